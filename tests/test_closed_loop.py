"""The closed loop presents as it should, reads responses as they are read offline, and writes everything down."""

from __future__ import annotations

import csv
import gc
import os
import re
import sys
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.closed_loop.agents import (
    ActorController,
    Agent,
    AnyCondition,
    OneCondition,
    interleave,
)
from animat.closed_loop.loop import Loop
from animat.closed_loop.outline import Outline
from animat.closed_loop.runner import RobotRunner
from animat.closed_loop.running import run_session
from animat.closed_loop.session import read_session, recover_session
from animat.closed_loop.tick import Tick
from animat.closed_loop.timing import drop_real_time_priority, real_time_priority
from animat.coding.mapping import Linear, Thresholds
from animat.cultures.budget import Account, Budget
from animat.cultures.contract import CultureContract
from animat.cultures.observed import Observed
from animat.environment import Animat
from animat.errors import BudgetSpent, InvalidArgument, UnsafeStimulus, UnusableData
from animat.evaluation.rollouts import HeuristicPolicy
from animat.evaluation.statistics import Interval
from animat.neurons.history_tracker import AdjustedRanks
from animat.neurons.simulator import fit_empirical
from animat.recordings.reading import read_recording
from animat.responses.condition import Condition
from animat.responses.conditions import ByFrequency
from animat.responses.extraction import extract_responses
from animat.responses.readouts import ALL
from animat.robots import Cartpole, Navigation, Robot
from animat.stimulation.protocol import Presentation, Protocol
from animat.stimulation.pulse import PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.stimulus import Stimulus
from cultures import small_culture
from fake_culture import CHANNELS, FakeCulture

HZ = (5.0, 10.0, 20.0, 40.0, 80.0)
CONDITIONS = tuple(Condition(f"{f:g} Hz", f, "Hz") for f in HZ)
PERCENTILES = np.linspace(0.0, 125.0, 11)
SHORT = Navigation(episode_limit=6)
RANDOM = Agent("random", "any", AnyCondition(5))


def loop_of(**changed: Any) -> Loop:
    given = {"robot": SHORT, "mapping": Thresholds(9), "conditions": CONDITIONS, "percentiles": PERCENTILES}
    return Loop(**(given | {"pause_s": 0.1, "warm_up": 0, "settling": 0} | changed))


class TestFake(CultureContract):
    """The fake is a culture: what the loop does with it, it does with any."""

    is_repeatable = True

    def make_culture(self) -> FakeCulture:
        return FakeCulture()


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    pulses=st.integers(1, 6),
    jitter=st.booleans(),
    on_burst=st.sampled_from(["use", "repeat", "skip"]),
    window_ms=st.sampled_from([(2.0, 10.0), (0.0, 5.0), (3.15, 11.05)]),
    warm_up=st.integers(0, 2),
)
@pytest.mark.oracle
def test_the_recording_of_a_session_gives_the_responses_that_the_loop_used(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    pulses: int,
    jitter: bool,
    on_burst: str,
    window_ms: tuple[float, float],
    warm_up: int,
) -> None:
    folder = tmp_path_factory.mktemp("session")
    loop = loop_of(pulses=pulses, burst_threshold=0.9, on_burst=on_burst, window_ms=window_ms, warm_up=warm_up)
    agents = [
        RANDOM,
        Agent("shuffled", "", OneCondition(1), "shuffled"),
        Agent("no", "", OneCondition(0), "silent"),
    ]
    with FakeCulture(seed, jitter=jitter) as culture:
        session = run_session(culture, loop, agents, folder, episodes=2, seed=seed)
    assert session.ending.by == "plan", session.ending
    assert_read_alike(folder, loop)
    ticks = session.ticks
    assert len(session.episodes) == 6
    for tick in ticks:
        if tick.handled == "used":
            assert tick.command == float(loop.mapping.command(np.float32(tick.rate_hz), loop.percentiles))
        assert tick.is_burst == (tick.active_ratio > 0.9)
        assert (tick.handled == "skipped") <= (on_burst == "skip" and tick.is_burst)
        assert (tick.handled == "repeated") <= (on_burst == "repeat" and tick.is_burst)
        assert tick.late_s == 0.0


def assert_read_alike(folder: Path, loop: Loop) -> None:
    """The session's NWB file, read like any other, gives the loop's x to the last bit."""
    session = read_session(folder)
    recording = read_recording(session.recording_file)
    # How it ended may be on no disk, where that was full.
    assert replace(recording, provenance={}).equals(replace(session.recording(), provenance={}))
    assert recording.presentation == Presentation("mixed", loop.pulses)
    responses = extract_responses(recording, ByFrequency(HZ), loop.window_ms, loop.burst_threshold)
    stimulated = [tick for tick in session.ticks if tick.patterns]
    assert len(responses) == len(stimulated)
    np.testing.assert_array_equal(responses.rate_hz, [tick.rate_hz for tick in stimulated])
    np.testing.assert_array_equal(responses.active_ratio, [tick.active_ratio for tick in stimulated])
    np.testing.assert_array_equal(responses.is_burst, [tick.is_burst for tick in stimulated])
    np.testing.assert_array_equal(responses.condition, [tick.delivered for tick in stimulated])
    np.testing.assert_array_equal(responses.time_s, [tick.read_after_s for tick in stimulated])


