"""Whatever goes wrong: no further pulse, every earlier tick on disk, and a file that can be read."""

from __future__ import annotations

import asyncio
import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cli import main
from animat.closed_loop.agents import Agent, OneCondition
from animat.closed_loop.log import LogRecord, LogWriter, read_log
from animat.closed_loop.running import run_session
from animat.closed_loop.session import LOG_FILE, Session, read_session, recover_session
from animat.closed_loop.stretch import check_answer
from animat.cultures import base
from animat.cultures.budget import Account, Budget
from animat.cultures.observed import Observed, Spikes
from animat.cultures.safety import SIMULATED_LIMITS
from animat.errors import InvalidArgument, InvalidFile, UnsafeStimulus, UnusableData
from animat.recordings.reading import read_recording
from animat.responses.condition import RESTING, Condition
from animat.robots import Navigation
from animat.stimulation.pulse import BALANCED_PULSE
from animat.stimulation.stimulus import Stimulus
from fake_culture import FakeCulture, Fault
from test_closed_loop import CONDITIONS, RANDOM, assert_read_alike, loop_of

LONG = Navigation(episode_limit=100_000, stride_m=1e-9)


def run(folder: Path, culture: FakeCulture, **changed: Any) -> Session:
    return run_session(culture, loop_of(**({"robot": Navigation(episode_limit=20)} | changed)), [RANDOM], folder)


def assert_safe(session: Session, culture: FakeCulture, at_least: int) -> None:
    """Stopped, no pulse after that, and on disk what was done: as a log and as a recording."""
    assert culture.is_stopped
    assert culture.halted
    assert culture.after_halt == 0
    with pytest.raises(UnsafeStimulus, match="stop"):
        culture.stimulate(culture.stimulation_electrodes[:1], session_pulse())
    again = read_session(session.folder)
    ticks = list(again.ticks)
    assert ticks == list(session.ticks)
    assert len(ticks) >= at_least
    assert [tick.number for tick in ticks] == list(range(len(ticks)))
    assert_read_alike(session.folder, loop_of())


def session_pulse() -> Any:
    from animat.stimulation.pulse import PUBLISHED_PULSE

    return PUBLISHED_PULSE


def raising(error: Exception) -> Fault:
    def fault(culture: FakeCulture, observed: Observed) -> Observed:
        raise error

    return fault


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            RuntimeError("the amplifier is on fire"),
            "the culture raised DeviceFailed: fake: expected it to deliver, got RuntimeError: the amplifier is on fire",
        ),
        (
            ConnectionResetError("gone"),
            "the connection to the culture is lost: DeviceFailed: fake: expected it to deliver, got "
            "ConnectionResetError: gone",
        ),
        pytest.param(OSError("no route to host"), "the connection to the culture is lost", marks=pytest.mark.oracle),
        # As the CL1's SDK says that its loop was late.
        (TimeoutError("no answer"), "the culture raised DeviceFailed: fake: expected it to deliver, got TimeoutError"),
        pytest.param(
            KeyError("window"),
            "the culture raised DeviceFailed: fake: expected it to deliver, got KeyError",
            marks=pytest.mark.oracle,
        ),
    ],
)
def test_a_backend_that_raises_or_loses_its_connection(tmp_path: Path, error: Exception, words: str) -> None:
    with FakeCulture(fault=raising(error), at=8) as culture:
        session = run(tmp_path, culture)
        assert session.ending.by == "culture"
        assert words in session.ending.message
        assert_safe(session, culture, 7)
        ticks = list(session.ticks)
        assert len(ticks) == 7
    # What was asked is in the log and in the account, as nobody knows whether it came.
    (asked,) = session.outline.unanswered
    assert len(asked["asked_for_s"]) == len(asked["stimuli"]) == 1
    assert asked["stimuli"][0][3] in [[100 + i, 100 + (i + 1) % 8] for i in range(8)]
    assert asked["asked_at_s"] == pytest.approx(ticks[-1].read_after_s + 0.0101, abs=1e-3)
    assert session.to_dict()["unanswered_pulses"] == 1
    assert session.recording().provenance["closed_loop_unanswered_pulses"] == "1"
    assert read_session(tmp_path).ending == session.ending


def garbled(**changed: Any) -> Fault:
    def fault(culture: FakeCulture, observed: Observed) -> Observed:
        return replace(observed, **{name: change(observed) for name, change in changed.items()})

    return fault


