"""What a task asks for beyond a reflex, what policies do beyond one, and what they lose by interventions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from animat.report.style import BLACK, BLUE, GREY, ORANGE, Axes, Figure, add_common_legend, new_figure, style_axes

_APART = 0.11
"""Between two cultures of a row, in rows."""


@dataclass(frozen=True)
class Estimate:
    """A value on one culture, with its interval where it has one; None where it is not known.

    Attributes:
        is_least: whether the true one is that or more.
    """

    value: float | None
    low: float | None = None
    high: float | None = None
    is_least: bool = False


def draw_context(
    gaps: Mapping[str, Sequence[Estimate]], scores: Mapping[str, Sequence[Estimate]], admitted: float
) -> Figure:
    """Context gaps of tasks beside context scores of policies: a row a robot, a point a culture with its interval.

    Args:
        gaps, scores: by the robot's name, of each culture.
        admitted: the gap from which on a task needs more than a reflex.
    """
    figure = new_figure(9.2, 1.7 + 0.55 * len(gaps))
    left, right = figure.subplots(1, 2, sharey=True)
    style_axes(left, "The task: is a reflex enough?", "context gap (0: a reflex does it all, 1: it does nothing)", "")
    style_axes(right, "The policies: more than a reflex?", "context score (0: the best reflex, 1: optimal)", "")
    left.axvline(admitted, color=ORANGE, linewidth=1, linestyle="--", label=f"from {admitted:g} on: needs context")
    for axes, found, colour in ((left, gaps, BLUE), (right, scores, BLACK)):
        axes.axvline(0, color=GREY, linewidth=0.8)
        _points(axes, found, colour, "not known" if axes is left else "none: no task beyond a reflex, or not known")
        # An interval of two policies can be as wide as it likes; what matters is on which side of 0 it ends.
        low, high = axes.get_xlim()
        values = [each.value for of_robot in found.values() for each in of_robot if each.value is not None]
        low, high = max(min(low, -0.05), -1.0), min(max(high, 1.05), 2.0)
        axes.set_xlim(min([low, *(value - 0.05 for value in values)]), max([high, *(value + 0.05 for value in values)]))
    left.set_yticks(range(len(gaps)), list(gaps))
    left.set_ylim(len(gaps) - 0.5, -0.5)
    add_common_legend(figure, (left, right), columns=2)
    return figure


def _points(axes: Axes, found: Mapping[str, Sequence[Estimate]], colour: str, nothing: str) -> None:
    for row, estimates in enumerate(found.values()):
        known = [each for each in estimates if each.value is not None]
        if not known:
            axes.text(0.02, row, nothing, fontsize=8, color=GREY, va="center")
        for i, each in enumerate(known):
            place = row + _APART * (i - (len(known) - 1) / 2)
            ends = [end for end in (each.low, each.high) if end is not None]
            axes.plot(ends, [place] * len(ends), color=colour, linewidth=1.2)
            marker, label = (">", "at least") if each.is_least else ("o", "a culture, 95 % interval")
            value = math.nan if each.value is None else each.value
            axes.plot([value], [place], marker, color=colour, markersize=4, label=label)


def draw_whose_work(lost: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """What policies lose by each intervention, in parts of what they have over random stimuli: a panel a robot.

    Args:
        lost: by robot and intervention, of each culture; 1: all that they have over random stimuli.
    """
    most = max(len(each) for each in lost.values())
    figure = new_figure(2.6 * len(lost) + 1.6, 1.5 + 0.34 * most)
    names = list(dict.fromkeys(name for each in lost.values() for name in each))
    panels = figure.subplots(1, len(lost), squeeze=False, sharey=True)[0]
    for axes, (robot, each) in zip(panels, lost.items(), strict=True):
        style_axes(axes, robot, "return lost (1: all over random stimuli)", "")
        for at in (0, 1):
            axes.axvline(at, color=GREY, linewidth=0.8)
        for name, values in each.items():
            axes.plot(values, [names.index(name)] * len(values), "o", color=BLUE, alpha=0.6, markersize=4)
    panels[0].set_yticks(range(len(names)), names)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    return figure
