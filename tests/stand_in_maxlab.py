"""A stand-in for MaxLab Live's module `maxlab` and its stream, written from notes, as no device is at hand.

It does what the notes say the device does: nothing acts before `download`; routing drops stimulation electrodes in
silence and undoes connections; two electrodes can get the same unit; an answer is a text, empty where there is none; a
DAC code of 512 is 0 V and less is positive; a sequence starts some frames after `send`, and in it delays are exact; one
that is not persistent goes with its object. What it says was delivered is read from the codes and the units alone.
"""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from animat.cultures import holding
from animat.errors import DeviceFailed

LSB_MV = 2.981901


@dataclass
class Delivered:
    """A pulse as it came out of one electrode: the frame it began, and (samples, mV) of each phase."""

    frame: int
    electrode: int
    phases: list[tuple[int, float]]


@dataclass
class Rig:
    """What there is of the device, and what tests want of it."""

    drop: set[int] = field(default_factory=set)
    without_unit: set[int] = field(default_factory=set)
    same_unit: dict[int, int] = field(default_factory=dict)
    jitter: int = 0
    lsb_mv: object = str(LSB_MV)
    now: int = 1_000_000
    powered: bool = False
    units: dict[int, dict[str, Any]] = field(default_factory=dict)
    wired: dict[int, int] = field(default_factory=dict)
    code: int = 512
    delivered: list[Delivered] = field(default_factory=list)
    sequences: dict[str, list[Any]] = field(default_factory=dict)
    events: list[tuple[int, str]] = field(default_factory=list)
    sent: list[str] = field(default_factory=list)
    busy_until: int = 0
    dead: bool = False
    is_gone: bool = False
    on_send: Any = None
    # A sequence that has begun ends before the next command: what power that is cut does to a pulse is not known.
    at_work: Any = field(default_factory=threading.RLock)

    def answer(self) -> None:
        """Nothing can be asked of a server that is not there."""
        if self.is_gone:
            raise ConnectionRefusedError("no server is there")

    def run(self, commands: list[Any]) -> None:
        """Execute a sequence on the device's clock."""
        at = self.now + self.jitter
        assert at >= self.busy_until, "a sequence was sent while another one was running"
        under_way: dict[int, Delivered] = {}
        since = at
        for command in commands:
            kind = command.kind
            if kind == "delay":
                at += command.samples
            elif kind == "event":
                self.events.append((at, command.text))
            elif kind == "unit":
                self._note(under_way, since, at)
                self.units[command.number], since = dict(command.state), at
                # A pulse is over when its unit lets go of the electrode.
                for electrode, unit in self.wired.items():
                    if unit == command.number and not command.state["connected"] and electrode in under_way:
                        self.delivered.append(under_way.pop(electrode))
            elif kind == "dac":
                self._note(under_way, since, at)
                self.code, since = command.code, at
        assert not under_way and self.code == 512, "a sequence ended while a unit was connected or a voltage on"
        self.busy_until = at

    def _note(self, under_way: dict[int, Delivered], since: int, at: int) -> None:
        if at == since or not self.powered:
            return
        for electrode, unit in self.wired.items():
            state = self.units.get(unit, {})
            if self.code == 512 and electrode not in under_way:
                continue
            if state.get("power") and state.get("connected") and state.get("dac") == 0 and state.get("voltage"):
                pulse = under_way.setdefault(electrode, Delivered(since, electrode, []))
                pulse.phases.append((at - since, (512 - self.code) * LSB_MV))


