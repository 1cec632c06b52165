"""Training all policies at once, as on a GPU: here on the processor, with a pretended GPU where one is asked for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from animat import devices
from animat.errors import Mismatch, UnusableData
from animat.execution import gpu, training_task
from animat.execution import training as in_folders
from animat.execution.gpu import find_gpu, group_by_program, submit_with_gpu
from animat.execution.jobs import Jobs
from animat.execution.task import TaskResult, reported
from animat.execution.training import TrainGroup, train
from animat.execution.training_task import TrainingTask, TrainingWork, parts_that_fit, train_together
from animat.progress import Silent
from animat.robots import Cartpole
from animat.studies import run as studies
from animat.studies.folder import describe_study
from animat.studies.run import plan_study
from animat.studies.source import Source
from animat.studies.toml import read_study
from animat.studies.training import TrainArm
from animat.training.folder import describe_training
from animat.training.group import Group, SideBySide, train_groups
from animat.training.lessons import Lesson
from animat.training.policy import Policy
from animat.training.replay import remember
from animat.training.specification import CHUNKS, Training
from test_training import SHORT, SMALL, Kept, bits, timeline_of, train_group
from worker_tasks import Join

TINY = Path(__file__).parent / "tiny_study.toml"
SHORTEST = replace(SHORT, iterations=1_000)


ARMS = (replace(SHORTEST, seed=3), replace(SHORTEST, seed=3, percentiles="first"))
"""Two that one program trains, with the same random numbers."""


def group_of(training: Training, *members: int) -> Group:
    return Group(training, members, timeline_of(), repr(training), {})


def arrays(policy: Policy) -> list[np.ndarray]:
    return [*policy.weights, *policy.biases, policy.learning_curve]


def assert_same(ones: Iterable[Policy], others: Iterable[Policy]) -> None:
    for one, other in zip(ones, others, strict=True):
        jax.tree.map(np.testing.assert_array_equal, arrays(one), arrays(other))


class AtOnce(NamedTuple):
    """What came of two policies of each of the arms, and the rows that were reported."""

    policies: list[list[Policy]]
    rows: list[list[np.ndarray]]


@pytest.fixture(scope="module")
def at_once() -> AtOnce:
    rows: list[list[np.ndarray]] = [[], []]
    policies = train_groups(
        [group_of(arm, 0, 1) for arm in ARMS], None, Silent(), add_chunks=[rows[0].append, rows[1].append]
    )
    return AtOnce(policies, rows)


@pytest.mark.oracle
def test_a_stack_of_simulators_is_to_each_policy_what_one_for_all_is(at_once: AtOnce) -> None:
    for arm, policies, rows in zip(ARMS, *at_once, strict=True):
        # Of four policies too, as their number changes the last bits.
        assert_same(policies, train_group(group_of(arm, 0, 1, 0, 1), None, Silent())[:2])
        np.testing.assert_array_equal(np.stack(rows, axis=1), [policy.learning_curve for policy in policies])
    assert at_once.policies[0][0].weights[0].tobytes() != at_once.policies[1][0].weights[0].tobytes()


@pytest.mark.oracle
def test_at_once_or_in_groups_differs_in_last_bits_only_before_they_grow() -> None:
    brief = replace(SHORTEST, iterations=CHUNKS * SMALL.environments)
    several = train_groups([group_of(brief, 0), group_of(brief, 1, 2)], None, Silent(), add_chunks=[None, None])
    for policies, members in zip(several, ((0,), (1, 2)), strict=True):
        for one, other in zip(policies, train_group(group_of(brief, *members), None, Silent()), strict=True):
            jax.tree.map(partial(np.testing.assert_allclose, rtol=0, atol=1e-5), arrays(one), arrays(other))


@pytest.mark.oracle
def test_stopped_at_a_checkpoint_all_go_on_to_the_same_bits(at_once: AtOnce, tmp_path: Path) -> None:
    class Stopping:
        def update(self, done: float, total: float, note: str = "") -> None:
            if done == CHUNKS - 3:
                raise KeyboardInterrupt

    groups, checkpoint, rows = [group_of(arm, 0, 1) for arm in ARMS], tmp_path / "kept.npz", list[np.ndarray]()
    with pytest.raises(KeyboardInterrupt):
        train_groups(groups, checkpoint, Stopping(), checkpoint_s=0.0, add_chunks=[None, None])
    kept = Kept()
    again = train_groups(groups, checkpoint, kept, add_chunks=[None, rows.append])
    assert [done for done, _ in kept.updates] == [CHUNKS - 2, CHUNKS - 1, CHUNKS]
    assert_same(chain(*again), chain(*at_once.policies))
    np.testing.assert_array_equal(rows, at_once.rows[1])


def test_what_all_remember_is_written_in_place_and_not_scattered() -> None:
    replays, rows = np.zeros((2, 3, 8, 2), np.float32), np.arange(24, dtype=np.float32).reshape(2, 3, 2, 2)
    write = jax.jit(jax.vmap(jax.vmap(remember, (0, 0, None)), (0, 0, None)))
    wanted = replays.copy()
    wanted[:, :, 5:7] = rows
    np.testing.assert_array_equal(write(replays, rows, 5), wanted)
    assert "scatter" not in write.lower(replays, rows, 5).as_text()
    with pytest.raises(ValueError, match="one position for all"):
        jax.vmap(remember)(replays[0], rows[0], np.arange(3))


def tasks_of(training: Training, *groups: tuple[int, ...]) -> list[TrainingTask]:
    return [TrainGroup(group_of(training, *members), 0.0, writes_rows=True) for members in groups]


@dataclass(frozen=True)
class Elsewhere(TrainingTask):
    """Trains a group into a folder by its name."""

    name: str
    group: Group

    @property
    def grows_with(self) -> dict[str, object]:
        return {}

    @property
    def training(self) -> Training:
        return self.group.training

    def prepare(self, folder: Path) -> TrainingWork:
        vars(self)["ran_on"] = threading.current_thread().name
        return TrainingWork(self.group, folder / self.name, folder / "none.npz")


@pytest.mark.oracle
def test_tasks_of_one_program_are_done_at_once_and_the_others_on_cores(at_once: AtOnce, tmp_path: Path) -> None:
    # Places of their own, as those of two trainings have.
    first, second = (Elsewhere(arm.percentiles, group_of(arm, 0, 1)) for arm in ARMS)
    tasks = [first, Join("a"), second]
    notices = [tmp_path / f"{number}.json" for number in range(3)]
    with ThreadPoolExecutor(1, "cores") as cores, ThreadPoolExecutor(1, "gpu") as process:
        done = [future.result() for future in submit_with_gpu(cores, process, tasks, tmp_path, notices)]
    assert [sorted(each.files) for each in done] == [
        ["moving/p0.safetensors", "moving/p1.safetensors"],
        ["a"],
        ["first/p0.safetensors", "first/p1.safetensors"],
    ]
    for name, policies in zip(("moving", "first"), at_once.policies, strict=True):
        assert_same([Policy.load(tmp_path / name / f"p{i}.safetensors") for i in range(2)], policies)
    assert [first.ran_on, second.ran_on] == ["gpu_0", "gpu_0"]
    assert [reported(notice)[0] for notice in (notices[0], notices[2])] == [1.0, 1.0]
    assert not list((tmp_path / ".unfinished").glob("*.npz"))


def test_what_fails_at_once_fails_for_each(tmp_path: Path) -> None:
    tasks = tasks_of(SHORTEST, (0,), (1,))
    failing: Future[list[TaskResult]] = Future()

    class Process(ThreadPoolExecutor):
        def submit(self, *_: Any) -> Any:
            return failing

    with ThreadPoolExecutor(1) as cores, Process(1) as process:
        futures = submit_with_gpu(cores, process, tasks, tmp_path, [tmp_path / "a", tmp_path / "b"])
        assert not any(future.done() for future in futures)
        failing.set_exception(UnusableData("no number"))
    assert [str(future.exception()) for future in futures] == ["no number"] * 2


def test_a_program_is_of_one_environment_one_algorithm_and_one_length() -> None:
    trainings = {
        "as it is": SHORTEST,
        "the same": replace(SHORTEST, seed=9, percentiles="first", shadowing=False, policies=4),
        "another length": SHORT,
        "another environment": replace(SHORTEST, delivery="shuffled"),
        "another algorithm": replace(SHORTEST, algorithm=replace(SMALL, batch=8)),
        "lessons": replace(SHORTEST, lessons=(Lesson(until_return=1.0),)),
        "other lessons": replace(SHORTEST, lessons=(Lesson(until_return=2.0),)),
        "the same lessons": replace(SHORTEST, lessons=(Lesson(until_return=1.0),)),
    }
    tasks = [task for training in trainings.values() for task in tasks_of(training, (0,))]
    assert group_by_program([*tasks, Join("a")]) == [[0, 1], [2], [3], [4], [5, 7], [6]]


def test_arms_of_a_study_share_programs_and_those_that_are_not_trained_have_none() -> None:
    study = read_study(TINY)
    tasks = [TrainArm(study, study.robots[0], arm, (0, 1)) for arm in study.arms]
    assert group_by_program([*tasks, replace(tasks[1], arm=replace(study.arms[1], name="again"))]) == [[1, 4], [2], [3]]


def test_a_device_s_memory_decides_on_the_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    groups = [group_of(SHORTEST, i) for i in range(3)]
    assert parts_that_fit(groups) == [[0, 1, 2]]  # A processor has no known limit.
    monkeypatch.setattr(training_task, "bytes_at_once", lambda groups: 9 * len(groups))
    for available, parts in (
        (30.0, [[0, 1, 2]]),
        (29.9, [[0, 1], [2]]),
        (14.9, [[0], [1], [2]]),
        (1.0, [[0], [1], [2]]),
    ):
        monkeypatch.setattr(training_task, "device_memory_bytes", lambda available=available: float(available))
        assert parts_that_fit(groups) == parts


@pytest.mark.oracle
def test_killed_between_two_parts_the_first_is_not_trained_again_and_the_bits_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_task, "parts_that_fit", lambda groups: [[0, 1], [2]])
    tasks = tasks_of(SHORTEST, (0,), (1,), (2,))
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    notices = [tmp_path / f"{number}.json" for number in range(3)]
    train_together(tasks, tmp_path / "whole", notices)
    rounds: list[int] = []
    plain = SideBySide.train

    def stopping(self: SideBySide, index: int, *simulators: Any) -> float:
        if len(rounds) == CHUNKS:
            raise KeyboardInterrupt
        rounds.append(index)
        return plain(self, index, *simulators)

    monkeypatch.setattr(SideBySide, "train", stopping)
    with pytest.raises(KeyboardInterrupt):
        train_together(tasks, tmp_path / "killed", notices)
    rounds.clear()
    train_together(tasks, tmp_path / "killed", notices)
    assert rounds == list(range(CHUNKS))
    assert bits(tmp_path / "killed") == bits(tmp_path / "whole")
    assert not list((tmp_path / "killed").glob(".unfinished/*.npz"))


@pytest.mark.oracle
def test_what_does_not_fit_into_memory_is_trained_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_task, "parts_that_fit", lambda groups: [[0, 1], [2]])
    tasks = tasks_of(SHORTEST, (0,), (1,), (2,))
    notices = [tmp_path / f"{number}.json" for number in range(3)]
    done = train_together(tasks, tmp_path, notices)
    assert [list(each.files) for each in done] == [[f"p{i}.safetensors"] for i in range(3)]
    groups = [task.prepare(tmp_path).group for task in tasks]
    wanted = [*train_groups(groups[:2], None, Silent(), add_chunks=[None] * 2), train_group(groups[2], None, Silent())]
    assert_same([Policy.load(tmp_path / f"p{i}.safetensors") for i in range(3)], chain(*wanted))


MEMORY = """
from dataclasses import replace
from test_gpu import ARMS, group_of, SMALL
from animat.execution.training_task import bytes_at_once
one, other = (replace(arm, algorithm=replace(SMALL, replay=16_384)) for arm in ARMS)
for groups in ([group_of(one, 0)], [group_of(one, 0, 1, 2)], [group_of(one, 0, 1), group_of(other, 0)]):
    print(bytes_at_once(groups))
