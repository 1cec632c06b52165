"""The post-stimulus time histogram: when the culture fires after a stimulus, and how it fires without one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from animat.errors import InvalidArgument
from animat.recordings.recording import Recording
from animat.responses.windows import HALF_NS_S, count_spikes

# Spikes count as spontaneous from 100 ms after a stimulus (the longest direct responses known to us are over by then;
# a longer window delays this) until 20 ms before the next (filters smear artefacts backwards), 200 ms at most.
_SETTLED_MS = 100.0
_ARTEFACT_MS = 20.0
_QUIET_MS = 200.0
_LEAST_QUIET_S = 1.0
_ARTEFACT_AFTER_MS = 2.0
_SEARCH_MS = 500.0
_SUSTAINED_BINS = 3
_BINS_MS = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True, eq=False)
class PostStimulusHistogram:
    """Spikes of all channels in bins of time from the stimulus, with edges at `edges_ms`, summed over stimuli."""

    edges_ms: Float64[np.ndarray, " edges"]
    count: Int64[np.ndarray, " bins"]
    n_stimuli: int
    n_channels: int

    @property
    def rate_hz(self) -> Float64[np.ndarray, " bins"]:
        """Mean firing rate per channel in each bin, in Hz: count / (stimuli x bin width x channels)."""
        exposure_s = self.n_stimuli * self.n_channels * np.diff(self.edges_ms) * 1e-3
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.count / exposure_s, dtype=np.float64)


@dataclass(frozen=True)
class ResponseTime:
    """The first stretch of time after a stimulus in which the culture fires clearly above its spontaneous rate."""

    start_ms: float
    end_ms: float

    def __str__(self) -> str:
        return f"{self.start_ms:g} to {self.end_ms:g} ms"


def post_stimulus_histogram(
    recording: Recording,
    from_ms: float = -20.0,
    to_ms: float = 50.0,
    bin_ms: float = 1.0,
    stimuli: Bool[np.ndarray, " stimuli"] | None = None,
) -> PostStimulusHistogram:
    """Count spikes by their time from the stimulus.

    Args:
        from_ms, to_ms: the span, from the stimulus; negative is before it. It grows to a whole number of bins.
        bin_ms: width of the bins, which are half-open, of lags rounded to a nanosecond. So bins inside a window add
            up to the spikes of that window (`animat.responses.windows.count_spikes`), except those on its edges.
        stimuli: which pulses to take, shape (stimuli,); None for the last pulses of trials.
    """
    if not (math.isfinite(from_ms) and math.isfinite(to_ms) and from_ms < to_ms):
        raise InvalidArgument(f"from_ms, to_ms: expected from_ms < to_ms, got {from_ms:g} and {to_ms:g}")
    if not (math.isfinite(bin_ms) and bin_ms > 0):
        raise InvalidArgument(f"bin_ms: expected a width above 0 ms, got {bin_ms:g}")
    table = recording.stimuli
    times_s = table.time_s[table.is_last_of_presentation & ~table.is_rest if stimuli is None else stimuli]
    # The small number keeps 70.000000001 bins from becoming 71.
    n_bins = max(1, math.ceil((to_ms - from_ms) / bin_ms - 1e-9))
    edges_ms = from_ms + bin_ms * np.arange(n_bins + 1)
    edges_s = edges_ms * 1e-3 - HALF_NS_S
    before = np.array([np.searchsorted(recording.spike_times_s, times_s + edge_s).sum() for edge_s in edges_s])
    return PostStimulusHistogram(edges_ms, np.diff(before.astype(np.int64)), len(times_s), len(recording.channels))


def spontaneous_rate(recording: Recording, after_ms: float = 0.0) -> tuple[float, float]:
    """Spikes per second, on all channels together, in the quiet stretches before stimuli; and their total time in s.

    A stretch is quiet from 100 ms (or `after_ms`, if that is more) after the previous pulse, and 20 to 220 ms before
    the next one. At 10 Hz and above there is none: such stimuli do not count, since what precedes them is the response
    to the previous one. Less than a second of quiet gives no rate (NaN): a single burst might fill it.
    """
    times_s = recording.stimuli.time_s
    if not len(times_s):
        return math.nan, 0.0
    settled_s = np.concatenate([[recording.start_s], times_s[:-1] + max(_SETTLED_MS, after_ms) * 1e-3])
    to_s = times_s - _ARTEFACT_MS * 1e-3
    from_s = np.maximum(settled_s, to_s - _QUIET_MS * 1e-3)
    quiet = to_s > from_s
    quiet_s = float(np.sum((to_s - from_s)[quiet]))
    n_spikes = int(count_spikes(recording, from_s[quiet], to_s[quiet]).sum())
    return (n_spikes / quiet_s if quiet_s >= _LEAST_QUIET_S else math.nan), quiet_s


def find_response(recording: Recording, stimuli: Bool[np.ndarray, " stimuli"] | None = None) -> ResponseTime | None:
    """When the culture first fires above its spontaneous rate after a stimulus; None if it does not, or is unknown.

    It is the first stretch, from 2 ms on, that begins with three successive bins above b + 3 sqrt(b), b the spikes
    expected spontaneously in a bin, and ends before three successive bins that are not. Bins are 1 ms wide, or up to
    10 ms if spikes are few. Only stimuli without another pulse within the search, of 500 ms, are used; if these are
    few, the search is shortened to the upper quartile of the intervals. `stimuli` is as in `post_stimulus_histogram`.
    """
    table, up_to_ms = recording.stimuli, _SEARCH_MS
    rate_hz, _ = spontaneous_rate(recording)
    read = table.is_last_of_presentation & ~table.is_rest if stimuli is None else stimuli
    if not read.any() or math.isnan(rate_hz):
        return None
    gap_ms = 1e3 * np.append(np.diff(table.time_s), np.inf)
    gap_ms = np.minimum(gap_ms, 1e3 * (recording.stop_s - table.time_s))
    if (read & (gap_ms >= up_to_ms)).sum() < min(20, int(read.sum())):
        up_to_ms = min(up_to_ms, float(np.quantile(gap_ms[read], 0.75)))
    chosen = read & (gap_ms >= up_to_ms)
    per_ms = rate_hz * 1e-3 * np.count_nonzero(chosen)
    bin_ms = next((width for width in _BINS_MS if width * per_ms >= 5), _BINS_MS[-1])
    n_bins = int((up_to_ms - _ARTEFACT_AFTER_MS) // bin_ms)
    if n_bins < _SUSTAINED_BINS:
        return None
    to_ms = _ARTEFACT_AFTER_MS + n_bins * bin_ms
    histogram = post_stimulus_histogram(recording, _ARTEFACT_AFTER_MS, to_ms, bin_ms, chosen)
    expected = per_ms * bin_ms
    above = histogram.count > expected + 3 * math.sqrt(max(expected, 1.0))
    runs = np.lib.stride_tricks.sliding_window_view(above, _SUSTAINED_BINS)
    begins = np.flatnonzero(runs.all(axis=1))
    if not len(begins):
        return None
    ends = begins[0] + np.flatnonzero(~runs[begins[0] :].any(axis=1))
    last = ends[0] if len(ends) else n_bins
    return ResponseTime(float(histogram.edges_ms[begins[0]]), float(histogram.edges_ms[last]))