def assert_table_is_the_session(folder: Path, names: list[str]) -> None:
    """`ticks.csv`, read without this package, is what the log says."""
    session = read_session(folder)
    with session.ticks_file.open(newline="") as file:
        table = list(csv.DictReader(file))

    def number(cell: str) -> float | None:
        return float(cell) if cell else None

    def numbers(cell: str) -> tuple[float, ...]:
        return tuple(float(word) for word in cell.split())

    again = [
        Tick(
            number=int(row["tick"]),
            agent=row["agent"],
            episode=int(row["episode"]),
            iteration=int(row["iteration"]),
            chosen=[c.label for c in CONDITIONS].index(row["chosen"]),
            delivered=[c.label for c in CONDITIONS].index(row["delivered"]),
            frequency_hz=float(row["frequency_hz"]),
            patterns=tuple(int(pattern) for pattern in numbers(row["patterns"])),
            pulse_time_s=numbers(row["pulse_times_s"]),
            read_after_s=float(row["time_s"]),
            spikes=int(row["spikes"]),
            rate_hz=float(row["rate_hz"]),
            active_ratio=float(row["active_ratio"]),
            is_burst=row["is_burst"] == "1",
            handled=row["handled"],  # type: ignore[arg-type]
            command=number(row["command"]),
            reward=number(row["reward"]),
            observation=tuple(float(row[name]) for name in names if row[name]),
            terminated=row["is_terminated"] == "1",
            truncated=row["is_truncated"] == "1",
            late_s=float(row["late_s"]),
            decided_s=float(row["decided_s"]),
            wall_s=float(row["wall_s"]),
        )
        for row in table
    ]
    assert again == list(session.ticks)
    assert len(again) > 0


@pytest.mark.parametrize(
    ("robot", "names"),
    [
        (SHORT, ["x_m", "y_m", "heading_rad"]),
        (
            Cartpole(episode_limit=6),
            ["cart_position_m", "cart_velocity_m_per_s", "pole_angle_rad", "pole_angular_velocity_rad_per_s"],
        ),
    ],
)
def test_the_ticks_are_beside_the_recording_as_a_table(tmp_path: Path, robot: Robot[Any], names: list[str]) -> None:
    loop = loop_of(robot=robot, pulses=2, burst_threshold=0.9, on_burst="repeat")
    agents = [RANDOM, Agent("no", "", OneCondition(0), "silent")]
    said: list[tuple[float, float, str]] = []
    with FakeCulture(1) as culture:
        session = run_session(
            culture,
            loop,
            agents,
            tmp_path,
            episodes=3,
            progress=SimpleNamespace(update=lambda *shown: said.append(shown)),
        )
    last = [tick for tick in session.ticks if tick.episode == 5 and tick.reward is not None]
    returns = [[sum(t.reward or 0.0 for t in session.ticks if t.episode == i)] for i in range(6)]
    names_of = [next(t.agent for t in session.ticks if t.episode == i) for i in range(6)]
    means = {name: np.mean([r for r, of in zip(returns, names_of, strict=True) if of == name]) for name in names_of}
    so_far = ", ".join(f"{name} {mean:.1f}" for name, mean in means.items())
    assert said[-1] == (6, 6, f"{last[0].agent}: return {returns[-1][0]:.1f}; means: {so_far}")
    assert [done for done, *_ in said] == sorted(done for done, *_ in said)
    assert {tick.handled for tick in session.ticks} == {"used", "repeated"}
    assert_table_is_the_session(tmp_path, names)
    said = read_recording(session.recording_file).provenance["session_description"]
    assert "(random, no): ticks.csv" in said
    written = session.ticks_file.read_bytes()
    session.ticks_file.unlink()
    recover_session(tmp_path)
    assert session.ticks_file.read_bytes() == written


@pytest.mark.oracle
def test_on_the_virtual_culture_too(tmp_path: Path) -> None:
    loop = loop_of(pulses=5, percentiles=np.linspace(0, 40, 11), burst_threshold=0.9)
    with small_culture() as culture:
        agents = [RANDOM, Agent("no", "", OneCondition(4), "silent")]
        session = run_session(culture, loop, agents, tmp_path, episodes=2)
        assert session.ending.by == "plan"
        assert not culture.is_stopped
        assert culture.delivered == sum(episode.pulses for episode in session.episodes) == 60
    assert_read_alike(tmp_path, loop)
    recording = session.recording()
    assert recording.provenance["source"].startswith("virtual culture")
    assert recording.start_min == session.log.header["start_min"]


def test_presentations_are_those_of_a_recording(tmp_path: Path) -> None:
    loop = loop_of(pulses=3, patterns=7)
    with FakeCulture() as culture:
        session = run_session(culture, loop, [RANDOM], tmp_path, episodes=8)
    pulse_s = np.array([t for tick in session.ticks for t in tick.pulse_time_s])
    frequency_hz = np.repeat([tick.frequency_hz for tick in session.ticks], 3)
    first = np.array([tick.iteration == 0 for tick in session.ticks]).repeat(3) & (np.arange(len(pulse_s)) % 3 == 0)
    # Every pulse 1/f after the one before it, f being its own: within the grid of 50 us.
    np.testing.assert_allclose(np.diff(pulse_s)[~first[1:]], 1 / frequency_hz[1:][~first[1:]], atol=5.1e-5)
    patterns = [tick.patterns for tick in session.ticks]
    assert all(len(set(p)) == 3 for p in patterns)
    counts = Counter(p for ps in patterns for p in ps)
    assert set(counts) == set(range(7))
    assert max(counts.values()) - min(counts.values()) <= 2
    assert {tick.chosen for tick in session.ticks} == set(range(5))


