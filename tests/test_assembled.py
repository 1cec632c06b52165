"""Blocks joined into a recording. Oracle: the times themselves, in whole nanoseconds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.cultures.observed import Observed, Spikes, assemble
from animat.recordings.recording import Channels
from animat.stimulation.protocol import Protocol
from animat.stimulation.schedule import make_schedule

ONE_CHANNEL = Channels(label=np.array(["0"]), electrode=np.array([0]), x_um=np.zeros(1), y_um=np.zeros(1))
PROTOCOL = Protocol((20.0, 40.0, 80.0), patterns=1, trials=2, setup_s=0.0, pause_s=0.1)


@given(
    st.sampled_from([10_000.0, 20_000.0, 24_414.0625, 25_000.0, 30_000.0, 32_000.0]),
    st.lists(st.integers(100_000, 30_000_000), min_size=3, max_size=3),
    st.lists(st.tuples(st.integers(0, 2), st.floats(0, 1, exclude_max=True)), max_size=20),
)
def test_all_that_was_seen_lies_within_and_at_its_sample(
    rate_hz: float, blocks_us: list[int], seen: list[tuple[int, float]]
) -> None:
    ends_ns = np.cumsum([1000 * us for us in blocks_us])
    observed, expected_ns = [], []
    for number, us in enumerate(blocks_us):
        # In the last nanosecond of each block too.
        spikes_ns = sorted([1000 * us - 1, *(int(1000 * us * share) for block, share in seen if block == number)])
        spikes = Spikes(np.array(spikes_ns) / 1e9, np.zeros(len(spikes_ns), np.int64))
        observed.append(Observed(0.0, us / 1e6, spikes, np.array([0.0, 0.5]) * us / 1e6))
        expected_ns += [int(ends_ns[number]) - 1000 * us + ns for ns in spikes_ns]
    recording = assemble(
        make_schedule(PROTOCOL, np.array([[0]]), 0),
        observed,
        channels=ONE_CHANNEL,
        sampling_rate_hz=rate_hz,
        start_min=0.0,
        provenance={},
        culture=None,
    )
    off_s = recording.spike_times_s - np.array(expected_ns) / 1e9
    assert np.all(np.abs(off_s) <= 0.5 / rate_hz + 1e-9)
    assert -1e-9 <= recording.duration_s - ends_ns[-1] / 1e9 < 1 / rate_hz
    assert recording.duration_s * rate_hz == pytest.approx(round(recording.duration_s * rate_hz), abs=1e-4)
