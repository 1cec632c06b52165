"""The study's results as tables: scores of every condition, comparisons, controls, learning curves, the culture."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float64

from animat.errors import InvalidArgument
from animat.evaluation.statistics import compare, holm, interquartile_mean, normalised_score, p_of_u
from animat.studies.evaluating import as_recorded, last_minute
from animat.studies.jobs import Report, Task
from animat.studies.limits import kinds_of
from animat.studies.paper import PRINTED
from animat.studies.places import (
    controls_file,
    episodes_file,
    limits_file,
    policies_folder,
    read_table,
    table_file,
)
from animat.studies.places import write_table as write
from animat.studies.specification import Body, Study, StudyCondition
from animat.training.policy import Policy

LEVEL = 0.01
"""The p below which the issue of a comparison counts as found."""

SCORES = (
    "robot",
    "condition",
    "mapping",
    "at_min",
    "policies",
    "episodes",
    "mean_return",
    "standard_deviation",
    "interquartile_mean",
    "low_95",
    "high_95",
    "random",
    "limit",
    "limit_grid_error",
    "limit_without_clock",
    "normalised_score",
)
COMPARISONS = (
    "comparison",
    "robot",
    "first",
    "second",
    "at_min",
    "episodes",
    "n",
    "mean_first",
    "mean_second",
    "score_first",
    "score_second",
    "random_second",
    "limit_first",
    "limit_second",
    "u",
    "p_normal",
    "p_exact",
    "p_holm",
    "effect",
    "effect_low_95",
    "effect_high_95",
    "outcome",
    "paper_u",
    "paper_p",
    "as_in_paper",
)
CONTROLS = ("robot", "mapping", "percentiles", "at_min", "control", "actors", "mean_return", "standard_error")
CURVES = ("robot", "condition", "policy", "iterations", "episodes", "mean_return")


@final
@dataclass(frozen=True)
class Tabulate(Task):
    """Write `tables/`: scores, comparisons, controls, learning-curves, limits, controllability, findings."""

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        study, timeline = as_recorded(study, folder)
        last = last_minute(timeline)
        files: list[Path] = []

        def table(name: str, head: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
            files.append(write(table_file(folder, name), list(head), [list(row) for row in rows]))

        references = {body.name: References(study, folder, body) for body in study.robots}
        table("scores", SCORES, _scores(study, folder, last, references))
        table("comparisons", COMPARISONS, _comparisons(study, folder, last, references))
        controls = [row for body in study.robots for row in _controls(study, folder, body)]
        table("controls", CONTROLS, controls)
        table("learning-curves", CURVES, _curves(study, folder))
        limits = [(body.name, row) for body in study.robots for row in read_table(limits_file(folder, body.name))]
        if limits:
            table("limits", ("robot", *limits[0][1]), ((robot, *row.values()) for robot, row in limits))
        if timeline is not None:
            rows = (
                (at_min, label, in_data, in_simulator)
                for at_min, kept in zip(timeline.start_min.tolist(), timeline.fidelities, strict=True)
                for label, in_data, in_simulator in zip(
                    kept.labels, kept.in_data.tolist(), kept.in_simulator.tolist(), strict=True
                )
            )
            table("controllability", ("at_min", "condition", "above_median_in_data", "above_median_in_simulator"), rows)
            found = [(finding.severity, finding.name, finding.sentence) for finding in timeline.findings]
            table("findings", ("severity", "name", "sentence"), found)
        return files


class References:
    """Random policies and best possible returns on a robot, for every mapping and minute."""

    def __init__(self, study: Study, folder: Path, body: Body) -> None:
        self._limits: dict[tuple[str, str, float], dict[str, Any]] = {
            (row["mapping"], row["percentiles"], row["at_min"]): row
            for row in read_table(limits_file(folder, body.name))
        }
        self._random: dict[tuple[str, str, float], float] = {}
        for kind in kinds_of(study):
            of_minute: dict[float, list[float]] = defaultdict(list)
            for row in read_table(controls_file(folder, body, kind)):
                if row["control"] == "random":
                    of_minute[row["at_min"]].append(row["return"])
            for at_min, returns in of_minute.items():
                self._random[kind.mapping, kind.percentiles, at_min] = float(np.mean(returns))

    def random(self, condition: StudyCondition, at_min: float) -> float | None:
        """The mean return of random actions, delivered as chosen."""
        return self._of(self._random, condition, at_min)  # type: ignore[no-any-return]

    def limit(self, condition: StudyCondition, at_min: float) -> dict[str, Any] | None:
        """The best possible return and how well it is known, of what is delivered as chosen."""
        return self._of(self._limits, condition, at_min)  # type: ignore[no-any-return]

    def score(self, condition: StudyCondition, at_min: float, mean: float) -> float | None:
        """The normalised score; None where nothing can be learned."""
        random, limit = self.random(condition, at_min), self.limit(condition, at_min)
        if random is None or limit is None:
            return None
        try:
            return normalised_score(mean, random, limit["best_return"])
        except InvalidArgument:
            return None

    @staticmethod
    def _of(known: dict[tuple[str, str, float], Any], condition: StudyCondition, at_min: float) -> Any:
        if condition.through_neurons:
            return known.get((condition.mapping, condition.percentiles, at_min))
        # Without neurons every minute is the same.
        same = [v for (mapping, _, _), v in known.items() if mapping == condition.mapping]
        return same[0] if same else None


def performances(
    folder: Path, body: Body, condition: StudyCondition, at_min: float, episodes: int | None = None
) -> Float64[np.ndarray, " policies"]:
    """Each policy's mean return over its first `episodes` at a minute, or all: the paper's measure of a policy."""
    returns: dict[str, list[float]] = defaultdict(list)
    for row in read_table(episodes_file(folder, body, condition)):
        if row["at_min"] == at_min:
            returns[row["actor"]].append(row["return"])
    return np.array([np.mean(of_policy[:episodes]) for of_policy in returns.values()])


def _scores(study: Study, folder: Path, last: float, references: dict[str, References]) -> Iterable[tuple[Any, ...]]:
    for body in study.robots:
        known = references[body.name]
        for condition in study.conditions:
            for at_min, episodes in sorted(study.minutes_of(condition, last).items()):
                means = performances(folder, body, condition, at_min)
                middle = interquartile_mean(means)
                limit = known.limit(condition, at_min) or {}
                yield (
                    body.name,
                    condition.name,
                    condition.mapping,
                    at_min,
                    len(means),
                    episodes,
                    float(means.mean()),
                    float(means.std(ddof=1)) if len(means) > 1 else None,
                    middle.value,
                    middle.low,
                    middle.high,
                    known.random(condition, at_min),
                    limit.get("best_return"),
                    limit.get("grid_error"),
                    limit.get("without_clock"),
                    known.score(condition, at_min, float(means.mean())),
                )


def _comparisons(study: Study, folder: Path, last: float, references: dict[str, References]) -> list[tuple[Any, ...]]:
    made = []
    for compared in study.comparisons:
        at_min = last if compared.at_min is None else compared.at_min
        first, second = study.condition(compared.first), study.condition(compared.second)
        for body in study.robots:
            a, b = (performances(folder, body, side, at_min, compared.episodes) for side in (first, second))
            made.append((compared, body, first, second, at_min, a, b, compare(a, b)))
    corrected = holm({f"{compared.name}/{body.name}": told.p_normal for compared, body, *_, told in made})
    rows = []
    for compared, body, first, second, at_min, a, b, told in made:
        known = references[body.name]
        printed = PRINTED.get((compared.name, body.name)) if study.paper else None
        found = told.p_normal < LEVEL
        # With four policies a side even U = 0 has p = 0.03: nothing could be found, which is not "no difference".
        could = p_of_u(0.0, len(a), len(b)) < LEVEL
        better = "second" if told.u_first < len(a) * len(b) / 2 else "first"
        limits = [known.limit(condition, at_min) or {} for condition in (first, second)]
        rows.append(
            (
                compared.name,
                body.name,
                first.name,
                second.name,
                at_min,
                compared.episodes,
                len(a),
                float(a.mean()),
                float(b.mean()),
                known.score(first, at_min, float(a.mean())),
                known.score(second, at_min, float(b.mean())),
                known.random(second, at_min),
                limits[0].get("best_return"),
                limits[1].get("best_return"),
                told.u,
                told.p_normal,
                told.p_exact,
                corrected[f"{compared.name}/{body.name}"],
                told.effect.value,
                told.effect.low,
                told.effect.high,
                f"{better} better" if found else "no difference" if could else "too few policies to tell",
                None if printed is None else printed.u,
                None if printed is None else printed.p,
                None if printed is None else "yes" if found and better == "second" else "no",
            )
        )
    return rows


def _controls(study: Study, folder: Path, body: Body) -> Iterable[tuple[Any, ...]]:
    for kind in kinds_of(study):
        returns: dict[tuple[float, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        for row in read_table(controls_file(folder, body, kind)):
            returns[row["at_min"], row["control"]][row["actor"] or ""].append(row["return"])
        for (at_min, control), actors in returns.items():
            means = np.array([np.mean(of_actor) for of_actor in actors.values()])
            # Over actors, as each is one sample; a control of one actor has its episodes for samples.
            samples = means if len(means) > 1 else np.array(next(iter(actors.values())))
            error = float(samples.std(ddof=1) / np.sqrt(len(samples))) if len(samples) > 1 else None
            yield body.name, kind.mapping, kind.percentiles, at_min, control, len(means), float(means.mean()), error


def _curves(study: Study, folder: Path) -> Iterable[tuple[Any, ...]]:
    for body in study.robots:
        for condition in study.conditions:
            out = policies_folder(folder, body, condition)
            for i in range(study.policies if condition.trained else 0):
                curve = Policy.load(out / f"p{i}.safetensors").learning_curve
                for iterations, episodes, mean_return in curve.tolist():
                    mean = None if np.isnan(mean_return) else mean_return
                    yield body.name, condition.name, f"p{i}", int(iterations), int(episodes), mean
