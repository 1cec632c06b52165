"""Stimuli as sequences of a MaxOne's commands: units connected, converter codes, delays in samples."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

from animat.cultures.limits import steps_of
from animat.recordings.formats.stimulus_text import parameters_of
from animat.stimulation.pulse import Pulse
from animat.stimulation.stimulus import Stimulus

FRAMES_PER_S = 20_000
SAMPLE_US = 50.0
INITIAL_DELAY = 100
"""Samples (5 ms) before the first command of a sequence, in which all of it arrives, so that its times are exact."""
ZERO_CODE = 512
WELL = 0
EVENT_TYPE = 1
MOST_KEPT = 1000


def dac_code(amplitude_mv: float, lsb_mv: float) -> int:
    """The converter's 10-bit code of a voltage: 512 is 0 V, and lower codes are *positive*, as the units invert.

    code = 512 - round(V / lsb)
    """
    return ZERO_CODE - steps_of(amplitude_mv, lsb_mv)


class Sequences:
    """Builds sequences of stimuli, and keeps one on the device for each pattern and pulse delivered singly.

    Trains are not assembled from kept sequences, as intervals between sequences depend on the computer and are inexact.
    """

    def __init__(self, mx: Any, unit_of: Mapping[int, int], lsb_mv: float) -> None:
        self._mx, self._unit_of, self._lsb_mv = mx, unit_of, lsb_mv
        self._kept: dict[tuple[tuple[int, ...], int, Pulse], Any] = {}
        self._passing: list[Any] = []
        self._numbers, self._events = count(1), count(1)

    def of(self, stimuli: Sequence[Stimulus]) -> Any:
        """A sequence that delivers these stimuli, the first `INITIAL_DELAY` samples after sending."""
        if len(stimuli) > 1:
            # A sequence leaves the device with its last reference; those of earlier deliveries are no longer running.
            self._passing = [*self._passing[-100:], self._build(stimuli, is_kept=False)]
            return self._passing[-1]
        key = stimuli[0].electrodes, stimuli[0].pattern, stimuli[0].pulse
        if key not in self._kept:
            if len(self._kept) >= MOST_KEPT:
                self.delete()
            self._kept[key] = self._build(stimuli, is_kept=True)
        return self._kept[key]

    def delete(self) -> None:
        """Remove all of them from the device."""
        for sequence in self._kept.values():
            # The vendor's module removes a sequence with its object, unless it is persistent.
            sequence.persistent = False
        self._kept.clear()
        self._passing.clear()

    def _build(self, stimuli: Sequence[Stimulus], *, is_kept: bool) -> Any:
        sequence = self._mx.Sequence(f"animat_{next(self._numbers)}", initial_delay=INITIAL_DELAY, persistent=is_kept)
        at = 0
        for stimulus in stimuli:
            begins = round((stimulus.time_s - stimuli[0].time_s) * FRAMES_PER_S)
            if begins > at:
                sequence.append(self._mx.DelaySamples(begins - at))
            at = begins + self._append(sequence, stimulus, is_kept)
        return sequence

    def _append(self, sequence: Any, stimulus: Stimulus, is_kept: bool) -> int:
        """Append one stimulus; returns its duration in samples."""
        mx, units = self._mx, [self._unit_of[electrode] for electrode in stimulus.electrodes]
        data = parameters_of(stimulus)
        if is_kept:
            # Nothing that differs between its uses.
            data = {name: data[name] for name in ("electrodes", "pattern") if name in data}
        sequence.append(mx.Event(WELL, EVENT_TYPE, next(self._events), json.dumps(data)))
        for unit in units:
            sequence.append(mx.StimulationUnit(unit).power_up(True).connect(True).set_voltage_mode().dac_source(0))
        lasted = 0
        for phase in stimulus.pulse.phases:
            assert phase.amplitude_mv is not None
            samples = round(phase.duration_us / SAMPLE_US)
            sequence.append(mx.DAC(0, dac_code(phase.amplitude_mv, self._lsb_mv)))
            sequence.append(mx.DelaySamples(samples))
            lasted += samples
        sequence.append(mx.DAC(0, ZERO_CODE))
        for unit in units:
            sequence.append(mx.StimulationUnit(unit).power_up(True).connect(False).set_voltage_mode().dac_source(0))
        return lasted
