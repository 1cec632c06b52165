"""Charts of a training: the return of each policy and their mean, and how their learners stand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.training.policy import CURVE
from animat.watch.blocks import chart, curve
from animat.watch.plain import listed, mapped, number

_LEARNER = (
    (
        "entropy",
        "Entropy",
        "nats",
        "Of the policy's choice of actions: high while it is almost random, low once it is sure.",
    ),
    ("alpha", "Alpha", "", "The weight of entropy beside reward, adjusted so that entropy comes to its target."),
    (
        "critic_loss",
        "Critic loss",
        "",
        "How far the critics are from the returns they learn to predict, in squared scaled rewards.",
    ),
)


_COLOURS = {"random actions": "grey", "best coupling": "green", "optimal return": "orange"}
"""Of the lines that returns are compared with."""


def levels_of(manifest: Mapping[str, Any], evaluation: Mapping[str, Any]) -> tuple[list[tuple[str, float]], str]:
    """Returns to compare with, by name; and in words where they come from and which are not known.

    They are in the training's description and in an evaluation of its policies, which is empty where there is none.
    """
    rows = {str(row.get("name")): number(row.get("mean_return")) for row in map(mapped, listed(evaluation.get("rows")))}
    optimum = mapped(evaluation.get("optimum")).get("value")
    known = {
        "random actions": rows.get("random", number(manifest.get("random_return"))),
        "best coupling": rows.get("coupling"),
        "optimal return": number(optimum),
    }
    words = [f"{name} {value:.4g}" for name, value in known.items() if value is not None]
    told = f"Lines: {', '.join(words)}." if words else ""
    minute = number(evaluation.get("recorded_at_min"))
    if rows and minute is not None:
        told += f" They are on the simulator of minute {minute:g}, by evaluation.json."
    elif words and not rows:
        told = told[:-1] + ", on the first simulator."
    if missing := [name for name, value in known.items() if value is None]:
        told += f" Not known: {', '.join(missing)}. To show them, run animat evaluate with --optimum and "
        told += "--out evaluation.json, in this folder."
    return [(name, value) for name, value in known.items() if value is not None], told.strip()


def learning_charts(
    curves: Mapping[int, Float64[np.ndarray, "chunks columns"]],
    swaps: Sequence[tuple[float, str]],
    iterations: float,
    levels: Sequence[tuple[str, float]] = (),
    missing: str = "",
) -> list[dict[str, Any]]:
    """The learning curves, and entropy, alpha and critic loss over the same iterations.

    Args:
        curves: of the policies that have some, by number; columns as `CURVE`.
        swaps: after how many iterations simulators are refreshed, and what with.
        iterations: of the whole training.
        levels, missing: as of `levels_of`.
    """
    series, last = _series(curves, "mean_return")
    told = "No learning curve is in the folder yet: the first checkpoint is written some seconds after the start."
    if series:
        told = f"Mean return of the episodes that ended last: {'none ended yet' if last is None else f'{last:.1f}'}. "
        told += (
            "Grey: each policy; blue: the mean of those that have come so far. A point is a sixtieth of the training."
        )
    told += " Dashed upright: the simulators are refreshed with the recording of that minute." if swaps else ""
    told = f"{told} {missing}".strip()
    series += [curve(name, [0.0, iterations], [level] * 2, "dashed", _COLOURS[name]) for name, level in levels]
    charts = [chart("Learning curves", "iterations", "return", series, told, marks=swaps, until=iterations)]
    for column, title, unit, meaning in _LEARNER:
        series, last = _series(curves, column)
        words = f"{'Not known' if last is None else f'{last:.3g}'} on average, at the last checkpoint. {meaning}"
        if not series:
            words = f"Known from the first checkpoint on. {meaning}"
        elif last is None:
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
