"""The guard. Oracle: each limit said once more, in exact arithmetic and by counting over all pairs of times."""

from __future__ import annotations

import gc
import itertools
import math
import subprocess
import sys
import weakref
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from animat.cultures.safety import SIMULATED_LIMITS, Admitted, Guard, History, Limits
from animat.errors import InvalidArgument, UnsafeStimulus
from animat.stimulation.pulse import BALANCED_PULSE, PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.stimulus import Stimulus

SITES = range(10, 16)
LIMITS = Limits(
    kind="voltage",
    amplitude=200.0,
    phase_us=(100.0, 500.0),
    charge_per_phase=75.0,
    net_charge=10.0,
    net_charge_per_session=90.0,
    electrodes_at_once=3,
    stimuli_per_electrode_s=4,
    stimuli_per_s=6,
    stimuli_per_session=40,
)
DEVICE = replace(
    LIMITS,
    phases_per_pulse=3,
    alternates=True,
    phase_step_us=25.0,
    amplitude_step=12.5,
    interval_us=100_000.0,
    gap_us=250.0,
)
"""With what only devices ask for: 193.625 mV is 187.5 mV, as it is rounded, and 193.75 mV is 200 mV."""


def as_made(phase: Phase, limits: Limits) -> Fraction:
    """An amplitude in whole steps of the device, half a step away from 0."""
    amplitude, step = Fraction(phase.amplitude), Fraction(limits.amplitude_step)
    if not step:
        return amplitude
    size = math.floor(abs(amplitude) / step + Fraction(1, 2)) * step
    return size if amplitude > 0 else -size


def left_after(limits: Limits, left: dict[int, Fraction], stimuli: list[Stimulus]) -> list[dict[int, Fraction]]:
    """What is left on each electrode after each of the stimuli."""
    after = []
    for stimulus in stimuli:
        net = sum((as_made(p, limits) * Fraction(p.duration_us) for p in stimulus.pulse.phases), Fraction(0)) / 1000
        left = left | {e: left.get(e, Fraction(0)) + net for e in stimulus.electrodes}
        after.append(left)
    return after


def is_safe(
    limits: Limits,
    sites: Sequence[int],
    past: list[Stimulus],
    request: list[Stimulus],
    in_session: int,
    left: dict[int, Fraction],
) -> bool:
    """Whether every limit holds for all that was delivered before and the request together, `time_s` on one clock."""
    if in_session + len(request) > limits.stimuli_per_session and request:
        return False
    if any(
        abs(q) > Fraction(limits.net_charge_per_session)
        for on in left_after(limits, left, request)
        for q in on.values()
    ):
        return False
    for stimulus in request:
        electrodes = list(stimulus.electrodes)
        if len(electrodes) == 0 or len(electrodes) > limits.electrodes_at_once:
            return False
        if any(electrodes.count(e) != 1 or e not in sites for e in electrodes):
            return False
        net, phases = Fraction(0), stimulus.pulse.phases
        if len(phases) > limits.phases_per_pulse:
            return False
        for phase in phases:
            if phase.kind != limits.kind:
                return False
            amplitude, duration = Fraction(phase.amplitude), Fraction(phase.duration_us)
            charge = as_made(phase, limits) * duration / 1000
            net += charge
            if max(abs(amplitude), abs(as_made(phase, limits))) > Fraction(limits.amplitude):
                return False
            if duration < Fraction(limits.phase_us[0]) or duration > Fraction(limits.phase_us[1]):
                return False
            if limits.phase_step_us and (duration / Fraction(limits.phase_step_us)).denominator != 1:
                return False
            if max(charge, -charge) > Fraction(limits.charge_per_phase):
                return False
        for before, after in itertools.pairwise(phases):
            for a, b in ((before.amplitude, after.amplitude), (as_made(before, limits), as_made(after, limits))):
                if limits.alternates and ((a > 0 and b > 0) or (a < 0 and b < 0) or a == b == 0):
                    return False
        if max(net, -net) > Fraction(limits.net_charge):
            return False
    everything = [*past, *request]
    us = [round(Fraction(s.time_s) * 1_000_000) for s in everything]
    # Those that were delivered were looked at when they were asked for.
    for i, stimulus in enumerate(request, len(past)):
        lasts_us = sum(Fraction(p.duration_us) for p in everything[i - 1].pulse.phases)
        if i and us[i] < us[i - 1] + lasts_us + Fraction(limits.gap_us):
            return False
        second = [j for j in range(len(everything)) if us[i] - 1_000_000 < us[j] <= us[i]]
        if len(second) > limits.stimuli_per_s:
            return False
        for electrode in stimulus.electrodes:
            earlier = [us[j] for j in range(i) if electrode in everything[j].electrodes]
            if earlier and us[i] - earlier[-1] < limits.interval_us:
                return False
            if sum(electrode in everything[j].electrodes for j in second) > limits.stimuli_per_electrode_s:
                return False
    return True


