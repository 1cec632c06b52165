"""The study's results as tables: scores of every condition, comparisons, controls, learning curves, the culture."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float64

from animat.errors import InvalidArgument
from animat.evaluation.optimum import bracket_findings
from animat.evaluation.statistics import Comparison, compare, holm, interquartile_mean, normalised_score, p_of_u
from animat.progress import Progress
from animat.recordings.findings import Finding
from animat.studies.evaluating import as_recorded, first_minute, last_minute
from animat.studies.heuristic import HEAD, rows_beside_heuristic
from animat.studies.limits import HEAD as LIMITS
from animat.studies.limits import kinds_of, left_out, limits_of_all
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
from animat.studies.task import StudyTask
from animat.training.policy import Policy

LEVEL = 0.01
"""The p, by the normal approximation and uncorrected as the paper's, below which a comparison's issue is found."""

AIM = 0.97
"""Normalised score from which a condition counts as being as good as its limit allows."""

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
    "limit_run",
    "limit_run_standard_error",
    "limit_without_clock",
    "normalised_score",
    "score_without_clock",
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
    "limit_error_first",
    "limit_error_second",
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
LEFT_OUT = "left-out"
"""The finding that a robot cannot do something, which the study is without."""

TRAINED = "trained: "
"""In front of a condition's name among the controls."""

CONTROLS = (
    "robot",
    "mapping",
    "percentiles",
    "at_min",
    "control",
    "actors",
    "mean_return",
    "standard_error",
    "random",
    "limit",
    "normalised_score",
)
CURVES = ("robot", "condition", "policy", "iterations", "episodes", "mean_return")


@final
@dataclass(frozen=True)
class Tabulate(StudyTask):
    """Write `tables/`: scores, comparisons, controls, heuristic, learning-curves, limits, controllability, findings."""

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        study, timeline = as_recorded(self.study, folder)
        first, last = first_minute(timeline), last_minute(timeline)
        files: list[Path] = []

        def table(name: str, head: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
            files.append(write(table_file(folder, name), list(head), [list(row) for row in rows]))

        references = {body.name: References(study, folder, body) for body in study.robots}
        table("scores", SCORES, _scores(study, folder, first, last, references))
        table("comparisons", COMPARISONS, _comparisons(study, folder, last, references))
        controls = [row for body in study.robots for row in _controls(study, folder, body, references[body.name])]
        table("controls", CONTROLS, controls)
        table("heuristic", HEAD, [row for body in study.robots for row in rows_beside_heuristic(study, folder, body)])
        table("learning-curves", CURVES, _curves(study, folder))
        limits = [(body.name, row) for body in study.robots for row in read_table(limits_file(folder, body.name))]
        table("limits", ("robot", *LIMITS), ((robot, *row.values()) for robot, row in limits))
        if timeline is not None:
            rows = (
                (at_min, label, in_data, in_simulator)
                for at_min, kept in zip(timeline.start_min.tolist(), timeline.fidelities, strict=True)
                for label, in_data, in_simulator in zip(
                    kept.labels, kept.in_data.tolist(), kept.in_simulator.tolist(), strict=True
                )
            )
            table("controllability", ("at_min", "condition", "above_median_in_data", "above_median_in_simulator"), rows)
        noticed = [] if timeline is None else list(timeline.findings)
        for robot, row in limits:
            if row["best_return"] is None:
                continue
            of = (row[name] for name in ("best_return", "grid_error", "monte_carlo", "standard_error"))
            where = f"{robot}, {named_mapping(row['mapping'], row['percentiles'])}, at {row['at_min']:g} min"
            noticed += [replace(told, sentence=f"{where}: {told.sentence}") for told in bracket_findings(*of)]
        noticed += [Finding(LEFT_OUT, "note", sentence) for sentence in left_out(study)]
        table("findings", ("severity", "name", "sentence"), ((n.severity, n.name, n.sentence) for n in noticed))
        return files


class References:
    """Random policies and best possible returns on a robot, for every mapping and minute."""

    def __init__(self, study: Study, folder: Path, body: Body) -> None:
        self._limits: dict[tuple[str, str, float], dict[str, Any]] = {
            (row["mapping"], row["percentiles"], row["at_min"]): row for row in limits_of_all(folder, body.name)
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
        """The best possible return and how well it is known.

        None for a control, which can do nothing, and where conditions with few responses were left out of it.
        """
        if condition.delivery == "shuffled":
            return None
        return self._of(self._limits, condition, at_min)  # type: ignore[no-any-return]

    def score(
        self, condition: StudyCondition, at_min: float, mean: float, against: str = "best_return"
    ) -> float | None:
        """The normalised score, against the limit or another column of its table; None where nothing can be learned."""
        random, limit = self.random(condition, at_min), self.limit(condition, at_min)
        if random is None or limit is None or limit[against] is None:
            return None
        try:
            return normalised_score(mean, random, limit[against])
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


def named_mapping(mapping: str, percentiles: str) -> str:
    """A mapping in words, with whether its percentiles are held."""
    held = ", percentiles held" if percentiles == "first" else ""
    return "without neurons" if mapping == "none" else f"{mapping}{held}"


def _scores(
    study: Study, folder: Path, first: float, last: float, references: dict[str, References]
) -> Iterable[tuple[Any, ...]]:
    for body in study.robots:
        known = references[body.name]
        for condition in study.conditions:
            for at_min, episodes in sorted(study.minutes_of(condition, first, last).items()):
                means = performances(folder, body, condition, at_min)
                middle = interquartile_mean(means, within=body.robot().return_range)
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
                    limit.get("monte_carlo"),
                    limit.get("standard_error"),
                    limit.get("without_clock"),
                    known.score(condition, at_min, float(means.mean())),
                    known.score(condition, at_min, float(means.mean()), "without_clock"),
                )


FIRST, SECOND, NONE, TOO_FEW = (
    "first better",
    "second better",
    f"none found (p ≥ {LEVEL:g})",
    "too few policies to tell",
)

AS_IN_PAPER = {FIRST: "no", SECOND: "yes", NONE: "no", TOO_FEW: "cannot tell"}
"""Of each outcome, whether it is the paper's, in which the second condition was always the better."""


def outcome_of(told: Comparison) -> str:
    """In words: which condition is better, that neither was found to be, or that it could not have been found."""
    if told.p_normal < LEVEL:
        return SECOND if told.effect.value > 0 else FIRST
    # With four policies a side even U = 0 has p = 0.03: nothing could be found, which says nothing of a difference.
    return NONE if p_of_u(0.0, told.n_first, told.n_second) < LEVEL else TOO_FEW


def _limit_error(limit: dict[str, Any]) -> float | None:
    """How far the best possible return may lie from its value: by the grid, or down to the controller's return."""
    if not limit:
        return None
    names = ("best_return", "grid_error", "monte_carlo", "standard_error")
    parted = bracket_findings(*(limit[name] for name in names))
    error: float = max([limit["grid_error"], *(abs(each.value or 0.0) for each in parted)])
    return error


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
        outcome = outcome_of(told)
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
                _limit_error(limits[0]),
                _limit_error(limits[1]),
                told.u,
                told.p_normal,
                told.p_exact,
                corrected[f"{compared.name}/{body.name}"],
                told.effect.value,
                told.effect.low,
                told.effect.high,
                outcome,
                None if printed is None else printed.u,
                None if printed is None else printed.p,
                None if printed is None else AS_IN_PAPER[outcome],
            )
        )
    return rows


