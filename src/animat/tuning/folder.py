"""A tuning's folder: whose it is, and that no two runs work in it at once."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from animat.differences import description_in, fingerprint_of, first_difference, of_another
from animat.errors import InvalidFile, Mismatch
from animat.studies.folder import describe_study
from animat.tuning.specification import Tuning
from animat.writing import LOCK, atomic_write, clear_away, exclusive_lock, is_unfinished

MANIFEST = "tune.json"


def describe_tuning(tuning: Tuning, sources: dict[str, str]) -> dict[str, Any]:
    """What decides how a tuning comes out, with a fingerprint over all of it.

    Args:
        tuning: the specification.
        sources: SHA-256 of each file of recordings, by its place.
    """
    versions = {**describe_study(tuning.study, sources)["versions"], "optuna": importlib.metadata.version("optuna")}
    told = json.loads(json.dumps({**tuning.to_dict(), "sources": sources, "versions": versions}))
    return {**told, "fingerprint": fingerprint_of(told)}


@contextmanager
def held(folder: Path, manifest: dict[str, Any]) -> Iterator[None]:
    """Make the folder this tuning's, or see that it is; keep other runs out.

    Nothing in the folder is touched before it is known to be this tuning's.

    Raises:
        Mismatch: if it is another tuning's, holds other files, or another run is at work in it.
        InvalidFile: if it cannot be read or made.
    """
    if folder.exists() and not folder.is_dir():
        raise InvalidFile(f"{folder}: expected a folder for the tuning, got a file")
    _is_ours(folder, manifest)
    with exclusive_lock(folder):
        if not _is_ours(folder, manifest):
            with atomic_write(folder / MANIFEST) as beside:
                beside.write_text(json.dumps(manifest, indent=1, sort_keys=True) + "\n")
        for leftover in folder.rglob(".*"):
            if is_unfinished(leftover):
                clear_away(leftover)
        yield


def _is_ours(folder: Path, manifest: dict[str, Any]) -> bool:
    """Whether the tuning is already in the folder; not if it is free for it."""
    found = description_in(folder / MANIFEST, "tuning")
    if found is None:
        if folder.is_dir() and any(e.name != LOCK and not is_unfinished(e) for e in folder.iterdir()):
            raise Mismatch(f"{folder}: expected an empty folder or one of this tuning, got one with other files in it")
        return False
    if found["fingerprint"] != manifest["fingerprint"]:
        raise of_another(folder, "tuning", first_difference(found, manifest, ignoring=("fingerprint",)))
    return True
