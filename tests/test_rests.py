"""The place without electrodes: trials take their usual time, nothing is delivered, the response is read as usual."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import stand_in_cl
import stand_in_maxlab
from animat.cli import main
from animat.cli.record import _plan
from animat.closed_loop.agents import Agent, AnyCondition
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.closed_loop.session import read_session, recover_session
from animat.coding.encoder import Dealer, Encoder
from animat.coding.mapping import Thresholds
from animat.cultures.base import Culture
from animat.cultures.budget import Account, Budget
from animat.cultures.devices.cl1 import CL1_PULSE, CL1Culture
from animat.cultures.devices.maxone import MaxOneCulture
from animat.cultures.observed import Observed, Spikes, with_rests
from animat.errors import BudgetSpent, InvalidArgument, UnsafeStimulus
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.responses.condition import RESTING, Condition
from animat.responses.conditions import ByElectrode, ByPattern
from animat.responses.extraction import extract_responses
from animat.responses.inspection import inspect_recording
from animat.robots import Navigation
from animat.stimulation.places import NONE, check_places
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import BALANCED_PULSE, PUBLISHED_PULSE, Pulse
from animat.stimulation.stimulus import NOTHING, Stimulus
from cultures import small_culture
from fake_culture import FakeCulture
from test_loop_on_devices import selection

REST = Stimulus(0.01, (), PUBLISHED_PULSE, 20.0, NOTHING, 0)
PULSE = Stimulus(0.06, (100, 102), PUBLISHED_PULSE, 20.0, -1, 1)


def culture_pulse(culture: Culture) -> Pulse:
    return BALANCED_PULSE if isinstance(culture, MaxOneCulture) else PUBLISHED_PULSE


def recorded(culture: Culture, *places: tuple[int, ...] | str, pulses: int = 1) -> Recording:
    pulse = culture_pulse(culture)
    given = {"places": places, "trials": 12, "setup_s": 0.0, "pause_s": 0.1, "pulses": pulses, "pulse": pulse}
    with culture:
        recording = culture.record(Protocol((20.0,), "mixed", **given), seed=3)  # type: ignore[arg-type]
        assert culture.delivered == 12 * pulses * sum(place != NONE for place in places)
    return recording


def test_places_may_be_none_once() -> None:
    assert check_places(["none", [3, 1]]) == (NONE, (1, 3))
    protocol = Protocol(places=[NONE, [1]])  # type: ignore[arg-type]
    assert Protocol.from_json(protocol.to_json()) == protocol and protocol.n_places == 2
    for wrong in (["none", "none", [1]], ["None"], [[]], ["none", []], ["none", [-2]]):
        with pytest.raises(InvalidArgument, match=r'^places: expected .*"none"|each once'):
            check_places(wrong)


def test_a_rest_is_explicit_and_not_a_set_that_is_empty_by_mistake() -> None:
    with pytest.raises(InvalidArgument, match="electrodes: expected none where nothing is delivered, got"):
        replace(REST, electrodes=(1,))
    with FakeCulture() as culture:
        with pytest.raises(UnsafeStimulus, match="expected 1 to 32 electrodes, got 0"):
            culture.deliver([replace(REST, pattern=-1)], 0.1)
        for times_s in ((0.06, 0.01), (-0.01, 0.06), (float("nan"), 0.06)):
            with pytest.raises(InvalidArgument, match=r"stimuli: expected times (from 0 s in ascending order|before)"):
                culture.deliver([replace(each, time_s=t) for each, t in zip((REST, PULSE), times_s, strict=True)], 0.1)
        assert culture.delivered == 0


def test_a_culture_given_only_rests_is_undisturbed() -> None:
    """The virtual culture's spikes are exactly those of a culture that was left alone for the same time."""
    recording = recorded(small_culture(), NONE)
    assert len(recording.stimuli) == 12 and np.all(recording.stimuli.is_rest)
    with small_culture() as alone:
        spikes = alone.advance(recording.duration_s)
        assert alone.delivered == 0
    kept = spikes.time_s < recording.duration_s
    np.testing.assert_allclose(recording.spike_times_s, spikes.time_s[kept], atol=5e-5)
    assert sorted(recording.spike_channels.tolist()) == sorted(spikes.channel[kept].tolist())


