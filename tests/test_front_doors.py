"""Random requests through every backend's front door: what comes out of the other side is within the limits.

Oracle: what the devices' stand-ins saw (for the CL1 and the MaxOne on their own clocks, from designs, codes and units),
or what the simulated backends were given, checked by array arithmetic that shares nothing with the guard.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

import stand_in_cl
import stand_in_maxlab
from animat.cultures.base import Culture
from animat.cultures.devices.cl1 import CL1_LIMITS, SITES, CL1Culture
from animat.cultures.devices.maxone import MAXONE_LIMITS, MaxOneCulture
from animat.cultures.observed import Observed, Spikes
from animat.cultures.replay import ReplayCulture
from animat.cultures.safety import SIMULATED_LIMITS, Admitted, Limits
from animat.errors import UnsafeStimulus
from animat.stimulation.array import MAXONE
from animat.stimulation.pulse import Phase, Pulse
from animat.stimulation.selection import Selection
from animat.stimulation.stimulus import Stimulus
from cultures import small_culture
from stand_in_maxlab import LSB_MV
from synthetic_recordings import synthetic_recording

BACKENDS = ("virtual", "replay", "cl1", "maxone")
FEW: dict[str, Any] = {"stimuli_per_s": 60, "stimuli_per_electrode_s": 9}
"""Tighter than the devices', so that requests this dense often meet them."""


class Out(NamedTuple):
    """A pulse as it came out of one electrode."""

    time_s: float
    electrode: int
    phases: tuple[tuple[float, float], ...]


class Door:
    """A culture, and what came out behind its front door."""

    def __init__(self, kind: str, patch: pytest.MonkeyPatch) -> None:
        self.kind = kind
        self.given: list[Out] = []
        self.culture: Culture
        if kind == "cl1":
            self.neurons = stand_in_cl.install(patch)
            self.culture = CL1Culture(ticks_per_s=500, margin_ms=0.0, limits=replace(CL1_LIMITS, **FEW))
        elif kind == "maxone":
            self.rig = stand_in_maxlab.install(patch)
            sites = np.arange(4000, 4320, 10)
            selection = Selection(MAXONE, sites, sites, sites[None, :5])
            self.culture = MaxOneCulture(
                selection, stream=stand_in_maxlab.Stream(self.rig), settle=False, limits=replace(MAXONE_LIMITS, **FEW)
            )
        else:
            limits = replace(SIMULATED_LIMITS, **FEW, net_charge_per_session=60.0)
            self.culture = (
                small_culture(limits=limits)
                if kind == "virtual"
                else ReplayCulture([synthetic_recording(1, channels=16)], limits=limits)
            )
            patch.setattr(self.culture, "_deliver", self._take)

    def _take(self, admitted: Admitted, duration_s: float) -> Observed:
        """In place of a simulation that has nothing to do with safety: note what would act, and let time pass."""
        culture: Any = self.culture
        for stimulus in admitted.stimuli:
            phases = tuple((phase.duration_us, phase.amplitude) for phase in stimulus.pulse.phases)
            self.given += [Out(culture.now_s + stimulus.time_s, e, phases) for e in stimulus.electrodes]
        culture._now_ns += round(duration_s * 1e9)
        begun = np.array([stimulus.time_s for stimulus in admitted.stimuli])
        return Observed(0.0, duration_s, Spikes(np.empty(0), np.empty(0, np.int64)), begun)

    def acts(self, pulse: Pulse) -> bool:
        """Whether anything comes out: a voltage that is rounded to nothing does not."""
        return self.kind != "maxone" or any(abs(phase.amplitude) >= LSB_MV / 2 for phase in pulse.phases)

    def let_pass(self, duration_s: float) -> None:
        """Time passes, for free."""
        if self.kind == "cl1":
            self.neurons.now += round(duration_s * 25_000)
        elif self.kind == "maxone":
            self.rig.now += round(duration_s * 20_000)
        else:
            culture: Any = self.culture
            culture._now_ns += round(duration_s * 1e9)

    def out(self) -> list[Out]:
        """What came out since it was last asked."""
        if self.kind == "cl1":
            pulses, self.neurons.pulses = self.neurons.pulses, []
            return [
                Out(frame / 25_000, channel, tuple(zip(d.durations_us, d.currents_ua, strict=True)))
                for frame, channel, d in pulses
            ]
        if self.kind == "maxone":
            delivered, self.rig.delivered = self.rig.delivered, []
            self.rig.events.clear()
            self.rig.sent.clear()
            return [Out(d.frame / 20_000, d.electrode, tuple((50.0 * n, mv) for n, mv in d.phases)) for d in delivered]
        given, self.given = self.given, []
        return given


