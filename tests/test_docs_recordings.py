"""The examples of docs/recordings.md run as printed, in order."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from animat.recordings.reading import read_recording, read_source
from animat.recordings.recording import ResponseTable
from synthetic_recordings import write_synthetic_series


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[1] / "docs" / "recordings.md").read_text()
    examples = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(examples) == 8
    monkeypatch.chdir(tmp_path)
    write_synthetic_series(1, "recordings", sessions=2, patterns=5, channels=16)
    names: dict[str, object] = {}
    for example in examples:
        exec(compile(example, "docs/recordings.md", "exec"), names)
    mine = read_recording("mine.nwb")
    assert (len(mine.channels), mine.start_min, mine.stimuli.electrodes.tolist()) == (
        3,
        30.0,
        [[9001, 9320], [9001, -1]],
    )
    table = read_source("counted.npz")
    assert isinstance(table, ResponseTable) and table.window_ms == (5.0, 25.0)
    assert read_recording("monday.nwb").provenance["experimenter"] == "Doe, Jane"
