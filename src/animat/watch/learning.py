"""Charts of a training: the return of each policy and their mean, and how their learners stand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.training.policy import CURVE
from animat.watch.blocks import chart, curve

_LEARNER = (
    ("entropy", "Entropy", "nats", "Of the actions: high while they are all but random, low once the policy is sure."),
    ("alpha", "Alpha", "", "The weight of entropy beside reward, learned so that entropy comes to its target."),
    ("critic_loss", "Critic loss", "", "How far critics are off what was met; in scaled rewards squared."),
)


def learning_charts(
    curves: Mapping[int, Float64[np.ndarray, "chunks columns"]],
    swaps: Sequence[tuple[float, str]],
    iterations: float,
) -> list[dict[str, Any]]:
    """The learning curves, and entropy, alpha and critic loss over the same iterations.

    Args:
        curves: of the policies that have some, by number; columns as `CURVE`.
        swaps: after how many iterations simulators are refreshed, and what with.
        iterations: of the whole training.
    """
    series, last = _series(curves, "mean_return")
    told = "No learning curve is in the folder yet: the first checkpoint is written some seconds after the start."
    if series:
        told = f"Mean return of the episodes that ended last: {'none ended yet' if last is None else f'{last:.1f}'}. "
        told += "Grey: each policy; blue: their mean, of those that are as far; a point a sixtieth of the training."
    told += " Dashed: the simulators were refreshed with the recording of that minute." if swaps else ""
    told += " The folder holds no returns of random actions, the best coupling or an optimum: animat evaluate has them."
    charts = [chart("Learning curves", "iterations", "return", series, told, marks=swaps, until=iterations)]
    for column, title, unit, meaning in _LEARNER:
        series, last = _series(curves, column)
        words = f"{'Not known' if last is None else f'{last:.3g}'} on average, at the last checkpoint. {meaning}"
        if series and last is None:
            words = "Not in these files: they were written before it was kept."
        charts.append(chart(title, "iterations", unit, series, words, until=iterations, width="third"))
    return charts


def _series(
    curves: Mapping[int, Float64[np.ndarray, "chunks columns"]], column: str
) -> tuple[list[dict[str, Any]], float | None]:
    """A column of the curves, each policy's and their mean, and what the mean was last."""
    at = CURVE.index(column)
    series = [curve("", of[:, 0].tolist(), of[:, at].tolist(), "thin", "grey") for of in curves.values()]
    longest = max(curves.values(), key=len, default=np.zeros((0, len(CURVE))))
    if not len(longest):
        return series, None
    values = np.full((len(curves), len(longest)), np.nan)
    for row, of in zip(values, curves.values(), strict=True):
        row[: len(of)] = of[:, at]
    known = np.isfinite(values)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known, values, 0.0).sum(axis=0) / known.sum(axis=0)
    series.append(curve("mean of the policies", longest[:, 0].tolist(), mean.tolist(), "line", "blue"))
    return series, next((x for x in mean[::-1].tolist() if np.isfinite(x)), None)
