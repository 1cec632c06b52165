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