@pytest.mark.parametrize("pulses", [1, 3])
def test_rests_are_recorded_sorted_and_read_as_other_trials(pulses: int, tmp_path: Path) -> None:
    culture = small_culture()
    with culture:
        sites = culture.stimulation_electrodes
    recording = recorded(culture, NONE, sites[:1], sites[2:5], pulses=pulses)
    write_nwb(recording, tmp_path / "rests.nwb")
    read = read_recording(tmp_path / "rests.nwb")
    assert read.stimuli.is_rest.sum() == 12 * pulses
    for name in ("time_s", "pattern", "electrodes", "presentation", "frequency_hz"):
        np.testing.assert_array_equal(getattr(read.stimuli, name), getattr(recording.stimuli, name))
    # Every pulse, delivered or not, is 1/f after the one before it.
    np.testing.assert_allclose(np.diff(read.stimuli.time_s), 1 / 20, atol=6e-5)
    assigned = ByElectrode().assign(read.stimuli)
    assert [each.electrodes for each in assigned.conditions] == [RESTING, (sites[:1],), (sites[2:5],)]
    assert assigned.conditions[0].label == "no electrode"
    assert not any(each.only_last for each in assigned.conditions)
    responses = extract_responses(read, burst_threshold=1.0)
    assert responses.by == "electrode" and np.bincount(responses.condition).tolist() == [12, 12, 12]
    assert ByPattern().assign(read.stimuli).conditions == ()
    # As policies keep them.
    encoder = Encoder(responses.conditions, pulses)
    assert encoder.electrodes == tuple(sorted((sites[0], *sites[2:5])))
    dealt = Dealer(encoder, np.array([[7, 8]]), np.random.default_rng(1)).targets(0)
    assert [tuple(each) for each in dealt] == [((), NOTHING)] * pulses


@pytest.mark.parametrize("places", [["none", []], ["none", "none"], ["nothing"]])
def test_places_that_are_empty_or_twice_the_same_are_refused(places: list[Any]) -> None:
    with pytest.raises(InvalidArgument, match=r"^places: expected"):
        check_places(places)


def test_a_protocol_of_rests_alone_is_recorded_with_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    culture = small_culture()
    with culture:
        sites = culture.stimulation_electrodes
    write_nwb(recorded(culture, NONE, sites[:1]), tmp_path / "some.nwb")
    (tmp_path / "none.json").write_text('{"frequencies_hz": [20], "trials": 12, "places": ["none"]}')
    (tmp_path / "places.json").write_text('["none"]')
    given = ["record", "--culture", "replay", "--recordings", str(tmp_path / "some.nwb"), "--sessions", "1"]
    for option, name in (("--protocol", "none.json"), ("--places", "places.json")):
        assert main([*given, option, str(tmp_path / name), "--out", str(tmp_path / f"of {name}")]) == 0
        said = capsys.readouterr().err.splitlines()
        assert [line for line in said if line.startswith('warning: the only place is "none", so nothing is ever')]
    # What is made of it says so, and is refused.
    assert main(["inspect", str(tmp_path / "of none.json")]) == 1
    assert "  refuse   dead-window: nothing was delivered: all 12 stimuli are rests" in capsys.readouterr().out
    protocol = Protocol(places=("none", (1, 2)))
    assert not protocol.is_rest and not Protocol().is_rest and Protocol(places=("none",)).is_rest


def test_after_an_emergency_stop_there_is_no_rest_either() -> None:
    with FakeCulture() as culture:
        culture.deliver([REST], 0.1)
        culture.stop("seen enough")
        with pytest.raises(UnsafeStimulus, match="an emergency stop is in force"):
            culture.deliver([REST], 0.1)
        # Looking on is no stimulation.
        culture.deliver([], 0.1)


def test_a_rest_after_a_stimulus_does_not_come_too_close() -> None:
    recording = recorded(FakeCulture(), (100, 102), NONE)
    followed = np.append(~recording.stimuli.is_rest[1:], False)
    # Trials are 50 ms apart.
    found = {finding.name: finding for finding in extract_responses(recording, window_ms=(2.0, 60.0)).findings}
    assert found["stimuli-too-close"].value == np.count_nonzero(followed) < len(recording.stimuli) - 1


def test_stimuli_on_unknown_electrodes_are_not_rests() -> None:
    recording = recorded(small_culture(), NONE)
    unknown = replace(recording.stimuli, pattern=np.full(12, -1))
    assert not np.any(unknown.is_rest) and ByElectrode().assign(unknown).conditions == ()


def test_a_budget_counts_what_is_delivered() -> None:
    account = Account(Budget(pulses=1))
    for _ in range(3):
        account.check([REST])
        account.spend([REST])
    account.spend([REST, PULSE])
    assert (account.pulses, account.most_on_an_electrode) == (1, 1)
    with pytest.raises(BudgetSpent, match="1 of 1 pulses are spent, and 1 more was wanted"):
        account.check([REST, PULSE])
    account.take_back([REST, PULSE])
    assert account.pulses == 0


@given(
    kinds=st.lists(st.booleans(), min_size=1, max_size=12),
    late_ms=st.floats(0, 4),
    begun_late_ms=st.floats(0, 3),
)
def test_rests_are_as_late_as_what_was_delivered_before_them(
    kinds: list[bool], late_ms: float, begun_late_ms: float
) -> None:
    stimuli = [replace(REST if rests else PULSE, time_s=0.01 + 0.05 * i) for i, rests in enumerate(kinds)]
    asked_s = np.array([each.time_s for each in stimuli])
    start_s = 5.0 + 1e-3 * begun_late_ms
    delivered_s = (5.0 + asked_s + 1e-3 * late_ms - start_s)[[not rests for rests in kinds]]
    seen = with_rests(Observed(start_s, 1.0, Spikes(np.empty(0), np.empty(0, int)), delivered_s), stimuli, 5.0)
    late_s = seen.stimulus_time_s + start_s - 5.0 - asked_s
    first = kinds.index(False) if False in kinds else len(kinds)
    np.testing.assert_allclose(late_s, [0.0] * first + [1e-3 * late_ms] * (len(kinds) - first), atol=1e-12)
    np.testing.assert_array_equal(seen.stimulus_time_s[[not rests for rests in kinds]], delivered_s)


