"""The view of a tuning: its trials as they are told, what runs, and the best so far."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Sequence
from typing import Any

from animat.errors import InvalidFile
from animat.plain_file import read_plain_text
from animat.watch.blocks import chart, curve, facts, table, time_left
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
        tune = mapped(self._manifest().get("tune"))
        planned = whole(tune.get("trials")) or 0
        trials = self._trials()
        results = mapped(json_of(self.folder / "results.json"))
        told = {n: each for n, each in self._told().items() if each[0] < 1}
        self._speed.see(len(trials))
        is_done = (self.folder / "results.json").exists()
        changed_s = newest_s([self.folder, *(self.folder / ".unfinished").glob("**/*.json")])
        state = state_of(self.folder, changed_s, is_done=is_done)
        is_running = state["state"] == "running"
        states = [trial["state"] for trial in trials]
        complete = (t for t in trials if t["state"] == "complete" and t["last"] is not None)
        best = max(complete, key=lambda t: t["last"], default=None)
        rows: list[tuple[str, Any]] = [
            ("trials done", f"{len(trials):,} of {planned:,}"),
            ("complete", states.count("complete")),
            ("stopped early", states.count("stopped")),
            ("diverged", states.count("diverged")),
            ("under way", _under_way(told, tune, len(trials), planned) if is_running else "nothing"),
            ("time left", self._left(planned - len(trials)) if is_running and planned else time_left(None, state)),
            _won(results)
            or ("best so far", "none yet" if best is None else f"trial {best['trial']}, {short(best['last'])}"),
        ]
        named = {_in_words(name): each for name, each in told.items()}
        below = _finals(results) if is_done else [running_table(named if is_running else {}, "whole")]
        chart = _chart(trials, planned if is_running else 0)
        return in_blocks(state, [facts("Trials", rows), chart, *below, _table(trials)])

    def _left(self, trials: int) -> str:
        if trials <= 0:
            return "not known: the best trials are retrained"
        left_s = self._speed.left_s(trials)
        return time_left(left_s, {"state": "running"}) + (
            "" if left_s is None else " of trials, then the best are retrained"
        )

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


def _numbers(name: str) -> tuple[str, list[str]]:
    """The rung and the trials of a job, by its name (`rung-1/trials-4+5`, in whose file's name `/` is `+` too)."""
    found = re.match(r"rung-(\d+)/trials-([\d/]+)$", name)
    return (found[1], found[2].split("/")) if found else ("", [])


def _in_words(name: str) -> str:
    """What a job does."""
    rung, trials = _numbers(name)
    if rung:
        return f"trial{'s' if len(trials) > 1 else ''} {', '.join(trials)}, rung {rung}"
    final = re.match(r"final/trial-(\d+)/p(\d+)$", name)
    if not final:
        return name
    return f"trial {final[1]}, retrained" + ("" if final[2] == "0" else f", policies from {final[2]} on")


def _under_way(told: dict[str, Any], tune: dict[str, Any], done: int, planned: int) -> str:
    """What is trained at present."""
    if planned and done >= planned:
        return "the best trials are retrained"
    rungs = [rung for rung, _ in map(_numbers, told) if rung]
    if not rungs:
        return "recordings, simulators" if not done else "the next trials"
    last = min(planned, done + (whole(tune.get("together")) or 1)) - 1
    trials = f"trial {done}" if last <= done else f"trials {done} to {last}"
    return f"{trials}, rung {rungs[0]} of {whole(tune.get('rungs')) or rungs[0]}"


def _finals(results: dict[str, Any]) -> list[dict[str, Any]]:
    """The trials that were trained anew at the end, the best first."""
    finals = [each for each in map(mapped, listed(results.get("finals"))) if whole(each.get("trial")) is not None]
    # One that diverged has no mean.
    finals.sort(key=lambda each: -math.inf if (mean := number(each.get("mean_return"))) is None else mean, reverse=True)
    means = _aligned([number(each.get("mean_return")) for each in finals])
    errors = _aligned([number(each.get("standard_error")) for each in finals])
    rows = [
        [each["trial"], mean, error, _settings(each)] for each, mean, error in zip(finals, means, errors, strict=True)
    ]
    head = ["trial", "mean return", "standard error", "settings"]
    words = "With all policies of the study, other random numbers and fresh episodes." if rows else "none is known"
    return [table("Retrained", head, rows, words, width="whole")]


def _aligned(values: Sequence[float | None]) -> list[str]:
    """Numbers with as many decimals each, four digits of the largest."""
    largest = max((abs(value) for value in values if value is not None), default=0.0)
    decimals = min(9, max(0, 3 - math.floor(math.log10(largest)))) if largest > 0 else 1
    return ["none" if value is None else f"{value:.{decimals}f}" for value in values]


def _settings(of: dict[str, Any]) -> str:
    return ", ".join(f"{text(k, 40)} {short(v)}" for k, v in mapped(of.get("settings")).items())


def _won(results: dict[str, Any]) -> tuple[str, str] | None:
    """The trial that came out best when the best ones were trained once more, once that is known."""
    trial = whole(mapped(results.get("best")).get("trial"))
    finals = {
        whole(each.get("trial")): number(each.get("mean_return")) for each in map(mapped, listed(results.get("finals")))
    }
    mean = finals.get(trial)
    return None if trial is None or mean is None else ("best, retrained", f"trial {trial}, {short(mean)}")


def _trial(line: str) -> dict[str, Any] | None:
    try:
        words = mapped(json.loads(line))
    except (ValueError, RecursionError):
        return None
    rungs = [[x for x in map(number, listed(of)) if x is not None] for of in listed(words.get("returns"))]
    means = [sum(of) / len(of) for of in rungs if of]
    if whole(words.get("trial")) is None:
        return None
    return {
        "trial": words["trial"],
        "state": text(words.get("state", "")),
        "rungs": len(means),
        "last": means[-1] if means else None,
        "settings": _settings(words),
    }


def _chart(trials: list[dict[str, Any]], planned: int) -> dict[str, Any]:
    known = [trial for trial in trials if trial["last"] is not None]
    series = []
    complete = [trial for trial in known if trial["state"] == "complete"]
    if complete:
        best = list(itertools.accumulate((each["last"] for each in complete), max))
        at = [each["trial"] for each in complete]
        # To the last trial that is known, as a step is drawn from a point to the next.
        series.append(curve("best so far", [*at, known[-1]["trial"]], [*best, best[-1]], "steps", "orange"))
    for state, colour in (("complete", "blue"), ("stopped", "grey"), ("diverged", "red")):
        of = [trial for trial in known if trial["state"] == state]
        if of:
            series.append(curve(_STATES[state], [t["trial"] for t in of], [t["last"] for t in of], "dots", colour))
    words = (
        "One dot for each trial: its mean return after its last rung. Trials that were stopped early were trained for "
        "less. Best so far: of those that are complete."
    )
    words = words if series else "No trial has ended yet."
    until = planned - 1 if planned else None
    return chart("Return of each trial", "trial", "mean return", series, words, until=until)


_STATES = {"complete": "complete", "stopped": "stopped early", "diverged": "diverged"}


def _table(trials: list[dict[str, Any]]) -> dict[str, Any]:
    shown = trials[::-1][:_MOST_SHOWN]
    means = _aligned([trial["last"] for trial in shown])
    rows = [
        [t["trial"], _STATES.get(t["state"], t["state"]), m, t["settings"]] for t, m in zip(shown, means, strict=True)
    ]
    return table(
        "Journal",
        ["trial", "state", "mean return", "settings"],
        rows,
        "" if rows else "no trial is done yet",
        width="whole",
    )
