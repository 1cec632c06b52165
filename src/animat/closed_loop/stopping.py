"""What ends a session before its plan is done, and in whose name."""

from __future__ import annotations

from pathlib import Path

from animat.closed_loop.tick import Ending
from animat.cultures.base import Culture
from animat.cultures.failures import describe_error
from animat.errors import UnsafeStimulus


def is_there(file: Path) -> bool:
    """Whether a file is there, asked before every trial.

    Raises:
        OSError: where that cannot be told, as in a folder that cannot be looked into.
    """
    try:
        file.stat()
    except FileNotFoundError:
        return False
    return True


class Stop(Exception):
    """The session is over before its plan is done."""

    def __init__(self, ending: Ending) -> None:
        super().__init__(ending.message)
        self.ending = ending


def ending_of(error: Exception, culture: Culture, is_stopped: bool) -> Ending:
    """The ending that an error of the culture means; `is_stopped`: whether a person stopped it before."""
    if is_stopped:
        return Ending("person", "stopped by a person")
    if isinstance(error, UnsafeStimulus) and error.limit in ("stimuli_per_session", "net_charge_per_session"):
        return Ending("budget", str(error))
    if isinstance(error, UnsafeStimulus) and culture.is_stopped:
        return Ending("culture", f"the culture was stopped: {error}")
    lost = "the connection to the culture is lost: " if _is_lost(error) else "the culture raised "
    return Ending("culture", lost + describe_error(error))


def _is_lost(error: BaseException | None) -> bool:
    """Whether an error is of a connection, or caused by one; a device that was too slow is still there."""
    if error is None:
        return False
    return (isinstance(error, OSError) and not isinstance(error, TimeoutError)) or _is_lost(error.__cause__)
