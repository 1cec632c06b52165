"""Pinned processes: an executor as the others of Python, one process a core, kept while it is small."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, ThreadPoolExecutor
from pathlib import Path

import pytest

from animat import process
from animat.errors import UnsafeStimulus
from animat.execution.pinned import PinnedProcesses
from worker_tasks import describe_process, die, refuse, rest

CORE = min(os.sched_getaffinity(0))


@pytest.fixture(scope="module")
def one() -> Iterator[Executor]:
    with PinnedProcesses([CORE]) as executor:
        yield executor


@pytest.mark.oracle
@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="the processes of others are not known here")
def test_a_run_takes_the_cores_that_others_leave(one: Executor, monkeypatch: pytest.MonkeyPatch) -> None:
    one.submit(divmod, 7, 2).result()
    assert process._pinned_processes()[CORE] >= 1
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2, 5}, raising=False)
    monkeypatch.setattr(process, "_pinned_processes", lambda: Counter({0: 2, 1: 1, 5: 1}))
    of_each = [process.own_cores(most) for most in (1, 2, 3, 4, 9, None)]
    assert of_each == [[2], [1, 2], [1, 2, 5], [0, 1, 2, 5], [0, 1, 2, 5], [0, 1, 2, 5]]


@pytest.mark.parametrize("make", [lambda: PinnedProcesses([CORE]), lambda: ThreadPoolExecutor(1)])
def test_it_keeps_to_the_contract_of_an_executor(make: Callable[[], Executor]) -> None:
    with make() as executor:
        assert list(executor.map(divmod, (7, 8, 9), (2, 3, 4))) == [(3, 1), (2, 2), (2, 1)]
        with pytest.raises(ZeroDivisionError):
            executor.submit(divmod, 1, 0).result()
        with pytest.raises(UnsafeStimulus, match="charge: too much; nothing was delivered") as raised:
            executor.submit(refuse, "charge").result()
        assert raised.value.limit == "charge"
        slow, waiting = executor.submit(rest, 0.3), executor.submit(rest, 60.0)
        while not slow.running():
            time.sleep(0.01)
        assert waiting.cancel()
        with pytest.raises(CancelledError):
            waiting.result()
        also = executor.submit(rest, 60.0)
        executor.shutdown(cancel_futures=True)
        assert slow.result() == 0.3 and also.cancelled()
        with pytest.raises(RuntimeError, match="cannot schedule new futures after shutdown"):
            executor.submit(rest, 0.0)


@pytest.mark.oracle
def test_a_process_stays_until_it_has_grown_large(one: Executor) -> None:
    first, second, third = (one.submit(describe_process, mib).result() for mib in (0, 900, 0))
    assert first == second
    assert first[0] != third[0]
    assert first[1] == third[1] == [CORE]


def test_ctrl_c_of_the_terminal_does_not_reach_a_process(one: Executor) -> None:
    process, _ = one.submit(describe_process).result()
    assert os.getpgid(process) != os.getpgid(0)


def test_work_whose_process_dies_fails_and_the_next_gets_another_process(one: Executor) -> None:
    with pytest.raises(BrokenExecutor, match="its process ended with status 7"):
        one.submit(die).result()
    assert one.submit(rest, 0.0).result() == 0.0


@pytest.mark.oracle
def test_left_by_an_error_it_ends_what_runs() -> None:
    with pytest.raises(ValueError, match="no"), PinnedProcesses([CORE, CORE]) as executor:
        process, _ = executor.submit(describe_process).result()
        running = [executor.submit(rest, 600.0) for _ in range(2)]
        waiting = executor.submit(rest, 600.0)
        while not all(future.running() for future in running):
            time.sleep(0.01)
        raise ValueError("no")
    assert waiting.cancelled()
    assert all(isinstance(future.exception(), BrokenExecutor) for future in running)
    assert not Path(f"/proc/{process}").exists()
