"""The folder of a study or a tuning: its paths, to which work it belongs, and that only one run uses it at a time."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from animat.coding.mapping import mapping_named
from animat.errors import InvalidArgument, InvalidFile, Mismatch, as_invalid_file
from animat.execution.receipts import sha256
from animat.execution.task import NOTICES, UNFINISHED
from animat.folders import first_difference, folder_mismatch, read_description, with_fingerprint
from animat.plain_file import expect_no_file, expect_plain_file
from animat.recordings.formats.csv import stimuli_beside
from animat.recordings.reading import list_recordings
from animat.studies.specification import Arm, RobotSpec, Study
from animat.training.folder import versions_of
from animat.writing import clear_away, exclusive_lock, is_unfinished, write_whole

MANIFEST, SPECIFICATION = "study.json", "study.toml"
RECORDINGS = "recordings"
TIMELINE = "simulators/timeline.safetensors"
RESPONSES = "simulators/responses.csv"
RESULTS = "tables/results.json"
REPORT = "report.html"
RECEIPTS = "jobs"
OWN_FOLDERS = (
    RECORDINGS, "simulators", "policies", "episodes", "controls", "optima", "tables", "figures", RECEIPTS, UNFINISHED,
)  # fmt: skip
"""All folders that a study makes in its folder; its other files are the report, the specification and its manifest."""
_PACKAGES = (
    "animat", "jax", "jaxlib", "numpy", "scipy", "optax", "numba", "h5py", "pynwb", "pandas", "pillow", "matplotlib",
    "jinja2",
)  # fmt: skip


def describe_study(study: Study, sources: dict[str, str], device: str | None = None) -> dict[str, Any]:
    """Everything that decides a study's results, with a fingerprint; `sources` are the files' SHA-256 by their paths.

    `device` is the kind of GPU that trains, as GPUs round differently; None for CPU cores, which are not recorded.
    """
    things: list[Any] = [
        *(spec.robot() for spec in study.robots),
        *(mapping_named(arm.mapping) for arm in study.arms if arm.through_neurons),
    ]
    # Another version may round differently, or draw other figures.
    versions = {"python": platform.python_version(), **versions_of(_PACKAGES, things, device)}
    if study.culture.kind == "virtual":
        from animat.cultures.tissue.parameters import REVISION

        # Another revision gives other spikes, even within one version of animat.
        versions["virtual tissue"] = f"revision {REVISION}"
    seeds = {"culture": study.culture.seed, "study": study.seed}
    return with_fingerprint({"study": asdict(study), "sources": sources, "versions": versions, "seeds": seeds})


def hash_sources(study: Study, base: Path) -> dict[str, str]:
    """`hash_files` of a study's recordings."""
    return hash_files(source_files(study, base), base)


def source_files(study: Study, base: Path) -> list[Path]:
    """The files of a study's recordings; their names are relative to `base`."""
    if study.culture.seeds or study.culture.folders:
        raise InvalidArgument("culture: expected one culture, got many; animat study runs such a study")
    if study.culture.kind != "files":
        return []
    return list_recordings([base / name for name in study.culture.files])


def hash_files(files: list[Path], base: Path) -> dict[str, str]:
    """SHA-256 of each file, by its path relative to `base`; CSV spikes include the file of their stimuli."""
    hashes: dict[str, str] = {}
    for file in files:
        for each in filter(None, (file, stimuli_beside(file))):
            # Relative where possible, so that a study and its files can be moved together.
            name = (each.relative_to(base) if each.is_relative_to(base) else each).as_posix()
            if name in hashes:
                raise InvalidArgument(f"culture.files: expected each file once, got {each} twice")
            with as_invalid_file(each):
                hashes[name] = sha256(expect_plain_file(each))
    return dict(sorted(hashes.items()))


