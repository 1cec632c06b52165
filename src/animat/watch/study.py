"""The view of a study: its jobs, how many are done, what runs, what is left, and results as they come."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from animat.execution.task import PLANNED, UNFINISHED
from animat.watch.blocks import Width, facts, table, time_left
from animat.watch.files import json_of, mean_of_episodes, newest_s, told_by_jobs
from animat.watch.held import state_of
from animat.watch.plain import listed, mapped, number, text
from animat.watch.view import View, in_blocks, titled

_MOST_RECEIPTS, _MOST_SHOWN = 5000, 300
_CONTEXT = "context study"
_FAILED = "A job that fails ends the study, and its command says which: the folder does not keep it."


class StudyView(View):
    """A study's folder."""

    def about(self) -> dict[str, Any]:
        """What is studied."""
        manifest = self._manifest()
        names = [mapped(each).get("name", "robot") for each in listed(mapped(manifest.get("study")).get("robots"))]
        names += listed(mapped(manifest.get(_CONTEXT)).get("robots"))
        robots, kind = ", ".join(map(text, names)), _CONTEXT if _CONTEXT in manifest else "study"
        return titled(f"{kind} {f'of {robots}' if robots else ''}".strip())

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """How far it is."""
        self._manifest()
        done = done_jobs(self.folder)
        told = running_jobs(self.folder, done)
        worked, costs = _work(self.folder, done, told)
        self._speed.see(worked)
        # Whoever has come to an end leaves nothing unfinished.
        is_done = bool(done) and not (self.folder / UNFINISHED).exists()
        changed_s = newest_s([self.folder, self.folder / "jobs", *(self.folder / UNFINISHED).glob("*/*.json")])
        state = state_of(self.folder, changed_s, is_done=is_done)
        is_running = state["state"] == "running"
        waiting = [name for name in costs if name not in done and not (is_running and name in told)]
        rows: list[tuple[str, Any]] = [
            ("jobs done", len(done)),
            ("running", len(told) if is_running else 0),
            ("waiting", len(waiting) if costs or is_done else "not known"),
            ("failed", "none" if is_running or is_done else "not known here"),
            ("time left", time_left(self._speed.left_s(sum(costs.values()) - worked), state)),
        ]
        blocks = [
            facts("Jobs", rows, "" if is_done else _FAILED),
            *([] if is_done else [running_table(told if is_running else {})]),
            results_table(self.folder, "two-thirds" if is_done else "whole"),
            _done(done, "whole" if is_done else "half"),
            *([] if is_done else [table("Waiting", ["job"], [[each] for each in waiting[:_MOST_SHOWN]])]),
        ]
        return in_blocks(state, blocks)

    def _manifest(self) -> dict[str, Any]:
        return self._described("study.json", "study")


def share_of(folder: Path) -> float:
    """How much of a study is done, by what its jobs cost; 0 where that is not known."""
    done = done_jobs(folder)
    worked, costs = _work(folder, done, running_jobs(folder, done))
    return worked / total if (total := sum(costs.values())) else 0.0


def _work(
    folder: Path, done: dict[str, int], told: dict[str, tuple[float, str, float]]
) -> tuple[float, dict[str, float]]:
    """How much of the work is done, and what each job costs, as it is written where jobs run."""
    found = mapped(json_of(folder / UNFINISHED / PLANNED))
    costs = {text(name): float(cost) for name, cost in found.items() if number(cost) is not None}
    worked = sum(costs.get(name, 0.0) for name in done)
    return worked + sum(share * costs.get(name, 0.0) for name, (share, *_) in told.items()), costs


def done_jobs(folder: Path) -> dict[str, int]:
    """The jobs that have a receipt, the last one last, and how many files each left."""
    receipts = []
    for path in (folder / "jobs").glob("[!.]*.json"):
        try:
            receipts.append((path.stat().st_mtime, path))
        except OSError:
            continue
    found = {}
    for _, path in sorted(receipts)[:_MOST_RECEIPTS]:
        words = mapped(json_of(path))
        if isinstance(words.get("job"), str):
            found[text(words["job"])] = len(mapped(words.get("outputs")))
    return found


def running_jobs(folder: Path, done: dict[str, int]) -> dict[str, tuple[float, str, float]]:
    """What jobs without a receipt told last."""
    told = told_by_jobs(folder / UNFINISHED / ".told")
    return {name: each for name, each in told.items() if name not in done and each[0] < 1}


def _done(done: dict[str, int], width: Width) -> dict[str, Any]:
    rows = [[name, files] for name, files in list(done.items())[-_MOST_SHOWN:]]
    return table("Done", ["job", "files"], rows, width=width)


def running_table(told: dict[str, tuple[float, str, float]], width: Width = "two-thirds") -> dict[str, Any]:
    """What runs."""
    says = any(note for _, note, _ in told.values())
    rows = [[name, f"{100 * share:.0f} %", *([note] if says else [])] for name, (share, note, _) in told.items()]
    head = ["job", "done", *(["what it says"] if says else [])]
    return table("Running", head, rows, "" if rows else "nothing runs now", width=width)


def results_table(folder: Path, width: Width = "whole") -> dict[str, Any]:
    """The mean return of each arm on each robot, as soon as its policies were evaluated."""
    rows = []
    for path in sorted(folder.glob("episodes/*/*/episodes.npz"))[:_MOST_SHOWN]:
        found = mean_of_episodes(path)
        if found is not None:
            rows.append([path.parts[-3], path.parts[-2], *found])
    for path in sorted(folder.glob("culture-*/*/simulated.json"))[:_MOST_SHOWN]:
        for row in listed(mapped(json_of(path)).get("rows"))[:1]:
            told = [number(mapped(row).get(name)) for name in ("mean_return", "actors", "episodes")]
            rows.append([path.parts[-2], f"policies, {path.parts[-3]}", *told])
    words = "Over all policies, on the last recording; the report has their comparisons." if rows else "none yet"
    return table("Results", ["robot", "arm", "mean return", "policies", "episodes"], rows, words, width=width)
