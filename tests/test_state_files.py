"""States of a virtual culture made by hand: refused in a line, or gone on from. Oracle: the operating system."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from animat.cultures.tissue import Tissue
from animat.cultures.tissue.parameters import TissueParameters
from animat.cultures.tissue.tissue import MARK_S, Drift
from animat.errors import InvalidArgument, InvalidFile
from cultures import small_culture


def change(folder: Path, every: int) -> tuple[int, int]:
    """In a process of its own: an index that is not checked ends it with signal 11, a clock that is not with 14."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(Path(__file__).parent / "damaging_states.py"), folder, str(every)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([*filter(None, sys.path), str(Path(__file__).parent)])},
    )
    last = (folder / "last").read_text() if (folder / "last").exists() else "before the first file"
    assert done.returncode == 0, f"{last}: status {done.returncode}\n{done.stderr[-3000:]}"
    refused, gone_on = (int(word) for word in done.stdout.split() if word.isdigit())
    return refused, gone_on


@pytest.mark.oracle
def test_a_state_that_was_changed_by_hand_is_refused_or_gone_on_from(tmp_path: Path) -> None:
    refused, gone_on = change(tmp_path, 7)
    assert refused > 100 and gone_on > 5


@pytest.mark.oracle
def test_a_state_that_was_changed_in_every_way_is_refused_or_gone_on_from(tmp_path: Path) -> None:
    refused, gone_on = change(tmp_path, 1)
    assert refused > 1000 and gone_on > 50


def test_an_array_that_does_not_belong_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with small_culture() as culture:
        culture.save_state(tmp_path / "culture.state")
    with np.load(tmp_path / "culture.state") as file:
        np.savez_compressed(tmp_path / "more.npz", **file, more=np.zeros(2**22))
    read: list[str] = []
    load = np.lib.npyio.NpzFile.__getitem__
    monkeypatch.setattr(np.lib.npyio.NpzFile, "__getitem__", lambda self, key: read.append(key) or load(self, key))
    with pytest.raises(InvalidFile, match=r"more\.npz: expected the whole state"):
        small_culture().restore_state(tmp_path / "more.npz")
    assert not read


@pytest.mark.parametrize(
    ("name", "value"), [("arriving_ampa", -1e-12), ("arriving_gaba", -1.0), ("arriving_nmda", 0.1)]
)
def test_arrivals_that_no_spike_brings_are_refused(name: str, value: float) -> None:
    tissue = Tissue(1, TissueParameters(neurons=300))
    snapshot = tissue.snapshot()
    getattr(snapshot.state, name)[3, 7] = value
    with pytest.raises(InvalidArgument, match=rf"^{name}: expected "):
        tissue.restore(snapshot)


def test_the_slow_drift_is_the_recursion_that_is_said() -> None:
    parameters = TissueParameters()
    draws, drift, expected = np.random.default_rng([7, 2]), 0.0, []
    kept = np.exp(-MARK_S / 60 / parameters.drift_min)
    for mark in range(500):
        if mark:
            drift = drift * kept + parameters.drift_share * np.sqrt(1 - kept**2) * draws.standard_normal()
        expected.append(1 + drift)
    slow = Drift(7, parameters)
    # In any order, as a tissue that is put back asks for earlier ones again.
    for mark in (0, 3, 2, 499, 250, 0):
        assert slow.gain(mark) == pytest.approx(expected[mark], rel=1e-12)
