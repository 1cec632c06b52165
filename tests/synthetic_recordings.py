"""Synthetic recordings of known truth, for tests. Not a model of neurons.

Nothing here responds to anything: each stimulus's response x is drawn from a gamma distribution that belongs to its
frequency, and spikes are then placed so that x is found again. There is no memory, no network, no effect of the order
or of the pattern of stimuli.

How a response becomes spikes. With N channels and a window of T = 8 ms, x = S / (T N) for S spikes, so S = x T N,
rounded up or down at random such that its mean is exact; x comes in steps of 1 / (T N), 0.49 Hz for 256 channels.
The spikes of a response come in volleys of `VOLLEY` on one channel, so that it activates about x T N / VOLLEY
channels: 8 % of them at x = 42 Hz, 24 % at 120 Hz. A burst activates 90 to 100 % of the channels, one to three times
each. In the ratio of active channels, responses and bursts are thus far apart, and Otsu's threshold falls between them.
Background spikes are placed everywhere except up to 10 ms after a stimulus: the window holds x and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Channels, Recording
from animat.stimulation.array import MAXONE
from animat.stimulation.protocol import Presentation
from animat.stimulation.stimulus import Stimuli

WINDOW_S = (0.002, 0.010)
"""In which a response's spikes lie; they keep 0.2 ms away from its ends, so that rounding cannot move one out."""
VOLLEY = 4
VOLLEY_STEP_S = 0.0012
BURST_RATIO = (0.9, 1.0)
PAUSE_S = 1.0
SAMPLING_RATE_HZ = 20_000.0
STIMULATION_ELECTRODES = 32
PATTERN_ELECTRODES = 5
PATTERN_SPACING_UM = 100.0
SOURCE = "synthetic: known truth, not a model of neurons"


