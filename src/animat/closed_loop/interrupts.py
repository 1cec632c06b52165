"""Ctrl-C, SIGTERM and a lost terminal in a closed loop: they request an end instead of interrupting the loop."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from animat.ctrl_c import KILLS, handled


@contextmanager
def stop_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on Ctrl-C, SIGTERM and SIGHUP, instead of raising; has no effect outside of the main thread.

    Ctrl-C and SIGHUP stay ignored where they were ignored before.
    """
    with handled((signal.SIGINT, *KILLS), lambda *_: stop()):
        yield
