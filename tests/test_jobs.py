"""Jobs: in order on any executor, done once, and what becomes of those that fail or die."""

from __future__ import annotations

import errno
import hashlib
import json
import multiprocessing
import os
import pickle
import random
import re
import shutil
import signal
import time
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.errors import AnimatError, InvalidFile
from animat.execution.jobs import PLANNED, Job, Jobs, in_order
from animat.execution.pinned import PinnedProcesses
from animat.execution.receipts import Receipt, _packed, digest_of, receipt_path
from animat.execution.task import Task, carry_out, carry_out_alone, reported
from animat.progress import Silent
from animat.recordings.findings import Finding
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.recording import Channels, Recording
from animat.stimulation.protocol import Presentation, Protocol
from animat.stimulation.stimulus import Stimuli
from synthetic_recordings import synthetic_recording
from worker_tasks import Die, Fail, Join, Killed, Starve, Stumble

CORE = min(os.sched_getaffinity(0))


class Kept:
    """A progress that keeps its updates."""

    def __init__(self) -> None:
        self.updates: list[tuple[float, float, str]] = []

    def update(self, done: float, total: float, note: str = "") -> None:
        self.updates.append((done, total, note))


def run(
    jobs: list[Job], folder: Path, executor: Executor | None = None, progress: Any = None, of: str = "study"
) -> Any:
    """Which jobs were run."""
    left = Jobs(jobs, folder, folder / "jobs", of)
    with ThreadPoolExecutor(2) as own:
        return set(left.run(workers=None, executor=executor or own, progress=progress or Silent()))


@pytest.fixture(scope="module")
def ours() -> Iterator[Executor]:
    with PinnedProcesses([CORE, CORE]) as executor:
        yield executor


def joined(name: str, *of: str, cost_s: float = 1.0, **more: Any) -> Job:
    return Job(name, Join(name, of, **more), of, cost_s)


def test_jobs_come_after_what_they_need_and_long_chains_first() -> None:
    jobs = [
        joined("short", cost_s=1.0),
        joined("end", "long", cost_s=5.0),
        joined("long", cost_s=2.0),
        joined("middle", cost_s=4.0),
    ]
    assert [job.name for job in in_order(jobs)] == ["long", "end", "middle", "short"]


@pytest.mark.parametrize("which", ["ours", "threads", "processes"])
def test_on_any_executor_each_comes_after_what_it_needs(which: str, ours: Executor, tmp_path: Path) -> None:
    if which == "ours":
        stays_open = nullcontext(ours)
    elif which == "threads":
        stays_open = ThreadPoolExecutor(3)
    else:
        stays_open = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
    rng = random.Random(1)
    needs: dict[str, tuple[str, ...]] = {}
    for i in range(12):
        needs[f"j{i}"] = tuple(rng.sample(sorted(needs), min(len(needs), rng.randrange(3))))

    def held(name: str) -> str:
        return f"({name}{''.join(held(other) for other in needs[name])})"

    jobs = [joined(name, *of) for name, of in needs.items()]
    rng.shuffle(jobs)
    with stays_open as executor:
        assert run(jobs, tmp_path, executor) == set(needs)
        assert executor.submit(len, "left open").result() == 9
    assert {name: (tmp_path / name).read_text() for name in needs} == {name: held(name) for name in needs}
    assert run(jobs, tmp_path) == set()


def test_what_is_lost_or_changed_is_done_again_and_what_rests_on_other_bytes(tmp_path: Path) -> None:
    jobs = [joined("a"), joined("b", "a"), joined("c", "b")]
    assert run(jobs, tmp_path) == {"a", "b", "c"}
    (tmp_path / "a").unlink()
    (tmp_path / "c").write_text("changed")
    # The same bytes as before: b stands on them as it did.
    assert run(jobs, tmp_path) == {"a", "c"}
    other = [Job("a", Join("a", ("x",))), *jobs[1:]]
    (tmp_path / "x").write_text("!")
    (tmp_path / "a").unlink()
    assert run(other, tmp_path) == {"a", "b", "c"}
    assert (tmp_path / "c").read_text() == "(c(b(a!)))"
    assert run(other, tmp_path, of="another study") == {"a", "b", "c"}