@pytest.mark.parametrize("rate_hz", [1_000.0, 10_000.0, 12_500.0])
def test_pulses_that_are_on_time_are_not_late_by_the_rounding_to_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate_hz: float
) -> None:
    monkeypatch.setattr(FakeCulture, "sampling_rate_hz", rate_hz)
    # Periods that are no whole number of samples.
    loop = loop_of(conditions=tuple(Condition(f"{f:g} Hz", f, "Hz") for f in (7.0, 15.0, 30.0, 60.0, 70.0)))
    with FakeCulture() as culture:
        session = run_session(culture, loop, [RANDOM], tmp_path, episodes=8)
    assert session.outline.late == 0, session.outline.latest_s


def test_the_time_to_decide_is_counted_from_the_data_and_a_pause_is_none_of_it(tmp_path: Path) -> None:
    class Ticking:
        """A clock that ticks each time that it is looked at, and has run for a while."""

        time_s = 5000.0

        def now_s(self) -> float:
            self.time_s += 1e-4
            return self.time_s

        def sleep_until(self, time_s: float) -> None:
            self.time_s = max(self.time_s, time_s)

    with FakeCulture() as culture:
        loop = loop_of(real_time=True, pause_s=30.0)
        session = run_session(culture, loop, [RANDOM], tmp_path, episodes=2, clock=Ticking())
    assert len(list(session.ticks)) == 12
    assert 0 < max(tick.decided_s for tick in session.ticks) < 0.002
    # From the start of the session, in step with the culture's clock.
    assert all(0 < tick.wall_s - tick.read_after_s < 0.1 for tick in session.ticks)


@pytest.mark.oracle
@pytest.mark.skipif(not hasattr(os, "SCHED_RR"), reason="the system has no real-time scheduling")
@pytest.mark.parametrize("real_time", [True, False])
def test_a_loop_with_deadlines_runs_ahead_of_other_programs_where_it_may(tmp_path: Path, real_time: bool) -> None:
    seen: set[int] = set()
    of_those_it_starts: set[int] = set()
    interpreter: set[tuple[bool, float]] = set()

    class Noting(AnyCondition):
        def act(self, observation: Any, rng: np.random.Generator) -> int:
            seen.add(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
            interpreter.add((gc.isenabled(), round(sys.getswitchinterval(), 6)))
            with ThreadPoolExecutor(1) as started:
                of_those_it_starts.add(started.submit(os.sched_getscheduler, 0).result())
            return super().act(observation, rng)

    def may() -> bool:
        with ThreadPoolExecutor(1) as thread:
            asked = thread.submit(os.sched_setscheduler, 0, os.SCHED_RR, os.sched_param(1))
            return asked.exception() is None

    if real_time and not may():
        pytest.skip("the system gives no real-time priority")
    before, usual = os.sched_getscheduler(0), (gc.isenabled(), sys.getswitchinterval())
    with FakeCulture() as culture:
        run_session(culture, loop_of(real_time=real_time), [Agent("noting", "", Noting(5))], tmp_path, episodes=1)
    # No garbage is collected meanwhile, and no thread keeps the interpreter for long.
    assert interpreter == {(False, 0.0002)}
    assert (gc.isenabled(), sys.getswitchinterval()) == usual == (True, usual[1])
    assert seen == {os.SCHED_RR if real_time else before}
    assert of_those_it_starts == {before}
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == before


@pytest.mark.skipif(not hasattr(os, "SCHED_RR"), reason="the system has no real-time scheduling")
def test_a_thread_that_is_left_alone_is_no_longer_ahead_of_other_programs() -> None:
    began, may_end, policies = threading.Event(), threading.Event(), list[int]()

    def run() -> None:
        with real_time_priority(inherited=False):
            policies.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
            began.set()
            may_end.wait(60)
            policies.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)

    thread = threading.Thread(target=run)
    thread.start()
    began.wait(60)
    drop_real_time_priority(thread)
    may_end.set()
    thread.join()
    if policies[0] != os.SCHED_RR:
        pytest.skip("the system gives no real-time priority")
    assert policies[1] == os.SCHED_OTHER


def test_agents_take_turns_in_random_order() -> None:
    rng = np.random.default_rng(1)
    turns = interleave([50] * 4, rng)
    rounds = np.array(turns).reshape(50, 4)
    assert all(set(row.tolist()) == {0, 1, 2, 3} for row in rounds)
    # Each stands in each place about as often as in any other: 12.5 times of 50, standard deviation 3.1.
    assert all(4 <= np.sum(rounds[:, place] == who) <= 24 for place in range(4) for who in range(4))


