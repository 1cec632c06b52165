"""The study's results as tables: scores, comparisons, controls, learning curves, controllability, findings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
from jaxtyping import Float64

from animat.evaluation.statistics import Comparison, compare, holm, interquartile_mean, normalised_score, p_of_u
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Progress
from animat.recordings.findings import Finding
from animat.report.results import TRAINED, ComparedReturns, ControlReturns, Results, Score, StudyOptimum
from animat.studies.episodes import POLICY, RANDOM, DataFrame, goals_met, mean_returns, read_episodes, rows_where
from animat.studies.evaluating import as_recorded, policies_of
from animat.studies.folder import RESULTS, controls_file, episodes_file, table_file
from animat.studies.optima import complete_optima, key_of, kinds_of, missing_capabilities, read_optima
from animat.studies.outperforming import compare_with_heuristic, compare_with_reflex
from animat.studies.paper import PRINTED
from animat.studies.recording import controllability
from animat.studies.results import write_records, write_table, write_typed
from animat.studies.specification import Arm, RobotSpec, Study, mapping_label
from animat.studies.task import StudyTask
from animat.writing import atomic_write

LEVEL = 0.01
"""The p below which an arm counts as better: by the normal approximation and uncorrected, as in the paper."""
LEFT_OUT = "left-out"
"""The finding that the study lacks something, as a robot cannot do it."""


class Tabulate(StudyTask):
    """Summarise the table of episodes and write `tables/`: typed results for later tasks, and everything as CSV."""

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        study, timeline, first, last = as_recorded(self.study, folder)
        table = all_episodes(study, folder, study.robots)
        known = [References(study, folder, spec, table) for spec in study.robots]
        optima = tuple(optimum for spec in study.robots for optimum in read_optima(folder, spec.name))
        results = Results(
            scores=tuple(row for of_robot in known for row in _scores(of_robot, first, last)),
            comparisons=tuple(_comparisons(study, last, known)),
            controls=tuple(row for of_robot in known for row in _controls(of_robot)),
            heuristic=tuple(row for spec in study.robots for row in compare_with_heuristic(study, table, spec)),
            optima=optima,
            findings=tuple(_findings(study, timeline, optima)),
            goals=tuple(goals_met(study, table)),
            reflexes=tuple(row for spec in study.robots for row in compare_with_reflex(study, table, spec, optima)),
        )
        files = [write_typed(folder / RESULTS, results)]
        for name, kinds in get_type_hints(Results).items():
            rows = getattr(results, name)
            # Findings have other columns, below, and most studies have no goals.
            if name != "findings" and (rows or name != "goals"):
                files.append(write_records(table_file(folder, name), get_args(kinds)[0], rows))
        findings = ((finding.severity, finding.name, finding.message) for finding in results.findings)
        files.append(write_table(table_file(folder, "findings"), ("severity", "name", "message"), findings))
        columns = ("robot", "arm", "policy", "iterations", "episodes", "mean_return")
        files.append(write_table(table_file(folder, "learning-curves"), columns, _curves(study, folder)))
        if timeline is not None:
            head = ("at_min", "condition", "above_median_in_data", "above_median_in_simulator")
            rows = (
                (at_min, *shares)
                for at_min, kept in controllability(timeline).items()
                for shares in zip(kept.labels, kept.in_data.tolist(), kept.in_simulator.tolist(), strict=True)
            )
            files.append(write_table(table_file(folder, "controllability"), head, rows))
        with atomic_write(table_file(folder, "episodes")) as beside:
            table.to_csv(beside, index=False, lineterminator="\n")
        return [*files, table_file(folder, "episodes")]


def all_episodes(study: Study, folder: Path, robots: Iterable[RobotSpec]) -> DataFrame:
    """The table of episodes of some robots."""
    files = []
    for spec in robots:
        files += [episodes_file(folder, spec, arm) for arm in study.arms]
        files += [controls_file(folder, spec, kind) for kind in kinds_of(study)]
    return read_episodes(files)


def _findings(study: Study, timeline: SimulatorTimeline | None, optima: Iterable[StudyOptimum]) -> Iterator[Finding]:
    if timeline is not None:
        yield from timeline.findings
    for optimum in optima:
        where = f"{optimum.robot}, {mapping_label(optimum.mapping, optimum.percentiles)}, at {optimum.at_min:g} min"
        for finding in optimum.findings():
            yield replace(finding, message=f"{where}: {finding.message}")
    for message in missing_capabilities(study):
        yield Finding(LEFT_OUT, "note", message)


class References:
    """Mean returns of random actions and optimal returns on a robot, for every mapping and minute.

    With `over_time`: of the few episodes at every recording, with the optimum on a coarse grid.
    """

    def __init__(
        self, study: Study, folder: Path, spec: RobotSpec, table: DataFrame, *, over_time: bool = False
    ) -> None:
        self.study, self.folder, self.spec, self.table = study, folder, spec, table
        self._optima = complete_optima(read_optima(folder, spec.name, "over-time" if over_time else "optima"))
        random = rows_where(table, robot=spec.name, agent=RANDOM, over_time=over_time)
        self._random: dict[tuple[str, str, float], float] = {}
        for kind in kinds_of(study):
            for at_min, returns in rows_where(random, arm=mapping_label(*kind.kind)).groupby("at_min")["return"]:
                self._random[key_of(kind, at_min)] = float(returns.to_numpy().mean())

    def random(self, arm: Arm, at_min: float) -> float | None:
        """The mean return of random actions, delivered as chosen."""
        return self._random.get(key_of(arm, at_min))

    def optimum(self, arm: Arm, at_min: float) -> StudyOptimum | None:
        """The optimum; None for the control, which has none, and where it leaves out conditions."""
        return None if arm.delivery == "shuffled" else self._optima.get(key_of(arm, at_min))

    def best_return(self, arm: Arm, at_min: float) -> float | None:
        """The optimal return, where there is an `optimum`."""
        optimum = self.optimum(arm, at_min)
        return None if optimum is None else optimum.best_return

    def score(self, arm: Arm, at_min: float, mean: float) -> float | None:
        """The normalised score; None if it is not known, or nothing can be learned."""
        random, best = self.random(arm, at_min), self.best_return(arm, at_min)
        return None if random is None or best is None or not best > random else normalised_score(mean, random, best)


def performances(
    table: DataFrame, robot: str, arm: Arm, at_min: float, episodes: int | None = None
) -> Float64[np.ndarray, " policies"]:
    """Each policy's mean return over its first `episodes`, or all, at a minute: the paper's measure of a policy."""
    rows = rows_where(table, robot=robot, arm=arm.name, agent=POLICY, at_min=at_min, over_time=False)
    return mean_returns(rows, episodes)


def _finite(end: float) -> float | None:
    """An end of an interval; None if it is infinite, as for one policy on a robot with unbounded returns."""
    return end if math.isfinite(end) else None


def _scores(known: References, first: float, last: float) -> Iterator[Score]:
    spec = known.spec
    for arm in known.study.arms:
        for at_min, episodes in sorted(known.study.minutes_of(arm, first, last).items()):
            means = performances(known.table, spec.name, arm, at_min)
            mean = float(means.mean())
            middle = interquartile_mean(means, within=spec.robot().return_range)
            yield Score(
                robot=spec.name,
                arm=arm.name,
                mapping=arm.mapping,
                at_min=at_min,
                policies=len(means),
                episodes=episodes,
                mean_return=mean,
                standard_deviation=float(means.std(ddof=1)) if len(means) > 1 else None,
                interquartile_mean=middle.value,
                low_95=_finite(middle.low),
                high_95=_finite(middle.high),
                random=known.random(arm, at_min),
                optimum=known.best_return(arm, at_min),
                normalised_score=known.score(arm, at_min, mean),
            )


FIRST, SECOND, NONE = "first better", "second better", f"none found (p ≥ {LEVEL:g})"
TOO_FEW = "too few policies to tell"
AS_IN_PAPER = {FIRST: "no", SECOND: "yes", NONE: "no", TOO_FEW: "cannot tell"}
"""Whether each outcome agrees with the paper, in which the second arm was always better."""


def outcome_of(comparison: Comparison) -> str:
    """Which arm is better, that no difference was found, or that none could have been found."""
    if comparison.p_normal < LEVEL:
        return SECOND if comparison.effect.value > 0 else FIRST
    # With four policies per side even U = 0 has p = 0.03, so no difference could have been found.
    return NONE if p_of_u(0.0, comparison.n_first, comparison.n_second) < LEVEL else TOO_FEW


def _optimum_error(optimum: StudyOptimum | None) -> float | None:
    """The possible error of the optimal return: that of the grid, or the distance to the controller's return."""
    if optimum is None or optimum.grid_error is None:
        return None
    return max(optimum.grid_error, *(abs(each.value or 0.0) for each in optimum.findings()), 0.0)


