"""How electrodes of a MaxOne are wired to amplifiers and stimulation units, with checks that the device omits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int64

from animat.cultures.devices.maxone_stream import AMPLIFIERS
from animat.errors import DeviceFailed
from animat.recordings.recording import Channels
from animat.stimulation.selection import Selection
from animat.tables import UNKNOWN

UNITS = 32


@dataclass(frozen=True, eq=False)
class Wiring:
    """The wiring of a selection.

    Attributes:
        channels: recording electrodes that were routed.
        row_of: row of `channels` for each amplifier, -1 if it has none.
        not_routed: recording electrodes that were selected but not routed.
        unit_of: stimulation unit of each stimulation electrode.
    """

    channels: Channels
    row_of: Int64[np.ndarray, " amplifiers"]
    not_routed: tuple[int, ...]
    unit_of: dict[int, int]


def wire(mx: Any, selection: Selection, *, wait: Callable[[str], None]) -> Wiring:
    """Route, connect, check, download, and compensate offsets; the units are left powered but not connected.

    Args:
        mx: the vendor's module, initialised.
        wait: called after a step with the vendor's name of the waiting time.

    Raises:
        DeviceFailed: naming the stimulation electrodes that were not routed, have no unit, or share one.
    """
    array = mx.Array("stimulation")
    array.reset()
    array.clear_selected_electrodes()
    recording, stimulation = selection.recording.tolist(), selection.stimulation.tolist()
    array.select_electrodes(recording)
    array.select_stimulation_electrodes(stimulation)
    array.route()
    amplifier_of = _routed(array)
    lost = [electrode for electrode in stimulation if electrode not in amplifier_of]
    if lost:
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
    return Wiring(
        channels=Channels.on(selection.array, np.array(routed, dtype=np.int64), amplifier),
        row_of=row_of,
        not_routed=tuple(electrode for electrode in recording if electrode not in amplifier_of),
        unit_of=unit_of,
    )


def _routed(array: Any) -> dict[int, int]:
    """The amplifier of each electrode that was routed."""
    amplifier_of: dict[int, int] = {}
    taken: set[int] = set()
    for mapping in array.get_config().mappings:
        amplifier, electrode = int(mapping.channel), int(mapping.electrode)
        if not 0 <= amplifier < AMPLIFIERS:
            raise DeviceFailed(f"MaxOne: expected amplifiers from 0 to {AMPLIFIERS - 1}, got {amplifier}")
        # Some versions list an amplifier twice: which electrode it then reads is unknown.
        if amplifier in taken:
            amplifier_of = {e: a for e, a in amplifier_of.items() if a != amplifier}
        else:
            amplifier_of[electrode] = amplifier
        taken.add(amplifier)
    return amplifier_of


def _connect(array: Any, electrodes: list[int]) -> dict[int, int]:
    """Connect each electrode to a separate unit; raises DeviceFailed if some have none or share one."""
    unit_of: dict[int, int] = {}
    without, shared = [], []
    for electrode in electrodes:
        array.connect_electrode_to_stimulation(electrode)
        reply = str(array.query_stimulation_at_electrode(electrode)).strip()
        if not reply.isdigit() or int(reply) >= UNITS:
            without.append(electrode)
            continue
        other = next((e for e, unit in unit_of.items() if unit == int(reply)), None)
        if other is None:
            unit_of[electrode] = int(reply)
        else:
            shared.append(f"electrodes {other} and {electrode} share unit {reply}")
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
    return unit_of


def _named(electrodes: list[int]) -> str:
    return f"electrode{'s' * (len(electrodes) > 1)} {', '.join(map(str, electrodes))}"
