"""On a Dask cluster: two workers over TCP on loopback, the same bits as without, whoever is killed when."""

from __future__ import annotations

import json
import logging
import os
import pickle
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TextIO

import pytest

from animat.cli import _parse, main
from animat.errors import AnimatError, InvalidFile, Mismatch
from animat.execution.cluster import Cluster, local_cluster
from animat.execution.dask_worker import _own_cores, versions_tag
from animat.execution.dispatch import Call
from animat.execution.jobs import PLANNED, Job, Jobs
from animat.execution.task import Task, bring_back, carry_out_unshared, store
from animat.progress import Progress, Silent
from worker_tasks import Fail, Join, Sized, describe_process, rest

TINY = Path(__file__).parent / "tiny_study.toml"


def test_without_dask_or_a_scheduler_it_is_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["study", str(TINY), "--out", str(tmp_path / "out"), "--cluster", str(tmp_path / "no.json")]
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(command) == 1
    assert capsys.readouterr().err == (
        "animat: --cluster: expected the package Dask, which is not installed: "
        f"{shlex.quote(sys.executable)} -m pip install 'animat[cluster]'\n"
    )
    assert not (tmp_path / "out").exists()


def test_while_no_scheduler_answers_a_line_says_what_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logger = logging.getLogger("distributed")
    monkeypatch.setattr(logger, "level", logging.INFO)
    monkeypatch.setattr("animat.execution.cluster._CONNECT_S", 0.3)
    with pytest.raises(AnimatError, match="no scheduler answers"):
        Cluster("tcp://127.0.0.1:9")
    assert capsys.readouterr().err.count("cluster: waiting up to 0.3 s for the scheduler at tcp://127.0.0.1:9\n") == 1
    assert logger.level == logging.INFO


def test_a_host_that_drops_packets_is_said_to_be_waited_for_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    patience_s = []

    def drop(_: tuple[str, int], timeout: float) -> NoReturn:
        patience_s.append(timeout)
        raise TimeoutError("timed out")

    monkeypatch.setattr("animat.execution.cluster._CONNECT_S", 0.3)
    monkeypatch.setattr("socket.create_connection", drop)
    with pytest.raises(AnimatError, match="no scheduler answers"):
        Cluster("tcp://127.0.0.1:9")
    assert patience_s[0] <= 5
    assert "cluster: waiting up to 0.3 s" in capsys.readouterr().err


def test_a_worker_takes_cores_in_a_folder_of_its_own_user_and_follows_no_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("animat.execution.dask_worker._HELD", held := list[TextIO]())
    folder, victim = tmp_path / f"animat-cores-{os.getuid()}", tmp_path / "victim.txt"
    victim.write_text("all there")
    (core,) = _own_cores(1)
    assert (folder.stat().st_mode & 0o777) == 0o700
    for place in os.sched_getaffinity(0):
        (folder / str(place)).unlink(missing_ok=True)
        (folder / str(place)).symlink_to(victim)
    with pytest.raises(OSError, match="symbolic links"):
        _own_cores(1)
    shutil.rmtree(folder)
    (tmp_path / "elsewhere").mkdir()
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InvalidFile, match="expected a folder of this user, got another user's or a link"):
        _own_cores(1)
    assert victim.read_text() == "all there" and core in os.sched_getaffinity(0)
    held.pop().close()


def test_a_file_that_came_back_damaged_is_a_line(tmp_path: Path) -> None:
    store(tmp_path, {})
    result, contents = carry_out_unshared(Join("a"), {}, tmp_path)
    assert bring_back(tmp_path, result, contents) == result
    assert (tmp_path / "a").read_text() == "(a)"
    with pytest.raises(InvalidFile, match="/a: expected the file that the worker wrote, got a different one"):
        bring_back(tmp_path, result, {"a": b"(b)"})


