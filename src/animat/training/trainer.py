"""Training of several policies: groups of them on processes, one a core, into a folder that can be gone on with."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import os
import pickle
import selectors
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from animat.coding.mapping import check_mapping, expect_loadable_mapping
from animat.differences import first_difference
from animat.errors import AnimatError, InvalidArgument, InvalidFile, Mismatch
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Progress, Silent
from animat.robots.checking import check_robot
from animat.robots.registry import expect_loadable_robot
from animat.training.group import CHECKPOINT_S, Group, split_groups, train_group
from animat.training.policy import Policy
from animat.training.specification import CHUNKS, Training
from animat.training.worker import start_worker
from animat.writing import alone_in, clear_away, written_whole

MANIFEST = "training.json"
_UNFINISHED = ".unfinished"
_NOT_TOLD = ("fingerprint", "sources", "burst_thresholds")
"""Where a folder is another training's: they differ with the responses."""


def train(
    training: Training,
    timeline: SimulatorTimeline | None,
    folder: str | os.PathLike[str] | None,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
    checkpoint_s: float = CHECKPOINT_S,
    sources: Sequence[str] = (),
) -> dict[str, Policy]:
    """Train policies into a folder: `p0.safetensors`, ..., and `training.json`, which says what they are.

    Stopped at any moment, also by SIGKILL, and called again, it goes on from the last chunk and ends in the same bits
    as if it had not been stopped, with any number of workers. On a finished folder it reads the policies and returns.

    Args:
        training: what is trained.
        timeline: the culture's simulators; None for a training without neurons.
        folder: where the policies go; made where it is missing. None: nowhere; they are trained in this process, and
            a training that is stopped begins anew. So can robots that are not registered, and mappings of one's own,
            which no file can name.
        workers: processes to use, each pinned to a core of its own; None: as many as there are cores.
        progress: told how far it is.
        checkpoint_s: seconds between checkpoints; what a kill may cost, never the result.
        sources: names of the recordings, for the manifest.

    Returns:
        The policies by name, `p0` first.

    Raises:
        InvalidArgument: if neurons are missing for a mapping or given without one, for fewer workers than one, or as
            `expect_trainable` does.
        Mismatch: if the folder holds another training, or another run is at work in it.
        InvalidFile: if a file cannot be read or written.
    """
    if (timeline is None) != (training.mapping is None):
        raise InvalidArgument(
            "timeline: expected the culture's simulators with a mapping, and None without, got "
            f"{'none' if timeline is None else 'some'} with mapping {training.mapping and training.mapping.name}"
        )
    if workers is not None and workers < 1:
        raise InvalidArgument(f"workers: expected at least 1, got {workers}")
    expect_trainable(training, is_saved=folder is not None)
    progress = progress or Silent()
    training = training.over(timeline)
    manifest = describe(training, timeline, sources)
    groups = [
        Group(training, members, _on_host(timeline), manifest["fingerprint"], provenance_of(manifest))
        for members in split_groups(training.policies, fewest=2)
    ]
    if folder is None:
        return _in_memory(groups, progress)
    folder = Path(folder)
    # Seen before it is touched: somebody else's folder stays as it is.
    _is_ours(folder, manifest)
    with alone_in(folder):
        if not _is_ours(folder, manifest):
            with written_whole(folder / MANIFEST) as beside:
                beside.write_text(json.dumps(manifest, indent=2, sort_keys=True) + "\n")
        _run([group for group in groups if not _is_trained(group, folder)], folder, workers, checkpoint_s, progress)
        shutil.rmtree(folder / _UNFINISHED, ignore_errors=True)
        for leftover in (*folder.glob(".p*.safetensors.*.partial*"), *folder.glob(f".{MANIFEST}.*.partial*")):
            clear_away(leftover)
    return {f"p{i}": Policy.load(folder / f"p{i}.safetensors") for i in range(training.policies)}


