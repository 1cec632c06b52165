"""The view of a tuning: its trials as they are told, what runs, and the best so far."""

from __future__ import annotations

import json
from typing import Any

from animat.errors import InvalidFile
from animat.plain_file import read_plain_text
from animat.watch.blocks import chart, curve, duration, facts, table, time_left
from animat.watch.files import json_of, newest_s, told_by_jobs
from animat.watch.held import state_of
from animat.watch.plain import listed, mapped, number, short, text, whole
from animat.watch.study import running_table
from animat.watch.view import View, in_blocks, titled

_MOST_SHOWN = 300


class TuningView(View):
    """A tuning's folder."""

    def about(self) -> dict[str, Any]:
        """What is tuned."""
        study = mapped(self._manifest().get("study"))
        robots = ", ".join(text(mapped(each).get("name", "robot")) for each in listed(study.get("robots")))
        return titled(f"tuning {f'on {robots}' if robots else ''}".strip())

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """How far it is."""
        planned = whole(mapped(self._manifest().get("tune")).get("trials")) or 0
        trials = self._trials()
        told = {n: each for n, each in self._told().items() if each[0] < 1}
        self._speed.see(len(trials))
        is_done = (self.folder / "results.json").exists()
        changed_s = newest_s([self.folder, *(self.folder / ".unfinished").glob("**/*.json")])
        state = state_of(self.folder, changed_s, is_done=is_done)
        is_running = state["state"] == "running"
        states = [trial["state"] for trial in trials]
        best = max((t for t in trials if t["last"] is not None), key=lambda t: (t["rungs"], t["last"]), default=None)
        rows: list[tuple[str, Any]] = [
            ("trials done", f"{len(trials):,} of {planned:,}"),
            ("complete", states.count("complete")),
            ("stopped early", states.count("stopped")),
            ("diverged", states.count("diverged")),
            ("running", len(told) if is_running else 0),
            ("time left", self._left(planned - len(trials)) if is_running else time_left(None, state)),
            _won(mapped(json_of(self.folder / "results.json")))
            or ("best so far", "none yet" if best is None else f"trial {best['trial']}, {best['last']:.1f}"),
        ]
        running = [] if is_done else [running_table(told if is_running else {}, "whole")]
        return in_blocks(state, [facts("Trials", rows), _chart(trials), *running, _table(trials)])

    def _left(self, trials: int) -> str:
        if trials <= 0:
            return "the finals are trained: not known"
        return f"{duration(self._speed.left_s(trials))} of trials, then the finals"

    def _manifest(self) -> dict[str, Any]:
        return self._described("tune.json", "tuning")

    def _told(self) -> dict[str, tuple[float, str, float]]:
        found: dict[str, tuple[float, str, float]] = {}
        for notices in sorted(self.folder.glob(".unfinished/**/.told"))[:50]:
            found |= told_by_jobs(notices)
        return found

    def _trials(self) -> list[dict[str, Any]]:
        """What the journal has of each trial, as far as it can be read."""
        try:
            lines = read_plain_text(self.folder / "journal.jsonl", 2**26).splitlines()
        except InvalidFile:
            return []
        return [found for line in lines if (found := _trial(line)) is not None]


def _won(results: dict[str, Any]) -> tuple[str, str] | None:
    """The trial that came out best when the best ones were trained once more, once that is known."""
    trial = whole(mapped(results.get("best")).get("trial"))
    finals = {
        whole(each.get("trial")): number(each.get("mean_return")) for each in map(mapped, listed(results.get("finals")))
    }
    mean = finals.get(trial)
    return None if trial is None or mean is None else ("best, retrained", f"trial {trial}, {mean:.1f}")


def _trial(line: str) -> dict[str, Any] | None:
    try:
        words = mapped(json.loads(line))
    except (ValueError, RecursionError):
        return None
    rungs = [[x for x in map(number, listed(of)) if x is not None] for of in listed(words.get("returns"))]
    means = [sum(of) / len(of) for of in rungs if of]
    settings = ", ".join(f"{text(k, 40)} {short(v)}" for k, v in mapped(words.get("settings")).items())
    if whole(words.get("trial")) is None:
        return None
    return {
        "trial": words["trial"],
        "state": text(words.get("state", "")),
        "rungs": len(means),
        "last": means[-1] if means else None,
        "settings": settings,
    }


def _chart(trials: list[dict[str, Any]]) -> dict[str, Any]:
    known = [trial for trial in trials if trial["last"] is not None]
    series = []
    for state, colour in (("complete", "blue"), ("stopped", "grey"), ("diverged", "red")):
        of = [trial for trial in known if trial["state"] == state]
        if of:
            series.append(curve(state, [t["trial"] for t in of], [t["last"] for t in of], "dots", colour))
    words = (
        "One dot for each trial: its mean return after its last rung. Trials that were stopped were trained for less."
    )
    return chart("Return of each trial", "trial", "mean return", series, words if series else "No trial has ended yet.")


def _table(trials: list[dict[str, Any]]) -> dict[str, Any]:
    rows = [[t["trial"], t["state"], t["last"], t["settings"]] for t in trials[::-1][:_MOST_SHOWN]]
    return table(
        "Journal",
        ["trial", "state", "mean return", "settings"],
        rows,
        "" if rows else "no trial is told yet",
        width="whole",
    )