def test_agents_with_fewer_episodes_are_spread_over_the_session() -> None:
    turns = np.array(interleave([40, 5], np.random.default_rng(2)))
    assert np.bincount(turns).tolist() == [40, 5]
    before = np.cumsum(turns == 0)[turns == 1]
    # One in each fifth of the session, which eight episodes of the other are in.
    assert all(8 * fifth <= n <= 8 * fifth + 8 for fifth, n in enumerate(before.tolist()))


def test_the_silent_control_gives_no_pulse_and_the_shuffled_one_another_condition(tmp_path: Path) -> None:
    agents = [Agent("no", "", OneCondition(0), "silent"), Agent("any", "", OneCondition(4), "shuffled")]
    with FakeCulture() as culture:
        session = run_session(culture, loop_of(), agents, tmp_path, episodes=10)
        assert culture.delivered == culture.pulses == 60
    silent = [tick for tick in session.ticks if tick.agent == "no"]
    assert not any(tick.patterns or tick.pulse_time_s for tick in silent)
    assert all(tick.reward is not None for tick in silent)
    # What is read is what came when the response to a pulse of 5 Hz would have come.
    for before, tick in pairwise(silent):
        assert tick.iteration == 0 or tick.read_after_s - before.read_after_s == pytest.approx(0.2, abs=1e-4)
    recording = session.recording()
    since_ms = 1e3 * np.subtract.outer([tick.read_after_s for tick in silent], recording.spike_times_s)
    inside = (-since_ms >= 2.0 - 1e-6) & (-since_ms < 10.0 - 1e-6)
    assert [tick.spikes for tick in silent] == inside.sum(axis=1).tolist() != [0] * 60
    # All that was seen is recorded, the pauses too: this culture's clock stands still in between.
    assert recording.duration_s == pytest.approx(culture.now_s - 12.0, abs=1e-9)
    assert recording.provenance["closed_loop_unwatched_s"] == "0.000000"
    shuffled = [tick.delivered for tick in session.ticks if tick.agent == "any"]
    assert {tick.chosen for tick in session.ticks if tick.agent == "any"} == {4}
    assert set(shuffled) == set(range(5))


def test_a_response_on_a_percentile_passes_it_as_in_training(tmp_path: Path) -> None:
    # x is k / (8 ms 16) = 7.8125 k Hz; with percentiles on such values ties are common. A window of 3 ms makes x a
    # number that float32 cannot hold: compared in float64, it would lie under its own percentile half of the time.
    window_ms = (2.0, 5.0)
    step_hz = 1 / (0.003 * CHANNELS)
    percentiles = (step_hz * np.array([0, 1, 1, 1, 2, 2, 3, 3, 4, 5, 9])).astype(np.float32)
    assert float(percentiles[5]) > 2 * step_hz
    loop = loop_of(mapping=Thresholds(1), percentiles=percentiles, window_ms=window_ms)
    with FakeCulture() as culture:
        session = run_session(culture, loop, [RANDOM], tmp_path, episodes=10)
    ties = [tick for tick in session.ticks if tick.spikes == 2]
    assert ties
    assert all(tick.command == (1.0 if tick.spikes >= 2 else -1.0) for tick in session.ticks)


@pytest.mark.oracle
def test_each_condition_leads_in_before_an_episode_and_moves_nothing(tmp_path: Path) -> None:
    class Fixed:
        def act(self, observation: Any, rng: np.random.Generator) -> int:
            np.testing.assert_array_equal(observation, SHORT.observe(SHORT.reset(jax.random.key(0))))
            raise Done

    class Done(Exception):
        pass

    rest = Agent("rest", "no pulse", AnyCondition(5), "silent")
    loop = loop_of(warm_up=3, pulses=2, burst_threshold=0.5, on_burst="repeat")
    with FakeCulture() as culture:
        session = run_session(culture, loop, [RANDOM, rest], tmp_path / "two", episodes=2)
    for episode in session.episodes:
        ticks = [tick for tick in session.ticks if tick.episode == episode.number]
        warming = [tick for tick in ticks if tick.handled == "warm-up"]
        # Silence has nothing before it either.
        assert len(warming) == (0 if episode.agent == "rest" else 15)
        assert ticks[: len(warming)] == warming
        for n in range(0, len(warming), 5):
            assert sorted(tick.delivered for tick in warming[n : n + 5]) == [0, 1, 2, 3, 4]
        assert len({tuple(tick.delivered for tick in warming[n : n + 5]) for n in (0, 5, 10)}) == (3 if warming else 1)
        for tick in warming:
            assert (tick.iteration, tick.command, tick.reward, tick.observation) == (-1, None, None, ())
            assert len(tick.pulse_time_s) == 2
        assert ticks[len(warming)].iteration == 0
        assert episode.iterations == 6
        assert episode.pulses == sum(len(tick.pulse_time_s) for tick in ticks)
        moving = ticks[len(warming) :]
        assert episode.warm_up_pulses == 2 * len(warming)
        assert (episode.trials, episode.bursts) == (len(moving), sum(tick.is_burst for tick in moving))
    assert session.outline.bursts == sum(tick.is_burst for tick in session.ticks)
    assert_read_alike(tmp_path / "two", loop)
    # The robot stands until the policy's first choice.
    with FakeCulture() as culture:
        session = run_session(culture, loop, [Agent("fixed", "", Fixed())], tmp_path / "one", episodes=1)
    assert session.ending.by == "controller"
    assert "Done" in session.ending.message
    assert len(list(session.ticks)) == 15


