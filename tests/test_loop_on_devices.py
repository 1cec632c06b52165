"""A closed loop on devices: their clocks go on while the program works, and they can be gone."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stand_in_cl
import stand_in_maxlab
from animat.closed_loop.agents import Agent, OneCondition
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session, read_session
from animat.closed_loop.timing import Clock
from animat.coding.mapping import Thresholds
from animat.cultures.base import Culture
from animat.cultures.devices.cl1 import CL1_PULSE, CL1Culture
from animat.cultures.devices.maxone import MaxOneCulture
from animat.errors import DeviceFailed
from animat.responses.condition import Condition
from animat.robots import Navigation
from animat.stimulation.array import MAXONE
from animat.stimulation.patterns import draw_patterns
from animat.stimulation.pulse import BALANCED_PULSE, Pulse
from animat.stimulation.selection import Selection

HZ = (5.0, 20.0)
BY_FREQUENCY = tuple(Condition(f"{f:g} Hz", f, "Hz") for f in HZ)


def selection() -> Selection:
    sites = np.array([(20 + 25 * (i // 8)) * 220 + 15 + 25 * (i % 8) for i in range(32)])
    return Selection(MAXONE, np.arange(13_000, 13_050), sites, draw_patterns(MAXONE, sites, seed=1))


def loop_at(
    tmp_path: Path,
    culture: Culture,
    pulse: Pulse,
    chosen: int,
    conditions: tuple[Condition, ...] = BY_FREQUENCY,
    clock: Clock | None = None,
) -> Session:
    loop = Loop(
        robot=Navigation(episode_limit=10),
        mapping=Thresholds(9),
        conditions=conditions,
        percentiles=np.linspace(0.0, 125.0, 11),
        pulses=5,
        pulse=pulse,
        pause_s=0.1,
        warm_up=0,
        on_late="stop",
        real_time=clock is not None,
    )
    with culture:
        return run_session(culture, loop, [Agent("one", "", OneCondition(chosen))], tmp_path, episodes=2, clock=clock)


def assert_in_time(session: Session, chosen: int, frame_s: float) -> None:
    assert session.ending.by == "plan", session.ending.message
    ticks = list(session.ticks)
    assert len(ticks) == 20
    assert [tick.late_s for tick in ticks] == [0.0] * 20
    for episode in (0, 1):
        times_s = np.concatenate([tick.pulse_time_s for tick in ticks if tick.episode == episode])
        np.testing.assert_allclose(np.diff(times_s), 1 / HZ[chosen], atol=1.5 * frame_s)


@pytest.mark.parametrize("chosen", [0, 1])
def test_a_cl1_is_in_time(tmp_path: Path, chosen: int, monkeypatch: pytest.MonkeyPatch) -> None:
    neurons = stand_in_cl.install(monkeypatch)
    read = neurons.timestamp

    def running() -> int:
        frame = read()
        # 3 ms go by until somebody does something with it.
        neurons.now += 0 if neurons.in_loop else 75
        return frame

    monkeypatch.setattr(neurons, "timestamp", running)
    assert_in_time(loop_at(tmp_path, CL1Culture(), CL1_PULSE, chosen), chosen, 1 / 25_000)


@pytest.mark.parametrize("rate", [0.9, 1.1])
def test_a_device_keeps_its_own_time_in_real_time_too(
    tmp_path: Path, rate: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    neurons = stand_in_cl.install(monkeypatch)

    class Drifting(Clock):
        """The machine's clock, slower or faster than the device's."""

        def now_s(self) -> float:
            return rate * neurons.now / 25_000

        def sleep_until(self, time_s: float) -> None:
            neurons.now = max(neurons.now, int(time_s * 25_000 / rate))

    assert_in_time(loop_at(tmp_path, CL1Culture(), CL1_PULSE, 1, clock=Drifting()), 1, 1 / 25_000)


@pytest.mark.parametrize("chosen", [0, 1])
def test_a_maxone_is_in_time_however_long_its_sequences_take_to_make(
    tmp_path: Path, chosen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = stand_in_maxlab.install(monkeypatch)

    class Running(stand_in_maxlab.Stream):
        def frame(self) -> int:
            rig.now += 1
            return rig.now - 1

    vendor = sys.modules["maxlab"].Sequence
    append = vendor.append

    def slowly(sequence: Any, command: Any) -> None:
        # Some 90 commands make the five pulses of an action: over 100 ms at 5 Hz, 9 ms at 20 Hz.
        rig.now += (25, 2)[chosen]
        append(sequence, command)

    monkeypatch.setattr(vendor, "append", slowly)
    culture = MaxOneCulture(selection(), stream=Running(rig), settle=False)
    assert_in_time(loop_at(tmp_path, culture, BALANCED_PULSE, chosen), chosen, 1 / 20_000)


def assert_on(session: Session, chosen: tuple[int, ...]) -> None:
    """All pulses were in time and on the chosen electrodes, as in the session's recording."""
    assert session.ending.by == "plan", session.ending.message
    assert [tick.late_s for tick in session.ticks] == [0.0] * 20
    stimuli = session.recording().stimuli
    assert len(stimuli) == 100
    assert {frozenset(row) - {-1} for row in stimuli.electrodes.tolist()} == {frozenset(chosen)}


