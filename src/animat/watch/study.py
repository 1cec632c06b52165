"""The view of a study: its jobs, how many are done, what runs, what is left, and results as they come."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from animat.errors import AnimatError, InvalidFile
from animat.plain_file import read_toml
from animat.watch.blocks import Width, facts, table, time_left
from animat.watch.files import json_of, mean_of_episodes, newest_s, told_by_jobs
from animat.watch.held import state_of
from animat.watch.plain import listed, mapped, number, text
from animat.watch.view import View, in_blocks, titled

_UNFINISHED = ".unfinished"
_MOST_RECEIPTS, _MOST_SHOWN = 5000, 300
_CONTEXT = "context study"
_FAILED = "A job that fails ends the study, and its command says which: the folder does not keep it."


class StudyView(View):
    """A study's folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._planned: list[tuple[str, float]] | None = None
        self._why_not = ""

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
        planned = self._plan(done)
        names = set(done)
        left = [] if planned is None else [(name, cost) for name, cost in planned if name not in names]
        worked, total = _work(planned or [], done, told)
        self._speed.see(worked)
        is_done = planned is not None and not left
        changed_s = newest_s([self.folder, self.folder / "jobs", *(self.folder / _UNFINISHED).glob("*/*.json")])
        state = state_of(self.folder, changed_s, is_done=is_done)
        is_running = state["state"] == "running"
        waiting = [name for name, _ in left if name not in told]
        rows: list[tuple[str, Any]] = [
            ("jobs done", len(done)),
            ("running", len(told) if is_running else 0),
            ("waiting", len(waiting) if planned is not None else f"not known: {self._why_not}"),
            ("failed", "none" if is_running or is_done else "its command said which, if any"),
            ("time left", time_left(self._speed.left_s(total - worked), state)),
        ]
        blocks = [
            facts("Jobs", rows, "" if is_done else _FAILED),
            *([] if is_done else [running_table(told if is_running else {})]),
            results_table(self.folder, "two-thirds" if is_done else "whole"),
            _done(done, "whole" if is_done else "half"),
            *([] if is_done else [table("Waiting", ["job"], [[each] for each in waiting[:_MOST_SHOWN]])]),
        ]
        return in_blocks(state, blocks)

    def share(self) -> float | None:
        """How much of the work is done, by what jobs cost; None where that is not known."""
        done = done_jobs(self.folder)
        worked, total = _work(self._plan(done) or [], done, running_jobs(self.folder, done))
        return worked / total if total else None

    def _manifest(self) -> dict[str, Any]:
        return self._described("study.json", "study")

    def _plan(self, done: dict[str, int]) -> list[tuple[str, float]] | None:
        """All jobs with what they cost, by the study's specification; None where that cannot be known."""
        if self._planned is None and not self._why_not:
            try:
                self._planned = _jobs_of(self.folder)
            except AnimatError as error:
                self._why_not = text(str(error))
            except Exception as error:
                # Of another version, or damaged.
                self._why_not = f"the specification cannot be read ({type(error).__name__})"
        return self._planned


def _work(
    planned: list[tuple[str, float]], done: dict[str, int], told: dict[str, tuple[float, str, float]]
) -> tuple[float, float]:
    """How much of the work is done, and all that there is, in what jobs cost."""
    costs = dict(planned)
    worked = sum(costs.get(name, 0.0) for name in done)
    return worked + sum(share * costs.get(name, 0.0) for name, (share, *_) in told.items()), sum(costs.values())


def _jobs_of(folder: Path) -> list[tuple[str, float]]:
    context = mapped(json_of(folder / "study.json")).get(_CONTEXT)
    if context is not None:
        return _jobs_of_context(mapped(context))
    specification = folder / "study.toml"
    words = read_toml(specification, 2**20)
    named = [mapped(each) for name in ("robots", "arms") for each in listed(words.get(name))]
    if any(":" in str(each.get(key, "")) for each in named for key in ("name", "kind", "mapping")):
        # Reading it would import what it names.
        raise InvalidFile("the study names code of one's own, which a page does not import")
    from animat.studies.plan import plan_study
    from animat.studies.toml import read_study

    return [(job.name, job.cost_s) for job in plan_study(read_study(specification), folder)]


def _jobs_of_context(words: dict[str, Any]) -> list[tuple[str, float]]:
    robots, cultures = (tuple(listed(words.get(name))) for name in ("robots", "cultures"))
    if any(":" in str(robot) for robot in robots):
        raise InvalidFile("the study names code of one's own, which a page does not import")
    if len(robots) * len(cultures) > _MOST_RECEIPTS:
        raise InvalidFile("the study has more robots and cultures than a page looks through")
    from animat.studies.context import plan_context_study
    from animat.studies.context_tasks import ContextStudy

    study = ContextStudy(**{**words, "robots": robots, "cultures": cultures})
    return [(job.name, job.cost_s) for job in plan_context_study(study)]


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
    told = told_by_jobs(folder / _UNFINISHED / ".told")
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
