"""Learning curves for TensorBoard, with the extra `[tensorboard]`; imported only on request."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Self

from animat.errors import as_invalid_file
from animat.execution.curves import CurveRow
from animat.extras import expect_extra


class TensorBoard:
    """A callback of `train` that writes each policy's curve as a run, with one scalar per number of `CurveRow`.

        with TensorBoard("runs") as board:
            train(training, timeline, "policies", callbacks=[board])

    The folder, for the runs `p0`, `p1` and so on, is created if missing. Raises AnimatError if tensorboardX is not
    installed, and InvalidFile, on entry or call, if the folder cannot be written to.
    """

    def __init__(self, folder: str | Path) -> None:
        board = expect_extra("tensorboardX", package="tensorboardX", extra="tensorboard")
        self._make, self._folder = board.SummaryWriter, Path(folder)
        self._writers: dict[str, Any] = {}

    def __enter__(self) -> Self:
        with as_invalid_file(self._folder, "cannot be written"):
            self._folder.mkdir(parents=True, exist_ok=True)
        return self

    def __call__(self, row: CurveRow) -> None:
        """Write a row without its NaNs."""
        scalars = {"episodes": row.episodes, "return": row.mean_return}
        scalars |= {"entropy": row.entropy, "alpha": row.alpha, "critic_loss": row.critic_loss}
        with as_invalid_file(self._folder, "cannot be written"):
            if row.policy not in self._writers:
                self._writers[row.policy] = self._make(str(self._folder / row.policy))
            for name, number in scalars.items():
                if not math.isnan(number):
                    self._writers[row.policy].add_scalar(name, number, row.iterations)

    def __exit__(self, *error: object) -> None:
        for writer in self._writers.values():
            writer.close()
        self._writers = {}
