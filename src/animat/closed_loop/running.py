"""Running a session: the loop in its own thread, and a supervisor that logs, watches, and ends it safely."""

from __future__ import annotations

import gc
import json
import math
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext, suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from animat.closed_loop.agents import Agent, interleave
from animat.closed_loop.driver import Driver
from animat.closed_loop.header import FORMAT, observed_columns, read_header
from animat.closed_loop.log import LogRecord, LogWriter
from animat.closed_loop.loop import Loop
from animat.closed_loop.outline import Outline
from animat.closed_loop.session import LOG_FILE, Session, expect_no_session
from animat.closed_loop.tick import STOP_FILE, Ending
from animat.closed_loop.timing import Clock, drop_real_time_priority, real_time_priority
from animat.ctrl_c import KILLS, handled
from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.cultures.failures import describe_error
from animat.errors import AnimatError, InvalidArgument, Mismatch, expect_at_least, shown, some_of
from animat.evaluation.statistics import Interval
from animat.progress import Progress, Silent
from animat.stimulation.plain import whole_number
from animat.writing import UNCHANGED

MOST_EPISODES = 100_000
"""Most episodes of each agent in a session."""
_POLL_S = 0.02
_BATCH, _PAUSE_S = 4, 2.5e-4
"""Records written in a row, some 0.2 ms, and the pause after them: the loop's thread may have a deadline."""
_SWITCH_S = 2e-4
"""How long the loop's thread may keep the interpreter while the log waits for it; Python's default is 5 ms."""
_SYNC_S = 0.5
"""Time between flushes of the log to disk: with polling and writing, a power cut then costs under 1 s."""
_GRACE_S = 2.0
"""How long the loop's thread has to end after a request to stop."""
_UNANSWERED_S = 2.0
"""And after Ctrl-C before that, however long its patience with an agent."""


def run_session(
    culture: Culture,
    loop: Loop,
    agents: Sequence[Agent],
    folder: str | os.PathLike[str],
    *,
    episodes: int | Sequence[int] = 5,
    seed: int = 1,
    account: Account | None = None,
    clock: Clock | None = None,
    progress: Progress | None = None,
    predicted: Mapping[str, Interval] | None = None,
) -> Session:
    """Run agents in closed loop on a culture, their episodes interleaved in random order.

    Whatever happens, `session.log` has every tick except those of the last 0.2 s before a SIGKILL, and the stimuli
    that were requested and not yet answered. Once this or `recover_session` returns, `session.nwb` is a recording like
    any other. Unless the plan was completed or the budget spent, the culture is then stopped: it delivers nothing until
    it is closed and opened again. `ending` says what happened; nothing is raised for it, not even for Ctrl-C and
    SIGTERM. A file `STOP` in the folder ends the session before the next pulse. An exception of `progress` is raised
    again, once the culture is stopped and the log is written.

    Args:
        culture: open; it stays open.
        agents: at least one, each name once.
        folder: for `session.log`, `session.nwb`, and `ticks.csv` with a line per tick.
        episodes: of each agent; one number, or one for each.
        seed: decides every random draw, except what the culture does.
        account: of a stimulation budget; None: unlimited.
        clock: the machine's; None: its monotonic clock.
        progress: updated continuously with the number of finished episodes and the returns so far.
        predicted: mean return expected of each agent, with its interval; stored in the log for viewers.

    Raises:
        InvalidArgument: for a culture, agents, a prediction or a loop that cannot be run, or a folder with a session or
            a file `STOP`.
        Mismatch: for electrodes that the culture does not stimulate or record, or a folder of other work.
        InvalidFile: if the folder is a file, or the log cannot be begun.
        UnsafeStimulus: for a pulse beyond the culture's limits.
    """
    several = episodes if isinstance(episodes, Iterable) else [episodes] * len(agents)
    planned, seed = [whole_number("episodes", number) for number in several], whole_number("seed", seed)
    check_session(culture, loop, agents, planned, seed)
    if unknown := sorted({*(predicted or {})} - {agent.name for agent in agents}):
        raise InvalidArgument(f"predicted: expected names of agents, got {', '.join(unknown)}")
    expect_no_session(folder)
    turns = _put_sources_first(interleave(planned, np.random.default_rng([seed, 20])), agents)
    driver = Driver(culture, loop, agents, turns, account or Account(), clock or Clock(), seed, Path(folder, STOP_FILE))
    file = Path(folder) / LOG_FILE
    # As it is read back from the log.
    header = json.loads(json.dumps(_header(driver, predicted or {})))
    read_header(file, header)
    with closing(LogWriter(file, header)) as log:
        ending = _Supervisor(driver, log, progress or Silent()).run()
        session = Session(file.parent, log.written(), ending)
        try:
            session.write()
        except Exception as error:
            # Return the session even if its files cannot be written.
            fault = error if isinstance(error, AnimatError) else f"its files cannot be made: {describe_error(error)}"
            fault = str(fault).removesuffix(UNCHANGED)
            message = f"{ending.message}; {fault} (once that is fixed, animat recover {folder} writes the files)"
            session = replace(session, ending=replace(ending, message=message))
    return session