def test_a_culture_settles_before_the_first_episode(tmp_path: Path) -> None:
    loop = loop_of(settling=3, warm_up=1, pause_s=0.5)
    # Silence comes first: what settles is given all the same.
    silent = Agent("silent", "", OneCondition(0), "silent")
    with FakeCulture() as culture:
        session = run_session(culture, loop, [silent, RANDOM], tmp_path, episodes=[1, 1], seed=2)
    first, second = session.episodes
    assert (first.agent, first.iterations, second.iterations) == ("silent", 6, 6)
    settling = [tick for tick in session.ticks if tick.handled == "warm-up" and tick.episode == 0]
    assert len(settling) == 3 * 6 * 5
    assert all(tick.iteration == -1 and len(tick.pulse_time_s) == 1 for tick in settling)
    delivered = np.reshape([tick.delivered for tick in settling], (18, 5))
    np.testing.assert_array_equal(np.sort(delivered), np.tile(range(5), (18, 1)))
    # Each part after a pause and its own first interval.
    at_s = np.reshape([tick.pulse_time_s[0] for tick in settling], (3, 30))
    rests_s = at_s[:, 0] - np.array([0.0, *at_s[:-1, -1]]) - [1 / HZ[c] for c in delivered[::6, 0]]
    assert np.all((rests_s > 0.499) & (rests_s < 0.53))
    assert len([tick for tick in session.ticks if tick.handled == "warm-up" and tick.episode == 1]) == 5
    assert_read_alike(tmp_path, loop)
    outline = Outline()
    for record in session.log:
        outline.add(record.fields)
    assert (
        outline.moved_at_s == next(tick.wall_s for tick in session.ticks if tick.iteration == 0) > settling[-1].wall_s
    )


def test_the_notes_of_a_session_from_its_warm_up_on(tmp_path: Path) -> None:
    def slowly(culture: FakeCulture, observed: Observed) -> Observed:
        culture._at += 1
        time.sleep(0.3 if culture.deliveries == 1 else 0.01)
        return observed

    said: list[tuple[float, str]] = []
    progress = SimpleNamespace(update=lambda done, total, note: said.append((done, note)))
    loop = loop_of(robot=Navigation(episode_limit=20), warm_up=2)
    with FakeCulture(fault=slowly, at=0) as culture:
        session = run_session(culture, loop, [RANDOM], tmp_path, episodes=1, progress=progress)
    total = f"{session.episodes[0].total:.1f}"
    notes, parts = [note for _, note in said], [done for done, _ in said]
    assert notes[0] == "warm-up" and notes[-1] == f"random: return {total}; means: random {total}"
    assert any(re.fullmatch(r"random: return \S+ so far", note) for note in notes)
    # In twentieths of the episode.
    assert any(0 < part < 1 for part in parts) and {round(20 * part, 9) for part in parts} <= {*range(21)}


def test_only_adaptive_thresholds_of_single_pulses_settle() -> None:
    with FakeCulture() as culture:
        recorded = extract_responses(culture.record(Protocol(order="mixed", patterns=8, trials=4, setup_s=0.1)))
    adjusted = AdjustedRanks.of(recorded, fit_empirical(recorded))
    assert [loop_of(pulses=n, adaptive_from=adjusted, settling=None).settling for n in (1, 2)] == [10, 0]
    assert loop_of(settling=None).settling == 0
    assert loop_of(pulses=2, settling=1).settling == 1


def test_several_pulses_need_no_warm_up() -> None:
    assert [loop_of(pulses=n, warm_up=None).warm_up for n in (1, 2, 5)] == [2, 0, 0]
    assert loop_of(pulses=5, warm_up=1).warm_up == 1


def test_a_budget_that_runs_out_in_the_warm_up_ends_the_session(tmp_path: Path) -> None:
    with FakeCulture() as culture:
        account = Account(Budget(7))
        session = run_session(culture, loop_of(warm_up=2), [RANDOM], tmp_path, episodes=1, account=account)
    assert session.ending.by == "budget"
    assert [tick.handled for tick in session.ticks] == ["warm-up"] * 7
    (episode,) = session.episodes
    assert (episode.iterations, episode.is_whole, episode.pulses) == (0, False, 7)
    assert_read_alike(tmp_path, loop_of())


@pytest.mark.oracle
def test_bursts_are_handled_as_chosen(tmp_path: Path) -> None:
    sessions = {}
    for how in ("use", "repeat", "skip"):
        # Every 37th response is a burst: that of the second episode is at its start.
        loop = loop_of(robot=Navigation(episode_limit=36), burst_threshold=0.95, on_burst=how, mapping=Linear())
        with FakeCulture() as culture:
            sessions[how] = run_session(culture, loop, [RANDOM], tmp_path / how, episodes=4)
    for how, session in sessions.items():
        ticks = list(session.ticks)
        bursts = [i for i, tick in enumerate(ticks) if tick.is_burst]
        assert bursts, how
        assert how == "repeat" or [ticks[i].iteration for i in bursts] == [0, 1, 2]
        for i in bursts:
            tick, after = ticks[i], ticks[i + 1 : i + 2]
            if how == "use":
                assert tick.handled == "used"
            elif how == "skip":
                before = ticks[i - 1]
                held = before.command if i and before.episode == tick.episode else 0.0
                assert (tick.handled, tick.command) == ("skipped", held)
            elif after and tick.handled == "repeated":
                assert (tick.command, tick.reward) == (None, None)
                assert (after[0].iteration, after[0].delivered) == (tick.iteration, tick.delivered)
                assert after[0].number == tick.number + 1
    assert sum(episode.iterations for episode in sessions["repeat"].episodes) == 4 * 36
    assert len(list(sessions["repeat"].ticks)) > 4 * 36


