"""The errors of animat: each names the argument or file, what was expected, what came, and what to do."""

from __future__ import annotations


class AnimatError(Exception):
    """Base of every error that a user can cause and mend; the command line prints it in one line.

    The message names the argument or file, what was expected, what came, and what to do.
    """


class InvalidArgument(AnimatError, ValueError):
    """An argument, option or configuration value is outside what it may be."""


class InvalidFile(AnimatError):
    """A file is missing, damaged, of another kind, or does not hold what it should."""


class UnusableData(AnimatError):
    """Data were read, but what was asked of them cannot be done (a dead window, no stimuli, an empty condition)."""


class Mismatch(AnimatError):
    """Two things that must belong together do not (a policy for another robot, conditions of another recording)."""


class UnsafeStimulus(AnimatError):
    """A stimulus is outside what the culture's safety limits allow; nothing of the request was delivered.

    Attributes:
        limit: the name of the limit, a field of `animat.cultures.safety.Limits` or `"sites"`, `"overlap"`, `"stopped"`.
    """

    def __init__(self, limit: str, message: str) -> None:
        super().__init__(f"{limit}: {message}; nothing was delivered")
        self.limit = limit


class BudgetSpent(AnimatError):
    """A stimulation budget does not hold what was asked for; nothing of the request was delivered."""


class LoopEnded(AnimatError):
    """A closed loop ended before its time, by a fault or a person; all of its ticks are in its folder."""


class DeviceFailed(AnimatError):
    """A device cannot be used or failed while it was (no driver, no connection, a pulse that did not come)."""