class _Supervisor:
    def __init__(self, driver: Driver, log: LogWriter, progress: Progress) -> None:
        self._driver, self._culture, self._loop = driver, driver.culture, driver.loop
        self._log, self._progress, self._synced = log, progress, time.monotonic()
        self._outline = Outline()
        self._ending: Ending | None = None
        self._logged_request = -1
        self._not_halted: str | None = None
        self._by_person: tuple[float, Ending] | None = None
        self._left_out = driver.culture.left_out

    def run(self) -> Ending:
        """Start the loop and supervise it until its end."""
        thread = threading.Thread(target=self._drive, name="closed loop", daemon=True)
        with ExitStack() as stack:
            # They request an end instead of interrupting the loop.
            stack.enter_context(handled((signal.SIGINT, *KILLS), lambda *_: self._stop_for_person()))
            if gc.isenabled():
                # A collection can take 50 ms, and the loop makes no cycles.
                stack.callback(gc.enable)
                gc.disable()
            stack.callback(sys.setswitchinterval, sys.getswitchinterval())
            sys.setswitchinterval(_SWITCH_S)
            stack.enter_context(self._priority(inherited=True))
            thread.start()
            try:
                ending = self._watch(thread)
            except BaseException as error:
                # From the caller's progress, or our own: an unsupervised loop must not continue.
                ending = Ending("person", "stopped by a person")
                if not isinstance(error, KeyboardInterrupt):
                    ending = Ending("crash", f"the loop's supervisor raised {describe_error(error)}")
                with suppress(Exception):
                    self._end(thread, ending)
                raise
            return self._end(thread, ending)

    def _end(self, thread: threading.Thread, ending: Ending) -> Ending:
        """Stop the culture; ask a loop that did not end by itself to end, and abandon it if it does not."""
        if ending.by not in ("plan", "budget"):
            self._driver.is_stopped = True
            self._halt(ending)
        if thread.is_alive():
            thread.join(_GRACE_S)
            if thread.is_alive():
                drop_real_time_priority(thread)
            self._halt(ending)
        return self._finish(ending)

    def _drive(self) -> None:
        # Threads and programs that the robot or an agent starts have no deadlines.
        with self._priority(inherited=False):
            self._ending = self._driver.run()

    def _priority(self, *, inherited: bool) -> AbstractContextManager[None]:
        """Real-time priority if there are deadlines; a loop that never waits would starve other programs."""
        if not self._loop.real_time and self._culture.device is None:
            return nullcontext()
        return real_time_priority(inherited=inherited)

    def _watch(self, thread: threading.Thread) -> Ending:
        """Log and watch while the loop runs; returns why it ended, or must be ended from outside."""
        driver, is_running = self._driver, True
        while is_running:
            thread.join(_POLL_S)
            # Looked at before writing, so that the last records are written and reported too.
            is_running = thread.is_alive()
            try:
                self._write()
            except OSError as error:
                if not is_running:
                    # Why the loop ended counts; `_finish` tries again, and says what is lost.
                    break
                return Ending("disk", f"the log cannot be written: {error.strerror or error}")
            if thread.is_alive() and (stopped := self._stopped_by_person() or driver.stopped_by_file()):
                # The loop checks before its next trial; do not wait for the pulses of the current one.
                return stopped
            by_s, who = driver.deadline
            if time.monotonic() > by_s and thread.is_alive():
                late = f"{self._loop.patience_s:g} s after it should have"
                return Ending("hang", f"{who} did not answer {late}: abandoned")
            self._report()
        return self._ending or Ending("crash", "the loop's thread ended without giving a reason")

    def _report(self) -> None:
        """Report how many episodes are over, the last return, and the agents' means; `"warm-up"` before any."""
        episode, returns = self._outline.moving, self._outline.returns
        done: float = sum(map(len, returns.values()))
        note = "warm-up"
        if episode is not None:
            done += 0 if episode.is_whole else episode.iterations / self._loop.robot.episode_limit
            note = f"{episode.agent}: return {episode.total:.1f}{'' if episode.is_whole else ' so far'}"
        if returns:
            note += f"; means: {', '.join(f'{name} {fmean(of):.1f}' for name, of in returns.items())}"
        self._progress.update(done, len(self._driver.turns), note)

    def _write(self) -> None:
        records = self._driver.records
        # Only the present records: a loop as fast as the log must not keep this thread from watching it.
        for number in range(len(records)):
            self._log.append(records[0])
            # Removed only once written, so that a full disk loses no record that could be written later.
            self._outline.add(records.popleft().fields)
            if number % _BATCH == _BATCH - 1:
                # A pause of 0 would not yield the processor to the loop's thread on a single core.
                time.sleep(_PAUSE_S)
        request = self._driver.request
        if request is not None and request["stretch"] > self._logged_request:
            # Known even if the answer never comes, or the program is killed meanwhile.
            self._log.append(LogRecord({"kind": "asked", **request}))
            self._logged_request = request["stretch"]
        if time.monotonic() - self._synced > _SYNC_S:
            self._log.sync()
            self._synced = time.monotonic()

    def _finish(self, ending: Ending) -> Ending:
        """Log the remaining records and the ending."""
        if self._not_halted is not None:
            message = f"{ending.message}; BUT {self._not_halted}: make sure that the device delivers no more pulses"
            ending = replace(ending, message=message)
        left_out: dict[str, int] = {}
        # A culture that has lost its device may fail here.
        with suppress(Exception):
            left_out = Counter(self._culture.left_out) - Counter(self._left_out)
        try:
            # Read before writing: if the robot answers just now, its finished tick is among the written records.
            unfinished = self._driver.unfinished
            self._write()
            if unfinished is not None and unfinished.fields["stretch"] > self._outline.answered:
                self._log.append(unfinished)
            fields = {"kind": "end", "by": ending.by, "message": ending.message, "left_out": left_out}
            self._log.append(LogRecord(fields))
            self._log.sync()
        except OSError as error:
            left, why = len(self._driver.records), error.strerror or str(error)
            lost = {0: "the ending", 1: "the last tick"}.get(left, f"the last {left} ticks")
            message = f"{ending.message}; {lost} could not be written and {'are' if left > 1 else 'is'} lost"
            message += "" if why in ending.message else f" ({why})"
            return Ending("disk" if ending.by in ("plan", "budget") else ending.by, message)
        return ending

    def _stop_for_person(self) -> None:
        self._driver.is_stopped = True
        ending = Ending("person", "stopped by a person (Ctrl-C or kill)")
        self._by_person = self._by_person or (time.monotonic(), ending)
        self._halt(ending)

    def _stopped_by_person(self) -> Ending | None:
        """The ending if a person stopped the loop some time ago, and an agent or the robot keeps it from ending."""
        since_s, ending = self._by_person or (math.inf, None)
        # The culture's answer to the last pulses is waited for; only the robot and agents are not.
        is_theirs = self._driver.deadline[1] not in ("the culture", "the clock")
        return ending if is_theirs and time.monotonic() > since_s + _UNANSWERED_S else None

    def _halt(self, ending: Ending) -> None:
        """Stop the culture in a separate thread: a backend that hangs must not block the end as well."""
        self._not_halted = f"the culture did not confirm within {_GRACE_S:g} s that it is stopped"

        def halt() -> None:
            # From here on the guard refuses every stimulus, whatever the backend does with those already requested.
            try:
                self._culture.stop(ending.message)
            except Exception as error:
                self._not_halted = f"the culture could not be stopped ({describe_error(error)})"
            else:
                self._not_halted = None

        halting = threading.Thread(target=halt, daemon=True)
        halting.start()
        halting.join(_GRACE_S)


