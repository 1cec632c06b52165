"""Jobs that draw the report's figures of the culture and of every robot, as PNG, SVG and PDF, with their numbers.

Numbers that only figures show are written from the arrays that are drawn, to a table of the figure's name.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from animat.lazy import Figure
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Progress
from animat.recordings.reading import read_recordings
from animat.recordings.recording import Recording
from animat.records import read_record
from animat.report.array import draw_array, rates_of_sites
from animat.report.drift import PERCENTILES, draw_drift, drift_of
from animat.report.episodes import draw_frames, draw_paths
from animat.report.over_time import Courses, LearningCurve, draw_learning_curves, draw_returns_over_time, over_rounds
from animat.report.response_histograms import draw_burst_separation, draw_response_histograms, draw_responses_over_time
from animat.report.results import ComparedReturns, ControlReturns, Results
from animat.report.returns import Pair, draw_comparisons, draw_controls
from animat.report.spikes import draw_psth, draw_raster
from animat.report.style import save_formats
from animat.responses.psth import PostStimulusHistogram, post_stimulus_histogram, spontaneous_rate
from animat.responses.responses import Responses
from animat.robots.base import lacking
from animat.studies.episodes import POLICY, Paths, mean_returns, rows_where
from animat.studies.evaluating import as_recorded
from animat.studies.folder import RECORDINGS, RESULTS, episodes_file, table_file
from animat.studies.optima import kinds_of
from animat.studies.recording import read_series
from animat.studies.results import read_arrays, read_typed, write_table
from animat.studies.specification import Arm, RobotSpec, Study, mapping_label
from animat.studies.tabulating import References, all_episodes, learning_of, performances
from animat.studies.task import StudyTask
from animat.studies.training import training_of
from animat.tables import UNKNOWN
from animat.training.settings import SAC
from animat.training.specification import CHUNKS

Rows = tuple[Sequence[str], Iterable[Sequence[Any]]]
"""The head and the rows of a table."""


class CulturePictures(StudyTask):
    """Draw the first recording and the series, and write their numbers to tables."""

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        series = read_series(self.study, folder, as_one=True)
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
            "responses": draw_response_histograms(responses, series[-1] if len(series) > 1 else None),
        }
        tables = {
            "psth": psth_rows(histogram, responses.window_ms, spontaneous_hz),
            "bursts": bursts_rows(series),
            "conditions": conditions_rows(series),
        }
        progress.update(0.3, 1, "first recording")
        if first.channels.has_positions:
            figures["array"] = draw_array(first)
            tables["array"] = array_rows(first)
        if len(series) > 1:
            figures["over-time"] = draw_responses_over_time(series)
            figures["drift"] = draw_drift(series)
            head = ("at_min", *(f"p{percent}_hz" for percent in PERCENTILES), "burst_share")
            tables["drift"] = head, drift_of(series).tolist()
        return _save(folder, "culture", figures, tables, progress)


@dataclass(frozen=True)
class RobotPictures(StudyTask):
    """Draw learning, comparisons, returns over the recordings, controls, paths and frames of one robot."""

    spec: RobotSpec

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        robot, name = self.spec.robot(), self.spec.name
        study, timeline, *_ = as_recorded(self.study, folder)
        table = all_episodes(study, folder, [self.spec])
        known = References(study, folder, self.spec, table)
        results = read_typed(folder / RESULTS, Results)
        # For every recording, with the optimum on a coarse grid.
        coarse = References(study, folder, self.spec, table, over_time=True) if study.needs_neurons else known
        figures: dict[str, Figure] = {}
        tables: dict[str, Rows] = {}
        if curves := list(_curves(known, coarse, timeline)):
            figures["learning"] = draw_learning_curves(curves, f"{name}: learning")
            tables["learning"] = learning_rows(curves)
        if study.comparisons:
            pairs = [_pair(row, known) for row in results.comparisons if row.robot == name]
            figures["comparisons"] = draw_comparisons(pairs, f"{name}: comparisons")
        if timeline is not None and len(timeline) > 1:
            courses = list(_courses(known, coarse, timeline))
            until_min = float(timeline.start_min[0]) + study.training_min
            figures["over-time"] = draw_returns_over_time(
                courses, f"{name}: at every recording", trained_until_min=until_min
            )
            tables["over-time"] = courses_rows(courses)
        progress.update(0.2, 1, "controls")
        controls = _controls(row for row in results.controls if row.robot == name)
        figures["controls"] = draw_controls(list(controls), f"{name}: controls")
        files = {each.name: episodes_file(folder, self.spec, each, "paths") for each in study.arms}
        recorded = {arm: Paths(**read_arrays(file)) for arm, file in files.items()}
        tables["paths"] = paths_rows([quantity.name for quantity in robot.observation_spec], recorded)
        paths = {arm: of.episodes() for arm, of in recorded.items()}
        lacks = lacking(robot)
        if "draw_paths" not in lacks:
            figures["paths"] = draw_paths(robot, paths, f"{name}: one episode of each policy")
        if "draw" not in lacks:
            figures["frames"] = draw_frames(robot, paths, f"{name}: the episode of median length of each arm")
        return _save(folder, name, figures, tables, progress)


def _save(
    folder: Path, of: str, figures: Mapping[str, Figure], tables: Mapping[str, Rows], progress: Progress
) -> list[Path]:
    files = [write_table(table_file(folder, f"{of}-{name}"), head, rows) for name, (head, rows) in tables.items()]
    for i, (name, figure) in enumerate(figures.items()):
        progress.update(0.3 + 0.7 * i / len(figures), 1, name)
        files += save_formats(figure, folder, f"figures/{of}-{name}")
    return files


def _curves(known: References, coarse: References, timeline: SimulatorTimeline | None) -> Iterator[LearningCurve]:
    study = known.study
    for arm in (arm for arm in study.arms if arm.trained):
        learning = learning_of(study, known.folder, known.spec, arm)
        random, optimum = [], []
        for at_min in _minutes_in_training(known, arm, timeline):
            random.append((coarse if arm.through_neurons else known).random(arm, at_min))
            best = known.best_return(arm, at_min)
            optimum.append(coarse.best_return(arm, at_min) if best is None else best)
        levels = np.array(random, np.float64), np.array(optimum, np.float64)
        iterations = learning[0, :, 0]
        returns = over_rounds(iterations, learning[:, :, 1], learning[:, :, 2], round_of(study, known.spec))
        yield LearningCurve(arm.name, iterations, returns, *levels, known.spec.robot().return_range)


def round_of(study: Study, spec: RobotSpec) -> int:
    """Iterations within which every training environment ends at least one episode."""
    return spec.robot().episode_limit * read_record(SAC, study.algorithm, "algorithm").environments


def _minutes_in_training(known: References, arm: Arm, timeline: SimulatorTimeline | None) -> list[float]:
    """The minute of the recording in use in each chunk of training; NaN if each episode draws its recording."""
    if timeline is None or not arm.through_neurons:
        # Without neurons every minute is the same.
        return [0.0] * CHUNKS
    if arm.shadowing == "drawn":
        return [math.nan] * CHUNKS
    training, every_min = training_of(known.study, known.spec, arm), timeline.start_min.tolist()
    return [every_min[timeline.row_at(every_min[0] + training.minute(chunk))] for chunk in range(CHUNKS)]


def _pair(row: ComparedReturns, known: References) -> Pair:
    first, second = known.study.arm(row.first), known.study.arm(row.second)
    a, b = (performances(known.table, row.robot, arm, row.at_min, row.episodes) for arm in (first, second))
    return Pair(row, a, b, known.random(first, row.at_min))


def _courses(known: References, coarse: References, timeline: SimulatorTimeline) -> Iterator[Courses]:
    every_min: list[float] = timeline.start_min.tolist()
    over_time = rows_where(known.table, agent=POLICY, over_time=True)
    for kind in (kind for kind in kinds_of(known.study) if kind.through_neurons):
        returns = {}
        for arm in known.study.arms_of(kind):
            of_minute = rows_where(over_time, arm=arm.name).groupby("at_min")
            returns[arm.name] = np.stack([mean_returns(rows) for _, rows in of_minute], axis=1)
        random = np.array([coarse.random(kind, at_min) for at_min in every_min])
        optimum = np.array([coarse.best_return(kind, at_min) for at_min in every_min], np.float64)
        fine = {at_min: best for at_min in every_min if (best := known.best_return(kind, at_min)) is not None}
        yield Courses(mapping_label(*kind.kind), timeline.start_min, returns, random, optimum, fine)


def _controls(rows: Iterable[ControlReturns]) -> Iterator[tuple[str, list[ControlReturns]]]:
    """Controls grouped by mapping and recording, with a title each."""
    for (mapping, percentiles, at_min), same in groupby(rows, lambda row: (row.mapping, row.percentiles, row.at_min)):
        at = "" if mapping == "none" else f", recording at {at_min:g} min"
        yield f"{mapping_label(mapping, percentiles)}{at}", list(same)


def psth_rows(histogram: PostStimulusHistogram, window_ms: Sequence[float], quiet_hz: float) -> Rows:
    """The histogram of the first recording, one row per bin; `in_window`: the bin's share in the response window."""
    from_ms, to_ms = histogram.edges_ms[:-1], histogram.edges_ms[1:]
    inside_ms = np.clip(np.minimum(to_ms, window_ms[1]) - np.maximum(from_ms, window_ms[0]), 0.0, None)
    head = ("from_ms", "to_ms", "in_window", "spikes", "stimuli", "channels", "rate_hz_per_channel")
    columns = (from_ms, to_ms, inside_ms / (to_ms - from_ms), histogram.count, histogram.rate_hz)
    rows = (
        (*bounds, inside, count, histogram.n_stimuli, histogram.n_channels, rate_hz, quiet_hz)
        for *bounds, inside, count, rate_hz in zip(*(column.tolist() for column in columns), strict=True)
    )
    return (*head, "spontaneous_hz_per_channel"), rows


