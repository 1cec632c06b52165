"""Readouts: groups of channels, each decoded into a command, defined by the electrodes that the channels read."""

from __future__ import annotations

import os
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import Field

from animat.errors import InvalidArgument, Mismatch, in_file, shown, some_of
from animat.recordings.recording import Channels
from animat.records import json_data, read_record, record
from animat.responses.windows import PerWindow, Spiking, Window, spikes_in
from animat.stimulation.places import CUT, count_places, electrodes_of, read_groups
from animat.stimulation.selection import Electrode
from animat.tables import UNKNOWN

CUT_NAMES = {"halves": ("left", "right"), "quadrants": ("left top", "left bottom", "right top", "right bottom")}
"""Names of the groups that `CUT` makes; left is the smaller x, top the smaller y."""
NAMED = ("all", *CUT)
MOST_READOUTS = 64
DEFAULT_READOUTS = {1: "all", 2: "halves", 4: "quadrants"}
"""By the number of commands that a robot takes."""

Group = Annotated[tuple[Electrode, ...], Field(min_length=1)]
Name = Annotated[str, Field(min_length=1, max_length=40)]


@record
class Readouts:
    """Named groups of channels; by default one of all channels (the paper).

    Attributes:
        names: of the groups, in the order of the commands.
        electrodes: of each group, rising; groups may overlap. None: one group of all channels, whatever they read.

    Raises:
        InvalidArgument: for invalid names or electrodes, or names without electrodes.
    """

    names: Annotated[tuple[Name, ...], Field(min_length=1, max_length=MOST_READOUTS)] = ("all",)
    electrodes: tuple[Group, ...] | None = None

    def __post_init__(self) -> None:
        if self.electrodes is None and self.names == ("all",):
            return
        groups = [tuple(sorted(set(group))) for group in self.electrodes or ()]
        if not groups:
            raise InvalidArgument(
                f"electrodes: expected a group of electrodes for each of the names {shown(self.names)}, got none"
            )
        if not len(set(self.names)) == len(self.names) == len(groups) or not all(map(str.isprintable, self.names)):
            raise InvalidArgument(
                f"names: expected a different printable name for each group of electrodes ({len(groups)} in all), got "
                f"{shown(self.names)}"
            )
        object.__setattr__(self, "electrodes", tuple(groups))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def are_all(self) -> bool:
        """Whether it is one group of all channels."""
        return self.electrodes is None

    def members(self, channels: Channels) -> Bool[np.ndarray, "readouts channels"]:
        """Which channels belong to each group; raises Mismatch for channels that do not read all of the electrodes."""
        if self.electrodes is None:
            return np.ones((1, len(channels)), np.bool_)
        read = set(channels.electrode.tolist()) - {UNKNOWN}
        for name, group in zip(self.names, self.electrodes, strict=True):
            if missing := sorted(set(group) - read):
                known = f"{len(read):,} are read ({some_of(sorted(read), 5)})" if read else "none is known"
                raise Mismatch(
                    f"readouts: expected channels that read all electrodes of the readout {name!r}, got none for "
                    f"{len(missing)} of its {len(group)} ({some_of(missing, 5)}); {known}"
                )
        return np.array([np.isin(channels.electrode, group) for group in self.electrodes])

    def read(
        self, recording: Spiking, members: Bool[np.ndarray, "readouts channels"], after_s: PerWindow, window_ms: Window
    ) -> Float64[np.ndarray, "windows *readouts"]:
        """The response x of each group in a window after each pulse, in Hz per channel.

            x = S / (T N),  S: spikes of the group's N channels in a window of T

        Edges are as in `animat.responses.windows.count_spikes`, and `members` is the result of that method. Pulses are
        timed on the clock of the spikes. With a single readout there is no axis of readouts.
        """
        window, spike = spikes_in(recording, after_s + window_ms[0] * 1e-3, after_s + window_ms[1] * 1e-3)
        channel = recording.spike_channels[spike]
        spikes = np.array([np.bincount(window[group[channel]], minlength=len(after_s)) for group in members])
        rate_hz = spikes.T / ((window_ms[1] - window_ms[0]) * 1e-3 * members.sum(axis=1))
        return self.squeeze(rate_hz)

    def squeeze(self, values: Float64[np.ndarray, "*any readouts"]) -> Float64[np.ndarray, "*any_readouts"]:
        """Values of each group; for a single group, without the axis of readouts (the paper's shapes)."""
        return values[..., 0] if len(self) == 1 else values

    def to_dict(self) -> dict[str, Any] | None:
        """As JSON data, in the order of the groups; None for one group of all channels."""
        if self.electrodes is None:
            return None
        return {"names": list(self.names), "electrodes": [list(group) for group in self.electrodes]}

    @classmethod
    def from_dict(cls, data: Any) -> Readouts:
        """The inverse of `to_dict`; raises InvalidArgument for anything else."""
        return cls() if data is None else read_record(cls, data, "readouts")


ALL = Readouts()
"""One readout of all channels: the paper's."""


def readouts_named(text: str) -> str | Readouts:
    """The name of readouts (`all`, `halves`, `quadrants`), or groups of electrodes as JSON: `{"left": [1, 2]}`."""
    if text in NAMED:
        return ALL if text == "all" else text
    if not text.lstrip().startswith("{"):
        raise InvalidArgument(
            f"readouts: expected {', '.join(NAMED)}, or groups of electrodes as JSON, "
            f'{{"left": [1, 2], "right": [3, 4]}}, got {shown(text)}'
        )
    groups = read_record(dict[str, Group], json_data(text, "readouts"), "readouts")
    return read_record(Readouts, {"names": list(groups), "electrodes": list(groups.values())}, "readouts")


def read_readouts(text: str | os.PathLike[str]) -> str | Readouts:
    """As `readouts_named`, or the name of a file with such JSON; raises InvalidFile if it cannot be read."""
    if text in NAMED or str(text).lstrip().startswith("{"):
        return readouts_named(str(text))
    written = read_groups("readouts", NAMED, text)
    with in_file(text):
        return readouts_named(written)


def count_readouts(readouts: str | Readouts) -> int:
    return count_places(readouts) if isinstance(readouts, str) else len(readouts)


def readouts_on(readouts: str | Readouts, channels: Channels) -> Readouts:
    """Readouts defined by the electrodes of a recording's channels.

    Halves are the electrodes with the smaller and the larger x, split as evenly as possible; for quadrants each half is
    split by y, as for places (`animat.stimulation.places`). Raises Mismatch for given groups that are not read whole.
    """
    if readouts == "all":
        return ALL
    if isinstance(readouts, str):
        if readouts not in CUT:
            raise InvalidArgument(
                f"readouts: expected {', '.join(NAMED)} or groups of electrodes, got {shown(readouts)}"
            )
        electrodes, first = np.unique(channels.electrode, return_index=True)
        if UNKNOWN in electrodes or len(electrodes) < count_places(readouts):
            raise InvalidArgument(
                f"readouts: expected {count_places(readouts)} or more channels, all of whose electrodes are known, to "
                f"form {readouts}, got {np.count_nonzero(electrodes != UNKNOWN)} electrodes of {len(channels)} channels"
            )
        if not channels.has_positions:
            raise InvalidArgument(f"readouts: expected channels whose positions are known to form {readouts}")
        groups = electrodes_of(readouts, electrodes, channels.x_um[first], channels.y_um[first])
        return Readouts(CUT_NAMES[readouts], groups)
    readouts.members(channels)
    return readouts