class Stream:
    """The stand-in's stream: time passes only when it is waited for. A pulse is answered by a spike 5 ms later."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.is_on = False
        self.extra: list[tuple[int, int]] = []

    def start(self) -> None:
        self.is_on = True

    def stop(self) -> None:
        self.is_on = False

    def frame(self) -> int:
        return self.rig.now

    def wait(self, frame: int) -> None:
        if self.rig.is_gone:
            raise DeviceFailed("MaxOne: expected frames, got none any more") from ConnectionError(
                "nothing came for 2 s"
            )
        self.rig.now = max(self.rig.now, frame)

    def take(self, start: int, stop: int) -> Any:
        answers = list(self.extra)
        for pulse in reversed(self.rig.delivered):
            if pulse.frame + 100 < start:
                break
            answers.append((pulse.frame + 100, 7))
        table = np.array(sorted(s for s in answers if start <= s[0] < stop), dtype=np.int64).reshape(-1, 2)
        return table[:, 0], table[:, 1]


def install(patch: pytest.MonkeyPatch) -> Rig:
    """Put the stand-in where `maxlab` is imported from, until the test ends."""
    rig = Rig()
    module: Any = ModuleType("maxlab")

    class StimulationUnit:
        kind = "unit"

        def __init__(self, number: int) -> None:
            self.number, self.state = int(number), {"voltage": True, "dac": 0}

        def _set(self, **what: Any) -> StimulationUnit:
            self.state |= what
            return self

        def power_up(self, on: bool) -> StimulationUnit:
            return self._set(power=on)

        def connect(self, on: bool) -> StimulationUnit:
            return self._set(connected=on)

        def set_voltage_mode(self) -> StimulationUnit:
            return self._set(voltage=True)

        def dac_source(self, dac: int) -> StimulationUnit:
            return self._set(dac=dac)

    class Core:
        kind = "core"

        def enable_stimulation_power(self, on: bool) -> Core:
            self.on = on
            return self

    class Array:
        def __init__(self, token: str = "online") -> None:
            self.wanted: list[int] = []
            self.stimulation: list[int] = []
            self.routed: dict[int, int] = {}
            self.connected: dict[int, int] = {}

        def reset(self) -> None:
            self.routed, self.connected = {}, {}

        def clear_selected_electrodes(self) -> None:
            self.wanted, self.stimulation = [], []

        def select_electrodes(self, electrodes: list[int]) -> None:
            self.wanted += electrodes

        def select_stimulation_electrodes(self, electrodes: list[int]) -> None:
            self.stimulation += electrodes

        def route(self) -> None:
            chosen = dict.fromkeys(e for e in [*self.stimulation, *self.wanted] if e not in rig.drop)
            self.routed = {electrode: i for i, electrode in enumerate(list(chosen)[:1024])}
            self.connected = {}

        def get_config(self) -> Any:
            return SimpleNamespace(
                mappings=[SimpleNamespace(channel=a, electrode=e, x=0.0, y=0.0) for e, a in self.routed.items()]
            )

        def connect_electrode_to_stimulation(self, electrode: int) -> str:
            if electrode not in self.routed or electrode in rig.without_unit:
                return "Error"
            shared = rig.same_unit.get(electrode)
            taken = set(self.connected.values())
            free = next((unit for unit in range(32) if unit not in taken), None)
            unit = self.connected.get(shared) if shared is not None else free
            if unit is not None:
                self.connected[electrode] = unit
            return "Ok"

        def query_stimulation_at_electrode(self, electrode: int) -> str:
            return str(self.connected[electrode]) if electrode in self.connected else ""

        def download(self) -> None:
            rig.wired = dict(self.connected)

    class Sequence:
        def __init__(self, token: str, initial_delay: int = 100, persistent: bool = False) -> None:
            self.token, self.persistent = token, persistent
            rig.sequences[token] = [SimpleNamespace(kind="delay", samples=initial_delay)]

        def append(self, command: Any) -> None:
            rig.sequences[self.token].append(command)

        def send(self) -> None:
            rig.answer()
            rig.sent.append(self.token)
            if rig.on_send is not None:
                rig.on_send()
            with rig.at_work:
                rig.run(rig.sequences[self.token])

        def __del__(self) -> None:
            if not self.persistent:
                rig.sequences.pop(self.token, None)

    def send(command: Any) -> str:
        rig.answer()
        if command.kind == "unit":
            rig.units[command.number] = dict(command.state)
        elif command.kind == "core":
            if rig.dead and command.on:
                return "Error"
            with rig.at_work:
                rig.powered = command.on
        return "Ok"

    def dac(number: int, code: int) -> Any:
        assert 0 <= code <= 1023 and number == 0
        return SimpleNamespace(kind="dac", code=code)

    def delay(samples: int) -> Any:
        assert isinstance(samples, int) and samples > 0
        return SimpleNamespace(kind="delay", samples=samples)

    module.StimulationUnit, module.Core, module.Array, module.Sequence = StimulationUnit, Core, Array, Sequence
    module.send, module.DAC, module.DelaySamples = send, dac, delay
    module.Event = lambda well, type_, number, text: SimpleNamespace(kind="event", text=text)
    module.query_DAC_lsb_mV = lambda: rig.lsb_mv
    module.initialize = module.offset = module.clear_events = rig.answer
    patch.setitem(sys.modules, "maxlab", module)
    # It is another device: whoever held the one before holds nothing of it.
    patch.setattr(holding, "MACHINE", holding.MACHINE / "another")
    patch.setattr(holding, "_own_folder", lambda: SimpleNamespace(name=holding.MACHINE))
    return rig
