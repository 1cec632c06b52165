"""Charts of a training: the return of each policy and their mean, and the state of the learners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from animat.training.policy import CURVE
from animat.watch.blocks import chart, curve
from animat.watch.plain import listed, mapped, number, text

Curves: TypeAlias = dict[int, Float64[np.ndarray, "chunks columns"]]
"""Learning curves by policy number, with the columns of `CURVE`."""

_LEARNER = (
    ("entropy", "nats", "Of the policy's choice of actions: high while it is almost random, low once it is certain."),
    ("alpha", "", "The weight of entropy relative to reward, adjusted so that entropy reaches its target."),
    ("critic_loss", "", "How far the critics are from the returns they learn to predict, in squared scaled rewards."),
)
_COLOURS = {"random actions": "grey", "best coupling": "green", "optimal return": "orange"}
"""Colours of the lines with which returns are compared."""


def levels_of(random_return: float | None, evaluation: Mapping[str, Any]) -> tuple[dict[str, float], str]:
    """Returns to compare with, by name, and a note on their source and on those that are not known.

    Args:
        random_return: of random actions on the first simulator; None if not known.
        evaluation: of the training's policies; empty if there is none.
    """
    # It is a file of the user's, which may hold anything.
    listed_rows = map(mapped, listed(evaluation.get("rows")))
    rows = {text(row.get("name")): number(row.get("mean_return")) for row in listed_rows}
    returns = {
        "random actions": rows.get("random", random_return),
        "best coupling": rows.get("coupling"),
        "optimal return": number(mapped(evaluation.get("optimum")).get("value")),
    }
    known = {name: value for name, value in returns.items() if value is not None}
    note = f"Lines: {', '.join(f'{name} {value:.4g}' for name, value in known.items())}." if known else ""
    if rows and (minute := number(evaluation.get("recorded_at_min"))) is not None:
        note += f" They are on the simulator of minute {minute:g}, from evaluation.json."
    elif known and not rows:
        note = note[:-1] + ", on the first simulator."
    if missing := [name for name in returns if name not in known]:
        note += f" Not known: {', '.join(missing)}. To show them, run animat evaluate with --optimum and "
        note += "--out evaluation.json, in this folder."
    return known, note.strip()


def learning_charts(
    curves: Curves, swaps: Sequence[tuple[float, str]], iterations: float, levels: Mapping[str, float], missing: str
) -> list[dict[str, Any]]:
    """The learning curves, and entropy, alpha and critic loss over the same iterations.

    Args:
        curves: of the policies.
        swaps: after how many iterations simulators are refreshed, and with which recording.
        iterations: of the whole training.
        levels, missing: the results of `levels_of`.
    """
    series, last = _series(curves, "mean_return")
    note = "No learning curve is in the folder yet: the first checkpoint is written some seconds after the start."
    if series:
        note = f"Mean return of the latest episodes: {'none has ended yet' if last is None else f'{last:.1f}'}. "
        note += "Grey: each policy; blue: the mean of those that have come so far. A point is a 60th of the training."
    note += " Dashed vertical: the simulators are refreshed with the recording of that minute." if swaps else ""
    series += [curve(name, [0.0, iterations], [y, y], "dashed", _COLOURS[name]) for name, y in levels.items()]
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
    known = np.isfinite(values)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known, values, 0.0).sum(axis=0) / known.sum(axis=0)
    series.append(curve("mean of the policies", longest[:, 0].tolist(), mean.tolist(), "line", "blue"))
    return series, next((x for x in mean[::-1].tolist() if np.isfinite(x)), None)
