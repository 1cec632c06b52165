"""The best possible returns as jobs: at the minutes of the comparisons, and roughly at every recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

from animat.evaluation.optimum import Case, Optimum, best_returns
from animat.studies.evaluating import as_recorded, first_minute, last_minute, setting_of
from animat.studies.jobs import Report, Task
from animat.studies.places import limits_file, write_table
from animat.studies.specification import Body, Study, StudyCondition

HEAD = (
    "mapping",
    "percentiles",
    "at_min",
    "best_return",
    "grid_error",
    "monte_carlo",
    "standard_error",
    "without_clock",
    "without_clock_standard_error",
    "nodes",
)
ROUGH = 0.5
"""Steps of the grid along each axis where every recording has its limit, as a part of those elsewhere."""


def kinds_of(study: Study) -> list[StudyCondition]:
    """One condition for each mapping and way to hold percentiles, delivered as chosen: each has a limit of its own."""
    kinds: dict[tuple[str, str], StudyCondition] = {}
    for condition in study.conditions:
        limit = StudyCondition("limit", mapping=condition.mapping, percentiles=condition.percentiles)
        kinds.setdefault((condition.mapping, condition.percentiles), limit)
    return list(kinds.values())


def rough_kinds(study: Study) -> list[StudyCondition]:
    """Of `kinds_of`, those whose limit is computed at every recording: the linear mapping's would take long."""
    return [kind for kind in kinds_of(study) if kind.through_neurons and kind.mapping != "linear"]


@final
@dataclass(frozen=True)
class Limit(Task):
    """The best possible return on a robot for every mapping of the study.

    Attributes:
        over_time: at every recording, on a rough grid and without running the controller; if not, at the minutes that
            anything is evaluated at.
    """

    grows_with = ("limit_resolution", "limit_episodes")

    body: Body
    over_time: bool = False

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        study, timeline = as_recorded(study, folder)
        first, last = first_minute(timeline), last_minute(timeline)
        kinds, minutes = kinds_of(study), study.limit_minutes(first, last)
        resolution, episodes = self.body.limit_resolution or study.limit_resolution, study.limit_episodes
        if self.over_time and timeline is not None:
            kinds, minutes = rough_kinds(study), timeline.start_min.tolist()
            resolution, episodes = min(ROUGH, resolution), 0
        asked = [(kind, at) for kind in kinds for at in (minutes if kind.through_neurons else [last])]
        cases: list[Case] = []
        for kind, at in asked:
            setting = setting_of(study, self.body, kind, timeline)
            cases.append((setting.environment, setting.simulator(at)))
        # Cases side by side all have as many actions as the one with the most, and as many commands as all together: a
        # continuous one has many, and over time there are many cases.
        alike: dict[object, list[int]] = {}
        for i, (environment, _) in enumerate(cases):
            alike.setdefault(asked[i][0] if self.over_time else environment.n_actions is None, []).append(i)
        told = _Told(report, len(cases))
        found: dict[int, Optimum] = {}
        for same in alike.values():
            best = best_returns(
                [cases[i] for i in same], resolution=resolution, episodes=episodes, seed=study.seed, progress=told
            )
            found |= dict(zip(same, best, strict=True))
            told.before += len(same)
        rows = []
        for i, (kind, at) in enumerate(asked):
            best_of = found[i].to_dict()
            best_of["best_return"] = best_of["value"]
            rows.append((kind.mapping, kind.percentiles, at, *(best_of[name] for name in HEAD[3:])))
        return [
            write_table(limits_file(folder, self.body.name, "over-time" if self.over_time else "limits"), HEAD, rows)
        ]


class _Told:
    def __init__(self, report: Report, n_cases: int) -> None:
        self._report, self._n_cases, self.before = report, n_cases, 0

    def update(self, done: float, total: float, note: str = "") -> None:
        self._report((self.before + done) / self._n_cases, note)