@pytest.mark.oracle
def test_a_task_that_ends_at_the_limit_is_not_cut_off_there(tmp_path: Path) -> None:
    limit = 200
    for ends in ("before the limit", "at the limit"):
        with FakeCulture() as culture:
            loop = loop_of(robot=Cartpole(episode_limit=limit))
            session = run_session(culture, loop, [Agent("one", "", OneCondition(0))], tmp_path / ends, episodes=1)
        last = list(session.ticks)[-1]
        assert (last.terminated, last.truncated) == (True, False)
        limit = last.iteration + 1


def test_a_stimulus_is_repeated_at_most_so_often(tmp_path: Path) -> None:
    loop = loop_of(burst_threshold=0.0, on_burst="repeat", most_repeats=2)
    with FakeCulture() as culture:
        session = run_session(culture, loop, [RANDOM], tmp_path, episodes=1)
    assert [tick.handled for tick in session.ticks] == ["repeated", "repeated", "used"] * 6
    assert session.episodes[0].is_whole


def test_the_shuffled_control_repeats_what_it_has_delivered(tmp_path: Path) -> None:
    loop = loop_of(burst_threshold=0.0, on_burst="repeat", most_repeats=3)
    with FakeCulture() as culture:
        agents = [Agent("shuffled", "", OneCondition(1), "shuffled")]
        session = run_session(culture, loop, agents, tmp_path, episodes=3)
    delivered = np.array([tick.delivered for tick in session.ticks]).reshape(3 * 6, 4)
    assert np.all(delivered == delivered[:, :1])
    assert len(set(delivered[:, 0].tolist())) > 1


class RecordedAs:
    """What a loop takes from a policy."""

    robot, mapping, readouts, conditions = SHORT, Thresholds(1), ALL, CONDITIONS
    neural_observation = False

    def __init__(self, presentation: Presentation | None, window_ms: tuple[float, float] | None = (2.0, 10.0)) -> None:
        self.presentation, self.window_ms = presentation, window_ms


def test_a_loop_presents_as_the_policy_was_recorded_and_names_where_it_does_not() -> None:
    loop, findings = Loop.of_policy(RecordedAs(Presentation("mixed", 5)), PERCENTILES)
    assert (loop.pulses, loop.presentation, findings) == (5, Presentation("mixed", 5), ())
    loop, findings = Loop.of_policy(RecordedAs(Presentation("blocked", 1)), PERCENTILES)
    assert loop.pulses == 1
    assert [f.severity for f in findings] == ["warning"]
    assert "blocked" in findings[0].message
    _, findings = Loop.of_policy(RecordedAs(Presentation("mixed", 5)), PERCENTILES, pulses=2)
    assert "5 pulse(s) per trial, the loop has 2" in findings[0].message
    loop, findings = Loop.of_policy(RecordedAs(None), PERCENTILES)
    assert loop.pulses == 1
    assert "not known" in findings[0].message
    _, findings = Loop.of_policy(RecordedAs(Presentation("mixed")), PERCENTILES, window_ms=(3.0, 9.0))
    assert [f.name for f in findings] == ["other-window"]
    without = RecordedAs(Presentation("mixed"))
    without.mapping = None  # type: ignore[assignment]
    with pytest.raises(UnusableData, match="through neurons"):
        Loop.of_policy(without, PERCENTILES)
    with pytest.raises(InvalidArgument, match=f"conditions: expected {len(CONDITIONS)}, as the policy has, got 1"):
        Loop.of_policy(RecordedAs(None), PERCENTILES, conditions=CONDITIONS[:1])
    with pytest.raises(InvalidArgument, match="conditions: expected several of: a Condition, got 5"):
        Loop.of_policy(RecordedAs(None), PERCENTILES, conditions=5)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"percentiles": [1, 2]}, "11 rising"),
        ({"percentiles": PERCENTILES[::-1]}, "11 rising"),
        ({"pulses": 0}, "pulses: expected at least 1"),
        # A quarter of an hour at the slowest of 5 to 80 Hz.
        (
            {"pulses": 5001},
            r"pulses: expected trials of 1000 s at most, got 5001 .* take 1,000\.2 s at 5 Hz: use at most 5,000",
        ),
        ({"window_ms": (10.0, 2.0)}, "start < end"),
        ({"conditions": ()}, "at least one"),
        ({"conditions": (Condition("electrode 5", 0.0),)}, "state the frequency of its pulses"),
        ({"on_burst": "panic"}, "use, repeat, skip"),
        ({"on_late": "panic"}, "continue, stop"),
        ({"pause_s": -1.0}, "pause_s"),
        ({"pause_s": "2"}, "pause_s: expected a number, got '2'"),
        ({"most_repeats": 2.5}, "most_repeats: expected a whole number, got 2.5"),
        ({"warm_up": -1}, "warm_up"),
        ({"warm_up": 1.5}, "warm_up: expected a whole number"),
        ({"settling": -1}, "settling: expected a whole number from 0 to 100, got -1"),
        ({"settling": 101}, "settling: expected a whole number from 0 to 100, got 101"),
        ({"settling": 2.5}, "settling: expected a whole number from 0 to 100, got 2.5"),
        ({"patience_s": float("nan")}, "patience_s"),
        ({"patience_s": 0.0}, "patience_s"),
        ({"patterns": 0}, "patterns"),
        ({"pulse": None}, "pulse: expected a pulse, such as animat.BALANCED_PULSE, got None"),
        ({"real_time": "off"}, "real_time: expected True or False, got 'off'"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, Any], words: str) -> None:
    assert loop_of(pulses=5000).pulses == 5000
    with pytest.raises((InvalidArgument, UnusableData), match=words):
        loop_of(**wrong)


