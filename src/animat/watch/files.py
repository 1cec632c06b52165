"""Small files of a run that may be in progress: read whole, or treated as missing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.errors import InvalidFile
from animat.execution.task import NOTICES, UNFINISHED
from animat.plain_file import expect_plain_file, read_plain_text
from animat.training.policy import CURVE, whole_curve
from animat.watch.plain import listed, mapped, number, text

_MOST_BYTES = 2**24
_MOST_CURVE_BYTES = 2**22
_MOST_EPISODES_BYTES = 2**27

JobProgress = dict[str, tuple[float, str]]
"""The share done of each job, and a message."""


def json_of(path: Path) -> dict[str, Any]:
    """The contents of a JSON file with names and values; empty if there is none or it cannot be read."""
    return mapped(_json_of(path))


def _json_of(path: Path) -> Any:
    try:
        return json.loads(text_of(path, _MOST_BYTES))
    except (InvalidFile, ValueError, RecursionError):
        return None


def text_of(path: Path, most_bytes: int) -> str:
    """The text of a file; raises InvalidFile as `expect_own` and `read_plain_text` do."""
    return read_plain_text(expect_own(path), most_bytes)


def expect_own(path: Path) -> Path:
    """Refuse a link, which may lead anywhere, and what would block its reader for ever, such as a pipe."""
    if path.is_symlink():
        raise InvalidFile(f"{path}: expected a file, got a link")
    return expect_plain_file(path)


def job_progress(folder: Path) -> JobProgress:
    """The last progress reported by the jobs of an unfinished run."""
    progress = {}
    for path in sorted((folder / UNFINISHED / NOTICES).glob("*.json"))[:1000]:
        report = listed(_json_of(path))
        if len(report) == 2 and number(report[0]) is not None:
            # Of policies that are trained together, only one reports a message.
            progress[path.stem.replace("+", "/")] = float(report[0]), text(report[1] or "")
    return progress


def curves_of_checkpoint(path: Path) -> dict[int, Float64[np.ndarray, "chunks columns"]]:
    """The learning curves in a checkpoint, by policy number; empty if it cannot be read."""
    arrays = _arrays_in(path, ("curve", "members"), _MOST_CURVE_BYTES)
    if arrays is None or (curve := _complete(arrays[0], 3)) is None:
        return {}
    if arrays[1].dtype.kind not in "iu" or arrays[1].shape != curve.shape[1:2]:
        return {}
    return {int(member): curve[:, row] for row, member in enumerate(arrays[1].tolist())}


def curve_of_policy(path: Path) -> Float64[np.ndarray, "chunks columns"] | None:
    """The learning curve in a policy's file; None if it cannot be read."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(expect_own(path), framework="numpy") as file:
            return _complete(file.get_tensor("learning_curve"), 2)
    except (InvalidFile, OSError, SafetensorError, ValueError, TypeError):
        return None


def _complete(curve: np.ndarray, dimensions: int) -> Float64[np.ndarray, "*_ columns"] | None:
    """Learning curves with the columns of `CURVE`; None for anything else."""
    whole = whole_curve(curve)
    is_curve = whole.ndim == dimensions and whole.shape[-1] == len(CURVE) and whole.dtype.kind == "f"
    return np.asarray(whole, np.float64) if is_curve else None


def mean_of_episodes(path: Path) -> tuple[float, int, int] | None:
    """Mean return, number of policies and number of episodes of an arm of a study; None if it has no own episodes."""
    arrays = _arrays_in(path, ("return", "actor", "over_time", "agent", "at_min"), _MOST_EPISODES_BYTES)
    if arrays is None:
        raise InvalidFile(f"{path}: expected the episodes of an arm")
    returns, actors, over_time, agents, at_min = arrays
    # Episodes over time are few per recording, and a comparison's episodes may be on another recording.
    own = ~over_time.astype(bool) & (agents == "policy") & (at_min == at_min.max(initial=-np.inf))
    return (float(returns[own].mean()), len(np.unique(actors[own])), int(own.sum())) if own.any() else None


def _arrays_in(path: Path, names: tuple[str, ...], most_bytes: int) -> list[np.ndarray] | None:
    """Arrays of a numpy archive; None if it cannot be read or they are too large."""
    try:
        with np.load(expect_own(path), allow_pickle=False) as file:
            sizes = [file.zip.getinfo(f"{name}.npy").file_size for name in names]
            return [file[name] for name in names] if sum(sizes) <= most_bytes else None
    except Exception:  # zipfile, zlib and numpy have a dozen kinds of errors for a damaged archive
        return None
