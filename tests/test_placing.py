"""Recordings without a culture's clock are placed by their dates."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from animat.cli import main
from animat.errors import InvalidFile
from animat.recordings.conversion import Origin, convert_recording
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.placing import placed_by_date
from animat.recordings.reading import read_recordings
from animat.recordings.recorded_culture import RecordedCulture
from synthetic_recordings import synthetic_recording


@pytest.mark.oracle
def test_recordings_of_rigs_are_placed_by_their_dates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second, undated = (tmp_path / f"{name}.nwb" for name in ("z", "a", "undated"))
    recording = synthetic_recording(1, patterns=20, channels=32)
    write_nwb(recording, undated)
    convert_recording(undated, first, Origin(recorded_at="2024-05-31T14:00:00+09:00"))
    convert_recording(undated, second, Origin(recorded_at="2024-05-31T06:12:30Z"))
    read = read_recordings([second, first])
    assert [each.start_min for each in read] == [0.0, 72.5]
    note = "some recordings start at the same minute, so all are placed by their dates: at 0 min, 72.5 min"
    assert all([(f.name, f.message) for f in each.findings[-1:]] == [("placed-by-date", note)] for each in read)
    # One alone, and those whose starts differ, stay where they are.
    assert read_recordings(second)[0].start_min == 0.0 and read_recordings(second)[0].findings == recording.findings
    later = tmp_path / "later.nwb"
    convert_recording(undated, later, Origin(recorded_at="2024-05-31T06:12:30Z"), start_min=10.0)
    assert [each.start_min for each in read_recordings([first, later])] == [0.0, 10.0]
    # A start that was stated is not replaced, nor is one recording made of two.
    for others in ([first, undated], [first, second, later]):
        with pytest.raises(InvalidFile, match=r"both start at 0 min; .* or with their dates and no starts"):
            read_recordings(others)
    with pytest.raises(InvalidFile, match=r"z\.nwb: expected each recording once, got it twice"):
        read_recordings([first, first])
    # The clock of a device starts with each program.
    device = RecordedCulture("maxone")
    days = [(0.0, 9), (10.0, 10), (0.0, 33)]
    series = [
        replace(
            recording, start_min=at, culture=device, recorded_at=datetime(2024, 5, 1, tzinfo=UTC) + timedelta(hours=h)
        )
        for at, h in days
    ]
    assert [each.start_min for each in placed_by_date(series)] == [0.0, 60.0, 1440.0]
    assert main(["inspect", str(first), str(second), "--out", str(tmp_path / "figures"), "--json"]) == 0
    *printed, last = capsys.readouterr().out.splitlines()
    assert f"  note     placed-by-date: {note}" in printed
    assert "  z.nwb from 0 min, a.nwb from 72.5 min" in printed
    inspected = json.loads(last)
    assert [finding["name"] for finding in inspected["together"]] == ["placed-by-date"]
    assert [each["start_min"] for each in inspected["recordings"]] == [0.0, 72.5]
    assert [Path(figure).name for figure in inspected["figures"]][-1] == "series-drift.png"


def test_a_devices_clock_that_was_restarted_is_known_by_the_dates() -> None:
    recording = synthetic_recording(1, patterns=20, channels=32)

    def of(kind: str, *starts: tuple[float, float]) -> list[float]:
        day = datetime(2024, 5, 1, tzinfo=UTC)
        series = [
            replace(recording, start_min=at, culture=RecordedCulture(kind), recorded_at=day + timedelta(minutes=date))
            for at, date in starts
        ]
        return [each.start_min for each in placed_by_date(series)]

    # Two days, on each of which the clock began anew, as a program did.
    days = (0.0002, 0.0), (10.0004, 10.0), (0.0003, 1440.0), (10.0005, 1450.0)
    assert of("maxone", *days) == [0.0, 10.0, 1440.0, 1450.0]
    assert of("maxone", (600.0, 0.0), (5.0, 1440.0)) == [0.0, 1440.0]
    # One clock, read with a little delay; and a simulator's, on which more time passes than here.
    for kind, starts in (("maxone", ((0.0, 0.0), (10.1, 10.6))), ("cl1", ((0.0, 0.0), (10.0, 1.0)))):
        assert of(kind, *starts) == [at for at, _ in starts]
    # Minutes of a file of a rig were stated.
    assert of("recording", (1.0, 0.0), (2.0, 1440.0)) == [1.0, 2.0]