def test_a_session_needs_an_open_culture_agents_and_a_folder_of_its_own(tmp_path: Path) -> None:
    culture = FakeCulture()
    with pytest.raises(InvalidArgument, match="closed"):
        run_session(culture, loop_of(), [RANDOM], tmp_path)
    with culture:
        twice = "agents: expected each name once, got random more than once: rename the policy's file"
        for agents, words in (([], "agents: expected at least one, got none"), ([RANDOM, RANDOM], twice)):
            with pytest.raises(InvalidArgument, match=words):
                run_session(culture, loop_of(), agents, tmp_path)
        with pytest.raises(InvalidArgument, match="patterns"):
            run_session(culture, loop_of(patterns=9), [RANDOM], tmp_path)
        with pytest.raises(InvalidArgument, match="episodes"):
            run_session(culture, loop_of(), [RANDOM], tmp_path, episodes=0)
        for wrong in ({"episodes": 1.5}, {"episodes": [True]}, {"seed": 0.5}):
            (name,) = wrong
            with pytest.raises(InvalidArgument, match=f"{name}: expected a whole number, got (1.5|True|0.5)"):
                run_session(culture, loop_of(), [RANDOM], tmp_path, **wrong)  # type: ignore[arg-type]
        strong = Pulse((Phase(200, amplitude_mv=-2000), Phase(200, amplitude_mv=2000)))
        with pytest.raises(UnsafeStimulus, match="amplitude: expected -400 to 400 mV, got -2000"):
            run_session(culture, loop_of(pulse=strong), [RANDOM], tmp_path)
        assert not list(tmp_path.iterdir())
        run_session(culture, loop_of(), [RANDOM], tmp_path, episodes=1)
        before = (tmp_path / "session.log").read_bytes()
        with pytest.raises(InvalidArgument, match="expected no session, got one"):
            run_session(culture, loop_of(), [RANDOM], tmp_path, episodes=1)
        assert (tmp_path / "session.log").read_bytes() == before
        culture.stop()
        with pytest.raises(InvalidArgument, match="stopped"):
            run_session(culture, loop_of(), [RANDOM], tmp_path / "other")


def test_what_is_predicted_stands_in_the_log(tmp_path: Path) -> None:
    with FakeCulture() as culture:
        with pytest.raises(InvalidArgument, match="predicted: expected names of agents, got someone"):
            run_session(culture, loop_of(), [RANDOM], tmp_path, predicted={"someone": Interval(1.5, 1.0, 2.0, 0.95)})
        predicted = {"random": Interval(1.5, 1.0, 2.0, 0.95)}
        session = run_session(culture, loop_of(), [RANDOM], tmp_path / "with", episodes=1, predicted=predicted)
        # Numbers of numpy are numbers too.
        counts: Any = {"episodes": np.int64(1), "seed": np.int64(7)}
        without = run_session(culture, loop_of(), [RANDOM], tmp_path / "without", **counts)
    assert session.log.header["predicted"] == {"random": {"mean": 1.5, "low": 1.0, "high": 2.0}}
    # The fake's clock was at 12 s.
    assert session.log.header["start_min"] == session.recording().start_min == 0.2
    assert "predicted" not in without.log.header and without.log.header["seed"] == 7
    assert [episode.is_whole for episode in without.episodes] == [True]


