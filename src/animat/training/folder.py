"""A training's folder, identified by a description of everything that determines its policies."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from animat.coding.checking import check_mapping
from animat.coding.mapping import REGISTRY as MAPPINGS
from animat.coding.mapping import Mapping as MappingOfResponses
from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.folders import expect_no_other, first_difference, folder_mismatch, read_description, with_fingerprint
from animat.goals.robot import without_goal
from animat.neurons.timeline import SIMULATORS, SimulatorTimeline
from animat.plain_file import expect_no_file
from animat.records import read_record
from animat.robots.base import Robot
from animat.robots.checking import check_robot
from animat.robots.host import HostRobot
from animat.robots.own_code import code_of
from animat.robots.registry import REGISTRY as ROBOTS
from animat.training.course import ASSESSED
from animat.training.group import BEST, Group, split_groups
from animat.training.policy import Policy
from animat.training.settings import LEARNER, Policies
from animat.training.specification import CHUNKS, Training
from animat.training.varied import expect_varied, varying_in
from animat.writing import clear_leftovers, write_whole

MANIFEST = "training.json"
TABLE = "assessments.csv"
_INFORMATIVE = ("sources", "random_return")
"""Entries of a description that do not determine the policies."""
_NOT_REPORTED = ("fingerprint", "culture", *_INFORMATIVE, "burst_thresholds")
"""Entries not reported as the difference between two trainings: they differ with the responses."""
_FIRST = ("training", "robot")
"""Entries reported first: what follows from the robot, such as the default iterations, is not the cause."""


def expect_trainable(training: Training, *, is_saved: bool) -> None:
    """Refuse, before the first iteration, what cannot be trained, or if it is saved could not be loaded afterwards."""
    robot, mapping = training.robot, training.mapping
    check_robot(robot)
    rounds = training.iterations // (CHUNKS * training.algorithm.environments)
    if isinstance(robot, HostRobot) and not robot.keeps_episodes and robot.episode_limit > rounds:
        needed = robot.episode_limit * CHUNKS * training.algorithm.environments
        raise InvalidArgument(
            f"iterations: expected {needed:,} or more, or an episode_limit of {rounds} or less, as episodes of "
            f"{robot.name} restart at each sixtieth of the training, got {training.iterations:,}"
        )
    if mapping is not None:
        check_mapping(mapping)
    if training.is_varied:
        expect_varied(robot, varying_in(training.lessons, recordings=False))
    if is_saved:
        ROBOTS.expect_loadable(without_goal(robot), in_workers=True)
        if mapping is not None:
            MAPPINGS.expect_loadable(mapping, in_workers=True)


def describe_training(
    training: Training,
    timeline: SimulatorTimeline | None,
    sources: Sequence[str] = (),
    random_return: float | None = None,
    *,
    device: str | None = None,
) -> dict[str, Any]:
    """Everything that determines the policies, as plain data, with its fingerprint; and what is informative only.

    `sources`, the names of the recordings, and the mean return of random actions are informative only. `device` is the
    kind of GPU used, which affects rounding; None for cores, which are not recorded.
    """
    decisive = {
        "training": training.to_dict(),
        "simulators": None if timeline is None else _describe_simulators(timeline),
        "versions": versions_of(
            ("animat", "jax", "jaxlib", "numpy", "optax"), [training.robot, training.mapping], device
        ),
    }
    leaves = jax.tree.leaves(timeline.simulators if timeline else ())
    manifest = with_fingerprint(decisive, *(np.ascontiguousarray(leaf).tobytes() for leaf in leaves))
    culture = {} if timeline is None or timeline.culture is None else {"culture": asdict(timeline.culture)}
    # File names do not count: the same recordings in another place are the same.
    informative = {"sources": list(sources), **({} if random_return is None else {"random_return": random_return})}
    return manifest | culture | informative


def versions_of(
    names: Iterable[str], things: Iterable[Robot[Any] | MappingOfResponses | None] = (), device: str | None = None
) -> dict[str, str]:
    """Versions of what may round or draw differently: packages by `names`, the GPU, the learner and the simulators.

    Of `things`, robots and mappings, those of their own packages, and the code of the user's own.
    """
    versions = {name: importlib.metadata.version(name) for name in names}
    for thing in things:
        body = without_goal(thing) if isinstance(thing, Robot) else thing
        versions |= {} if body is None else code_of(body)
        if isinstance(body, HostRobot):
            versions |= body.versions
    if device is not None:
        versions["device"] = device
    return versions | {"learner": f"revision {LEARNER}", "simulators": f"revision {SIMULATORS}"}


def _describe_simulators(timeline: SimulatorTimeline) -> dict[str, Any]:
    return {
        **timeline.fitted,
        "conditions": [condition.label for condition in timeline.conditions],
        # Stored in policies, whose reward may contain the cost of these electrodes.
        "electrodes": [condition.electrodes for condition in timeline.conditions],
        "window_ms": timeline.window_ms,
        "presentation": None if timeline.presentation is None else str(timeline.presentation),
        "recorded_at_min": timeline.start_min.tolist(),
        "readouts": timeline.readouts.to_dict(),
    }


def expect_folder_for(training: Training, folder: Path) -> None:
    """Refuse a folder of another training by its settings, as `train` does, before any recording is read."""
    if (stored := _stored_description(folder)) is not None:
        as_long_as_recordings = training.duration_min is None and training.mapping is not None
        unknown = ("simulators", *_NOT_REPORTED, "device", *["duration_min"] * as_long_as_recordings)
        if difference := first_difference(stored, describe_training(training, None), ignoring=unknown, first=_FIRST):
            raise folder_mismatch(folder, "training", difference)


def missing_policies(folder: Path) -> tuple[int, int]:
    """How many policies a training's folder lacks, and of how many; 0 of 0 where no training is described."""
    with suppress(OSError, InvalidFile, InvalidArgument, KeyError, TypeError):
        if (stored := read_description(folder / MANIFEST, "training")) is not None:
            planned: int = read_record(Policies, stored["training"]["policies"])
            return sum(not (folder / f"p{i}.safetensors").exists() for i in range(planned)), planned
    return 0, 0


