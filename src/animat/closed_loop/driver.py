"""The loop itself: observe, choose, stimulate, read the response, move the robot, write it down."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.closed_loop.adaptive import AdaptiveThresholds
from animat.closed_loop.agents import Agent, Controller, InTurn
from animat.closed_loop.log import Record
from animat.closed_loop.loop import Loop
from animat.closed_loop.runner import HostRunner, RobotRunner, Runner
from animat.closed_loop.standing import Standing
from animat.closed_loop.stopping import Stop, ending_of, is_there
from animat.closed_loop.stretch import Asked, Stretch, read_response, seen_in, wrong_with
from animat.closed_loop.tick import Ending, Handled, Tick
from animat.closed_loop.timing import Clock
from animat.coding.encoder import Dealer
from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.cultures.failing import in_words
from animat.errors import AnimatError, BudgetSpent
from animat.neurons.history_tracker import HistoryState
from animat.responses.extraction import SILENCE_S
from animat.robots.host import HostRobot
from animat.stimulation.schedule import TICK_S, on_ticks
from animat.stimulation.stimulus import Stimulus


class Driver:
    """Runs episodes on a culture; everything that happens is appended to `records`, for another thread to write.

    Args:
        culture: open.
        loop: the settings.
        agents: who acts.
        turns: whose turn each episode is.
        account: of the stimulation budget.
        clock: the machine's.
        seed: decides every random draw.
        stop_file: looked for before anything is asked of the culture; once it is there, nothing is any more.
    """

    def __init__(
        self,
        culture: Culture,
        loop: Loop,
        agents: Sequence[Agent],
        turns: Sequence[int],
        account: Account,
        clock: Clock,
        seed: int,
        stop_file: Path,
    ) -> None:
        self.records: deque[Record] = deque()
        self.standing = Standing(loop.robot.episode_limit)
        self.is_stopped = False
        self.expected = float("inf"), "nobody"
        """By when, on `time.monotonic()`, who should have answered at the latest; a supervisor watches it."""
        self.under_way: Asked | None = None
        """What was asked of the culture and is not answered yet; a supervisor writes it down."""
        self._stop_file = stop_file
        self._culture, self._loop, self._agents, self._turns = culture, loop, agents, turns
        self._account, self._clock = account, clock
        self._rng = np.random.default_rng([seed, 21])
        runs = HostRunner if isinstance(loop.robot, HostRobot) else RobotRunner
        self._runner: Runner = runs(loop.robot, np.random.default_rng([seed, 22]))
        if any(agent.switch_at is not None for agent in agents):
            # Compiled now, as its step is.
            self._runner.switch_goal(0)
        self._channels, self._rate_hz = culture.channels, culture.sampling_rate_hz
        self._adaptive = None if loop.adaptive_from is None else AdaptiveThresholds(loop.adaptive_from)
        self._percentiles = loop.percentiles
        self._decoder, self._members = loop.decoder, loop.readouts.members(culture.channels)
        self._dealer = Dealer(loop.encoder, culture.patterns[: loop.patterns], self._rng)
        self._begun: Counter[str] = Counter()
        self._presented = self._stretches = 0
        self._zero_s = self._seen_until_s = self._last_pulse_s = 0.0
        self._data_at_s = self._wall_zero_s = 0.0
        self._last_command = self._at_rest
        self._remembered = HistoryState()
        self._given: dict[str, list[int]] = {}
        """What was delivered in the last whole episode of each agent."""
        self._unmoved: tuple[Stretch, Sequence[Stimulus], dict[str, Any]] | None = None

    @property
    def _at_rest(self) -> float | tuple[float, ...]:
        return 0.0 if (n := self._loop.robot.n_commands) == 1 else (0.0,) * n

    @property
    def unfinished(self) -> Record | None:
        """What the culture answered while the robot has not moved by it: to be written down if it never does."""
        return None if self._unmoved is None else seen_in(*self._unmoved)

    def stopped_by_file(self) -> Ending | None:
        """The ending that a person asks for by a file, if they do."""
        words = f"stopped by a person (the file {self._stop_file.name})"
        return Ending("person", words) if is_there(self._stop_file) else None

    def run(self) -> Ending:
        """Run all episodes; whatever goes wrong is an ending, never an exception."""
        try:
            self._zero_s = self._now_s()
            self._data_at_s = self._wall_zero_s = self._clock.now_s()
            for episode, turn in enumerate(self._turns):
                self._run_episode(episode, self._agents[turn])
                self.standing.end()
        except Stop as stop:
            return stop.ending
        except Exception as error:
            return Ending("crash", f"an error of the loop itself: {in_words(error)}")
        return Ending("plan", f"all {len(self._turns)} episodes were run")

    def _run_episode(self, episode: int, agent: Agent) -> None:
        loop = self._loop
        turn = self._begun[agent.name]
        self._begun[agent.name] += 1
        controller = agent.acting(turn)
        observation = self._start(episode, turn)
        self._last_command = self._at_rest
        for rounds in loop.rounds_before(episode, is_silent=agent.delivery == "silent"):
            self._warm_up(agent, episode, rounds)
        self.standing.begin(agent.name)
        given, remembering = list[int](), loop.remembering if agent.sees_neurons(turn) else None
        source = self._source_of(agent)
        for iteration in range(loop.robot.episode_limit):
            seen = observation if remembering is None else remembering.append_to(observation, self._remembered)
            chosen = self._choose(agent, controller, seen)
            repeats = 0
            while True:
                delivered = chosen
                if agent.delivery == "shuffled":
                    delivered = int(self._rng.integers(len(loop.conditions)))
                elif agent.delivery == "yoked":
                    delivered = source[iteration % len(source)]
                tick, again = self._present(agent, episode, iteration, chosen, delivered, repeats)
                if not again:
                    break
                repeats += 1
            given.append(delivered)
            self.standing.add(tick.reward or 0.0)
            if tick.terminated or tick.truncated:
                break
            observation = np.array(tick.observation)
        # The newest is the last of all.
        self._given.pop(agent.name, None)
        self._given[agent.name] = given

    def _source_of(self, agent: Agent) -> list[int]:
        """What a yoked agent's culture is given: that of one who takes turns there, the newest episode of any."""
        if agent.delivery != "yoked":
            return []
        assert isinstance(agent.controller, InTurn)
        of_them = [given for name, given in self._given.items() if name in agent.controller.by_name]
        if not of_them:
            raise Stop(Ending("controller", f"{agent.name}: expected an episode of a policy before, got none"))
        return of_them[-1]

    def _start(self, episode: int, turn: int) -> Float64[np.ndarray, " observations"]:
        """Put the robot where it starts: in a round of all agents each meets the same start."""
        self._expect("the robot")
        try:
            observation = self._runner.reset(turn)
        except Exception as error:
            raise Stop(Ending("robot", f"the robot raised {in_words(error)}")) from error
        if not np.all(np.isfinite(observation)):
            raise Stop(Ending("robot", f"the robot starts at {observation.tolist()}"))
        self.records.append(Record({"kind": "start", "episode": episode, "observation": observation.tolist()}))
        return observation

    def _warm_up(self, agent: Agent, episode: int, rounds: int) -> None:
        """A pause, then what brings the culture to where it was recorded: a rested one responds differently."""
        self._see((), self._loop.pause_s, self._now_s(), pause=True)
        # The first pulse comes as if one had been given at the end of the pause.
        self._last_pulse_s = self._now_s()
        for _ in range(rounds):
            for condition in self._rng.permutation(len(self._loop.conditions)).tolist():
                self._present(agent, episode, -1, condition, condition, 0)

    def _choose(self, agent: Agent, controller: Controller, observation: Float64[np.ndarray, " observations"]) -> int:
        n = len(self._loop.conditions)
        self._expect(agent.name)
        try:
            chosen = int(controller.act(observation, self._rng))
        except Exception as error:
            raise Stop(Ending("controller", f"{agent.name} raised {in_words(error)}")) from error
        if not 0 <= chosen < n:
            raise Stop(Ending("controller", f"{agent.name} chose {chosen}: expected a condition from 0 to {n - 1}"))
        return chosen

    def _present(
        self, agent: Agent, episode: int, iteration: int, chosen: int, delivered: int, repeats: int
    ) -> tuple[Tick, bool]:
        """Present a condition and move the robot by the answer; returns whether to present it once more instead.

        Before iteration 0 the robot stands, whatever the answer.
        """
        loop, is_warm_up = self._loop, iteration < 0
        frequency_hz = self._dealer.frequency_hz(delivered)
        due_s = self._last_pulse_s + 1 / frequency_hz
        since_s, times_s = self._times(due_s, frequency_hz)
        stimuli: list[Stimulus] = []
        if agent.delivery != "silent" or is_warm_up:
            stimuli = [
                Stimulus(float(t), on.electrodes, loop.pulse, frequency_hz, on.pattern, self._presented)
                for t, on in zip(times_s, self._dealer.targets(delivered), strict=True)
            ]
        # Two samples more than the window: no spike at its very end can then be seen only in the next stretch.
        duration_s = float(times_s[-1]) + loop.window_ms[1] * 1e-3 + 2 / self._rate_hz
        decided_s = self._clock.now_s() - self._data_at_s
        stretch = self._see(stimuli, duration_s, since_s)
        pulse_time_s = stretch.stimulus_time_s if stimuli else self._on_samples(stretch.asked_at_s + times_s)
        after_s = pulse_time_s[-1:]
        # From when they really came; a grid step is the grid's, and a sample's rounding, and not lateness.
        due_at_s = due_s - self._zero_s + np.arange(loop.pulses) / frequency_hz
        late_s = float(np.max(pulse_time_s - due_at_s))
        late_s = late_s if late_s > TICK_S + 1e-9 else 0.0
        read = read_response(loop, None if is_warm_up else agent.drawn_from, stretch, self._members, after_s, self._rng)
        self._last_pulse_s = self._zero_s + float(after_s[0])
        again = read.is_burst and loop.on_burst == "repeat" and repeats < loop.most_repeats and not is_warm_up
        tick: dict[str, Any] = {
            "number": self._presented,
            "agent": agent.name,
            "episode": episode,
            "iteration": iteration,
            "chosen": chosen,
            "delivered": delivered,
            "frequency_hz": frequency_hz,
            "patterns": tuple(stimulus.pattern for stimulus in stimuli),
            "pulse_time_s": tuple(pulse_time_s.tolist()) if stimuli else (),
            "read_after_s": float(after_s[0]),
            "handled": "warm-up" if is_warm_up else "repeated" if again else "unfinished",
            "command": None,
            "reward": None,
            "observation": (),
            "terminated": False,
            "truncated": False,
            "late_s": late_s,
            "decided_s": decided_s,
            **read.told,
        }
        self._presented += 1
        came = self._remembered
        if loop.history is not None and stimuli:
            is_rested = bool(pulse_time_s[0] - came.at_s > SILENCE_S)
            came = loop.history.when(came, float(after_s[0]), is_rested=is_rested)
            self._remembered = loop.history.after(came, delivered, read.told["rate_hz"], is_burst=read.is_burst)
        if loop.remembering is not None:
            tick["neurons"] = loop.remembering.observed(self._remembered)
        tick["wall_s"] = self._clock.now_s() - self._wall_zero_s
        self._unmoved = stretch, stimuli, dict(tick)
        adapted: dict[str, Any] = {}
        try:
            if late_s and loop.on_late == "stop":
                raise Stop(Ending("lateness", f"a pulse came {1000 * late_s:.3g} ms late, and that was to stop it"))
            if not (again or is_warm_up):
                tick |= self._move(agent, read.x_hz, read.is_burst, iteration)
            if self._adaptive is not None and stimuli and (agent.calibrates or is_warm_up) and not read.is_burst:
                self._adaptive.add(delivered, came, np.asarray(read.x_hz))
                self._percentiles = self._adaptive.percentiles()
                adapted["percentiles_hz"] = self._percentiles.tolist()
        finally:
            # Whatever happens to the robot, what the culture did is written down.
            finished = Tick(**tick)
            record = seen_in(stretch, stimuli, vars(finished))
            record.words.update(adapted)
            self.records.append(record)
            self._unmoved = None
        return finished, again

    def _move(
        self, agent: Agent, x_hz: Float64[np.ndarray, "*readouts"], is_burst: bool, iteration: int
    ) -> dict[str, Any]:
        loop = self._loop
        handled: Handled = "skipped" if is_burst and loop.on_burst == "skip" else "used"
        if handled == "used":
            # In float32, as when it was trained: a response that lies on a percentile is then on it here as well.
            command = self._decoder.command(np.asarray(x_hz, np.float32)[()], self._percentiles)
            command = -command if agent.is_turned_round else command
            self._last_command = tuple(command.tolist()) if np.ndim(command) else float(command)
        self._expect("the robot")
        try:
            moved = self._runner.step(self._last_command)
            if iteration + 1 == agent.switch_at and not moved.terminated:
                moved = moved._replace(observation=self._runner.switch_goal(self._presented))
        except Exception as error:
            raise Stop(Ending("robot", f"the robot raised {in_words(error)}")) from error
        if not (np.isfinite(moved.reward) and np.all(np.isfinite(moved.observation))):
            raise Stop(Ending("robot", f"the robot came to {moved.observation.tolist()} with reward {moved.reward:g}"))
        return {
            "handled": handled,
            "command": self._last_command,
            "reward": moved.reward,
            "observation": tuple(moved.observation.tolist()),
            "terminated": moved.terminated,
            "truncated": (moved.truncated or iteration + 1 >= loop.robot.episode_limit) and not moved.terminated,
        }

    def _times(self, due_s: float, frequency_hz: float) -> tuple[float, Float64[np.ndarray, " pulses"]]:
        """The culture's clock, and when the pulses of a trial come after that; the first one is due at `due_s`.

        All that it takes to ask for them from here on is counted: they come when they are due, not later by that.
        """
        now_s = self._now_s()
        first_s = max(due_s - now_s, 0.0)
        if self._loop.real_time:
            # A culture that is held back to real time stands still meanwhile: what is missed has to be made up.
            behind_s = self._clock.now_s() - self._wall_zero_s - (now_s - self._zero_s)
            first_s = max(first_s, behind_s)
        return now_s, on_ticks(first_s + np.arange(self._loop.pulses) / frequency_hz)

    def _see(self, stimuli: Sequence[Stimulus], duration_s: float, since_s: float, pause: bool = False) -> Stretch:
        """Deliver, watch, and check what came back; times count from `since_s`; a pause is written down here."""
        if self.is_stopped:
            raise Stop(Ending("person", "stopped by a person"))
        if stopped := self.stopped_by_file():
            raise Stop(stopped)
        culture, account = self._culture, self._account
        try:
            account.check(stimuli)
        except BudgetSpent as spent:
            raise Stop(Ending("budget", str(spent))) from spent
        asked = Asked(self._stretches, since_s - self._zero_s, tuple(stimuli))
        self._stretches += 1
        # Spent from now on: whether pulses that are never answered came is not known.
        account.spend(stimuli)
        self.under_way = asked
        self._expect("the culture", duration_s)
        try:
            observed = culture.deliver(stimuli, duration_s, since_s=since_s)
        except Exception as error:
            # Not what the culture counts: another thread may have stimuli delivered meanwhile.
            is_admitted = not isinstance(error, AnimatError) or error.is_admitted
            if not is_admitted:
                account.take_back(stimuli)
            # Whoever stopped the culture ended the session, not the culture's refusal that follows.
            ending = ending_of(error, culture, self.is_stopped)
            self._note_fault(ending, asked, is_admitted=is_admitted)
            raise Stop(ending) from error
        wrong = wrong_with(
            observed,
            asked_s=np.array([stimulus.time_s for stimulus in stimuli], np.float64),
            duration_s=duration_s,
            since_s=since_s,
            from_s=self._zero_s + self._seen_until_s,
            sample_s=1 / self._rate_hz,
            n_channels=len(self._channels),
        )
        if wrong is not None:
            ending = Ending("culture", wrong)
            self._note_fault(ending, asked, is_admitted=bool(stimuli), got=repr(observed)[:2000])
            raise Stop(ending)
        offset_s = observed.start_s - self._zero_s
        stretch = Stretch(
            asked.stretch,
            asked.at_s,
            offset_s,
            observed.duration_s,
            self._on_samples(offset_s + observed.spikes.time_s),
            np.asarray(observed.spikes.channel, np.int64),
            self._channels,
            self._on_samples(offset_s + observed.stimulus_time_s),
        )
        self._seen_until_s = offset_s + observed.duration_s
        if pause:
            self.records.append(seen_in(stretch, (), None))
        if self._loop.real_time:
            until_s = self._wall_zero_s + (self._now_s() - self._zero_s)
            self._expect("the clock", max(0.0, until_s - self._clock.now_s()))
            self._clock.sleep_until(until_s)
        self._data_at_s = self._clock.now_s()
        return stretch

    def _note_fault(self, ending: Ending, asked: Asked, **more: Any) -> None:
        """Have it written down that what was asked came to no answer that can be used."""
        words = {"kind": "event", "what": ending.by, "message": ending.message, **asked.to_dict(), **more}
        self.records.append(Record(words))

    def _expect(self, who: str, in_s: float = 0.0) -> None:
        """Say who is waited for, and how long that may take besides patience."""
        self.expected = time.monotonic() + in_s + self._loop.patience_s, who

    def _now_s(self) -> float:
        """The culture's clock, which a connection that is lost takes along."""
        self._expect("the culture")
        try:
            return self._culture.now_s
        except Exception as error:
            raise Stop(ending_of(error, self._culture, self.is_stopped)) from error

    def _on_samples(self, times_s: Float64[np.ndarray, " times"]) -> Float64[np.ndarray, " times"]:
        # The same numbers that a recording of the session holds: only then are windows the same to the last bit.
        return np.asarray(np.rint(times_s * self._rate_hz) / self._rate_hz)