def _header(driver: Driver, predicted: Mapping[str, Interval]) -> dict[str, Any]:
    culture, loop, agents, channels = driver.culture, driver.loop, driver.agents, driver.culture.channels
    predictions = {name: {"mean": r.value, "low": r.low, "high": r.high} for name, r in predicted.items()}
    return {
        "kind": "header",
        "format": FORMAT,
        "recorded_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "start_min": culture.now_s / 60,
        "sampling_rate_hz": culture.sampling_rate_hz,
        "channels": {name: getattr(channels, name).tolist() for name in ("label", "electrode", "x_um", "y_um")},
        "culture": culture.name,
        "provenance": culture.provenance,
        "limits": asdict(culture.limits),
        # Including what was spent before the session.
        "account": driver.account.to_dict(),
        "loop": loop.to_dict(),
        "observed": observed_columns(loop.robot),
        "agents": [_agent_to_dict(agent) for agent in agents],
        "turns": [agents[turn].name for turn in driver.turns],
        "seed": driver.seed,
        **({"predicted": predictions} if predictions else {}),
    }


def _put_sources_first(turns: list[int], agents: Sequence[Agent]) -> list[int]:
    """Swap an agent's first yoked episode with the first one that it can repeat, if that comes later."""
    turns = list(turns)
    for number, agent in enumerate(agents):
        if agent.delivery != "yoked" or number not in turns:
            continue
        names = agent.controller if isinstance(agent.controller, Mapping) else ()
        sources = [i for i, turn in enumerate(turns) if agents[turn].name in names]
        if not sources:
            raise InvalidArgument(f"agents: expected episodes for {agent.name!r} to repeat, got none")
        if (first := turns.index(number)) < sources[0]:
            turns[first], turns[sources[0]] = turns[sources[0]], turns[first]
    return turns


