"""The best possible returns as jobs: at the minutes of the comparisons, and roughly at every recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from animat.animat import Animat
from animat.evaluation.optimum import Case, Optimum, best_returns
from animat.evaluation.resampling import Counted, few_of
from animat.progress import Part, Progress
from animat.robots.capabilities import lacking
from animat.robots.grid import no_grid
from animat.studies.evaluating import as_recorded, first_minute, last_minute, setting_of
from animat.studies.places import limits_file, read_table, write_table
from animat.studies.simulating import read_series
from animat.studies.specification import Body, Study, StudyCondition
from animat.studies.task import StudyTask

HEAD = (
    "mapping",
    "percentiles",
    "at_min",
    "best_return",
    "low_95",
    "high_95",
    "grid_error",
    "monte_carlo",
    "standard_error",
    "without_clock",
    "without_clock_standard_error",
    "nodes",
    "left_out",
)
ROUGH = 0.5
"""Steps of the grid along each axis where every recording has its limit, as a part of those elsewhere."""
COARSER = 0.8
"""Steps of the grid of redrawn responses along each axis, at most, as a part of the limit's."""


def kinds_of(study: Study) -> list[StudyCondition]:
    """One condition for each mapping and way to hold percentiles, delivered as chosen: each has a limit of its own."""
    kinds: dict[tuple[str, str], StudyCondition] = {}
    for condition in study.conditions:
        limit = StudyCondition("limit", mapping=condition.mapping, percentiles=condition.percentiles)
        kinds.setdefault((condition.mapping, condition.percentiles), limit)
    return list(kinds.values())


def rough_kinds(study: Study) -> list[StudyCondition]:
    """Of `kinds_of`, those whose limit is computed at every recording; of mappings without steps that is long."""
    return [kind for kind in kinds_of(study) if kind.has_steps]


def limits_of_all(folder: Path, robot: str, what: str = "limits") -> list[dict[str, Any]]:
    """The limits of all conditions; what policies could do with fewer is none of theirs."""
    return [row for row in read_table(limits_file(folder, robot, what)) if row["left_out"] is None]


def left_out(study: Study) -> list[str]:
    """What its robots cannot do, and the study is without: a sentence each."""
    sentences: list[str] = []
    for robot in dict.fromkeys(body.robot() for body in study.robots):
        lacks = lacking(robot)
        if (why_not := no_grid(robot)) is not None:
            lacks.setdefault("value_grid", f"no best possible return: {why_not}")
        sentences += lacks.values()
    return sentences


@final
@dataclass(frozen=True)
class Limit(StudyTask):
    """The best possible return on a robot for every mapping of the study, of conditions with enough responses.

    Of a robot without a grid the table is empty.

    Attributes:
        over_time: at every recording, on a rough grid, without the controller's return and without an interval; if not,
            at the minutes that anything is evaluated at.
    """

    sizes = ("limit_resolution", "limit_episodes")

    body: Body
    over_time: bool = False

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        file = limits_file(folder, self.body.name, "over-time" if self.over_time else "limits")
        if no_grid(self.body.robot()) is not None:
            return [write_table(file, HEAD, [])]
        study, timeline = as_recorded(self.study, folder)
        first, last = first_minute(timeline), last_minute(timeline)
        kinds, minutes = kinds_of(study), study.limit_minutes(first, last)
        resolution, episodes = self.body.limit_resolution or study.limit_resolution, study.limit_episodes
        if self.over_time and timeline is not None:
            kinds, minutes = rough_kinds(study), timeline.start_min.tolist()
            resolution, episodes = min(ROUGH, resolution), 0
        asked = [(kind, at) for kind in kinds for at in (minutes if kind.through_neurons else [last])]
        cases: dict[int, Case] = {}
        counted: dict[int, Counted] = {}
        left_out: dict[int, tuple[str, ...]] = {}
        if timeline is not None:
            series = sorted(read_series(study, folder), key=lambda responses: responses.start_min)
            timeline = replace(timeline, responses=tuple(series))
        for i, (kind, at) in enumerate(asked):
            environment = setting_of(study, self.body, kind, timeline).environment
            if timeline is None or not isinstance(environment, Animat):
                cases[i] = environment, None
                continue
            responses = timeline.responses[timeline.row_at(at)]
            left_out[i] = few_of(responses)
            if len(left_out[i]) < len(responses.conditions):
                of = Counted.of(environment, timeline, at, are_held=kind.percentiles == "first")
                counted[i], cases[i] = of, (of.environment, of.simulator)
        # Cases side by side all have as many actions as the one with the most, and as many commands as all together: a
        # continuous one has many, and over time there are many cases.
        alike: dict[object, list[int]] = {}
        for i, (environment, _) in cases.items():
            alike.setdefault(asked[i][0] if self.over_time else environment.n_actions is None, []).append(i)
        known = {} if self.over_time else {i: counted[i] for i in counted if asked[i] in _compared(study, first, last)}
        steps = len(cases) + len(known)
        found: dict[int, Optimum] = {}
        for same in alike.values():
            part = Part(progress, len(found), len(same), steps)
            best = best_returns(
                [cases[i] for i in same], resolution=resolution, episodes=episodes, seed=study.seed, progress=part
            )
            found |= dict(zip(same, best, strict=True))
        for done, (i, of) in enumerate(known.items(), len(cases) + 1):
            found[i] = of.known(found[i], resolution=COARSER * resolution, seed=study.seed)
            progress.update(done, steps, "how well it is known")
        rows = [
            (kind.mapping, kind.percentiles, at, *_cells(found.get(i)), "; ".join(left_out.get(i, ())) or None)
            for i, (kind, at) in enumerate(asked)
        ]
        return [write_table(file, HEAD, rows)]


def _compared(study: Study, first: float, last: float) -> list[tuple[StudyCondition, float]]:
    """Threshold mappings at the minutes that conditions of theirs are evaluated at: whose limits have an interval."""
    return [
        (kind, at)
        for kind in rough_kinds(study)
        for condition in study.conditions
        if (condition.mapping, condition.percentiles) == (kind.mapping, kind.percentiles)
        for at in study.minutes_of(condition, first, last)
    ]


def _cells(optimum: Optimum | None) -> tuple[float | int | None, ...]:
    """Of the head, from the best return to the nodes; nothing where no condition has enough responses."""
    if optimum is None:
        return (None,) * len(HEAD[3:-1])
    told, interval = optimum.to_dict(), optimum.interval
    told["best_return"] = told["value"]
    told["low_95"], told["high_95"] = (None, None) if interval is None else (interval.low, interval.high)
    return tuple(told[name] for name in HEAD[3:-1])