def expect_trainable(training: Training, *, is_saved: bool) -> None:
    """Refuse, before the first iteration, what cannot be trained, or could not be loaded once it is.

    Args:
        training: what is to be trained.
        is_saved: whether its policies go to files.

    Raises:
        InvalidArgument: naming what of the robot or the mapping was expected, what came, and what can be done.
    """
    check_robot(training.robot)
    if training.mapping is not None:
        check_mapping(training.mapping)
    if is_saved:
        expect_loadable_robot(training.robot, in_workers=True)
        if training.mapping is not None:
            expect_loadable_mapping(training.mapping)


def describe(training: Training, timeline: SimulatorTimeline | None, sources: Sequence[str] = ()) -> dict[str, Any]:
    """What decides how policies come out, as plain data, with a fingerprint over all of it."""
    manifest: dict[str, Any] = {
        "training": training.to_dict(),
        "simulators": None if timeline is None else _described(timeline),
        "versions": {name: importlib.metadata.version(name) for name in ("animat", "jax", "jaxlib", "numpy", "optax")},
    }
    # By way of JSON, in which a tuple and a list are the same.
    manifest = json.loads(json.dumps(manifest))
    digest = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode())
    for leaf in jax.tree.leaves(_on_host(timeline).simulators if timeline else ()):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    # Names of files are told but do not decide: the same recordings in another place are the same.
    return manifest | {"sources": list(sources), "fingerprint": digest.hexdigest()}


def _described(timeline: SimulatorTimeline) -> dict[str, Any]:
    """Where the simulators came from, as far as it is not the responses themselves."""
    return {
        **timeline.fitted,
        "conditions": [condition.label for condition in timeline.conditions],
        "window_ms": timeline.window_ms,
        "presentation": None if timeline.presentation is None else str(timeline.presentation),
        "recorded_at_min": timeline.start_min.tolist(),
    }


def expect_folder_for(training: Training, folder: Path) -> None:
    """Refuse a folder of another training by its settings, which are known before any recording is read.

    Raises:
        Mismatch, InvalidFile: as `train` does.
    """
    if (found := _description_in(folder)) is not None:
        as_long_as_recordings = training.duration_min is None and training.mapping is not None
        unknown = ("simulators", "sources", "fingerprint", *(("duration_min",) if as_long_as_recordings else ()))
        if difference := _first_difference(found, describe(training, None), unknown):
            raise _of_another(folder, difference)


def is_finished(training: Training, folder: Path) -> bool:
    """Whether a training's folder has all of its policies."""
    return (folder / MANIFEST).exists() and all(
        (folder / f"p{i}.safetensors").exists() for i in range(training.policies)
    )


def _is_ours(folder: Path, manifest: dict[str, Any]) -> bool:
    """Whether the training is already in the folder; not if it is free for it.

    Raises:
        Mismatch: if it is another training's, or holds policies that no description tells of.
        InvalidFile: if its description cannot be read, or it is a file.
    """
    found = _description_in(folder)
    if found is not None and found["fingerprint"] != manifest["fingerprint"]:
        raise _of_another(folder, _first_difference(found, manifest, _NOT_TOLD) or "other responses")
    return found is not None