def _agent_to_dict(agent: Agent) -> dict[str, Any]:
    optional = {
        # The controllers of successive episodes, in a cycle.
        "in_turn": list(agent.controller) if isinstance(agent.controller, Mapping) else [],
        "is_drawn": agent.drawn_from is not None,
        "is_turned_round": agent.is_turned_round,
        "switch_at": agent.switch_at,
    }
    required = {"name": agent.name, "meaning": agent.meaning, "delivery": agent.delivery}
    return required | {name: value for name, value in optional.items() if value}


def check_episodes(name: str, episodes: int) -> None:
    """Raise InvalidArgument for no episodes, or more than a session can plan: all turns are drawn before the first."""
    if not 1 <= episodes <= MOST_EPISODES:
        expected = "at least 1" if episodes < 1 else f"at most {MOST_EPISODES:,}"
        raise InvalidArgument(f"{name}: expected {expected}, got {shown(episodes)}")


def check_session(culture: Culture, loop: Loop, agents: Sequence[Agent], episodes: Sequence[int], seed: int) -> None:
    """Raise as `run_session` does for its culture, loop and agents."""
    if not culture.is_open or culture.is_stopped:
        state = "stopped" if culture.is_open else "closed"
        raise InvalidArgument(f"culture: expected an open one that can be stimulated, got one that is {state}")
    if not agents:
        raise InvalidArgument("agents: expected at least one, got none")
    if twice := [name for name, n in Counter(agent.name for agent in agents).items() if n > 1]:
        remedy = "rename the policy's file if it has the name of a control"
        raise InvalidArgument(f"agents: expected each name once, got {some_of(twice)} more than once: {remedy}")
    if len(episodes) != len(agents):
        raise InvalidArgument(f"episodes: expected one number, or {len(agents)}, one per agent, got {len(episodes)}")
    for number in episodes:
        check_episodes("episodes", number)
    expect_at_least("seed", seed, 0)
    if loop.patterns is not None and loop.patterns > len(culture.patterns):
        raise InvalidArgument(f"patterns: expected at most the culture's {len(culture.patterns)}, got {loop.patterns}")
    seeing = [agent.name for agent, n in zip(agents, episodes, strict=True) if any(map(agent.sees_neurons, range(n)))]
    if seeing and loop.remembering is None:
        why = f"for agents that see the history state ({', '.join(seeing)})"
        raise InvalidArgument(f"loop: expected `remembering` of a recording {why}, got none")
    loop.readouts.members(culture.channels)
    culture.limits.check_pulse(loop.pulse)
    if unknown := sorted({*loop.encoder.electrodes} - {*culture.stimulation_electrodes}):
        sites = some_of(culture.stimulation_electrodes)
        expected = f"electrodes that the {culture.name} culture can stimulate ({sites})"
        remedy = "run on the culture that was recorded, or train on recordings of this one"
        raise Mismatch(f"conditions: expected {expected}, got {some_of(unknown)}: {remedy}")
