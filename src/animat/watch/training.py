"""The view of a training: learning curves so far, speed, and the simulators in use."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.execution.task import UNFINISHED
from animat.watch.blocks import facts, table, time_left
from animat.watch.files import JobProgress, curve_of_policy, curves_of_checkpoint, job_progress, json_of, newest_s
from animat.watch.learning import learning_charts, levels_of
from animat.watch.plain import mapped, number, numbers, short, text, whole
from animat.watch.state import state_of
from animat.watch.view import View, in_blocks, titled

_MOST_POLICIES = 1000


class TrainingView(View):
    """The folder of a training."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._curves: dict[Path, tuple[float, Any]] = {}

    def about(self) -> dict[str, Any]:
        """The robot that is trained for."""
        training = self._training()
        robot = text(mapped(training.get("robot")).get("name", "robot"))
        return titled(f"training of {robot} policies")

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The progress of the training."""
        training, simulators = self._training(), mapped(self._manifest().get("simulators"))
        planned = min(whole(training.get("policies")) or 0, _MOST_POLICIES)
        iterations = number(training.get("iterations")) or 0
        progress = job_progress(self.folder)
        curves, shares = self._learned(planned, progress)
        done = sum(shares.values())
        self._speed.see(done * iterations)
        left = (planned - done) * iterations
        is_done = planned > 0 and done >= planned
        changed_s = max(
            [newest_s([self.folder, self.folder / UNFINISHED]), *(time_s for *_, time_s in progress.values())]
        )
        state = state_of(self.folder, changed_s, is_done=is_done)
        is_running = state["state"] == "running"
        share = max(shares.values(), default=0.0)
        levels, missing = levels_of(self._manifest(), mapped(json_of(self.folder / "evaluation.json")))
        rows: list[tuple[str, Any]] = [
            ("policies", f"{planned:,}, of which {sum(part >= 1 for part in shares.values()):,} are done"),
            ("iterations of each", iterations),
            ("done", f"{100 * done / max(1, planned):.0f} % of all"),
            ("iterations per second", _speed(self._speed.per_s) if is_running else "none now"),
            ("time left", time_left(self._speed.left_s(left), state)),
            ("mapping", training.get("mapping") or "none: without neurons"),
            *_in_use(training, simulators, share),
            ("algorithm", ", ".join(f"{text(k)} {short(v)}" for k, v in mapped(training.get("algorithm")).items())),
        ]
        swaps = _swaps(training, simulators, iterations)
        charts = learning_charts(curves, swaps, iterations, levels, missing)
        return in_blocks(state, [facts("So far", rows), *charts, _table(planned, curves, shares, progress)])

    def _manifest(self) -> dict[str, Any]:
        return self._described("training.json", "training")

    def _training(self) -> dict[str, Any]:
        return mapped(self._manifest().get("training"))

    def _learned(
        self, planned: int, progress: JobProgress
    ) -> tuple[dict[int, Float64[np.ndarray, "chunks columns"]], dict[int, float]]:
        """The learning curve of each policy by its number, and the share of its training that is done."""
        curves: dict[int, Any] = {}
        shares = dict.fromkeys(range(planned), 0.0)
        # Checkpoints of groups on cores, and of all policies trained together on a GPU.
        unfinished = self.folder / UNFINISHED
        for path in (*unfinished.glob("from-p*.npz"), *unfinished.glob("at-once-*.npz")):
            for i, curve in (self._cached(path, curves_of_checkpoint) or {}).items():
                curves[i], shares[i] = curve, min(1.0, len(curve) / 60)
        for name, (share, _, _) in progress.items():
            members = re.fullmatch(r"p(\d{1,6})(?: to p(\d{1,6}))?", name)
            if members is not None:
                last = min(int(members[2] or members[1]), planned - 1)
                shares |= {i: max(shares.get(i, 0.0), min(share, 1.0)) for i in range(int(members[1]), last + 1)}
        for i in range(planned):
            curve = self._cached(self.folder / f"p{i}.safetensors", curve_of_policy)
            if curve is not None:
                curves[i], shares[i] = curve, 1.0
        known = range(planned)
        return {i: curves[i] for i in sorted(curves) if i in known}, {i: shares[i] for i in known}

    def _cached(self, path: Path, read: Any) -> Any:
        """The content of a file, read again only if it changed."""
        try:
            changed_s = path.stat().st_mtime
        except OSError:
            return None
        if self._curves.get(path, (None,))[0] != changed_s:
            self._curves[path] = changed_s, read(path)
        return self._curves[path][1]


def _speed(per_s: float | None) -> str:
    return "being measured" if per_s is None else f"{per_s:,.0f}, all policies together"


def _in_use(training: dict[str, Any], simulators: dict[str, Any], share: float) -> list[tuple[str, Any]]:
    minutes = _recorded_at_min(simulators)
    if not minutes:
        return [("recordings", "none: training without neurons")]
    list_of_minutes = ", ".join(f"{minute:g}" for minute in minutes)
    if training.get("shadowing") == "drawn":
        return [("recordings", f"at minutes {list_of_minutes}; each episode draws one")]
    clock = _minute(training, minutes, share)
    used = max((minute for minute in minutes if minute <= clock + 1e-9), default=minutes[0])
    return [("recordings", f"at minutes {list_of_minutes}"), ("in use", f"that of minute {used:g}")]


def _recorded_at_min(simulators: dict[str, Any]) -> list[float]:
    return [minute for minute in numbers(simulators.get("recorded_at_min")) if minute is not None]


def _minute(training: dict[str, Any], minutes: list[float], share: float) -> float:
    """The culture's clock after a share of the training, at the start of the current chunk."""
    if not training.get("shadowing"):
        return minutes[0]
    return minutes[0] + (number(training.get("duration_min")) or 0.0) * min(int(60 * share), 59) / 60


def _swaps(training: dict[str, Any], simulators: dict[str, Any], iterations: float) -> list[tuple[float, str]]:
    """After how many iterations the simulators are refreshed."""
    minutes = _recorded_at_min(simulators)
    duration_min = number(training.get("duration_min")) or 0.0
    if not minutes or training.get("shadowing") is not True or duration_min <= 0:
        return []
    swaps = [((minute - minutes[0]) / duration_min, minute) for minute in minutes[1:]]
    return [(share * iterations, f"minute {minute:g}") for share, minute in swaps if 0 < share < 1]


def _table(
    planned: int,
    curves: dict[int, Float64[np.ndarray, "chunks columns"]],
    shares: dict[int, float],
    progress: JobProgress,
) -> dict[str, Any]:
    rows = []
    for i in range(planned):
        curve = curves.get(i)
        returns = [] if curve is None else [x for x in curve[:, 2].tolist() if np.isfinite(x)]
        rows.append([f"p{i}", f"{100 * shares[i]:.0f} %", returns[-1] if returns else "none yet"])
    note = "; ".join(f"{name}: {100 * share:.0f} % {message}".strip() for name, (share, message, _) in progress.items())
    return table("Policies", ["policy", "done", "last return"], rows, note, width="whole")