"""


@pytest.mark.oracle
def test_memory_is_that_of_the_replay_and_grows_with_policies() -> None:
    # In a process of its own: JAX puts shapes in place of arrays, which the tests' checks of types refuse.
    said = subprocess.run(
        [sys.executable, "-c", MEMORY],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    one, three, of_two_arms = map(int, said.stdout.split())
    # A transition: the state twice with the time left, action, reward and ending, of 4 bytes each.
    row = 4 * (2 * (len(Cartpole().observation_spec) + 1) + 3)
    assert 16_384 * row < one < 1.3 * 16_384 * row
    assert 2.9 < three / one < 3.1
    assert three < of_two_arms < 1.1 * three


def test_without_a_plugin_and_where_the_processor_is_asked_for_nothing_is_looked_for_or_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(devices.importlib.util, "find_spec", lambda name: None)
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    assert not devices.may_use_gpu()
    monkeypatch.setattr(devices.importlib.util, "find_spec", lambda name: name)
    assert devices.may_use_gpu()
    for asked, allowed in (("cpu", False), ("cpu,cuda", False), ("cuda,cpu", True), ("cuda", True)):
        monkeypatch.setenv("JAX_PLATFORMS", asked)
        assert devices.may_use_gpu() == allowed
    monkeypatch.setattr(devices, "GPU_IS_ALLOWED", False)
    assert find_gpu() is None
    assert capsys.readouterr().err == ""


@pytest.mark.oracle
def test_a_platform_that_jax_does_not_have_is_not_asked_for(tmp_path: Path) -> None:
    command = ["train", "cartpole", "--mapping", "none", "--iterations", "2400", "--policies", "1"]
    done = subprocess.run(
        [sys.executable, "-m", "animat", *command, "--out", str(tmp_path / "policies")],
        env=os.environ | {"JAX_PLATFORMS": "abacus"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


class Process(ThreadPoolExecutor):
    """In place of the process that may use the GPU."""

    found: Any

    def __init__(self, cores: list[None]) -> None:
        super().__init__(len(cores))

    def submit(self, *_: Any) -> Any:
        future: Future[Any] = Future()
        if isinstance(self.found, Exception):
            future.set_exception(self.found)
        else:
            future.set_result(self.found)
        return future


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ("NVIDIA H100", ""),
        (None, "gpu: JAX finds none; policies are trained on cores\n"),
        (RuntimeError("no driver"), "gpu: none can be used (RuntimeError: no driver); policies are trained on cores\n"),
    ],
)
def test_where_no_gpu_is_found_it_says_so_in_a_line(
    found: Any, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(devices, "GPU_IS_ALLOWED", True)
    monkeypatch.setattr(Process, "found", found, raising=False)
    monkeypatch.setattr(gpu, "PinnedProcesses", Process)
    assert find_gpu() == (found if isinstance(found, str) else None)
    err = capsys.readouterr().err
    assert err == said


def test_a_training_records_its_device_and_is_not_continued_on_another(tmp_path: Path) -> None:
    on = {
        name: describe_training(SHORTEST, timeline_of(), device=name) for name in (None, "NVIDIA H100", "NVIDIA A100")
    }
    assert len({manifest["fingerprint"] for manifest in on.values()}) == 3
    assert "device" not in on[None]["versions"]
    (tmp_path / "training.json").write_text(json.dumps(on["NVIDIA H100"]))
    with pytest.raises(Mismatch, match=r"versions\.device: 'NVIDIA H100' there, nothing now"):
        train(SHORTEST, timeline_of(), tmp_path)


@pytest.mark.oracle
def test_a_training_with_a_gpu_comes_from_one_process_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole way: a process without a core of its own, which here finds the processor alone."""
    monkeypatch.setattr(in_folders, "find_gpu", lambda: "pretended")
    seven, progress, rows = replace(SHORTEST, policies=7), Kept(), list[Any]()
    at_once = train(seven, timeline_of(), tmp_path, progress=progress, callbacks=[rows.append])
    assert progress.updates[-1] == (7 * CHUNKS, 7 * CHUNKS)
    assert list(bits(tmp_path)) == [f"p{i}.safetensors" for i in range(7)]
    assert not (tmp_path / ".unfinished").exists()
    assert len(rows) == 7 * CHUNKS
    assert {policy.provenance["versions"]["device"] for policy in at_once.values()} == {"pretended"}
    whole = train_group(group_of(seven, *range(7)), None, Silent())
    for one, other in zip(at_once.values(), whole, strict=True):
        jax.tree.map(np.testing.assert_array_equal, arrays(one), arrays(other))


