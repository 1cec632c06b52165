"""The simulated tissue as the CL1's SDK would read it: time cut in any way gives the same frames and spikes."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.cultures.devices import cl1_source
from animat.cultures.devices.cl1 import NO_STIMULATION
from animat.cultures.devices.cl1_source import BEFORE, REAL_TIME_NEURONS, SAMPLES, SimulatedCL1
from animat.errors import DeviceFailed, InvalidArgument


def event(frame: int, channel: int, ua: float = 2.0) -> Any:
    return SimpleNamespace(timestamp=frame, channel=channel, phase_durations_us=(160, 160), phase_currents_uA=(-ua, ua))


STIMULI = [event(frame, channel) for frame in (701, 1503, 2250) for channel in (9, 18, 27)]


def read(pieces: list[int], stimuli: list[Any] = STIMULI) -> tuple[np.ndarray, list[tuple[int, int]], np.ndarray]:
    """Frames, spikes and their waveforms; stimuli are passed as by the SDK, before the frames that they lie in."""
    culture, at, waiting = SimulatedCL1(2, neurons=200), 0, sorted(stimuli, key=lambda e: e.timestamp)
    frames, spikes, shapes = [], [], []
    for piece in pieces:
        due = [e for e in waiting if e.timestamp < at + piece]
        waiting = waiting[len(due) :]
        culture.stimulate(due)
        part, found = culture.read(at, piece)
        assert part.shape == (piece, 64)
        assert part.dtype == np.int16
        assert all(at <= frame < at + piece for frame, _, _ in found)
        frames.append(part)
        spikes += [(frame, channel) for frame, channel, _ in found]
        shapes += [shape for _, _, shape in found]
        at += piece
    return np.concatenate(frames), spikes, np.array(shapes)


WHOLE = 3000
_whole: list[Any] = []


@settings(max_examples=6, deadline=None)
@given(st.lists(st.integers(1, 700), min_size=1, max_size=30))
def test_pieces_do_not_change_what_is_read(pieces: list[int]) -> None:
    if not _whole:
        _whole.append(read([WHOLE]))
    cut: list[int] = []
    while sum(cut) < WHOLE:
        cut.append(min(pieces[len(cut) % len(pieces)], WHOLE - sum(cut)))
    frames, spikes, _ = read(cut)
    assert sorted(spikes) == sorted(_whole[0][1])
    np.testing.assert_array_equal(frames, _whole[0][0])


def test_it_answers_pulses_and_only_cathodic_charge_counts() -> None:
    def answers(stimuli: list[Any]) -> int:
        return len(read([WHOLE], stimuli)[1])

    quiet, loud = answers([]), answers(STIMULI)
    assert loud > quiet
    assert answers([event(701, channel) for channel in NO_STIMULATION]) == quiet
    anodic = SimpleNamespace(timestamp=701, channel=9, phase_durations_us=(160,), phase_currents_uA=(2.0,))
    assert answers([anodic]) == quiet


def test_spikes_are_in_the_frames_on_their_channel_and_ground_is_silent() -> None:
    frames, spikes, shapes = read([WHOLE])
    assert not np.any(frames[:, list(NO_STIMULATION)])
    assert not {channel for _, channel in spikes} & set(NO_STIMULATION)
    assert shapes.shape == (len(spikes), SAMPLES)
    assert np.all(np.argmin(shapes, axis=1) == BEFORE)
    # 60 uV is the smallest spike, five standard deviations of the noise less is below 48 uV, which is 246 units.
    times = np.array(spikes)
    depth = np.array([frames[frame, channel] for frame, channel in spikes])
    alone = [np.count_nonzero((times[:, 1] == c) & (np.abs(times[:, 0] - f) < SAMPLES)) == 1 for f, c in spikes]
    assert np.count_nonzero(alone) > 10
    assert np.all(depth[alone] < -246)


def test_time_only_goes_on_and_may_be_skipped() -> None:
    culture = SimulatedCL1(2, neurons=100)
    culture.read(0, 100)
    frames, spikes = culture.read(5000, 500)
    assert all(5000 <= frame < 5500 for frame, _, _ in spikes)
    assert frames.shape == (500, 64)
    with pytest.raises(InvalidArgument, match="time only moves forward"):
        culture.read(5499, 10)


def test_late_stimuli_act_at_once_and_clash_with_nothing() -> None:
    culture = SimulatedCL1(2, neurons=100)
    culture.read(0, 1000)
    culture.stimulate([event(10, 9), event(10, 18)])
    culture.stimulate([event(1003, 9)])
    culture.read(1000, 500)
    culture.read(1500, 2)


def test_timing_it_leaves_it_where_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    timed, fresh = (SimulatedCL1(2, neurons=100) for _ in range(2))
    passed = iter([10.0, 10.03])
    monkeypatch.setattr(cl1_source.time, "perf_counter", lambda: next(passed))
    assert timed.share_of_real_time() == pytest.approx(0.3)
    frames, spikes = timed.read(0, 1000)
    expected, as_expected = fresh.read(0, 1000)
    np.testing.assert_array_equal(frames, expected)
    assert [spike[:2] for spike in spikes] == [spike[:2] for spike in as_expected]
    with pytest.raises(InvalidArgument, match="got one that was read to frame 1000"):
        timed.share_of_real_time()


@pytest.mark.parametrize(
    ("neurons", "share", "words"),
    [
        (100, 0.69, None),
        (100, 0.71, r"of 100 neurons in real time: .* takes 0.71 s here"),
        (201, 0.1, r"of 201 neurons in real time: .*; 200 neurons leave 30 % .* to spare"),
    ],
)
def test_a_culture_too_large_for_real_time_says_so(
    neurons: int, share: float, words: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    culture = SimulatedCL1(2, neurons=neurons)
    monkeypatch.setattr(culture, "share_of_real_time", lambda: share)
    warning = culture.real_time_warning()
    assert warning is None if words is None else warning is not None and re.search(words, warning)


@pytest.mark.parametrize("bad", [{"pitch_um": 0.0}, {"reach_um": -1.0}, {"charge_nc": float("nan")}])
def test_settings_that_cannot_be_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InvalidArgument, match="expected above 0"):
        SimulatedCL1(1, **bad)  # type: ignore[arg-type]


def test_without_the_sdk_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cl", None)
    with pytest.raises(DeviceFailed, match=r"expected the vendor's package cl-sdk .* pip install"):
        cl1_source.use_simulated_culture(seed=1)


def test_by_default_it_has_as_many_neurons_as_the_page_says() -> None:
    docs = (Path(__file__).parent.parent / "docs" / "hardware.md").read_text()
    assert f"It has {REAL_TIME_NEURONS} neurons by default" in docs
    assert len(SimulatedCL1(1)._sees) == REAL_TIME_NEURONS
