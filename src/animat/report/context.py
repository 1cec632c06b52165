"""What a task needs beyond a reflex, what policies do beyond one, and what they lose by interventions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from animat.lazy import Axes, Figure
from animat.report.results import CONTEXT_GAP_LEVEL, ContextRow
from animat.report.style import BLACK, BLUE, GREY, ORANGE, add_common_legend, new_figure, style_axes

_SPACING = 0.11
"""Distance between two cultures on a row, in rows."""


def draw_context(rows: Mapping[str, Sequence[ContextRow]]) -> Figure:
    """Context gaps of tasks and context scores of policies: one row per robot, one point with interval per culture."""
    figure = new_figure(9.2, 1.7 + 0.55 * len(rows))
    left, right = figure.subplots(1, 2, sharey=True)
    style_axes(left, "The task: is a reflex enough?", "context gap (0: a reflex does it all, 1: it does nothing)", "")
    style_axes(right, "The policies: more than a reflex?", "context score (0: the best reflex, 1: optimal)", "")
    left.axvline(CONTEXT_GAP_LEVEL, color=ORANGE, linewidth=1, linestyle="--", label="a reflex leaves half undone")
    for axes, name, colour in ((left, "gap", BLUE), (right, "score", BLACK)):
        axes.axvline(0, color=GREY, linewidth=0.8)
        nothing = "not known" if axes is left else "none: no task beyond a reflex, or not known"
        _points(axes, rows, name, colour, nothing)
        # An interval of two policies can be arbitrarily wide; only the side of 0 on which it ends matters.
        low, high = axes.get_xlim()
        values = [value for of_robot in rows.values() for row in of_robot if (value := getattr(row, name)) is not None]
        low, high = max(min(low, -0.05), -1.0), min(max(high, 1.05), 2.0)
        axes.set_xlim(min([low, *(value - 0.05 for value in values)]), max([high, *(value + 0.05 for value in values)]))
    left.set_yticks(range(len(rows)), list(rows))
    left.set_ylim(len(rows) - 0.5, -0.5)
    add_common_legend(figure, (left, right), columns=2)
    return figure


def _points(axes: Axes, rows: Mapping[str, Sequence[ContextRow]], name: str, colour: str, nothing: str) -> None:
    for i, of_robot in enumerate(rows.values()):
        known = [row for row in of_robot if getattr(row, name) is not None]
        if not known:
            axes.text(0.02, i, nothing, fontsize=8, color=GREY, va="center")
        for j, row in enumerate(known):
            place = i + _SPACING * (j - (len(known) - 1) / 2)
            value, low, high = (getattr(row, each) for each in (name, f"{name}_low_95", f"{name}_high_95"))
            ends = [end for end in (low, high) if end is not None]
            axes.plot(ends, [place] * len(ends), color=colour, linewidth=1.2)
            marker, label = (">", "lower bound") if row.is_least else ("o", "a culture, 95 % interval")
            axes.plot([value], [place], marker, color=colour, markersize=4, label=label)


def draw_whose_work(lost: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Return lost on each culture, by robot and intervention, as a fraction of the advantage over random stimuli."""
    most = max(len(each) for each in lost.values())
    figure = new_figure(2.6 * len(lost) + 1.6, 1.5 + 0.34 * most)
    names = list(dict.fromkeys(name for each in lost.values() for name in each))
    panels = figure.subplots(1, len(lost), squeeze=False, sharey=True)[0]
    for axes, (robot, each) in zip(panels, lost.items(), strict=True):
        style_axes(axes, robot, "return lost (1: whole advantage)", "")
        for at in (0, 1):
            axes.axvline(at, color=GREY, linewidth=0.8)
        for name, values in each.items():
            axes.plot(values, [names.index(name)] * len(values), "o", color=BLUE, alpha=0.6, markersize=4)
    panels[0].set_yticks(range(len(names)), names)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    return figure
