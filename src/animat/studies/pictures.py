"""The report's figures as jobs, each as PNG, SVG and PDF, and their numbers: of the culture, and of every robot."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Progress
from animat.recordings.reading import read_recordings
from animat.report.array import draw_array
from animat.report.burst_separation import draw_burst_separation
from animat.report.comparisons import Group, Pair, draw_comparisons
from animat.report.controls import Controls, draw_controls
from animat.report.drift import draw_drift, drift_of
from animat.report.episodes import draw_frames, draw_paths
from animat.report.first_and_last import draw_first_and_last
from animat.report.learning_curves import LearningCurve, draw_learning_curves
from animat.report.over_time import MOST, Course, Courses, draw_over_time
from animat.report.psth import draw_psth
from animat.report.raster import draw_raster
from animat.report.response_histograms import draw_response_histograms
from animat.report.responses_over_time import draw_responses_over_time
from animat.report.style import FORMATS, save_figure
from animat.responses.psth import post_stimulus_histogram, spontaneous_rate
from animat.robots.capabilities import lacking
from animat.studies.evaluating import as_recorded, first_minute, last_minute
from animat.studies.figure_tables import (
    write_array,
    write_bursts,
    write_conditions,
    write_courses,
    write_drift,
    write_learning,
    write_psth,
)
from animat.studies.limits import kinds_of, limits_of_all
from animat.studies.places import (
    RECORDINGS,
    controls_file,
    episodes_file,
    read_table,
    table_file,
)
from animat.studies.simulating import read_series
from animat.studies.specification import Body, Study, StudyCondition
from animat.studies.tabulating import TRAINED, References, named_mapping, performances
from animat.studies.task import StudyTask

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@final
@dataclass(frozen=True)
class CulturePictures(StudyTask):
    """Draw the first recording, and the series; write their numbers beside."""

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        series = read_series(self.study, folder)
        first = read_recordings(folder / RECORDINGS)[0]
        responses = series[0]
        to_ms = max(50.0, 2 * responses.window_ms[1])
        histogram = post_stimulus_histogram(first, -0.4 * to_ms, to_ms, 1.0 if to_ms <= 100 else 5.0)
        spontaneous_hz, _ = spontaneous_rate(first, responses.window_ms[1])
        spontaneous_hz /= len(first.channels)
        figures = {
            "raster": draw_raster(first, responses),
            "psth": draw_psth(histogram, responses.window_ms, spontaneous_hz),
            "bursts": draw_burst_separation(responses),
            "responses": draw_response_histograms(responses),
        }
        tables = [
            write_psth(folder, histogram, responses.window_ms, spontaneous_hz),
            write_bursts(folder, series),
            write_conditions(folder, series),
        ]
        progress.update(0.3, 1, "first recording")
        if first.channels.has_positions:
            figures["array"] = draw_array(first)
            tables.append(write_array(folder, first))
        if len(series) > 1:
            figures["first-and-last"] = draw_first_and_last(series)
            figures["over-time"] = draw_responses_over_time(series, 0)
            figures["drift"] = draw_drift(series)
            tables.append(write_drift(folder, drift_of(series)))
        return tables + _save(folder, "culture", figures, progress)


@final
@dataclass(frozen=True)
class RobotPictures(StudyTask):
    """Draw learning, comparisons, the course over the recordings, controls, paths and frames of one robot.

    The numbers of what no other table holds are written beside: learning with its intervals, and the course.
    """

    body: Body

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        robot, name = self.body.robot(), self.body.name
        study, timeline = as_recorded(self.study, folder)
        last = last_minute(timeline)
        known = References(study, folder, self.body)
        figures: dict[str, Figure] = {}
        tables: list[Path] = []
        curves = _curves(study, folder, self.body, known, timeline)
        if curves:
            figures["learning"] = draw_learning_curves(curves, f"{name}: learning")
            tables.append(write_learning(folder, name, curves))
        if study.comparisons:
            figures["comparisons"] = draw_comparisons(
                _pairs(study, folder, self.body, known, last), f"{name}: comparisons"
            )
        if timeline is not None and len(timeline) > 1:
            courses = _courses(study, folder, self.body, known, timeline)
            until_min = float(timeline.start_min[0]) + study.training_min
            drawn = [replace(of, courses=of.courses[:MOST], left_out=len(of.courses[MOST:])) for of in courses]
            figures["over-time"] = draw_over_time(drawn, f"{name}: at every recording", trained_until_min=until_min)
            tables.append(write_courses(folder, name, courses))
        progress.update(0.2, 1, "controls")
        figures["controls"] = draw_controls(_controls(folder, self.body), f"{name}: controls")
        paths = {condition.name: _paths(folder, self.body, condition) for condition in study.conditions}
        lacks = lacking(robot)
        if "draw_paths" not in lacks:
            only_paths = {c: [path for path, _ in each] for c, each in paths.items()}
            figures["paths"] = draw_paths(robot, only_paths, f"{name}: one episode of each policy")
        if "draw" not in lacks:
            middle = {c: sorted(each, key=lambda one: len(one[0]))[len(each) // 2] for c, each in paths.items()}
            figures["frames"] = draw_frames(robot, middle, f"{name}: the episode of middle length of each condition")
        return tables + _save(folder, name, figures, progress)


def _save(folder: Path, of: str, figures: Mapping[str, Figure], progress: Progress) -> list[Path]:
    files = []
    for i, (name, figure) in enumerate(figures.items()):
        progress.update(0.3 + 0.7 * i / len(figures), 1, name)
        files += [save_figure(figure, folder / "figures" / f"{of}-{name}.{ending}") for ending in FORMATS]
    return files


def _curves(
    study: Study, folder: Path, body: Body, known: References, timeline: SimulatorTimeline | None
) -> list[LearningCurve]:
    returns: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    iterations: dict[str, list[float]] = {}
    for row in read_table(table_file(folder, "learning-curves")):
        if row["robot"] == body.name:
            mean = row["mean_return"]
            returns[row["condition"]][row["policy"]].append(np.nan if mean is None else mean)
            if row["policy"] == "p0":
                iterations.setdefault(row["condition"], []).append(row["iterations"])
    rough = _over_time(study, folder, body)
    curves = []
    for condition in study.conditions:
        if condition.name in returns:
            parts = len(iterations[condition.name])
            minutes = _minutes_in_training(study, condition, timeline, parts)
            random, limit = [], []
            for at_min in minutes:
                row = known.limit(condition, at_min) or {}
                near = rough.get((condition.mapping, condition.percentiles, at_min), (None, None))
                random.append(near[0] if condition.through_neurons else known.random(condition, at_min))
                exact = row.get("best_return")
                limit.append(near[1] if exact is None and condition.delivery == "chosen" else exact)
            curves.append(
                LearningCurve(
                    condition.name,
                    np.array(iterations[condition.name]),
                    np.array(list(returns[condition.name].values()), np.float64),
                    np.array(random, np.float64),
                    np.array(limit, np.float64),
                )
            )
    return curves


def _minutes_in_training(
    study: Study, condition: StudyCondition, timeline: SimulatorTimeline | None, parts: int
) -> list[float]:
    """The recording that answers in each part of a training."""
    if timeline is None or not condition.through_neurons:
        return [last_minute(timeline)] * parts
    start = first_minute(timeline)
    share = 1 / parts if condition.shadowing else 0.0
    rows = [timeline.row_at(start + study.training_min * share * part) for part in range(parts)]
    return [float(timeline.start_min[row]) for row in rows]


def _over_time(study: Study, folder: Path, body: Body) -> dict[tuple[str, str, float], tuple[float, float | None]]:
    """Random actions and the limit on a rough grid (None where it was not computed) at every recording."""
    if not study.needs_neurons:
        return {}
    limits = {
        (row["mapping"], row["percentiles"], row["at_min"]): row["best_return"]
        for row in limits_of_all(folder, body.name, "over-time")
    }
    found: dict[tuple[str, str, float], tuple[float, float | None]] = {}
    for kind in (kind for kind in kinds_of(study) if kind.through_neurons):
        for row in read_table(controls_file(folder, body, kind, "over-time")):
            key = (kind.mapping, kind.percentiles, row["at_min"])
            found[key] = (row["random"], limits.get(key))
    return found


def _pairs(study: Study, folder: Path, body: Body, known: References, last: float) -> list[Pair]:
    rows = {
        row["comparison"]: row for row in read_table(table_file(folder, "comparisons")) if row["robot"] == body.name
    }
    pairs = []
    for compared in study.comparisons:
        at_min = last if compared.at_min is None else compared.at_min
        groups: list[Group] = []
        for condition in (study.condition(compared.first), study.condition(compared.second)):
            limit = known.limit(condition, at_min)
            groups.append(
                Group(
                    condition.name,
                    performances(folder, body, condition, at_min, compared.episodes),
                    known.random(condition, at_min),
                    None if limit is None else limit["best_return"],
                    rows[compared.name]["score_first" if not groups else "score_second"],
                )
            )
        row = rows[compared.name]
        pairs.append(Pair(f"at {at_min:g} min", groups[0], groups[1], row["p_holm"], row["u"]))
    return pairs


def _courses(study: Study, folder: Path, body: Body, known: References, timeline: SimulatorTimeline) -> list[Courses]:
    rough = _over_time(study, folder, body)
    every_min = [float(at_min) for at_min in timeline.start_min]
    panels = []
    for kind in (kind for kind in kinds_of(study) if kind.through_neurons):
        same = [c for c in study.conditions if (c.mapping, c.percentiles) == (kind.mapping, kind.percentiles)]
        courses = []
        for condition in same:
            of_policy: dict[str, list[float]] = defaultdict(list)
            for row in read_table(episodes_file(folder, body, condition, "over-time")):
                of_policy[row["actor"]].append(row["mean_return"])
            courses.append(Course(condition.name, np.array(every_min), np.array(list(of_policy.values()))))
        at = [rough[kind.mapping, kind.percentiles, at_min] for at_min in every_min]
        fine = [(at_min, row["best_return"]) for at_min in every_min for row in (known.limit(kind, at_min),) if row]
        panels.append(
            Courses(
                named_mapping(kind.mapping, kind.percentiles),
                tuple(courses),
                np.array([random for random, _ in at]),
                None if at[0][1] is None else np.array([limit for _, limit in at], np.float64),
                tuple(fine),
            )
        )
    return panels


def _controls(folder: Path, body: Body) -> list[Controls]:
    of_panel: dict[tuple[str, str, float], list[dict[str, Any]]] = defaultdict(list)
    for row in read_table(table_file(folder, "controls")):
        if row["robot"] == body.name:
            of_panel[row["mapping"], row["percentiles"], row["at_min"]].append(row)
    panels = []
    for (mapping, percentiles, at_min), rows in of_panel.items():
        at = "" if mapping == "none" else f", recording at {at_min:g} min"
        panels.append(
            Controls(
                f"{named_mapping(mapping, percentiles)}{at}",
                tuple((row["control"], row["mean_return"], row["standard_error"]) for row in rows),
                sum(row["control"].startswith(TRAINED) for row in rows),
                rows[0]["random"],
                rows[0]["limit"],
            )
        )
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
