"""Ctrl-C, a polite kill and a terminal that is gone: each ends a command by an exception, wherever Python is just then.

What is ignored when the program starts stays ignored: `nohup` has it go on when the terminal is gone, and a script has
its jobs in the background go on when Ctrl-C ends what is in front. SIGTERM always ends it.
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
from types import FrameType
from typing import Any

# A hang-up comes where the terminal goes (an ssh session that breaks off); not every system has it.
KILLS = (signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))

_AGAIN_S = 0.05
_LONGEST_IMPORT_S = 10.0


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt, a moment later where Python would drop it.

    What is raised in a callback of the garbage collector (JAX has one) or in a finaliser is told to a hook, and Python
    goes on as if nothing had been. An import is not cut short, unless it takes long: what is half imported may crash as
    Python exits, and libraries make another error of it. Ctrl-C is left alone where it does not raise already.
    """
    told, waits_since_s, is_asking = sys.unraisablehook, 0.0, False

    def ask_again() -> None:
        nonlocal is_asking
        if not is_asking:
            is_asking = True
            _thread.start_new_thread(in_a_moment, ())

    def in_a_moment() -> None:
        nonlocal is_asking
        time.sleep(_AGAIN_S)
        is_asking = False
        _raise_again()

    def interrupt(_number: int, frame: FrameType | None) -> None:
        nonlocal waits_since_s
        waits_since_s = waits_since_s or time.monotonic()
        if not _is_importing(frame) or time.monotonic() > waits_since_s + _LONGEST_IMPORT_S:
            waits_since_s = 0.0
            raise KeyboardInterrupt
        # Not a `Thread`: it takes a lock, which what was interrupted may hold.
        ask_again()

    def dropped(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            ask_again()
        else:
            told(unraisable)

    raising = (signal.SIGINT,) if signal.getsignal(signal.SIGINT) is signal.default_int_handler else ()
    with handled((*raising, *KILLS), interrupt):
        sys.unraisablehook = dropped
        try:
            yield
        finally:
            sys.unraisablehook = told


@contextmanager
def handled(numbers: tuple[signal.Signals, ...], handler: Callable[..., None]) -> Iterator[None]:
    """Handle these signals, but not Ctrl-C and SIGHUP where they are ignored, and none outside of the main thread."""
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


def _raise_again() -> None:
    # Of the signals here it is never ignored; where nobody handles it any more, the command has ended.
    if signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        os.kill(os.getpid(), signal.SIGTERM)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False