def _comparisons(study: Study, last: float, references: Iterable[References]) -> Iterator[ComparedReturns]:
    rows = []
    for compared, known in product(study.comparisons, references):
        robot, at_min = known.spec.name, last if compared.at_min is None else compared.at_min
        first, second = study.arm(compared.first), study.arm(compared.second)
        a, b = (performances(known.table, robot, arm, at_min, compared.episodes) for arm in (first, second))
        test = compare(a, b)
        outcome = outcome_of(test)
        printed = PRINTED.get((compared.name, robot)) if study.paper else None
        row = ComparedReturns(
            comparison=compared.name,
            robot=robot,
            first=first.name,
            second=second.name,
            at_min=at_min,
            episodes=compared.episodes,
            n=len(a),
            mean_first=float(a.mean()),
            mean_second=float(b.mean()),
            score_first=known.score(first, at_min, float(a.mean())),
            score_second=known.score(second, at_min, float(b.mean())),
            random_second=known.random(second, at_min),
            optimum_first=known.best_return(first, at_min),
            optimum_second=known.best_return(second, at_min),
            optimum_error_first=_optimum_error(known.optimum(first, at_min)),
            optimum_error_second=_optimum_error(known.optimum(second, at_min)),
            u=test.u,
            p_normal=test.p_normal,
            p_exact=test.p_exact,
            p_holm=math.nan,
            effect=test.effect.value,
            effect_low_95=test.effect.low,
            effect_high_95=test.effect.high,
            outcome=outcome,
            paper_u=None if printed is None else printed.u,
            paper_p=None if printed is None else printed.p,
            as_in_paper=None if printed is None else AS_IN_PAPER[outcome],
        )
        rows.append(row)
    corrected = holm({f"{row.comparison}/{row.robot}": row.p_normal for row in rows})
    return (replace(row, p_holm=corrected[f"{row.comparison}/{row.robot}"]) for row in rows)