@pytest.mark.oracle
def test_progress_goes_up_to_all_and_says_what_runs(tmp_path: Path) -> None:
    # A run that was killed left its last words.
    stale = receipt_path(tmp_path / ".unfinished" / ".notices", "b")
    stale.parent.mkdir(parents=True)
    stale.write_text(json.dumps([0.9, "nearly"]))
    kept = Kept()
    run([joined("a", cost_s=3.0, takes_s=0.5), joined("b", "a", takes_s=0.5)], tmp_path, progress=kept)
    done = [update[0] for update in kept.updates]
    assert done == sorted(done)
    assert (done[-1], {update[1] for update in kept.updates}) == (4.0, {4.0})
    notes = {update[2] for update in kept.updates}
    assert {"0 of 2 jobs; a 50 % half", "1 of 2 jobs; b 50 % half"} <= notes
    assert not any("nearly" in note for note in notes)


@pytest.mark.oracle
def test_the_share_done_counts_jobs_of_earlier_runs(tmp_path: Path) -> None:
    first = joined("a", cost_s=3.0)
    run([first], tmp_path)
    kept = Kept()
    run([first, joined("b", "a", takes_s=0.5)], tmp_path, progress=kept)
    assert min(done / total for done, total, _ in kept.updates) >= 0.75
    assert kept.updates[-1][:2] == (4.0, 4.0)
    # Before it reports itself, or, on a busy machine, after that.
    assert kept.updates[0][2] in ("1 of 2 jobs", "1 of 2 jobs; b 50 % half")


def test_what_is_planned_and_what_it_costs_is_in_a_file_until_all_is_done(tmp_path: Path) -> None:
    jobs = [joined("b", "a", cost_s=2.5), joined("a", cost_s=0.1), Job("c/d", Fail(), ("b",))]
    for _ in ("anew", "going on"):
        with pytest.raises(InvalidFile):
            run(jobs, tmp_path)
        planned = json.loads((tmp_path / ".unfinished" / PLANNED).read_text())
        assert list(planned.items()) == [("b", 2.5), ("a", 0.1), ("c/d", 1.0)]


def test_a_task_reports_its_progress_in_a_file(tmp_path: Path) -> None:
    assert reported(tmp_path / "notice.json") is None
    done = carry_out(Join("a"), tmp_path, tmp_path / "notice.json")
    assert reported(tmp_path / "notice.json") == [0.5, "half"]
    assert list(done.files) == ["a"]


@pytest.mark.parametrize(
    ("task", "kind", "words"),
    [
        (Fail(), InvalidFile, "job: a.nwb: expected a recording, got none"),
        (
            Stumble(),
            AnimatError,
            r"job: TypeError: expected an int, got a float \(in run, worker_tasks\.py, line \d+\)",
        ),
        (
            Starve(),
            AnimatError,
            r"job: out of memory \(256. PiB more were requested\): it grows with policies \(10\), culture.channels "
            r"\(256\): reduce these, or use a machine with more memory",
        ),
        (
            Die(),
            AnimatError,
            r"job: its process ended with status 7 \(is there enough memory\? .*\); run again to continue",
        ),
        (
            Die(status=0),
            AnimatError,
            r"job: its process ended with status 0 \(code in it ended the process, .*\); run again to continue",
        ),
        pytest.param(
            Killed(),
            AnimatError,
            r"job: its process ended with status -15 \(another program ended it\); run again to continue",
            marks=pytest.mark.oracle,
        ),
    ],
)
def test_a_job_that_fails_is_named_with_why_in_one_line(
    task: Task, kind: type[AnimatError], words: str, ours: Executor, tmp_path: Path
) -> None:
    with pytest.raises(AnimatError) as raised:
        run([Job("job", task)], tmp_path, ours)
    assert type(raised.value) is kind and re.fullmatch(words, str(raised.value))
    assert run([joined("next")], tmp_path, ours) == {"next"}


def test_the_first_that_fails_ends_all_and_a_lent_executor_is_waited_for(tmp_path: Path) -> None:
    log = tmp_path / "log"
    jobs = [Job("fails", Fail(), cost_s=9.0), joined("runs", log=log, takes_s=0.5), joined("waits", log=log)]
    with ThreadPoolExecutor(2) as executor:
        with pytest.raises(InvalidFile):
            run([*jobs, *(joined(f"waits{i}", takes_s=0.2) for i in range(9))], tmp_path, executor)
        # What ran has ended, and nothing is begun after it.
        left = sorted(path.name for path in tmp_path.iterdir())
        executor.submit(len, "").result()
        assert sorted(path.name for path in tmp_path.iterdir()) == left
    said = log.read_text().splitlines()
    assert said.count("runs begins") == said.count("runs ends") == 1
    assert len(left) < 12
    # It is not done again.
    assert Jobs([joined("runs")], tmp_path, tmp_path / "jobs", "study").waiting == []