def test_a_study_records_its_device_and_is_not_continued_on_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = replace(read_study(TINY), culture=Source())
    description = describe_study(study, {}, "NVIDIA H100")
    assert description["fingerprint"] != describe_study(study, {})["fingerprint"]
    (tmp_path / "study.json").write_text(json.dumps(description))
    (tmp_path / "jobs").mkdir()
    (tmp_path / "jobs" / "fit.json").write_text("{}")
    with pytest.raises(Mismatch, match=r"versions\.device: 'NVIDIA H100' there, nothing now"):
        studies.run_study(study, tmp_path)
    monkeypatch.setattr(studies, "find_gpu", lambda: "NVIDIA A100")
    with pytest.raises(Mismatch, match=r"versions\.device: 'NVIDIA H100' there, 'NVIDIA A100' now"):
        studies.run_study(study, tmp_path)


@pytest.mark.oracle
def test_arms_trained_at_once_are_those_of_a_study_on_cores_where_none_shares_a_program(tmp_path: Path) -> None:
    study = read_study(TINY)
    for name in ("gpu", "cores"):
        plan = [job for job in plan_study(study, TINY.parent) if job.name.split("/")[0] in ("record", "fit", "train")]
        jobs = Jobs(plan, tmp_path / name, tmp_path / name / "jobs", "the study")
        assert len(jobs.run(workers=1, executor=None, progress=Silent(), has_gpu=name == "gpu")) == 6
    policies = [sorted((tmp_path / name / "policies").rglob("*.safetensors")) for name in ("gpu", "cores")]
    assert len(policies[0]) == len(policies[1]) == 8
    for one, other in zip(*policies, strict=True):
        assert one.read_bytes() == other.read_bytes()
    receipts = [sorted((tmp_path / name / "jobs").iterdir()) for name in ("gpu", "cores")]
    assert [file.read_text() for file in receipts[0]] == [file.read_text() for file in receipts[1]]


GPU_PROCESS = """
import os, sys
from animat.process import pin_worker
cores = os.sched_getaffinity(0)
pin_worker(None)
assert os.sched_getaffinity(0) == cores
values = [os.environ.get(n) for n in ("JAX_PLATFORMS", "XLA_PYTHON_CLIENT_PREALLOCATE", "JAX_DEFAULT_MATMUL_PRECISION")]
print(*values, file=sys.stderr)
"""


def test_the_process_for_a_gpu_may_use_one_whatever_this_process_may() -> None:
    said = subprocess.run(
        [sys.executable, "-c", GPU_PROCESS],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "XLA_PYTHON_CLIENT_PREALLOCATE": "true"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stderr == "None true highest\n"
