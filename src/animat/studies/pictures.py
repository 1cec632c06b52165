"""The report's figures as jobs, each as PNG, SVG and PDF: of the culture, and of every robot."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from animat.neurons.psth import post_stimulus_histogram, spontaneous_rate
from animat.recordings.reading import list_recordings, read_recording
from animat.report.array import draw_array
from animat.report.burst_separation import draw_burst_separation
from animat.report.comparisons import Group, Pair, draw_comparisons
from animat.report.controls import Controls, draw_controls
from animat.report.drift import draw_drift
from animat.report.episodes import draw_frames, draw_paths
from animat.report.first_and_last import draw_first_and_last
from animat.report.learning_curves import LearningCurve, draw_learning_curves
from animat.report.over_time import Course, draw_over_time
from animat.report.psth import draw_psth
from animat.report.raster import draw_raster
from animat.report.response_histograms import draw_response_histograms
from animat.report.responses_over_time import draw_responses_over_time
from animat.report.style import FORMATS, save_figure
from animat.studies.evaluating import as_recorded, last_minute
from animat.studies.jobs import Report, Task
from animat.studies.limits import kinds_of
from animat.studies.places import (
    RECORDINGS,
    controls_file,
    episodes_file,
    limits_file,
    read_table,
    table_file,
)
from animat.studies.simulating import read_series
from animat.studies.specification import Body, Study, StudyCondition
from animat.studies.tabulating import References, performances

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_COURSES = 6


@final
@dataclass(frozen=True)
class CulturePictures(Task):
    """Draw the first recording, and the series."""

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        series = read_series(study, folder)
        first = read_recording(list_recordings([folder / RECORDINGS])[0])
        responses = series[0]
        to_ms = max(50.0, 2 * responses.window_ms[1])
        histogram = post_stimulus_histogram(first, -0.4 * to_ms, to_ms, 1.0 if to_ms <= 100 else 5.0)
        spontaneous_hz, _ = spontaneous_rate(first, responses.window_ms[1])
        figures = {
            "raster": draw_raster(first, responses),
            "psth": draw_psth(histogram, responses.window_ms, spontaneous_hz / len(first.channels)),
            "bursts": draw_burst_separation(responses),
            "responses": draw_response_histograms(responses),
        }
        report(0.3, "first recording")
        if first.channels.has_positions:
            figures["array"] = draw_array(first)
        if len(series) > 1:
            figures["first-and-last"] = draw_first_and_last(series)
            figures["over-time"] = draw_responses_over_time(series, 0)
            figures["drift"] = draw_drift(series)
        return _save(folder, "culture", figures, report)


@final
@dataclass(frozen=True)
class RobotPictures(Task):
    """Draw learning, comparisons, the course over the recordings, controls, paths and frames of one robot."""

    body: Body

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        robot, name = self.body.robot(), self.body.name
        study, timeline = as_recorded(study, folder)
        last = last_minute(timeline)
        known = References(study, folder, self.body)
        figures: dict[str, Figure] = {}
        curves = _curves(study, folder, self.body, known, last)
        if curves:
            figures["learning"] = draw_learning_curves(curves, f"{name}: learning")
        if study.comparisons:
            figures["comparisons"] = draw_comparisons(
                _pairs(study, folder, self.body, known, last), f"{name}: comparisons"
            )
        if timeline is not None and len(timeline) > 1:
            figures["over-time"] = _draw_course(study, folder, self.body, float(timeline.start_min[0]))
        report(0.2, "controls")
        figures["controls"] = draw_controls(_controls(study, folder, self.body, known, last), f"{name}: controls")
        paths = {condition.name: _paths(folder, self.body, condition) for condition in study.conditions}
        figures["paths"] = draw_paths(
            robot, {c: [path for path, _ in each] for c, each in paths.items()}, f"{name}: one episode of each policy"
        )
        middle = {c: sorted(each, key=lambda one: len(one[0]))[len(each) // 2] for c, each in paths.items()}
        figures["frames"] = draw_frames(robot, middle, f"{name}: the episode of middle length of each condition")
        return _save(folder, name, figures, report)


def _save(folder: Path, of: str, figures: Mapping[str, Figure], report: Report) -> list[Path]:
    files = []
    for i, (name, figure) in enumerate(figures.items()):
        report(0.3 + 0.7 * i / len(figures), name)
        files += [save_figure(figure, folder / "figures" / f"{of}-{name}.{ending}") for ending in FORMATS]
    return files


def _curves(study: Study, folder: Path, body: Body, known: References, last: float) -> list[LearningCurve]:
    returns: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    iterations: dict[str, list[float]] = {}
    for row in read_table(table_file(folder, "learning-curves")):
        if row["robot"] == body.name:
            mean = row["mean_return"]
            returns[row["condition"]][row["policy"]].append(np.nan if mean is None else mean)
            if row["policy"] == "p0":
                iterations.setdefault(row["condition"], []).append(row["iterations"])
    start = study.limit_minutes(last)[0]
    curves = []
    for condition in study.conditions:
        if condition.name in returns:
            limit = known.limit(condition, start)
            curves.append(
                LearningCurve(
                    condition.name,
                    np.array(iterations[condition.name]),
                    np.array(list(returns[condition.name].values()), np.float64),
                    known.random(condition, start),
                    None if limit is None else limit["best_return"],
                )
            )
    return curves


def _pairs(study: Study, folder: Path, body: Body, known: References, last: float) -> list[Pair]:
    rows = {
        row["comparison"]: row for row in read_table(table_file(folder, "comparisons")) if row["robot"] == body.name
    }
    pairs = []
    for compared in study.comparisons:
        at_min = last if compared.at_min is None else compared.at_min
        groups = []
        for condition in (study.condition(compared.first), study.condition(compared.second)):
            limit = known.limit(condition, at_min)
            groups.append(
                Group(
                    condition.name,
                    performances(folder, body, condition, at_min, compared.episodes),
                    known.random(condition, at_min),
                    None if limit is None else limit["best_return"],
                )
            )
        row = rows[compared.name]
        pairs.append(Pair(f"at {at_min:g} min", groups[0], groups[1], row["p_normal"], row["u"]))
    return pairs


def _draw_course(study: Study, folder: Path, body: Body, start_min: float) -> Figure:
    courses = []
    for condition in [c for c in study.conditions if c.through_neurons][:_MOST_COURSES]:
        of_policy: dict[str, list[float]] = defaultdict(list)
        minutes: list[float] = []
        for row in read_table(episodes_file(folder, body, condition, "over-time")):
            of_policy[row["actor"]].append(row["mean_return"])
            if row["actor"] == "p0":
                minutes.append(row["at_min"])
        courses.append(Course(condition.name, np.array(minutes), np.array(list(of_policy.values()))))
    kind = next(kind for kind in kinds_of(study) if kind.through_neurons)
    random = [row["random"] for row in read_table(controls_file(folder, body, kind, "over-time"))]
    limit = [row["best_return"] for row in read_table(limits_file(folder, body.name, "over-time"))]
    return draw_over_time(
        courses,
        f"{body.name}: at every recording (best possible return and random: {kind.mapping})",
        random=np.array(random),
        limit=np.array(limit),
        trained_until_min=start_min + study.training_min,
    )


def _controls(study: Study, folder: Path, body: Body, known: References, last: float) -> list[Controls]:
    rows = [row for row in read_table(table_file(folder, "controls")) if row["robot"] == body.name]
    panels = []
    for kind in kinds_of(study):
        same = [row for row in rows if (row["mapping"], row["percentiles"]) == (kind.mapping, kind.percentiles)]
        returns: list[tuple[str, float, float | None]] = []
        for condition in study.conditions:
            if (condition.mapping, condition.percentiles) == (kind.mapping, kind.percentiles) and condition.trained:
                means = performances(folder, body, condition, last)
                error = float(means.std(ddof=1) / np.sqrt(len(means))) if len(means) > 1 else None
                returns.append((f"trained: {condition.name}", float(means.mean()), error))
        returns += [
            (row["control"], row["mean_return"], row["standard_error"]) for row in same if row["at_min"] == last
        ]
        limit = known.limit(kind, last)
        at = f", recording at {last:g} min" if kind.through_neurons else ""
        mapping = kind.mapping if kind.through_neurons else "without neurons"
        panels.append(Controls(f"{mapping}{at}", tuple(returns), None if limit is None else limit["best_return"]))
    return panels


def _paths(folder: Path, body: Body, condition: StudyCondition) -> list[tuple[np.ndarray, list[float]]]:
    """Observations and commands of each policy's episode."""
    of_actor: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in read_table(episodes_file(folder, body, condition, "paths")):
        of_actor[row["actor"]].append(row)
    names = [quantity.name for quantity in body.robot().quantities]
    return [
        (np.array([[row[name] for name in names] for row in rows]), [row["command"] for row in rows[1:]])
        for rows in of_actor.values()
    ]
