"""JSON that is nested without end, in any file of a folder, is a line and no traceback."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.errors import InvalidFile
from animat.execution.receipts import Receipt, receipt_path
from animat.execution.task import reported
from animat.folders import read_description
from animat.report.results import Results
from animat.studies.results import read_arrays, read_typed
from animat.tuning.search import JOURNAL, read_journal

NESTED = "[" * 200_000


def receipt(path: Path) -> Any:
    path.rename(receipt_path(path.parent, "job"))
    return Receipt.load(path.parent, "job")


def journal(path: Path) -> Any:
    path.rename(path.parent / JOURNAL)
    return read_journal(path.parent)


@pytest.mark.parametrize(
    "read", [lambda path: read_description(path, "study"), lambda path: read_typed(path, Results), receipt, journal]
)
def test_it_is_a_line(read: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    path.write_text(NESTED)
    with pytest.raises(InvalidFile) as error:
        read(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_what_was_reported_so_is_nothing(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    path.write_text(NESTED)
    assert reported(path) is None


def test_arrays_of_another_kind_are_a_line(tmp_path: Path) -> None:
    np.save(tmp_path / "file.npy", np.zeros(3))
    with pytest.raises(InvalidFile, match="expected arrays of this study"):
        read_arrays(tmp_path / "file.npy")
