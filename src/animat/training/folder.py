"""A training's folder: whose it is, by a description of all that decides how its policies come out."""

from __future__ import annotations

import importlib.metadata
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from animat.coding.checking import check_mapping
from animat.coding.mapping import REGISTRY as MAPPINGS
from animat.differences import fingerprint_of, first_difference, folder_mismatch, read_description
from animat.errors import InvalidArgument, Mismatch
from animat.folder_kinds import expect_no_other
from animat.goals.robot import without_goal
from animat.neurons.timeline import SimulatorTimeline
from animat.plain_file import expect_no_file
from animat.robots.checking import check_robot
from animat.robots.host import HostRobot
from animat.robots.registry import REGISTRY as ROBOTS
from animat.training.course import ASSESSED
from animat.training.group import Group, split_groups
from animat.training.policy import Policy
from animat.training.settings import LEARNER
from animat.training.specification import CHUNKS, Training
from animat.training.varied import expect_varied, varying_in
from animat.writing import atomic_write

MANIFEST = "training.json"
TABLE = "assessments.csv"
_BESIDE = ("sources", "random_return")
"""What a description tells beside what decides how policies come out."""
_NOT_TOLD = ("fingerprint", *_BESIDE, "burst_thresholds")
"""Where a folder is another training's: they differ with the responses."""


def expect_trainable(training: Training, *, is_saved: bool) -> None:
    """Refuse, before the first iteration, what cannot be trained, or could not be loaded once it is.

    Args:
        training: what is to be trained.
        is_saved: whether its policies go to files.

    Raises:
        InvalidArgument: naming what of the robot or the mapping was expected, what came, and what can be done.
    """
    check_robot(training.robot)
    _expect_whole_episodes(training)
    if training.mapping is not None:
        check_mapping(training.mapping)
    else:
        training.environment(0)
    if training.is_varied:
        expect_varied(training.robot, varying_in(training.lessons, recordings=False))
    if is_saved:
        ROBOTS.expect_loadable(without_goal(training.robot), in_workers=True)
        if training.mapping is not None:
            MAPPINGS.expect_loadable(training.mapping, in_workers=True)


def _expect_whole_episodes(training: Training) -> None:
    """Refuse a body whose episodes begin anew at each checkpoint, and never come to their end before."""
    robot, rounds = training.robot, training.iterations // (CHUNKS * training.algorithm.environments)
    if isinstance(robot, HostRobot) and not robot.keeps_episodes and robot.episode_limit > rounds:
        needed = robot.episode_limit * CHUNKS * training.algorithm.environments
        raise InvalidArgument(
            f"iterations: expected {needed:,} or more, or an episode_limit of {rounds} or less, as the episodes of "
            f"{robot.name} cannot be kept in a checkpoint and begin anew at each sixtieth of the training, got "
            f"{training.iterations:,} iterations and episodes of {robot.episode_limit:,}"
        )


def describe(
    training: Training,
    timeline: SimulatorTimeline | None,
    sources: Sequence[str] = (),
    random_return: float | None = None,
    *,
    device: str | None = None,
) -> dict[str, Any]:
    """What decides how policies come out, as plain data, with a fingerprint over all of it; and what is told beside.

    Args:
        training, timeline: what is trained, and on what.
        sources: names of the recordings; told beside.
        random_return: mean return of random actions; told beside, where it is known.
        device: the kind of GPU that trains, which rounds otherwise; None for cores, which are not told.
    """
    versions = {name: importlib.metadata.version(name) for name in ("animat", "jax", "jaxlib", "numpy", "optax")}
    if isinstance(training.robot, HostRobot):
        versions |= training.robot.versions
    if device is not None:
        versions["device"] = device
    manifest: dict[str, Any] = {
        "training": training.to_dict(),
        "simulators": None if timeline is None else _described(timeline),
        "versions": {**versions, "learner": f"revision {LEARNER}"},
    }
    # By way of JSON, in which a tuple and a list are the same.
    manifest = json.loads(json.dumps(manifest))
    leaves = jax.tree.leaves(timeline.simulators if timeline else ())
    fingerprint = fingerprint_of(manifest, *(np.ascontiguousarray(leaf).tobytes() for leaf in leaves))
    # Names of files are told but do not decide: the same recordings in another place are the same.
    beside = {"sources": list(sources), **({} if random_return is None else {"random_return": random_return})}
    return manifest | beside | {"fingerprint": fingerprint}


