"""Receipts: that a job is done, on which inputs, and which files it left."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from animat.errors import AnimatError, InvalidFile
from animat.recordings.metadata import to_metadata
from animat.recordings.recording import Recording
from animat.writing import write_whole


@dataclass(frozen=True)
class Receipt:
    """That a job is done: of which study, from which receipts, and which files it left.

    Attributes:
        job: its name.
        study: fingerprint of the study or training that it is part of.
        inputs: digest of the receipt of each job it needed.
        outputs: of each file by its place in the folder, `digest_of` it.
    """

    job: str
    study: str
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]

    @property
    def digest(self) -> str:
        """Stands for all of it."""
        return hashlib.sha256(self._text().encode()).hexdigest()

    def _text(self) -> str:
        words: dict[str, Any] = {"job": self.job, "study": self.study, "inputs": self.inputs, "outputs": self.outputs}
        return json.dumps(words, indent=1, sort_keys=True) + "\n"

    def save(self, receipts: Path) -> None:
        """Write it into a folder of receipts, after all files are there."""
        write_whole(receipt_path(receipts, self.job), self._text())

    def changed(self, folder: Path) -> list[str]:
        """The files that are not in the folder any more as they were left."""
        return [name for name, sum_ in self.outputs.items() if not _is_file_of(folder / name, sum_)]

    @staticmethod
    def load(receipts: Path, job: str) -> Receipt | None:
        """The receipt of a job; None where there is none. Raises InvalidFile if it cannot be read."""
        path = receipt_path(receipts, job)
        if not path.exists():
            return None
        try:
            words = json.loads(path.read_text())
            return Receipt(words["job"], words["study"], dict(words["inputs"]), dict(words["outputs"]))
        except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
            raise InvalidFile(f"{path}: expected a job's receipt, got a file that cannot be read; remove it") from error


def receipt_path(receipts: Path, job: str) -> Path:
    """Where a job's receipt lies."""
    # A sign that no name holds: of two jobs none may have the other's.
    return receipts / f"{job.replace('/', '+')}.json"


def sha256(path: Path) -> str:
    """Of a file's contents."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_of(path: Path) -> str:
    """SHA-256 of what a file tells: of the recording in one of NWB, which has identifiers and a date of its own each
    time that it is written; else of its bytes.

    Raises:
        OSError, InvalidFile: if it cannot be read.
    """
    if path.suffix != ".nwb":
        return sha256(path)
    from animat.recordings.hdf5_subprocess import read_hdf5_in_subprocess

    return hashlib.sha256(_packed(read_hdf5_in_subprocess(path))).hexdigest()


def _packed(recording: Recording) -> bytes:
    """All of a recording as bytes, the same for recordings that are equal."""
    arrays = {name: getattr(recording, name) for name in ("spike_times_s", "spike_channels")}
    for name, table in (("channels", recording.channels), ("stimuli", recording.stimuli)):
        arrays |= {f"{name}_{field.name}": getattr(table, field.name) for field in fields(table)}
    numbers = ("sampling_rate_hz", "start_s", "duration_s", "start_min")
    words = {
        "numbers": {name: float(getattr(recording, name)) for name in numbers},
        "presentation": None if recording.presentation is None else asdict(recording.presentation),
        "told": list(to_metadata(recording).items()),
    }
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, words=np.frombuffer(json.dumps(words).encode(), np.uint8), **arrays)
    return buffer.getvalue()


def _is_file_of(path: Path, sum_: str) -> bool:
    try:
        return digest_of(path) == sum_
    except (OSError, AnimatError):
        return False
