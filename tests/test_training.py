"""Training as a user meets it: the same bits whatever happens, shadowing, baselines, folders that are not mixed up."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from animat.coding.mapping import Thresholds
from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.execution.training import train
from animat.folders import first_difference
from animat.neurons.timeline import SimulatorTimeline, fit_timeline
from animat.progress import Progress, Silent
from animat.robots import Cartpole, Navigation
from animat.training.folder import describe_training, missing_policies
from animat.training.group import Group, programs, split_groups, train_groups
from animat.training.policy import Policy
from animat.training.settings import MOST_POLICIES, SAC
from animat.training.specification import CHUNKS, Training
from animat.writing import exclusive_lock
from test_simulator import responses_of

SMALL = SAC(environments=8, gradient_steps=1, batch=16, replay=1024, hidden=8)
SHORT = Training(Cartpole(), Thresholds(1), policies=2, iterations=6_000, duration_min=60.0, algorithm=SMALL)
"""Two groups of one policy each, which are one program."""


def timeline_of(minutes: tuple[float, ...] = (0.0, 10.0, 20.0), seed: int = 0, **fit: Any) -> SimulatorTimeline:
    rng = np.random.default_rng(seed)
    return fit_timeline(
        [responses_of(*(rng.gamma(6.0, m / 6.0, 60) for m in (30, 40, 55)), start_min=minute) for minute in minutes],
        **fit,
    )


def trained(training: Training, timeline: SimulatorTimeline | None, folder: Path, **more: Any) -> dict[str, Policy]:
    """Trained into the folder in this process: for tests of what comes out, not of who does it."""
    with ThreadPoolExecutor(1) as executor:
        return train(training, timeline, folder, executor=executor, **more)


def train_group(group: Group, checkpoint: Path | None, progress: Progress, **more: Any) -> list[Policy]:
    return train_groups([group], checkpoint, progress, add_chunks=[None], **more)[0]


def bits(folder: Path) -> dict[str, bytes]:
    """The policies' files, byte for byte."""
    return {file.name: file.read_bytes() for file in sorted(folder.glob("*.safetensors"))}


class Kept:
    """A progress that keeps its updates."""

    def __init__(self) -> None:
        self.updates: list[tuple[float, float]] = []

    def update(self, done: float, total: float, note: str = "") -> None:
        self.updates.append((done, total))


@pytest.mark.oracle
def test_the_same_seed_gives_the_same_bits_in_workers_and_on_an_executor_which_stays_open(tmp_path: Path) -> None:
    four = replace(SHORT, policies=4, iterations=1_000)
    progress = Kept()
    # First here, where the program is compiled that each worker then finds.
    with ThreadPoolExecutor(2) as executor:
        lent = train(four, timeline_of(), tmp_path / "lent", executor=executor)
        assert executor.submit(len, lent).result() == 4
    train(four, timeline_of(), tmp_path / "two", workers=2, progress=progress)
    assert list(bits(tmp_path / "two")) == [f"p{i}.safetensors" for i in range(4)]
    assert bits(tmp_path / "two") == bits(tmp_path / "lent")
    assert progress.updates[-1] == (4 * CHUNKS, 4 * CHUNKS)
    assert not any((tmp_path / name / ".unfinished").exists() for name in ("two", "lent"))
    # In memory, one group of two after the other.
    progress = Kept()
    alone = train(four, timeline_of(), None, progress=progress)
    done = [each for each, _ in progress.updates]
    assert done == sorted(done) and {*range(1, 2 * CHUNKS + 1)} <= {*done}
    for name, policy in lent.items():
        np.testing.assert_array_equal(policy.weights[0], alone[name].weights[0])


@pytest.mark.oracle
def test_informative_entries_change_no_policy_and_no_folder(tmp_path: Path) -> None:
    short = replace(SHORT, policies=1, iterations=500)
    named = trained(short, timeline_of(), tmp_path / "named", sources=["a.nwb"], random_return=-12.5)
    plain = trained(short, timeline_of(), tmp_path / "plain")
    assert bits(tmp_path / "named") == bits(tmp_path / "plain")
    assert json.loads((tmp_path / "named" / "training.json").read_text())["random_return"] == -12.5
    # Asked for again without it, it is the same training.
    assert trained(short, timeline_of(), tmp_path / "named")["p0"].provenance == named["p0"].provenance
    assert plain["p0"].provenance == named["p0"].provenance