def _described(timeline: SimulatorTimeline) -> dict[str, Any]:
    """Where the simulators came from, as far as it is not the responses themselves."""
    return {
        **timeline.fitted,
        "conditions": [condition.label for condition in timeline.conditions],
        "window_ms": timeline.window_ms,
        "presentation": None if timeline.presentation is None else str(timeline.presentation),
        "recorded_at_min": timeline.start_min.tolist(),
        "readouts": timeline.readouts.to_dict(),
    }


def expect_folder_for(training: Training, folder: Path) -> None:
    """Refuse a folder of another training by its settings, which are known before any recording is read.

    Raises:
        Mismatch, InvalidFile: as `train` does.
    """
    if (found := _description_in(folder)) is not None:
        as_long_as_recordings = training.duration_min is None and training.mapping is not None
        unknown = ("simulators", *_BESIDE, "fingerprint", "device", *["duration_min"] * as_long_as_recordings)
        if difference := _first_difference(found, describe(training, None), unknown):
            raise folder_mismatch(folder, "training", difference)


def is_finished(training: Training, folder: Path) -> bool:
    """Whether a training's folder has all of its policies."""
    return (folder / MANIFEST).exists() and all(
        (folder / f"p{i}.safetensors").exists() for i in range(training.policies)
    )


def write_description(folder: Path, manifest: dict[str, Any]) -> Path:
    """Make a folder this training's."""
    with atomic_write(folder / MANIFEST) as beside:
        beside.write_text(json.dumps(manifest, indent=2, sort_keys=True) + "\n")
    return folder / MANIFEST


def write_assessments(folder: Path, policies: Mapping[str, Policy]) -> Path:
    """Write the table of all assessments, and which of them was each policy's best."""
    rows = ["policy," + ",".join(ASSESSED) + ",best"]
    for name, policy in policies.items():
        best = -1 if policy.best is None else len(policy.best.assessments) - 1
        for row, (iterations, minute, lesson, success, mean_return) in enumerate(policy.assessments.tolist()):
            told = ("" if math.isnan(number) else f"{number:.6g}" for number in (minute, lesson, success, mean_return))
            rows.append(",".join([name, f"{iterations:.0f}", *told, str(int(row == best))]))
    with atomic_write(folder / TABLE) as beside:
        beside.write_text("\n".join(rows) + "\n")
    return folder / TABLE


def is_ours(folder: Path, manifest: dict[str, Any]) -> bool:
    """Whether the training is already in the folder; not if it is free for it.

    Raises:
        Mismatch: if it is another training's, holds policies that no description tells of, or work of another kind.
        InvalidFile: if its description cannot be read, or it is a file.
    """
    found = _description_in(folder)
    if found is not None and found["fingerprint"] != manifest["fingerprint"]:
        difference = _first_difference(found, manifest, _NOT_TOLD) or "other responses"
        raise folder_mismatch(folder, "training", difference)
    return found is not None


def _description_in(folder: Path) -> dict[str, Any] | None:
    """What a folder says it holds; None if it is free."""
    if (found := read_description(folder / MANIFEST, "training")) is not None:
        return found
    expect_no_file(folder, "the policies")
    if folder.is_dir() and any(not file.name.startswith(".") for file in folder.glob("*.safetensors")):
        raise Mismatch(f"{folder}: expected a folder of this training, got policies without a {MANIFEST}")
    expect_no_other(folder, "training")
    return None


def _first_difference(found: dict[str, Any], manifest: dict[str, Any], ignoring: Sequence[str]) -> str:
    # What follows from the robot, such as the usual iterations, is not what differs.
    there, now = map(_robot_in, (found, manifest))
    return first_difference(there, now, "training.robot.name") or first_difference(found, manifest, ignoring=ignoring)


def _robot_in(manifest: dict[str, Any]) -> Any:
    """The robot's name; None where a description that somebody edited has none."""
    try:
        return manifest["training"]["robot"]["name"]
    except (KeyError, TypeError):
        return None


def provenance_of(manifest: dict[str, Any]) -> dict[str, Any]:
    """What of a training's description its policies carry: all that decides how they come out."""
    return {key: value for key, value in manifest.items() if key not in _BESIDE}


def groups_of(
    training: Training, timeline: SimulatorTimeline | None, manifest: dict[str, Any], *, fewest: int = 1
) -> list[Group]:
    """All policies of a training in groups, `fewest` at least, that can go to other processes."""
    # Where trials cost something and it is not known what, before any process begins.
    training.environment_on(timeline)
    if timeline is not None:
        timeline = replace(timeline, simulators=jax.device_get(timeline.simulators))
    return [
        Group(training, members, timeline, manifest["fingerprint"], provenance_of(manifest))
        for members in split_groups(training.policies, fewest=fewest)
    ]
