"""The commands of a MaxOne: electrodes routed, and checked as the device does not, and stimuli as sequences."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64

from animat.cultures.devices.maxone_stream import AMPLIFIERS
from animat.cultures.limits import steps_of
from animat.errors import DeviceFailed
from animat.recordings.formats.stimulus_text import parameters_of
from animat.recordings.recording import Channels
from animat.stimulation.pulse import Pulse
from animat.stimulation.selection import Selection
from animat.stimulation.stimulus import Stimulus
from animat.tables import UNKNOWN

UNITS = 32
FRAMES_PER_S = 20_000
SAMPLE_US = 50.0
INITIAL_DELAY = 100
"""Samples (5 ms) before the first command of a sequence, in which all of it arrives, so that its times are exact."""
ZERO_CODE = 512
WELL = 0
EVENT_TYPE = 1
MOST_KEPT = 1000


class Routing(NamedTuple):
    """Recording electrodes that were routed, and those that were not; the unit of each stimulation electrode."""

    channels: Channels
    row_of: Int64[np.ndarray, " amplifiers"]
    """Row of `channels` for each amplifier, -1 if it has none."""
    not_routed: tuple[int, ...]
    unit_of: dict[int, int]


def route(mx: Any, selection: Selection, *, wait: Callable[[str], None]) -> Routing:
    """Route, connect, check, download, and compensate offsets; the units are left powered but not connected.

    `wait` is called after a step with the vendor's name of the waiting time. Raises DeviceFailed, naming the
    stimulation electrodes that were not routed, have no unit, or share one.
    """
    array = mx.Array("stimulation")
    array.reset()
    array.clear_selected_electrodes()
    recording, stimulation = selection.recording.tolist(), selection.stimulation.tolist()
    array.select_electrodes(recording)
    array.select_stimulation_electrodes(stimulation)
    array.route()
    amplifier_of = _routed(array)
    if lost := [electrode for electrode in stimulation if electrode not in amplifier_of]:
        lack = f"but not {_named(lost)}: choose others nearby, or fewer recording electrodes"
        raise DeviceFailed(f"MaxOne: expected all {len(stimulation)} stimulation electrodes to be routed, {lack}")
    unit_of = _connect(array, stimulation)
    array.download()
    wait("waitAfterDownload")
    mx.offset()
    wait("waitInMX1Offset")
    mx.clear_events()
    for unit in unit_of.values():
        mx.send(mx.StimulationUnit(unit).power_up(True).connect(False).set_voltage_mode().dac_source(0))
    routed = [electrode for electrode in recording if electrode in amplifier_of]
    amplifier = np.array([amplifier_of[electrode] for electrode in routed], dtype=np.int64)
    row_of = np.full(AMPLIFIERS, UNKNOWN, dtype=np.int64)
    row_of[amplifier] = np.arange(len(routed))
    not_routed = tuple(electrode for electrode in recording if electrode not in amplifier_of)
    return Routing(Channels.on(selection.array, np.array(routed, np.int64), amplifier), row_of, not_routed, unit_of)


def _routed(array: Any) -> dict[int, int]:
    """The amplifier of each electrode that was routed."""
    mappings = [(int(mapping.electrode), int(mapping.channel)) for mapping in array.get_config().mappings]
    for _, amplifier in mappings:
        if not 0 <= amplifier < AMPLIFIERS:
            raise DeviceFailed(f"MaxOne: expected amplifiers from 0 to {AMPLIFIERS - 1}, got {amplifier}")
    # Some versions list an amplifier twice: which electrode it then reads is unknown.
    listed = Counter(amplifier for _, amplifier in mappings)
    return {electrode: amplifier for electrode, amplifier in mappings if listed[amplifier] == 1}


def _connect(array: Any, electrodes: list[int]) -> dict[int, int]:
    """Connect each electrode to a separate unit; raises DeviceFailed if some have none or share one."""
    on_unit: dict[int, list[int]] = defaultdict(list)
    for electrode in electrodes:
        array.connect_electrode_to_stimulation(electrode)
        reply = str(array.query_stimulation_at_electrode(electrode)).strip()
        on_unit[int(reply) if reply.isdigit() else UNITS].append(electrode)
    expected = "MaxOne: expected a separate stimulation unit for each stimulation electrode"
    if without := [electrode for unit, connected in on_unit.items() if unit >= UNITS for electrode in connected]:
        raise DeviceFailed(f"{expected}, but there is none for {_named(without)}: choose others nearby")
    several = {unit: " and ".join(map(str, connected)) for unit, connected in on_unit.items() if len(connected) > 1}
    if shared := "; ".join(f"electrodes {connected} share unit {unit}" for unit, connected in several.items()):
        raise DeviceFailed(f"{expected}, but {shared}: choose another near one of them")
    return {electrode: unit for unit, (electrode,) in on_unit.items()}


def _named(electrodes: list[int]) -> str:
    return f"electrode{'s' * (len(electrodes) > 1)} {', '.join(map(str, electrodes))}"


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
