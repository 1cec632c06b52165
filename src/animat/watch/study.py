"""The views of a study, by its jobs and results, and of one over many cultures, with the progress of each."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from animat.errors import InvalidFile, some_of
from animat.execution.task import PLANNED, UNFINISHED
from animat.watch.discovery import changed_s, is_locked, state_of
from animat.watch.files import JobProgress, arrays_in, job_progress, json_of, listed, mapped, number, text, text_of
from animat.watch.view import View, Width, facts, in_blocks, table, time_left

_MOST_RECEIPTS, _MOST_SHOWN = 5000, 300
_CONTEXT = "context study"
_FAILED = "A job that fails ends the study, and its command names it: the folder does not record it."
_DONE, _COMPARISONS = "jobs/report.json", "tables/comparisons.csv"
_MOST_CULTURES, _MOST_TABLE_BYTES, _MOST_EPISODES_BYTES = 10_000, 2**20, 2**27
_NOTE = "Mean returns over the cultures that are done, and in how many of them that of the second arm is larger."
_Means = dict[tuple[str, str], tuple[float, float]]
"""The means of both arms on one culture, by comparison and robot."""


class StudyView(View):
    kind = "study"

    def _title(self) -> str:
        manifest = self._manifest()
        names = [spec["name"] for spec in manifest.get("study", {}).get("robots", ())]
        names += manifest.get(_CONTEXT, {}).get("robots", ())
        robots, kind = ", ".join(map(text, names)), _CONTEXT if _CONTEXT in manifest else "study"
        return f"{kind} {f'of {robots}' if robots else ''}".strip()

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        self._manifest()
        done = done_jobs(self.folder)
        progress = running_jobs(self.folder, done)
        worked, costs = _work(self.folder, done, progress)
        self._speed.see(worked)
        # A finished study has removed its folder of unfinished work.
        is_done = bool(done) and not (self.folder / UNFINISHED).exists()
        state = state_of(self.folder, is_done=is_done)
        is_running = state["state"] == "running"
        running = progress if is_running else {}
        waiting = [name for name in costs if name not in done and name not in running]
        rows: list[tuple[str, Any]] = [
            ("jobs done", len(done)),
            ("running", len(running)),
            ("waiting", len(waiting) if costs or is_done else "not known"),
            ("failed", "none" if is_running or is_done else "not known here"),
            ("time left", time_left(self._speed.left_s(sum(costs.values()) - worked), state)),
        ]
        results = _results_table(self.folder, "two-thirds" if is_done else "whole")
        last = list(done.items())[-_MOST_SHOWN:]
        finished = table("Done", ["job", "files"], last, width="whole" if is_done else "half")
        if is_done:
            return in_blocks(state, [facts("Jobs", rows), results, finished])
        planned = table("Waiting", ["job"], [[name] for name in waiting[:_MOST_SHOWN]])
        return in_blocks(state, [facts("Jobs", rows, _FAILED), running_table(running), results, finished, planned])


def _share_of(folder: Path) -> float:
    """The share of a study that is done, by the cost of its jobs; 0 if not known."""
    done = done_jobs(folder)
    worked, costs = _work(folder, done, running_jobs(folder, done))
    return worked / total if (total := sum(costs.values())) else 0.0


def _work(folder: Path, done: dict[str, int], progress: JobProgress) -> tuple[float, dict[str, float]]:
    """The work done, and the cost of each job, as the unfinished study lists it."""
    costs = {text(name): number(cost) or 0.0 for name, cost in json_of(folder / UNFINISHED / PLANNED).items()}
    worked = sum(costs.get(name, 0.0) for name in done)
    return worked + sum(share * costs.get(name, 0.0) for name, (share, _) in progress.items()), costs


def done_jobs(folder: Path) -> dict[str, int]:
    """The number of output files of each job with a receipt, in the order of the receipts."""
    receipts = sorted((changed_s(path) or 0.0, path) for path in (folder / "jobs").glob("[!.]*.json"))
    contents = (json_of(path) for _, path in receipts[:_MOST_RECEIPTS])
    return {text(receipt["job"]): len(mapped(receipt.get("outputs"))) for receipt in contents if "job" in receipt}


def running_jobs(folder: Path, done: dict[str, int]) -> JobProgress:
    """The last progress of jobs without a receipt."""
    return {name: report for name, report in job_progress(folder).items() if name not in done and report[0] < 1}


def running_table(progress: JobProgress, width: Width = "two-thirds") -> dict[str, Any]:
    """The running jobs."""
    head = ["job", "done", "message"]
    rows = [[name, f"{100 * share:.0f} %", message] for name, (share, message) in progress.items()]
    if not any(message for _, message in progress.values()):
        head, rows = head[:2], [row[:2] for row in rows]
    return table("Running", head, rows, "" if rows else "nothing is running", width=width)


def _results_table(folder: Path, width: Width) -> dict[str, Any]:
    """The mean return of each arm on each robot, as soon as its policies have been evaluated."""
    rows: list[list[Any]] = []
    left_out = []
    for files in ("episodes/*/*/episodes.npz", "culture-*/*/simulated.json"):
        for path in sorted(folder.glob(files))[:_MOST_SHOWN]:
            try:
                rows += _results_of(path)
            except Exception:  # anything may be in a file
                left_out.append(path.relative_to(folder).as_posix())
    note = "None yet."
    if rows:
        note = "Over all policies, on the last recording; comparisons are in the folder's report.html once it is done."
    if left_out:
        note += f" Left out, as they cannot be read: {some_of(left_out)}."
    return table("Results", ["robot", "arm", "mean return", "policies", "episodes"], rows, note, width=width)


def _results_of(path: Path) -> list[list[Any]]:
    robot, arm = path.parts[-3:-1]
    if path.suffix == ".npz":
        names = "return", "actor", "over_time", "agent", "at_min"
        if (arrays := arrays_in(path, names, _MOST_EPISODES_BYTES)) is None:
            raise InvalidFile(f"{path}: expected the episodes of an arm")
        returns, actors, over_time, agents, at_min = arrays
        # Only those at the last minute: episodes over time are few, and a comparison may be on an earlier recording.
        own = ~over_time.astype(bool) & (agents == "policy") & (at_min == at_min.max())
        return [[robot, arm, float(returns[own].mean()), len(np.unique(actors[own])), int(own.sum())]]
    culture, robot = robot, arm
    rows = json_of(path)["rows"][:1]
    return [[robot, f"policies, {culture}", row["mean_return"], row["actors"], row["episodes"]] for row in rows]


class CulturesView(View):
    kind = "cultures"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._compared: dict[str, tuple[float | None, _Means]] = {}
        """When each culture's table last changed, and its means."""

    def _title(self) -> str:
        return f"study over {len(self._names()):,} cultures"

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        names, failed = self._names(), self._failed()
        done = [name for name in names if (self.folder / name / _DONE).exists()]
        begun = [name for name in names if name not in done and (self.folder / name).is_dir()]
        shares = {name: _share_of(self.folder / name) for name in begun if is_locked(self.folder / name) is not False}
        self._speed.see(worked := len(done) + sum(shares.values()))
        state = state_of(self.folder, is_done=len(done) == len(names))
        running = shares if state["state"] == "running" else {}
        if failed and state["state"] == "silent":
            message = f"{len(failed)} of the cultures failed; run the study again to continue"
            state = {"state": "ended", "message": message}
        rows: list[tuple[str, Any]] = [
            ("cultures done", f"{len(done):,} of {len(names):,}"),
            ("running", len(running)),
            ("begun, not running", len(begun) - len(running)),
            ("failed", len(failed)),
            ("time left", time_left(self._speed.left_s(len(names) - worked), state)),
        ]
        blocks = [facts("Cultures", rows, "The list at the top has a page for each culture.")]
        is_done = state["state"] == "ended"
        if not is_done:
            shares_done = [[name, f"{100 * share:.0f} %"] for name, share in running.items()]
            note = "" if running else "nothing is running"
            blocks.append(table("Running", ["culture", "done"], shares_done, note, width="two-thirds"))
        if failed:
            blocks.append(table("Failed", ["culture", "error"], list(failed.items())))
        return in_blocks(state, [*blocks, self._comparisons(done, "two-thirds" if is_done else "whole")])

    def _comparisons(self, done: list[str], width: Width) -> dict[str, Any]:
        for name in done:
            file = self.folder / name / _COMPARISONS
            if (time_s := changed_s(file)) == self._compared.get(name, (None,))[0]:
                continue
            self._compared.pop(name, None)
            if (means := _means_of(file)) is not None:
                self._compared[name] = time_s, means
        known = [self._compared[name][1] for name in done if name in self._compared]
        rows = []
        for comparison in dict.fromkeys(key for means in known for key in means):
            pairs = [means[comparison] for means in known if comparison in means]
            first, second = (sum(means) / len(pairs) for means in zip(*pairs, strict=True))
            larger = sum(after > before for before, after in pairs)
            rows.append([*comparison, first, second, f"{larger:,} of {len(pairs):,}"])
        head = ["comparison", "robot", "mean, first arm", "mean, second arm", "second larger in"]
        note = _NOTE if rows else "None yet."
        if left_out := len(done) - len(known):
            note += f" Left out, as their {_COMPARISONS} cannot be read: {left_out:,} of the cultures that are done."
        return table("Comparisons", head, rows, note, width=width)

    def _failed(self) -> dict[str, str]:
        """The cultures that the last run could not finish, each with its error."""
        failed = mapped(json_of(self.file).get("failed"))
        return {name: text(error) for name, error in list(failed.items())[:_MOST_CULTURES] if _is_name(name)}

    def _names(self) -> list[str]:
        cultures = listed(json_of(self.file).get("cultures"))
        # A link may lead out of the folder.
        names = [name for name in cultures if _is_name(name) and not (self.folder / name).is_symlink()]
        if not names:
            raise InvalidFile(f"{self.file}: expected the names of cultures, got none")
        return names[:_MOST_CULTURES]


def _is_name(name: Any) -> bool:
    return isinstance(name, str) and name.startswith("culture-") and "/" not in name and text(name) == name


def _means_of(path: Path) -> _Means | None:
    """The means in a table of comparisons; None if it is damaged."""
    try:
        means = {
            (text(row["comparison"]), text(row["robot"])): (float(row["mean_first"]), float(row["mean_second"]))
            for row in csv.DictReader(io.StringIO(text_of(path, _MOST_TABLE_BYTES)))
        }
    except (InvalidFile, csv.Error, KeyError, TypeError, ValueError):
        return None
    return means if all(math.isfinite(mean) for pair in means.values() for mean in pair) else None
