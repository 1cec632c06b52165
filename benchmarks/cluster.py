"""The overhead of a cluster on one machine, and how work grows with policies and cultures.

    python benchmarks/cluster.py [--parts study tasks sizes growth] [--rounds 3] [--json results.json]

Two pinned processes are compared with a Dask scheduler and two workers, in turns. Needs the extra `[cluster]`.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from animat.execution.cluster import Cluster, local_cluster
from animat.execution.jobs import Job, Jobs
from animat.execution.receipts import Receipt, receipt_path
from animat.execution.task import Task, TaskResult, carry_out_alone
from animat.execution.training import train
from animat.progress import Silent
from animat.studies.cultures import run_over_cultures
from animat.studies.folder import RECEIPTS
from animat.studies.run import plan_study, run_study
from animat.studies.source import Source
from animat.studies.toml import read_study

STUDY = Path(__file__).parents[1] / "tests" / "tiny_study.toml"
WORKERS = 2


@dataclass(frozen=True)
class Rest(Task):
    """Takes a given time, and leaves a file."""

    number: int
    seconds: float

    @property
    def grows_with(self) -> dict[str, object]:
        return {}

    def run(self, folder: Path, progress: Any) -> list[Path]:
        time.sleep(self.seconds)
        (folder / str(self.number)).write_text("done")
        return [folder / str(self.number)]


def timed(work: Callable[[Path, Any], Any], scheduler: Path | None, longest_s: float = 30.0) -> float:
    """Seconds of some work in a new folder: on pinned processes, or on a running cluster."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        if scheduler is None:
            work(Path(folder), None)
        else:
            with Cluster(scheduler, longest_s=longest_s) as cluster:
                work(Path(folder), cluster)
        return time.perf_counter() - began


def study(scheduler: Path, rounds: int) -> dict[str, Any]:
    """The same study on both, in turns, after one run that fills the cache of compiled programs."""

    def work(folder: Path, cluster: Any) -> None:
        here = None if cluster else WORKERS
        run_study(read_study(STUDY), folder, base=STUDY.parent, workers=here, executor=cluster)

    work_s: dict[str, list[float]] = {"pinned": [], "cluster": []}
    for turn in range(-1, rounds):
        for name, where in (("pinned", None), ("cluster", scheduler)):
            took_s = timed(work, where)
            work_s[name] += [took_s] if turn >= 0 else []
    ratios = [over / alone for alone, over in zip(work_s["pinned"], work_s["cluster"], strict=True)]
    return {**work_s, "ratio": statistics.median(ratios)}


def tasks(scheduler: Path, rounds: int) -> dict[str, Any]:
    """A thousand tasks of a second, of 0.1 s and of no work, each with its receipt, and the overhead per task."""
    figures = {}
    for seconds in (1.0, 0.1, 0.0):

        def work(folder: Path, cluster: Any, seconds: float = seconds) -> None:
            jobs = [Job(f"rest/{i}", Rest(i, seconds), cost_s=max(seconds, 0.001)) for i in range(1000)]
            here = None if cluster else WORKERS
            Jobs(jobs, folder, folder / RECEIPTS, "benchmark").run(workers=here, executor=cluster, progress=Silent())

        for name, where, longest_s in (
            ("pinned", None, 0.0),
            ("cluster, in batches", scheduler, 30.0),
            ("cluster, one by one", scheduler, 0.0),
        ):
            took_s = timed(work, where, longest_s)
            over = took_s - 1000 * seconds / WORKERS
            figures[f"{name}, {seconds} s each"] = {"s": took_s, "tasks_a_s": 1000 / took_s, "ms_more_a_task": over}
    return figures


def sizes(scheduler: Path, rounds: int) -> dict[str, Any]:
    """Bytes of a study's tasks and answers as sent, and of the files that each leaves, by kind."""
    by_kind: dict[str, list[tuple[int, int, int]]] = {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        the_study = read_study(STUDY)
        run_study(the_study, folder, base=STUDY.parent, workers=WORKERS)
        for job in plan_study(the_study, STUDY.parent):
            receipt = Receipt.load(folder / RECEIPTS, job.name)
            assert receipt is not None
            notice = receipt_path(folder / RECEIPTS, job.name)
            task = pickle.dumps((carry_out_alone, (job.task, folder, notice), {}))
            answer = pickle.dumps(TaskResult(dict(receipt.outputs), 1.0))
            left = sum((folder / name).stat().st_size for name in receipt.outputs)
            by_kind.setdefault(job.name.split("/")[0], []).append((len(task), len(answer), left))
    names = ("task", "answer", "files")
    return {kind: dict(zip(names, map(max, zip(*rows, strict=True)), strict=True)) for kind, rows in by_kind.items()}


def growth(scheduler: Path, rounds: int) -> dict[str, Any]:
    """Seconds for 10, 100 and 1,000 policies of 10,000 iterations, and for a small study on 1, 10 and 100 cultures.

    The study is the tiny one with its first two arms; all cultures share its recordings. Each size runs once on pinned
    processes, after one run of each kind that fills the cache of compiled programs.
    """
    from training import timeline, training

    def policies(many: int) -> float:
        what = training(many, 10_000)
        return timed(lambda folder, _: train(what, timeline(), folder, workers=WORKERS), None)

    def cultures(many: int) -> float:
        study = read_study(STUDY)
        with tempfile.TemporaryDirectory() as base:
            names = tuple(f"{i}" for i in range(many))
            for name in names:
                (Path(base) / name).symlink_to(STUDY.parent / study.culture.files[0])
            culture = Source("files", folders=names)
            study = replace(study, culture=culture, arms=study.arms[:2], optimum_resolution=0.1)
            return timed(lambda folder, _: run_over_cultures(study, folder, base=Path(base), workers=WORKERS), None)

    seconds = {}
    for name, work, most in (("policies", policies, 1000), ("cultures", cultures, 100)):
        work(2)
        for many in (most // 100, most // 10, most):
            seconds[f"{many} {name}"] = work(many)
            print(f"{many} {name}: {seconds[f'{many} {name}']:.1f} s", flush=True)
    return seconds


PARTS = {"study": study, "tasks": tasks, "sizes": sizes, "growth": growth}


def main() -> int:
    """Run the parts and print the measurements."""
    parser = argparse.ArgumentParser(description="What a cluster costs on one machine, and how work grows.")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all measurements to a file")
    options = parser.parse_args()
    measured: dict[str, Any] = {"load": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory() as folder, local_cluster(WORKERS, Path(folder) / "cluster.json"):
        for part in options.parts:
            measured[part] = PARTS[part](Path(folder) / "cluster.json", options.rounds)
            print(f"{part}: {json.dumps(measured[part], indent=1)}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(measured, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    # Imported by its own name, so that workers can import its tasks.
    import cluster

    sys.exit(cluster.main())
