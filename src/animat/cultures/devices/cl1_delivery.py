"""Deliveries on a CL1: pulses run at frames of its clock, while a loop reads the spikes."""

from __future__ import annotations

import json
import math
import threading
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from animat.cultures.failures import vendor_module
from animat.cultures.observed import Observed, observed_in_frames
from animat.cultures.safety import Guard
from animat.errors import DeviceFailed
from animat.extras import install_command
from animat.recordings.formats.cl1_layout import CHANNELS, SITES
from animat.recordings.formats.stimulus_text import parameters_of
from animat.stimulation.pulse import Pulse
from animat.stimulation.stimulus import Stimulus
from animat.tables import UNKNOWN

FRAMES_PER_S = 25_000
LEAD_US = 80
"""The shortest time from a command to its pulse."""
LEAD_FRAMES = LEAD_US * FRAMES_PER_S // 1_000_000
AHEAD_FRAMES = 2_500
"""Pulses are queued on the device up to 100 ms ahead: the computer may fall behind by as much, and a stop has to remove
no more than that from the queue."""
QUEUEING_S = 0.5
"""How long a stop waits while a pulse is being queued."""

_ROW_OF = np.full(CHANNELS, UNKNOWN, dtype=np.int64)
_ROW_OF[list(SITES)] = np.arange(len(SITES))


class CL1Session:
    """An open CL1, from opening to closing: delivers stimuli through `Neurons.loop` and stim plans.

    A plan runs at a frame, and its pulse comes one lead time later. Pulses are queued within the loop, in order of
    time, at least `margin_frames` ahead. If one is late, all after it are delayed equally, so that intervals between
    pulses can only grow. A delivery that hangs beyond its session stays halted.
    """

    def __init__(self, cl: Any, neurons: Any, ticks_per_s: int, margin_frames: int, jitter: dict[str, Any]) -> None:
        self.cl, self.neurons = cl, neurons
        self._ticks_per_s, self._margin_frames, self._jitter = ticks_per_s, margin_frames, jitter
        self.guard: Guard
        """On the device's clock."""
        self.stream: Any = None
        """The SDK's data stream for the parameters of each stimulus; None: not recorded."""
        self._design_of = cache(self._design)
        self._halted = threading.Event()
        self._lock = threading.RLock()

    def halt(self) -> None:
        """Let no later pulse be queued, and interrupt those that are."""
        # First of all: a delivery checks it, with the lock held, before it queues a pulse.
        self._halted.set()
        # Wait while a pulse is being queued, but not for ever: the queue must be cleared even if that hangs.
        is_held = self._lock.acquire(timeout=QUEUEING_S)
        try:
            self.interrupt()
        finally:
            if is_held:
                self._lock.release()

    def interrupt(self) -> None:
        """Stop pulses in progress on every channel, and clear the queue."""
        self.neurons.interrupt(self.cl.ChannelSet(*SITES))

    def deliver(self, stimuli: Sequence[Stimulus], duration_s: float, since: int) -> tuple[Observed, int, int]:
        """Deliver, and read until `duration_s` after the loop starts, extended by the delay of the stimuli.

        Times of stimuli count from the frame `since`, no later than the start. Also returns how many spikes were not on
        electrodes, and how many are from before the start; raises DeviceFailed if it was stopped half way, or a pulse
        never came.
        """
        waiting, requested = deque(stimuli), [since + _frames(stimulus.time_s) for stimulus in stimuli]
        queued: list[int] = []
        frames, channels, reported = [], [], defaultdict[int, deque[int]](deque)
        late, start, stop = 0, None, 0
        for tick in self.neurons.loop(self._ticks_per_s, **self._jitter):
            analysis = tick.analysis
            if start is None:
                start = int(analysis.start_timestamp)
            stop = int(analysis.stop_timestamp)
            frames += [spike.timestamp for spike in analysis.spikes]
            channels += [spike.channel for spike in analysis.spikes]
            for pulse in sorted(analysis.stims, key=lambda pulse: pulse.timestamp):
                reported[pulse.channel].append(pulse.timestamp)
            self._expect_going(len(queued), len(stimuli))
            while waiting and requested[len(queued)] + late < stop + AHEAD_FRAMES:
                # A stop from another thread comes either before the pulse is queued, or after, and then removes it.
                with self._lock:
                    self._expect_going(len(queued), len(stimuli))
                    frame, latest = self._queue(waiting.popleft(), requested[len(queued)] + late)
                late = latest - requested[len(queued)]
                queued.append(frame)
            end = start + int(np.ceil(duration_s * FRAMES_PER_S)) + late
            if not waiting and stop >= max(end, queued[-1] + 1 if queued else 0):
                tick.loop.stop()
        if start is None or waiting:
            raise DeviceFailed(f"CL1: expected a loop over {duration_s:g} s, got one that ended early")
        began = [_began(stimulus, due, reported, start) for stimulus, due in zip(stimuli, queued, strict=True)]
        frame_of, row = np.array(frames, np.int64), _ROW_OF[np.array(channels, np.int64)]
        is_late = frame_of < start
        frame_of, row = frame_of[~is_late], row[~is_late]
        observed = observed_in_frames(start, stop, frame_of, row, np.array(began, np.float64), FRAMES_PER_S)
        return observed, int(np.count_nonzero(row == UNKNOWN)), int(np.count_nonzero(is_late))

    def _expect_going(self, queued: int, total: int) -> None:
        if total and self._halted.is_set():
            sent = f"{queued} of {total} stimuli had been sent to the device"
            raise DeviceFailed(f"CL1: stopped while delivering: {sent}, and what had not begun was interrupted")

    def _queue(self, stimulus: Stimulus, frame: int) -> tuple[int, int]:
        """Queue one stimulus on the device, at a frame or as soon as possible after it.

        Returns that frame, and the latest at which it comes: if the program was held up meanwhile, the frame may have
        passed, and the device delivers at once.
        """
        earliest = int(self.neurons.timestamp()) + self._margin_frames + LEAD_FRAMES
        alone = [replace(stimulus, time_s=0.0)]
        frame = round(self.guard.earliest(alone, max(frame, earliest) / FRAMES_PER_S) * FRAMES_PER_S)
        self.guard.admit(alone, frame / FRAMES_PER_S)
        plan = self.neurons.create_stim_plan()
        plan.stim(self.cl.ChannelSet(*stimulus.electrodes), self._design_of(stimulus.pulse), lead_time_us=LEAD_US)
        plan.run(at_timestamp=frame - LEAD_FRAMES)
        latest = max(frame, int(self.neurons.timestamp()) + LEAD_FRAMES)
        self.guard.delay_last(stimulus, (latest - frame) / FRAMES_PER_S)
        if self.stream is not None:
            self.stream.append(frame, json.dumps({**parameters_of(stimulus), "phases": stimulus.pulse.to_list()}))
        return frame, latest

    def _design(self, pulse: Pulse) -> Any:
        return self.cl.StimDesign(*(n for phase in pulse.phases for n in (round(phase.duration_us), phase.amplitude)))


