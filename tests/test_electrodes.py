"""Array, scan, selection, patterns. Oracles: manual counts and brute force over all sets."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from animat.errors import InvalidArgument, InvalidFile, UnusableData
from animat.recordings.recording import Channels
from animat.stimulation.array import MAXONE, ElectrodeArray
from animat.stimulation.patterns import draw_patterns
from animat.stimulation.scan import ScannedActivity
from animat.stimulation.selection import Selection, SelectionRule, select_electrodes

SMALL = ElectrodeArray("small", columns=20, rows=10, pitch_um=20.0, channels=60, stimulation_units=16)


def test_the_maxone_has_the_size_stated_in_the_paper() -> None:
    assert len(MAXONE) == 26_400
    x_um, y_um = MAXONE.position_um(np.array([0, 219, 220, 26_399]))
    assert x_um.tolist() == [0.0, 219 * 17.5, 0.0, 219 * 17.5]
    assert y_um.tolist() == [0.0, 0.0, 17.5, 119 * 17.5]
    # From edge to edge of the grid's cells: 3.85 x 2.10 mm.
    assert (MAXONE.columns * MAXONE.pitch_um, MAXONE.rows * MAXONE.pitch_um) == (3850.0, 2100.0)


def test_electrodes_off_the_array_are_refused() -> None:
    with pytest.raises(InvalidArgument, match="expected numbers from 0 to 26399 on the MaxOne, got 26400"):
        MAXONE.position_um(26_400)


def test_scan_blocks_cover_every_electrode_once_in_26_blocks() -> None:
    blocks = MAXONE.scan_blocks()
    assert len(blocks) == math.ceil(26_400 / 1024) == 26
    assert max(map(len, blocks)) <= 1024
    assert np.array_equal(np.concatenate(blocks), np.arange(26_400))


def scanned(array: ElectrodeArray, seed: int = 0, **columns: Any) -> ScannedActivity:
    rng = np.random.default_rng(seed)
    n = len(array)
    return ScannedActivity(
        **(
            {
                "electrode": np.arange(n),
                "rate_hz": rng.uniform(0.1, 5, n),
                "amplitude_uv": rng.uniform(5, 100, n),
                "noise_uv": np.full(n, 2.5),
                "trough_to_peak_ms": rng.uniform(0.2, 0.6, n),
                "recovery_ms": rng.uniform(0.2, 0.6, n),
            }
            | columns
        )
    )


RULE = SelectionRule(recording_sites=40, stimulation_sites=12, patterns=10, pattern_size=3, pattern_spacing_um=60.0)


def test_recording_sites_pass_the_threshold_and_have_the_highest_rates() -> None:
    scan = scanned(SMALL)
    rule = SelectionRule(**(vars(RULE) | {"spacing_um": 0.0, "signal_to_noise": 10.0}))
    selection = select_electrodes(SMALL, scan, rule)
    passing = [e for e in range(len(SMALL)) if scan.amplitude_uv[e] / 2.5 >= 10.0]
    highest = sorted(passing, key=lambda e: -scan.rate_hz[e])[:40]
    assert selection.recording.tolist() == sorted(highest)
    assert (selection.scanned, selection.passed) == (200, len(passing))


def test_with_a_spacing_the_best_neighbour_is_kept() -> None:
    scan = scanned(SMALL)
    ratio = scan.signal_to_noise
    distance_um = SMALL.distance_um(scan.electrode, scan.electrode)
    # Electrodes are 20 um apart: the four nearest, with the diagonal ones, and those within two rows or columns.
    for spacing_um in (20.0, 30.0, 45.0):
        few = {"spacing_um": spacing_um, "signal_to_noise": 4.0, "stimulation_sites": 1, "patterns": 1}
        rule = SelectionRule(**(vars(RULE) | few | {"pattern_size": 1, "recording_sites": 60}))
        selection = select_electrodes(SMALL, scan, rule)
        best = [e for e in range(200) if ratio[e] >= 4 and ratio[e] == ratio[distance_um[e] <= spacing_um].max()]
        assert selection.passed == len(best)
        assert selection.recording.tolist() == best
    tie = scanned(SMALL, amplitude_uv=np.full(200, 50.0))
    # All alike: the first number stays, its neighbours go.
    assert select_electrodes(SMALL, tie, rule).recording.tolist() == [0]


def test_stimulation_sites_are_large_and_look_excitatory() -> None:
    scan = scanned(SMALL)
    selection = select_electrodes(SMALL, scan, SelectionRule(**(vars(RULE) | {"spacing_um": 0.0})))
    worth = scan.amplitude_uv * scan.excitatory_score
    best = sorted(selection.recording.tolist(), key=lambda e: -worth[e])[:12]
    assert selection.stimulation.tolist() == sorted(best)


def test_the_excitatory_score_is_soft() -> None:
    n = len(SMALL)
    times = np.linspace(0.1, 0.7, n)
    score = scanned(SMALL, trough_to_peak_ms=times, recovery_ms=times).excitatory_score
    assert np.all(np.diff(score) > 0)
    assert score[0] < 0.03
    assert score[-1] > 0.97
    assert score[np.argmin(np.abs(times - 0.35))] == pytest.approx(0.5, abs=0.05)
    # 0.1 ms more than 0.35 ms is two of its widths of 0.05 ms, and 0.15 ms one and a half of 0.1 ms.
    longer = scanned(SMALL, trough_to_peak_ms=np.full(n, 0.45), recovery_ms=np.full(n, 0.5))
    np.testing.assert_allclose(longer.excitatory_score, 1 / (1 + math.exp(-(2 + 1.5) / 2)))
    noise_uv = np.resize([0.5, 0.0, 4.0], n)
    quiet = scanned(SMALL, amplitude_uv=np.full(n, 30.0), noise_uv=noise_uv)
    assert quiet.signal_to_noise[:3].tolist() == [60, 0, 7.5]
    silent = scanned(SMALL, amplitude_uv=np.full(n, np.nan), trough_to_peak_ms=np.full(n, np.nan))
    assert not np.any(silent.excitatory_score)
    assert not np.any(silent.signal_to_noise)


@pytest.mark.parametrize("seed", range(3))
def test_patterns_are_different_sets_far_apart(seed: int) -> None:
    electrodes = np.random.default_rng(seed).choice(len(MAXONE), 32, replace=False)
    patterns = draw_patterns(MAXONE, electrodes, seed=seed)
    assert patterns.shape == (100, 5)
    assert len({tuple(pattern) for pattern in patterns.tolist()}) == 100
    assert np.all(np.isin(patterns, electrodes))
    for pattern in patterns:
        for a, b in itertools.combinations(pattern.tolist(), 2):
            (ax, ay), (bx, by) = MAXONE.position_um(a), MAXONE.position_um(b)
            assert math.dist((ax[0], ay[0]), (bx[0], by[0])) > 100.0
    assert np.array_equal(draw_patterns(MAXONE, electrodes, seed=seed), patterns)
    assert not np.array_equal(draw_patterns(MAXONE, electrodes, seed=seed + 1), patterns)


def test_every_possible_pattern_is_found_and_one_more_is_too_many() -> None:
    electrodes = np.array([0, 3, 6, 9, 65, 68, 71])
    position = np.column_stack(SMALL.position_um(electrodes))
    possible = [
        three
        for three in itertools.combinations(range(7), 3)
        if all(math.dist(position[a], position[b]) > 70 for a, b in itertools.combinations(three, 2))
    ]
    wanted = {"size": 3, "spacing_um": 70.0, "seed": 1}
    drawn = draw_patterns(SMALL, electrodes, patterns=len(possible), **wanted)
    assert {tuple(p) for p in drawn.tolist()} == {tuple(electrodes[list(three)].tolist()) for three in possible}
    with pytest.raises(InvalidArgument, match=f"7 electrodes found only {len(possible)}: ask for fewer patterns"):
        draw_patterns(SMALL, electrodes, patterns=len(possible) + 1, **wanted)
    with pytest.raises(InvalidArgument, match="found only 0"):
        draw_patterns(SMALL, electrodes, patterns=1, size=8, spacing_um=1.0, seed=0)


@pytest.mark.oracle
def test_a_draw_that_finds_hardly_any_pattern_ends() -> None:
    far = np.array([220 * 25 * i + 25 * j + 1_000 for i in range(4) for j in range(6)])
    with pytest.raises(InvalidArgument, match="24 electrodes found only 0"):
        draw_patterns(MAXONE, far, size=25, spacing_um=100.0, seed=1)
    with pytest.raises(InvalidArgument, match="24 electrodes found only 24"):
        draw_patterns(MAXONE, far, size=23, spacing_um=100.0, seed=1)
    near = np.array([220 * row + column for row in range(10, 30) for column in range(10, 30)])
    with pytest.raises(InvalidArgument, match="400 electrodes found only 0"):
        draw_patterns(MAXONE, near, size=25, spacing_um=100.0, seed=1, patterns=1)


def test_every_pattern_is_equally_likely() -> None:
    electrodes = np.array([0, 4, 8, 12, 16])
    counts = dict.fromkeys(itertools.combinations(electrodes.tolist(), 2), 0)
    for seed in range(2000):
        counts[tuple(draw_patterns(SMALL, electrodes, patterns=1, size=2, spacing_um=10.0, seed=seed)[0].tolist())] += 1
    assert stats.chisquare(list(counts.values())).pvalue > 1e-3


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ({"recording_sites": 61}, "recording_sites: expected 1 to 60 on the small, got 61"),
        ({"stimulation_sites": 17}, "stimulation_sites: expected 1 to 16 on the small, got 17"),
        ({"signal_to_noise": 39.5}, "lower the ratio or the spacing, scan for longer, or ask for fewer"),
        ({"recording_sites": 5}, r"expected at most as many as recording sites \(5\), got 12"),
        ({"pattern_spacing_um": 500.0}, "ask for fewer patterns, fewer electrodes in each, a shorter distance"),
    ],
)
def test_criteria_that_cannot_be_met_are_refused_with_what_to_relax(rule: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidArgument, match=words):
        select_electrodes(SMALL, scanned(SMALL), SelectionRule(**(vars(RULE) | {"spacing_um": 0.0} | rule)))


def test_a_selection_is_saved_and_read(tmp_path: Path) -> None:
    selection = select_electrodes(SMALL, scanned(SMALL), SelectionRule(**(vars(RULE) | {"spacing_um": 0.0})), seed=3)
    selection.save(tmp_path / "selection.json")
    assert Selection.load(tmp_path / "selection.json") == selection
    assert hash(Selection.load(tmp_path / "selection.json")) == hash(selection)
    # One that stimulates places only has no patterns.
    of_places = Selection(SMALL, selection.recording, selection.stimulation, np.empty((0, 0), np.int64))
    of_places.save(tmp_path / "places.json")
    assert Selection.load(tmp_path / "places.json") == of_places
    channels = Channels.on(SMALL, selection.recording)
    assert channels.electrode.tolist() == selection.recording.tolist()
    assert channels.has_positions
    for content in ("", "[]", "{}", json.dumps({**selection.to_dict(), "format": "other"}), "\x00"):
        (tmp_path / "bad.json").write_text(content)
        with pytest.raises(InvalidFile, match=r"bad.json: selection(\.\w+)?: expected"):
            Selection.load(tmp_path / "bad.json")
    first, second = selection.stimulation[:2].tolist()
    silent = next(electrode for electrode in range(200) if electrode not in selection.stimulation)
    for name, value, words in (
        ("patterns", [[first, silent]], f"selection.patterns: expected stimulation sites only, got electrode {silent}"),
        ("patterns", [[first], [first, second]], "selection.patterns: expected the same number of electrodes in each"),
        ("stimulation", [1, 1], "selection.stimulation: expected each electrode once"),
        ("patterns", [[7, 900]], "electrode: expected numbers from 0 to 199"),
        ("recording", [-5], "selection.recording: expected at least 0"),
        ("rule", {"x": 1}, "x: no such setting in .selection.rule."),
    ):
        (tmp_path / "bad.json").write_text(json.dumps({**selection.to_dict(), name: value}))
        with pytest.raises(InvalidFile, match=rf"bad.json: {words}"):
            Selection.load(tmp_path / "bad.json")
    with pytest.raises(InvalidFile, match="no such file"):
        Selection.load(tmp_path / "none.json")
    with pytest.raises(InvalidArgument, match=r"selection\.recording: expected 1 dimensions, got \(1, 2\)"):
        Selection(SMALL, np.array([[first, silent]]), selection.stimulation, selection.patterns)


def test_an_invalid_scan_is_refused() -> None:
    with pytest.raises(UnusableData, match=r"rate_hz: expected \d+ values in the scan, got shape"):
        scanned(SMALL, rate_hz=np.zeros(3))
    with pytest.raises(UnusableData, match="each electrode once"):
        scanned(SMALL, electrode=np.zeros(200))
    blocks = [scanned(SMALL, electrode=np.arange(200) + 200 * i) for i in range(2)]
    assert len(ScannedActivity.from_blocks(blocks)) == 400