@pytest.mark.parametrize("chosen", [0, 1])
def test_a_cl1_is_stimulated_on_the_chosen_electrodes(
    tmp_path: Path, chosen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    neurons = stand_in_cl.install(monkeypatch)
    sets = ((1, 20, 40), (2, 30))
    on = tuple(Condition(f"electrodes {one}", i, "", (20.0,), (one,)) for i, one in enumerate(sets))
    assert_on(loop_at(tmp_path, CL1Culture(), CL1_PULSE, chosen, on), sets[chosen])
    # What the device delivered, and not only what it was asked for.
    assert {channel for _, channel, _ in neurons.pulses} == set(sets[chosen])
    assert len(neurons.pulses) == 100 * len(sets[chosen])


@pytest.mark.parametrize("chosen", [0, 1])
def test_a_maxone_is_stimulated_on_the_chosen_electrodes(
    tmp_path: Path, chosen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = stand_in_maxlab.install(monkeypatch)
    picked = selection()
    sets = tuple(tuple(picked.stimulation[places].tolist()) for places in ([0, 9, 31], [4, 20]))
    on = tuple(Condition(f"electrodes {one}", i, "", (20.0,), (one,)) for i, one in enumerate(sets))
    culture = MaxOneCulture(picked, stream=stand_in_maxlab.Stream(rig), settle=False)
    assert_on(loop_at(tmp_path, culture, BALANCED_PULSE, chosen, on), sets[chosen])
    assert {pulse.electrode for pulse in rig.delivered} == set(sets[chosen])
    assert len(rig.delivered) == 100 * len(sets[chosen])


def test_a_cl1_that_is_gone_is_a_lost_connection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    neurons = stand_in_cl.install(monkeypatch)
    loop, loops = neurons.loop, [0]

    def lost(*given: int, **more: object) -> Iterator[object]:
        loops[0] += 1
        neurons.is_gone = loops[0] >= 8
        return loop(*given, **more)

    monkeypatch.setattr(neurons, "loop", lost)
    with pytest.raises(DeviceFailed, match="cl1: expected it to close, got ConnectionResetError"):
        loop_at(tmp_path, CL1Culture(), CL1_PULSE, 0)
    ending = read_session(tmp_path).ending
    assert ending.by == "culture"
    assert "the connection to the culture is lost: DeviceFailed: CL1" in ending.message
    assert "could not be interrupted" in ending.message
    assert "BUT the culture could not be stopped" in ending.message


def test_a_cl1_whose_loop_is_late_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    neurons = stand_in_cl.install(monkeypatch)
    neurons.fail = TimeoutError("Loop fell behind by 1 frame (40 us)")
    ending = loop_at(tmp_path, CL1Culture(), CL1_PULSE, 0).ending
    assert ending.message.startswith(
        "the culture raised DeviceFailed: CL1: expected a loop over 0.1 s, got TimeoutError"
    )


@pytest.mark.parametrize("where", ["server", "stream"])
def test_a_maxone_that_is_gone_is_a_lost_connection(
    tmp_path: Path, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = stand_in_maxlab.install(monkeypatch)

    class Silent(stand_in_maxlab.Stream):
        def wait(self, frame: int) -> None:
            rig.is_gone = rig.is_gone or (where == "stream" and len(rig.sent) >= 5)
            super().wait(frame)

    def lose() -> None:
        rig.is_gone = where == "server" and len(rig.sent) >= 5
        rig.answer()

    rig.on_send = lose
    with pytest.raises(DeviceFailed, match="maxone: expected it to close, got ConnectionRefusedError"):
        loop_at(tmp_path, MaxOneCulture(selection(), stream=Silent(rig), settle=False), BALANCED_PULSE, 0)
    ending = read_session(tmp_path).ending
    assert ending.by == "culture"
    assert ending.message.startswith("the connection to the culture is lost: DeviceFailed")
    assert "BUT the culture could not be stopped" in ending.message
