"""Jobs that compute optimal returns: at the minutes of the comparisons, and on a coarse grid at every recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from animat.environment import Animat
from animat.evaluation.optimal_returns import WellSampled, undersampled
from animat.evaluation.optimum import Case, Optimum, best_returns
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Part, Progress
from animat.report.results import StudyOptimum
from animat.robots.base import lacking
from animat.robots.grid import why_no_grid
from animat.studies.evaluating import as_recorded, setting_of
from animat.studies.folder import optima_file
from animat.studies.recording import read_series
from animat.studies.results import read_typed, write_typed
from animat.studies.specification import Arm, RobotSpec, Study
from animat.studies.task import StudyTask

STEPS_OVER_TIME = 0.5
"""Grid steps along each axis for the optima of every recording, as a fraction of those elsewhere."""
STEPS_BOOTSTRAPPED = 0.8
"""Grid steps along each axis for bootstrapped responses, at most, as a fraction of the optimum's."""
_COPIED = ("grid_error", "monte_carlo", "standard_error", "without_clock", "without_clock_standard_error", "nodes")
"""Columns of the table that an `Optimum` has under the same name."""


def kinds_of(study: Study) -> list[Arm]:
    """One arm for each mapping and percentile setting, delivered as chosen: each has its own optimum."""
    kinds = [Arm("optimum", mapping=arm.mapping, percentiles=arm.percentiles) for arm in study.arms]
    return list(dict.fromkeys(kinds))


def kinds_over_time(study: Study) -> list[Arm]:
    """The `kinds_of` whose optimum is computed at every recording, which takes too long for mappings without steps."""
    return [kind for kind in kinds_of(study) if kind.has_steps]


def read_optima(folder: Path, robot: str, what: str = "optima") -> tuple[StudyOptimum, ...]:
    """All optima that the job wrote."""
    return read_typed(optima_file(folder, robot, what), tuple[StudyOptimum, ...])


def complete_optima(optima: Iterable[StudyOptimum]) -> dict[tuple[str, str, float], StudyOptimum]:
    """The optima of one robot over all conditions, by `key_of`; those over fewer do not apply to the policies."""
    return {key_of(optimum, optimum.at_min): optimum for optimum in optima if optimum.left_out is None}


def key_of(of: Arm | StudyOptimum, at_min: float) -> tuple[str, str, float]:
    """What identifies an optimum on a robot: without neurons every minute is the same."""
    return of.mapping, of.percentiles, 0.0 if of.mapping == "none" else at_min


def missing_capabilities(study: Study) -> list[str]:
    """A sentence for each thing that a robot of the study cannot do, and that the study therefore lacks."""
    sentences: list[str] = []
    for robot in dict.fromkeys(spec.robot() for spec in study.robots):
        lacks = lacking(robot)
        if (why_not := why_no_grid(robot)) is not None:
            lacks.setdefault("value_grid", f"no optimal return: {why_not}")
        sentences.extend(lacks.values())
    # Robots of one kind with different parameters lack the same.
    return list(dict.fromkeys(sentences))


@dataclass(frozen=True)
class FindOptima(StudyTask):
    """Compute the optimal return on a robot for every mapping of the study, over conditions with enough responses.

    It is computed at the minutes at which anything is evaluated, or `over_time` at every recording, on a coarse grid,
    without the controller's return and without an interval. For a robot without a grid the table is empty.
    """

    sizes = ("optimum_resolution", "optimum_episodes")

    spec: RobotSpec
    over_time: bool = False

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        file = optima_file(folder, self.spec.name, "over-time" if self.over_time else "optima")
        if why_no_grid(self.spec.robot()) is not None:
            return [write_typed(file, [])]
        study, timeline, first, last = as_recorded(self.study, folder)
        kinds, minutes = kinds_of(study), study.optimum_minutes(first, last)
        resolution, episodes = self.spec.optimum_resolution or study.optimum_resolution, study.optimum_episodes
        if self.over_time and timeline is not None:
            kinds, minutes = kinds_over_time(study), timeline.start_min.tolist()
            resolution, episodes = min(STEPS_OVER_TIME, resolution), 0
        if timeline is not None:
            timeline = replace(timeline, responses=tuple(read_series(study, folder)))
        requests = [
            self._request(kind, at, timeline) for kind in kinds for at in (minutes if kind.through_neurons else [last])
        ]
        # Cases computed together are padded to the most actions, and to the commands of all. So continuous ones, which
        # have many, are computed apart, and over time, where there are many cases, each kind is.
        batches: dict[object, list[_Request]] = {}
        for each in requests:
            if each.case is not None:
                batches.setdefault(each.kind if self.over_time else each.case[0].n_actions is None, []).append(each)
        # Threshold mappings have an interval at the minutes at which their arms are evaluated.
        arms = [] if self.over_time else [arm for arm in study.arms if arm.has_steps]
        evaluated = {(arm.kind, at) for arm in arms for at in study.minutes_of(arm, first, last)}
        bootstrapped = [each for each in requests if each.counted and (each.kind.kind, each.at_min) in evaluated]
        done, steps = 0, sum(map(len, batches.values())) + len(bootstrapped)
        coarser = STEPS_BOOTSTRAPPED * resolution
        for batch in batches.values():
            part = Part(progress, done, len(batch), steps)
            cases = [each.case for each in batch if each.case is not None]
            best = best_returns(cases, resolution=resolution, episodes=episodes, seed=study.seed, progress=part)
            for each, optimum in zip(batch, best, strict=True):
                each.optimum = optimum
            done += len(batch)
        for each in bootstrapped:
            assert each.counted is not None and each.optimum is not None
            each.optimum = each.counted.with_interval(each.optimum, resolution=coarser, seed=study.seed)
            done += 1
            progress.update(done, steps, "intervals")
        return [write_typed(file, [each.to_row(self.spec.name) for each in requests])]

    def _request(self, kind: Arm, at_min: float, timeline: SimulatorTimeline | None) -> _Request:
        environment = setting_of(self.study, self.spec, kind, timeline).environment
        if timeline is None or not isinstance(environment, Animat):
            return _Request(kind, at_min, case=(environment, None))
        responses = timeline.responses[timeline.row_at(at_min)]
        few = undersampled(responses)
        if len(few) == len(responses.conditions):
            return _Request(kind, at_min, left_out=few)
        of = WellSampled.of(environment, timeline, at_min, kind.percentiles)
        return _Request(kind, at_min, case=(of.environment, of.simulator), counted=of, left_out=few)


@dataclass
class _Request:
    """An optimum to compute: `case` is None if no condition has enough responses, `counted` None without neurons."""

    kind: Arm
    at_min: float
    case: Case | None = None
    counted: WellSampled | None = None
    left_out: tuple[str, ...] = ()
    optimum: Optimum | None = None

    def to_row(self, robot: str) -> StudyOptimum:
        known: dict[str, Any] = {} if self.optimum is None else self.optimum.to_dict()
        interval, few = known.get("interval") or {}, "; ".join(self.left_out) or None
        bracket = known.get("value"), interval.get("low"), interval.get("high")
        copied: dict[str, Any] = {name: known.get(name) for name in _COPIED}
        return StudyOptimum(robot, *self.kind.kind, self.at_min, *bracket, **copied, left_out=few)
