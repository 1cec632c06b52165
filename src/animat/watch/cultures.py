"""The view of a study over many cultures: the progress of each, and comparisons over those that are done."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile
from animat.plain_file import read_plain_text
from animat.watch.blocks import Width, facts, table, time_left
from animat.watch.files import json_of, newest_s
from animat.watch.plain import listed, mapped, text
from animat.watch.state import is_locked, state_of
from animat.watch.study import share_of
from animat.watch.view import View, in_blocks, titled

_MANIFEST, _DONE, _COMPARISONS = "cultures.json", "jobs/report.json", "tables/comparisons.csv"
_MOST_CULTURES, _MOST_BYTES = 10_000, 2**20
_NOTE = "Mean returns over the cultures that are done, and in how many of them that of the second arm is larger."
_Means = list[tuple[str, str, float, float]]
"""Comparison, robot, and the means of both arms, on one culture."""


class CulturesView(View):
    """The folder of a study over many cultures."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._compared: dict[str, _Means] = {}

    def about(self) -> dict[str, Any]:
        """The number of cultures."""
        return titled(f"study over {len(self._names()):,} cultures")

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The progress of the cultures."""
        names, failed = self._names(), self._failed()
        done = [name for name in names if (self.folder / name / _DONE).exists()]
        begun = [name for name in names if name not in done and (self.folder / name).is_dir()]
        shares = {name: share_of(self.folder / name) for name in begun if is_locked(self.folder / name) is not False}
        self._speed.see(worked := len(done) + sum(shares.values()))
        changed_s = newest_s([self.folder, *(self.folder / name / "jobs" for name in begun)])
        state = state_of(self.folder, changed_s, is_done=len(done) == len(names))
        running = shares if state["state"] == "running" else {}
        if failed and state["state"] == "silent":
            state = {
                "state": "ended",
                "message": f"{len(failed)} of the cultures failed; run the study again to continue",
            }
        rows: list[tuple[str, Any]] = [
            ("cultures done", f"{len(done):,} of {len(names):,}"),
            ("running", len(running)),
            ("begun, not running", len(begun) - len(running)),
            ("failed", len(failed)),
            ("time left", time_left(self._speed.left_s(len(names) - worked), state)),
        ]
        is_done = state["state"] == "ended"
        shares_done = [[name, f"{100 * share:.0f} %"] for name, share in running.items()]
        note = "" if running else "nothing is running"
        blocks = [
            facts("Cultures", rows, "The list at the top has a page for each culture."),
            *([] if is_done else [table("Running", ["culture", "done"], shares_done, note, width="two-thirds")]),
            *([table("Failed", ["culture", "error"], [[*row] for row in failed.items()])] if failed else ()),
            self._comparisons(done, "two-thirds" if is_done else "whole"),
        ]
        return in_blocks(state, blocks)

    def _comparisons(self, done: list[str], width: Width) -> dict[str, Any]:
        pairs_of: dict[tuple[str, str], list[tuple[float, float]]] = {}
        left_out = 0
        for name in done:
            if name not in self._compared:
                means = _means_of(self.folder / name / _COMPARISONS)
                if means is None:
                    left_out += 1
                    continue
                self._compared[name] = means
            for comparison, robot, first, second in self._compared[name]:
                pairs_of.setdefault((comparison, robot), []).append((first, second))
        rows = []
        for (comparison, robot), pairs in pairs_of.items():
            first, second = (sum(means) / len(pairs) for means in zip(*pairs, strict=True))
            larger = sum(after > before for before, after in pairs)
            rows.append([comparison, robot, first, second, f"{larger:,} of {len(pairs):,}"])
        head = ["comparison", "robot", "mean, first arm", "mean, second arm", "second larger in"]
        note = _NOTE if rows else "none yet"
        if left_out:
            note += f" Left out, as their {_COMPARISONS} cannot be read: {left_out:,} of the cultures that are done."
        return table("Comparisons", head, rows, note, width=width)

    def _failed(self) -> dict[str, str]:
        """The cultures that the last run could not finish, each with its error."""
        failed = mapped(mapped(json_of(self.folder / _MANIFEST)).get("failed"))
        return {name: text(error) for name, error in list(failed.items())[:_MOST_CULTURES] if _is_name(name)}

    def _names(self) -> list[str]:
        names = [
            name
            for name in listed(mapped(json_of(self.folder / _MANIFEST)).get("cultures"))
            # A link may lead out of the folder.
            if _is_name(name) and not (self.folder / name).is_symlink()
        ]
        if not names:
            raise InvalidFile(f"{self.folder / _MANIFEST}: expected the names of cultures, got none")
        return names[:_MOST_CULTURES]


def _is_name(name: Any) -> bool:
    return isinstance(name, str) and name.startswith("culture-") and "/" not in name and text(name) == name


def _means_of(path: Path) -> _Means | None:
    """The means in a table of comparisons; None if it is damaged."""
    try:
        rows = csv.DictReader(io.StringIO(read_plain_text(path, _MOST_BYTES)))
        means = [
            (text(row["comparison"]), text(row["robot"]), float(row["mean_first"]), float(row["mean_second"]))
            for row in rows
        ]
    except (InvalidFile, csv.Error, KeyError, TypeError, ValueError):
        return None
    return means if all(math.isfinite(mean) for *_, first, second in means for mean in (first, second)) else None