@contextmanager
def claim_folder(
    folder: Path,
    what: str,
    manifest: dict[str, Any],
    file: str,
    beside: Mapping[str, str],
    own_folders: Iterable[str] = OWN_FOLDERS,
) -> Iterator[None]:
    """Claim a folder for some work: lock out other runs, and delete what a killed run left unfinished.

    Nothing in it is touched before it is known to be free or to belong to this work (`what`, in messages), which the
    manifest describes with a fingerprint. It is written to `file`, and further texts to files `beside` it, by name.

    Raises Mismatch if the folder belongs to other work, holds other files, or is in use by another run, and InvalidFile
    if it cannot be read or created.
    """
    expect_no_file(folder, f"the {what}")
    files = {file: json.dumps(manifest, indent=1, sort_keys=True) + "\n", **beside}
    _check_claim(folder, what, manifest, [*files])
    with exclusive_lock(folder):
        if not _check_claim(folder, what, manifest, [*files]):
            for name, text in files.items():
                write_whole(folder / name, text)
        for leftover in [*folder.iterdir(), *(path for name in own_folders for path in (folder / name).rglob("*"))]:
            if is_unfinished(leftover):
                clear_away(leftover)
        yield


def _check_claim(folder: Path, what: str, manifest: dict[str, Any], files: list[str]) -> bool:
    """Refuse the folder of other work than the manifest's; True if it has all of this work's files, False if free."""
    found = read_description(folder / files[0], what)
    if found is None:
        # Hidden files do not count: they are locks, unfinished files of a killed run, or another program's.
        if folder.is_dir() and not all(path.name.startswith(".") for path in folder.iterdir()):
            got = "got one with other files in it; choose another folder"
            raise Mismatch(f"{folder}: expected an empty folder or one of this {what}, {got}")
        return False
    if found["fingerprint"] == manifest["fingerprint"]:
        return all((folder / name).exists() for name in files)
    _expect_replaceable(folder, what, found, manifest, files)
    return False


def _expect_replaceable(
    folder: Path, what: str, found: dict[str, Any], manifest: dict[str, Any], files: list[str]
) -> None:
    """Refuse the folder of other work, unless that stopped at its first step: it then left only these files."""
    left = (path for path in folder.rglob("*") if not path.is_dir() and not path.name.startswith("."))
    if any(path.name not in files and path.parent.name != NOTICES for path in left):
        # What its specification states, by the names that it has there.
        difference = first_difference(found, manifest, ignoring=("fingerprint",), first=("study",))
        raise folder_mismatch(folder, what, difference)


def expect_same_specification(study: Study, folder: Path, *, of_culture: bool = True) -> None:
    """Refuse the folder of a study with another specification (Mismatch), without touching it.

    If it need not be `of_culture`, it may be the study's of another culture.
    """
    found = None
    with suppress(InvalidFile):
        # What is damaged is found when this culture's study is run.
        found = read_description(folder / MANIFEST, "study")
    if found is None:
        return
    described, there = json.loads(json.dumps(asdict(study))), found.get("study")
    if not of_culture and isinstance(there, dict) and isinstance(there.get("culture"), dict):
        described["culture"] |= {name: there["culture"].get(name) for name in ("seed", "seeds", "files", "folders")}
    if there != described:
        _expect_replaceable(folder, "study", found, found | {"study": described}, [MANIFEST, SPECIFICATION])


def policies_folder(folder: Path, spec: RobotSpec, arm: Arm) -> Path:
    return folder / "policies" / spec.name / arm.slug


def episodes_file(folder: Path, spec: RobotSpec, arm: Arm, what: str = "episodes") -> Path:
    """The episodes of an arm's policies on a robot, or `paths`; each arm has its own folder: names cannot collide."""
    return folder / "episodes" / spec.name / arm.slug / f"{what}.npz"


def controls_file(folder: Path, spec: RobotSpec, arm: Arm) -> Path:
    """The episodes of the controls of an arm's mapping on a robot."""
    return folder / "controls" / spec.name / arm.thresholds / "episodes.npz"


def optima_file(folder: Path, robot: str, what: str = "optima") -> Path:
    return folder / "optima" / f"{robot}-{what}.json"


def table_file(folder: Path, name: str) -> Path:
    """A table of results as CSV."""
    return folder / "tables" / f"{name}.csv"
