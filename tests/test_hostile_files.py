"""Files made to hang or crash a reader: protocols, selections, checkpoints. Each is refused in one line, in time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.errors import InvalidFile
from animat.progress import Silent
from animat.stimulation.protocol import read_protocol
from animat.stimulation.selection import Selection
from animat.training.group import Group
from test_training import SHORT, timeline_of, train_group

SELECTION: dict[str, Any] = {
    "format": "animat electrode selection 1",
    "array": {"name": "a", "columns": 220, "rows": 120, "pitch_um": 17.5, "channels": 1024, "stimulation_units": 32},
    "rule": {},
    "seed": 0,
    "scanned": 0,
    "passed": 0,
    "stimulation": [1, 2],
    "patterns": [[1, 2]],
    "recording": [1, 2, 3],
}


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"trials": ' + "9" * 4000 + "}",
        '{"trials": ' + "9" * 5000 + "}",
        '{"frequencies_hz": [1e-300]}',
        '{"order": []}',
        '{"pulses": 1e400}',
        " " * 2**21,
    ],
    ids=["nested", "digits", "more digits", "slow", "a list", "infinite", "long"],
)
def test_invalid_protocols_are_refused_in_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(InvalidFile, match=r"p\.json: ") as raised:
        read_protocol(tmp_path / "p.json")
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 400


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"array": SELECTION["array"] | {"columns": 10**30}}, "array.columns: expected at most 1,000,000"),
        ({"array": SELECTION["array"] | {"pitch_um": "a"}}, "array.pitch_um: expected a number"),
        ({"recording": ["1", "2"]}, "selection.recording: expected a whole number, got '1'"),
        ({"recording": [1.5]}, "selection.recording: expected a whole number, got 1.5"),
        ({"recording": [10**30]}, "selection.recording: expected at most"),
        ({"recording": {}}, "selection.recording: expected a list"),
        ({"patterns": [[1], [1, 2]]}, "selection.patterns: expected the same number of electrodes in each"),
        ({"rule": {"spacing_um": "a"}}, "selection.rule.spacing_um: expected a number"),
        ({"seed": 1.5}, "expected a whole number, got 1.5"),
    ],
)
def test_invalid_selections_are_refused_in_one_line(changed: dict[str, Any], words: str, tmp_path: Path) -> None:
    (tmp_path / "s.json").write_text(json.dumps(SELECTION))
    assert len(Selection.load(tmp_path / "s.json").recording) == 3
    (tmp_path / "s.json").write_text(json.dumps(SELECTION | changed))
    with pytest.raises(InvalidFile, match=words):
        Selection.load(tmp_path / "s.json")
    (tmp_path / "s.json").write_text("[" * 100_000)
    with pytest.raises(InvalidFile, match=r"s.json: selection: expected JSON, got malformed text: maximum recursion"):
        Selection.load(tmp_path / "s.json")


@pytest.mark.oracle
def test_a_checkpoint_that_unpacks_to_more_than_one_holds_is_not_read(tmp_path: Path) -> None:
    group = Group(SHORT, (0,), timeline_of(), "f", {})
    np.savez_compressed(tmp_path / "c.npz", fingerprint=np.array("f"), more=np.zeros(2**24))
    with pytest.raises(InvalidFile, match=r"c\.npz: expected a checkpoint of at most .* bytes, got 134,"):
        train_group(group, tmp_path / "c.npz", Silent())
