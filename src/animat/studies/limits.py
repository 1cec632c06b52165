"""The best possible returns as jobs: at the minutes of the comparisons, and roughly at every recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

from animat.evaluation.optimum import Case, Optimum, best_returns
from animat.studies.evaluating import as_recorded, last_minute, setting_of
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


@final
@dataclass(frozen=True)
class Limit(Task):
    """The best possible return on a robot for every mapping of the study.

    Attributes:
        over_time: at every recording, for the first mapping with neurons only, on a rough grid; if not, at the minutes
            of the comparisons.
    """

    body: Body
    over_time: bool = False

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        study, timeline = as_recorded(study, folder)
        last = last_minute(timeline)
        kinds, minutes = kinds_of(study), study.limit_minutes(last)
        resolution, episodes = self.body.limit_resolution or study.limit_resolution, study.limit_episodes
        if self.over_time and timeline is not None:
            kinds = [kind for kind in kinds if kind.through_neurons][:1]
            minutes, resolution, episodes = timeline.start_min.tolist(), min(ROUGH, resolution), 2
        asked = [(kind, at) for kind in kinds for at in (minutes if kind.through_neurons else [last])]
        cases: list[Case] = []
        for kind, at in asked:
            setting = setting_of(study, self.body, kind, timeline)
            cases.append((setting.environment, setting.simulator(at)))
        told = _Told(report)
        found: dict[int, Optimum] = {}
        # Cases side by side all have as many actions as the one with the most, and a continuous one has many.
        for continuous in (False, True):
            same = [i for i, (environment, _) in enumerate(cases) if (environment.n_actions is None) == continuous]
            if same:
                best = best_returns(
                    [cases[i] for i in same], resolution=resolution, episodes=episodes, seed=study.seed, progress=told
                )
                found |= dict(zip(same, best, strict=True))
        rows = [
            (
                kind.mapping,
                kind.percentiles,
                at,
                best.value,
                best.grid_error,
                best.monte_carlo,
                best.standard_error,
                best.without_clock,
                best.without_clock_standard_error,
                best.nodes,
            )
            for i, (kind, at) in enumerate(asked)
            for best in (found[i],)
        ]
        return [
            write_table(limits_file(folder, self.body.name, "over-time" if self.over_time else "limits"), HEAD, rows)
        ]


class _Told:
    def __init__(self, report: Report) -> None:
        self._report = report

    def update(self, done: float, total: float, note: str = "") -> None:
        self._report(done / total, note)
