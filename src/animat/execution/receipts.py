"""Receipts, which record that a job is done, on which inputs, and which files it wrote."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from animat.errors import AnimatError, InvalidFile
from animat.recordings.metadata import to_metadata
from animat.recordings.recording import Recording
from animat.writing import write_whole


@dataclass(frozen=True)
class Receipt:
    """The record that a job is done.

    Attributes:
        study: fingerprint of the study or training to which it belongs.
        inputs: digest of the receipt of each job it needed.
        outputs: `digest_of` each file that it wrote, by its place in the folder.
    """

    job: str
    study: str
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]

    @property
    def digest(self) -> str:
        return hashlib.sha256(self._text().encode()).hexdigest()

    def _text(self) -> str:
        return json.dumps(asdict(self), indent=1, sort_keys=True) + "\n"

    def save(self, receipts: Path) -> None:
        """Write it into a folder of receipts, once all files are written."""
        write_whole(receipt_path(receipts, self.job), self._text())

    def changed(self, folder: Path) -> list[str]:
        """The files that are missing from the folder or differ from those that were written."""
        return [name for name, digest in self.outputs.items() if not _has_digest(folder / name, digest)]

    @staticmethod
    def load(receipts: Path, job: str) -> Receipt | None:
        """The receipt of a job; None if there is none. Raises InvalidFile if it cannot be read."""
        path = receipt_path(receipts, job)
        if not path.exists():
            return None
        try:
            data = json.loads(path.read_text())
            return Receipt(data["job"], data["study"], dict(data["inputs"]), dict(data["outputs"]))
        except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
            raise InvalidFile(f"{path}: expected a job's receipt, got a file that cannot be read; remove it") from error


def remove_changed(folder: Path, receipts: Path, job: str) -> None:
    """Delete the files of a job that changed after it: they may be valid, and nothing later would notice the change."""
    receipt = Receipt.load(receipts, job)
    for name in () if receipt is None else receipt.changed(folder):
        (folder / name).unlink(missing_ok=True)


def receipt_path(receipts: Path, job: str) -> Path:
    # No job's name has a "+", so two jobs never share a path.
    return receipts / f"{job.replace('/', '+')}.json"


def sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_of(path: Path) -> str:
    """SHA-256 of a file's bytes; of an NWB file that of its recording, as its identifiers and date differ each time."""
    if path.suffix != ".nwb":
        return sha256(path)
    from animat.recordings.hdf5_subprocess import read_hdf5_in_subprocess

    return hashlib.sha256(_packed(read_hdf5_in_subprocess(path))).hexdigest()


def _packed(recording: Recording) -> bytes:
    """A recording as bytes, which are the same for equal recordings."""
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
    np.savez(buffer, words=np.frombuffer(json.dumps(words).encode(), np.uint8), **arrays)
    return buffer.getvalue()


def _has_digest(path: Path, digest: str) -> bool:
    try:
        return digest_of(path) == digest
    except (OSError, AnimatError):
        return False
