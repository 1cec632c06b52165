"""Ctrl-C, a polite kill and a terminal that is gone in a closed loop: asked for an end, it ends in its own time."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from animat.ctrl_c import KILLS, handled


@contextmanager
def told_instead(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` for Ctrl-C, SIGTERM and SIGHUP, in place of raising somewhere; nothing outside of the main thread.

    Ctrl-C and SIGHUP are left alone where they are ignored.
    """
    with handled((signal.SIGINT, *KILLS), lambda *_: stop()):
        yield
