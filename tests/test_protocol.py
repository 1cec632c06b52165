"""Protocols and their schedules: the method's numbers by hand, and properties over all settings."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from animat.errors import InvalidArgument, InvalidFile
from animat.stimulation.protocol import CLOSED_LOOP, PAPER, Presentation, Protocol, read_protocol
from animat.stimulation.pulse import BALANCED_PULSE, PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.schedule import make_schedule

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


def test_the_closed_loops_protocol_presents_as_often_as_a_memory_needs() -> None:
    assert CLOSED_LOOP.presentation == Presentation("mixed", 1)
    (block,) = make_schedule(CLOSED_LOOP, PATTERNS, seed=1).blocks
    frequency_hz = block.stimuli.frequency_hz
    assert [int(np.sum(frequency_hz == f)) for f in (5, 10, 20, 40, 80)] == [1000] * 5
    # Each of 100 patterns ten times at each frequency.
    pairs, often = np.unique(np.stack([frequency_hz, block.stimuli.pattern]), axis=1, return_counts=True)
    assert pairs.shape == (2, 500)
    assert set(often.tolist()) == {10}


def test_five_pulses_are_of_one_frequency_and_the_last_is_read() -> None:
    schedule = make_schedule(Protocol(order="mixed", pulses=5), PATTERNS, seed=1)
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


# Frequencies that differ by rounding only are the same.
frequencies_hz = st.lists(st.floats(0.5, 200), min_size=1, max_size=4).filter(
    lambda values_hz: all(high > 1.00001 * low for low, high in pairwise(sorted(values_hz)))
)
protocols = st.builds(
    Protocol,
    frequencies_hz=frequencies_hz.map(tuple),
    order=st.sampled_from(["blocked", "mixed"]),
    pulses=st.integers(1, 4),
    patterns=st.integers(1, 6),
    trials=st.integers(1, 9),
    setup_s=st.floats(0, 5),
    pause_s=st.floats(0, 5),
    tail_s=st.floats(50e-6, 1),
    pulse=st.sampled_from([PUBLISHED_PULSE, BALANCED_PULSE]),
)


@settings(max_examples=60, deadline=None)
@given(protocols, st.integers(0, 2**32))
def test_a_schedule_does_what_its_protocol_says(protocol: Protocol, seed: int) -> None:
    schedule = make_schedule(protocol, PATTERNS, seed)
    assert Protocol.from_json(protocol.to_json()) == protocol
    assert len(schedule) == len(protocol.frequencies_hz) * protocol.trials * protocol.pulses
    assert len(schedule.blocks) == (len(protocol.frequencies_hz) if protocol.order == "blocked" else 1)
    read: dict[float, list[int]] = {f: [] for f in protocol.frequencies_hz}
    presentations = []
    for block in schedule.blocks:
        stimuli = block.stimuli
        # On the 50 us grid, within the block, 1/f apart.
        np.testing.assert_allclose(stimuli.time_s * 20_000, np.rint(stimuli.time_s * 20_000), atol=1e-6)
        assert block.setup_s == protocol.setup_s
        assert stimuli.time_s[0] == pytest.approx(protocol.pause_s, abs=51e-6)
        # A delivery takes stimuli before its end only.
        assert stimuli.time_s[-1] < block.duration_s
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
    schedule = make_schedule(Protocol(patterns=1, trials=10, pulses=3), PATTERNS, 0)
    assert all(np.all(block.stimuli.pattern == 0) for block in schedule.blocks)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"frequencies_hz": ()}, "frequencies_hz: expected at least 1"),
        ({"frequencies_hz": (5, 5)}, "frequencies_hz: expected each once"),
        ({"frequencies_hz": (5, 5.000001)}, "frequencies_hz: expected each once, got 5, 5.000001"),
        ({"frequencies_hz": (5, 5000)}, "frequencies_hz: expected at most 1111 Hz, as a pulse lasts 900 us, got 5"),
        ({"frequencies_hz": (0,)}, "frequencies_hz: expected more than 0, got 0"),
        ({"order": "shuffled"}, "order: expected 'blocked' or 'mixed'"),
        ({"pulses": 0}, "pulses: expected at least 1"),
        ({"patterns": 0}, "patterns: expected at least 1"),
        ({"trials": 0}, "trials: expected at least 1"),
        ({"pause_s": float("nan")}, "pause_s: expected a finite number"),
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


def test_a_protocol_with_more_pulses_than_a_recording_can_have_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="pulses: expected at most 10,000,000"):
        Protocol(pulses=10**12)
    # Two frequencies, four places and 125 trials of 10,000 pulses are as many as can be.
    most: dict[str, Any] = {"frequencies_hz": (1000, 500), "places": "corners", "trials": 125}
    assert Protocol(**most, pulses=10_000).n_places == 4
    with pytest.raises(InvalidArgument, match=r"pulses: expected at most 10,000,000 .*, got 10,001,000$"):
        Protocol(**most, pulses=10_001)


def test_a_protocol_of_more_than_a_week_is_refused() -> None:
    # 403,200 s at 1 Hz, and half of that at 2 Hz.
    assert Protocol(frequencies_hz=(1, 2), trials=403_200).trials == 403_200
    with pytest.raises(InvalidArgument, match=r"expected stimuli of at most a week \(604,800 s\) .*, got 6.05e\+05 s"):
        Protocol(frequencies_hz=(1, 2), trials=403_201)


# --- as JSON ----------------------------------------------------------------------------------------------------------

PHASE = {"duration_us": 200, "amplitude_ua": -1}

NOT_PROTOCOLS = {
    "": "protocol: expected JSON, got malformed text: Expecting value: line 1 column 1",
    '{"pulses": 1': "protocol: expected JSON, got malformed text: Expecting ',' delimiter: line 1 column 13",
    "[5, 10]": "protocol: expected what Protocol.to_json writes",
    "[" * 100_000: "protocol: expected JSON, got malformed text: maximum recursion depth exceeded",
    '{"pulse_s": 1}': "pulse_s: no such setting at the top; expected some of frequencies_hz",
    '{"self": 1}': "self: no such setting at the top",
    '{"pulses": 1, "pulses": 2}': "protocol: expected each name once, got pulses twice",
    '{"pulses": 0}': "pulses: expected at least 1",
    '{"pulses": 2.5}': "pulses: expected a whole number, got 2.5",
    '{"pulses": true}': "pulses: expected a whole number, got True",
    '{"patterns": "20"}': "patterns: expected a whole number, got '20'",
    '{"trials": 0}': "trials: expected at least 1",
    '{"order": "shuffled"}': "order: expected 'blocked' or 'mixed'",
    '{"order": ["mixed"]}': "order: expected 'blocked' or 'mixed'",
    '{"frequencies_hz": 5}': "frequencies_hz: expected a list, got 5",
    '{"frequencies_hz": "5"}': "frequencies_hz: expected a list",
    '{"frequencies_hz": [5, "10"]}': "frequencies_hz: expected a number, got '10'",
    '{"frequencies_hz": [5, 5]}': "frequencies_hz: expected each once",
    '{"frequencies_hz": [1' + "0" * 400 + "]}": "frequencies_hz: expected a number",
    '{"frequencies_hz": [NaN]}': "frequencies_hz: expected a finite number",
    '{"pause_s": null}': "pause_s: expected a number, got None",
    '{"pause_s": Infinity}': "pause_s: expected a finite number",
    '{"setup_s": 1e6}': "setup_s: expected at most 86,400",
    '{"tail_s": -1}': "tail_s: expected at least 5e-05",
    '{"tail_s": 0}': "tail_s: expected at least 5e-05, got 0",
    '{"pulse": []}': "pulse.phases: expected at least 1",
    '{"pulse": {"duration_us": 1}}': "pulse.phases: expected a list, got {'duration_us': 1}",
    '{"pulse": [{"duration_us": 200}]}': "pulse.phases.amplitude: expected either amplitude_mv or amplitude_ua",
    '{"pulse": [{"duration_us": "200", "amplitude_ua": 1}]}': "pulse.phases.duration_us: expected a number, got '200'",
    '{"pulse": [{"duration": 200, "amplitude_ua": 1}]}': "pulse.phases.duration_us: expected to be given",
}


@pytest.mark.parametrize("text", NOT_PROTOCOLS, ids=[text[:40] for text in NOT_PROTOCOLS])
def test_what_is_no_protocol_is_refused_and_a_file_of_it_is_named(text: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match=NOT_PROTOCOLS[text]):
        Protocol.from_json(text, PAPER)
    with pytest.raises(InvalidArgument):
        Protocol.from_json(text)
    file = tmp_path / "mine.json"
    file.write_text(text)
    with pytest.raises(InvalidFile, match=rf"mine\.json: {NOT_PROTOCOLS[text]}"):
        read_protocol(file)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidFile, match=r"nothing\.json: no such file"):
        read_protocol(tmp_path / "nothing.json")
    for name, words in (("", "expected a file, got a folder"), ("binary.json", "expected text in UTF-8")):
        with pytest.raises(InvalidFile, match=words):
            read_protocol(tmp_path / name)


def test_without_a_pulse_it_is_not_known_what_a_recording_was_made_with() -> None:
    with pytest.raises(InvalidArgument, match="with a pulse"):
        Protocol.from_json('{"pulses": 5}')


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(protocol=protocols)
def test_a_file_holds_a_protocol(protocol: Protocol, tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text(protocol.to_json())
    assert read_protocol(tmp_path / "mine.json", CLOSED_LOOP) == protocol


def test_what_a_file_leaves_out_is_usual_and_whole_numbers_are_numbers(tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text(json.dumps({"frequencies_hz": [5, 20], "pause_s": 3, "pulse": [PHASE]}))
    found = read_protocol(tmp_path / "mine.json", CLOSED_LOOP)
    pulse = Pulse((Phase(200.0, amplitude_ua=-1.0),))
    same = replace(CLOSED_LOOP, frequencies_hz=(5.0, 20.0), pause_s=3.0, pulse=pulse)
    # As text too, which is how a series knows its own protocol again.
    assert (found, found.to_json()) == (same, same.to_json())
    (tmp_path / "mine.json").write_text("{}")
    assert read_protocol(tmp_path / "mine.json") == PAPER
