"""A study's folder: whose it is, what in it is done, and that no two runs work in it at once."""

from __future__ import annotations

import fcntl
import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile, Mismatch
from animat.studies.jobs import sha256
from animat.studies.specification import Study
from animat.studies.toml import study_to_toml
from animat.writing import written_whole

MANIFEST = "study.json"
SPECIFICATION = "study.toml"
_LOCK = ".running"
_PACKAGES = ("animat", "jax", "jaxlib", "numpy", "scipy", "optax", "numba", "h5py", "pynwb", "matplotlib", "jinja2")


def describe_study(study: Study, sources: dict[str, str]) -> dict[str, Any]:
    """What decides how a study comes out, with a fingerprint over all of it.

    Args:
        study: the specification.
        sources: SHA-256 of each file of recordings, by name.
    """
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    told: dict[str, Any] = {
        "study": study.to_dict(),
        "sources": sources,
        # Another version may round otherwise, or draw other figures.
        "versions": {"python": platform.python_version(), **versions},
        "seeds": {"culture": study.culture.seed, "training and evaluation": study.seed},
    }
    # By way of JSON, in which a tuple and a list are the same.
    told = json.loads(json.dumps(told))
    return told | {"fingerprint": hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()}


def source_files(study: Study, base: Path) -> list[Path]:
    """The files of recordings that a study names, relative to `base`.

    Raises:
        InvalidFile: if one is missing.
    """
    if study.culture.kind != "files":
        return []
    from animat.recordings.reading import list_recordings

    return list_recordings([base / name for name in study.culture.files])


def sums_of(files: list[Path]) -> dict[str, str]:
    """SHA-256 of each file, by its name; stimuli beside CSV spikes belong to them."""
    sums = {}
    for file in files:
        beside = sorted(file.parent.glob(f"{file.name.split('_spikes.csv')[0]}_stimuli.csv*"))
        for each in [file, *(beside if "_spikes.csv" in file.name else [])]:
            if not each.is_file():
                raise InvalidFile(f"{each}: no such file")
            sums[each.name] = sha256(each)
    return dict(sorted(sums.items()))


def claim(folder: Path, study: Study, manifest: dict[str, Any]) -> None:
    """Make the folder this study's, or see that it is.

    Raises:
        Mismatch: if it is another study's, or holds other files.
        InvalidFile: if it cannot be read or written.
    """
    path = folder / MANIFEST
    if path.exists():
        try:
            found = json.loads(path.read_text())
            fingerprint = found["fingerprint"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InvalidFile(f"{path}: expected a study's description, got a file that cannot be read") from error
        if fingerprint != manifest["fingerprint"]:
            raise Mismatch(
                f"{folder}: expected a folder of this study, got one of another ({_first_difference(found, manifest)}"
                "); give another folder, or remove this one"
            )
    elif folder.is_dir() and any(entry.name != _LOCK for entry in folder.iterdir()):
        raise Mismatch(f"{folder}: expected an empty folder or one of this study, got one with other files in it")
    else:
        with written_whole(path) as beside:
            beside.write_text(json.dumps(manifest, indent=1, sort_keys=True) + "\n")
    if not (folder / SPECIFICATION).exists():
        with written_whole(folder / SPECIFICATION) as beside:
            beside.write_text(study_to_toml(study))


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep other runs out of the folder, and clear away what a killed one was just writing.

    Raises:
        Mismatch: if another run is at work in it.
        InvalidFile: if the folder cannot be made.
    """
    if folder.exists() and not folder.is_dir():
        raise InvalidFile(f"{folder}: expected a folder for the study, got a file")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / _LOCK).open("w")
    except OSError as error:
        raise InvalidFile(f"{folder}: cannot be written: {error.strerror or error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise Mismatch(f"{folder}: another run is at work in this folder; wait for it, or stop it") from error
        for leftover in folder.rglob(".*.partial*"):
            leftover.unlink(missing_ok=True)
        try:
            yield
        finally:
            (folder / _LOCK).unlink(missing_ok=True)


def _first_difference(found: Any, wanted: Any, name: str = "") -> str:
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in sorted(set(found) | set(wanted)):
            if key != "fingerprint" and found.get(key) != wanted.get(key):
                return _first_difference(found.get(key), wanted.get(key), f"{name}.{key}" if name else key)
    if isinstance(found, list) and isinstance(wanted, list) and len(found) == len(wanted):
        for i, (one, other) in enumerate(zip(found, wanted, strict=True)):
            if one != other:
                return _first_difference(one, other, f"{name}[{i}]")
    return f"{name}: {_short(found)} there, {_short(wanted)} now"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
