"""The context study: whether tasks need more than a reflex, and whose work it is, on several cultures."""

from __future__ import annotations

import json
import os
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

from animat.cultures.tissue.parameters import REVISION
from animat.execution.jobs import Job, expect_workers
from animat.folders import with_fingerprint
from animat.progress import Progress
from animat.report.results import ContextRow, LostRow
from animat.robots.registry import robot_named
from animat.studies.context_tasks import MEASURED, SIMULATED, ContextStudy, Judge, Measure, RecordCulture, TrainPolicies
from animat.studies.folder import MANIFEST, claim_folder
from animat.studies.places import RECEIPTS
from animat.studies.results import write_records
from animat.studies.run import run_jobs
from animat.training.folder import versions_of

TABLE, WHOSE_WORK = "context.csv", "whose-work.csv"
_PACKAGES = ("animat", "jax", "jaxlib", "numpy", "scipy", "optax", "numba")


@dataclass(frozen=True)
class ContextRun:
    """Results of the study: rows of each culture and robot, and what was lost by each intervention.

    Attributes:
        done_now: processor seconds of each job that this run did.
    """

    folder: Path
    rows: tuple[ContextRow, ...]
    lost: tuple[LostRow, ...]
    done_now: dict[str, float]


def run_context_study(
    study: ContextStudy,
    folder: str | os.PathLike[str],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> ContextRun:
    """Run the study in a folder, or resume it there: finished jobs are not run again.

    Arguments and errors are those of `animat.studies.run.run_study`.
    """
    expect_workers(workers, executor)
    folder = Path(folder).absolute()
    versions = versions_of(_PACKAGES) | {"virtual tissue": f"revision {REVISION}"}
    manifest = with_fingerprint({"context study": asdict(study), "versions": versions})
    cultures = [f"culture-{culture}" for culture in study.cultures]
    rows: list[ContextRow] = []
    lost: list[LostRow] = []
    with claim_folder(folder, "study", manifest, MANIFEST, {}, (*cultures, RECEIPTS)):
        jobs = plan_context_study(study)
        took_s = run_jobs(jobs, folder, manifest["fingerprint"], progress, workers=workers, executor=executor)
        for robot, culture in product(study.robots, study.cultures):
            files = (folder / f"culture-{culture}" / robot / name for name in (SIMULATED, MEASURED))
            simulated, measured = (json.loads(file.read_text()) for file in files)
            rows.append(_row(culture, robot, simulated, measured))
            lost += _lost(culture, robot, simulated)
        write_records(folder / TABLE, ContextRow, rows)
        write_records(folder / WHOSE_WORK, LostRow, lost)
    return ContextRun(folder, tuple(rows), tuple(lost), took_s)


def plan_context_study(study: ContextStudy) -> list[Job]:
    """All jobs of the study."""
    jobs = []
    commands = {robot: robot_named(robot).n_commands for robot in study.robots}
    for culture in study.cultures:
        records = {n: f"record/{culture}" + (f"/{n}-commands" if n > 1 else "") for n in sorted({*commands.values()})}
        jobs += [Job(name, RecordCulture(study, culture, n), (), 60) for n, name in records.items()]
        for robot, n in commands.items():
            trained = f"train/{culture}/{robot}"
            jobs += [
                Job(trained, TrainPolicies(study, culture, robot), (records[n],), 30),
                Job(f"judge/{culture}/{robot}", Judge(study, culture, robot), (trained,), 100),
                Job(f"measure/{culture}/{robot}", Measure(study, culture, robot), (trained,), 100),
            ]
    return jobs


def _row(culture: int, robot: str, evaluation: dict[str, Any], session: dict[str, Any]) -> ContextRow:
    simulated = {row["name"]: row["mean_return"] for row in evaluation["rows"]}
    measured = {row["name"]: row["measured"] for row in session["rows"]}
    context = evaluation["context"] or {}
    gap, score = context.get("context_gap") or {}, evaluation["context_score"] or {}
    information = evaluation["whose_work"]["rows"][0]["goal_information"]
    return ContextRow(
        culture=culture,
        robot=robot,
        random=simulated["random"],
        heuristic=simulated.get("heuristic"),
        coupling=simulated.get("coupling"),
        policies=simulated["policies"],
        optimum=None if evaluation["optimum"] is None else evaluation["optimum"]["value"],
        best_known=context.get("best_known"),
        gap=gap.get("value"),
        gap_low_95=gap.get("low"),
        gap_high_95=gap.get("high"),
        score=score.get("value"),
        score_low_95=score.get("low"),
        score_high_95=score.get("high"),
        bits=None if information is None else information["bits"]["value"],
        measured_random=measured.get("random"),
        measured_heuristic=measured.get("heuristic"),
        measured_coupling=measured.get("coupling"),
        # The first row is that of all policies, or of the only one.
        measured_policies=session["rows"][0]["measured"],
        predicted_policies=session["rows"][0]["predicted"],
    )


def _lost(culture: int, robot: str, evaluation: dict[str, Any]) -> list[LostRow]:
    _, *interventions = evaluation["whose_work"]["rows"]
    return [
        LostRow(culture, robot, row["name"], row["mean_return"], *(row["lost"][of] for of in ("value", "low", "high")))
        for row in interventions
    ]