def bursts_rows(series: Sequence[Responses]) -> Rows:
    """Burst separation in every recording; a response whose ratio of active channels is above the threshold is one."""
    head = ("at_min", "responses", "bursts", "burst_share", "threshold_active_ratio", "separability", "channels")
    rows = []
    for responses in series:
        n, bursts = len(responses), int(np.count_nonzero(responses.is_burst))
        counts = (responses.start_min, n, bursts, bursts / n if n else None)
        rows.append((*counts, responses.threshold, responses.separability, responses.n_channels))
    return head, rows


def conditions_rows(series: Sequence[Responses]) -> Rows:
    """The non-burst responses to every condition in every recording: how many, median, and P(x >= P50 of all)."""
    head = ("at_min", "condition", "value", "unit", "non_bursts", "median_hz", "above_median")
    rows = []
    for responses in series:
        for i, share in enumerate(responses.shares_above_median().tolist()):
            condition, x = responses.conditions[i], responses.rates_of(i)
            of_condition = condition.label, condition.value, condition.unit
            rows.append((responses.start_min, *of_condition, len(x), float(np.median(x)) if len(x) else None, share))
    return head, rows


def array_rows(recording: Recording) -> Rows:
    """Every recording site of the first recording with its rate, and stimulated electrodes that no channel reads."""
    channels, electrodes = recording.channels, recording.stimuli.electrodes
    stimulated = set(electrodes[electrodes != UNKNOWN].tolist())
    columns = (channels.label, channels.electrode, channels.x_um, channels.y_um, rates_of_sites(recording))
    rows: list[tuple[Any, ...]] = [
        (label, None if electrode == UNKNOWN else electrode, *numbers, int(electrode in stimulated))
        for label, electrode, *numbers in zip(*(column.tolist() for column in columns), strict=True)
    ]
    unread = sorted(stimulated - set(channels.electrode.tolist()))
    rows += [(None, electrode, None, None, None, 1) for electrode in unread]
    return ("channel", "electrode", "x_um", "y_um", "rate_hz", "is_stimulated"), rows


