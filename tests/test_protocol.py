"""Protocols and their schedules: the method's numbers by hand, and properties over all settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.errors import InvalidArgument
from animat.recordings.protocol import CLOSED_LOOP, PAPER, Presentation, Protocol
from animat.recordings.schedule import make_schedule
from animat.recordings.stimulus import BALANCED_PULSE, PUBLISHED_PULSE

PATTERNS = np.arange(500).reshape(100, 5)


def test_the_papers_protocol_is_the_papers() -> None:
    schedule = make_schedule(PAPER, PATTERNS, seed=1)
    assert len(schedule) == 500
    assert len(schedule.blocks) == 5
    stimulated_s = 0.0
    for block in schedule.blocks:
        stimuli = block.stimuli
        frequency_hz = stimuli.frequency_hz[0]
        assert np.all(stimuli.frequency_hz == frequency_hz)
        np.testing.assert_allclose(np.diff(stimuli.time_s), 1 / frequency_hz, rtol=0, atol=1e-9)
        assert sorted(stimuli.pattern.tolist()) == list(range(100))
        assert np.array_equal(stimuli.electrodes, PATTERNS[stimuli.pattern])
        stimulated_s += 100 / frequency_hz
    # 100/5 + 100/10 + 100/20 + 100/40 + 100/80 = 38.75 s, about 120 s with set-up.
    assert stimulated_s == 38.75
    assert schedule.duration_s == pytest.approx(120, abs=2)
    assert sorted(block.stimuli.frequency_hz[0] for block in schedule.blocks) == [5, 10, 20, 40, 80]
    orders = {tuple(b.stimuli.frequency_hz[0] for b in make_schedule(PAPER, PATTERNS, s).blocks) for s in range(40)}
    assert len(orders) > 20


def test_the_closed_loops_protocol_mixes_and_reads_the_last_of_five() -> None:
    schedule = make_schedule(CLOSED_LOOP, PATTERNS, seed=1)
    assert CLOSED_LOOP.presentation == Presentation("mixed", 5)
    (block,) = schedule.blocks
    stimuli = block.stimuli
    assert len(schedule) == 2500
    assert np.array_equal(stimuli.presentation, np.repeat(np.arange(500), 5))
    frequency_hz = stimuli.frequency_hz.reshape(500, 5)
    assert np.all(frequency_hz == frequency_hz[:, :1])
    assert [int(np.sum(frequency_hz[:, 0] == f)) for f in (5, 10, 20, 40, 80)] == [100] * 5
    # Mixed: a frequency follows itself about as often as any other.
    assert np.mean(frequency_hz[1:, 0] == frequency_hz[:-1, 0]) == pytest.approx(0.2, abs=0.08)
    # Every pulse comes 1/f of its own presentation after the one before.
    np.testing.assert_allclose(np.diff(stimuli.time_s), 1 / stimuli.frequency_hz[1:], rtol=0, atol=51e-6)
    pattern = stimuli.pattern.reshape(500, 5)
    assert all(len(set(row)) == 5 for row in pattern.tolist())
    for f in (5, 10, 20, 40, 80):
        assert sorted(pattern[frequency_hz[:, 0] == f, -1].tolist()) == list(range(100))


protocols = st.builds(
    Protocol,
    frequencies_hz=st.lists(st.floats(0.5, 200), min_size=1, max_size=4, unique=True).map(tuple),
    order=st.sampled_from(["blocked", "mixed"]),
    pulses=st.integers(1, 4),
    patterns=st.integers(1, 6),
    presentations=st.integers(1, 9),
    setup_s=st.floats(0, 5),
    pause_s=st.floats(0, 5),
    tail_s=st.floats(0, 1),
    pulse=st.sampled_from([PUBLISHED_PULSE, BALANCED_PULSE]),
)


@settings(max_examples=60, deadline=None)
@given(protocols, st.integers(0, 2**32))
def test_a_schedule_does_what_its_protocol_says(protocol: Protocol, seed: int) -> None:
    schedule = make_schedule(protocol, PATTERNS, seed)
    assert Protocol.from_json(protocol.to_json()) == protocol
    assert len(schedule) == len(protocol.frequencies_hz) * protocol.presentations * protocol.pulses
    assert len(schedule.blocks) == (len(protocol.frequencies_hz) if protocol.order == "blocked" else 1)
    read: dict[float, list[int]] = {f: [] for f in protocol.frequencies_hz}
    presentations = []
    for block in schedule.blocks:
        stimuli = block.stimuli
        # On the 50 us grid, within the block, 1/f apart.
        np.testing.assert_allclose(stimuli.time_s * 20_000, np.rint(stimuli.time_s * 20_000), atol=1e-6)
        assert block.setup_s == protocol.setup_s
        assert stimuli.time_s[0] == pytest.approx(protocol.pause_s, abs=51e-6)
        assert block.duration_s == pytest.approx(stimuli.time_s[-1] + protocol.tail_s, abs=51e-6)
        np.testing.assert_allclose(np.diff(stimuli.time_s), 1 / stimuli.frequency_hz[1:], atol=101e-6)
        presentations += stimuli.presentation.tolist()
        for pattern, f in zip(
            stimuli.pattern[stimuli.is_last_of_presentation].tolist(),
            stimuli.frequency_hz[stimuli.is_last_of_presentation].tolist(),
            strict=True,
        ):
            read[f].append(pattern)
        for row in stimuli.pattern.reshape(-1, protocol.pulses).tolist():
            assert len(set(row)) >= min(protocol.pulses, protocol.patterns)
        assert stimuli.pattern.max() < protocol.patterns
        delivered = schedule.deliveries(block)
        assert [d.time_s for d in delivered] == stimuli.time_s.tolist()
        assert all(d.pulse == protocol.pulse for d in delivered)
    expected = np.repeat(np.arange(len(schedule) // protocol.pulses), protocol.pulses)
    assert presentations == expected.tolist()
    for patterns in read.values():
        counts = np.bincount(patterns, minlength=protocol.patterns)
        assert counts.max() - counts.min() <= 1


def test_the_same_seed_is_the_same_schedule() -> None:
    first, again, other = (make_schedule(PAPER, PATTERNS, seed) for seed in (4, 4, 5))
    for a, b in zip(first.blocks, again.blocks, strict=True):
        assert np.array_equal(a.stimuli.pattern, b.stimuli.pattern)
    assert not np.array_equal(first.blocks[0].stimuli.pattern, other.blocks[0].stimuli.pattern)


def test_one_pattern_can_be_repeated() -> None:
    schedule = make_schedule(Protocol(patterns=1, presentations=10, pulses=3), PATTERNS, 0)
    assert all(np.all(block.stimuli.pattern == 0) for block in schedule.blocks)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"frequencies_hz": ()}, "frequencies_hz: expected some"),
        ({"frequencies_hz": (5, 5)}, "frequencies_hz: expected each once"),
        ({"frequencies_hz": (0,)}, "frequencies_hz: expected some, above 0"),
        ({"order": "shuffled"}, "order: expected 'blocked' or 'mixed'"),
        ({"pulses": 0}, "pulses: expected at least 1"),
        ({"patterns": 0}, "patterns: expected 1 to"),
        ({"presentations": 0}, "presentations: expected 1 to"),
        ({"pause_s": float("nan")}, "pause_s: expected finite seconds"),
    ],
)
def test_protocols_that_cannot_be_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidArgument, match=words):
        Protocol(**settings)


def test_a_schedule_needs_the_patterns_that_its_protocol_uses(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match=r"patterns: expected at most the 20 .* got 100: select more"):
        make_schedule(PAPER, PATTERNS[:20], 0)
    with pytest.raises(InvalidArgument, match="seed: expected 0 or more"):
        make_schedule(PAPER, PATTERNS, -1)
    for text in ("", "{}", '{"pulse": []}', PAPER.to_json().replace("pulses", "pulse_s")):
        with pytest.raises(InvalidArgument, match=r"protocol: expected what Protocol.to_json writes|phases: expected"):
            Protocol.from_json(text)
