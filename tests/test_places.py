"""Places: groups of electrodes that are pulsed together, cut by hand, presented as conditions, read from files."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.cli import main
from animat.cli.record import Record
from animat.cultures.series import Series
from animat.errors import InvalidArgument, InvalidFile
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from animat.responses.condition import Condition, abbreviated, electrodes_label
from animat.responses.conditions import ByElectrode, conditions_named
from animat.responses.extraction import extract_responses
from animat.responses.inspection import inspect_recording
from animat.stimulation.places import check_places, count_places, electrodes_of, read_places
from animat.stimulation.protocol import Protocol
from animat.stimulation.schedule import make_schedule
from animat.stimulation.stimulus import Stimuli
from cultures import small_culture

GRID = np.arange(12)
X_UM, Y_UM = 10.0 * (GRID % 4), 10.0 * (GRID // 4)
"""Four columns and three rows, numbered row by row."""
LISTED = ((0, 1), (5, 7), (3, 9, 11))


def test_halves_and_quadrants_are_cut_by_position() -> None:
    left, right = electrodes_of("halves", GRID, X_UM, Y_UM)
    assert (left, right) == ((0, 1, 4, 5, 8, 9), (2, 3, 6, 7, 10, 11))
    assert electrodes_of("quadrants", GRID, X_UM, Y_UM) == ((0, 1, 4), (5, 8, 9), (2, 3, 6), (7, 10, 11))
    assert electrodes_of(LISTED, GRID, X_UM, Y_UM) == LISTED
    with pytest.raises(InvalidArgument, match="positions of 2 stimulation electrodes or more to cut into halves"):
        electrodes_of("halves", GRID, X_UM, np.append(Y_UM[1:], np.nan))
    with pytest.raises(InvalidArgument, match=r"positions of 4 .* got 3 electrodes: list"):
        electrodes_of("quadrants", GRID[:3], X_UM[:3], Y_UM[:3])


@given(st.integers(4, 40), st.sampled_from(["halves", "quadrants"]), st.integers(0, 10**6))
def test_every_electrode_is_in_one_place_and_places_are_as_large(n: int, named: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    electrodes = rng.permutation(100)[:n]
    x_um, y_um = rng.integers(0, 5, n) * 1.0, rng.integers(0, 5, n) * 1.0
    places = electrodes_of(named, electrodes, x_um, y_um)
    assert sorted(e for place in places for e in place) == sorted(electrodes.tolist())
    assert max(map(len, places)) - min(map(len, places)) <= 2
    x_of = dict(zip(electrodes.tolist(), x_um.tolist(), strict=True))
    half = len(places) // 2
    left, right = ([x_of[e] for place in some for e in place] for some in (places[:half], places[half:]))
    assert max(left) <= min(right)


@pytest.mark.parametrize(
    "given_",
    ["thirds", [[1, 2], []], [[1, -2]], [[1.5]], [1, 2], {"left": [1]}, [[True]], [[1, 2], [2, 1]], 3],
)
def test_invalid_places_are_refused_and_their_file_is_named(given_: object, tmp_path: Path) -> None:
    for value in (given_, [np.array([1, 2]), [3]]):
        with pytest.raises(InvalidArgument, match=r"^places: expected"):
            check_places(value)
    file = tmp_path / "places.json"
    file.write_text(json.dumps(given_))
    with pytest.raises(InvalidFile, match=r"places\.json: places: expected"):
        read_places(str(file))
    file.write_text("[]")
    with pytest.raises(InvalidFile, match=r"places\.json: places: expected groups of electrodes .*, got none"):
        read_places(str(file))
    file.write_text("[[1, 2]")
    with pytest.raises(
        InvalidFile,
        match=r"places\.json: places: expected JSON such as .*, got malformed text: .* line 1 column 8",
    ):
        read_places(str(file))
    with pytest.raises(
        InvalidFile, match=r"places: expected halves, .* or a file of groups .*nothing\.json, which is not a file"
    ):
        read_places(str(tmp_path / "nothing.json"))


@pytest.mark.parametrize("order", ["mixed", "blocked"])
def test_every_place_at_every_frequency_is_a_condition(order: str) -> None:
    protocol = Protocol((5.0, 20.0), order, 2, trials=7, places=LISTED)  # type: ignore[arg-type]
    assert Protocol.from_json(protocol.to_json()) == protocol
    # The second place is the third of the culture's patterns.
    patterns = np.array([[0, 2, -1], [3, 9, 0], [7, 5, -1]])
    schedule = make_schedule(protocol, patterns, 3, places=LISTED)
    assert len(schedule.blocks) == (6 if order == "blocked" else 1)
    each: Counter[object] = Counter()
    for block in schedule.blocks:
        stimuli = block.stimuli
        sets = [frozenset(row) - {-1} for row in stimuli.electrodes.tolist()]
        assert all(sets[i] == sets[i + 1] for i in range(0, len(sets), 2))
        assert stimuli.pattern.tolist() == [2 if one == {5, 7} else -1 for one in sets]
        # Each pulse comes 1/f after the one before it, as without places.
        np.testing.assert_allclose(np.diff(stimuli.time_s), 1 / stimuli.frequency_hz[1:], atol=6e-5)
        each.update(zip(stimuli.frequency_hz.tolist(), sets, strict=True))
        if order == "blocked":
            assert len({*sets}) == len({*stimuli.frequency_hz.tolist()}) == 1
    assert each == {(hz, frozenset(place)): 14 for hz in (5.0, 20.0) for place in LISTED}
    numbers = np.concatenate([block.stimuli.presentation for block in schedule.blocks])
    assert numbers.tolist() == [i // 2 for i in range(84)]
    with pytest.raises(InvalidArgument, match="places: expected electrodes of 3, got those of 0"):
        make_schedule(protocol, patterns, 3)


def test_in_a_mixed_recording_a_place_may_follow_itself() -> None:
    """As in a closed loop; rounds of all places would never show this."""
    protocol = Protocol((10.0,), "mixed", trials=500, places=LISTED)
    (block,) = make_schedule(protocol, np.zeros((100, 1), np.int64), 0, places=LISTED).blocks
    first = block.stimuli.electrodes[:, 0]
    share = float(np.mean(first[1:] == first[:-1]))
    # A third, with the standard error of 1,500 draws.
    assert share == pytest.approx(1 / 3, abs=4 * (2 / 9 / 1500) ** 0.5)


def test_a_protocol_without_places_is_written_as_before() -> None:
    assert "places" not in json.loads(Protocol().to_json())


def test_halves_of_a_virtual_culture_are_recorded_and_sorted(tmp_path: Path) -> None:
    protocol = Protocol((20.0,), "mixed", trials=3, places="halves", setup_s=0.0, pause_s=0.1)
    with small_culture() as culture:
        recording = culture.record(protocol)
        x_of = dict(zip(culture.channels.electrode.tolist(), culture.channels.x_um.tolist(), strict=True))
        electrodes = set(culture.stimulation_electrodes)
    write_nwb(recording, tmp_path / "halves.nwb")
    left, right = conditions_named("electrode").assign(read_recording(tmp_path / "halves.nwb").stimuli).conditions
    assert left.electrodes and right.electrodes
    (one,), (other,) = sorted((left.electrodes, right.electrodes), key=lambda sets: x_of[sets[0][0]])
    assert {*one, *other} == electrodes and len(one) == len(other)
    assert max(x_of[e] for e in one) <= min(x_of[e] for e in other)


def test_the_command_records_places(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, file = tmp_path / "out", tmp_path / "places.json"
    file.write_text("[[1, 2]")
    assert main(["record", "--places", str(file), "--out", str(out)]) == 1
    assert "places.json: places: expected JSON" in capsys.readouterr().err
    assert not out.exists()


def test_the_command_says_how_to_train_on_places(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("animat.cultures.series.record_series", lambda *_, **__: Series([], []))
    assert main(["record", "--places", "halves"]) == 0
    assert "each place is a condition; --conditions frequency pools the places" in capsys.readouterr().out
    assert main(["record"]) == 0
    assert "--conditions" not in capsys.readouterr().out


@pytest.mark.parametrize(("hz", "by"), [((20.0,), "electrode"), ((5.0, 20.0), "frequency x electrode")])
def test_places_are_the_default_conditions(hz: tuple[float, ...], by: str) -> None:
    protocol = Protocol(hz, "mixed", trials=20, places="halves", setup_s=0.0, pause_s=0.1)
    with small_culture() as culture:
        recording = culture.record(protocol)
    responses = extract_responses(recording, burst_threshold=1.0)
    assert responses.by == by and len(responses.conditions) == 2 * len(hz)
    inspection = inspect_recording(recording, burst_threshold=1.0)
    assert (inspection.responses.by, inspection.by_default) == (by, True)
    assert extract_responses(recording, conditions_named("frequency"), burst_threshold=1.0).by == "frequency"


def test_corners_are_spread_over_the_halves() -> None:
    left, right, both, one = electrodes_of("corners", GRID, X_UM, Y_UM)
    assert (left, right, both, one) == ((0, 1, 4, 5, 8, 9), (2, 3, 6, 7, 10, 11), tuple(GRID.tolist()), (0,))
    # 24 electrodes in a column, as many in another: of each the first, the last, and six between them.
    column = np.arange(48)
    of_many = electrodes_of("corners", column, 1.0 * (column >= 24), 1.0 * (column % 24))
    assert of_many[0] == (0, 3, 7, 10, 13, 16, 20, 23) and of_many[1] == tuple(24 + e for e in of_many[0])
    assert count_places("corners") == 4 == Protocol(places="corners").n_places
    with pytest.raises(InvalidArgument, match=r"positions of 4 stimulation electrodes or more .* corners, got 3"):
        electrodes_of("corners", GRID[:3], X_UM[:3], Y_UM[:3])


@given(st.integers(4, 40), st.integers(0, 10**6))
def test_corners_are_parts_of_the_halves_and_differ(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = rng.permutation(100)[:n], rng.integers(0, 5, n) * 1.0, rng.integers(0, 5, n) * 1.0
    half_left, half_right = electrodes_of("halves", *positions)
    left, right, both, one = corners = electrodes_of("corners", *positions)
    assert set(left) <= set(half_left) and set(right) <= set(half_right)
    assert len(left) == min(8, len(half_left)) and len(right) == min(8, len(half_right))
    assert set(both) == {*left, *right} and set(one) < set(left) and len(set(corners)) == 4


def test_corners_are_recorded_at_one_frequency() -> None:
    protocol = Record(places="corners")._protocol()
    assert (protocol.frequencies_hz, protocol.trials, protocol.order) == ((20.0,), 1000, "mixed")


def test_large_sets_of_electrodes_are_counted_in_labels() -> None:
    small, large, other = (1, 2), (1, 2, 3, 4, 5, 6), (1, 2, 3, 4, 5, 7)
    written = [
        Condition(f"5 Hz, {electrodes_label(one)}", float(i), electrodes=(one,)) for i, one in enumerate((small, large))
    ]
    assert [one.label for one in abbreviated(written)] == ["5 Hz, electrodes 1+2", "5 Hz, 6 electrodes from 1"]
    assert abbreviated(abbreviated(written)) == abbreviated(written)
    alike = [*written, Condition(electrodes_label(other), 2.0, electrodes=(other,))]
    assert abbreviated(alike) == tuple(alike)


def test_a_condition_may_be_more_electrodes_than_a_label_could_list() -> None:
    electrodes = np.stack([10_000 + np.arange(2600), 20_000 + np.arange(2600)])
    every = np.arange(2)
    stimuli = Stimuli(0.5 * every, np.full(2, 5.0), every, electrodes, every)
    labels = [condition.label for condition in ByElectrode().assign(stimuli).conditions]
    assert labels == ["2600 electrodes from 10000", "2600 electrodes from 20000"]