def _description_in(folder: Path) -> dict[str, Any] | None:
    """What a folder says it holds; None if it is free."""
    path = folder / MANIFEST
    if path.exists():
        try:
            found: dict[str, Any] = json.loads(path.read_text())
            _ = found["fingerprint"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InvalidFile(f"{path}: expected a training's description, got a file that cannot be read") from error
        return found
    if folder.exists() and not folder.is_dir():
        raise InvalidFile(f"{folder}: expected a folder for the policies, got a file")
    if folder.is_dir() and any(not file.name.startswith(".") for file in folder.glob("*.safetensors")):
        raise Mismatch(f"{folder}: expected a folder of this training, got policies without a {MANIFEST}")
    return None


def _first_difference(found: dict[str, Any], manifest: dict[str, Any], ignoring: Sequence[str]) -> str:
    # What follows from the robot, such as the usual iterations, is not what differs.
    there, now = (each.get("training", {}).get("robot", {}).get("name") for each in (found, manifest))
    return first_difference(there, now, "training.robot.name") or first_difference(found, manifest, ignoring=ignoring)


def _of_another(folder: Path, difference: str) -> Mismatch:
    return Mismatch(
        f"{folder}: expected a folder of this training, got one of another ({difference}); "
        "give another folder, or remove this one"
    )


def provenance_of(manifest: dict[str, Any]) -> dict[str, Any]:
    """What of a training's description its policies carry: all that decides how they come out."""
    return {key: value for key, value in manifest.items() if key != "sources"}


def _is_trained(group: Group, folder: Path) -> bool:
    for member in group.members:
        path = folder / f"p{member}.safetensors"
        if not path.exists() or Policy.load(path).provenance.get("fingerprint") != group.fingerprint:
            return False
    return True


def _on_host(timeline: SimulatorTimeline | None) -> Any:
    """The timeline with numpy arrays: they go to another process without a device."""
    if timeline is None:
        return None
    from dataclasses import replace

    return replace(timeline, simulators=jax.device_get(timeline.simulators))


def _in_memory(groups: list[Group], progress: Progress) -> dict[str, Policy]:
    """Train the groups in this process, one after the other."""
    trained: dict[str, Policy] = {}
    for number, group in enumerate(groups):

        def told(done: int, mean_return: float, number: int = number) -> None:
            note = "" if math.isnan(mean_return) else f"return {mean_return:.1f}"
            progress.update(number * CHUNKS + done, len(groups) * CHUNKS, note)

        policies = train_group(group, None, told)
        trained |= {f"p{member}": policy for member, policy in zip(group.members, policies, strict=True)}
    return trained


def _run(groups: list[Group], folder: Path, workers: int | None, checkpoint_s: float, progress: Progress) -> None:
    """Train the groups on processes, each pinned to its own core; the first error ends all."""
    cores = sorted(os.sched_getaffinity(0))
    free = cores[: min(len(cores), len(groups), workers or len(cores))]
    waiting = list(groups)
    total = sum(len(group.members) for group in groups) * CHUNKS
    done: dict[tuple[int, ...], int] = {}
    running: dict[int, tuple[subprocess.Popen[bytes], Group]] = {}
    selector = selectors.DefaultSelector()
    try:
        while waiting or running:
            while waiting and free:
                group, core = waiting.pop(0), free.pop(0)
                process = _start(group, folder, core, checkpoint_s)
                assert process.stdout is not None
                selector.register(process.stdout, selectors.EVENT_READ, core)
                running[core] = (process, group)
            for key, _ in selector.select():
                process, group = running[key.data]
                assert process.stdout is not None
                line = process.stdout.readline()
                if line:
                    told = json.loads(line)
                    if "error" in told:
                        raise InvalidFile(told["error"])
                    done[group.members] = told["done"] * len(group.members)
                    mean = told["mean_return"]
                    progress.update(sum(done.values()), total, "" if math.isnan(mean) else f"return {mean:.1f}")
                    continue
                selector.unregister(process.stdout)
                process.stdout.close()
                del running[key.data]
                free.append(key.data)
                if process.wait() != 0:
                    raise AnimatError(
                        f"training: the process of policies {group.members} ended with status {process.returncode}; "
                        "start again to go on from its last checkpoint"
                    )
    finally:
        for process, _ in running.values():
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        selector.close()


def _start(group: Group, folder: Path, core: int, checkpoint_s: float) -> subprocess.Popen[bytes]:
    checkpoint = folder / _UNFINISHED / f"from-p{group.members[0]}.npz"
    # From a file, not a pipe: the job may be larger than a pipe holds, and is read only once JAX is imported.
    with tempfile.TemporaryFile() as job:
        try:
            pickle.dump((group, folder, checkpoint, checkpoint_s), job)
            job.seek(0)
        except OSError as error:
            raise InvalidFile(f"{tempfile.gettempdir()}: cannot be written to: {error.strerror or error}") from error
        return start_worker("animat.training.worker", core, job)
