"""The view of a tuning: its trials, running jobs, and the best trial so far."""

from __future__ import annotations

import itertools
import json
import math
from statistics import fmean
from typing import Any

from animat.errors import InvalidFile
from animat.watch.discovery import state_of
from animat.watch.files import json_of, listed, mapped, number, text, text_of
from animat.watch.study import running_jobs, running_table
from animat.watch.view import View, chart, curve, facts, in_blocks, settings, short, table, time_left

_MOST_SHOWN = 300
_STATES = {"complete": "complete", "stopped": "stopped early", "diverged": "diverged"}


class TuningView(View):
    kind = "tuning"
    # Many trials end at the same time, followed by a long pause.
    speed_over_s = math.inf

    def _title(self) -> str:
        robots = ", ".join(text(spec["name"]) for spec in self._manifest()["study"]["robots"])
        return f"tuning {f'on {robots}' if robots else ''}".strip()

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        planned = self._manifest()["tune"]["trials"]
        trials = self._trials()
        self._speed.see(len(trials))
        results = json_of(self.folder / "results.json")
        state = state_of(self.folder, is_done=bool(results))
        is_running = state["state"] == "running"
        running = running_jobs(self.folder, {}) if is_running else {}
        states = [trial["state"] for trial in trials]
        complete = (trial for trial in trials if trial["state"] == "complete" and trial["last"] is not None)
        best = max(complete, key=lambda trial: trial["last"], default=None)
        rows: list[tuple[str, Any]] = [
            ("trials done", f"{len(trials):,} of {planned:,}"),
            *((name, states.count(kind)) for kind, name in _STATES.items()),
            ("running", len(running)),
            ("time left for the trials", time_left(self._speed.left_s(planned - len(trials)), state)),
            (
                f"best {'of the search' if results else 'so far'}",
                "none yet" if best is None else f"trial {best['trial']}, {short(best['last'])}",
            ),
        ]
        jobs = _finals(results) if results else running_table(running, "whole")
        trials_chart = _chart(trials, planned - 1 if is_running else None)
        return in_blocks(state, [facts("Trials", rows), trials_chart, jobs, _table(trials)])

    def _trials(self) -> list[dict[str, Any]]:
        """The readable trials in the journal, each with its last mean return."""
        try:
            lines = text_of(self.folder / "journal.jsonl", 2**26).splitlines()
        except InvalidFile:
            return []
        return [trial for line in lines if (trial := _trial(line)) is not None]


def _trial(line: str) -> dict[str, Any] | None:
    try:
        trial = json.loads(line)
        means = [fmean(returns) for returns in trial["returns"]]
        known = {"trial": number(trial["trial"]), "state": text(trial["state"]), "settings": mapped(trial["settings"])}
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None
    return None if known["trial"] is None else known | {"last": number(means[-1]) if means else None}


def _finals(results: dict[str, Any]) -> dict[str, Any]:
    """The trials that were retrained at the end, the best first."""

    def place(row: dict[str, Any]) -> tuple[bool, float, float]:
        mean = number(row.get("mean_return"))
        # A trial that diverged has no mean, and comes last.
        return mean is None, -(mean or 0.0), number(row.get("trial")) or 0

    rows = [
        [row.get("trial"), row.get("mean_return"), row.get("standard_error"), settings(mapped(row.get("settings")))]
        for row in sorted(map(mapped, listed(results.get("finals"))), key=place)
    ]
    head = ["trial", "mean return", "standard error", "settings"]
    note = "With all policies of the study, different random numbers and fresh episodes." if rows else "none is known"
    return table("Retrained", head, rows, note, width="whole")


def _chart(trials: list[dict[str, Any]], until: int | None) -> dict[str, Any]:
    known = [trial for trial in trials if trial["last"] is not None]
    series = []
    for state, colour in (("complete", "blue"), ("stopped", "grey"), ("diverged", "red")):
        alike = [trial for trial in known if trial["state"] == state]
        at, returns = [trial["trial"] for trial in alike], [trial["last"] for trial in alike]
        if alike and state == "complete":
            best = list(itertools.accumulate(returns, max))
            # Extended to the last known trial, as a step is drawn from one point to the next.
            series.append(curve("best so far", [*at, known[-1]["trial"]], [*best, best[-1]], "steps", "orange"))
        if alike:
            series.append(curve(_STATES[state], at, returns, "dots", colour))
    note = "No trial has ended yet."
    if series:
        note = (
            "One dot per trial: its mean return after its last rung. Trials that were stopped early were trained for "
            "less. Best so far: among complete trials."
        )
    return chart("Return of each trial", "trial", "mean return", series, note, until=until)


def _table(trials: list[dict[str, Any]]) -> dict[str, Any]:
    newest = trials[::-1][:_MOST_SHOWN]
    rows = [[t["trial"], _STATES.get(t["state"], t["state"]), t["last"], settings(t["settings"])] for t in newest]
    head = ["trial", "state", "mean return", "settings"]
    return table("Journal", head, rows, "" if rows else "no trial is done yet", width="whole")
