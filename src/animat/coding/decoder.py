"""From responses to a motor command: readouts, each through the mapping with thresholds of its own."""

from __future__ import annotations

from dataclasses import dataclass

from animat.coding.mapping import N_PERCENTILES, Mapping, Numbers, namespace_of
from animat.errors import InvalidArgument
from animat.responses.readouts import ALL, Readouts


@dataclass(frozen=True)
class Decoder:
    """What a response is as a command: a number in [-1, 1] of each readout.

    Attributes:
        mapping: from the response of a readout to its command.
        readouts: the groups of channels, by default one of all (the paper).
    """

    mapping: Mapping
    readouts: Readouts = ALL

    @property
    def percentiles_shape(self) -> tuple[int, ...]:
        """Of the percentiles that `command` takes."""
        return percentiles_shape(self.readouts)

    def command(self, x: Numbers, percentiles: Numbers) -> Numbers:
        """The motor command that answers a response (see `decoded`)."""
        return decoded(self.mapping, x, percentiles)


def percentiles_shape(readouts: Readouts) -> tuple[int, ...]:
    """Of the percentiles of readouts: (11,), or (readouts, 11) for several."""
    return (N_PERCENTILES,) if len(readouts) == 1 else (len(readouts), N_PERCENTILES)


def decoded(mapping: Mapping, x: Numbers, percentiles: Numbers) -> Numbers:
    """The motor command that answers a response.

    Args:
        mapping: from the response of a readout to its command.
        x: of one readout, in Hz, any shape; of several, in the last axis, shape (..., readouts).
        percentiles: P0, P10, ..., P100 of the non-burst responses, in Hz, shape (11,); of several readouts each its
            own, shape (readouts, 11).

    Returns:
        Commands in [-1, 1], in the shape of `x`.
    """
    if percentiles.ndim == 1:
        return mapping.command(x, percentiles)
    commands = [mapping.command(x[..., d], percentiles[d]) for d in range(len(percentiles))]
    return namespace_of(x, percentiles).stack(commands, axis=-1)


def expect_fit(robot: str, n_commands: int, readouts: int) -> None:
    """Refuse readouts that are more or fewer than the commands that a robot takes.

    Args:
        robot: its name.
        n_commands: that it takes.
        readouts: how many there are.

    Raises:
        InvalidArgument: where they differ.
    """
    # What is no number of commands is named where a robot is checked.
    if type(n_commands) is int and n_commands > 0 and n_commands != readouts:
        raise InvalidArgument(
            f"readouts: expected {n_commands}, one for each command of {robot}, got {readouts}; halves make two, "
            "quadrants four, a file of groups of electrodes as many as it has (animat train --readouts)"
        )


def expect_one_command(robot: str, n_commands: int) -> None:
    """Refuse commands to pick from, each a number, for a robot that takes several at once.

    Raises:
        InvalidArgument: for such a robot.
    """
    if type(n_commands) is int and n_commands > 1:
        raise InvalidArgument(
            f"commands: expected none to pick from for {robot}, which takes {n_commands} at once: without neurons its "
            "commands are continuous (baseline_commands = None)"
        )
