"""Early endings of a session, and their causes."""

from __future__ import annotations

from animat.closed_loop.tick import Ending
from animat.cultures.base import Culture
from animat.cultures.failures import describe_error
from animat.errors import UnsafeStimulus


class Stop(Exception):
    """The session ends before its plan is completed."""

    def __init__(self, ending: Ending) -> None:
        super().__init__(ending.message)
        self.ending = ending


def ending_of(error: Exception, culture: Culture, is_stopped: bool) -> Ending:
    """The ending for an error of the culture; `is_stopped`: whether a person had stopped it before."""
    if is_stopped:
        return Ending("person", "stopped by a person")
    if isinstance(error, UnsafeStimulus) and error.limit in ("stimuli_per_session", "net_charge_per_session"):
        return Ending("budget", str(error))
    if isinstance(error, UnsafeStimulus) and culture.is_stopped:
        return Ending("culture", f"the culture was stopped: {error}")
    lost = "the connection to the culture is lost: " if _is_lost(error) else "the culture raised "
    return Ending("culture", lost + describe_error(error))


def _is_lost(error: BaseException | None) -> bool:
    """Whether an error comes from a lost connection; a timeout does not, as the device is still there."""
    if error is None:
        return False
    return (isinstance(error, OSError) and not isinstance(error, TimeoutError)) or _is_lost(error.__cause__)
