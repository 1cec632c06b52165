"""Writes spikes into an NWB file block by block, as there may be more of them than memory holds."""

from __future__ import annotations

from collections.abc import Iterable

import h5py
import numpy as np
from jaxtyping import Float64, Int, Int64

from animat.errors import UnusableData

SpikeBlock = tuple[Float64[np.ndarray, " spikes"], Int[np.ndarray, " spikes"]]
"""Times in s and channels of a block of spikes."""

_COUNTED_AT_ONCE = 2**14


class SpikeCounts:
    """Counts the spikes of each of some channels incrementally."""

    def __init__(self, channels: int) -> None:
        self._counts = np.zeros(channels, np.int64)
        self._span_s = np.inf, -np.inf
        self._waiting: list[SpikeBlock] = []
        self._n_waiting = 0

    def add(self, times_s: Float64[np.ndarray, " spikes"], channel: Int[np.ndarray, " spikes"]) -> None:
        """Add spikes; refuses times that are not finite and unknown channels, in this call or a later one."""
        if len(times_s):
            self._waiting.append((times_s, channel))
            self._n_waiting += len(times_s)
            # Counting many takes as long as counting one.
            if self._n_waiting > _COUNTED_AT_ONCE:
                self._count()

    @property
    def of_channels(self) -> Int64[np.ndarray, " channels"]:
        """Spikes counted so far, shape (channels,)."""
        self._count()
        return self._counts

    @property
    def span_s(self) -> tuple[float, float]:
        """The earliest and the latest time; 0 if there are no spikes."""
        self._count()
        return self._span_s if np.isfinite(self._span_s[0]) else (0.0, 0.0)

    def _count(self) -> None:
        if not self._waiting:
            return
        times_s, channel = (np.concatenate(arrays) for arrays in zip(*self._waiting, strict=True))
        self._waiting, self._n_waiting = [], 0
        channels = len(self._counts)
        if not np.all(np.isfinite(times_s)):
            raise UnusableData("spike_times_s: expected finite times in seconds, got NaN or infinite ones")
        if channel.min() < 0 or channel.max() >= channels:
            wrong = channel[(channel < 0) | (channel >= channels)][0]
            raise UnusableData(f"spike_channels: expected rows of the {channels} channels, got {wrong}")
        self._counts += np.bincount(channel, minlength=channels)
        self._span_s = min(self._span_s[0], float(times_s.min())), max(self._span_s[1], float(times_s.max()))


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