def is_finished(training: Training, folder: Path) -> bool:
    """Whether a training's folder holds all of its policies."""
    names = (MANIFEST, *(f"p{i}.safetensors" for i in range(training.policies)))
    return all((folder / name).exists() for name in names)


def write_description(folder: Path, manifest: dict[str, Any]) -> Path:
    """Write a training's description into its folder."""
    return write_whole(folder / MANIFEST, json.dumps(manifest, indent=2, sort_keys=True) + "\n")


def finish(training: Training, folder: Path) -> dict[str, Policy]:
    """Clear away what a kill left, and write what is missing once all policies are written; returns them by name."""
    # In other subfolders another training may be writing.
    for place in (folder, folder / BEST):
        clear_leftovers(place, "p*.safetensors", MANIFEST, TABLE)
    policies = {f"p{i}": Policy.load(folder / f"p{i}.safetensors") for i in range(training.policies)}
    for name, policy in policies.items():
        if len(policy.assessments):
            policies[name] = replace(policy, best=Policy.load(folder / BEST / f"{name}.safetensors"))
    if training.episodes_assessed and not (folder / TABLE).exists():
        _write_assessments(folder, policies)
    return policies


def _write_assessments(folder: Path, policies: Mapping[str, Policy]) -> None:
    """Write the table of all assessments, with each policy's best one marked."""
    from pandas import DataFrame, concat

    tables = []
    for name, policy in policies.items():
        table = DataFrame(policy.assessments, columns=ASSESSED).astype({"iterations": int})
        best = 0 if policy.best is None else len(policy.best.assessments)
        tables.append(table.assign(policy=name, best=(table.index + 1 == best).astype(int)))
    columns = ["policy", *ASSESSED, "best"]
    write_whole(folder / TABLE, concat(tables).to_csv(columns=columns, index=False, float_format="%.6g"))


def check_claim(folder: Path, manifest: dict[str, Any]) -> bool:
    """Refuse a folder of other work (Mismatch, InvalidFile); True if it holds this training, False if it is free."""
    stored = _stored_description(folder)
    if stored is not None and stored["fingerprint"] != manifest["fingerprint"]:
        difference = first_difference(stored, manifest, ignoring=_NOT_REPORTED, first=_FIRST)
        raise folder_mismatch(folder, "training", difference or "other responses")
    return stored is not None


def _stored_description(folder: Path) -> dict[str, Any] | None:
    """The training's description in a folder; None if the folder is free."""
    if (stored := read_description(folder / MANIFEST, "training")) is not None:
        return stored
    expect_no_file(folder, "the policies")
    if folder.is_dir() and any(not file.name.startswith(".") for file in folder.glob("*.safetensors")):
        raise Mismatch(f"{folder}: expected a folder of this training, got policies without a {MANIFEST}")
    expect_no_other(folder, "training")
    return None


def provenance_of(manifest: dict[str, Any]) -> dict[str, Any]:
    """The part of a training's description that is stored in its policies: everything that determines them."""
    return {key: value for key, value in manifest.items() if key not in _INFORMATIVE}


def groups_of(
    training: Training, timeline: SimulatorTimeline | None, manifest: dict[str, Any], *, fewest: int = 1
) -> list[Group]:
    """All policies of a training in at least `fewest` groups, which can be sent to other processes."""
    # Refuses a cost of pulses without known electrodes before any process begins.
    training.environment_on(timeline)
    if timeline is not None:
        timeline = replace(timeline, simulators=jax.device_get(timeline.simulators))
    parts = split_groups(training.policies, fewest=fewest)
    return [Group(training, members, timeline, manifest["fingerprint"], provenance_of(manifest)) for members in parts]