def spikes(change: Callable[[Any, Any], tuple[Any, Any]]) -> Callable[[Observed], Spikes]:
    return lambda observed: Spikes(*change(observed.spikes.time_s, observed.spikes.channel))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (garbled(spikes=spikes(lambda t, c: (t[:-1], c))), "spike times for"),
        (garbled(spikes=spikes(lambda t, c: (t, c + 1000))), "channel 10"),
        pytest.param(garbled(spikes=spikes(lambda t, c: (t, c - 1000))), "channel -", marks=pytest.mark.oracle),
        (garbled(spikes=spikes(lambda t, c: (np.where(t > 0.01, np.nan, t), c))), "spike times"),
        (garbled(spikes=spikes(lambda t, c: (t[::-1], c))), "that do not rise"),
        (garbled(spikes=spikes(lambda t, c: (t + 100.0, c))), "outside of the"),
        (garbled(spikes=spikes(lambda t, c: (t, c.astype(float)))), "not whole numbers"),
        pytest.param(garbled(spikes=spikes(lambda t, c: (None, None))), "cannot be read", marks=pytest.mark.oracle),
        pytest.param(garbled(spikes=lambda o: 7), "cannot be read", marks=pytest.mark.oracle),
        (garbled(stimulus_time_s=lambda o: np.empty(0)), "0,) stimulus times for 1"),
        pytest.param(garbled(stimulus_time_s=lambda o: np.array([np.nan])), "stimulus times", marks=pytest.mark.oracle),
        (garbled(stimulus_time_s=lambda o: o.stimulus_time_s - 0.002), "2 ms before its requested time"),
        (garbled(duration_s=lambda o: 0.001), "returned 0.001 s"),
        pytest.param(garbled(duration_s=lambda o: float("nan")), "returned nan s", marks=pytest.mark.oracle),
        (garbled(start_s=lambda o: o.start_s - 0.002), "went back"),
        (lambda culture, observed: None, "cannot be read"),
    ],
)
def test_a_backend_that_answers_garbage(tmp_path: Path, fault: Fault, words: str) -> None:
    with FakeCulture(fault=fault, at=8) as culture:
        session = run(tmp_path, culture)
        assert session.ending.by == "culture"
        assert words in session.ending.message
        assert_safe(session, culture, 7)
    assert session.to_dict()["unanswered_pulses"] == 1


RIGHT = Observed(5.0, 0.02, Spikes(np.array([0.0, 0.01, 0.02]), np.array([0, 7, 15])), np.array([0.001]))
"""A possible answer of 16 channels, at 20 kHz, to a pulse after 1 ms of the 20 ms from 5 s on."""


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, None),
        # Rounded to samples, times may be off by a sample and a half; counted from a later start they are earlier.
        ({"start_s": 5.0 - 7e-5, "duration_s": 0.0201}, None),
        ({"start_s": 5.0 - 8e-5, "duration_s": 0.0201}, "went back to 4.99992 s"),
        ({"stimulus_time_s": np.array([0.001 - 7e-5])}, None),
        ({"stimulus_time_s": np.array([0.001 - 8e-5])}, "a stimulus 0.08 ms before"),
        ({"start_s": 5.0005, "stimulus_time_s": np.array([0.0005])}, None),
        # A window after a late stimulus must not be cut off.
        ({"stimulus_time_s": np.array([0.006]), "duration_s": 0.0241}, None),
        ({"stimulus_time_s": np.array([0.006]), "duration_s": 0.0239}, "a stimulus 5 ms late, but observed no longer"),
        ({"start_s": 5.0005, "stimulus_time_s": np.array([0.0004])}, "a stimulus 0.1 ms before"),
        ({"duration_s": 0.02 - 5e-7, "spikes": Spikes(np.empty(0), np.empty(0, int))}, None),
        ({"duration_s": 0.02 - 2e-6, "spikes": Spikes(np.empty(0), np.empty(0, int))}, "where 0.02 s from 5.0 s were"),
        ({"start_s": np.inf}, "returned 0.02 s from inf s"),
        ({"duration_s": np.inf}, "returned inf s from 5.0 s"),
        ({"spikes": Spikes(np.array([-2e-9]), np.array([0]))}, "spike times outside of the 0.02 s"),
        ({"spikes": Spikes(np.array([0.02 + 2e-9]), np.array([0]))}, "spike times outside of the 0.02 s"),
        ({"spikes": Spikes(np.array([0.01, 0.01]), np.array([15, 0]))}, None),
        ({"spikes": Spikes(np.array([0.0, 0.015, 0.01]), np.array([0, 1, 2]))}, "spike times that do not rise"),
        ({"spikes": Spikes(np.array([0.01]), np.array([16]))}, "channel 16 of 16"),
        ({"spikes": Spikes(np.array([0.01]), np.array([-1]))}, "channel -1 of 16"),
        ({"spikes": Spikes(np.array([0.01]), np.array([1], np.uint8))}, None),
    ],
)
def test_an_answer_is_possible_to_within_rounding_and_no_further(changed: dict[str, Any], words: str | None) -> None:
    asked = {"requested_s": np.array([0.001]), "duration_s": 0.02, "since_s": 5.0, "from_s": 5.0}
    fault = check_answer(replace(RIGHT, **changed), **asked, sample_s=5e-5, n_channels=16)  # type: ignore[arg-type]
    assert fault is None if words is None else words in str(fault)


class Gone(FakeCulture):
    """Its clock answers so many times, then fails as requested."""

    def __init__(self, then: Callable[[], Any], left: int = 60) -> None:
        super().__init__()
        self.then, self.left = then, left

    @property
    def now_s(self) -> float:
        self.left -= 1
        if self.left == 0:
            self.then()
        return self._now_s


def test_a_connection_that_is_lost_between_two_stimuli(tmp_path: Path) -> None:
    def lose() -> None:
        raise ConnectionResetError("gone")

    # The clock is asked between deliveries, and in them: both are the culture's fault and not the loop's.
    for left in range(40, 46):
        with Gone(lose, left) as culture:
            session = run(tmp_path / str(left), culture)
            assert session.ending.by == "culture"
            assert "the connection to the culture is lost" in session.ending.message
            assert_safe(session, culture, 3)


@pytest.mark.parametrize("at", [0, 1, 8])
def test_a_file_ends_the_session_before_the_next_pulse(tmp_path: Path, at: int) -> None:
    pulses: list[int] = []

    def asking(culture: FakeCulture, observed: Observed) -> Observed:
        pulses.append(culture.pulses)
        (tmp_path / "STOP").touch()
        return observed

    with FakeCulture(fault=asking, at=at) as culture:
        session = run(tmp_path, culture, robot=LONG)
        # Those of the delivery under way had been given when the file was made.
        assert pulses == [culture.pulses]
        assert session.ending.by == "person"
        assert session.ending.message == "stopped by a person (the file STOP)"
        assert read_session(tmp_path).ending == session.ending
        assert culture.is_stopped and culture.halted and culture.after_halt == 0


