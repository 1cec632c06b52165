"""Small files of a run that may be in progress: read whole, or treated as missing."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.errors import InvalidFile
from animat.execution.task import NOTICES, UNFINISHED
from animat.plain_file import read_plain_text
from animat.training.policy import CURVE, whole_curve
from animat.watch.plain import listed, number, text

_MOST_BYTES = 2**24
_MOST_CURVE_BYTES = 2**22
_MOST_EPISODES_BYTES = 2**27


def json_of(path: Path) -> Any:
    """The contents of a JSON file; None if it cannot be read."""
    try:
        return json.loads(read_plain_text(path, _MOST_BYTES))
    except (InvalidFile, ValueError, RecursionError):
        return None


JobProgress = dict[str, tuple[float, str, float]]
"""The share done of each job, a message, and when it was reported."""


def job_progress(folder: Path) -> JobProgress:
    """The last progress reported by the jobs of an unfinished run."""
    progress = {}
    for path in sorted((folder / UNFINISHED / NOTICES).glob("*.json"))[:1000]:
        report = listed(json_of(path))
        try:
            changed_s = path.stat().st_mtime
        except OSError:
            continue
        if len(report) == 2 and number(report[0]) is not None:
            # Of policies that are trained together, only one reports a message.
            message = "" if report[1] is None else text(report[1])
            progress[path.stem.replace("+", "/")] = (float(report[0]), message, changed_s)
    return progress


def curves_of_checkpoint(path: Path) -> dict[int, Float64[np.ndarray, "chunks columns"]]:
    """The learning curves in a checkpoint, by policy number; empty if it cannot be read."""
    try:
        with zipfile.ZipFile(path) as archive:
            curve = _complete(_array_in(archive, "curve.npy"))
            if curve is None or curve.ndim != 3:
                return {}
            members = _array_in(archive, "members.npy").tolist()
            return {int(member): curve[:, row] for row, member in enumerate(members)}
    except Exception:  # zipfile, zlib and numpy have a dozen kinds of errors for a damaged archive
        return {}


def _array_in(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    member = archive.getinfo(name)
    if member.file_size > _MOST_CURVE_BYTES:
        raise ValueError(name)
    with archive.open(member) as file:
        return np.lib.format.read_array(io.BytesIO(file.read(_MOST_CURVE_BYTES)), allow_pickle=False)


def curve_of_policy(path: Path) -> Float64[np.ndarray, "chunks columns"] | None:
    """The learning curve in a policy's file; None if it cannot be read."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            curve = file.get_tensor("learning_curve")
    except (OSError, SafetensorError, ValueError, TypeError):
        return None
    return _complete(curve) if curve.ndim == 2 else None


def _complete(curve: np.ndarray) -> Float64[np.ndarray, "*_ columns"] | None:
    """Learning curves with the columns of `CURVE`; None for anything else."""
    whole = whole_curve(curve)
    return np.asarray(whole, np.float64) if whole.shape[-1] == len(CURVE) and whole.dtype.kind == "f" else None


def mean_of_episodes(path: Path) -> tuple[float, int, int] | None:
    """Mean return, number of policies and number of episodes of an arm of a study; None if not known."""
    try:
        if path.stat().st_size > _MOST_EPISODES_BYTES:
            return None
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            if sum(member.file_size for member in file.zip.infolist()) > _MOST_EPISODES_BYTES:
                return None
            columns = (file[name] for name in ("return", "actor", "over_time", "agent", "at_min"))
            returns, actors, over_time, agents, at_min = columns
        # Episodes over time are few per recording, and a comparison's episodes may be on another recording.
        own = ~over_time.astype(bool) & (agents == "policy") & (at_min == at_min.max())
        mean = float(returns[own].mean()) if own.any() else float("nan")
    except Exception:  # as for a checkpoint
        return None
    return (mean, len(np.unique(actors[own])), int(own.sum())) if np.isfinite(mean) else None


def newest_s(paths: list[Path]) -> float:
    """When one of these last changed; 0 if there are none."""
    times = [0.0]
    for path in paths:
        try:
            times.append(path.stat().st_mtime)
        except OSError:
            continue
    return max(times)