def test_the_page_has_commands_that_animat_knows() -> None:
    page = (Path(__file__).parents[1] / "docs" / "cluster.md").read_text()
    commands = re.findall(r"^(?:`| +)?animat ([a-z][^&#`\n]+)", page, re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        _parse(shlex.split(command))


distributed = pytest.importorskip("distributed", reason="distributed, of the extra [cluster], is not installed")
oracle = pytest.mark.oracle


def test_a_place_that_is_no_scheduler_s_is_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cluster.json").write_text("{")
    for where, words in (
        (
            "no.json",
            "animat: --cluster: expected a scheduler's address, such as tcp://host:8786, or its file, got 'no.json'",
        ),
        ("tcp://myhost", "an address that ends in a port, such as tcp://host:8786, got tcp://myhost"),
        ("myhost:", "an address that ends in a port, such as tcp://host:8786, got myhost:"),
        (str(tmp_path / "cluster.json"), "expected a scheduler's file, got one without an address"),
    ):
        assert main(["study", str(TINY), "--out", str(tmp_path / "out"), "--cluster", where]) == 1
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_scheduler_s_file_may_be_in_a_new_folder_and_is_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def start(_: str, file: Path, *options: str) -> Any:
        made.append(file.parent.is_dir())
        raise AnimatError("stopped")

    monkeypatch.setattr("animat.execution.cluster._start", start)
    for file, said in (
        (tmp_path / "new" / "cluster.json", "stopped"),
        (tmp_path, f"{tmp_path}: expected no file, got a folder"),
    ):
        assert main(["cluster", "local", "--file", str(file)]) == 1
        assert capsys.readouterr().err == f"animat: {said}\n"
    assert made == [True]


@dataclass
class Running:
    """A cluster that runs: its file, and the processes of the scheduler and of what looks after the workers."""

    file: Path
    processes: list[subprocess.Popen[bytes]]

    def workers(self) -> list[int]:
        """Their processes."""
        with distributed.Client(scheduler_file=str(self.file), set_as_default=False) as client:
            return list(client.run(os.getpid, on_error="ignore").values())


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    file = tmp_path_factory.mktemp("cluster") / "cluster.json"
    with local_cluster(2, file) as processes, distributed.Client(scheduler_file=str(file)) as client:
        client.wait_for_workers(2, timeout=300)
        yield Running(file, processes)


def run(jobs: list[Job], folder: Path, executor: Any) -> set[str]:
    """Which jobs were run."""
    left = Jobs(jobs, folder, folder / "jobs", "study")
    return set(left.run(workers=None, executor=executor, progress=Silent()))


@dataclass(frozen=True)
class Tried(Sized):
    """Writes a line whenever it is tried, and then fails as often as is said."""

    log: Path
    times: int

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        with self.log.open("a") as file:
            file.write("tried\n")
        if self.log.read_text().count("tried") > self.times:
            return [self.log]
        raise InvalidFile("a.nwb: expected a recording, got none")


@oracle
def test_each_has_a_core_and_jobs_come_in_order(running: Running, tmp_path: Path) -> None:
    with Cluster(running.file) as cluster:
        processes = [future.result() for future in [cluster.submit(describe_process) for _ in range(6)]]
        assert all(len(cores) == 1 for _, cores in processes)
        assert len({process for process, _ in processes}) <= 2
        jobs = [Job(name, Join(name, tuple(of)), tuple(of)) for name, of in (("a", ""), ("b", "a"), ("c", "ab"))]
        assert run(jobs, tmp_path, cluster) == {"a", "b", "c"}
        assert (tmp_path / "c").read_text() == "(c(a)(b(a)))"
    # Another client gets another process: what it has imported may have changed.
    with Cluster(running.file) as cluster:
        assert cluster.submit(describe_process).result()[0] not in {process for process, _ in processes}


@oracle
def test_what_fails_twice_is_done_and_thrice_is_reported(running: Running, tmp_path: Path) -> None:
    jobs = [
        Job("twice", Tried(tmp_path / "twice", 2)),
        Job("thrice", Tried(tmp_path / "thrice", 3), cost_s=8),
        Job("in vain", Join("in vain", ("thrice",)), ("thrice",)),
        Job("other", Join("other")),
    ]
    words = "^thrice: a.nwb: expected a recording, got none; not run, as they need failed jobs: 1$"
    with Cluster(running.file) as cluster, pytest.raises(AnimatError, match=words):
        run(jobs, tmp_path, cluster)
    assert (tmp_path / "thrice").read_text().count("tried") == 3
    assert {path.stem for path in (tmp_path / "jobs").iterdir()} == {"twice", "other"}
    assert [*json.loads((tmp_path / ".unfinished" / PLANNED).read_text())] == [job.name for job in jobs]


@oracle
def test_what_goes_wrong_with_one_result_is_reported_and_the_others_arrive(running: Running) -> None:
    def fail(_: float) -> NoReturn:
        raise OSError("too many open files")

    def call(takes_s: float, finish: Callable[[float], float] | None = None) -> Call:
        pickled = pickle.dumps((rest, (takes_s,), {}))
        return Call("rest", lambda _: pickled, cost_s=0.01, finish=finish)

    with Cluster(running.file) as cluster:
        # Both workers are busy at first, so that the others go in batches.
        calls = [call(1.0), call(1.0), *(call(0.0, fail if i == 3 else None) for i in range(60))]
        futures = [cluster._submit(each) for each in calls]
        assert not wait(futures, timeout=60).not_done
        assert [i for i, future in enumerate(futures) if future.exception() is not None] == [5]
        assert isinstance(futures[5].exception(), OSError)


@oracle
def test_small_tasks_go_together_each_with_its_receipt(
    running: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[int] = []
    submit = distributed.Client.submit

    def counting(client: Any, function: Any, calls: list[bytes], *args: Any, **settings: Any) -> Any:
        sent.append(len(calls))
        return submit(client, function, calls, *args, **settings)

    monkeypatch.setattr(distributed.Client, "submit", counting)
    names = [str(i) for i in range(80)]
    jobs = [Job(name, Join(name), cost_s=0.02) for name in names]
    jobs[7] = Job("7", Fail(), cost_s=0.02)
    jobs.append(Job("long", Join("long"), cost_s=100))
    with Cluster(running.file) as cluster, pytest.raises(InvalidFile, match=r"^7: a\.nwb: expected"):
        run(jobs, tmp_path, cluster)
    assert {path.stem for path in (tmp_path / "jobs").iterdir()} == {*names, "long"} - {"7"}
    assert len(sent) < 40 and sum(sent) >= 81 + 2
    assert sent[0] == 1, "what takes long goes alone"
    # What takes longer than was said does not wait for its batch: the other worker takes it.
    sent.clear()
    with Cluster(running.file, longest_s=0.3) as cluster:
        jobs = [Job(f"slow {name}", Join(f"slow {name}", takes_s=0.2), cost_s=0.001) for name in names[:20]]
        assert len(run(jobs, tmp_path, cluster)) == 20
    assert sum(sent) > 20


@dataclass(frozen=True)
class Ends(Sized):
    """Writes a line, waits for others to run too, and ends its process or the worker."""

    log: Path
    worker: bool

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        with self.log.open("a") as file:
            file.write("tried\n")
        time.sleep(0.5)
        os.kill(os.getppid() if self.worker else os.getpid(), signal.SIGKILL)
        time.sleep(60)
        return []


@pytest.mark.long
def test_what_kills_is_reported_and_what_ran_beside_it_is_done(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "cluster.json"
    with local_cluster(1, file, threads=3):
        with distributed.Client(scheduler_file=str(file)) as client:
            client.wait_for_workers(1, timeout=300)
        for worker in (False, True):
            folder = tmp_path / str(worker)
            folder.mkdir()
            log = folder / "log"
            # Two run when it ends its worker, one more waits in a batch behind it.
            jobs = [Job("ends", Ends(log, worker), cost_s=2), Job("behind", Join("behind"), cost_s=0.1)]
            jobs += [Job(name, Join(name, takes_s=1), cost_s=10) for name in "ab"]
            with Cluster(file) as cluster, pytest.raises(AnimatError) as raised:
                run(jobs, folder, cluster)
            how = r"worker tcp://\S+ ended" if worker else r"its process ended with status -9, on \S+"
            words = rf"ends: its process or worker ended 3 times, last: {how} \(is there enough memory\? .*"
            assert re.fullmatch(words, str(raised.value))
            assert log.read_text().count("tried") == 3
            assert {path.stem for path in (folder / "jobs").iterdir()} == {"a", "b", "behind"}
    said = capfd.readouterr().err
    assert (
        len(re.findall(r"^warning: cluster: worker tcp://\S+ ended; its tasks \(\d\) go to others$", said, re.M)) == 3
    )
    assert (
        len(re.findall(r"^warning: cluster: ends: its process ended with status -9, on \S+; trying again$", said, re.M))
        == 2
    )


@pytest.mark.long
def test_a_frozen_worker_and_a_frozen_scheduler_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("animat.execution.dispatch._SILENT_S", 3)
    file = tmp_path / "cluster.json"
    with local_cluster(2, file) as (scheduler, _), Cluster(file) as cluster:
        with distributed.Client(scheduler_file=str(file), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=300)
            frozen = next(iter(client.run(os.getpid).values()))
        futures = [cluster.submit(rest, 2.0) for _ in range(4)]
        os.kill(frozen, signal.SIGSTOP)
        try:
            assert [future.result() for future in futures] == [2.0] * 4
        finally:
            os.kill(frozen, signal.SIGCONT)
        assert re.search(
            r"worker tcp://\S+ has been silent for 3 s \(frozen, or cut off\); its tasks", capfd.readouterr().err
        )
        scheduler.send_signal(signal.SIGSTOP)
        time.sleep(5)
        scheduler.send_signal(signal.SIGCONT)
        assert cluster.submit(rest, 0.0).result() == 0.0
        said = "warning: cluster: the scheduler has not answered for 3 s; waiting for it\n"
        assert said in capfd.readouterr().err


@oracle
def test_all_failures_are_reported_at_the_end(running: Running, tmp_path: Path) -> None:
    tasks: list[Task] = [Fail(), Fail(), Join("other")]
    with Cluster(running.file) as cluster, pytest.raises(InvalidFile, match=r"^0: a\.nwb: .*; 1: a\.nwb: .* none$"):
        run([Job(str(i), task) for i, task in enumerate(tasks)], tmp_path, cluster)
    assert (tmp_path / "other").exists()


@oracle
def test_a_worker_of_another_version_is_named_and_gets_nothing(
    running: Running, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = versions_tag().replace("animat:", "animat:0.0.")
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(running.file)]
    with subprocess.Popen([*worker, "--no-dashboard", "--nthreads", "9", "--resources", f"{other}=9"]) as process:
        with distributed.Client(scheduler_file=str(running.file), set_as_default=False) as client:
            client.wait_for_workers(3, timeout=300)
        with Cluster(running.file) as cluster:
            warned = capsys.readouterr().err
            processes = [future.result() for future in [cluster.submit(describe_process) for _ in range(12)]]
        process.terminate()
    assert len({pid for pid, _ in processes}) <= 2
    assert re.fullmatch(r"warning: worker tcp://\S+: expected animat 0\.1\S+, jax .*, got animat 0\.0\..*\n", warned)


@oracle
def test_where_all_are_of_another_version_it_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.execution.cluster.versions_tag", lambda: "animat:9/Python:3.99")
    with local_cluster(1, tmp_path / "cluster.json"):
        with distributed.Client(scheduler_file=str(tmp_path / "cluster.json"), set_as_default=False) as client:
            client.wait_for_workers(1, timeout=300)
        with pytest.raises(Mismatch, match=r"expected animat 9, Python 3\.99, got animat 0\..*there is no other"):
            Cluster(tmp_path / "cluster.json")


def started(out: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "animat", "study", str(TINY), "--out", str(out), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(out: Path, *options: str) -> None:
    process = started(out, *options)
    said, _ = process.communicate()
    assert process.returncode == 0, said


def contents(out: Path) -> dict[str, bytes]:
    """What may not differ by a bit: all but recordings, which NWB gives dates, and what is drawn from tables."""
    among = [*out.glob("tables/*"), *out.glob("policies/**/*"), *out.glob("jobs/*"), *out.glob("simulators/*")]
    return {str(path.relative_to(out)): path.read_bytes() for path in among if path.is_file()}


@oracle
def test_a_study_is_the_same_bits_with_workers_and_clients_killed(
    running: Running, tiny_study: Path, tmp_path: Path
) -> None:
    out, on, rng = tmp_path / "study", ("--cluster", str(running.file)), random.Random(1)
    for of in ("worker", "client", "worker", "client"):
        process = started(out, *on)
        done = len(list(out.glob("jobs/*")))
        while process.poll() is None and len(list(out.glob("jobs/*"))) < done + rng.randrange(1, 4):
            time.sleep(rng.random())
        if of == "worker":
            os.kill(rng.choice(running.workers()), signal.SIGKILL)
            time.sleep(5 * rng.random())
        process.kill()
        process.communicate()
    finish(out, *on)
    assert contents(out) == contents(tiny_study)


MAY_NOT = """
import os, sys
def refuse(event, args):
    if event in ("open", "os.mkdir", "os.listdir", "os.scandir", "os.rename", "os.remove", "os.link") and args:
        path = args[0].decode() if isinstance(args[0], bytes) else args[0]
        if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith({folder!r}):
            raise PermissionError(f"{{path}} is another machine's")
sys.addaudithook(refuse)
"""


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A cluster whose workers may not touch the folder `out`: Python itself refuses them. They start elsewhere too."""
    (theirs := tmp_path / "theirs").mkdir()
    (theirs / "sitecustomize.py").write_text(MAY_NOT.format(folder=str(tmp_path / "out")))
    monkeypatch.syspath_prepend(str(theirs))
    monkeypatch.chdir(theirs)
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    (tmp_path / "out").mkdir()
    with local_cluster(2, tmp_path / "cluster.json"):
        sys.path.remove(str(theirs))
        # Processes on this machine are none of theirs, also where an empty entry of the path stands for this folder.
        monkeypatch.chdir(tmp_path)
        yield tmp_path / "cluster.json"
    assert not [*theirs.rglob("animat-task-*"), *(tmp_path / "tmp").rglob("animat-task-*")]


@dataclass(frozen=True)
class Copies(Sized):
    """Copies a file, of anywhere."""

    file: Path
    reads_elsewhere: bool = True

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        (folder / "copy").write_bytes(self.file.read_bytes())
        return [folder / "copy"]


@oracle
def test_without_a_shared_folder_files_go_along_and_come_back(elsewhere: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "settings").write_text("settings")
    jobs = [
        Job("a", Join("a", ("settings",)), reads=("settings",), cost_s=0.1),
        Job("b", Join("b", ("a",)), ("a",)),
        # What comes before what it needs is there too.
        Job("c", Join("c", ("a", "b", "copy")), ("b", "copy")),
        Job("copy", Copies(out / "settings")),
    ]
    with Cluster(elsewhere, has_shared_folder=False) as cluster:
        assert run(jobs, out, cluster) == {"a", "b", "c", "copy"}
        assert (out / "c").read_text() == "(c(asettings)(b(asettings))settings)"
        with pytest.raises(AnimatError, match=r"^d: .*No such file .*/a' \(in open"):
            run([*jobs, Job("d", Join("d", ("a",)))], out, cluster)
    with Cluster(elsewhere) as cluster, pytest.raises(AnimatError, match="is another machine's"):
        run([Job("e", Join("e"))], out, cluster)


@pytest.mark.long
def test_without_a_shared_folder_a_study_is_the_same_bits(tiny_study: Path, elsewhere: Path, tmp_path: Path) -> None:
    out = tmp_path / "out" / "study"
    finish(out, "--cluster", str(elsewhere), "--no-shared-folder")
    assert contents(out) == contents(tiny_study)


@pytest.mark.long
def test_without_a_shared_folder_a_tuning_finds_the_same(elsewhere: Path, tmp_path: Path) -> None:
    best = []
    for out, options in (
        (tmp_path / "out" / "tuning", ("--cluster", str(elsewhere), "--no-shared-folder")),
        (tmp_path / "plain", ()),
    ):
        command = [sys.executable, "-m", "animat", "tune", str(TINY.with_name("tiny_tuning.toml")), "--out", str(out)]
        subprocess.run([*command, *options], check=True)
        best.append(
            {
                path.name: path.read_bytes()
                for path in [*out.glob("*.toml"), *out.glob("*.jsonl"), *out.glob("finals/*")]
            }
        )
    assert best[0] == best[1] and len(best[0]) > 3


def test_without_a_cluster_every_folder_is_shared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", str(TINY), "--out", str(tmp_path / "out"), "--no-shared-folder"]) == 1
    assert capsys.readouterr().err == "animat: --no-shared-folder: expected only with --cluster, got no cluster\n"


@oracle
def test_a_cluster_ends_where_its_scheduler_died_as_its_workers_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.execution.cluster._PATIENCE_S", 2)
    with local_cluster(1, tmp_path / "cluster.json") as (scheduler, looks_after):
        scheduler.kill()
        time.sleep(2)
    assert looks_after.returncode is not None and not (tmp_path / "cluster.json").exists()


@oracle
def test_a_dead_scheduler_is_reported_and_the_same_command_continues(tiny_study: Path, tmp_path: Path) -> None:
    out, file = tmp_path / "study", tmp_path / "cluster.json"
    with local_cluster(2, file) as (scheduler, _):
        process = started(out, "--cluster", str(file))
        while process.poll() is None and len(list(out.glob("jobs/*"))) < 3:
            time.sleep(0.1)
        scheduler.kill()
        said, _ = process.communicate()
    assert process.returncode == 1
    assert re.fullmatch(r"animat: .* has ended; start it, then run this again to continue", last(said))
    with local_cluster(2, file):
        finish(out, "--cluster", str(file))
    assert contents(out) == contents(tiny_study)


def last(said: str) -> str:
    return said.strip().splitlines()[-1]