class Requests:
    """Random requests about the edges of both limits; numbers are multiples of 1/8, so that products are exact."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def pick(self, *options: Any) -> Any:
        return options[self.rng.integers(len(options))]

    def pulse(self) -> Pulse:
        if self.rng.random() < 0.8:
            return self.pick(
                Pulse((Phase(375, amplitude_mv=-200), Phase(375, amplitude_mv=200))),
                Pulse((Phase(375, amplitude_mv=-193.75), Phase(325, amplitude_mv=200))),
                Pulse((Phase(500, amplitude_mv=-150), Phase(500, amplitude_mv=150))),
                Pulse((Phase(100, amplitude_mv=-100),)),
            )
        kind = "amplitude_ua" if self.rng.random() < 0.03 else "amplitude_mv"
        edge = (0.0, 6.125, 6.25, 100.0, 150.0, 187.5, 193.625, 193.75, 199.875, 200.0, 200.125)
        times = (99.875, 100.0, 325.0, 375.0, 375.125, 400.0, 500.0, 500.125)
        phases, sign = [], self.pick(-1.0, 1.0)
        us, amplitude = self.pick(*times), self.pick(*edge)
        for _ in range(self.rng.integers(1, 5)):
            phases.append(Phase(us, **{kind: sign * amplitude}))
            sign = -sign if self.rng.random() < 0.9 else sign
            # Often as long and as large as the one before: balance is not found by chance.
            us = us if self.rng.random() < 0.7 else self.pick(*times)
            amplitude = amplitude if self.rng.random() < 0.5 else self.pick(*edge)
        return Pulse(tuple(phases))

    def electrodes(self) -> tuple[int, ...]:
        if self.rng.random() < 0.9:
            return tuple(self.rng.choice(np.array(SITES), self.rng.integers(1, 4), replace=False).tolist())
        return tuple(self.rng.integers(9, 17, self.rng.integers(0, 5)).tolist())

    def stimuli(self) -> list[Stimulus]:
        """Times lie on whole microseconds, often exactly on an edge."""
        us, request = 0, []
        for _ in range(self.rng.integers(0, 6)):
            us += int(
                self.pick(0, 650, 750, 999, *[1000] * 4, 99_999, 100_000, 200_000, 200_000, 333_333, 999_999, 1_000_000)
            )
            request.append(Stimulus(us / 1_000_000, self.electrodes(), self.pulse()))
        if len(request) > 1 and self.rng.random() < 0.02:
            request.reverse()
        return request


def try_requests(limits: Limits, seed: int, number: int, start_us: int = 0) -> tuple[int, Counter[str]]:
    """Put random requests before guards and the oracle; returns how many were safe, and how many not, by limit."""
    requests, safe, unsafe = Requests(seed), 0, Counter[str]()
    history, past, now_us = History(), list[Stimulus](), start_us
    guard, left = Guard(limits, SITES, history), dict[int, Fraction]()
    for _ in range(number):
        if requests.rng.random() < 0.04:
            guard, left = Guard(limits, SITES, history, now_us / 1_000_000), {}
        request = requests.stimuli()
        shifted = [replace(s, time_s=float(Fraction(now_us, 1_000_000) + Fraction(s.time_s))) for s in request]
        before = guard.delivered
        expected = is_safe(limits, SITES, past, shifted, before, left)
        try:
            admitted = guard.admit(request, now_us / 1_000_000)
        except UnsafeStimulus as error:
            assert not expected, f"a safe request was refused: {error}\n{request}"
            assert guard.delivered == before
            unsafe[error.limit] += 1
        else:
            assert expected, f"an unsafe request passed: {request} after {past}"
            assert list(admitted.stimuli) == request
            assert guard.delivered == before + len(request)
            # All that is less than a second back is among the last of them.
            past = [*past, *shifted][-3 * limits.stimuli_per_s :]
            left = left_after(limits, left, request)[-1] if request else left
            safe += 1
        last_us = round(request[-1].time_s * 1_000_000) if request else 0
        now_us += last_us + int(requests.pick(750, 1000, 100_000, 200_000, 500_000, 1_000_000))
    return safe, unsafe


def check_counts(limits: Limits, safe: int, unsafe: Counter[str], least: int) -> None:
    assert min(safe, unsafe.total()) > least
    known = {
        "kind",
        "amplitude",
        "phase_us",
        "charge_per_phase",
        "net_charge",
        "electrodes_at_once",
        "sites",
        "overlap",
    }
    known |= {"stimuli_per_s", "stimuli_per_session", "net_charge_per_session"}
    # On a device an interval keeps the rate on an electrode, and rounding is part of the limits on charge.
    known |= {"stimuli_per_electrode_s"} if limits is LIMITS else {
        "phases_per_pulse", "phase_step_us", "alternates", "interval_us", "gap_us",
    }  # fmt: skip
    assert set(unsafe) >= known


@pytest.mark.parametrize("limits", [LIMITS, DEVICE], ids=["simulated", "device"])
def test_no_unsafe_request_passes_and_no_safe_one_is_refused(limits: Limits) -> None:
    safe, unsafe = try_requests(limits, 0, 2_500)
    check_counts(limits, safe, unsafe, 500)


@pytest.mark.parametrize(
    ("limits", "start_s"),
    [
        pytest.param(DEVICE, 100_000, id="device-100000"),
        *(
            pytest.param(*case, id=name, marks=pytest.mark.oracle)
            for name, case in {
                "device-10000": (DEVICE, 10_000),
                "simulated-10000": (LIMITS, 10_000),
                "simulated-100000": (LIMITS, 100_000),
            }.items()
        ),
    ],
)
def test_its_arithmetic_holds_after_long_sessions(limits: Limits, start_s: int) -> None:
    safe, unsafe = try_requests(limits, start_s, 1_000, start_us=1_000_000 * start_s + 7)
    assert min(safe, unsafe.total()) > 200


@pytest.mark.parametrize("limits", [LIMITS, DEVICE], ids=["simulated", "device"])
@pytest.mark.parametrize(
    "seed",
    [pytest.param(1, marks=pytest.mark.oracle), *(pytest.param(n, marks=pytest.mark.long) for n in range(2, 11))],
)
def test_among_100000_requests_none_unsafe_passes_and_none_safe_is_refused(limits: Limits, seed: int) -> None:
    # Of each seed a tenth, under both marks.
    safe, unsafe = try_requests(limits, seed, 10_000)
    assert safe + unsafe.total() == 10_000
    check_counts(limits, safe, unsafe, 2_000)


def one(pulse: Pulse = BALANCED_PULSE, electrodes: tuple[int, ...] = (10,), time_s: float = 0.0) -> Stimulus:
    return Stimulus(time_s, electrodes, pulse)


WIDE = replace(SIMULATED_LIMITS, stimuli_per_s=10, stimuli_per_electrode_s=5, stimuli_per_session=20)


@pytest.mark.parametrize(
    ("limit", "stimuli", "words"),
    [
        ("amplitude", [one(Pulse((Phase(100, amplitude_mv=-401),)))], "-400 to 400 mV, got -401"),
        ("phase_us", [one(Pulse((Phase(20, amplitude_mv=-1),)))], "phases of 50 to 1000 us, got 20"),
        ("charge_per_phase", [one(Pulse((Phase(1000, amplitude_mv=-300),)))], "-200 to 200 mV ms per phase, got -300"),
        ("net_charge", [one(Pulse((Phase(500, amplitude_mv=-60),)))], "balance to within 25 mV ms, got -30"),
        (
            "kind",
            [one(Pulse((Phase(500, amplitude_ua=-1),)))],
            "pulse: expected a voltage pulse, which this kind of culture takes, got a current pulse",
        ),
        ("electrodes_at_once", [one(electrodes=())], "expected 1 to 32 electrodes, got 0"),
        ("sites", [one(electrodes=(99,))], "got electrode 99"),
        ("sites", [one(electrodes=(10, 10))], "each electrode once"),
        ("overlap", [one(), one(time_s=0.0005)], "500 us too early"),
        ("overlap", [one(time_s=math.nan)], "finite times"),
        ("overlap", [one(time_s=math.inf)], "finite times"),
        ("overlap", [one(time_s=-1e-6)], "from 0 s on, got -1e-06"),
        ("stimuli_per_s", [one(electrodes=(10 + i % 3,), time_s=i * 0.09) for i in range(11)], "at most 10 stimuli"),
        ("stimuli_per_electrode_s", [one(time_s=i * 0.1) for i in range(6)], "at most 5 stimuli on an electrode"),
        ("stimuli_per_session", [one(time_s=float(i)) for i in range(21)], "at most 20 stimuli in a session"),
    ],
)
def test_a_refusal_names_the_limit_the_value_and_that_nothing_happened(
    limit: str, stimuli: list[Stimulus], words: str
) -> None:
    guard = Guard(WIDE, SITES)
    with pytest.raises(UnsafeStimulus, match=words) as refused:
        guard.admit(stimuli, 0.0)
    assert refused.value.limit == limit
    assert "nothing was delivered" in str(refused.value)
    assert "\n" not in str(refused.value)
    assert guard.delivered == 0
    # What was refused left no trace: as much as is allowed can still be delivered.
    guard.admit([one(time_s=i * 0.2) for i in range(5)], 0.0)


def test_the_papers_pulse_is_not_balanced_and_passes_only_where_limits_say_so() -> None:
    assert PUBLISHED_PULSE.net_charge == -20.0
    Guard(SIMULATED_LIMITS, SITES).admit([one(PUBLISHED_PULSE)], 0.0)
    with pytest.raises(UnsafeStimulus, match="net_charge: expected phases that balance to within 1 mV ms, got -20"):
        Guard(replace(SIMULATED_LIMITS, net_charge=1.0), SITES).admit([one(PUBLISHED_PULSE)], 0.0)
    assert BALANCED_PULSE.net_charge == 0.0


def test_rates_hold_across_requests_and_a_second_later_all_is_forgotten() -> None:
    guard = Guard(WIDE, SITES)
    for i in range(5):
        guard.admit([one()], 0.1 * i)
    with pytest.raises(UnsafeStimulus, match="stimuli_per_electrode_s"):
        guard.admit([one()], 0.999)
    guard.admit([one()], 1.0)


def test_an_emergency_stop_refuses_everything_until_a_new_session() -> None:
    guard = Guard(WIDE, SITES)
    guard.stop("smoke")
    guard.stop("later")
    with pytest.raises(UnsafeStimulus, match="stopped: an emergency stop is in force \\(smoke\\)"):
        guard.admit([one()], 0.0)
    assert guard.admit([], 0.0).stimuli == ()
    Guard(WIDE, SITES, History(), 0.0).admit([one()], 0.0)


@pytest.mark.parametrize("now_s", [math.nan, math.inf])
def test_a_clock_that_fails_admits_nothing(now_s: float) -> None:
    guard = Guard(WIDE, SITES)
    with pytest.raises(InvalidArgument, match=f"now_s: expected a finite time on the culture's clock, got {now_s}"):
        guard.admit([one()], now_s)
    assert guard.delivered == 0


def test_only_a_guard_admits() -> None:
    with pytest.raises(InvalidArgument, match="expected to be made by a Guard"):
        Admitted([one()], 0.0, by=None)


def test_a_gap_of_more_than_a_second_does_not_keep_the_first_stimulus_waiting() -> None:
    guard = Guard(replace(SIMULATED_LIMITS, gap_us=5e6), SITES)
    ends_s = 0.5 + BALANCED_PULSE.duration_us * 1e-6
    guard.admit([Stimulus(0.5, (10,), BALANCED_PULSE)], 0.0)
    with pytest.raises(UnsafeStimulus, match="gap_us: expected"):
        guard.check([Stimulus(0.0, (11,), BALANCED_PULSE)], ends_s + 4.999)
    guard.check([Stimulus(0.0, (11,), BALANCED_PULSE)], ends_s + 5)


def test_only_what_time_makes_safe_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    loud, last = one(Pulse((Phase(100, amplitude_mv=-401),))), one(time_s=0.2)
    for limit, least_us, earliest_s in (
        ("interval_us", 100_000.0, 0.3),
        ("interval_us", 2_000_000.0, 2.2),
        ("interval_us", 5_000_000.0, None),
        ("gap_us", 100_000.0, 0.3 + BALANCED_PULSE.duration_us * 1e-6),
    ):
        tighter: dict[str, Any] = {limit: least_us}
        guard = Guard(replace(WIDE, **tighter), SITES)
        guard.admit([last], 0.0)
        with monkeypatch.context() as patched, pytest.raises(UnsafeStimulus, match="amplitude"):
            patched.setattr(guard, "check", check := Mock(wraps=guard.check))
            guard.earliest([loud], 0.25)
        assert check.call_count == 1
        if earliest_s is None:
            with pytest.raises(UnsafeStimulus, match="interval_us"):
                guard.earliest([one()], 0.25)
        else:
            # In steps of a millisecond.
            assert earliest_s - 1e-9 <= guard.earliest([one()], 0.25) < earliest_s + 0.001


def test_limits_that_cannot_be_are_refused() -> None:
    with pytest.raises(InvalidArgument, match="phase_us: expected"):
        replace(LIMITS, phase_us=(500.0, 100.0))
    with pytest.raises(InvalidArgument, match="net_charge: expected a finite number, got nan"):
        replace(LIMITS, net_charge=math.nan)
    with pytest.raises(InvalidArgument, match=r"limits.stimuli_per_s: expected no looser than the device's 6, got 7"):
        replace(LIMITS, stimuli_per_s=7).check_within(LIMITS)
    with pytest.raises(InvalidArgument, match=r"limits.phase_us"):
        replace(LIMITS, phase_us=(50.0, 500.0)).check_within(LIMITS)
    with pytest.raises(InvalidArgument, match=r"limits.amplitude_step: expected no looser than the device's 12.5"):
        replace(DEVICE, amplitude_step=6.25).check_within(DEVICE)
    replace(DEVICE, amplitude_step=0.0, phase_us=(500.0, 500.0)).check_within(DEVICE)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Phase(100), "either amplitude_mv or amplitude_ua"),
        (lambda: Phase(100, amplitude_mv=1, amplitude_ua=1), "either amplitude_mv or amplitude_ua"),
        (lambda: Phase(0, amplitude_mv=1), "duration_us: expected more than 0, got 0"),
        (lambda: Phase(100, amplitude_mv=math.inf), "finite number, got inf"),
        (lambda: Pulse(()), "phases: expected at least 1, got"),
        (lambda: Pulse((Phase(1, amplitude_mv=1), Phase(1, amplitude_ua=1))), "got both in one pulse"),
        (lambda: Pulse.from_list([{"duration_ms": 1}]), "phases.duration_us: expected to be given"),
    ],
)
def test_pulses_that_cannot_be_are_refused(make: Any, words: str) -> None:
    with pytest.raises(InvalidArgument, match=words):
        make()


def test_a_current_pulse_has_its_charge_in_nanocoulombs() -> None:
    # 3 uA for 1000 us is 3 nC.
    assert Phase(1000, amplitude_ua=-3).charge == -3.0
    assert Pulse.from_list(PUBLISHED_PULSE.to_list()) == PUBLISHED_PULSE
    assert str(PUBLISHED_PULSE) == "-200 mV 500 us, then +200 mV 400 us"


def test_a_dropped_guard_is_freed_without_garbage_collection() -> None:
    gc.disable()
    try:
        guard = Guard(SIMULATED_LIMITS, SITES)
        guard.admit([Stimulus(0.0, (10,), BALANCED_PULSE)], 0.0)
        freed = weakref.ref(guard)
        del guard
        assert freed() is None
    finally:
        gc.enable()


def test_a_culture_that_a_program_leaves_open_is_closed_at_its_end() -> None:
    program = """
from fake_culture import FakeCulture

class Device(FakeCulture):
    def _close(self):
        print("power off", flush=True)

left, closed, again = Device().open(), Device().open(), Device().open()
closed.close()
again.close()
again.open()
print("end", flush=True)
raise SystemExit("an error")
"""
    tests = str(Path(__file__).parent)
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tests, check=False)
    assert ran.stdout.split("\n") == ["power off", "power off", "end", "power off", "power off", ""], ran.stderr
    assert ran.returncode == 1 and "Traceback" not in ran.stderr
