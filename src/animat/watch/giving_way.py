"""Beside a closed loop that runs: the page is answered with what the loop leaves of the cores."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_T = TypeVar("_T")


def give_way() -> None:
    """Let the calling thread run only where nothing else wants its core, as far as the system can (Linux)."""
    if hasattr(os, "SCHED_IDLE"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


class Answering:
    """Threads that answer: ordinary ones, and one that gives way, as a thread may not come back from that."""

    def __init__(self) -> None:
        self._giving_way = ThreadPoolExecutor(1, "giving-way", initializer=give_way)

    async def run(self, answer: Callable[[], _T], *, beside_a_loop: bool) -> _T:
        """What a call returns, made beside the event loop.

        Args:
            answer: is called.
            beside_a_loop: whether a closed loop runs that needs the cores more.
        """
        threads = self._giving_way if beside_a_loop else None
        return await asyncio.get_running_loop().run_in_executor(threads, answer)
