"""From responses to a motor command: each readout is mapped with its own thresholds."""

from __future__ import annotations

from dataclasses import dataclass

from animat.arguments import checked_arguments
from animat.coding.mapping import N_PERCENTILES, Mapping, Numbers, namespace_of
from animat.errors import InvalidArgument
from animat.responses.readouts import ALL, Readouts


@checked_arguments
@dataclass(frozen=True)
class Decoder:
    """From a response to a command: a number in [-1, 1] for each readout.

    Attributes:
        mapping: from the response of a readout to its command.
        readouts: the groups of channels; by default one of all channels (the paper).
    """

    mapping: Mapping
    readouts: Readouts = ALL

    @property
    def percentiles_shape(self) -> tuple[int, ...]:
        """Shape of the percentiles that `command` takes: (11,), or (readouts, 11) for several."""
        return (N_PERCENTILES,) if len(self.readouts) == 1 else (len(self.readouts), N_PERCENTILES)

    def command(self, x: Numbers, percentiles: Numbers) -> Numbers:
        """The motor command for a response (see `decode`)."""
        return decode(self.mapping, x, percentiles)


def decode(mapping: Mapping, x: Numbers, percentiles: Numbers) -> Numbers:
    """The motor command for a response, in [-1, 1] and in the shape of `x`.

    Args:
        x: of one readout, in Hz, any shape; of several, in the last axis, shape (..., readouts).
        percentiles: P0, P10, ..., P100 of the non-burst responses, in Hz, shape (11,); with several readouts, of each,
            shape (readouts, 11).
    """
    if percentiles.ndim == 1:
        return mapping.command(x, percentiles)
    commands = [mapping.command(x[..., d], percentiles[d]) for d in range(len(percentiles))]
    return namespace_of(x, percentiles).stack(commands, axis=-1)


def expect_readout_per_command(robot: str, n_commands: int, readouts: int) -> None:
    """Raise InvalidArgument if the number of readouts differs from the number of commands that a robot takes."""
    # An invalid number of commands is reported by the check of the robot.
    if type(n_commands) is int and n_commands > 0 and n_commands != readouts:
        advice = "halves are two, quadrants four, a file as many as it has groups (animat train --readouts)"
        expected = f"{n_commands}, one for each command of {robot}"
        raise InvalidArgument(f"readouts: expected {expected}, got {readouts}; {advice}")


def expect_one_command(robot: str, n_commands: int) -> None:
    """Raise InvalidArgument for single commands to pick from with a robot that takes several at once."""
    if type(n_commands) is int and n_commands > 1:
        why = "without neurons they are continuous (baseline_commands = None)"
        expected = f"expected none to pick from for {robot}"
        raise InvalidArgument(f"commands: {expected}, which takes {n_commands} at once: {why}")
