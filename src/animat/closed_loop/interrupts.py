"""Ctrl-C and a polite kill: whoever asks for an end must not leave a culture as it is."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

ASKING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def told_instead(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` for Ctrl-C and SIGTERM, in place of raising somewhere; nothing outside of the main thread."""
    with _handled(ASKING, lambda *_: stop()):
        yield


@contextmanager
def polite_kill_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt as Ctrl-C does: what is open is then closed, and not left as it is."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with _handled((signal.SIGTERM,), interrupt):
        yield


@contextmanager
def _handled(numbers: tuple[signal.Signals, ...], handler: Callable[..., None]) -> Iterator[None]:
    # Only the main thread may set handlers, and only it is interrupted.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)