def learning_rows(curves: Sequence[LearningCurve]) -> Rows:
    """Learning curves as means over policies with their 95 % intervals, with random actions and the optimum."""
    head = ("arm", "iterations", "policies", "mean_return", "low_95", "high_95", "random", "optimum")
    rows: list[tuple[Any, ...]] = []
    for curve in curves:
        ended = np.count_nonzero(np.isfinite(curve.returns), axis=0)
        columns = (curve.iterations.astype(int), ended, *curve.mean_with_interval(), curve.random, curve.optimum)
        rows += [(curve.name, *row) for row in zip(*(column.tolist() for column in columns), strict=True)]
    return head, rows


def courses_rows(panels: Sequence[Courses]) -> Rows:
    """Quartiles over policies of every arm at every recording, with random actions and the optima."""
    head = ("mapping", "arm", "at_min", "policies", "lower_quartile", "median", "upper_quartile", "random")
    rows = []
    for panel in panels:
        for arm, returns in panel.returns.items():
            columns = (panel.minutes, *panel.quartiles(arm), panel.random, panel.optimum)
            for at_min, *levels in zip(*(column.tolist() for column in columns), strict=True):
                rows.append((panel.title, arm, at_min, len(returns), *levels, panel.fine_optimum.get(at_min)))
    return (*head, "optimum_rough_grid", "optimum_fine_grid"), rows


def paths_rows(names: Sequence[str], paths: Mapping[str, Paths]) -> Rows:
    """One episode of each policy of every arm: observations, and the command or commands that led to each."""
    n = max(math.prod(of.commands.shape[2:]) for of in paths.values())
    heads = ["command"] if n == 1 else [f"command_{number}" for number in range(1, n + 1)]
    rows = (
        (arm, f"p{actor}", i, *observed.tolist(), *(np.ravel(commands[i - 1]).tolist() if i else [None] * n))
        for arm, of in paths.items()
        for actor, (observations, commands) in enumerate(of.episodes())
        for i, observed in enumerate(observations)
    )
    return ("arm", "policy", "iteration", *names, *heads), rows
