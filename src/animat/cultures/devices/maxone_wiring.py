"""How electrodes of a MaxOne are wired to amplifiers and stimulation units, with checks that the device omits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64

from animat.cultures.devices.maxone_stream import AMPLIFIERS
from animat.errors import DeviceFailed
from animat.recordings.recording import Channels
from animat.stimulation.selection import Selection
from animat.tables import UNKNOWN

UNITS = 32


class Wiring(NamedTuple):
    """Recording electrodes that were routed, and those that were not; the unit of each stimulation electrode."""

    channels: Channels
    row_of: Int64[np.ndarray, " amplifiers"]
    """Row of `channels` for each amplifier, -1 if it has none."""
    not_routed: tuple[int, ...]
    unit_of: dict[int, int]


def wire(mx: Any, selection: Selection, *, wait: Callable[[str], None]) -> Wiring:
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
        raise DeviceFailed(
            f"MaxOne: expected all {len(stimulation)} stimulation electrodes to be routed, but not {_named(lost)}: "
            "choose others nearby, or fewer recording electrodes"
        )
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
    return Wiring(Channels.on(selection.array, np.array(routed, np.int64), amplifier), row_of, not_routed, unit_of)


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
    electrode_of: dict[int, int] = {}
    without, shared = [], []
    for electrode in electrodes:
        array.connect_electrode_to_stimulation(electrode)
        reply = str(array.query_stimulation_at_electrode(electrode)).strip()
        unit = int(reply) if reply.isdigit() else UNITS
        if unit >= UNITS:
            without.append(electrode)
        elif unit in electrode_of:
            shared.append(f"electrodes {electrode_of[unit]} and {electrode} share unit {unit}")
        else:
            electrode_of[unit] = electrode
    if without:
        raise DeviceFailed(
            f"MaxOne: expected a stimulation unit for each stimulation electrode, but there is none for "
            f"{_named(without)}: choose others nearby"
        )
    if shared:
        raise DeviceFailed(
            f"MaxOne: expected a separate stimulation unit for each stimulation electrode, but {'; '.join(shared)}: "
            "choose another near one of each pair"
        )
    return {electrode: unit for unit, electrode in electrode_of.items()}


def _named(electrodes: list[int]) -> str:
    return f"electrode{'s' * (len(electrodes) > 1)} {', '.join(map(str, electrodes))}"