@pytest.mark.oracle
def test_policies_differ_from_each_other_and_from_those_of_another_seed(tmp_path: Path) -> None:
    weights = [
        policy.weights[0].tobytes()
        for seed in (1, 2)
        for policy in trained(replace(SHORT, iterations=500, seed=seed), timeline_of(), tmp_path / str(seed)).values()
    ]
    assert len(set(weights)) == 4


KILLED = """
import sys
from pathlib import Path
from test_training import SHORT, timeline_of
from animat.execution.training import train
train(SHORT, timeline_of(), Path(sys.argv[1]), checkpoint_s=0.0)
"""


@pytest.mark.oracle
def test_killed_at_any_moment_and_started_again_it_ends_in_the_same_bits(tmp_path: Path) -> None:
    train(SHORT, timeline_of(), tmp_path / "undisturbed", workers=1)
    folder = tmp_path / "killed"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    checkpoint = folder / ".unfinished" / "from-p0.npz"
    seen = set()
    for _ in range(2):
        process = subprocess.Popen([sys.executable, "-c", KILLED, str(folder)], env=environment, start_new_session=True)
        # Killed while chunks are being finished: once another one is on disk than at the last start.
        while process.poll() is None:
            if checkpoint.exists() and (stamp := checkpoint.stat().st_mtime_ns) not in seen:
                seen.add(stamp)
                break
            time.sleep(0.005)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        time.sleep(0.2)
    assert len(seen) == 2, "it was over before it could be killed twice"
    assert "p0.safetensors" not in bits(folder), "the group that was watched was over"
    train(SHORT, timeline_of(), folder)
    assert bits(folder) == bits(tmp_path / "undisturbed")


def test_what_a_killed_process_left_half_written_is_cleared_away(tmp_path: Path) -> None:
    names = ("p1.safetensors", "training.json", "assessments.csv")
    leftovers = [tmp_path / f".{name}.ab.partial{Path(name).suffix}" for name in names]
    for leftover in leftovers:
        leftover.write_bytes(b"half of it")
    # Another training may be writing this one just now.
    of_another = tmp_path / "another" / leftovers[0].name
    of_another.parent.mkdir()
    of_another.write_bytes(b"half of it")
    trained(replace(SHORT, policies=1, iterations=500), timeline_of(), tmp_path)
    assert of_another.exists()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["another", "p0.safetensors", "training.json"]


WATCHED = """
import signal, sys
from pathlib import Path
# A process that was started in the background ignores the keyboard; this one is to feel it.
signal.signal(signal.SIGINT, signal.default_int_handler)
from animat.execution.training import train
from test_training import SHORT, Interrupting, replace, timeline_of
train(replace(SHORT, iterations=10_000_000), timeline_of(), Path(sys.argv[1]), progress=Interrupting())
"""


class Interrupting:
    """A progress that interrupts the whole foreground group, as Ctrl-C in a terminal does, and says who is in it."""

    def update(self, done: float, total: float, note: str = "") -> None:
        begun = [
            Path("/proc", child)
            for of in Path("/proc/self/task").glob("*/children")
            for child in of.read_text().split()
        ]
        # Not one that is just being forked.
        workers = [child.name for child in begun if b"animat.process" in (child / "cmdline").read_bytes()]
        if not workers:
            return
        print(*(os.getpgid(int(worker)) == os.getpgrp() for worker in workers), flush=True)
        os.killpg(os.getpgrp(), signal.SIGINT)


