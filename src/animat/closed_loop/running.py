"""Running a session: the loop in a thread of its own, and a supervisor that writes, watches, and ends it safely."""

from __future__ import annotations

import gc
import json
import os
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext, suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from animat.closed_loop.agents import Agent, InTurn, interleaved
from animat.closed_loop.driver import Driver
from animat.closed_loop.gathering import LOG_FILE, STOP_FILE
from animat.closed_loop.header import FORMAT, observed_columns, read_header
from animat.closed_loop.interrupts import told_instead
from animat.closed_loop.log import LogWriter, Record
from animat.closed_loop.loop import Loop
from animat.closed_loop.session import Session, expect_no_session
from animat.closed_loop.tick import Ending
from animat.closed_loop.timing import Clock, WallClock, ahead_of_other_programs, among_other_programs
from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.cultures.failures import describe_error
from animat.cultures.observed import more_left_out
from animat.cultures.safety import Guard
from animat.errors import AnimatError, InvalidArgument, Mismatch, shown, some_of
from animat.evaluation.statistics import Interval
from animat.progress import Progress, Silent
from animat.writing import UNCHANGED

MOST_EPISODES = 100_000
"""Of each agent in a session."""
_POLL_S = 0.02
_BATCH, _PAUSE_S = 4, 2.5e-4
"""Records written in a row, some 0.2 ms, and the pause after them: the loop's thread may have a deadline."""
_SWITCH_S = 2e-4
"""How long the loop's thread may keep the interpreter while the log is waiting for it; Python's own is 5 ms."""
_SYNC_S = 0.5
"""Between times that the log is put on the disk itself: with polling and writing, a power cut then costs under 1 s."""
_GRACE_S = 2.0
"""How long the loop's thread gets to come to its end once it was told to."""


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

    Whatever happens, every tick but those of the last 0.2 s before a SIGKILL is in `session.log`, with what was asked
    of the culture and not answered yet. Once this returns, or `recover_session` did its work, `session.nwb` is a
    recording like any other. Unless the plan was done or the budget spent, the culture is then stopped: it delivers
    nothing until it is closed and opened again. `ending` says what happened; nothing is raised for it, Ctrl-C and
    SIGTERM included. A file `STOP` in the folder ends the session before the next pulse. What `progress` raises is
    raised, once the culture is stopped and the log is written.

    Args:
        culture: open; it stays open.
        loop: the settings.
        agents: who acts.
        folder: for `session.log`, `session.nwb`, and `ticks.csv` with a line a tick.
        episodes: of each agent, or of each its own number.
        seed: decides every random draw, but what the culture does.
        account: of a stimulation budget; None: without end.
        clock: the machine's; None: its monotonic one.
        progress: told all the time how many episodes are done, and the returns so far.
        predicted: mean return that is expected of each agent, with its interval; kept in the log for whoever watches.

    Raises:
        InvalidArgument: for a culture that is closed or stopped, no agents, one that sees the history state in a loop
            that does not remember, a prediction of no agent, or a session or a file `STOP` that is in the folder
            already.
        Mismatch: for conditions on electrodes that the culture cannot stimulate, or readouts of ones that it does not
            read, or a folder of other work.
        InvalidFile: if a file is in the folder's place, or the log cannot be begun.
        UnsafeStimulus: for a pulse that the culture may not be given.
    """
    planned = [episodes] * len(agents) if isinstance(episodes, int) else list(episodes)
    check_session(culture, loop, agents, planned, seed)
    if strange := sorted({*(predicted or {})} - {agent.name for agent in agents}):
        raise InvalidArgument(f"predicted: expected names of agents, got {', '.join(strange)}")
    expect_no_session(folder)
    stop_file = Path(folder) / STOP_FILE
    if stop_file.exists():
        raise InvalidArgument(f"{stop_file}: expected none yet, as it ends a session: remove it first")
    account, progress = account or Account(), progress or Silent()
    turns = _after_their_sources(interleaved(planned, np.random.default_rng([seed, 20])), agents)
    driver = Driver(culture, loop, agents, turns, account, clock or WallClock(), seed, stop_file)
    file = Path(folder) / LOG_FILE
    # As whoever reads the log has it.
    header = json.loads(json.dumps(_header(culture, loop, agents, turns, account, seed, predicted or {})))
    read_header(file, header)
    with closing(LogWriter(file, header)) as log:
        ending = _Supervisor(culture, loop, driver, log, progress, len(turns)).run()
        session = Session(file.parent, log.written(), ending)
        try:
            session.write()
        except Exception as error:
            # What was measured comes back, whatever its files are like.
            told = error if isinstance(error, AnimatError) else f"its files cannot be made: {describe_error(error)}"
            told = str(told).removesuffix(UNCHANGED)
            message = f"{ending.message}; {told} (animat recover {folder} writes the files, once that is mended)"
            session = replace(session, ending=replace(ending, message=message))
    return session


class _Supervisor:
    def __init__(
        self,
        culture: Culture,
        loop: Loop,
        driver: Driver,
        log: LogWriter,
        progress: Progress,
        episodes: int,
    ) -> None:
        self._culture, self._loop, self._driver = culture, loop, driver
        self._log, self._progress, self._episodes = log, progress, episodes
        self._synced = time.monotonic()
        self._ending: Ending | None = None
        self._noted = self._seen = -1
        self._not_halted: str | None = None
        self._left_out = culture.left_out

    def run(self) -> Ending:
        """Start the loop and stay with it to its end."""
        thread = threading.Thread(target=self._drive, name="closed loop", daemon=True)
        with ExitStack() as stack:
            stack.enter_context(told_instead(self._stop_for_a_person))
            if gc.isenabled():
                # A collection can take 50 ms, and the loop makes no cycles.
                stack.callback(gc.enable)
                gc.disable()
            stack.callback(sys.setswitchinterval, sys.getswitchinterval())
            sys.setswitchinterval(_SWITCH_S)
            stack.enter_context(self._ahead(with_those_it_starts=True))
            thread.start()
            try:
                ending = self._watch(thread)
            except BaseException as error:
                # The caller's progress, or a fault of our own: a loop that nobody watches must not go on.
                is_person = isinstance(error, KeyboardInterrupt)
                told = "stopped by a person" if is_person else f"what watches the loop raised {describe_error(error)}"
                with suppress(Exception):
                    self._end_it(thread, Ending("person" if is_person else "crash", told))
                raise
            if ending is not None:
                return self._end_it(thread, ending)
            ending = self._ending or Ending("crash", "the loop's thread ended without a word")
            if ending.by not in ("plan", "budget"):
                self._halt(ending)
            return self._finish(ending)

    def _end_it(self, thread: threading.Thread, ending: Ending) -> Ending:
        """End a loop that did not end by itself: it is told to, and left alone if it does not."""
        self._driver.is_stopped = True
        self._halt(ending)
        thread.join(_GRACE_S)
        if thread.is_alive():
            among_other_programs(thread)
        self._halt(ending)
        return self._finish(ending)

    def _drive(self) -> None:
        # What the robot or an agent starts has no deadlines.
        with self._ahead(with_those_it_starts=False):
            self._ending = self._driver.run()

    def _ahead(self, *, with_those_it_starts: bool) -> AbstractContextManager[None]:
        """Ahead of other programs, if there are deadlines: what computes as fast as it can would leave them nothing."""
        if not self._loop.real_time and self._culture.device is None:
            return nullcontext()
        return ahead_of_other_programs(with_those_it_starts=with_those_it_starts)

    def _watch(self, thread: threading.Thread) -> Ending | None:
        """Write and watch while the loop runs; returns why it must be ended from outside, None if it ended."""
        driver = self._driver
        while thread.is_alive():
            thread.join(_POLL_S)
            try:
                self._write()
            except OSError as error:
                return Ending("disk", f"the log cannot be written: {error.strerror or error}")
            if thread.is_alive() and (stopped := driver.stopped_by_file()):
                # The loop sees it before its next trial; pulses of the one under way are not waited for.
                return stopped
            by_s, who = driver.expected
            if time.monotonic() > by_s and thread.is_alive():
                return Ending(
                    "hang", f"{who} did not answer {self._loop.patience_s:g} s after it should have: left alone"
                )
            self._progress.update(driver.standing.episodes, self._episodes, driver.standing.note())
        return None

    def _write(self) -> None:
        records = self._driver.records
        # No more than are there now: a loop that is as fast as the log must not keep this thread from watching it.
        for number in range(len(records)):
            self._log.append(records[0])
            # Taken away only once it is written: a full disk loses none that could be written later.
            written = records.popleft().words
            self._seen = written["stretch"] if written["kind"] == "seen" else self._seen
            if number % _BATCH == _BATCH - 1:
                # A pause of 0 would keep the processor, and on one core the loop's thread could not go on.
                time.sleep(_PAUSE_S)
        asked = self._driver.under_way
        if asked is not None and asked.stretch > self._noted:
            # If the answer never comes, or the program is killed meanwhile, it is known what was asked for.
            self._log.append(Record({"kind": "asked", **asked.to_dict()}))
            self._noted = asked.stretch
        if time.monotonic() - self._synced > _SYNC_S:
            self._log.sync()
            self._synced = time.monotonic()

    def _finish(self, ending: Ending) -> Ending:
        """Write what is left, and how it ended."""
        if self._not_halted is not None:
            message = f"{ending.message}; BUT {self._not_halted}: see to it that the device gives no more pulses"
            ending = replace(ending, message=message)
        try:
            # Looked at first: a robot that comes back just now has its tick among those that are written.
            unfinished = self._driver.unfinished
            self._write()
            if unfinished is not None and unfinished.words["stretch"] > self._seen:
                self._log.append(unfinished)
            left_out = more_left_out(self._left_out, self._culture.left_out)
            words = {"kind": "end", "by": ending.by, "message": ending.message, "left_out": left_out}
            self._log.append(Record(words))
            self._log.sync()
        except OSError as error:
            left, why = len(self._driver.records), error.strerror or str(error)
            lost = {0: "how it ended", 1: "the last tick"}.get(left, f"the last {left} ticks")
            message = f"{ending.message}; {lost} could not be written and {'are' if left > 1 else 'is'} lost"
            message += "" if why in ending.message else f" ({why})"
            return Ending("disk" if ending.by in ("plan", "budget") else ending.by, message)
        return ending

    def _stop_for_a_person(self) -> None:
        self._driver.is_stopped = True
        self._halt(Ending("person", "stopped by a person (Ctrl-C, or a polite kill)"))

    def _halt(self, ending: Ending) -> None:
        """Stop the culture, from a thread of its own: a backend that hangs must not hang the end as well."""
        self._not_halted = f"the culture did not say within {_GRACE_S:g} s that it is stopped"
        halting = threading.Thread(target=self._halt_now, args=(ending.message,), daemon=True)
        halting.start()
        halting.join(_GRACE_S)

    def _halt_now(self, reason: str) -> None:
        # The guard refuses every stimulus from here on, whatever the backend does about those under way.
        try:
            self._culture.stop(reason)
        except Exception as error:
            self._not_halted = f"the culture could not be stopped ({describe_error(error)})"
        else:
            self._not_halted = None


def _header(
    culture: Culture,
    loop: Loop,
    agents: Sequence[Agent],
    turns: Sequence[int],
    account: Account,
    seed: int,
    predicted: Mapping[str, Interval],
) -> dict[str, Any]:
    channels = culture.channels
    told = {name: {"mean": of.value, "low": of.low, "high": of.high} for name, of in predicted.items()}
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
        # What was spent of it before the session.
        "account": account.to_dict(),
        "loop": loop.to_dict(),
        "observed": observed_columns(loop.robot),
        "agents": [_told(agent) for agent in agents],
        "turns": [agents[turn].name for turn in turns],
        "seed": seed,
        **({"predicted": told} if told else {}),
    }


def _after_their_sources(turns: list[int], agents: Sequence[Agent]) -> list[int]:
    """The same turns with no yoked episode before the first one that it could repeat: the two change places."""
    turns = list(turns)
    for number, agent in enumerate(agents):
        if agent.delivery != "yoked" or number not in turns:
            continue
        assert isinstance(agent.controller, InTurn)
        sources = [i for i, turn in enumerate(turns) if agents[turn].name in agent.controller.by_name]
        if not sources:
            raise InvalidArgument(f"agents: expected episodes that {agent.name!r} could repeat, got none")
        if (first := turns.index(number)) < sources[0]:
            turns[first], turns[sources[0]] = turns[sources[0]], turns[first]
    return turns


def _told(agent: Agent) -> dict[str, Any]:
    told = {"name": agent.name, "meaning": agent.meaning, "delivery": agent.delivery}
    more = {
        # Episode after episode of this agent, over and over.
        "in_turn": list(agent.controller.by_name) if isinstance(agent.controller, InTurn) else [],
        "is_drawn": agent.drawn_from is not None,
        "is_turned_round": agent.is_turned_round,
        "switch_at": agent.switch_at,
    }
    return told | {name: value for name, value in more.items() if value}


def check_episodes(name: str, episodes: int) -> None:
    """Refuse episodes that are none, or more than a session can plan: whose turn each is is drawn before the first.

    Raises:
        InvalidArgument: by the name of the argument or option.
    """
    if not 1 <= episodes <= MOST_EPISODES:
        expected = "at least 1" if episodes < 1 else f"at most {MOST_EPISODES:,}"
        raise InvalidArgument(f"{name}: expected {expected}, got {shown(episodes)}")


def check_session(culture: Culture, loop: Loop, agents: Sequence[Agent], episodes: Sequence[int], seed: int) -> None:
    """Refuse what `run_session` would, of culture, loop and agents, before anything else is done."""
    if not culture.is_open or culture.is_stopped:
        state = "stopped" if culture.is_open else "closed"
        raise InvalidArgument(f"culture: expected an open one that may stimulate, got one that is {state}")
    if not agents or len({agent.name for agent in agents}) < len(agents):
        raise InvalidArgument("agents: expected at least one, each name once")
    if len(episodes) != len(agents):
        raise InvalidArgument(
            f"episodes: expected one number, or one for each of {len(agents)} agents, got {len(episodes)}"
        )
    for each in episodes:
        check_episodes("episodes", each)
    if seed < 0:
        raise InvalidArgument(f"seed: expected 0 or more, got {seed}")
    if loop.patterns is not None and loop.patterns > len(culture.patterns):
        raise InvalidArgument(f"patterns: expected at most the culture's {len(culture.patterns)}, got {loop.patterns}")
    seeing = [agent.name for agent, n in zip(agents, episodes, strict=True) if any(map(agent.sees_neurons, range(n)))]
    if seeing and loop.remembering is None:
        raise InvalidArgument(
            f"loop: expected `remembering` of a recording for agents that see the history state ({', '.join(seeing)}), "
            "got none"
        )
    loop.readouts.members(culture.channels)
    Guard(culture.limits, ()).check_pulse(loop.pulse)
    if strange := sorted({*loop.encoder.electrodes} - {*culture.stimulation_electrodes}):
        raise Mismatch(
            f"conditions: expected electrodes that the {culture.name} culture can stimulate "
            f"({some_of(culture.stimulation_electrodes)}), got {some_of(strange)}: run on the culture that was "
            "recorded, or train on recordings of this one"
        )
