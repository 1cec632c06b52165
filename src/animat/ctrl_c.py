"""Ctrl-C where Python would drop it: nothing can be raised in a callback of the garbage collector, such as JAX's."""

from __future__ import annotations

import gc
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_AGAIN_S = 0.05


@contextmanager
def heard_everywhere() -> Iterator[None]:
    """Let a Ctrl-C that comes where nothing can be raised come again a moment later.

    Python prints what is raised in a callback of its garbage collector or in a finaliser, and goes on as if nothing had
    been: a command would run to its end.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not _is_dropped(frame):
            raise KeyboardInterrupt
        again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
        again.daemon = True
        again.start()

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _is_dropped(frame: FrameType | None) -> bool:
    """Whether what is raised in a frame would be dropped."""
    callbacks = {getattr(callback, "__code__", None) for callback in gc.callbacks}
    while frame is not None:
        if frame.f_code in callbacks or frame.f_code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False
