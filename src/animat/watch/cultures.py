"""The view of a study over many cultures: the progress of each, and comparisons over those that are done."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile
from animat.watch.discovery import is_locked, state_of
from animat.watch.files import json_of, text_of
from animat.watch.plain import listed, mapped, text
from animat.watch.study import share_of
from animat.watch.view import View, Width, facts, in_blocks, table, time_left

_DONE, _COMPARISONS = "jobs/report.json", "tables/comparisons.csv"
_MOST_CULTURES, _MOST_BYTES = 10_000, 2**20
_NOTE = "Mean returns over the cultures that are done, and in how many of them that of the second arm is larger."
_Means = dict[tuple[str, str], tuple[float, float]]
"""The means of both arms on one culture, by comparison and robot."""


class CulturesView(View):
    """The folder of a study over many cultures."""

    kind = "cultures"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._compared: dict[str, _Means] = {}

    def _title(self) -> str:
        return f"study over {len(self._names()):,} cultures"

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        names, failed = self._names(), self._failed()
        done = [name for name in names if (self.folder / name / _DONE).exists()]
        begun = [name for name in names if name not in done and (self.folder / name).is_dir()]
        shares = {name: share_of(self.folder / name) for name in begun if is_locked(self.folder / name) is not False}
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
            if name not in self._compared and (means := _means_of(self.folder / name / _COMPARISONS)) is not None:
                self._compared[name] = means
        known = [self._compared[name] for name in done if name in self._compared]
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
        # A link may lead out of the folder.
        names = [
            name
            for name in listed(json_of(self.file).get("cultures"))
            if _is_name(name) and not (self.folder / name).is_symlink()
        ]
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
            for row in csv.DictReader(io.StringIO(text_of(path, _MOST_BYTES)))
        }
    except (InvalidFile, csv.Error, KeyError, TypeError, ValueError):
        return None
    return means if all(math.isfinite(mean) for pair in means.values() for mean in pair) else None
