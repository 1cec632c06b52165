"""Ctrl-C, SIGTERM and a closed terminal: each ends a command with an exception, whatever Python is executing.

Signals that are ignored when the program starts stay ignored, as with `nohup` and in a script's background jobs, but
SIGTERM always ends it.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from traceback import walk_stack
from types import FrameType
from typing import Any

# A hang-up comes when the terminal closes (a lost ssh session); not every system has it.
KILLS = (signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))

_RETRY_S = 0.05
_LONGEST_IMPORT_S = 10.0


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt, a moment later if Python would drop it.

    An exception in a callback of the garbage collector (JAX has one) or in a finaliser goes to a hook, and Python
    carries on as if nothing had happened. An import is not cut short unless it takes long: a half-imported module may
    crash as Python exits, and libraries turn the exception into another. Ctrl-C is left alone if it did not raise
    before.
    """
    previous_hook, waits_since_s, will_retry = sys.unraisablehook, 0.0, False

    def retry() -> None:
        nonlocal will_retry
        if not will_retry:
            will_retry = True
            _thread.start_new_thread(retry_later, ())

    def retry_later() -> None:
        nonlocal will_retry
        time.sleep(_RETRY_S)
        will_retry = False
        # SIGTERM is never ignored; if nobody handles it any more, the command has ended.
        if signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
            os.kill(os.getpid(), signal.SIGTERM)

    def interrupt(_number: int, frame: FrameType | None) -> None:
        nonlocal waits_since_s
        waits_since_s = waits_since_s or time.monotonic()
        if not _is_importing(frame) or time.monotonic() > waits_since_s + _LONGEST_IMPORT_S:
            waits_since_s = 0.0
            raise KeyboardInterrupt
        # `Thread` cannot be used: it takes a lock that the interrupted code may hold.
        retry()

    def hook(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            retry()
        else:
            previous_hook(unraisable)

    raising = (signal.SIGINT,) if signal.getsignal(signal.SIGINT) is signal.default_int_handler else ()
    with handled((*raising, *KILLS), interrupt):
        sys.unraisablehook = hook
        try:
            yield
        finally:
            sys.unraisablehook = previous_hook


@contextmanager
def handled(numbers: tuple[signal.Signals, ...], handler: Callable[..., None]) -> Iterator[None]:
    """Handle these signals, except an ignored Ctrl-C or SIGHUP; outside the main thread handle none."""
    # Only the main thread may set handlers, and only it is interrupted.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = tuple(n for n in numbers if n == signal.SIGTERM or signal.getsignal(n) != signal.SIG_IGN)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)


def _is_importing(frame: FrameType | None) -> bool:
    # `walk_stack(None)` would walk the stack of its own caller.
    return frame is not None and any(
        each.f_code.co_filename == "<frozen importlib._bootstrap>" for each, _ in walk_stack(frame)
    )
