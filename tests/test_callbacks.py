"""What follows a training: rows of the learning curves as they come, and TensorBoard's files of them."""

from __future__ import annotations

import struct
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from animat import CurveRow, train
from animat.cli import main
from animat.execution.curves import CurveFile
from animat.training.policy import Policy
from animat.training.specification import CHUNKS
from test_training import SHORT, bits, timeline_of, trained

FOUR = replace(SHORT, policies=4, iterations=1_000)
"""In two groups of two, which are one program."""


def assert_whole(rows: list[CurveRow], policies: dict[str, Policy]) -> None:
    """Every row of every policy once, in its order."""
    assert {row.policy for row in rows} == set(policies)
    for name, policy in policies.items():
        reported = [astuple(row)[1:] for row in rows if row.policy == name]
        assert len(reported) == CHUNKS
        np.testing.assert_array_equal(reported, policy.learning_curve)


@pytest.mark.oracle
def test_rows_come_while_it_trains_and_change_no_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = trained(FOUR, timeline_of(), tmp_path / "plain")
    rows: list[CurveRow] = []
    came, waited = Event(), list[bool]()
    add = CurveFile.add

    def add_and_wait(file: CurveFile, part: np.ndarray) -> None:
        """The training goes on only when its first row has come."""
        add(file, part)
        waited.append(came.wait(60))

    def on_row(row: CurveRow) -> None:
        rows.append(row)
        came.set()

    monkeypatch.setattr(CurveFile, "add", add_and_wait)
    followed = trained(FOUR, timeline_of(), tmp_path / "followed", callbacks=[on_row])
    assert bits(tmp_path / "plain") == bits(tmp_path / "followed")
    assert_whole(rows, followed)
    # Every chunk of both groups; the first waited for its rows, and not in vain.
    assert waited == [True] * 2 * CHUNKS
    # In memory, one by one; and of a folder that is finished.
    in_memory: list[CurveRow] = []
    alone = train(FOUR, timeline_of(), None, callbacks=[in_memory.append])
    assert_whole(in_memory, alone)
    for name, policy in plain.items():
        np.testing.assert_array_equal(policy.weights[0], alone[name].weights[0])
    again: list[CurveRow] = []
    assert_whole(again, trained(FOUR, timeline_of(), tmp_path / "followed", callbacks=[again.append]))


@pytest.mark.oracle
def test_a_continued_training_reports_all_rows_again_from_the_first(tmp_path: Path) -> None:
    trained(SHORT, timeline_of(), tmp_path / "whole")
    rows: list[CurveRow] = []

    def stop(row: CurveRow) -> None:
        rows.append(row)
        if len(rows) == 5:
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"), ThreadPoolExecutor(1) as executor:
        train(SHORT, timeline_of(), tmp_path / "stopped", executor=executor, checkpoint_s=0.0, callbacks=[stop])
    rows.clear()
    gone_on = trained(SHORT, timeline_of(), tmp_path / "stopped", callbacks=[rows.append])
    assert bits(tmp_path / "whole") == bits(tmp_path / "stopped")
    assert_whole(rows, gone_on)


def test_tensorboard_has_every_row(tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX", reason="tensorboardX is not installed (animat[tensorboard])")
    from animat.report.tensorboard import TensorBoard

    with TensorBoard(tmp_path / "runs") as board:
        policies = trained(FOUR, timeline_of(), tmp_path / "policies", callbacks=[board])
    for name, policy in policies.items():
        curve = policy.learning_curve
        written = scalars(next((tmp_path / "runs" / name).iterdir()))
        for column, tag in enumerate(("episodes", "return", "entropy", "alpha", "critic_loss"), 1):
            known = curve[np.isfinite(curve[:, column])]
            assert written[tag] == [(int(row[0]), float(np.float32(row[column]))) for row in known]


def test_without_tensorboard_x_the_extra_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # What Python does with a module that is None is what it does where there is none.
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    out = tmp_path / "out"
    words = ["train", "cartpole", "--mapping", "none", "--out", str(out), "--tensorboard", str(tmp_path / "runs")]
    assert main(words) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("animat: --tensorboard: expected the package tensorboardX, which is not installed: ")
    assert "pip install 'animat[tensorboard]'" in line
    assert not out.exists() and not (tmp_path / "runs").exists()


def scalars(file: Path) -> dict[str, list[tuple[int, float]]]:
    """What an event file holds, by its format: length, checksum, message, checksum."""
    from tensorboardX.proto.event_pb2 import Event as ScalarEvent

    data, at = file.read_bytes(), 0
    found: dict[str, list[tuple[int, float]]] = {}
    while at < len(data):
        (length,) = struct.unpack("<Q", data[at : at + 8])
        event = ScalarEvent.FromString(data[at + 12 : at + 12 + length])
        for value in event.summary.value:
            found.setdefault(value.tag, []).append((event.step, value.simple_value))
        at += 16 + length
    return found