def _controls(study: Study, folder: Path, body: Body, known: References) -> Iterable[tuple[Any, ...]]:
    for kind in kinds_of(study):
        returns: dict[tuple[float, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        for row in read_table(controls_file(folder, body, kind)):
            returns[row["at_min"], row["control"]][row["actor"] or ""].append(row["return"])
        for at_min in sorted({minute for minute, _ in returns}):
            rows: list[tuple[str, int, Float64[np.ndarray, " samples"]]] = []
            for condition in study.conditions:
                if (condition.mapping, condition.percentiles) == (kind.mapping, kind.percentiles):
                    means = performances(folder, body, condition, at_min)
                    if condition.trained and len(means):
                        rows.append((f"{TRAINED}{condition.name}", len(means), means))
            for (minute, control), actors in returns.items():
                if minute == at_min:
                    means = np.array([np.mean(of_actor) for of_actor in actors.values()])
                    # Over actors, as each is one sample; a control of one actor has its episodes for samples.
                    rows.append(
                        (control, len(means), means if len(means) > 1 else np.array(next(iter(actors.values()))))
                    )
            limit = known.limit(kind, at_min) or {}
            for name, actors_, samples in rows:
                mean = float(samples.mean())
                error = float(samples.std(ddof=1) / np.sqrt(len(samples))) if len(samples) > 1 else None
                references = (known.random(kind, at_min), limit.get("best_return"), known.score(kind, at_min, mean))
                yield body.name, kind.mapping, kind.percentiles, at_min, name, actors_, mean, error, *references


def _curves(study: Study, folder: Path) -> Iterable[tuple[Any, ...]]:
    for body in study.robots:
        for condition in study.conditions:
            out = policies_folder(folder, body, condition)
            for i in range(study.policies if condition.trained else 0):
                curve = Policy.load(out / f"p{i}.safetensors").learning_curve
                for iterations, episodes, mean_return in curve.tolist():
                    mean = None if np.isnan(mean_return) else mean_return
                    yield body.name, condition.name, f"p{i}", int(iterations), int(episodes), mean
