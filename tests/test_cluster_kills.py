"""On a Dask cluster of four workers, SIGKILL of workers, schedulers and clients: always the same bits in the end."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from animat.execution.cluster import local_cluster
from animat.execution.dispatch import ATTEMPTS

distributed = pytest.importorskip("distributed", reason="distributed, of the extra [cluster], is not installed")
pytestmark = pytest.mark.long

TINY = Path(__file__).parent / "tiny_study.toml"


def started(out: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "animat", "study", str(TINY), "--out", str(out), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def contents(out: Path) -> dict[str, bytes]:
    """What may not differ by a bit: all but recordings, which NWB gives dates, and what is drawn from tables."""
    among = [*out.glob("tables/*"), *out.glob("policies/**/*"), *out.glob("jobs/*"), *out.glob("simulators/*")]
    return {str(path.relative_to(out)): path.read_bytes() for path in among if path.is_file()}


def is_complete(process: subprocess.Popen[str], out: Path, expected: dict[str, bytes]) -> bool:
    """Whether a run that is not killed completes its study; one that gives up a job is started again, as a user would.

    It gives up a job whose workers ended `ATTEMPTS` times, as a slow one may among so many kills.
    """
    said, _ = process.communicate()
    if f"ended {ATTEMPTS} times" in said:
        return False
    assert process.returncode == 0, said
    assert contents(out) == expected
    return True


def workers(file: Path) -> list[int]:
    with distributed.Client(scheduler_file=str(file), set_as_default=False) as client:
        client.wait_for_workers(1, timeout=300)
        return list(client.run(os.getpid, on_error="ignore").values())


@pytest.mark.parametrize(
    "moments",
    [
        pytest.param({"worker": 4, "scheduler": 2, "client": 2}, id="few"),
        pytest.param({"worker": 20, "scheduler": 5, "client": 5}, id="many"),
    ],
)
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "apart"])
def test_whoever_is_killed_when_a_study_is_the_same_bits(
    moments: dict[str, int], shared: bool, tiny_study: Path, tmp_path: Path
) -> None:
    expected = contents(tiny_study)
    rng, file = random.Random(5), tmp_path / "cluster.json"
    kills = [of for of, times in moments.items() for _ in range(times)]
    rng.shuffle(kills)
    on = ("--cluster", str(file), *(() if shared else ("--no-shared-folder",)))
    folders = [tmp_path / "study-0"]
    with ExitStack() as running:
        scheduler, _ = running.enter_context(local_cluster(4, file))
        process = started(folders[-1], *on)
        while kills:
            time.sleep(rng.uniform(3, 20))
            if process.poll() is not None:
                # Of a study that was over before the moment came, nothing was killed.
                if is_complete(process, folders[-1], expected):
                    folders.append(tmp_path / f"study-{len(folders)}")
                process = started(folders[-1], *on)
                continue
            of = kills.pop()
            print("killed:", of)
            if of == "worker":
                os.kill(rng.choice(workers(file)), signal.SIGKILL)
            else:
                (process if of == "client" else scheduler).kill()
                said, _ = process.communicate()
                last = said.strip().splitlines()[-1] if said.strip() else ""
                # The second, before it was connected; the third, just before it was killed.
                lines = ("has ended; start", "no scheduler answers", f"ended {ATTEMPTS} times")
                assert process.returncode in (0, -signal.SIGKILL) or any(line in last for line in lines), said
                if process.returncode == 0:
                    assert contents(folders[-1]) == expected
                    folders.append(tmp_path / f"study-{len(folders)}")
                if of == "scheduler":
                    running.close()
                    scheduler, _ = running.enter_context(local_cluster(4, file))
                process = started(folders[-1], *on)
        while not is_complete(process, folders[-1], expected):
            process = started(folders[-1], *on)