@pytest.mark.oracle
def test_an_interrupt_from_the_keyboard_does_not_reach_the_workers(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", WATCHED, str(tmp_path)],
        env=environment,
        start_new_session=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    in_its_group = done.stdout.splitlines()[0].split()
    assert in_its_group
    assert set(in_its_group) == {"False"}
    assert done.stderr.count("Traceback") == 1, "the process's own, and none of a worker's"
    assert done.stderr.rstrip().endswith("KeyboardInterrupt")


def test_a_finished_folder_is_read_and_not_trained_again(tmp_path: Path) -> None:
    trained(replace(SHORT, iterations=1_000), timeline_of(), tmp_path)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
    progress = Kept()
    policies = train(replace(SHORT, iterations=1_000), timeline_of(), tmp_path, progress=progress)
    assert list(policies) == ["p0", "p1"]
    assert {file: file.stat().st_mtime_ns for file in tmp_path.iterdir()} == before
    assert not progress.updates


def test_a_folder_of_another_training_is_refused_and_left_alone(tmp_path: Path) -> None:
    short = replace(SHORT, iterations=1_000, policies=1)
    trained(short, timeline_of(), tmp_path)
    before = bits(tmp_path)
    with pytest.raises(Mismatch, match=r"training.seed: 1 there, 9 now"):
        train(replace(short, seed=9), timeline_of(), tmp_path)
    with pytest.raises(Mismatch, match="other responses"):
        train(short, timeline_of(seed=1), tmp_path)
    for wanted, fit in (("bins: 20 there, 10 now", {"bins": 10}), ("range_hz: None there", {"range_hz": 120.0})):
        with pytest.raises(Mismatch, match=rf"simulators\.{wanted}"):
            train(short, timeline_of(**fit), tmp_path)
    assert bits(tmp_path) == before
    (tmp_path / "training.json").unlink()
    with pytest.raises(Mismatch, match=r"without a training\.json"):
        train(short, timeline_of(), tmp_path)


@pytest.mark.oracle
def test_a_difference_without_neurons_is_reported_by_name(tmp_path: Path) -> None:
    baseline = replace(SHORT, iterations=1_000, policies=1, mapping=None, commands=(-1.0, 1.0))
    trained(baseline, None, tmp_path)
    assert list(train(baseline, None, tmp_path)) == ["p0"]
    with pytest.raises(Mismatch, match=r"training\.seed: 1 there, 9 now"):
        train(replace(baseline, seed=9), None, tmp_path)


def test_a_second_training_in_a_folder_at_work_is_refused(tmp_path: Path) -> None:
    with exclusive_lock(tmp_path), pytest.raises(Mismatch, match="another run is at work in this folder"):
        train(SHORT, timeline_of(), tmp_path)
    assert not any(tmp_path.iterdir())


def test_a_checkpoint_of_another_training_or_a_damaged_one_is_refused(tmp_path: Path) -> None:
    timeline = timeline_of()
    group = Group(SHORT, (0,), timeline, describe_training(SHORT, timeline)["fingerprint"], {})
    checkpoint = tmp_path / "c.npz"

    class Stop(Exception):
        pass

    class Stopping:
        def update(self, done: float, total: float, note: str = "") -> None:
            raise Stop

    stop = Stopping()

    with pytest.raises(Stop):
        train_group(group, checkpoint, stop, checkpoint_s=0.0)
    with pytest.raises(InvalidFile, match="got another training's"):
        train_group(replace(group, fingerprint="other"), checkpoint, stop, checkpoint_s=0.0)
    whole = checkpoint.read_bytes()
    with np.load(checkpoint) as kept:
        arrays = dict(kept)
    last = max((name for name in arrays if name.startswith("leaf")), key=lambda name: int(name[4:]))
    fewer = {name: array for name, array in arrays.items() if name != last}
    of_another_version = (
        fewer,
        arrays | {last: arrays[last][..., None]},
        arrays | {"leaf0": arrays["leaf0"].astype(float)},
        arrays | {"done": arrays["done"] + 1},
        arrays | {"done": 0 * arrays["done"], "curve": arrays["curve"][:0]},
        arrays | {"curve": arrays["curve"][..., :-1]},
    )
    for others in of_another_version:
        np.savez(checkpoint, **others)
        with pytest.raises(InvalidFile, match=r"as this version of animat writes it, of .*: rm '"):
            train_group(group, checkpoint, stop, checkpoint_s=0.0)
    # Flags and compression of the first entry in the table at the end: zipfile has errors of other kinds for these.
    table = whole.index(b"PK\x01\x02")
    encrypted, unknown = bytearray(whole), bytearray(whole)
    encrypted[table + 8] |= 1
    unknown[table + 10] = 77
    for damaged in (whole[:5000], bytes(encrypted), bytes(unknown)):
        checkpoint.write_bytes(damaged)
        with pytest.raises(InvalidFile, match="cannot be read"):
            train_group(group, checkpoint, stop, checkpoint_s=0.0)


def weights_after(training: Training, timeline: SimulatorTimeline, checkpoint: Path) -> bytes:
    """The first layer of the first policy, trained in this process."""
    group = Group(training, (0,), timeline, "any", {})
    # Without a checkpoint, however slow the machine: the next training would go on from it.
    policy = train_group(group, checkpoint, Silent(), checkpoint_s=float("inf"))[0]
    return policy.weights[0].tobytes()


def test_shadowing_uses_the_newest_simulator_of_each_minute(tmp_path: Path) -> None:
    """Recordings after the last minute that training stands for change nothing; earlier ones do, unless held off."""
    short = replace(SHORT, iterations=1_000, duration_min=30.0)
    weights = {
        (minutes, shadowing): weights_after(
            replace(short, shadowing=shadowing), timeline_of(minutes), tmp_path / "checkpoint"
        )
        for minutes in ((0.0,), (0.0, 10.0), (0.0, 10.0, 40.0))
        for shadowing in (True, False)
    }
    shadowed, held = ({m: w for (m, shadowing), w in weights.items() if shadowing is s} for s in (True, False))
    assert shadowed[0.0, 10.0] == shadowed[0.0, 10.0, 40.0] != shadowed[0.0,]
    assert set(held.values()) == {shadowed[0.0,]}


@pytest.mark.oracle
def test_held_percentiles_train_another_policy(tmp_path: Path) -> None:
    moving = weights_after(SHORT, timeline_of(), tmp_path / "checkpoint")
    assert weights_after(replace(SHORT, percentiles="first"), timeline_of(), tmp_path / "checkpoint") != moving


@pytest.mark.long
@pytest.mark.parametrize(
    ("robot", "commands", "better_than"), [(Cartpole(), (-1.0, 1.0), 100.0), (Navigation(), None, 20.0)]
)
def test_baselines_without_neurons_learn_their_task(
    robot: Cartpole | Navigation, commands: tuple[float, ...] | None, better_than: float, tmp_path: Path
) -> None:
    # Perfect is 120 on the cartpole; a straight run in navigation gives about 25.
    training = Training(robot, None, policies=2, iterations=60_000, commands=commands)
    policies = train(training, None, tmp_path)
    assert max(p.learning_curve[-5:, 2].mean() for p in policies.values()) > better_than
    assert policies["p0"].n_actions == (None if commands is None else 2)
    assert policies["p0"].mapping is None


@pytest.mark.oracle
def test_where_the_user_computes_in_64_bits_policies_are_the_same() -> None:
    usual = train(SHORT, timeline_of(), None)
    with jax.enable_x64(True):
        policies = train(SHORT, timeline_of(), None)
    for name, policy in policies.items():
        assert all(map(np.array_equal, policy.weights, usual[name].weights))


@pytest.mark.oracle
def test_a_learning_curve_counts_what_was_done(tmp_path: Path) -> None:
    curve = trained(SHORT, timeline_of(), tmp_path)["p1"].learning_curve
    assert curve.shape == (CHUNKS, 6)
    # 6,000 iterations in rounds of 8 are 750 rounds, hence exact.
    assert curve[-1, 0] == 6_000
    assert np.all(np.diff(curve[:, 0]) >= 0)
    # No cartpole episode is longer than 120 iterations, and none that fails is shorter than 5.
    assert 6_000 / 120 <= curve[:, 1].sum() <= 6_000 / 5


def test_programs_are_traced_once_a_process() -> None:
    environment, other = (SHORT.environment(n) for n in (3, 5))
    assert programs(environment, SMALL) is programs(SHORT.environment(3), replace(SMALL)) is not programs(other, SMALL)


def test_groups_are_even_and_depend_on_the_number_of_policies_only() -> None:
    for n in range(1, 40):
        groups = split_groups(n)
        assert [i for group in groups for i in group] == list(range(n))
        assert max(map(len, groups)) <= 5
        assert max(map(len, groups)) - min(map(len, groups)) <= 1
        on_two_cores = split_groups(n, fewest=2)
        assert [i for group in on_two_cores for i in group] == list(range(n))
        assert len(on_two_cores) == max(len(groups), min(2, n))


@pytest.mark.oracle
def test_the_error_of_a_worker_comes_in_one_line(tmp_path: Path) -> None:
    short = replace(SHORT, iterations=1_000, policies=1)
    (tmp_path / ".unfinished").mkdir()
    (tmp_path / ".unfinished" / "from-p0.npz").write_text("in the way")
    with pytest.raises(InvalidFile, match=r"^p0: .* cannot be read"):
        train(short, timeline_of(), tmp_path)
    assert not bits(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"policies": 0}, "policies"),
        ({"iterations": 0}, "iterations"),
        ({"iterations": 2**31}, "iterations"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**32}, "seed"),
        ({"duration_min": 0.0}, "duration_min"),
        ({"duration_min": float("nan")}, "duration_min"),
        ({"percentiles": "last"}, "percentiles"),
        ({"delivery": "lost"}, "delivery"),
        ({"shadowing": 1}, "shadowing"),
        ({"neural_observation": 0}, "neural_observation"),
    ],
)
def test_settings_without_meaning_are_refused_by_name(change: dict[str, object], words: str) -> None:
    with pytest.raises(InvalidArgument, match=words):
        replace(SHORT, **change)


