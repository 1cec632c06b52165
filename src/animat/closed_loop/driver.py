"""The loop itself: observe, choose, stimulate, read the response, move the robot, log."""

from __future__ import annotations

import itertools
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64

from animat.closed_loop.adaptive import AdaptiveThresholds
from animat.closed_loop.agents import Agent
from animat.closed_loop.log import LogRecord
from animat.closed_loop.loop import Loop
from animat.closed_loop.runner import runner_of
from animat.closed_loop.stretch import Stretch, check_answer, ending_of, read_response, request_fields, stretch_record
from animat.closed_loop.tick import EndedBy, Ending, Handled, Stop, Tick
from animat.closed_loop.timing import Clock
from animat.coding.encoder import Dealer
from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.cultures.failures import describe_error
from animat.cultures.observed import Observed
from animat.errors import AnimatError, BudgetSpent
from animat.evaluation.controllers import Controller, begun, index_of
from animat.neurons.history_tracker import HistoryState
from animat.responses.extraction import SILENCE_S
from animat.robots.starts import robot_generator
from animat.stimulation.schedule import TICK_S, on_ticks
from animat.stimulation.stimulus import Stimulus

T = TypeVar("T")


@dataclass(eq=False)
class Driver:
    """Runs episodes on a culture; everything that happens is appended to `records`, for another thread to write.

    Attributes:
        turns: the agent of each episode, by its number.
        stop_file: checked before every request to the culture; once it exists, there are no more requests.
        is_stopped: set by another thread, after which there are no more requests either.
        deadline: latest time on `time.monotonic()` for an answer, and from whom; a supervisor watches it.
        request: the fields of the latest request to the culture, answered or not; a supervisor logs it.
        unfinished: the record of a response that has not moved the robot yet: to be logged if it never does.
    """

    culture: Culture
    loop: Loop
    agents: Sequence[Agent]
    turns: Sequence[int]
    account: Account
    clock: Clock
    seed: int
    stop_file: Path
    is_stopped: bool = False
    deadline: tuple[float, str] = float("inf"), "nobody"
    request: dict[str, Any] | None = None
    unfinished: LogRecord | None = None

    def __post_init__(self) -> None:
        loop, culture = self.loop, self.culture
        self.records: deque[LogRecord] = deque()
        self._rng = np.random.default_rng([self.seed, 21])
        self._runner = runner_of(loop.robot, robot_generator(self.seed))
        if any(agent.switch_at is not None for agent in self.agents):
            # Compile now, like its step.
            self._runner.switch_goal(0)
        self._channels, self._rate_hz = culture.channels, culture.sampling_rate_hz
        # A device keeps its own time, from which the machine's clock drifts away.
        self._is_held_back = loop.real_time and culture.device is None
        # Not late within rounding: the grid of ticks and that of samples each move a pulse by up to half a step.
        self._least_late_s = max(TICK_S, (TICK_S + 1 / self._rate_hz) / 2) + 1e-9
        self._adaptive = None if loop.adaptive_from is None else AdaptiveThresholds(loop.adaptive_from)
        self._percentiles = loop.percentiles
        self._decoder, self._members = loop.decoder, loop.readouts.members(culture.channels)
        self._dealer = Dealer(loop.encoder, culture.patterns[: loop.patterns], self._rng)
        self._n_begun: Counter[str] = Counter()
        self._n_presented = self._n_stretches = 0
        self._zero_s = self._observed_until_s = self._last_pulse_s = 0.0
        self._data_at_s = self._wall_zero_s = 0.0
        self._last_command: float | tuple[float, ...] = 0.0
        self._remembered = HistoryState() if loop.history is None else loop.history.at_rest
        self._last_delivered: dict[str, list[int]] = {}
        """Conditions delivered in the last whole episode of each agent, the newest last."""

    def stopped_by_file(self) -> Ending | None:
        """The ending if a person created the stop file, or if the folder can no longer be read."""
        try:
            self.stop_file.stat()
        except FileNotFoundError:
            return None
        except OSError as error:
            return Ending("disk", f"{self.stop_file} cannot be looked for: {error.strerror or error}")
        return Ending("person", f"stopped by a person (the file {self.stop_file.name})")

    def run(self) -> Ending:
        """Run all episodes; every failure is an ending, never an exception."""
        try:
            self._zero_s = self._now_s()
            self._data_at_s = self._wall_zero_s = self.clock.now_s()
            for episode, turn in enumerate(self.turns):
                self._run_episode(episode, self.agents[turn])
        except Stop as stop:
            return stop.ending
        except Exception as error:
            return Ending("crash", f"an error of the loop itself: {describe_error(error)}")
        return Ending("plan", f"all {len(self.turns)} episodes were run")

    def _run_episode(self, episode: int, agent: Agent) -> None:
        loop = self.loop
        turn = self._n_begun[agent.name]
        self._n_begun[agent.name] += 1
        observation = self._start(episode, turn)
        self._last_command = 0.0 if (n := loop.robot.n_commands) == 1 else (0.0,) * n
        for rounds in loop.rounds_before(episode, is_silent=agent.delivery == "silent"):
            self._warm_up(agent, episode, rounds)
        controller = self._ask(agent.name, "controller", lambda: begun(agent.acting(turn)))
        remembering = loop.remembering if agent.sees_neurons(turn) else None
        source, conditions = list[int](), list[int]()
        if agent.delivery == "yoked":
            assert isinstance(agent.controller, Mapping)
            # The stimuli of its controllers' newest episode are repeated.
            source = [of for name, of in self._last_delivered.items() if name in agent.controller][-1]
        for iteration in range(loop.robot.episode_limit):
            seen = observation
            if remembering is not None:
                seen = np.concatenate([observation, remembering.observed(self._remembered)])
            chosen = delivered = self._choose(agent, controller, seen)
            if agent.delivery == "shuffled":
                delivered = int(self._rng.integers(len(loop.conditions)))
            elif agent.delivery == "yoked":
                delivered = source[iteration % len(source)]
            for repeats in itertools.count():
                tick = self._present(agent, episode, iteration, chosen, delivered, repeats)
                if tick.handled != "repeated":
                    break
            conditions.append(delivered)
            if tick.terminated or tick.truncated:
                break
            observation = np.array(tick.observation)
        # Insert it again, as the newest.
        self._last_delivered.pop(agent.name, None)
        self._last_delivered[agent.name] = conditions

    def _start(self, episode: int, turn: int) -> Float64[np.ndarray, " observations"]:
        """Start the robot: all agents of a round have the same start."""
        observation = self._ask("the robot", "robot", lambda: self._runner.reset(turn))
        if not np.all(np.isfinite(observation)):
            raise Stop(Ending("robot", f"the robot starts at {observation.tolist()}"))
        self.records.append(LogRecord({"kind": "start", "episode": episode, "observation": observation.tolist()}))
        return observation

    def _warm_up(self, agent: Agent, episode: int, rounds: int) -> None:
        """A pause, then stimuli that bring the culture to the state of its recording: a rested one differs."""
        self._observe((), self.loop.pause_s, self._now_s(), pause=True)
        # The first pulse comes as if one had been delivered at the end of the pause.
        self._last_pulse_s = self._now_s()
        for _ in range(rounds):
            for condition in self._rng.permutation(len(self.loop.conditions)).tolist():
                self._present(agent, episode, -1, condition, condition, 0)

    def _choose(self, agent: Agent, controller: Controller, seen: Float64[np.ndarray, " observed"]) -> int:
        n = len(self.loop.conditions)
        chosen = self._ask(agent.name, "controller", lambda: index_of(controller.act(seen, self._rng)))
        if not 0 <= chosen < n:
            raise Stop(Ending("controller", f"{agent.name} chose {chosen}: expected a condition from 0 to {n - 1}"))
        return chosen

    def _present(self, agent: Agent, episode: int, iteration: int, chosen: int, delivered: int, repeats: int) -> Tick:
        """Present a condition and move the robot by the response, unless it is repeated or warms the culture up."""
        loop, is_warm_up = self.loop, iteration < 0
        frequency_hz = self._dealer.frequency_hz(delivered)
        due_s = self._last_pulse_s + 1 / frequency_hz
        since_s, times_s = self._times(due_s, frequency_hz)
        is_stimulated = agent.delivery != "silent" or is_warm_up
        stimuli = self._stimuli(delivered, times_s, frequency_hz) if is_stimulated else []
        # Two samples longer than the window, so that a spike at its very end is not left to the next stretch.
        duration_s = float(times_s[-1]) + loop.window_ms[1] * 1e-3 + 2 / self._rate_hz
        decided_s = self.clock.now_s() - self._data_at_s
        stretch = self._observe(stimuli, duration_s, since_s)
        pulse_time_s = stretch.stimulus_time_s if stimuli else self._on_samples(since_s - self._zero_s + times_s)
        after_s = pulse_time_s[-1:]
        late_s = self._late_s(stimuli, pulse_time_s, due_s, frequency_hz)
        drawn_from = None if is_warm_up else agent.drawn_from
        x_hz, response = read_response(loop, drawn_from, stretch, self._members, after_s, self._rng)
        is_burst = response["is_burst"]
        self._last_pulse_s = self._zero_s + float(after_s[0])
        again = is_burst and loop.on_burst == "repeat" and repeats < loop.most_repeats and not is_warm_up
        at_trial = self._remembered
        if stimuli:
            at_trial = self._remember(delivered, pulse_time_s, response["rate_hz"], is_burst=is_burst)
        tick = Tick(
            number=self._n_presented,
            agent=agent.name,
            episode=episode,
            iteration=iteration,
            chosen=chosen,
            delivered=delivered,
            frequency_hz=frequency_hz,
            patterns=tuple(stimulus.pattern for stimulus in stimuli),
            pulse_time_s=tuple(pulse_time_s.tolist()) if stimuli else (),
            read_after_s=float(after_s[0]),
            handled="warm-up" if is_warm_up else "repeated" if again else "unfinished",
            late_s=late_s,
            decided_s=decided_s,
            neurons=() if loop.remembering is None else loop.remembering.observed(self._remembered),
            wall_s=self.clock.now_s() - self._wall_zero_s,
            **response,
        )
        self._n_presented += 1
        record = self.unfinished = stretch_record(stretch, stimuli, vars(tick))
        adapted: dict[str, Any] = {}
        try:
            if late_s and loop.on_late == "stop":
                raise Stop(Ending("lateness", f"a pulse came {1000 * late_s:.3g} ms late, and on_late is stop"))
            if tick.handled == "unfinished":
                tick = replace(tick, **self._move(agent, x_hz, is_burst, iteration))
            if self._adaptive is not None and stimuli and (agent.calibrates or is_warm_up) and not is_burst:
                self._adaptive.add(delivered, at_trial, np.asarray(x_hz))
                self._percentiles = self._adaptive.percentiles()
                adapted["percentiles_hz"] = self._percentiles.tolist()
        finally:
            # Whatever happens to the robot, the culture's response is logged.
            self.records.append(record._replace(fields={**record.fields, "tick": vars(tick), **adapted}))
            self.unfinished = None
        return tick

    def _stimuli(self, condition: int, times_s: Float64[np.ndarray, " pulses"], frequency_hz: float) -> list[Stimulus]:
        """The stimuli of a trial, on the next patterns of the deck."""
        return [
            Stimulus(float(t), target.electrodes, self.loop.pulse, frequency_hz, target.pattern, self._n_presented)
            for t, target in zip(times_s, self._dealer.targets(condition), strict=True)
        ]

    def _late_s(
        self,
        stimuli: Sequence[Stimulus],
        pulse_time_s: Float64[np.ndarray, " pulses"],
        due_s: float,
        frequency_hz: float,
    ) -> float:
        """How late the latest pulse of a trial came, whose first one was due at `due_s`; 0 within rounding.

        Where nothing is delivered, no pulse is late.
        """
        due_at_s = due_s - self._zero_s + np.arange(self.loop.pulses) / frequency_hz
        given = [i for i, stimulus in enumerate(stimuli) if not stimulus.is_rest]
        late_s = float(np.max((pulse_time_s - due_at_s)[given], initial=0.0))
        return late_s if late_s > self._least_late_s else 0.0

    def _remember(
        self, condition: int, pulse_time_s: Float64[np.ndarray, " pulses"], rate_hz: Any, *, is_burst: bool
    ) -> HistoryState:
        """Update the history state by a response; returns the state at its trial."""
        at_trial, history = self._remembered, self.loop.history
        if history is not None:
            is_rested = bool(pulse_time_s[0] - at_trial.at_s > SILENCE_S)
            at_trial = history.when(at_trial, float(pulse_time_s[-1]), is_rested=is_rested)
            self._remembered = history.after(at_trial, condition, rate_hz, is_burst=is_burst)
        return at_trial

    def _move(
        self, agent: Agent, x_hz: Float64[np.ndarray, "*readouts"], is_burst: bool, iteration: int
    ) -> dict[str, Any]:
        loop = self.loop
        handled: Handled = "skipped" if is_burst and loop.on_burst == "skip" else "used"
        if handled == "used":
            # In float32, as in training, so that a response on a percentile is exactly on it here as well.
            command = self._decoder.command(np.asarray(x_hz, np.float32)[()], self._percentiles)
            command = -command if agent.is_turned_round else command
            self._last_command = tuple(command.tolist()) if np.ndim(command) else float(command)
        moved = self._ask("the robot", "robot", lambda: self._runner.step(self._last_command))
        if iteration + 1 == agent.switch_at and not moved.terminated:
            other = self._ask("the robot", "robot", lambda: self._runner.switch_goal(self._n_presented))
            moved = moved._replace(observation=other)
        if not (np.isfinite(moved.reward) and np.all(np.isfinite(moved.observation))):
            raise Stop(Ending("robot", f"the robot returned {moved.observation.tolist()} with reward {moved.reward:g}"))
        return {
            "handled": handled,
            "command": self._last_command,
            "reward": moved.reward,
            "observation": tuple(moved.observation.tolist()),
            "terminated": moved.terminated,
            "truncated": (moved.truncated or iteration + 1 >= loop.robot.episode_limit) and not moved.terminated,
        }

    def _times(self, due_s: float, frequency_hz: float) -> tuple[float, Float64[np.ndarray, " pulses"]]:
        """The culture's clock now, and the times of a trial's pulses counted from it; the first one is due at `due_s`.

        The time until the request is included: pulses come when they are due, not later by that time.
        """
        now_s = self._now_s()
        first_s = max(due_s - now_s, 0.0)
        if self._is_held_back:
            # A culture that is held back to real time stands still meanwhile, and has to catch up.
            behind_s = self.clock.now_s() - self._wall_zero_s - (now_s - self._zero_s)
            first_s = max(first_s, behind_s)
        return now_s, on_ticks(first_s + np.arange(self.loop.pulses) / frequency_hz)

    def _observe(self, stimuli: Sequence[Stimulus], duration_s: float, since_s: float, pause: bool = False) -> Stretch:
        """Deliver stimuli, observe, and check the answer; times count from `since_s`; a pause is logged here."""
        if self.is_stopped:
            raise Stop(Ending("person", "stopped by a person"))
        if stopped := self.stopped_by_file():
            raise Stop(stopped)
        number = self._n_stretches
        request = request_fields(number, since_s - self._zero_s, stimuli)
        observed = self._delivered(stimuli, duration_s, since_s, request)
        fault = check_answer(
            observed,
            requested_s=np.array([stimulus.time_s for stimulus in stimuli], np.float64),
            duration_s=duration_s,
            since_s=since_s,
            from_s=self._zero_s + self._observed_until_s,
            sample_s=1 / self._rate_hz,
            n_channels=len(self._channels),
        )
        if fault is not None:
            ending = Ending("culture", fault)
            self._log_fault(ending, request, is_admitted=bool(stimuli), got=repr(observed)[:2000])
            raise Stop(ending)
        offset_s = observed.start_s - self._zero_s
        times_s, pulses_s = (self._on_samples(offset_s + t) for t in (observed.spikes.time_s, observed.stimulus_time_s))
        channel = np.asarray(observed.spikes.channel, np.int64)
        stretch = Stretch(number, offset_s, observed.duration_s, times_s, channel, self._channels, pulses_s)
        self._observed_until_s = offset_s + observed.duration_s
        if pause:
            self.records.append(stretch_record(stretch, (), None))
        if self._is_held_back:
            until_s = self._wall_zero_s + (self._now_s() - self._zero_s)
            self._set_deadline("the clock", max(0.0, until_s - self.clock.now_s()))
            self.clock.sleep_until(until_s)
        self._data_at_s = self.clock.now_s()
        return stretch

    def _delivered(
        self, stimuli: Sequence[Stimulus], duration_s: float, since_s: float, request: dict[str, Any]
    ) -> Observed:
        """What the culture answers, within the budget; if it fails, this is logged, and the loop ends."""
        culture, account = self.culture, self.account
        try:
            account.check(stimuli)
        except BudgetSpent as spent:
            raise Stop(Ending("budget", str(spent))) from spent
        self._n_stretches += 1
        # Spent before the answer: unanswered pulses may have been delivered.
        account.spend(stimuli)
        self.request = request
        self._set_deadline("the culture", duration_s)
        try:
            return culture.deliver(stimuli, duration_s, since_s=since_s)
        except Exception as error:
            # By the error itself: the culture's count may include another thread's stimuli.
            is_admitted = not isinstance(error, AnimatError) or error.is_admitted
            if not is_admitted:
                account.take_back(stimuli)
            # If a person stopped the culture, that ended the session, not the refusal that follows.
            ending = ending_of(error, culture, self.is_stopped)
            self._log_fault(ending, request, is_admitted=is_admitted)
            raise Stop(ending) from error

    def _log_fault(self, ending: Ending, request: dict[str, Any], **more: Any) -> None:
        """Log a request that has no usable answer."""
        fields = {"kind": "event", "what": ending.by, "message": ending.message, **request, **more}
        self.records.append(LogRecord(fields))

    def _ask(self, who: str, by: EndedBy, ask: Callable[[], T]) -> T:
        """The answer of the robot or an agent, by a deadline; whatever it raises ends the session."""
        self._set_deadline(who)
        try:
            return ask()
        except BaseException as error:
            # Also SystemExit, KeyboardInterrupt and CancelledError, which a user's code or its libraries may raise.
            raise Stop(Ending(by, f"{who} raised {describe_error(error)}")) from error

    def _set_deadline(self, who: str, in_s: float = 0.0) -> None:
        """Set who has to answer next, and the expected time, to which the patience is added."""
        self.deadline = time.monotonic() + in_s + self.loop.patience_s, who

    def _now_s(self) -> float:
        """The culture's clock; fails if the connection is lost."""
        self._set_deadline("the culture")
        try:
            return self.culture.now_s
        except Exception as error:
            raise Stop(ending_of(error, self.culture, self.is_stopped)) from error

    def _on_samples(self, times_s: Float64[np.ndarray, " times"]) -> Float64[np.ndarray, " times"]:
        # The same numbers as in a recording of the session, so that windows agree to the last bit.
        return np.asarray(np.rint(times_s * self._rate_hz) / self._rate_hz)