def test_the_heuristic_policy_steers_the_right_way() -> None:
    means = jnp.asarray([[-0.4, -0.1, 0.0, 0.1, 0.4]])
    rule = ActorController(HeuristicPolicy(jnp.arange(5)[None], means), Animat(Cartpole(), Thresholds(1), 5))
    rng = np.random.default_rng(1)
    assert rule.act(np.array([0.0, 0.0, 0.1, 0.0]), rng) == 4
    assert rule.act(np.array([0.0, 0.0, 0.05, -1.0]), rng) == 0
    # By the robot itself: a push by the rule brings a leaning pole back sooner than the opposite one.
    navigation = Navigation()
    # The oracle is the angle itself: from the heading to the goal, the short way round.
    places = rng.uniform([-1, -1, -np.pi], [1, 1, np.pi], (500, 3))
    to_goal = np.arctan2(navigation.goal_y_m - places[:, 1], navigation.goal_x_m - places[:, 0]) - places[:, 2]
    turn_rad = (to_goal + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_array_equal([navigation.heuristic(place) for place in places], np.sign(turn_rad))


@pytest.mark.parametrize("robot", [Cartpole(), Navigation()])
def test_by_the_robots_own_physics_the_rule_does_better_than_its_opposite(robot: Robot[Any]) -> None:
    """Commands of full power by the rule, and by the rule turned round."""
    lasted = {}
    for sign in (1, -1):
        runner = RobotRunner(robot, np.random.default_rng(1))
        observation, total = runner.reset(0), 0.0
        for _ in range(robot.episode_limit):
            moved = runner.step(sign * robot.heuristic(observation))
            observation, total = moved.observation, total + moved.reward
            if moved.terminated:
                break
        lasted[sign] = total
    assert lasted[1] > lasted[-1] + 10


def test_what_the_device_left_out_is_reported(tmp_path: Path) -> None:
    class Losing(FakeCulture):
        @property
        def left_out(self) -> dict[str, int]:
            return {"frames lost": 3 + self.deliveries, "spikes nowhere": 5}

    with Losing() as culture:
        session = run_session(culture, loop_of(), [RANDOM], tmp_path, episodes=1)
    assert session.outline.left_out == session.to_dict()["left_out"] == {"frames lost": 7}
    assert read_recording(session.recording_file).provenance["left_out"] == "7 frames lost"


@pytest.mark.parametrize("error", [RuntimeError("gone"), ConnectionResetError("gone")])
def test_a_device_that_can_no_longer_count_does_not_keep_the_session_from_ending(
    tmp_path: Path, error: Exception
) -> None:
    class Gone(FakeCulture):
        @property
        def left_out(self) -> dict[str, int]:
            if self.deliveries > 4:
                raise error
            return {}

    def lost(culture: FakeCulture, observed: Observed) -> Observed:
        raise error

    with Gone(fault=lost, at=4) as culture:
        session = run_session(culture, loop_of(), [RANDOM], tmp_path)
    assert session.ending.message.endswith(f"got {type(error).__name__}: gone")
    assert (session.ending, session.outline.left_out) == (read_session(tmp_path).ending, {})


def test_unanswered_pulses_are_counted_in_whatever_order_threads_write() -> None:
    of: dict[str, Any] = {"stretch": 0, "stimuli": [[5.0, 0, 0, [100, 101]]], "tick": None}
    asked, seen, failed = ({"kind": kind, **of} for kind in ("asked", "seen", "event"))
    refused = failed | {"is_admitted": False}
    for records, pulses in (
        ([asked], 1), ([asked, seen], 0), ([seen, asked], 0), ([asked, failed], 1), ([failed, asked], 1),
        ([asked, refused], 0), ([refused, asked], 0),
    ):  # fmt: skip
        outline = Outline()
        for record in records:
            outline.add(record)
        assert outline.unanswered_pulses == pulses, records


def test_policies_take_turns_under_a_control(tmp_path: Path) -> None:
    who = {f"p{i}": OneCondition(i) for i in range(3)}
    agents = [RANDOM, Agent("silent", "", who, "silent"), Agent("shuffled", "", who, "shuffled")]
    with FakeCulture() as culture:
        session = run_session(culture, loop_of(), agents, tmp_path, episodes=5)
    for name in ("silent", "shuffled"):
        episodes = [episode.number for episode in session.episodes if episode.agent == name]
        chosen = [{tick.chosen for tick in session.ticks if tick.episode == number} for number in episodes]
        assert chosen == [{0}, {1}, {2}, {0}, {1}]
    assert [agent.get("in_turn") for agent in session.log.header["agents"]] == [None, *[["p0", "p1", "p2"]] * 2]


def test_a_budget_is_kept_to_the_pulse() -> None:
    account = Account(Budget(pulses=10, pulses_per_electrode=4))
    assert account.to_dict() == {"pulses": 0, "of": 10, "most_on_an_electrode": 0, "of_per_electrode": 4}
    pair = [Stimulus(0.0, (1, 2), PUBLISHED_PULSE), Stimulus(0.1, (2, 3), PUBLISHED_PULSE)]
    for _ in range(2):
        account.check(pair)
        account.spend(pair)
    assert account._on == {1: 2, 2: 4, 3: 2}
    with pytest.raises(BudgetSpent, match="electrode 2 had 4 of 4"):
        account.check(pair)
    account.take_back(pair)
    account.check(pair)
    account.spend(pair)
    account.check([Stimulus(0.0, (1,), PUBLISHED_PULSE)] * 2)
    with pytest.raises(BudgetSpent, match="4 of 10 pulses are spent, and 7 more"):
        account.check([Stimulus(0.0, (i,), PUBLISHED_PULSE) for i in range(10, 17)])
    assert account.to_dict() == {"pulses": 4, "of": 10, "most_on_an_electrode": 4, "of_per_electrode": 4}
    with pytest.raises(InvalidArgument, match="pulses"):
        Budget(pulses=-1)
    assert replace(Budget(), pulses=3) == Budget(3)
