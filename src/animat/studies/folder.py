"""A study's or a tuning's folder: whose it is, and that no two runs work in it at once."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from animat.differences import first_difference, folder_mismatch, read_description, with_fingerprint
from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.execution.receipts import sha256
from animat.goals.robot import without_goal
from animat.plain_file import expect_no_file
from animat.recordings.formats.csv import stimuli_beside
from animat.robots.host import HostRobot
from animat.studies.places import OWN_FOLDERS
from animat.studies.specification import Study
from animat.studies.toml import study_to_toml
from animat.training.settings import LEARNER
from animat.writing import clear_away, exclusive_lock, is_unfinished, write_whole

MANIFEST = "study.json"
SPECIFICATION = "study.toml"
_PACKAGES = (
    "animat", "jax", "jaxlib", "numpy", "scipy", "optax", "numba", "h5py", "pynwb", "pandas", "pillow", "matplotlib",
    "jinja2",
)  # fmt: skip
_ABOUT_FILES = "# files: as seen from where the specification lay. To run it from here: files = ['recordings']\n"


def describe_study(study: Study, sources: dict[str, str], device: str | None = None) -> dict[str, Any]:
    """What decides how a study comes out, with a fingerprint over all of it.

    Args:
        study: the specification.
        sources: SHA-256 of each file of recordings, by its place.
        device: the kind of GPU that trains, which rounds otherwise; None for cores, which are not told.
    """
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    if study.culture.kind == "virtual":
        from animat.cultures.tissue.parameters import REVISION

        # Another one gives other spikes, also within one version of animat.
        versions["virtual tissue"] = f"revision {REVISION}"
    for spec in study.robots:
        if isinstance(robot := without_goal(spec.robot()), HostRobot):
            versions |= robot.versions
    if device is not None:
        versions["device"] = device
    return with_fingerprint(
        {
            "study": asdict(study),
            "sources": sources,
            # Another version may round otherwise, or draw other figures.
            "versions": {"python": platform.python_version(), "learner": f"revision {LEARNER}", **versions},
            "seeds": {"culture": study.culture.seed, "training and evaluation": study.seed},
        }
    )


def source_files(study: Study, base: Path) -> list[Path]:
    """The files of recordings that a study names, relative to `base`.

    Raises:
        InvalidFile: if one is missing.
        InvalidArgument: for a study of many cultures.
    """
    if study.culture.seeds or study.culture.folders:
        raise InvalidArgument("culture: expected one culture, got many; animat study runs such a study")
    if study.culture.kind != "files":
        return []
    from animat.recordings.reading import list_recordings

    return list_recordings([base / name for name in study.culture.files])


def sums_of(files: list[Path], base: Path) -> dict[str, str]:
    """SHA-256 of each file, by its place as seen from `base`; stimuli beside CSV spikes belong to them.

    Raises:
        InvalidFile: if one is missing or cannot be read.
        InvalidArgument: if one is named twice.
    """
    sums: dict[str, str] = {}
    for file in files:
        place = _place(file, base)
        if place in sums:
            raise InvalidArgument(f"culture.files: expected each file once, got {file} twice")
        beside = stimuli_beside(file)
        for each in [file, *([] if beside is None else [beside])]:
            try:
                sums[_place(each, base)] = sha256(each)
            except FileNotFoundError as error:
                raise InvalidFile(f"{each}: no such file") from error
            except OSError as error:
                raise InvalidFile(f"{each}: cannot be read: {error.strerror or error}") from error
    return dict(sorted(sums.items()))


def _place(file: Path, base: Path) -> str:
    """So that a study and its files can be moved together."""
    return (file.relative_to(base) if file.is_relative_to(base) else file).as_posix()


@contextmanager
def held(
    folder: Path,
    what: str,
    manifest: dict[str, Any],
    file: str,
    beside: Mapping[str, str],
    own_folders: Iterable[str] = OWN_FOLDERS,
) -> Iterator[None]:
    """Make the folder this work's, or see that it is; keep other runs out; clear away what a killed one was writing.

    Nothing in the folder is touched before it is known to be this work's.

    Args:
        folder: of the work.
        what: it is, for messages: a `study`.
        manifest: its description, with a fingerprint.
        file: in which that lies.
        beside: what is written beside it, by the files' names.
        own_folders: all that it makes in its folder.

    Raises:
        Mismatch: if it is another one's, holds other files, or another run is at work in it.
        InvalidFile: if it cannot be read or made.
    """
    expect_no_file(folder, f"the {what}")
    files = {file: json.dumps(manifest, indent=1, sort_keys=True) + "\n", **beside}
    _is_ours(folder, what, manifest, [*files])
    with exclusive_lock(folder):
        if not _is_ours(folder, what, manifest, [*files]):
            for name, words in files.items():
                write_whole(folder / name, words)
        for leftover in [*folder.iterdir(), *(path for name in own_folders for path in (folder / name).rglob("*"))]:
            if is_unfinished(leftover):
                clear_away(leftover)
        yield


def described_beside(study: Study) -> dict[str, str]:
    """What lies beside a study's description: its specification, to be changed and run."""
    return {SPECIFICATION: _ABOUT_FILES * (study.culture.kind == "files") + study_to_toml(study)}


def _is_ours(folder: Path, what: str, manifest: dict[str, Any], files: list[str]) -> bool:
    """Whether the work is already in the folder; not if it is free for it.

    Raises:
        Mismatch: if it is another one's, or holds other files.
        InvalidFile: if its description, the first of its files, cannot be read.
    """
    found = read_description(folder / files[0], what)
    if found is None:
        if folder.is_dir() and not all(map(_is_passing, folder.iterdir())):
            raise Mismatch(f"{folder}: expected an empty folder or one of this {what}, got one with other files in it")
        return False
    if found["fingerprint"] == manifest["fingerprint"]:
        return all((folder / name).exists() for name in files)
    # What stopped at its first step left these and no more.
    begun = (path for path in folder.rglob("*") if not path.is_dir() and not _is_passing(path))
    if any(path.name not in files for path in begun):
        raise folder_mismatch(folder, what, first_difference(found, manifest, ignoring=("fingerprint",)))
    return False


def _is_passing(path: Path) -> bool:
    """Whether a file is nobody's: half written by a killed run, there to be locked, or hidden by another program."""
    return path.name.startswith(".")
