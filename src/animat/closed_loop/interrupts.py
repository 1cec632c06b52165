"""Ctrl-C, a polite kill and a terminal that is gone: whoever asks for an end must not leave a culture as it is.

What is ignored when the program starts stays ignored: `nohup` has it go on when the terminal is gone, and a script has
its jobs in the background go on when Ctrl-C ends what is in front. SIGTERM always ends it.
"""

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
    """Call `stop` for Ctrl-C, SIGTERM and SIGHUP, in place of raising somewhere; nothing outside of the main thread.

    Ctrl-C and SIGHUP are left alone where they are ignored.
    """
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
    numbers = tuple(n for n in numbers if n == signal.SIGTERM or signal.getsignal(n) != signal.SIG_IGN)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)