@pytest.mark.oracle
def test_ours_end_at_once_where_one_fails(tmp_path: Path) -> None:
    jobs = [Job("fails", Fail(), cost_s=9.0), joined("runs", takes_s=600.0)]
    with pytest.raises(InvalidFile, match="fails: a"):
        Jobs(jobs, tmp_path, tmp_path / "jobs", "study").run(workers=2, executor=None, progress=Silent())
    assert not (tmp_path / "runs").exists()


@pytest.mark.oracle
def test_ctrl_c_ends_processes_of_ours_that_several_plans_share(tmp_path: Path) -> None:
    class Interrupted:
        def update(self, done: float, total: float, note: str = "") -> None:
            if (tmp_path / "log").exists():
                raise KeyboardInterrupt

    jobs = [joined("runs", log=tmp_path / "log", takes_s=3.0)]
    with PinnedProcesses([CORE]) as executor, pytest.raises(KeyboardInterrupt):
        run(jobs, tmp_path, executor, Interrupted())
    assert not (tmp_path / "runs").exists()


def test_a_receipt_of_the_first_plan_is_read(tmp_path: Path) -> None:
    """As commit 5e75c96 wrote it, byte for byte: digests of later receipts rest on it."""
    text = (
        '{\n "inputs": {\n  "record": "00"\n },\n "job": "optimum/cartpole",\n'
        ' "outputs": {\n  "optima/a.csv": "11"\n },\n "study": "22"\n}\n'
    )
    (tmp_path / "optimum+cartpole.json").write_text(text)
    receipt = Receipt.load(tmp_path, "optimum/cartpole")
    assert receipt == Receipt("optimum/cartpole", "22", {"record": "00"}, {"optima/a.csv": "11"})
    receipt.save(tmp_path)
    assert (tmp_path / "optimum+cartpole.json").read_text() == text
    (tmp_path / "optimum+cartpole.json").write_text("{")
    with pytest.raises(InvalidFile, match="expected a job's receipt"):
        Receipt.load(tmp_path, "optimum/cartpole")


def test_no_two_jobs_have_one_receipt(tmp_path: Path) -> None:
    """Names of robots and conditions may hold dots, spaces and dashes."""
    jobs = ["optimum/cartpole/over-time", "optimum/cartpole.over-time", "optimum.cartpole/over-time"]
    assert len({receipt_path(tmp_path, job) for job in jobs}) == 3


@pytest.mark.oracle
def test_a_recording_is_known_by_what_it_says_not_by_what_nwb_adds(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("again", 1), ("other", 2)):
        write_nwb(synthetic_recording(seed, patterns=5, channels=16), tmp_path / f"{name}.nwb")
    made, again, other = (tmp_path / f"{name}.nwb" for name in ("a", "again", "other"))
    assert made.read_bytes() != again.read_bytes()
    assert digest_of(made) == digest_of(again) != digest_of(other)
    receipt = Receipt("record", "22", {}, {"a.nwb": digest_of(made)})
    shutil.copy(again, made)
    assert receipt.changed(tmp_path) == []
    shutil.copy(other, made)
    assert receipt.changed(tmp_path) == ["a.nwb"]
    made.write_bytes(made.read_bytes()[:1000])
    assert receipt.changed(tmp_path) == ["a.nwb"]


