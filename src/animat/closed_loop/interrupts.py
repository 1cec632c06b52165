"""Ctrl-C, a polite kill and a terminal that is gone: whoever asks for an end must not leave a culture as it is."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# A hang-up comes where the terminal goes (an ssh session that breaks off); not every system has it.
_KILLS = (signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))
ASKING = (signal.SIGINT, *_KILLS)


@contextmanager
def told_instead(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` for Ctrl-C, SIGTERM and SIGHUP, in place of raising somewhere; nothing outside of the main thread."""
    with _handled(ASKING, lambda *_: stop()):
        yield


@contextmanager
def polite_kill_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise KeyboardInterrupt as Ctrl-C does: what is open is then closed, not left as it is."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with _handled(_KILLS, interrupt):
        yield


@contextmanager
def _handled(numbers: tuple[signal.Signals, ...], handler: Callable[..., None]) -> Iterator[None]:
    # Only the main thread may set handlers, and only it is interrupted.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # `nohup` has a hang-up ignored: it stays so.
    numbers = tuple(n for n in numbers if n.name != "SIGHUP" or signal.getsignal(n) != signal.SIG_IGN)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)
