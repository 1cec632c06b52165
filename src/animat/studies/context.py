"""The context study: whether tasks need more than a reflex, and whose work it is, on several cultures."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from animat.differences import with_fingerprint
from animat.execution.jobs import Job, Jobs, expect_workers
from animat.execution.task import UNFINISHED
from animat.progress import Progress, Silent
from animat.report.results import ContextRow, LostRow
from animat.robots.registry import robot_named
from animat.studies.context_tasks import MEASURED, SIMULATED, ContextStudy, Judge, Measure, RecordCulture, TrainPolicies
from animat.studies.folder import MANIFEST, claim_folder
from animat.studies.places import RECEIPTS
from animat.studies.results import write_records
from animat.training.settings import LEARNER

TABLE, WHOSE_WORK = "context.csv", "whose-work.csv"


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

    Args:
        study: the specification.
        folder: for all files; created if it is missing.
        workers, executor, progress: as for `animat.studies.run.run_study`.

    Raises:
        Mismatch: if the folder belongs to another study, holds other files, or is in use by another run.
        InvalidFile: if a file cannot be read or written.
        InvalidArgument: for fewer than one worker, or workers together with an executor.
        AnimatError: if a job failed; its message names the job.
    """
    expect_workers(workers, executor)
    folder = Path(folder).absolute()
    manifest = _describe(study)
    cultures = [f"culture-{culture}" for culture in study.cultures]
    with claim_folder(folder, "study", manifest, MANIFEST, {}, (*cultures, RECEIPTS)):
        left = Jobs(plan_context_study(study), folder, folder / RECEIPTS, manifest["fingerprint"])
        took_s = {}
        if left.waiting:
            took_s = left.run(workers=workers, executor=executor, progress=progress or Silent())
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
        pairs = [(culture, robot) for robot in study.robots for culture in study.cultures]
        rows = tuple(_row(folder, *pair) for pair in pairs)
        lost = tuple(row for pair in pairs for row in _lost(folder, *pair))
        write_records(folder / TABLE, ContextRow, rows)
        write_records(folder / WHOSE_WORK, LostRow, lost)
    return ContextRun(folder, rows, lost, took_s)


def _describe(study: ContextStudy) -> dict[str, Any]:
    from animat.cultures.tissue.parameters import REVISION

    packages = ("animat", "jax", "jaxlib", "numpy", "scipy", "optax", "numba")
    versions = {name: importlib.metadata.version(name) for name in packages}
    versions |= {"learner": f"revision {LEARNER}", "virtual tissue": f"revision {REVISION}"}
    return with_fingerprint({"context study": asdict(study), "versions": versions})


def plan_context_study(study: ContextStudy) -> list[Job]:
    """All jobs of the study."""
    jobs = []
    for culture in study.cultures:
        commands = {robot: robot_named(robot).n_commands for robot in study.robots}
        records = {n: f"record/{culture}" + (f"/{n}-commands" if n > 1 else "") for n in sorted({*commands.values()})}
        jobs += [Job(name, RecordCulture(study, culture, n), (), 60) for n, name in records.items()]
        for robot in study.robots:
            recorded = records[commands[robot]]
            trained = f"train/{culture}/{robot}"
            jobs += [
                Job(trained, TrainPolicies(study, culture, robot), (recorded,), 30),
                Job(f"judge/{culture}/{robot}", Judge(study, culture, robot), (trained,), 100),
                Job(f"measure/{culture}/{robot}", Measure(study, culture, robot), (trained,), 100),
            ]
    return jobs


def _row(folder: Path, culture: int, robot: str) -> ContextRow:
    evaluation = _read(folder, culture, robot, SIMULATED)
    session_rows = _read(folder, culture, robot, MEASURED)["rows"]
    simulated = {row["name"]: row["mean_return"] for row in evaluation["rows"]}
    measured = {row["name"]: row["measured"] for row in session_rows}
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
        measured_policies=session_rows[0]["measured"],
        predicted_policies=session_rows[0]["predicted"],
    )


def _lost(folder: Path, culture: int, robot: str) -> list[LostRow]:
    _, *interventions = _read(folder, culture, robot, SIMULATED)["whose_work"]["rows"]
    return [
        LostRow(culture, robot, row["name"], row["mean_return"], *(row["lost"][of] for of in ("value", "low", "high")))
        for row in interventions
    ]


def _read(folder: Path, culture: int, robot: str, name: str) -> Any:
    return json.loads((folder / f"culture-{culture}" / robot / name).read_text())