def loop_of(electrodes: tuple[int, ...], pulse: Pulse, pulses: int) -> Loop:
    conditions = (
        Condition("no electrode", 0.0, "", (20.0,), RESTING),
        Condition("some", 1.0, "", (20.0,), (electrodes,)),
    )
    given: dict[str, Any] = {"robot": Navigation(episode_limit=20), "mapping": Thresholds(9), "pulse": pulse}
    percentiles = np.linspace(0.0, 125.0, 11)
    return Loop(conditions=conditions, percentiles=percentiles, pulses=pulses, pause_s=0.1, warm_up=1, **given)


@pytest.mark.parametrize("pulses", [1, 2])
def test_in_a_closed_loop_a_rest_is_a_trial_without_a_pulse(pulses: int, tmp_path: Path) -> None:
    loop, account = loop_of((101, 103, 105), PUBLISHED_PULSE, pulses), Account()
    agents = [Agent("any", "", AnyCondition(2)), Agent("none", "", AnyCondition(2), "silent")]
    with FakeCulture() as culture:
        session = run_session(culture, loop, agents, tmp_path, episodes=2, seed=4, account=account)
        assert session.ending.by == "plan", session.ending
        given = [tick for tick in session.ticks if tick.delivered == 1 and tick.agent == "any"]
        rested = [tick for tick in session.ticks if tick.delivered == 0 and tick.agent == "any"]
        assert given and rested
        assert culture.pulses == account.pulses == pulses * len(given) == account.most_on_an_electrode
    assert all(tick.patterns == (NOTHING,) * pulses and len(tick.pulse_time_s) == pulses for tick in rested)
    assert sum(episode.pulses for episode in session.episodes) == account.pulses
    assert all(tick.command is not None for tick in rested if tick.handled != "warm-up")
    # The session is a recording in which rests are rests, read as the loop read them.
    recording = read_recording(session.recording_file)
    assert recording.stimuli.is_rest.sum() == pulses * len(rested)
    responses = extract_responses(recording, ByElectrode(), burst_threshold=1.0)
    ticks = [tick for tick in session.ticks if tick.agent == "any"]
    np.testing.assert_array_equal(responses.rate_hz, [tick.rate_hz for tick in ticks])
    np.testing.assert_array_equal(responses.condition, [tick.delivered for tick in ticks])
    np.testing.assert_array_equal(responses.time_s, [tick.read_after_s for tick in ticks])
    table = session.ticks_file.read_bytes()
    session.recording_file.unlink()
    recover_session(tmp_path)
    assert read_recording(session.recording_file).equals(recording) and session.ticks_file.read_bytes() == table


def test_no_rest_is_sent_to_a_cl1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    neurons = stand_in_cl.install(monkeypatch)
    with CL1Culture() as culture:
        run_session(culture, loop_of((1, 20, 40), CL1_PULSE, 2), [Agent("any", "", AnyCondition(2))], tmp_path)
    session = read_session(tmp_path)
    assert session.ending.by == "plan", session.ending.message
    n = sum(tick.delivered for tick in session.ticks)
    assert 0 < n < len(list(session.ticks)) and len(neurons.pulses) == 2 * 3 * n


def test_no_rest_is_sent_to_a_maxone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = stand_in_maxlab.install(monkeypatch)
    picked = selection()
    sites = tuple(picked.stimulation[[0, 9, 31]].tolist())
    culture = MaxOneCulture(picked, stream=stand_in_maxlab.Stream(rig), settle=False)
    recording = recorded(culture, NONE, sites)
    assert recording.stimuli.is_rest.sum() == 12 and len(rig.delivered) == 3 * 12
    with culture:
        run_session(culture, loop_of(sites, BALANCED_PULSE, 1), [Agent("any", "", AnyCondition(2))], tmp_path)
    session = read_session(tmp_path)
    assert session.ending.by == "plan", session.ending.message
    assert len(rig.delivered) == 3 * (12 + sum(tick.delivered for tick in session.ticks))


def test_inspection_and_plan_count_what_is_delivered() -> None:
    culture = small_culture()
    with culture:
        sites = culture.stimulation_electrodes[:8]
    recording = recorded(culture, NONE, sites)
    inspection = inspect_recording(recording)
    assert (inspection.n_stimuli, inspection.n_trials) == (12, 24)
    times_s = recording.stimuli.time_s[~recording.stimuli.is_rest]
    spikes_s = recording.spike_times_s
    counts = [np.count_nonzero((spikes_s >= t + 0.002) & (spikes_s < t + 0.01)) for t in times_s]
    assert inspection.mean_spikes_per_stimulus == pytest.approx(np.mean(counts), abs=0.2)
    plan = _plan(Protocol((20.0,), "mixed", trials=12, places=(NONE, (1, 2))), 1, 10.0)
    assert "with 12 stimuli each" in plan
