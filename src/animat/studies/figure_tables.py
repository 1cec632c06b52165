"""Tables of the numbers that only figures show, from the arrays that are drawn: in `tables/` by the figure's name."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from animat.recordings.recording import Recording
from animat.report.array import rates_of_sites
from animat.report.drift import PERCENTILES, Drift
from animat.report.learning_curves import LearningCurve, mean_with_interval
from animat.report.over_time import Courses, quartiles
from animat.responses.psth import PostStimulusHistogram
from animat.responses.responses import Responses
from animat.studies.episodes import Paths
from animat.studies.places import table_file
from animat.studies.results import write_table
from animat.tables import UNKNOWN


def write_psth(
    folder: Path, histogram: PostStimulusHistogram, window_ms: tuple[float, float], spontaneous_hz: float
) -> Path:
    """The post-stimulus time histogram of the first recording, one row per bin.

    `in_window` is the share of the bin that lies in the response window.
    """
    from_ms, to_ms = histogram.edges_ms[:-1], histogram.edges_ms[1:]
    inside_ms = np.clip(np.minimum(to_ms, window_ms[1]) - np.maximum(from_ms, window_ms[0]), 0.0, None)
    head = ("from_ms", "to_ms", "in_window", "spikes", "stimuli", "channels", "rate_hz_per_channel")
    columns = (from_ms, to_ms, inside_ms / (to_ms - from_ms), histogram.count, histogram.rate_hz)
    rows = (
        (*bounds, inside, count, histogram.n_stimuli, histogram.n_channels, rate_hz, spontaneous_hz)
        for *bounds, inside, count, rate_hz in zip(*(column.tolist() for column in columns), strict=True)
    )
    return _write(folder, "culture-psth", (*head, "spontaneous_hz_per_channel"), rows)


def write_bursts(folder: Path, series: Sequence[Responses]) -> Path:
    """Burst separation in every recording; a response whose ratio of active channels is above the threshold is one."""
    head = ("at_min", "responses", "bursts", "burst_share", "threshold_active_ratio", "separability", "channels")
    rows = []
    for responses in series:
        n, bursts = len(responses), int(np.count_nonzero(responses.is_burst))
        counts = (responses.start_min, n, bursts, bursts / n if n else None)
        rows.append((*counts, responses.threshold, responses.separability, responses.n_channels))
    return _write(folder, "culture-bursts", head, rows)


def write_conditions(folder: Path, series: Sequence[Responses]) -> Path:
    """The non-burst responses to every condition in every recording: how many, median, and P(x >= P50 of all)."""
    head = ("at_min", "condition", "value", "unit", "non_bursts", "median_hz", "above_median")
    rows = []
    for responses in series:
        for i, share in enumerate(responses.shares_above_median().tolist()):
            condition, x = responses.conditions[i], responses.rates_of(i)
            of_condition = condition.label, condition.value, condition.unit
            rows.append((responses.start_min, *of_condition, len(x), float(np.median(x)) if len(x) else None, share))
    return _write(folder, "culture-conditions", head, rows)


def write_drift(folder: Path, drift: Drift) -> Path:
    """Percentiles of the non-burst responses to all conditions, and the share of bursts, at every recording."""
    head = ("at_min", *(f"p{percent}_hz" for percent in PERCENTILES), "burst_share")
    columns = (drift.minutes, *drift.percentiles_hz.T, drift.bursts)
    return _write(folder, "culture-drift", head, zip(*(column.tolist() for column in columns), strict=True))


def write_array(folder: Path, recording: Recording) -> Path:
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
    return _write(folder, "culture-array", ("channel", "electrode", "x_um", "y_um", "rate_hz", "is_stimulated"), rows)


def write_learning(folder: Path, robot: str, curves: Sequence[LearningCurve]) -> Path:
    """Learning curves as means over policies with their 95 % intervals, with random actions and the optimum."""
    head = ("arm", "iterations", "policies", "mean_return", "low_95", "high_95", "random", "optimum")
    rows: list[tuple[Any, ...]] = []
    for curve in curves:
        ended = np.count_nonzero(np.isfinite(curve.returns), axis=0).tolist()
        interval = (column.tolist() for column in mean_with_interval(curve.returns))
        levels = ([None] * len(ended) if each is None else each.tolist() for each in (curve.random, curve.optimum))
        iterations = (int(done) for done in curve.iterations)
        rows += [(curve.name, *row) for row in zip(iterations, ended, *interval, *levels, strict=True)]
    return _write(folder, f"{robot}-learning", head, rows)


def write_courses(folder: Path, robot: str, panels: Sequence[Courses]) -> Path:
    """Quartiles over policies of every arm at every recording, with random actions and the optima."""
    head = ("mapping", "arm", "at_min", "policies", "lower_quartile", "median", "upper_quartile", "random")
    rows = []
    for panel in panels:
        for arm, returns in panel.returns.items():
            for i, at_min in enumerate(panel.minutes.tolist()):
                levels = (None if each is None else float(each[i]) for each in (panel.random, panel.optimum))
                known = panel.title, arm, at_min, len(returns), *quartiles(returns)[:, i].tolist()
                rows.append((*known, *levels, panel.fine_optimum.get(at_min)))
    return _write(folder, f"{robot}-over-time", (*head, "optimum_rough_grid", "optimum_fine_grid"), rows)


def write_paths(folder: Path, robot: str, names: Sequence[str], paths: Mapping[str, Paths]) -> Path:
    """One episode of each policy of every arm: observations, and the command or commands that led to each."""
    n = max(math.prod(of.commands.shape[2:]) for of in paths.values())
    heads = ["command"] if n == 1 else [f"command_{number}" for number in range(1, n + 1)]
    rows = (
        (arm, f"p{actor}", i, *observed.tolist(), *(np.ravel(commands[i - 1]).tolist() if i else [None] * n))
        for arm, of in paths.items()
        for actor, (observations, commands) in enumerate(of.episodes())
        for i, observed in enumerate(observations)
    )
    return _write(folder, f"{robot}-paths", ("arm", "policy", "iteration", *names, *heads), rows)


def _write(folder: Path, name: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Path:
    """Write a table with NaN as empty cells."""
    known = ([None if isinstance(cell, float) and math.isnan(cell) else cell for cell in row] for row in rows)
    return write_table(table_file(folder, name), head, known)
