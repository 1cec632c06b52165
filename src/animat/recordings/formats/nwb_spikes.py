"""Writes spikes into an NWB file block by block, as there may be more of them than memory holds."""

from __future__ import annotations

from collections.abc import Iterable

import h5py
import numpy as np
from jaxtyping import Float64, Int, Int64

from animat.errors import UnusableData

SpikeBlock = tuple[Float64[np.ndarray, " spikes"], Int[np.ndarray, " spikes"]]
"""Times in s and channels of a block of spikes."""


class SpikeCounts:
    """How many spikes each of some channels has, and the earliest and the latest time, added block by block.

    Attributes:
        of_channels: shape (channels,).
        span_s: 0 and 0 if there are no spikes.
    """

    def __init__(self, channels: int) -> None:
        self.of_channels = np.zeros(channels, np.int64)
        self.span_s = 0.0, 0.0

    def add(self, times_s: Float64[np.ndarray, " spikes"], channel: Int[np.ndarray, " spikes"]) -> None:
        """Add spikes; refuses times that are not finite and unknown channels."""
        channels = len(self.of_channels)
        if not len(times_s):
            return
        if not np.all(np.isfinite(times_s)):
            raise UnusableData("spike_times_s: expected finite times in seconds, got NaN or infinite ones")
        if channel.min() < 0 or channel.max() >= channels:
            wrong = channel[(channel < 0) | (channel >= channels)][0]
            raise UnusableData(f"spike_channels: expected rows of the {channels} channels, got {wrong}")
        every_s = np.append(times_s, self.span_s if self.of_channels.any() else ())
        self.span_s = float(every_s.min()), float(every_s.max())
        self.of_channels += np.bincount(channel, minlength=channels)


def write_spikes(dataset: h5py.Dataset, blocks: Iterable[SpikeBlock], counts: Int64[np.ndarray, " channels"]) -> None:
    """Write spike times channel by channel, in ascending order within a channel.

    `dataset` is contiguous in the file and has as many floats as `counts` counts spikes, in any order in `blocks`.
    """
    ends = np.cumsum(counts)
    place, newest_s = ends - counts, np.full(len(ends), -np.inf)
    space = dataset.id.get_space()
    falling: set[int] = set()
    # Sixteen bits are sorted in one sweep.
    kind = np.uint16 if len(ends) <= 2**16 else np.int64
    for times_s, channel in blocks:
        channel = channel.astype(kind)
        order = np.argsort(channel, kind="stable")
        times_s, channel = times_s[order], channel[order]
        falling.update(channel[1:][(times_s[1:] < times_s[:-1]) & (channel[1:] == channel[:-1])].tolist())
        present, begins = np.unique(channel, return_index=True)
        stops = np.append(begins[1:], len(channel))[: len(begins)]
        for c, a, b in zip(present.tolist(), begins.tolist(), stops.tolist(), strict=True):
            _write(dataset, space, int(place[c]), times_s[a:b])
            if times_s[a] < newest_s[c]:
                falling.add(c)
            place[c] += b - a
            newest_s[c] = times_s[b - 1]
    for c in falling:
        first = int(ends[c] - counts[c])
        _write(dataset, space, first, np.sort(dataset[first : int(ends[c])]))


def _write(dataset: h5py.Dataset, space: h5py.h5s.SpaceID, place: int, values: Float64[np.ndarray, " values"]) -> None:
    # Like `dataset[a:b] = values`, in a twentieth of the time, as there are tens of thousands of these. Space and type
    # are passed, as looking them up each time takes as long as writing.
    space.select_hyperslab((place,), (len(values),))
    dataset.id.write(h5py.h5s.create_simple((len(values),)), space, values, h5py.h5t.NATIVE_DOUBLE)
