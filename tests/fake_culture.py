"""A small culture on the contract that answers and fails on request, for tests of the closed loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from animat.cultures.base import Culture
from animat.cultures.observed import Observed, Spikes
from animat.cultures.safety import SIMULATED_LIMITS, Admitted, Limits
from animat.recordings.recording import Channels

CHANNELS = 16
STRENGTH = {5.0: 0.5, 10.0: 1.0, 20.0: 1.5, 40.0: 2.0, 80.0: 2.5}
"""Mean number of spikes on a channel that answers a pulse of each frequency."""

Fault = Callable[["FakeCulture", Observed], Observed]
"""Given what would be answered, answers something else, or raises, or never returns."""


class FakeCulture(Culture):
    """16 channels, of which half answer each pulse, the more the higher its frequency; every 37th is a burst of all.

    Args:
        seed: of its spikes.
        fault: what happens to the answer of delivery number `at`, counted from 0.
        at: see `fault`.
        limits: tighter ones.
        jitter: whether spikes lie off the sampling grid too.
    """

    name: ClassVar[str] = "fake"

    def __init__(
        self,
        seed: int = 1,
        *,
        fault: Fault | None = None,
        at: int = 5,
        limits: Limits | None = None,
        jitter: bool = True,
    ) -> None:
        super().__init__(limits)
        self._rng = np.random.default_rng(seed)
        self._fault, self._at, self._jitter = fault, at, jitter
        self._now_s = 12.0
        self.deliveries = 0
        self.pulses = 0
        self.halted = 0
        self.after_halt = 0

    @property
    def channels(self) -> Channels:
        n = np.arange(CHANNELS)
        return Channels(label=n.astype(np.str_), electrode=n + 100, x_um=17.5 * n, y_um=0.0 * n)

    @property
    def stimulation_electrodes(self) -> tuple[int, ...]:
        return tuple(range(100, 108))

    @property
    def patterns(self) -> np.ndarray:
        return np.array([[100 + i, 100 + (i + 1) % 8, -1] for i in range(8)])

    @property
    def device_limits(self) -> Limits:
        return SIMULATED_LIMITS

    @property
    def now_s(self) -> float:
        return self._now_s

    @property
    def sampling_rate_hz(self) -> float:
        return 20_000.0

    @property
    def provenance(self) -> dict[str, str]:
        return {"source": "a fake culture", "seed": "1"}

    def _open(self) -> None:
        self.halted = 0

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        number, self.deliveries = self.deliveries, self.deliveries + 1
        self.pulses += len(admitted.stimuli)
        self.after_halt += len(admitted.stimuli) if self.halted else 0
        times, channels = [self._rng.random(20) * duration_s], [self._rng.integers(0, CHANNELS, 20)]
        for i, stimulus in enumerate(admitted.stimuli):
            bursts = (self.pulses + i) % 37 == 0
            answering = np.arange(CHANNELS) if bursts else self._rng.permutation(CHANNELS)[: CHANNELS // 2]
            mean = STRENGTH.get(stimulus.frequency_hz, 1.5)
            fired = np.repeat(answering, 1 + self._rng.poisson(mean, len(answering)))
            first_s, length_s = (0.003, 0.006) if bursts else (0.0005, 0.011)
            times.append(stimulus.time_s + first_s + length_s * self._rng.random(len(fired)))
            channels.append(fired)
            # At the very edges of the window, where rounding decides.
            times.append(stimulus.time_s + np.array([0.002, 0.01, 0.01 + 5e-5, 0.01 + 1e-4]))
            channels.append(np.array([0, 1, 2, 3]))
        time_s, channel = np.concatenate(times), np.concatenate(channels)
        if not self._jitter:
            time_s = np.rint(time_s * 20_000) / 20_000
        kept = time_s < duration_s
        order = np.argsort(time_s[kept], kind="stable")
        observed = Observed(
            self._now_s,
            duration_s,
            Spikes(time_s[kept][order], channel[kept][order]),
            np.array([s.time_s for s in admitted.stimuli], np.float64),
        )
        self._now_s += duration_s
        if self._fault is not None and number == self._at:
            return self._fault(self, observed)
        return observed

    def _rest(self, duration_s: float) -> None:
        self._now_s += duration_s

    def _halt(self) -> None:
        self.halted += 1

    def _close(self) -> None:
        pass