class Requests:
    """Requests about the edges of some limits: every second one is wrong in one way or another."""

    def __init__(self, seed: int, limits: Limits, sites: tuple[int, ...]) -> None:
        self.rng = np.random.default_rng(seed)
        self.limits, self.sites = limits, np.array(sites)
        self.unit = "amplitude_mv" if limits.kind == "voltage" else "amplitude_ua"
        self.good = [self._good() for _ in range(40)]
        self.bad = [self._bad() for _ in range(200)]

    def _phase(self, us: float, amplitude: float) -> Phase:
        return Phase(us, **{self.unit: amplitude})

    def _good(self) -> Pulse:
        limits = self.limits
        step = limits.phase_step_us or 1.0
        us = step * self.rng.integers(math.ceil(limits.phase_us[0] / step), 500 // step + 1)
        most = min(limits.amplitude, limits.charge_per_phase * 1000 / us)
        a = float(self.rng.uniform(0.05, 1.0) * most)
        if self.rng.random() < 0.3:
            return Pulse((self._phase(us, -a), self._phase(us, 0.0), self._phase(us, a)))
        return Pulse((self._phase(us, -a), self._phase(us, a)))

    def _bad(self) -> Pulse:
        rng, limits = self.rng, self.limits
        us = rng.choice([10.0, 20.0, 50.0, 150.0, 160.0, 500.0, 1000.0, 1010.0, 1e5], 4)
        a = rng.choice([0.0, 0.3, 0.5, 0.999, 1.0, 1.001, 5.0], 4) * limits.amplitude
        a *= rng.choice([-1.0, 1.0], 4)
        n = int(rng.integers(1, 5))
        if rng.random() < 0.5:
            us[1], a[1], n = us[0], -a[0], 2
        kind = self.unit if rng.random() < 0.9 else ("amplitude_ua" if self.unit == "amplitude_mv" else "amplitude_mv")
        return Pulse(tuple(Phase(float(u), **{kind: float(x)}) for u, x in zip(us[:n], a[:n], strict=True)))

    def electrodes(self) -> tuple[int, ...]:
        rng = self.rng
        if rng.random() < 0.85:
            first = int(rng.integers(len(self.sites)))
            return tuple(self.sites[(first + 3 * np.arange(rng.integers(1, 4))) % len(self.sites)].tolist())
        return tuple(rng.integers(-1, self.sites.max() + 3, rng.integers(0, 4)).tolist())

    def next(self) -> list[Stimulus]:
        rng, time_s, request = self.rng, 0.0, []
        for _ in range(1 if rng.random() < 0.8 else int(rng.integers(2, 5))):
            pulses = self.good if rng.random() < 0.6 else self.bad
            pulse = pulses[int(rng.integers(len(pulses)))]
            request.append(Stimulus(time_s, self.electrodes(), pulse))
            time_s += float(rng.choice([0.0, 0.0003, 0.001, 0.0021, 0.005, 0.01, 0.0125]))
        if rng.random() < 0.01:
            request[-1] = Stimulus(float(rng.choice([math.nan, -0.001])), request[-1].electrodes, request[-1].pulse)
        return request


def breaches(out: list[Out], limits: Limits, sites: tuple[int, ...]) -> list[str]:
    """Limits that what came out does not keep; `out` is all of a session, in any order."""
    found = []
    shapes: dict[tuple[tuple[float, float], ...], list[Out]] = defaultdict(list)
    for pulse in out:
        shapes[pulse.phases].append(pulse)
    for phases in shapes:
        us, a = np.array(phases).T
        charge = us * a / 1000
        found += ["amplitude"] * bool(np.any(np.abs(a) > limits.amplitude + limits.amplitude_step / 2 + 1e-9))
        found += ["phase_us"] * bool(np.any((us < limits.phase_us[0]) | (us > limits.phase_us[1])))
        found += ["charge_per_phase"] * bool(np.any(np.abs(charge) > limits.charge_per_phase + 1e-9))
        found += ["net_charge"] * bool(abs(charge.sum()) > limits.net_charge + 1e-9)
        found += ["phases"] * (len(us) > limits.phases_per_pulse)
        if limits.phase_step_us:
            found += ["phase_step_us"] * bool(np.any(us % limits.phase_step_us))
        if limits.alternates:
            found += ["alternates"] * bool(np.any(np.sign(a[1:]) == np.sign(a[:-1])))
    electrode = np.array([pulse.electrode for pulse in out])
    us = np.rint(np.array([pulse.time_s for pulse in out]) * 1e6)
    lasts = np.array([sum(p[0] for p in pulse.phases) for pulse in out])
    found += ["sites"] * bool(np.any(~np.isin(electrode, sites)))
    order = np.argsort(us, kind="stable")
    electrode, us, lasts = electrode[order], us[order], lasts[order]
    begins, first, count = np.unique(us, return_index=True, return_counts=True)
    found += ["electrodes_at_once"] * bool(np.any(count > limits.electrodes_at_once))
    found += ["gap_us"] * bool(np.any(np.diff(begins) < lasts[first[:-1]] + limits.gap_us - 1.5))
    within = np.arange(len(begins)) - np.searchsorted(begins, begins - 1e6 + 1.5) + 1
    found += ["stimuli_per_s"] * bool(np.any(within > limits.stimuli_per_s))
    for site in np.unique(electrode):
        own = us[electrode == site]
        found += ["interval_us"] * bool(np.any(np.diff(own) < max(limits.interval_us, 1) - 1.5))
        within = np.arange(len(own)) - np.searchsorted(own, own - 1e6 + 1.5) + 1
        found += ["stimuli_per_electrode_s"] * bool(np.any(within > limits.stimuli_per_electrode_s))
    return found


def left_over(out: list[Out], limits: Limits, left: dict[int, float]) -> list[str]:
    """Whether pulses left more charge on an electrode, at any time, than a session may; `left` is what was before."""
    found = False
    for pulse in sorted(out, key=lambda pulse: pulse.time_s):
        left[pulse.electrode] += sum(us * amplitude / 1000 for us, amplitude in pulse.phases)
        found = found or abs(left[pulse.electrode]) > limits.net_charge_per_session + 1e-6
    return ["net_charge_per_session"] * bool(found)


def end_of(request: list[Stimulus]) -> float:
    """When to end a delivery; the front door itself refuses times that are not before the end."""
    if math.isnan(request[-1].time_s):
        return 1.0
    return max([0.0, *(s.time_s for s in request)]) + 0.0001


def go_through(kind: str, number: int, seed: int, patch: pytest.MonkeyPatch) -> tuple[int, int, list[str]]:
    """Requests delivered, requests refused, and limits that were not kept."""
    door, found, done, refused = Door(kind, patch), [], 0, 0
    with door.culture as culture:
        limits, sites = culture.limits, culture.stimulation_electrodes
        requests = Requests(seed, limits, sites)
        door.out()
        out: list[Out] = []
        left: dict[int, float] = defaultdict(float)
        asked = 0
        for count in range(number):
            request = requests.next()
            end_s = end_of(request)
            try:
                culture.deliver(request, end_s)
            except UnsafeStimulus:
                refused += 1
            except Exception as error:
                assert "expected times before" in str(error), error
                refused += 1
            else:
                done += 1
                asked += sum(len(s.electrodes) for s in request if door.acts(s.pulse))
            # In turns in a hurry, against the limits on rates, and at leisure, so that much is delivered too.
            if count // 100 % 2:
                door.let_pass(float(requests.rng.choice([0.001, 0.01, 0.04])))
            elif count % 4 == 0:
                door.let_pass(float(requests.rng.choice([0.0, 0.001, 0.004, 0.01, 0.05])))
            if count % 20_000 == 19_999 or count == number - 1:
                new = door.out()
                assert len(new) == asked, "what was asked for and what came out differ"
                # A second of what was before is checked together with what came after it.
                out = [pulse for pulse in out if pulse.time_s > out[-1].time_s - 1.1] + new
                found += breaches(out, limits, sites)
                found += left_over(new, limits, left)
                asked = 0
    return done, refused, found


@pytest.fixture
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as context:
        yield context


@pytest.mark.parametrize("kind", BACKENDS)
def test_nothing_outside_the_limits_is_delivered(kind: str, patch: pytest.MonkeyPatch) -> None:
    done, refused, found = go_through(kind, 3_000, 0, patch)
    assert found == []
    assert min(done, refused) > 800


@pytest.mark.long
@pytest.mark.parametrize("kind", BACKENDS)
def test_of_a_million_requests_none_outside_the_limits_is_delivered(kind: str, patch: pytest.MonkeyPatch) -> None:
    done, refused, found = go_through(kind, 1_000_000, 1, patch)
    assert found == []
    assert done + refused == 1_000_000
    assert min(done, refused) > 250_000


def test_the_oracle_finds_each_breach() -> None:
    ok = ((160.0, -1.0), (160.0, 1.0))
    assert breaches([Out(0.0, 1, ok), Out(0.0, 2, ok), Out(0.005, 1, ok)], CL1_LIMITS, SITES) == []
    for wrong, pulses in (
        ("amplitude", [Out(0.0, 1, ((160.0, -3.1), (160.0, 3.1)))]),
        ("phase_us", [Out(0.0, 1, ((10.0, -1.0), (10.0, 1.0)))]),
        ("charge_per_phase", [Out(0.0, 1, ((1100.0, -3.0), (1100.0, 3.0)))]),
        ("net_charge", [Out(0.0, 1, ((160.0, -1.0), (180.0, 1.0)))]),
        ("phase_step_us", [Out(0.0, 1, ((150.0, -1.0), (150.0, 1.0)))]),
        ("alternates", [Out(0.0, 1, ((160.0, -1.0), (160.0, -1.0), (320.0, 1.0)))]),
        ("phases", [Out(0.0, 1, ok + ok)]),
        ("sites", [Out(0.0, 4, ok)]),
        ("gap_us", [Out(0.0, 1, ok), Out(0.00036, 2, ok)]),
        ("interval_us", [Out(0.0, 1, ok), Out(0.0049, 1, ok)]),
        ("stimuli_per_s", [Out(0.0049 * i, 1 + i % 2, ok) for i in range(204)]),
    ):
        assert wrong in breaches(pulses, CL1_LIMITS, SITES)
