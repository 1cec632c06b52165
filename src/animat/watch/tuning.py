"""The view of a tuning: its trials, running jobs, and the best trial so far."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile
from animat.execution.task import UNFINISHED
from animat.plain_file import read_plain_text
from animat.watch.blocks import chart, curve, facts, table, time_left
from animat.watch.files import json_of, newest_s
from animat.watch.plain import listed, mapped, number, short, text, whole
from animat.watch.state import state_of
from animat.watch.study import running_jobs, running_table
from animat.watch.view import View, in_blocks, titled

_MOST_SHOWN = 300


class TuningView(View):
    """The folder of a tuning."""

    def about(self) -> dict[str, Any]:
        """The robots that are tuned for."""
        study = mapped(self._manifest().get("study"))
        robots = ", ".join(text(mapped(spec).get("name", "robot")) for spec in listed(study.get("robots")))
        return titled(f"tuning {f'on {robots}' if robots else ''}".strip())

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The progress of the trials."""
        planned = whole(mapped(self._manifest().get("tune")).get("trials")) or 0
        trials = self._trials()
        self._speed.see(len(trials))
        is_done = (self.folder / "results.json").exists()
        changed_s = newest_s([self.folder, *(self.folder / UNFINISHED).glob("**/*.json")])
        state = state_of(self.folder, changed_s, is_done=is_done)
        running = running_jobs(self.folder, {}) if state["state"] == "running" else {}
        states = [trial["state"] for trial in trials]
        complete = (t for t in trials if t["state"] == "complete" and t["last"] is not None)
        best = max(complete, key=lambda t: t["last"], default=None)
        rows: list[tuple[str, Any]] = [
            ("trials done", f"{len(trials):,} of {planned:,}"),
            ("complete", states.count("complete")),
            ("stopped early", states.count("stopped")),
            ("diverged", states.count("diverged")),
            ("running", len(running)),
            ("time left for the trials", time_left(self._speed.left_s(planned - len(trials)), state)),
            (
                f"best {'of the search' if is_done else 'so far'}",
                "none yet" if best is None else f"trial {best['trial']}, {short(best['last'])}",
            ),
        ]
        jobs = _finals(self.folder) if is_done else running_table(running, "whole")
        chart = _chart(trials, planned if state["state"] == "running" else 0)
        return in_blocks(state, [facts("Trials", rows), chart, jobs, _table(trials)])

    def _manifest(self) -> dict[str, Any]:
        return self._described("tune.json", "tuning")

    def _trials(self) -> list[dict[str, Any]]:
        """The readable trials in the journal."""
        try:
            lines = read_plain_text(self.folder / "journal.jsonl", 2**26).splitlines()
        except InvalidFile:
            return []
        return [trial for line in lines if (trial := _trial(line)) is not None]


def _finals(folder: Path) -> dict[str, Any]:
    """The trials that were retrained at the end, the best first."""
    results = mapped(json_of(folder / "results.json"))
    finals = [row for row in map(mapped, listed(results.get("finals"))) if whole(row.get("trial")) is not None]
    # One that diverged has no mean.
    finals.sort(key=lambda row: (math.inf if (mean := number(row.get("mean_return"))) is None else -mean, row["trial"]))
    rows = [
        [row["trial"], number(row.get("mean_return")), number(row.get("standard_error")), _settings(row)]
        for row in finals
    ]
    head = ["trial", "mean return", "standard error", "settings"]
    note = "With all policies of the study, different random numbers and fresh episodes." if rows else "none is known"
    return table("Retrained", head, rows, note, width="whole")


def _settings(row: dict[str, Any]) -> str:
    return ", ".join(f"{text(k, 40)} {short(v)}" for k, v in mapped(row.get("settings")).items())


def _trial(line: str) -> dict[str, Any] | None:
    try:
        row = mapped(json.loads(line))
    except (ValueError, RecursionError):
        return None
    rungs = [[x for x in map(number, listed(returns)) if x is not None] for returns in listed(row.get("returns"))]
    means = [sum(returns) / len(returns) for returns in rungs if returns]
    if whole(row.get("trial")) is None:
        return None
    return {
        "trial": row["trial"],
        "state": text(row.get("state", "")),
        "last": means[-1] if means else None,
        "settings": _settings(row),
    }


def _chart(trials: list[dict[str, Any]], planned: int) -> dict[str, Any]:
    known = [trial for trial in trials if trial["last"] is not None]
    series = []
    complete = [trial for trial in known if trial["state"] == "complete"]
    if complete:
        best = list(itertools.accumulate((trial["last"] for trial in complete), max))
        at = [trial["trial"] for trial in complete]
        # Extended to the last known trial, as a step is drawn from one point to the next.
        series.append(curve("best so far", [*at, known[-1]["trial"]], [*best, best[-1]], "steps", "orange"))
    for state, colour in (("complete", "blue"), ("stopped", "grey"), ("diverged", "red")):
        alike = [trial for trial in known if trial["state"] == state]
        if alike:
            xs, ys = [trial["trial"] for trial in alike], [trial["last"] for trial in alike]
            series.append(curve(_STATES[state], xs, ys, "dots", colour))
    note = "No trial has ended yet."
    if series:
        note = (
            "One dot per trial: its mean return after its last rung. Trials that were stopped early were trained for "
            "less. Best so far: among complete trials."
        )
    until = planned - 1 if planned else None
    return chart("Return of each trial", "trial", "mean return", series, note, until=until)


_STATES = {"complete": "complete", "stopped": "stopped early", "diverged": "diverged"}


def _table(trials: list[dict[str, Any]]) -> dict[str, Any]:
    shown = trials[::-1][:_MOST_SHOWN]
    rows = [[t["trial"], _STATES.get(t["state"], t["state"]), t["last"], t["settings"]] for t in shown]
    return table(
        "Journal",
        ["trial", "state", "mean return", "settings"],
        rows,
        "" if rows else "no trial is done yet",
        width="whole",
    )
