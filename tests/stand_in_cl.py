"""A stand-in for the CL1's SDK in a time of its own, that remembers every pulse; for tests without the SDK.

It does what was seen of cl-sdk 1.0.0 in its accelerated time: ticks of whole frames, pulses one lead time after their
plan, ground ignored in silence, no look at balance, queues that wait until a channel is free.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from animat.cultures import holding

GROUNDED = {0, 7, 56, 63}


class StimDesign:
    def __init__(self, *numbers: float) -> None:
        if len(numbers) not in (2, 4, 6):
            raise ValueError("StimDesign requires 2, 4, or 6 arguments.")
        self.durations_us, self.currents_ua = numbers[::2], numbers[1::2]
        for i, (duration_us, current_ua) in enumerate(zip(self.durations_us, self.currents_ua, strict=True)):
            if abs(current_ua * duration_us) > 3000 or abs(current_ua) > 3 or duration_us < 20 or duration_us % 20:
                raise ValueError(f"not allowed: {numbers}")
            if i and np.sign(current_ua) == np.sign(self.currents_ua[i - 1]):
                raise ValueError("must have different polarities")
        self.duration_us = sum(self.durations_us)


class ChannelSet(frozenset[int]):
    def __new__(cls, *channels: int) -> ChannelSet:
        return super().__new__(cls, channels)


class Neurons:
    """Every seventh frame on which a channel was pulsed 100 frames ago it spikes once."""

    def __init__(self) -> None:
        self.now = 0
        self.pulses: list[tuple[int, int, StimDesign]] = []
        self.queue: list[tuple[int, int, StimDesign]] = []
        self.late_frames = 0
        self.in_loop = False
        self.drop: set[int] = set()
        self.fail: Exception | None = None
        self.is_gone = False
        self.interrupted = 0
        self.stream: list[tuple[int, Any]] = []

    def _answer(self) -> None:
        if self.is_gone:
            raise ConnectionResetError("the device is gone")

    def timestamp(self) -> int:
        self._answer()
        return self.now + (self.late_frames if self.in_loop else 0)

    def get_frames_per_second(self) -> int:
        return 25_000

    def get_channel_count(self) -> int:
        return 64

    def read(self, count: int, start: int) -> None:
        self._answer()
        self.now = start + count

    def create_stim_plan(self) -> Any:
        operations: list[Any] = []

        def stim(channels: ChannelSet, design: StimDesign, *, lead_time_us: int) -> None:
            assert lead_time_us >= 80
            operations.append((channels, design))

        def run(at_timestamp: int) -> None:
            for channels, design in operations:
                frame = max(at_timestamp, self.timestamp()) + 2
                self.queue += [(frame, c, design) for c in sorted(channels) if c not in GROUNDED | self.drop]

        return SimpleNamespace(stim=stim, run=run)

    def interrupt(self, channels: ChannelSet) -> None:
        self._answer()
        self.interrupted += 1
        self.queue = [pulse for pulse in self.queue if pulse[1] not in channels]

    def record(self, **_: Any) -> Any:
        return SimpleNamespace(stop=lambda: None)

    def create_data_stream(self, name: str) -> Any:
        assert name == "animat_stimuli"
        return SimpleNamespace(append=lambda frame, words: self.stream.append((frame, words)))

    def loop(self, ticks_per_s: int, **_: Any) -> Iterator[Any]:
        step, going = 25_000 // ticks_per_s, [True]
        stop = SimpleNamespace(stop=lambda: going.clear())
        while going:
            self._answer()
            if self.fail is not None:
                raise self.fail
            first, last = self.now, self.now + step
            done = sorted(((f, c, d) for f, c, d in self.queue if f < last), key=lambda pulse: pulse[:2])
            self.queue = [pulse for pulse in self.queue if pulse[0] >= last]
            self.pulses += done
            self.now = last
            stims = [SimpleNamespace(timestamp=f, channel=c) for f, c, _ in done]
            spikes = [SimpleNamespace(timestamp=f, channel=c) for f, c, _ in done if f % 7 == 0]
            found = SimpleNamespace(start_timestamp=first, stop_timestamp=last, spikes=spikes, stims=stims)
            self.in_loop = True
            yield SimpleNamespace(analysis=found, loop=stop, iteration_timestamp=last)
            self.in_loop = False


def install(patch: pytest.MonkeyPatch) -> Neurons:
    """Put the stand-in where the SDK is imported from, until the test ends."""
    module: Any = ModuleType("cl")
    neurons = module.neurons = Neurons()

    @contextmanager
    def opened(**_: bool) -> Iterator[Neurons]:
        neurons._answer()
        yield neurons

    module.open, module.ChannelSet, module.StimDesign = opened, ChannelSet, StimDesign
    module.is_simulator = lambda: True
    module.get_system_attributes = lambda: neurons._answer() or {"system_id": "stand-in", "chip_id": "none"}
    patch.setitem(sys.modules, "cl", module)
    # It is another device: whoever held the one before holds nothing of it.
    patch.setattr(holding, "MACHINE", holding.MACHINE / "another")
    patch.setattr(holding, "_own_folder", lambda: SimpleNamespace(name=holding.MACHINE))
    return neurons
