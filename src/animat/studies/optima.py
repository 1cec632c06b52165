"""The optimal returns as jobs: at the minutes of the comparisons, and roughly at every recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from animat.environment import Animat
from animat.evaluation.optimum import Case, Optimum, best_returns
from animat.evaluation.resampling import Counted, few_of
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Part, Progress
from animat.report.results import StudyOptimum
from animat.robots.base import lacking
from animat.robots.grid import no_grid
from animat.studies.evaluating import as_recorded, setting_of, span_min
from animat.studies.places import optima_file
from animat.studies.results import read_typed, write_typed
from animat.studies.simulating import read_series
from animat.studies.specification import Arm, RobotSpec, Study
from animat.studies.task import StudyTask

ROUGH = 0.5
"""Steps of the grid along each axis where every recording has its optimum, as a part of those elsewhere."""
COARSER = 0.8
"""Steps of the grid of bootstrapped responses along each axis, at most, as a part of the optimum's."""


def kinds_of(study: Study) -> list[Arm]:
    """One arm for each mapping and way to hold percentiles, delivered as chosen: each has its own optimum."""
    alike = [Arm("optimum", mapping=arm.mapping, percentiles=arm.percentiles) for arm in study.arms]
    return list(dict.fromkeys(alike))


def rough_kinds(study: Study) -> list[Arm]:
    """Of `kinds_of`, those whose optimum is computed at every recording; of mappings without steps that is long."""
    return [kind for kind in kinds_of(study) if kind.has_steps]


def read_complete_optima(folder: Path, robot: str, what: str = "optima") -> list[StudyOptimum]:
    """The optima of all conditions; what policies could do with fewer is none of theirs."""
    return [optimum for optimum in read_optima(folder, robot, what) if optimum.left_out is None]


def read_optima(folder: Path, robot: str, what: str = "optima") -> tuple[StudyOptimum, ...]:
    """The optima as the job left them."""
    return read_typed(optima_file(folder, robot, what), tuple[StudyOptimum, ...])


def left_out(study: Study) -> list[str]:
    """What its robots cannot do, and the study is without: a sentence each."""
    messages: list[str] = []
    for robot in dict.fromkeys(spec.robot() for spec in study.robots):
        lacks = lacking(robot)
        if (why_not := no_grid(robot)) is not None:
            lacks.setdefault("value_grid", f"no optimal return: {why_not}")
        messages += lacks.values()
    return messages


@final
@dataclass(frozen=True)
class FindOptima(StudyTask):
    """The optimal return on a robot for every mapping of the study, of conditions with enough responses.

    Of a robot without a grid the table is empty.

    Attributes:
        over_time: at every recording, on a rough grid, without the controller's return and without an interval; if not,
            at the minutes that anything is evaluated at.
    """

    sizes = ("optimum_resolution", "optimum_episodes")

    spec: RobotSpec
    over_time: bool = False

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        file = optima_file(folder, self.spec.name, "over-time" if self.over_time else "optima")
        if no_grid(self.spec.robot()) is not None:
            return [write_typed(file, [])]
        study, timeline = as_recorded(self.study, folder)
        first, last = span_min(timeline)
        kinds, minutes = kinds_of(study), study.optimum_minutes(first, last)
        resolution, episodes = self.spec.optimum_resolution or study.optimum_resolution, study.optimum_episodes
        if self.over_time and timeline is not None:
            kinds, minutes = rough_kinds(study), timeline.start_min.tolist()
            resolution, episodes = min(ROUGH, resolution), 0
        if timeline is not None:
            series = sorted(read_series(study, folder), key=lambda responses: responses.start_min)
            timeline = replace(timeline, responses=tuple(series))
        asked = [
            self._asked(kind, at, timeline) for kind in kinds for at in (minutes if kind.through_neurons else [last])
        ]
        # Cases side by side all have as many actions as the one with the most, and as many commands as all together: a
        # continuous one has many, and over time there are many cases.
        alike: dict[object, list[_Asked]] = {}
        for each in asked:
            if each.case is not None:
                alike.setdefault(each.kind if self.over_time else each.case[0].n_actions is None, []).append(each)
        compared = [] if self.over_time else _compared(study, first, last)
        known = [each for each in asked if each.counted is not None and (each.kind, each.at_min) in compared]
        done, steps = 0, sum(map(len, alike.values())) + len(known)
        for same in alike.values():
            part = Part(progress, done, len(same), steps)
            cases = [each.case for each in same if each.case is not None]
            best = best_returns(cases, resolution=resolution, episodes=episodes, seed=study.seed, progress=part)
            for each, optimum in zip(same, best, strict=True):
                each.optimum = optimum
            done += len(same)
        for each in known:
            assert each.counted is not None and each.optimum is not None
            each.optimum = each.counted.known(each.optimum, resolution=COARSER * resolution, seed=study.seed)
            done += 1
            progress.update(done, steps, "how well it is known")
        return [write_typed(file, [each.told(self.spec.name) for each in asked])]

    def _asked(self, kind: Arm, at_min: float, timeline: SimulatorTimeline | None) -> _Asked:
        environment = setting_of(self.study, self.spec, kind, timeline).environment
        if timeline is None or not isinstance(environment, Animat):
            return _Asked(kind, at_min, case=(environment, None))
        responses = timeline.responses[timeline.row_at(at_min)]
        few = few_of(responses)
        if len(few) == len(responses.conditions):
            return _Asked(kind, at_min, left_out=few)
        of = Counted.of(environment, timeline, at_min, are_fixed=kind.percentiles == "first")
        return _Asked(kind, at_min, case=(of.environment, of.simulator), counted=of, left_out=few)


@dataclass
class _Asked:
    """An optimum that is asked for.

    Attributes:
        case: where it is; None where no condition has enough responses.
        counted: the responses that it is of; None without neurons.
        left_out: conditions with too few responses.
    """

    kind: Arm
    at_min: float
    case: Case | None = None
    counted: Counted | None = None
    left_out: tuple[str, ...] = ()
    optimum: Optimum | None = None

    def told(self, robot: str) -> StudyOptimum:
        """A row of the table."""
        kind, few = self.kind, "; ".join(self.left_out) or None
        return StudyOptimum(robot, kind.mapping, kind.percentiles, self.at_min, **_known(self.optimum), left_out=few)


def _compared(study: Study, first: float, last: float) -> list[tuple[Arm, float]]:
    """Threshold mappings at the minutes that arms of theirs are evaluated at: whose optima have an interval."""
    return [
        (kind, at)
        for kind in rough_kinds(study)
        for arm in study.arms_of(kind)
        for at in study.minutes_of(arm, first, last)
    ]


def _known(optimum: Optimum | None) -> dict[str, Any]:
    """The fields of an optimum from the best return to the nodes; None where no condition has enough responses."""
    told = {} if optimum is None else optimum.to_dict()
    interval = None if optimum is None else optimum.interval
    names = ("grid_error", "monte_carlo", "standard_error", "without_clock", "without_clock_standard_error", "nodes")
    return {
        "best_return": told.get("value"),
        "low_95": None if interval is None else interval.low,
        "high_95": None if interval is None else interval.high,
        **{name: told.get(name) for name in names},
    }
