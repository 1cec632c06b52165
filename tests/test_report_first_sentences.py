"""The first sentences of a report agree with its numbers; and the text of figures fits into them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from animat.report.over_time import Courses, LearningCurve, draw_learning_curves, draw_returns_over_time
from animat.report.results import ControlReturns, OverCultures
from animat.report.returns import Pair, draw_comparisons, draw_controls, draw_headline, draw_over_cultures
from animat.studies.publishing import _describe
from test_report_claims import ROW, score

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@pytest.mark.parametrize(
    ("low", "high", "found"),
    [
        (40.0, 60.0, "do better than random actions: 75 % of the way to the optimal controller. Their"),
        (-30.0, 90.0, "are not found to differ from random actions. Their"),
        (-90.0, -30.0, "do worse than random actions. Their"),
    ],
)
def test_the_first_sentence_follows_the_interval(low: float, high: float, found: str) -> None:
    text = _describe(score("cartpole", "1 threshold", 50.0, low, high, -10.0, 70.0))
    assert text.startswith(f"policies trained as “1 threshold” {found}")
    assert "return is 50, that of random actions −10, that of the optimal controller 70." in text


def test_without_an_interval_nothing_is_claimed() -> None:
    text = _describe(score("cartpole", "linear", 50.0, None, None, None, None))
    assert text == "of the policies trained as “linear” the interquartile mean return is 50."


def left_out(figure: Figure) -> list[str]:
    """Titles, labels and legends that reach beyond the figure."""
    figure.canvas.draw()
    width = figure.bbox.width
    texts = [*(text for axes in figure.axes for text in (axes.xaxis.label, axes._left_title))]  # type: ignore[attr-defined]
    texts += [text for legend in figure.legends for text in legend.get_texts()]
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts]
    return [words for words, box in boxes if words and (box.x0 < 0 or box.x1 > width)]


def test_text_of_narrow_figures_fits() -> None:
    rows = [
        (score("navigation", name, 1.0, 0.0, 2.0, 0.5, 3.0), np.array([0.5, 1.5]))
        for name in ("before training", "linear")
    ]
    assert left_out(draw_headline(rows)) == left_out(draw_headline(rows, narrow=True)) == []
    over = OverCultures("before and after training", "navigation", 2, 1.0, 1.2, 0.2, 0.1, 0.3, 2, 2, 2)
    assert left_out(draw_over_cultures([(over, (0.1, 0.3))])) == []
    row = ControlReturns(
        "navigation", "9-thresholds", "first", 0.0, "trained: without neurons", 2, 1.0, 0.1, None, None, None
    )
    panels = [(f"9-thresholds, percentiles fixed, recording at {at} min", [row]) for at in (0, 140)]
    assert left_out(draw_controls(panels, "navigation: controls")) == []


LONG = ("9-thresholds without shadowing, fixed, second learner", "9-thresholds without shadowing, fixed, first learner")
"""Names of a grid, of arms and of comparisons."""
ON = ("cartpole with a pole ten times as heavy", "navigation")


def long_named(kind: str) -> Figure:
    minutes, means = np.array([0.0, 10.0]), np.array([1.0, 2.0, 3.0])
    if kind == "comparisons":
        pair = Pair(replace(ROW, first=LONG[0], second=LONG[1], robot=ON[0]), means, means + 1, 0.0)
        return draw_comparisons([pair, pair], f"{ON[0]}: comparisons")
    if kind == "learning":
        curves = [LearningCurve(name, minutes, np.ones((3, 2)), minutes, minutes) for name in (*LONG, "a")]
        return draw_learning_curves(curves, f"{ON[0]}: learning")
    if kind == "over time":
        name = "my_laboratory.another_package.mappings:Steep, percentiles fixed"
        returns = {each: np.ones((3, 2)) for each in LONG}
        courses = [Courses(f"{name} {i}", minutes, returns, minutes, np.full(2, np.nan)) for i in (1, 2)]
        return draw_returns_over_time(courses, f"{ON[0]}: at every recording", trained_until_min=5.0)
    if kind == "over cultures":
        row = OverCultures(LONG[0], ON[0], 2, 1.0, 1.2, 0.2, 0.1, 0.3, 2, 2, 2)
        over = [replace(row, comparison=name, robot=robot) for name in LONG for robot in ON]
        return draw_over_cultures([(each, (0.1, 0.3)) for each in over])
    rows = [(score(robot, arm, 1.0, 0.0, 2.0, 0.5, 3.0), means) for robot in ON for arm in LONG]
    return draw_headline(rows, narrow=kind == "narrow headline")


@pytest.mark.oracle
@pytest.mark.parametrize(
    "kind", ["comparisons", "learning", "over time", "over cultures", "headline", "narrow headline"]
)
def test_long_names_neither_overlap_nor_take_the_room_of_the_panels(kind: str) -> None:
    figure = long_named(kind)
    assert left_out(figure) == []
    texts = [axes._left_title for axes in figure.axes]  # type: ignore[attr-defined]
    for axes in figure.axes:
        assert axes.get_window_extent().width > 0.25 * figure.bbox.width / len({a.bbox.x0 for a in figure.axes})
        labels = (*axes.get_xticklabels(), *axes.get_yticklabels())
        texts += [label for label in labels if "thresholds" in label.get_text()]
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts if text.get_text()]
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.width for _, box in boxes)
    assert not [(a, b) for i, (a, one) in enumerate(boxes) for b, other in boxes[:i] if one.overlaps(other)]