def test_a_number_is_the_same_training_whatever_kind_of_number_it_is() -> None:
    plain = replace(SHORT, mapping=None, policies=2, iterations=1_000, seed=3, duration_min=60.0, pulse_cost=0.0)
    other = replace(
        plain,
        policies=np.int64(2),
        iterations=np.int32(1_000),
        seed=np.uint32(3),
        duration_min=60,
        pulse_cost=np.float32(0),
    )
    assert describe_training(other, None) == describe_training(plain, None)


def test_neurons_and_mapping_come_together(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match="timeline"):
        train(SHORT, None, tmp_path)
    with pytest.raises(InvalidArgument, match="timeline"):
        train(replace(SHORT, mapping=None), timeline_of(), tmp_path)
    with pytest.raises(InvalidArgument, match="workers"):
        train(SHORT, timeline_of(), tmp_path, workers=0)
    with (
        ThreadPoolExecutor(1) as executor,
        pytest.raises(InvalidArgument, match="workers: expected None with an executor"),
    ):
        train(SHORT, timeline_of(), tmp_path, workers=1, executor=executor)


def test_a_policy_says_where_it_came_from(tmp_path: Path) -> None:
    timeline = timeline_of()
    trained(replace(SHORT, iterations=1_000, policies=1), timeline, tmp_path, sources=["mine.nwb"])
    policy = Policy.load(tmp_path / "p0.safetensors")
    assert policy.conditions == timeline.conditions
    assert policy.presentation == timeline.presentation
    assert policy.robot == Cartpole()
    assert policy.provenance["training"]["seed"] == 1
    assert (policy.percentiles, policy.delivery) == ("moving", "chosen")
    made = policy.provenance["simulators"]
    assert (made["kind"], made["bins"], made["range_hz"], made["window_ms"]) == ("histogram", 20, None, [2.0, 10.0])
    assert made["recorded_at_min"] == [0.0, 10.0, 20.0] and len(made["burst_thresholds"]) == 3
    assert policy.provenance["versions"]["jax"] == jax.__version__


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ({"duration_min": "x"}, "duration_min: expected a number, got 'x'"),
        ({"duration_min": float("inf")}, "duration_min: expected a finite number, got inf"),
        ({"commands": 3}, "commands: expected a list, got 3"),
        ({"commands": ("a",)}, "commands: expected a number, got 'a'"),
        ({"commands": ()}, "commands: expected at least 1"),
        ({"commands": ()}, "commands: expected at least 1 command to pick from, or None for any, got none"),
        ({"mapping": "none"}, "mapping: expected None without neurons, mapping=None in Python, got 'none'"),
        ({"commands": (0.5, 2.0)}, "commands: expected at most 1, got 2"),
        ({"lessons": (3,)}, "lessons: expected Lesson, got 3"),
        ({"algorithm": 3}, "algorithm: expected SAC, got 3"),
    ],
)
def test_invalid_settings_are_refused(named: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidArgument, match=re.escape(message)):
        Training(**{"robot": Cartpole(), "mapping": None, **named})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"training": "cartpole"},
            "training: expected a Training, such as animat.Training('cartpole', '9-thresholds')",
        ),
        (
            {"timeline": "recordings/"},
            "timeline: expected simulators, as animat.fit_timeline returns, or None, got 'rec",
        ),
        ({"folder": 3}, "folder: expected a path, or None, got 3"),
        (
            {"callbacks": print},
            "callbacks: expected a list of functions that take a row of a learning curve, got <built",
        ),
        (
            {"callbacks": [None]},
            "callbacks: expected a list of functions that take a row of a learning curve, got None",
        ),
    ],
)
def test_values_of_the_wrong_kind_are_refused(changed: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"training": replace(SHORT, mapping=None), "timeline": None, "folder": None} | changed
    with pytest.raises(InvalidArgument, match=re.escape(message)):
        train(**arguments)