@dataclass(frozen=True)
class SyntheticCulture:
    """A culture that answers each stimulus with a number drawn from a known distribution.

    A stimulus of frequency i is answered by x ~ Gamma(shape, m_i / shape) Hz per channel, with
    m_i = means_hz[i] exp(-fatigue_per_h t), t the recording's start on the culture's clock in hours; with probability
    `burst_share` a burst comes instead.

    Attributes:
        seed: fixes the electrodes and patterns, and with `start_min` every draw of a recording.
        means_hz: mean response at each frequency when fresh, Hz per channel, at most 150.
        shape: the gamma's shape; the coefficient of variation is 1 / sqrt(shape).
        frequencies_hz: stimulus frequencies, presented as blocks in random order; at most 100.
        patterns: stimulation patterns; each is presented once at each frequency, in random order.
        channels: recording channels; x comes in steps of 1 / (0.008 channels) Hz.
        fatigue_per_h: how fast the means fall.
        burst_share: share of stimuli that a burst covers.
        background_hz: rate of spikes that no stimulus causes, per channel, outside the 10 ms after a stimulus.
    """

    seed: int
    means_hz: tuple[float, ...] = (30.0, 36.0, 42.0, 48.0, 54.0)
    shape: float = 6.0
    frequencies_hz: tuple[float, ...] = (5.0, 10.0, 20.0, 40.0, 80.0)
    patterns: int = 100
    channels: int = 256
    fatigue_per_h: float = 0.05
    burst_share: float = 0.05
    background_hz: float = 0.5

    def record(self, start_min: float = 0.0) -> Recording:
        """One recording by the paper's protocol: blocked, one pulse a trial (method of the paper, section 2).

        Args:
            start_min: its start on the culture's clock in minutes, 0 or more.
        """
        channels, patterns = _electrodes(self.seed, self.channels, self.patterns)
        rng = np.random.default_rng([self.seed, 1, round(start_min * 60_000)])
        time_s, frequency, pattern = self._protocol(rng)
        stop_s = float(time_s[-1]) + PAUSE_S
        means_hz = np.array(self.means_hz) * np.exp(-self.fatigue_per_h * start_min / 60)
        x_hz = rng.gamma(self.shape, means_hz[frequency] / self.shape)
        is_burst = rng.random(len(time_s)) < self.burst_share
        parts = (
            self._responses(rng, time_s[~is_burst], x_hz[~is_burst]),
            self._bursts(rng, time_s[is_burst]),
            self._background(rng, time_s, stop_s),
        )
        spike_time_s = np.concatenate([part[0] for part in parts])
        spike_channel = np.concatenate([part[1] for part in parts])
        order = np.argsort(spike_time_s, kind="stable")
        return Recording(
            spike_times_s=spike_time_s[order],
            spike_channels=spike_channel[order],
            channels=channels,
            stimuli=Stimuli(
                time_s, np.array(self.frequencies_hz)[frequency], pattern, patterns[pattern], np.arange(len(time_s))
            ),
            sampling_rate_hz=SAMPLING_RATE_HZ,
            start_s=0.0,
            duration_s=stop_s,
            start_min=float(start_min),
            presentation=Presentation("blocked", 1),
            provenance={"source": SOURCE, "seed": str(self.seed)},
            culture=RecordedCulture("synthetic", self.seed),
        )

    def _protocol(
        self, rng: np.random.Generator
    ) -> tuple[Float64[np.ndarray, " stimuli"], Int64[np.ndarray, " stimuli"], Int64[np.ndarray, " stimuli"]]:
        """Time, index of the frequency and pattern of each stimulus."""
        times, frequencies, patterns = [], [], []
        start_s = 0.0
        for frequency in rng.permutation(len(self.frequencies_hz)):
            start_s += PAUSE_S
            block_s = start_s + np.arange(self.patterns) / self.frequencies_hz[frequency]
            start_s = float(block_s[-1])
            times.append(block_s)
            frequencies.append(np.full(self.patterns, frequency))
            patterns.append(rng.permutation(self.patterns))
        return np.concatenate(times), np.concatenate(frequencies), np.concatenate(patterns)

    def _responses(
        self,
        rng: np.random.Generator,
        time_s: Float64[np.ndarray, " responses"],
        x_hz: Float64[np.ndarray, " responses"],
    ) -> tuple[Float64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
        """Spikes (time, channel) in the windows such that each response is x."""
        window_s = WINDOW_S[1] - WINDOW_S[0]
        n_spikes = np.floor(x_hz * window_s * self.channels + rng.random(len(x_hz))).astype(np.int64)
        response = np.repeat(np.arange(len(x_hz)), n_spikes)
        place = np.arange(len(response)) - np.repeat(np.cumsum(n_spikes) - n_spikes, n_spikes)
        volley, step = place // VOLLEY, place % VOLLEY
        channel = _shuffles(rng, len(x_hz), self.channels)[response, volley % self.channels]
        # The spikes of a volley share its start.
        start_s = rng.random((len(x_hz), int(volley.max(initial=0)) + 1))[response, volley]
        room_s = window_s - 0.0004 - (VOLLEY - 1) * VOLLEY_STEP_S
        return time_s[response] + WINDOW_S[0] + 0.0002 + start_s * room_s + step * VOLLEY_STEP_S, channel

    def _bursts(
        self, rng: np.random.Generator, time_s: Float64[np.ndarray, " bursts"]
    ) -> tuple[Float64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
        n_active = np.ceil(rng.uniform(*BURST_RATIO, len(time_s)) * self.channels).astype(np.int64)
        is_active = np.arange(self.channels)[None, :] < n_active[:, None]
        n_spikes = rng.integers(1, 4, (len(time_s), self.channels))[is_active]
        burst = np.repeat(np.nonzero(is_active)[0], n_spikes)
        channel = np.repeat(_shuffles(rng, len(time_s), self.channels)[is_active], n_spikes)
        return time_s[burst] + rng.uniform(WINDOW_S[0] + 0.0002, WINDOW_S[1] - 0.0002, len(burst)), channel

    def _background(
        self, rng: np.random.Generator, time_s: Float64[np.ndarray, " stimuli"], stop_s: float
    ) -> tuple[Float64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
        spike_s = rng.uniform(0, stop_s, rng.poisson(self.background_hz * self.channels * stop_s))
        channel = rng.integers(0, self.channels, len(spike_s))
        latest = np.searchsorted(time_s, spike_s, side="right") - 1
        is_free = (latest < 0) | (spike_s - time_s[latest] > WINDOW_S[1] + 0.0002)
        return spike_s[is_free], channel[is_free]


def synthetic_recording(seed: int, *, start_min: float = 0.0, **settings: Any) -> Recording:
    """One recording of a synthetic culture; `settings` are the attributes of `SyntheticCulture`."""
    return SyntheticCulture(seed, **settings).record(start_min)


def write_synthetic_series(
    seed: int, folder: str | Path, *, sessions: int, interval_min: float = 10.0, **settings: Any
) -> list[Path]:
    """Write the recordings of a synthetic culture over time, one NWB file each; returns the files in order of time."""
    culture = SyntheticCulture(seed, **settings)
    files = []
    for start_min in np.arange(sessions) * interval_min:
        files.append(Path(folder) / recording_name(start_min))
        write_nwb(culture.record(start_min), files[-1])
    return files


def _shuffles(rng: np.random.Generator, n: int, channels: int) -> Int64[np.ndarray, "n channels"]:
    """All channels in random order, n times."""
    return np.argsort(rng.random((n, channels)), axis=1)


@cache
def _electrodes(
    seed: int, n_channels: int, n_patterns: int
) -> tuple[Channels, Int64[np.ndarray, "patterns electrodes"]]:
    """The recording channels, and the electrodes of each pattern; the same in all recordings of a culture."""
    rng = np.random.default_rng([seed, 0])
    shuffled = rng.permutation(len(MAXONE))
    electrode, others = shuffled[:n_channels], shuffled[n_channels:]
    stimulating: list[int] = []
    for candidate in others.tolist():
        if all(MAXONE.distance_um(candidate, chosen) > PATTERN_SPACING_UM for chosen in stimulating):
            stimulating.append(candidate)
        if len(stimulating) == STIMULATION_ELECTRODES:
            break
    patterns: dict[tuple[int, ...], None] = {}
    while len(patterns) < n_patterns:
        chosen = rng.choice(stimulating, PATTERN_ELECTRODES, replace=False)
        patterns[tuple(sorted(chosen.tolist()))] = None
    of_patterns = np.array(list(patterns), dtype=np.int64)
    # All who ask have the same one.
    of_patterns.setflags(write=False)
    return Channels.on(MAXONE, electrode), of_patterns