def test_a_recording_s_digest_rests_on_all_of_it_and_on_no_version_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    channels = Channels(np.array(["a", "b"]), np.array([7, 9]), np.zeros(2), np.ones(2))
    stimuli = Stimuli(np.array([0.5, 1.0]), np.array([5.0, 5.0]), np.array([0, 1]), np.array([[1], [2]]), np.arange(2))
    numbers = {"sampling_rate_hz": 20_000.0, "start_s": 0.0, "duration_s": 2.0, "start_min": 1.0}
    of = Recording(
        np.array([0.6, 1.1]), np.array([0, 1]), channels, stimuli, **numbers, presentation=Presentation("blocked")
    )

    def digest(recording: Recording) -> str:
        return hashlib.sha256(_packed(recording)).hexdigest()

    # As commit fdbeb56 found it: with another one, finished recordings would be made again.
    assert digest(of) == "b5e812e3eac6cf6f4d641e67ddb8265a3ccbf7517db39a4752276ffd2bad8718"
    others: list[dict[str, Any]] = [{name: number + 0.25} for name, number in numbers.items()]
    others += [{"presentation": each} for each in (None, Presentation("mixed"), Presentation("blocked", 2))]
    others += [{"spike_times_s": of.spike_times_s + 0.1}, {"spike_channels": 1 - of.spike_channels}]
    others += [{"provenance": {"rig": "1"}}, {"findings": (Finding("noisy", "warning", "very"),)}]
    others += [{"protocol": Protocol((5.0,))}, {"channels": replace(channels, label=np.array(["a", "c"]))}]
    others += [{"channels": replace(channels, **{name: np.arange(2)})} for name in ("electrode", "x_um", "y_um")]
    for name in ("time_s", "frequency_hz", "pattern", "electrodes", "presentation"):
        others.append({"stimuli": replace(stimuli, **{name: getattr(stimuli, name) + 1})})
    assert len({digest(of), *(digest(replace(of, **other)) for other in others)}) == 1 + len(others)
    # For numpy 2.0 every keyword is an array, which it writes.
    written: dict[str, Any] = {}
    monkeypatch.setattr(np, "savez", lambda file, **arrays: written.update(arrays))
    _packed(of)
    assert len(written) == 12 and all(isinstance(array, np.ndarray) for array in written.values())


@pytest.mark.oracle
@pytest.mark.parametrize("freezes", [False, True])
def test_a_task_at_work_elsewhere_is_waited_for_unless_it_is_frozen(
    freezes: bool, ours: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.execution.task.SILENT_S", 1.0 if freezes else 60.0)
    (notice := tmp_path / "notices" / "a.json").parent.mkdir()
    log, thawed = tmp_path / "log", tmp_path / "thawed"
    task = Join("a", log=log, until=thawed) if freezes else Join("a", log=log, takes_s=0.5)
    elsewhere = ours.submit(carry_out_alone, task, tmp_path, notice)
    # The file is there before its first line.
    while not (log.exists() and log.read_text()):
        time.sleep(0.01)
    (at_work,) = [pid for pid in children() if str(notice.with_suffix(".lock")) in open_files(pid)]
    if freezes:
        os.kill(at_work, signal.SIGSTOP)
    try:
        carry_out_alone(Join("a", log=log), tmp_path, notice)
    finally:
        thawed.touch()
        os.kill(at_work, signal.SIGCONT)
    elsewhere.result()
    order = ["begins", "begins", "ends", "ends"] if freezes else ["begins", "ends", "begins", "ends"]
    assert [line.split()[1] for line in log.read_text().splitlines()] == order
    assert (tmp_path / "a").read_text() == "(a)"


def test_a_folder_that_is_gone_may_have_been_removed_or_be_out_of_sight(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    with pytest.raises(InvalidFile, match=r"gone: expected .* does not see it, or it was removed during the work"):
        carry_out_alone(Join("a"), gone, gone / ".notices" / "a")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        pytest.param(
            OSError(errno.EMFILE, os.strerror(errno.EMFILE)),
            r"job: .*Too many open files \(.*`ulimit -n` raises",
            marks=pytest.mark.oracle,
        ),
        (pickle.PicklingError("not a function"), "^job: PicklingError: not a function; run again to continue$"),
        (MemoryError(), r"^job: MemoryError: .* \(is there enough memory\? it grows with .*\); run again to continue$"),
        (OSError(errno.ENOMEM, "no memory"), r"^job: OSError: .* \(is there enough memory\? .*\); run again"),
    ],
)
def test_what_an_executor_raises_is_taken_for_too_little_memory_only_where_it_is(
    error: Exception, words: str, tmp_path: Path
) -> None:
    class Full(ThreadPoolExecutor):
        def submit(self, *_: Any, **__: Any) -> Any:
            future: Future[Any] = Future()
            future.set_exception(error)
            return future

    with Full() as executor, pytest.raises(AnimatError, match=words) as raised:
        run([Job("job", Join("a"))], tmp_path, executor)
    assert ("memory" in str(raised.value)) == ("memory" in words)


def children() -> list[int]:
    return [int(pid) for file in Path("/proc/self/task").glob("*/children") for pid in file.read_text().split()]


def open_files(pid: int) -> set[str]:
    return {str(each.readlink()) for each in Path(f"/proc/{pid}/fd").iterdir()}