def test_commands_are_taken_from_whatever_yields_them() -> None:
    for given in ((-1, 0, 1), [-1.0, 0.0, 1.0], np.linspace(-1, 1, 3), map(float, (-1, 0, 1))):
        assert Training(Cartpole(), None, commands=given).commands == (-1.0, 0.0, 1.0)  # type: ignore[arg-type]


def test_an_unknown_shadowing_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="shadowing: expected True, False or 'drawn', got 'bogus'"):
        Training(Cartpole(), None, shadowing="bogus")  # type: ignore[arg-type]


def test_what_conditions_deliver_decides_the_fingerprint() -> None:
    """Its labels may be the same, as those of patterns are."""
    timeline = timeline_of()
    conditions = tuple(replace(each, electrodes=((7 + i,),)) for i, each in enumerate(timeline.conditions))
    others = replace(timeline, conditions=conditions)
    first, second = (describe_training(SHORT, each) for each in (timeline, others))
    assert first["fingerprint"] != second["fingerprint"] == describe_training(SHORT, replace(others))["fingerprint"]
    assert "electrodes" in str(first_difference(first, second, ignoring=("fingerprint",)))


@pytest.mark.parametrize("first_min", [33.1, 0.7, 1234.567])
def test_simulators_change_with_the_chunk_whatever_the_minutes(first_min: float) -> None:
    timeline = timeline_of(tuple(round(first_min + 10.0 * i, 3) for i in range(6)))
    training = replace(SHORT, duration_min=60.0)
    rows = [timeline.row_at(first_min + training.minute(i)) for i in range(60)]
    assert rows == [i // 10 for i in range(60)]


@pytest.mark.parametrize(
    ("minutes", "unused"),
    [
        ([0.0], []),
        ([0.0, 10.0, 20.0], []),
        ([7.0, 607.0, 617.0, 627.0], [617.0]),
        ([0.0, 10.0, 20.0, 1440.0, 1450.0, 1460.0], [10.0, 1440.0, 1450.0]),
        ([10.0 * n for n in range(60)], []),
        ([10.0 * n for n in range(61)], [590.0]),
    ],
)
def test_the_newest_recording_is_always_used_and_those_that_are_not_are_named(
    minutes: list[float], unused: list[float]
) -> None:
    timeline = replace(timeline_of(), start_min=np.array(minutes))
    asked = replace(SHORT, duration_min=None)
    lasting = asked.with_duration_of(timeline)
    used = {float(timeline.start_min[timeline.row_at(minutes[0] + lasting.minute(i))]) for i in range(CHUNKS)}
    assert minutes[-1] in used and [each for each in minutes if each not in used] == unused
    found = asked.unused_recordings(timeline)
    assert [each.value for each in found] == [len(unused)] * bool(unused)
    for finding in found:
        assert ", ".join(f"{minute:g} min" for minute in unused) in finding.message
    assert lasting.unused_recordings(timeline) == replace(asked, shadowing=False).unused_recordings(timeline) == ()


@pytest.mark.parametrize("policies", [MOST_POLICIES + 1, "2", None])
def test_a_training_of_an_impossible_number_of_policies_lacks_none(tmp_path: Path, policies: object) -> None:
    (tmp_path / "training.json").write_text(json.dumps({"fingerprint": "a", "training": {"policies": policies}}))
    assert missing_policies(tmp_path) == (0, 0)