def _frames(time_s: float) -> int:
    """A time in whole frames, halves rounded up: rounded to even, equal intervals would differ by two frames."""
    return math.floor(round(time_s * FRAMES_PER_S, 6) + 0.5)


def _began(stimulus: Stimulus, frame: int, reported: dict[int, deque[int]], start: int) -> int:
    """The frame at which the device reports the first pulse of a stimulus; it must report all its electrodes."""
    began = []
    for electrode in stimulus.electrodes:
        while reported[electrode] and reported[electrode][0] < frame:
            reported[electrode].popleft()
        if not reported[electrode]:
            at_s = (frame - start) / FRAMES_PER_S
            expected = f"a pulse on channel {electrode} {at_s:g} s into the delivery"
            raise DeviceFailed(f"CL1: expected {expected}, got none: the device left it out")
        began.append(reported[electrode].popleft())
    return min(began)


def sdk(module: str = "cl") -> ModuleType:
    """The vendor's package, or a part of it; DeviceFailed, with what to do, if it is not installed."""
    missing = "culture: expected the vendor's package cl-sdk for a cl1, which is not installed"
    how = f"on Python 3.12 or later {install_command('cl1')} (its licence is CC BY-NC 4.0); on a CL1 it is preinstalled"
    return vendor_module(module, f"{missing}: {how}")