def _controls(known: References) -> Iterator[ControlReturns]:
    study, table, spec = known.study, known.table, known.spec
    for kind in kinds_of(study):
        # Where choices have no effect, the optimum is a different one.
        without_effect = replace(kind, delivery="shuffled")
        of_kind = rows_where(table, robot=spec.name, arm=mapping_label(*kind.kind), over_time=False)
        for at_min, of_minute in of_kind[of_kind["agent"] != POLICY].groupby("at_min"):
            rows: list[tuple[Arm, str, int, Float64[np.ndarray, " samples"]]] = []
            for arm in study.arms_of(kind):
                means = performances(table, spec.name, arm, at_min)
                if arm.trained and len(means):
                    rows.append((arm, f"{TRAINED}{arm.name}", len(means), means))
            for agent, of_agent in of_minute.groupby("agent", sort=False):
                means = mean_returns(of_agent)
                # Each actor is one sample; for a single actor, each of its episodes is.
                samples = means if len(means) > 1 else of_agent["return"].to_numpy()
                rows.append((without_effect if agent in ("silent", "shuffled") else kind, agent, len(means), samples))
            for acting, name, actors, samples in rows:
                mean = float(samples.mean())
                yield ControlReturns(
                    robot=spec.name,
                    mapping=kind.mapping,
                    percentiles=kind.percentiles,
                    at_min=at_min,
                    control=name,
                    actors=actors,
                    mean_return=mean,
                    standard_error=float(samples.std(ddof=1) / np.sqrt(len(samples))) if len(samples) > 1 else None,
                    random=known.random(kind, at_min),
                    optimum=known.best_return(acting, at_min),
                    normalised_score=known.score(acting, at_min, mean),
                )


def learning_of(study: Study, folder: Path, spec: RobotSpec, arm: Arm) -> Float64[np.ndarray, "policies parts 3"]:
    """The learning curves of an arm's policies: iterations, episodes and mean return, as in `Policy.learning_curve`."""
    curves = [policy.learning_curve[:, :3] for policy in policies_of(study, folder, spec, arm)]
    return np.stack(curves).astype(np.float64)


def _curves(study: Study, folder: Path) -> Iterator[tuple[Any, ...]]:
    for spec in study.robots:
        for arm in (arm for arm in study.arms if arm.trained):
            for i, curve in enumerate(learning_of(study, folder, spec, arm).tolist()):
                for iterations, episodes, mean in curve:
                    yield spec.name, arm.name, f"p{i}", int(iterations), int(episodes), mean
