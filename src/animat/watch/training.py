"""The view of a training: learning curves so far, speed, and the simulators in use."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from animat.execution.task import UNFINISHED
from animat.watch.discovery import is_locked, state_of
from animat.watch.files import JobProgress, arrays_in, job_progress, json_of, listed, mapped, number, text
from animat.watch.learning import MOST_POLICIES, Curves, curve_of_policy, learning_charts, with_all_columns
from animat.watch.view import View, facts, in_blocks, settings, table, time_left

_MOST_BYTES = 2**22
_CHUNKS = 60
"""Parts of a training, and points of a learning curve."""


class TrainingView(View):
    kind = "training"

    def _title(self) -> str:
        return f"training of {text(self._manifest()['training']['robot']['name'])} policies"

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        manifest = self._manifest()
        training = manifest["training"]
        minutes = (manifest.get("simulators") or {}).get("recorded_at_min", [])
        planned, iterations = min(training["policies"], MOST_POLICIES), training["iterations"]
        progress = job_progress(self.folder)
        # What a stopped training had done since its last checkpoint is lost.
        curves, shares = self._curves_so_far(planned, {} if is_locked(self.folder) is False else progress)
        done = sum(shares.values())
        self._speed.see(done * iterations)
        left_s = self._speed.left_s((planned - done) * iterations)
        state = state_of(self.folder, is_done=planned > 0 and done >= planned)
        speed = "none now"
        if state["state"] == "running":
            per_s = self._speed.per_s
            speed = "being measured" if per_s is None else f"{per_s:,.0f}, all policies together"
        finished = sum(part >= 1 for part in shares.values())
        rows: list[tuple[str, Any]] = [
            ("policies", f"{planned:,}, of which {finished:,} {'is' if finished == 1 else 'are'} done"),
            ("iterations of each", iterations),
            ("done", f"{100 * done / max(1, planned):.0f} % of all"),
            ("iterations per second", speed),
            ("time left", time_left(left_s, state)),
            ("mapping", training.get("mapping") or "none: without neurons"),
            *_in_use(training, minutes, max(shares.values(), default=0.0)),
            ("algorithm", settings(training.get("algorithm", {}))),
        ]
        levels, missing = _levels_of(manifest.get("random_return"), json_of(self.folder / "evaluation.json"))
        charts = learning_charts(curves, _swaps(training, minutes), iterations, levels, missing)
        return in_blocks(state, [facts("So far", rows), *charts, _table(curves, shares, progress)])

    def _curves_so_far(self, planned: int, progress: JobProgress) -> tuple[Curves, dict[int, float]]:
        """The learning curve of each policy by its number, and the share of its training that is done."""
        curves: Curves = {}
        # Checkpoints of groups on cores, and of all policies trained together on a GPU.
        unfinished = self.folder / UNFINISHED
        for path in (*unfinished.glob("from-p*.npz"), *unfinished.glob("at-once-*.npz")):
            curves |= self._cached_content(path, _curves_of_checkpoint) or {}
        shares = {i: min(1.0, len(curves.get(i, ())) / _CHUNKS) for i in range(planned)}
        for name, (share, _) in progress.items():
            members = re.fullmatch(r"p(\d{1,6})(?: to p(\d{1,6}))?", name)
            if members is not None:
                last = min(int(members[2] or members[1]), planned - 1)
                shares |= {i: max(shares[i], min(share, 1.0)) for i in range(int(members[1]), last + 1)}
        for i in shares:
            if (rows := self._cached_content(self.folder / f"p{i}.safetensors", curve_of_policy)) is not None:
                curves[i], shares[i] = rows, 1.0
        return {i: curves[i] for i in shares if i in curves}, shares


def _curves_of_checkpoint(path: Path) -> Curves:
    """The learning curves in a checkpoint, by policy number; empty if it cannot be read."""
    arrays = arrays_in(path, ("curve", "members"), _MOST_BYTES)
    if arrays is None or (curve := with_all_columns(arrays[0], 3)) is None:
        return {}
    if arrays[1].dtype.kind not in "iu" or arrays[1].shape != curve.shape[1:2]:
        return {}
    return {int(member): curve[:, row] for row, member in enumerate(arrays[1].tolist())}


def _in_use(training: dict[str, Any], minutes: list[float], share: float) -> list[tuple[str, Any]]:
    if not minutes:
        return [("recordings", "none: training without neurons")]
    recordings = f"at minutes {', '.join(f'{minute:g}' for minute in minutes)}"
    if training.get("shadowing") == "drawn":
        return [("recordings", f"{recordings}; each episode draws one")]
    clock_min = minutes[0]
    if training.get("shadowing"):
        # Simulators change only at the start of a chunk.
        clock_min += (training.get("duration_min") or 0.0) * min(int(_CHUNKS * share), _CHUNKS - 1) / _CHUNKS
    used = max((minute for minute in minutes if minute <= clock_min + 1e-9), default=minutes[0])
    return [("recordings", recordings), ("in use", f"that of minute {used:g}")]


def _swaps(training: dict[str, Any], minutes: list[float]) -> list[tuple[float, str]]:
    """After how many iterations the simulators are refreshed."""
    duration_min = training.get("duration_min")
    if not duration_min or training.get("shadowing") is not True:
        return []
    shares = [((minute - minutes[0]) / duration_min, minute) for minute in minutes[1:]]
    return [(share * training["iterations"], f"minute {minute:g}") for share, minute in shares if 0 < share < 1]


def _table(curves: Curves, shares: dict[int, float], progress: JobProgress) -> dict[str, Any]:
    rows = []
    for i, share in shares.items():
        returns = [x for x in curves[i][:, 2].tolist() if np.isfinite(x)] if i in curves else []
        rows.append([f"p{i}", f"{100 * share:.0f} %", returns[-1] if returns else "none yet"])
    note = "; ".join(f"{name}: {100 * share:.0f} % {message}".strip() for name, (share, message) in progress.items())
    return table("Policies", ["policy", "done", "last return"], rows, note, width="whole")


def _levels_of(random_return: float | None, evaluation: Mapping[str, Any]) -> tuple[dict[str, float], str]:
    """Returns to compare with, by name, and a note on their source and on those that are not known."""
    # The evaluation is a file of the user's, which may hold anything.
    listed_rows = map(mapped, listed(evaluation.get("rows")))
    rows = {text(row.get("name")): number(row.get("mean_return")) for row in listed_rows}
    returns = {
        "random actions": rows.get("random", random_return),
        "best coupling": rows.get("coupling"),
        "optimal return": number(mapped(evaluation.get("optimum")).get("value")),
    }
    known = {name: value for name, value in returns.items() if value is not None}
    note = f"Lines: {', '.join(f'{name} {value:.4g}' for name, value in known.items())}." if known else ""
    if rows and (minute := number(evaluation.get("recorded_at_min"))) is not None:
        note += f" They are on the simulator of minute {minute:g}, from evaluation.json."
    elif known and not rows:
        note = note[:-1] + ", on the first simulator."
    if missing := [name for name in returns if name not in known]:
        note += f" Not known: {', '.join(missing)}. To show them, run animat evaluate with --optimum and "
        note += "--out evaluation.json, in this folder."
    return known, note.strip()
