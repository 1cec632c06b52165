"""Learning curves in a view: those of policies' files, and charts of return, entropy, alpha and critic loss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from animat.errors import InvalidFile
from animat.training.policy import CURVE, whole_curve
from animat.watch.files import expect_own
from animat.watch.view import chart, curve

MOST_POLICIES = 1000
"""Most policies whose learning curves are shown."""
_LEARNER = (
    ("entropy", "nats", "Of the policy's choice of actions: high while it is almost random, low once it is certain."),
    ("alpha", "", "The weight of entropy relative to reward, adjusted so that entropy reaches its target."),
    ("critic_loss", "", "How far the critics are from the returns they learn to predict, in squared scaled rewards."),
)
_COLOURS = {"random actions": "grey", "best coupling": "green", "optimal return": "orange"}
"""Colours of the lines with which returns are compared."""

Curves: TypeAlias = dict[int, Float64[np.ndarray, "chunks columns"]]
"""Learning curves by policy number, with the columns of `CURVE`."""


def curve_of_policy(path: Path) -> Float64[np.ndarray, "chunks columns"] | None:
    """The learning curve in a policy's file; None if it cannot be read."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(expect_own(path), framework="numpy") as file:
            return with_all_columns(file.get_tensor("learning_curve"), 2)
    except (InvalidFile, OSError, SafetensorError, ValueError, TypeError):
        return None


def with_all_columns(curve: np.ndarray, dimensions: int) -> Float64[np.ndarray, "*_ columns"] | None:
    """Learning curves with the columns of `CURVE`; None for anything else."""
    whole = whole_curve(curve)
    is_curve = whole.ndim == dimensions and whole.shape[-1] == len(CURVE) and whole.dtype.kind == "f"
    return np.asarray(whole, np.float64) if is_curve else None


def learning_charts(
    curves: Curves,
    swaps: Sequence[tuple[float, str]],
    iterations: float | None,
    levels: Mapping[str, float],
    missing: str,
) -> list[dict[str, Any]]:
    """The learning curves, and entropy, alpha and critic loss over the same iterations.

    Args:
        swaps: after how many iterations simulators were refreshed, with labels.
        iterations: of the whole training; None: not known, as in a live run.
        levels: returns to compare with, by name; none if the iterations are not known.
        missing: a note on those that are not known.
    """
    series, last = _series(curves, "mean_return")
    note = "No learning curve is in the folder yet: the first checkpoint is written some seconds after the start."
    if series:
        note = f"Mean return of the latest episodes: {'none has ended yet' if last is None else f'{last:.1f}'}. "
        point = "chunk" if iterations is None else "60th of the training"
        note += f"Grey: each policy; blue: the mean of those that have come so far. A point is a {point}."
    note += " Dashed vertical: the simulators are refreshed with the recording of that minute." if swaps else ""
    whole = [0.0, iterations or 0.0]
    series += [curve(name, whole, [y, y], "dashed", _COLOURS[name]) for name, y in levels.items()]
    note = f"{note} {missing}".strip()
    charts = [chart("Learning curves", "iterations", "return", series, note, marks=swaps, until=iterations)]
    for column, unit, meaning in _LEARNER:
        series, last = _series(curves, column)
        if not series:
            note = f"Known from the first checkpoint on. {meaning}"
        elif last is None:
            note = "Not in these files: they were written before it was kept."
        else:
            note = f"{last:.3g} on average, at the last checkpoint. {meaning}"
        title = column.replace("_", " ").capitalize()
        charts.append(chart(title, "iterations", unit, series, note, until=iterations, width="third"))
    return charts


def _series(curves: Curves, column: str) -> tuple[list[dict[str, Any]], float | None]:
    """One column of the curves of each policy, and their mean, with the last value of the mean."""
    at = CURVE.index(column)
    series = [curve("", rows[:, 0].tolist(), rows[:, at].tolist(), "thin", "grey") for rows in curves.values()]
    longest = max(curves.values(), key=len, default=np.zeros((0, len(CURVE))))
    if not len(longest):
        return series, None
    values = np.full((len(curves), len(longest)), np.nan)
    for row, rows in zip(values, curves.values(), strict=True):
        row[: len(rows)] = rows[:, at]
    mean = np.ma.masked_invalid(values).mean(axis=0).filled(np.nan)
    series.append(curve("mean of the policies", longest[:, 0].tolist(), mean.tolist(), "line", "blue"))
    return series, next((x for x in mean[::-1].tolist() if np.isfinite(x)), None)
