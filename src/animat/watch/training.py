"""The view of a training: learning curves so far, speed, and the simulators in use."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from animat.execution.task import UNFINISHED
from animat.watch.blocks import facts, table, time_left
from animat.watch.files import JobProgress, curve_of_policy, curves_of_checkpoint, job_progress, json_of
from animat.watch.learning import Curves, learning_charts, levels_of
from animat.watch.plain import settings, text
from animat.watch.state import changed_s, state_of
from animat.watch.view import View, in_blocks

_MOST_POLICIES = 1000
_CHUNKS = 60
"""Parts of a training, and points of a learning curve."""


class TrainingView(View):
    """The folder of a training."""

    kind = "training"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._read: dict[Path, tuple[float, Any]] = {}

    def _title(self) -> str:
        return f"training of {text(self._manifest()['training']['robot']['name'])} policies"

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        manifest = self._manifest()
        training = manifest["training"]
        minutes = (manifest.get("simulators") or {}).get("recorded_at_min", [])
        planned, iterations = min(training["policies"], _MOST_POLICIES), training["iterations"]
        progress = job_progress(self.folder)
        curves, shares = self._learned(planned, progress)
        done = sum(shares.values())
        self._speed.see(done * iterations)
        left_s = self._speed.left_s((planned - done) * iterations)
        state = state_of(self.folder, is_done=planned > 0 and done >= planned)
        speed = "none now"
        if state["state"] == "running":
            per_s = self._speed.per_s
            speed = "being measured" if per_s is None else f"{per_s:,.0f}, all policies together"
        rows: list[tuple[str, Any]] = [
            ("policies", f"{planned:,}, of which {sum(part >= 1 for part in shares.values()):,} are done"),
            ("iterations of each", iterations),
            ("done", f"{100 * done / max(1, planned):.0f} % of all"),
            ("iterations per second", speed),
            ("time left", time_left(left_s, state)),
            ("mapping", training.get("mapping") or "none: without neurons"),
            *_in_use(training, minutes, max(shares.values(), default=0.0)),
            ("algorithm", settings(training.get("algorithm", {}))),
        ]
        levels, missing = levels_of(manifest.get("random_return"), json_of(self.folder / "evaluation.json"))
        charts = learning_charts(curves, _swaps(training, minutes), iterations, levels, missing)
        return in_blocks(state, [facts("So far", rows), *charts, _table(curves, shares, progress)])

    def _learned(self, planned: int, progress: JobProgress) -> tuple[Curves, dict[int, float]]:
        """The learning curve of each policy by its number, and the share of its training that is done."""
        curves: Curves = {}
        shares = dict.fromkeys(range(planned), 0.0)
        # Checkpoints of groups on cores, and of all policies trained together on a GPU.
        unfinished = self.folder / UNFINISHED
        for path in (*unfinished.glob("from-p*.npz"), *unfinished.glob("at-once-*.npz")):
            for i, curve in (self._content(path, curves_of_checkpoint) or {}).items():
                curves[i], shares[i] = curve, min(1.0, len(curve) / _CHUNKS)
        for name, (share, _) in progress.items():
            members = re.fullmatch(r"p(\d{1,6})(?: to p(\d{1,6}))?", name)
            if members is not None:
                last = min(int(members[2] or members[1]), planned - 1)
                shares |= {i: max(shares[i], min(share, 1.0)) for i in range(int(members[1]), last + 1)}
        for i in range(planned):
            curve = self._content(self.folder / f"p{i}.safetensors", curve_of_policy)
            if curve is not None:
                curves[i], shares[i] = curve, 1.0
        known = range(planned)
        return {i: curves[i] for i in known if i in curves}, {i: shares[i] for i in known}

    def _content(self, path: Path, read: Any) -> Any:
        """The content of a file, read again only if it changed; None if there is none."""
        time_s = changed_s(path)
        if time_s is None:
            return None
        if self._read.get(path, (None,))[0] != time_s:
            self._read[path] = time_s, read(path)
        return self._read[path][1]


def _in_use(training: dict[str, Any], minutes: list[float], share: float) -> list[tuple[str, Any]]:
    if not minutes:
        return [("recordings", "none: training without neurons")]
    recordings = f"at minutes {', '.join(f'{minute:g}' for minute in minutes)}"
    if training.get("shadowing") == "drawn":
        return [("recordings", f"{recordings}; each episode draws one")]
    clock_min = minutes[0]
    if training.get("shadowing"):
        # At the start of the current chunk.
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