def test_a_file_ends_a_session_whose_culture_is_still_answering(tmp_path: Path, little_grace: None) -> None:
    released = threading.Event()

    def answering(culture: FakeCulture, observed: Observed) -> Observed:
        (tmp_path / "STOP").touch()
        released.wait(60)
        return observed

    with FakeCulture(fault=answering, at=8) as culture:
        try:
            session = run(tmp_path, culture, robot=LONG)
            assert session.ending.by == "person"
            assert_safe(session, culture, 7)
            # Not again while it is waited for.
            assert [each.fields["kind"] for each in session.log][-3:].count("asked") == 1
        finally:
            released.set()


@pytest.mark.parametrize("takes_s", [0.0, 0.2])
def test_a_folder_that_can_no_longer_be_read_ends_the_session(
    takes_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a network disk that is gone: whether the loop or its supervisor notices first."""
    stat, gone = Path.stat, threading.Event()

    def fails(path: Path, **how: Any) -> os.stat_result:
        if gone.is_set() and path.name == "STOP":
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
        return stat(path, **how)

    def answering(culture: FakeCulture, observed: Observed) -> Observed:
        gone.set()
        time.sleep(takes_s)
        return observed

    monkeypatch.setattr(Path, "stat", fails)
    with FakeCulture(fault=answering, at=8) as culture:
        session = run(tmp_path, culture, robot=LONG)
        assert session.ending.by == "disk"
        assert session.ending.message == f"{tmp_path / 'STOP'} cannot be looked for: {os.strerror(errno.ESTALE)}"
        assert_safe(session, culture, 7)


def test_a_file_of_before_is_refused_and_no_pulse_is_given(tmp_path: Path) -> None:
    (tmp_path / "STOP").touch()
    with FakeCulture() as culture, pytest.raises(InvalidArgument, match="STOP: expected none yet"):
        run(tmp_path, culture)
    assert culture.deliveries == 0
    assert [file.name for file in tmp_path.iterdir()] == ["STOP"]


@pytest.fixture
def little_grace(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who hangs is not waited for as long as usual."""
    monkeypatch.setattr("animat.closed_loop.running._GRACE_S", 0.2)


@pytest.mark.oracle
@pytest.mark.parametrize("left", [40, 41, 42, 43])
def test_a_clock_that_hangs(tmp_path: Path, left: int, little_grace: None) -> None:
    released = threading.Event()
    with Gone(lambda: released.wait(60), left) as culture:
        try:
            session = run(tmp_path, culture, patience_s=0.3)
            assert session.ending.by == "hang"
            assert "the culture did not answer 0.3 s after" in session.ending.message
            assert_safe(session, culture, 3)
        finally:
            released.set()


@pytest.mark.oracle
def test_what_takes_longer_than_the_patience_is_waited_for_if_it_was_asked_for(tmp_path: Path) -> None:
    """The patience counts from when the pause should be over, not from its beginning."""

    def in_real_time(culture: FakeCulture, observed: Observed) -> Observed:
        time.sleep(observed.duration_s)
        return observed

    # Its first delivery is the pause.
    with FakeCulture(fault=in_real_time, at=0) as culture:
        session = run(tmp_path, culture, pause_s=0.6, warm_up=1, patience_s=0.3)
    assert session.ending.by == "plan", session.ending


@pytest.mark.oracle
@pytest.mark.usefixtures("in_the_foreground")
@pytest.mark.parametrize("is_interrupted", [False, True])
def test_a_policy_that_hangs(tmp_path: Path, is_interrupted: bool, little_grace: None) -> None:
    released, acted = threading.Event(), [0]

    class Pondering:
        def act(self, observation: Any, rng: np.random.Generator) -> int:
            acted[0] += 1
            if acted[0] == 8:
                if is_interrupted:
                    os.kill(os.getpid(), signal.SIGINT)
                released.wait(60)
            return 0

    with FakeCulture() as culture:
        try:
            agent = Agent("it", "", Pondering())
            session = run_session(culture, loop_of(robot=LONG, patience_s=0.3), [agent], tmp_path, episodes=1)
            assert session.ending.by == "hang"
            assert "it did not answer 0.3 s after it should have" in session.ending.message
            assert_safe(session, culture, 7)
            pulses = culture.pulses
        finally:
            released.set()
        thread = next((t for t in threading.enumerate() if t.name == "closed loop"), None)
        if thread is not None:
            thread.join(10)
        assert culture.pulses == pulses


@pytest.mark.usefixtures("in_the_foreground")
def test_ctrl_c_is_not_held_up_by_the_patience_with_an_agent(
    tmp_path: Path, little_grace: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.closed_loop.running._UNANSWERED_S", 0.1)
    released = threading.Event()

    class Hangs:
        def act(self, observation: Any, rng: np.random.Generator) -> int:
            os.kill(os.getpid(), signal.SIGINT)
            released.wait(60)
            return 0

    with FakeCulture() as culture:
        try:
            session = run_session(culture, loop_of(robot=LONG, patience_s=50.0), [Agent("it", "", Hangs())], tmp_path)
        finally:
            released.set()
    assert (session.ending.by, session.ending.message) == ("person", "stopped by a person (Ctrl-C or kill)")


@pytest.mark.oracle
@pytest.mark.usefixtures("in_the_foreground")
def test_what_a_culture_answers_after_ctrl_c_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.closed_loop.running._UNANSWERED_S", 0.05)

    def slow(culture: FakeCulture, observed: Observed) -> Observed:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.5)
        return observed

    with FakeCulture(fault=slow, at=6) as culture:
        session = run(tmp_path, culture)
    assert session.ending.by == "person" and session.to_dict()["unanswered_pulses"] == 0


@pytest.mark.parametrize("error", [KeyboardInterrupt(), GeneratorExit(), asyncio.CancelledError()])
def test_whatever_an_agent_raises_ends_the_session(tmp_path: Path, error: BaseException) -> None:
    class Raises:
        def act(self, observation: Any, rng: np.random.Generator) -> int:
            raise error

    with FakeCulture() as culture:
        session = run_session(culture, loop_of(robot=LONG), [Agent("it", "", Raises())], tmp_path)
    assert session.ending.by == "controller"
    assert session.ending.message.startswith(f"it raised {type(error).__name__}")


@pytest.mark.parametrize("how", ["takes a while", "raises", "hangs"])
def test_a_culture_that_cannot_stop_is_reported(tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()
    monkeypatch.setattr("animat.closed_loop.running._GRACE_S", 0.2)

    class Unstoppable(FakeCulture):
        def _halt(self) -> None:
            if how == "raises":
                raise ConnectionResetError("gone")
            released.wait(0.02 if how == "takes a while" else 60)

    with Unstoppable(fault=raising(RuntimeError("smoke")), at=8) as culture:
        try:
            session = run(tmp_path, culture)
        finally:
            released.set()
        if how == "takes a while":
            assert session.ending.message.endswith("got RuntimeError: smoke")
        else:
            assert "got RuntimeError: smoke; BUT the culture" in session.ending.message
            assert "make sure that the device delivers no more pulses" in session.ending.message
        # Whatever the device does: nothing passes the guard.
        with pytest.raises(UnsafeStimulus, match="stop"):
            culture.stimulate(culture.stimulation_electrodes[:1], session_pulse())
    assert read_session(tmp_path).ending == session.ending


def test_a_later_pulse_of_a_presentation_that_comes_late_is_late(tmp_path: Path) -> None:
    def third(culture: FakeCulture, observed: Observed) -> Observed:
        times_s = observed.stimulus_time_s.copy()
        times_s[2:] += 0.007
        culture._now_s += 0.007
        return replace(observed, stimulus_time_s=times_s, duration_s=observed.duration_s + 0.007)

    with FakeCulture(fault=third, at=8) as culture:
        session = run(tmp_path, culture, pulses=4)
    late = {tick.number: tick.late_s for tick in session.ticks if tick.late_s > 0}
    assert late == {7: pytest.approx(0.007, abs=1e-4)}
    assert session.to_dict()["late_pulses"] == 1
    assert session.to_dict()["latest_ms"] == pytest.approx(7.0, abs=0.1)


def test_a_backend_that_hangs(tmp_path: Path, little_grace: None) -> None:
    released = threading.Event()

    def hang(culture: FakeCulture, observed: Observed) -> Observed:
        released.wait(60)
        return observed

    with FakeCulture(fault=hang, at=8) as culture:
        try:
            session = run(tmp_path, culture, patience_s=0.3)
            assert session.ending.by == "hang"
            assert "the culture did not answer 0.3 s after it should have" in session.ending.message
            assert session.to_dict()["unanswered_pulses"] == 1
            assert_safe(session, culture, 7)
            pulses = culture.pulses
        finally:
            released.set()
        thread = next((t for t in threading.enumerate() if t.name == "closed loop"), None)
        if thread is not None:
            thread.join(10)
        # It woke up, and could do nothing more: neither to the culture nor to the log.
        assert culture.pulses == pulses
        assert list(read_session(tmp_path).ticks) == list(session.ticks)


class FakeClock:
    """A clock that moves when a sleeper waits for it, or when it is moved."""

    def __init__(self) -> None:
        self.time_s = 100.0

    def now_s(self) -> float:
        return self.time_s

    def sleep_until(self, time_s: float) -> None:
        self.time_s = max(self.time_s, time_s)


def late_by(clock: FakeClock) -> Callable[[FakeCulture, Observed], Observed]:
    """A fault: the answer comes a quarter of a second late."""

    def late(culture: FakeCulture, observed: Observed) -> Observed:
        clock.time_s += observed.duration_s + 0.25
        return observed

    return late


@pytest.mark.parametrize("on_late", ["continue", "stop"])
def test_a_backend_that_answers_late(tmp_path: Path, on_late: str) -> None:
    clock = FakeClock()

    loop = loop_of(robot=Navigation(episode_limit=20), real_time=True, on_late=on_late)
    with FakeCulture(fault=late_by(clock), at=8) as culture:
        session = run_session(culture, loop, [RANDOM], tmp_path, episodes=1, clock=clock)
        was_late = [tick.number for tick in session.ticks if tick.late_s > 0]
        # Delivery 0 is the pause: number 8 is tick 7, and tick 8 is the one that comes late.
        assert was_late == [8]
        tick = list(session.ticks)[8]
        window_s = 0.010 + 2 / 20_000
        assert tick.late_s == pytest.approx(0.25 - (1 / tick.frequency_hz - window_s), abs=1e-4)
        if on_late == "stop":
            assert session.ending.by == "lateness"
            assert f"{1000 * tick.late_s:.3g} ms late" in session.ending.message
            assert_safe(session, culture, 9)
            assert list(session.ticks)[-1].handled == "unfinished"
        else:
            assert session.ending.by == "plan"
            assert session.episodes[0].late == 1
            assert clock.time_s == pytest.approx(100.0 + culture.now_s - 12.0, abs=1e-6)
            assert_read_alike(tmp_path, loop)


@pytest.mark.parametrize("how", ["silent", "resting"])
def test_where_nothing_is_delivered_no_pulse_is_late(tmp_path: Path, how: str) -> None:
    clock = FakeClock()

    rest = Condition("no electrode", 0.0, frequencies_hz=(20.0,), electrodes=RESTING)
    conditions = {"silent": CONDITIONS, "resting": (rest,)}[how]
    agent = Agent("one", "", OneCondition(0), "silent" if how == "silent" else "chosen")
    loop = loop_of(conditions=conditions, real_time=True, on_late="stop")
    with FakeCulture(fault=late_by(clock), at=3) as culture:
        session = run_session(culture, loop, [agent], tmp_path, episodes=1, clock=clock)
    assert session.ending.by == "plan", session.ending
    assert session.outline.late == 0 and culture.pulses == 0


class Broken:
    """A body that comes to an end in its seventh step."""

    def __init__(self, how: str) -> None:
        self.how, self.steps = how, 0

    def __call__(self, step: Callable[[float], Any]) -> Callable[[float], Any]:
        def broken(u: float) -> Any:
            self.steps += 1
            moved = step(u)
            if self.steps < 7:
                return moved
            if self.how == "raises":
                raise ZeroDivisionError("the wheel came off")
            ends = {"truncated": True, "terminated": self.how == "falls"}
            return moved._replace(**({"reward": float("nan")} if self.how == "nan" else ends))

        return broken


def break_robot(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from animat.closed_loop import runner

    broken = Broken(how)

    class BrokenRunner(runner.RobotRunner):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            self.step = broken(self.step)  # type: ignore[method-assign]

    monkeypatch.setattr(runner, "RobotRunner", BrokenRunner)


@pytest.mark.parametrize("how", ["stops", "falls"])
def test_a_robot_that_cuts_its_episode_off_or_falls_ends_it_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    break_robot(how, monkeypatch)
    with FakeCulture() as culture:
        session = run(tmp_path, culture)
        assert session.ending.by == "plan"
        assert culture.pulses == 11
    # It does so in its seventh step and in every later one.
    assert [episode.iterations for episode in session.episodes] == [7, 1, 1, 1, 1]
    assert all(episode.is_whole and episode.terminated == (how == "falls") for episode in session.episodes)
    # Who falls is not cut off as well.
    ends = [(tick.terminated, tick.truncated) for tick in session.ticks]
    assert ends == [(False, False)] * 6 + [(how == "falls", how == "stops")] * 5


@pytest.mark.parametrize(("how", "words"), [("raises", "the wheel came off"), ("nan", "with reward nan")])
def test_a_robot_that_fails(tmp_path: Path, how: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    break_robot(how, monkeypatch)
    with FakeCulture() as culture:
        session = run(tmp_path, culture)
        assert session.ending.by == "robot"
        assert words in session.ending.message
        assert_safe(session, culture, 7)
    assert [tick.handled for tick in session.ticks] == ["used"] * 6 + ["unfinished"]
    assert not session.episodes[0].is_whole


@pytest.mark.oracle
@pytest.mark.parametrize("answers_at_last", [False, True])
def test_a_robot_that_hangs_leaves_the_response_it_did_not_move_by(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answers_at_last: bool
) -> None:
    from animat.closed_loop import runner, running

    released, steps, write = threading.Event(), [0], running._Supervisor._write

    def write_after_the_answer(supervisor: Any) -> None:
        """It comes just after the response without it was taken down to be written."""
        if answers_at_last and supervisor._driver.is_stopped:
            released.set()
            next(thread for thread in threading.enumerate() if thread.name == "closed loop").join(10)
        write(supervisor)

    class StuckRunner(runner.RobotRunner):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            step = self.step

            def stuck(u: float) -> Any:
                steps[0] += 1
                if steps[0] == 7:
                    released.wait(60)
                return step(u)

            self.step = stuck  # type: ignore[method-assign]

    monkeypatch.setattr(runner, "RobotRunner", StuckRunner)
    monkeypatch.setattr(running._Supervisor, "_write", write_after_the_answer)
    monkeypatch.setattr(running, "_GRACE_S", 0.2)
    with FakeCulture() as culture:
        try:
            session = run(tmp_path, culture, patience_s=0.3)
            assert session.ending.by == "hang"
            assert "the robot did not answer 0.3 s after it should have" in session.ending.message
            assert_safe(session, culture, 7)
        finally:
            released.set()
        assert culture.pulses == session.to_dict()["pulses"] == 7
    assert [tick.handled for tick in session.ticks] == ["used"] * 6 + ["used" if answers_at_last else "unfinished"]
    assert session.to_dict()["unanswered_pulses"] == 0


def test_a_controller_that_exits_is_named(tmp_path: Path) -> None:
    class Exits:
        def act(self, observation: Any, rng: np.random.Generator) -> Any:
            raise SystemExit(3)

    with FakeCulture() as culture:
        session = run_session(culture, loop_of(robot=LONG), [Agent("it", "", Exits())], tmp_path, episodes=1)
        assert (session.ending.by, session.ending.message) == ("controller", "it raised SystemExit: 3")
        assert_safe(session, culture, 0)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (None, "raised TypeError"),
        (1.0, "raised TypeError"),
        (True, "raised TypeError: expected the index of a condition, got True"),
        (5, "chose 5"),
        (-1, "chose -1"),
    ],
)
def test_a_controller_that_fails(tmp_path: Path, action: Any, words: str) -> None:
    class Confused:
        def act(self, observation: Any, rng: np.random.Generator) -> Any:
            return action if rng.random() < 0.2 else 0

    with FakeCulture() as culture:
        session = run_session(culture, loop_of(robot=LONG), [Agent("it", "", Confused())], tmp_path, episodes=1)
        assert session.ending.by == "controller"
        assert f"it {words}" in session.ending.message
        assert_safe(session, culture, 0)


@pytest.mark.parametrize(
    ("controller", "delivery", "words"),
    [
        (OneCondition(0), "shufled", "it: delivery: expected one of chosen, shuffled, silent, yoked, got 'shufled'"),
        (object(), "chosen", "it: controller: expected a method `act`, got <object"),
        ({"p0": OneCondition(0), "p1": 3}, "silent", "it: controller: expected a method `act`, got 3"),
    ],
)
def test_an_agent_that_cannot_act_is_refused_before_a_culture_is_touched(
    controller: Any, delivery: Any, words: str
) -> None:
    with pytest.raises(InvalidArgument, match=re.escape(words)):
        Agent("it", "", controller, delivery)


def pressing(number: signal.Signals) -> Fault:
    def press(culture: FakeCulture, observed: Observed) -> Observed:
        os.kill(os.getpid(), number)
        time.sleep(0.3)
        return observed

    return press


@pytest.mark.oracle
@pytest.mark.usefixtures("in_the_foreground")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_was_ignored_when_it_started_does_not_end_a_session(tmp_path: Path, number: signal.Signals) -> None:
    signal.signal(number, signal.SIG_IGN)
    with FakeCulture(fault=pressing(number), at=8) as culture:
        session = run(tmp_path, culture)
    assert session.ending.by == "plan"
    assert signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.usefixtures("in_the_foreground")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_a_polite_kill_and_a_terminal_that_is_gone(tmp_path: Path, number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with FakeCulture(fault=pressing(number), at=8) as culture:
        session = run(tmp_path, culture)
        assert session.ending.by == "person"
        assert_safe(session, culture, 7)
        assert culture.deliveries <= 10
    assert signal.getsignal(number) is before


@pytest.mark.parametrize(
    ("error", "by"), [(RuntimeError("the terminal is gone"), "crash"), (KeyboardInterrupt(), "person")]
)
def test_a_progress_that_fails_leaves_no_loop_behind(tmp_path: Path, error: BaseException, by: str) -> None:
    def slowly(culture: FakeCulture, observed: Observed) -> Observed:
        culture._at += 1
        time.sleep(0.002)
        return observed

    class Failing:
        """A progress that fails once the loop is under way."""

        def update(self, done: float, total: float, note: str = "") -> None:
            if culture.pulses > 8:
                raise error

    with FakeCulture(fault=slowly, at=0) as culture:
        with pytest.raises(type(error)):
            run_session(culture, loop_of(robot=LONG), [RANDOM], tmp_path, progress=Failing())
        assert not any(thread.name == "closed loop" for thread in threading.enumerate())
        session = recover_session(tmp_path)
        assert session.ending.by == by
        assert str(error) in session.ending.message
        assert_safe(session, culture, 8)


@pytest.mark.parametrize("kind", ["pulses", "electrode", "session", "charge"])
def test_the_budget_runs_out(tmp_path: Path, kind: str) -> None:
    limits = replace(SIMULATED_LIMITS, stimuli_per_session=30) if kind == "session" else None
    if kind == "charge":
        # Six times what the published pulse leaves on an electrode.
        limits = replace(SIMULATED_LIMITS, net_charge_per_session=120.0)
    account = Account(Budget(30 if kind == "pulses" else None, 6 if kind == "electrode" else None))
    with FakeCulture(limits=limits) as culture:
        loop = loop_of(robot=LONG, pulses=4)
        session = run_session(culture, loop, [RANDOM], tmp_path, account=account, episodes=1)
        assert session.ending.by == "budget"
        assert account.pulses == culture.pulses == culture.delivered
        if kind in ("electrode", "charge"):
            assert 4 < account.most_on_an_electrode <= 6
        else:
            # Four a presentation: the eighth would be over it.
            assert account.pulses == 28
    assert_read_alike(tmp_path, loop_of(pulses=4))


def test_what_was_refused_is_not_spent_although_another_delivery_came_between(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests, plain_request = [], base._plain_request

    def after_another(stimuli: Any, duration_s: float) -> tuple[Sequence[Stimulus], float]:
        request = plain_request(stimuli, duration_s)
        requests.append(len(request[0]))
        if sum(requests) == 8 and request[0]:
            # As another thread's would, it takes the last place of the session.
            culture.deliver([Stimulus(0.0, (100,), BALANCED_PULSE)], 0.001)
        return request

    monkeypatch.setattr(base, "_plain_request", after_another)
    account = Account(Budget())
    with FakeCulture(limits=replace(SIMULATED_LIMITS, stimuli_per_session=8)) as culture:
        session = run_session(culture, loop_of(robot=LONG), [RANDOM], tmp_path, account=account, episodes=1)
        assert session.ending.by == "budget"
        assert culture.delivered == 8
    assert account.pulses == session.outline.ticks == 7
    assert session.outline.unanswered == ()


class Disk:
    """`os.write` of a disk that has room for so many bytes."""

    def __init__(self, room: int) -> None:
        self.room, self.real = room, os.write

    def write(self, file: int, data: Any) -> int:
        if self.room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        part = bytes(data)[: self.room]
        self.room -= len(part)
        return self.real(file, part)


def test_a_disk_that_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(60_000)
    monkeypatch.setattr("animat.closed_loop.log.os.write", disk.write)

    def slowly(culture: FakeCulture, observed: Observed) -> Observed:
        culture._at += 1
        time.sleep(0.002)
        return observed

    with FakeCulture(fault=slowly, at=0) as culture:
        session = run(tmp_path, culture, robot=LONG)
        assert session.ending.by == "disk"
        assert "No space left on device" in session.ending.message
        assert disk.room == 0
        assert_safe(session, culture, 20)
    assert session.log.lost_bytes == read_session(tmp_path).log.lost_bytes == 0
    assert "could not be written" in session.ending.message
    assert re.fullmatch(
        r"the log cannot be written: No space left on device; "
        r"(the ending could .* is|the last tick could .* is|the last \d+ ticks could not be written and are) lost",
        session.ending.message,
    )
    with pytest.raises(InvalidFile, match="No space left"):
        LogWriter(tmp_path / "other.log", {})


def test_a_log_that_is_removed_ends_the_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.closed_loop.running._SYNC_S", 0.01)

    def slowly(culture: FakeCulture, observed: Observed) -> Observed:
        culture._at += 1
        (tmp_path / "session.log").unlink(missing_ok=True)
        time.sleep(0.002)
        return observed

    with FakeCulture(fault=slowly, at=0) as culture:
        session = run(tmp_path, culture, robot=LONG)
        assert session.ending.by == "disk"
        assert session.ending.message.startswith("the log cannot be written: it was removed")
        assert culture.halted and culture.after_halt == 0


def test_the_log_is_flushed_to_disk_before_the_first_pulse_meanwhile_and_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[tuple[int, int, int]] = []

    def fsync(file: int) -> None:
        status = os.fstat(file)
        flushed.append((status.st_ino, status.st_size, culture.pulses))

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr("animat.closed_loop.running._SYNC_S", 0.0)
    with FakeCulture() as culture:
        run(tmp_path, culture, robot=Navigation(episode_limit=3))
    log = (tmp_path / LOG_FILE).stat()
    first, *meanwhile, last = [(size, pulses) for inode, size, pulses in flushed if inode == log.st_ino]
    assert first[1] == 0 and len(meanwhile) >= 1 and last == (log.st_size, 15)


def test_a_log_that_cannot_be_begun_leaves_nothing_in_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with FakeCulture() as culture:
        with monkeypatch.context() as patched, pytest.raises(InvalidFile, match="No space left"):
            patched.setattr("animat.closed_loop.log.os.write", Disk(500).write)
            run(tmp_path, culture)
        assert list(tmp_path.iterdir()) == [] and culture.pulses == 0
        assert run(tmp_path, culture).ending.by == "plan"


@pytest.mark.parametrize(("at", "by", "why"), [(999, "disk", "all 1 episodes were run"), (4, "culture", "the culture")])
def test_a_disk_that_is_full_once_the_loop_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int, by: str, why: str
) -> None:
    real, begun = os.write, threading.Event()

    def write(file: int, data: Any) -> int:
        if begun.is_set() and not any(thread.name == "closed loop" for thread in threading.enumerate()):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(file, data)

    def fault(culture: FakeCulture, observed: Observed) -> Observed:
        culture._at += 1
        begun.set()
        if culture.deliveries >= at:
            raise RuntimeError("the amplifier is on fire")
        return observed

    monkeypatch.setattr("animat.closed_loop.log.os.write", write)
    with FakeCulture(fault=fault, at=0) as culture:
        loop = loop_of(robot=Navigation(episode_limit=6))
        session = run_session(culture, loop, [RANDOM], tmp_path, episodes=1)
        assert culture.is_stopped == (by == "culture")
    assert session.ending.by == by
    assert session.ending.message.startswith(why)
    assert re.search(r" lost \(No space left on device\)$", session.ending.message)


def test_a_recording_that_cannot_be_written_is_made_later(tmp_path: Path) -> None:
    # A folder stands where the file should go.
    (tmp_path / "session.nwb").mkdir()
    (tmp_path / "session.nwb" / "in the way").touch()
    with FakeCulture() as culture:
        session = run(tmp_path, culture, robot=Navigation(episode_limit=3))
    assert session.ending.by == "plan"
    assert "session.nwb: cannot be written" in session.ending.message
    assert "animat recover" in session.ending.message
    assert session.ending.message == (
        f"all 5 episodes were run; {tmp_path}/session.nwb: cannot be written: Is a directory "
        f"(once that is fixed, animat recover {tmp_path} writes the files)"
    )
    (tmp_path / "session.nwb" / "in the way").unlink()
    (tmp_path / "session.nwb").rmdir()
    assert list(recover_session(tmp_path).ticks) == list(session.ticks)
    assert_read_alike(tmp_path, loop_of())


@pytest.mark.parametrize("error", [UnusableData("spikes: expected finite times"), RuntimeError("Can't write data")])
def test_a_session_comes_back_whatever_its_files_are_like(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def failing(*_: Any) -> None:
        raise error

    with monkeypatch.context() as patched, FakeCulture() as culture:
        patched.setattr("animat.closed_loop.session.write_nwb", failing)
        session = run(tmp_path, culture, robot=Navigation(episode_limit=3))
    assert session.ending.by == "plan"
    assert str(error) in session.ending.message
    assert f"animat recover {tmp_path} writes" in session.ending.message
    assert len(session.episodes) == 5
    assert recover_session(tmp_path).episodes == session.episodes
    assert_read_alike(tmp_path, loop_of())


KILLED = """
import sys, time
from test_closed_loop_faults import LONG, RANDOM, FakeCulture, loop_of, run_session

def slowly(culture, observed):
    culture._at += 1
    time.sleep(0.005)
    if culture._at % 20 == 0:
        print(culture._at, time.monotonic(), flush=True)
    return observed

with FakeCulture(fault=slowly, at=0) as culture:
    run_session(culture, loop_of(robot=LONG), [RANDOM], sys.argv[1], episodes=1)
"""


@pytest.mark.oracle
def test_killed_outright_it_loses_at_most_a_second(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent
    )
    assert process.stdout is not None
    written = []
    while len(written) < 2 or written[-1][1] - written[0][1] < 2.0:
        number, at_s = process.stdout.readline().split()
        written.append((int(number), float(at_s)))
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    session = read_session(tmp_path)
    assert session.ending.by == "crash"
    # What was done a second before the last sign of life is there, whatever came after it.
    done = max(number for number, at_s in written if at_s < written[-1][1] - 1.0)
    assert session.outline.ticks >= done - 1 > 20
    with pytest.raises(InvalidFile):
        read_recording(tmp_path / "session.nwb")
    assert list(recover_session(tmp_path).ticks) == list(session.ticks)
    assert_read_alike(tmp_path, loop_of())


KILLED_MEANWHILE = """
import sys, time
from test_closed_loop_faults import LONG, RANDOM, FakeCulture, loop_of, run_session

def hang(culture, observed):
    print(culture.pulses, flush=True)
    time.sleep(600)

with FakeCulture(fault=hang, at=8) as culture:
    run_session(culture, loop_of(robot=LONG, pulses=4, patience_s=600.0), [RANDOM], sys.argv[1], episodes=1)
"""


@pytest.mark.oracle
def test_killed_during_a_long_presentation_the_log_has_what_was_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED_MEANWHILE, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parent,
    )
    assert process.stdout is not None
    pulses = int(process.stdout.readline())
    time.sleep(1.0)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    session = recover_session(tmp_path)
    summary = session.to_dict()
    assert summary["pulses"] + summary["unanswered_pulses"] == pulses == 8 * 4
    assert summary["unanswered_pulses"] == 4
    assert len(session.outline.unanswered[0]["stimuli"][0][3]) == 2
    assert main(["recover", str(tmp_path)]) == 0
    assert "4 pulses were requested and never answered" in capsys.readouterr().out
    assert_read_alike(tmp_path, loop_of(pulses=4))


def test_a_session_that_was_logged_before_stretches_were_is_read(tmp_path: Path) -> None:
    with FakeCulture(fault=raising(RuntimeError("smoke")), at=8) as culture:
        session = run(tmp_path / "new", culture)
    log = LogWriter(tmp_path / "old" / LOG_FILE, session.log.header)
    for words, times_s, channels in session.log:
        kept = {name: value for name, value in words.items() if name not in ("stretch", "stimuli")}
        seen = {"stimuli": words["stimuli"]} if words["kind"] == "seen" else {}
        log.append(LogRecord(kept | seen, times_s, channels))
    log.close()
    old = recover_session(tmp_path / "old")
    assert list(old.ticks) == list(session.ticks)
    assert old.to_dict() == session.to_dict() | {"unanswered_pulses": 0}


def test_a_log_cut_off_anywhere_is_whole_up_to_there(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / LOG_FILE, {"kind": "header"})
    header_ends = (tmp_path / LOG_FILE).stat().st_size
    rng = np.random.default_rng(1)
    written = [LogRecord({"n": n}, np.sort(rng.random(n)), rng.integers(0, 9, n)) for n in range(6)]
    ends = []
    for record in written:
        log.append(record)
        ends.append((tmp_path / LOG_FILE).stat().st_size)
    log.sync()
    log.close()
    data = (tmp_path / LOG_FILE).read_bytes()
    assert len(data) == ends[-1]
    other = tmp_path / "cut.log"
    for length in range(len(data) + 1):
        other.write_bytes(data[:length])
        if length < header_ends:
            with pytest.raises(InvalidFile):
                read_log(other)
            continue
        whole = [record for record, end in zip(written, ends, strict=True) if end <= length]
        found = read_log(other)
        assert [r.fields for r in found] == [r.fields for r in whole]
        for got, want in zip(found, whole, strict=True):
            np.testing.assert_array_equal(got.spike_times_s, want.spike_times_s)
            np.testing.assert_array_equal(got.spike_channels, want.spike_channels)
    # A byte that changed is noticed: nothing from there on is taken for true.
    for place in range(ends[1], len(data), 7):
        other.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        assert len(read_log(other)) < len(written)
    for content in (b"", b"ANIMAT", b"something else entirely"):
        other.write_bytes(content)
        with pytest.raises(InvalidFile):
            read_log(other)
    with pytest.raises(InvalidFile):
        read_session(tmp_path / "nowhere")
    # Who opened a pipe that nobody writes to would wait without end.
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InvalidFile, match="expected a file, got a device or a pipe"):
        read_log(tmp_path / "pipe")
