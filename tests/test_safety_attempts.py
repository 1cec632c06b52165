"""Attempts to get something past the limits by accident, one after the other: each is refused, or does no harm."""

from __future__ import annotations

import copy
import math
import os
import pickle
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import FrozenInstanceError, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import stand_in_cl
import stand_in_maxlab
from animat.cultures import holding
from animat.cultures.base import Culture
from animat.cultures.budget import Budget
from animat.cultures.devices.cl1 import CL1_LIMITS, CL1_PULSE, CL1Culture
from animat.cultures.devices.maxone import MAXONE_LIMITS, MaxOneCulture
from animat.cultures.limits import SIMULATED_LIMITS, Limits
from animat.cultures.observed import Observed
from animat.cultures.openable import Turns
from animat.cultures.safety import Admitted, Guard
from animat.cultures.virtual import VirtualCulture
from animat.errors import DeviceFailed, InvalidArgument, UnsafeStimulus
from animat.stimulation.array import MAXONE
from animat.stimulation.pulse import BALANCED_PULSE, PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.selection import Selection
from animat.stimulation.stimulus import Stimulus
from fake_culture import FakeCulture
from test_safety import DEVICE


class Seen(FakeCulture):
    """Keeps what it is given to deliver."""

    def __init__(self, device: Limits = SIMULATED_LIMITS, **settings: Any) -> None:
        super().__init__(**settings)
        self.stands = device
        self.seen: list[tuple[float, Stimulus]] = []

    device_limits = property(lambda self: self.stands)  # type: ignore[assignment]

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        self.seen += [(admitted.now_s + stimulus.time_s, stimulus) for stimulus in admitted.stimuli]
        return super()._deliver(admitted, duration_s)


def one(time_s: float = 0.0, pulse: Pulse = BALANCED_PULSE, electrodes: Any = (100,)) -> Stimulus:
    return Stimulus(time_s, electrodes, pulse)


# Threads.


@pytest.fixture
def quick_switches() -> Iterator[None]:
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before_s)


def test_two_threads_with_single_stimuli_never_overlap(quick_switches: None) -> None:
    culture = Seen(limits=replace(SIMULATED_LIMITS, stimuli_per_session=600)).open()

    def ask() -> None:
        for _ in range(500):
            try:
                culture.deliver([one(electrodes=(100 + len(culture.seen) % 8,))], 0.002)
            except UnsafeStimulus:
                culture.advance(0.05)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    times_s = [time_s for time_s, _ in culture.seen]
    assert len(times_s) == 600 == culture.delivered
    assert min(b - a for a, b in pairwise(times_s)) >= 0.001 - 1e-9
    assert all(b - a >= 1.0 - 1e-9 for a, b in zip(times_s, times_s[200:], strict=False))


class Hanging(Seen):
    """Its delivery does not come back until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.is_under_way, self.let_go = threading.Event(), threading.Event()

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        self.is_under_way.set()
        assert self.let_go.wait(60)
        return super()._deliver(admitted, duration_s)


def test_a_stop_a_close_and_a_new_session_wait_for_nothing_that_hangs() -> None:
    culture, refused = Hanging(), list[Exception]()

    def ask() -> None:
        try:
            culture.deliver([one()], 0.1)
        except UnsafeStimulus as error:
            refused.append(error)

    with culture:
        hanging, waiting = threading.Thread(target=ask), threading.Thread(target=ask)
        hanging.start()
        assert culture.is_under_way.wait(60)
        waiting.start()
        assert not refused
        culture.stop("smoke")
        waiting.join(60)
        assert len(refused) == 1
        assert "smoke" in str(refused[0])
        with pytest.raises(UnsafeStimulus, match=r"stopped: .*smoke"):
            culture.deliver([one()], 0.1)
        assert culture.halted == 1
    assert not culture.is_open
    with culture:
        assert culture.delivered == 0
        with pytest.raises(UnsafeStimulus):
            # The one that hangs counts as delivered.
            culture.deliver([one()], 0.1)
        culture.let_go.set()
        hanging.join(60)
        culture.rest(1.0)
        culture.deliver([one()], 0.1)
    assert len(culture.seen) == 2


def test_a_close_from_another_thread_ends_what_is_delivered() -> None:
    culture = Hanging().open()
    hanging = threading.Thread(target=lambda: culture.deliver([one()], 0.1))
    hanging.start()
    assert culture.is_under_way.wait(60)
    culture._halt = culture.let_go.set  # type: ignore[method-assign]
    culture.close()
    hanging.join(60)
    assert not hanging.is_alive()
    with pytest.raises(InvalidArgument, match="expected an open one"):
        culture.deliver([one()], 0.1)


def test_a_call_that_was_on_its_way_when_it_was_closed_is_refused() -> None:
    turns, halted = Turns(Guard(SIMULATED_LIMITS, (100,))), list[int]()
    turns.end(lambda: halted.append(1), 0.1)
    with pytest.raises(InvalidArgument, match="got one that was closed meanwhile"), turns:
        pass
    # Another thread is told the same, and does not wait. None had a turn, so nothing was to be halted.
    turns.guard.stop("it was closed")
    with ThreadPoolExecutor(1) as thread, pytest.raises(InvalidArgument, match="got one that was closed meanwhile"):
        thread.submit(turns.__enter__).result()
    assert halted == []


def test_a_delivery_from_within_a_delivery_is_refused() -> None:
    class Within(Seen):
        def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
            if admitted.stimuli:
                self.deliver([], 0.1)
            return super()._deliver(admitted, duration_s)

    with Within() as culture, pytest.raises(InvalidArgument, match="one call to end before the next"):
        culture.deliver([one()], 0.1)


def test_two_threads_open_it_once() -> None:
    opening, let_go = threading.Event(), threading.Event()

    class Slow(Seen):
        def _open(self) -> None:
            super()._open()
            opening.set()
            assert let_go.wait(60)

    culture = Slow()
    thread = threading.Thread(target=culture.open)
    thread.start()
    assert opening.wait(60)
    with pytest.raises(InvalidArgument, match="is being opened or closed"):
        culture.open()
    # An emergency stop before it is open holds once it is.
    culture.stop("smoke")
    let_go.set()
    thread.join(60)
    with pytest.raises(UnsafeStimulus, match="smoke"):
        culture.deliver([one()], 0.1)


class Opening(Seen):
    """Its opening does not end until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.is_under_way, self.let_go = threading.Event(), threading.Event()

    def _open(self) -> None:
        self.is_under_way.set()
        assert self.let_go.wait(60)


def test_a_close_while_another_thread_opens_leaves_it_closed() -> None:
    culture = Opening()
    opens, closes = threading.Thread(target=culture.open), threading.Thread(target=culture.close)
    opens.start()
    assert culture.is_under_way.wait(60)
    closes.start()
    # It waits, or had nothing to do.
    closes.join(0.05)
    culture.let_go.set()
    opens.join(60)
    closes.join(60)
    assert not culture.is_open


def test_a_backend_that_closes_or_opens_while_it_opens_waits_for_nothing() -> None:
    class Reentrant(Seen):
        def _open(self) -> None:
            self.close()
            with pytest.raises(InvalidArgument, match="is being opened or closed"):
                self.open()

    with Reentrant() as culture:
        assert culture.is_open


@pytest.mark.filterwarnings("ignore:os.fork")
def test_a_fork_while_another_thread_opens_closes_without_waiting() -> None:
    culture = Opening()
    thread = threading.Thread(target=culture.open)
    thread.start()
    assert culture.is_under_way.wait(60)
    child = os.fork()
    if child == 0:
        # Ends a child that waits for ever.
        signal.alarm(5)
        culture.close()
        os._exit(0)
    _, status = os.waitpid(child, 0)
    culture.let_go.set()
    thread.join(60)
    culture.close()
    assert status == 0


@pytest.mark.parametrize(
    ("stimuli", "is_admitted"), [([one()], True), ([], False), ([one(electrodes=(1,))], False)], ids=str
)
def test_an_error_of_a_delivery_says_whether_stimuli_were_admitted(stimuli: Any, is_admitted: bool) -> None:
    class Failing(Seen):
        def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
            raise RuntimeError("on fire")

    with Failing() as culture, pytest.raises((DeviceFailed, UnsafeStimulus)) as failed:
        culture.deliver(stimuli, 0.1)
    assert failed.value.is_admitted is is_admitted


# Times.

IMPRECISE = [np.float32(0.5), np.float16(0.5), np.array(0.5, np.float32), np.array([0.5]), "0.5", None, True, 0.5j]


@pytest.mark.parametrize("time_s", IMPRECISE, ids=lambda time_s: type(time_s).__name__)
def test_times_that_are_no_float64_are_refused_by_name(time_s: Any) -> None:
    with pytest.raises(InvalidArgument, match="time_s: expected seconds as float64"):
        one(time_s)
    with FakeCulture() as culture:
        with pytest.raises(InvalidArgument, match="duration_s: expected seconds as float64"):
            culture.advance(time_s)
        with pytest.raises(InvalidArgument, match="duration_s: expected seconds as float64"):
            culture.rest(time_s)
        if time_s is not None:
            with pytest.raises(InvalidArgument, match="since_s: expected seconds as float64"):
                culture.deliver([], 0.1, since_s=time_s)
        with pytest.raises(InvalidArgument, match="now_s: expected seconds as float64"):
            Guard(SIMULATED_LIMITS, (100,)).admit([one()], time_s)
    assert culture.pulses == 0


def test_a_backend_whose_clock_is_less_precise_delivers_nothing() -> None:
    class Imprecise(Seen):
        now_s = property(lambda self: np.float32(10_000.0))  # type: ignore[assignment]

    with pytest.raises(InvalidArgument, match="now_s: expected seconds as float64"):
        Imprecise().open()


@pytest.mark.parametrize("start_s", [0.0, 1e4, 1e5])
def test_after_hours_pulses_that_follow_each_other_at_once_are_as_far_apart(start_s: float) -> None:
    """At 764 pulses of 800 us: float32 had 382 of them overlap after 10,000 s."""
    pulse = Pulse((Phase(400, amplitude_mv=-100), Phase(400, amplitude_mv=100)))
    culture = Seen()
    culture._now_s = start_s
    with culture:
        for number in range(764):
            culture.rest(0.0052)
            culture.deliver([one(np.float64(0.0), pulse, (100 + number % 8,))], 0.0002)
            with pytest.raises(UnsafeStimulus, match=r"100[.0-9]* us too early"):
                culture.deliver([one(np.float64(0.0005), pulse)], 0.00051)
    assert len(culture.seen) == 764
    assert min(b - a for (a, _), (b, _) in pairwise(culture.seen)) >= 0.0008 - 1e-9


# Limits.

EXTREME = [
    0,
    1,
    2,
    0.5,
    1e-9,
    1e9,
    1e300,
    math.inf,
    -1,
    math.nan,
    True,
    False,
    "current",
    (1e-9, 1e9),
    (100, 200),
    None,
]


@given(
    st.fixed_dictionaries({}, optional={each.name: st.sampled_from(EXTREME) for each in fields(Limits)}),
    st.integers(0, 10**6),
)
@pytest.mark.parametrize("device", [CL1_LIMITS, MAXONE_LIMITS, SIMULATED_LIMITS, DEVICE])
def test_no_field_of_limits_that_is_tightened_loosens_anything(
    device: Limits, changed: dict[str, Any], seed: int
) -> None:
    """Whatever limits are let through, field by field and in any combination: what they admit, the device's do."""
    try:
        culture = Seen(device, limits=replace(device, **changed)).open()
    except InvalidArgument:
        return
    rng = np.random.default_rng(seed)
    unit = "amplitude_mv" if device.kind == "voltage" else "amplitude_ua"
    as_device = Guard(device, range(100, 108))
    for _ in range(10):
        culture.rest(float(rng.choice([0.0, 0.01, 1.0])))
        us = float(rng.choice([20.0, 100.0, 160.0, 500.0, 980.0]))
        a = float(rng.choice([0.3, 1.0, 3.0, 100.0, 300.0, 401.0]))
        second = float(rng.choice([0.0, a, a, a, -a, a + 10.0]))
        pulse = Pulse((Phase(us, **{unit: -a}), Phase(us, **{unit: second}))[: int(rng.integers(1, 3))])
        now_s = culture.now_s
        try:
            culture.deliver([one(0.0, pulse, (100,))], 0.001)
        except UnsafeStimulus:
            continue
        as_device.admit([one(0.0, pulse, (100,))], now_s)


def test_every_field_of_limits_is_looked_at() -> None:
    """Each field can be made looser, and is then refused by its name: a new one cannot be forgotten."""
    names = [each.name for each in fields(Limits)]
    looser: dict[str, Any] = {name: 2 * getattr(DEVICE, name) for name in names if name != "kind"}
    looser |= {"kind": "current", "phase_us": (1.0, DEVICE.phase_us[1]), "alternates": False}
    looser |= {name: getattr(DEVICE, name) / 2 for name in ("interval_us", "gap_us", "phase_step_us")}
    assert set(looser) == set(names)
    for name, value in [*looser.items(), ("phase_us", (DEVICE.phase_us[0], 1e6))]:
        with pytest.raises(InvalidArgument, match=rf"^limits\.{name}: expected no looser"):
            replace(DEVICE, **{name: value}).check_within(DEVICE)


@pytest.mark.parametrize("amplitude_step", [1e-9, 1.0, 1e9])
def test_a_step_of_amplitude_where_the_device_has_none_lets_no_unbalanced_pulse_through(
    amplitude_step: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in_cl.install(monkeypatch)
    with pytest.raises(InvalidArgument, match=r"limits\.amplitude_step"):
        CL1Culture(limits=replace(CL1_LIMITS, amplitude_step=amplitude_step)).open()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("stimuli_per_s", True),
        ("stimuli_per_s", 1.5),
        ("stimuli_per_s", math.nan),
        ("electrodes_at_once", math.inf),
        ("amplitude", "400"),
        ("amplitude", np.array([400.0])),
        ("amplitude", 1j),
        ("amplitude", None),
        ("amplitude", 10**400),
        ("alternates", "False"),
        ("alternates", 1),
        ("phase_us", 50.0),
        ("phase_us", (1, 2, 3)),
        ("kind", ["voltage"]),
    ],
)
def test_limits_that_are_none_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(InvalidArgument, match=f"^{name}: expected"):
        replace(SIMULATED_LIMITS, **{name: value})


def test_limits_of_arrays_and_lists_do_not_change_after_they_were_checked() -> None:
    amplitude, phase_us = np.array(100.0), [100.0, 500.0]
    limits = replace(SIMULATED_LIMITS, amplitude=amplitude, phase_us=phase_us, alternates=np.True_)
    with Seen(limits=limits) as culture:
        amplitude[...] = 1e9
        phase_us[:] = [1e-9, 1e9]
        assert culture.limits == replace(SIMULATED_LIMITS, amplitude=100.0, phase_us=(100.0, 500.0), alternates=True)
        assert [type(getattr(culture.limits, name)) for name in ("amplitude", "alternates")] == [float, bool]
        with pytest.raises(UnsafeStimulus, match="amplitude"):
            culture.deliver([one()], 0.1)
        with pytest.raises(FrozenInstanceError):
            culture.limits.amplitude = 1e9  # type: ignore[misc]


def test_limits_of_a_subclass_are_what_their_attributes_say() -> None:
    class Wide(Limits):
        def check_within(self, device: Limits) -> None:
            pass

    wide = Wide(**{each.name: getattr(SIMULATED_LIMITS, each.name) for each in fields(Limits)} | {"amplitude": 1e9})
    culture = FakeCulture(limits=wide)
    culture._open = lambda: pytest.fail("opened in vain")  # type: ignore[method-assign]
    with pytest.raises(InvalidArgument, match=r"limits\.amplitude"):
        culture.open()
    with pytest.raises(InvalidArgument, match="expected Limits, got dict"):
        FakeCulture(limits={"amplitude": 1e9})  # type: ignore[arg-type]


# What stimuli are made of.


@pytest.mark.parametrize("kind", [np.int8, np.int16, np.int64, np.float16, np.float32, np.float64, int])
def test_numbers_of_any_type_give_the_right_charge(kind: Any) -> None:
    pulse = Pulse([Phase(kind(100), amplitude_mv=kind(-120)), Phase(kind(100), amplitude_mv=kind(120))])  # type: ignore[arg-type]
    assert [type(phase.duration_us) for phase in pulse.phases] == [float, float]
    assert [phase.charge for phase in pulse.phases] == [-12.0, 12.0]
    with Seen() as culture:
        culture.deliver([one(0.0, pulse, np.array([100, 101], np.int8))], 0.1)
        stimulus = culture.seen[0][1]
        # As text: it has no frequency, and from Python 3.13 on no record equals another where both have NaN.
        assert str(stimulus) == str(Stimulus(0.0, (100, 101), pulse))
        assert {type(electrode) for electrode in stimulus.electrodes} == {int}
    made = Stimulus(0.0, (kind(100), kind(101)), pulse, frequency_hz=kind(5), pattern=kind(3), presentation=kind(7))
    numbers = [*made.electrodes, made.frequency_hz, made.pattern, made.presentation]
    assert [(type(number), number) for number in numbers] == [(int, 100), (int, 101), (float, 5.0), (int, 3), (int, 7)]


def test_an_int8_at_its_edge_is_no_small_amplitude() -> None:
    """|-128| is -128 in int8."""
    pulse = Pulse((Phase(100, amplitude_mv=np.int8(-128)), Phase(100, amplitude_mv=128)))
    limits = replace(SIMULATED_LIMITS, amplitude=100.0)
    with FakeCulture(limits=limits) as culture, pytest.raises(UnsafeStimulus, match="-100 to 100 mV, got -128"):
        culture.deliver([one(0.0, pulse)], 0.1)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Phase(True, amplitude_mv=1), "duration_us: expected a number, got True"),
        (lambda: Phase(100, amplitude_mv="1"), "amplitude_mv: expected a number, got '1'"),
        (lambda: Phase(100, amplitude_mv=np.array([1.0, 2.0])), r"amplitude_mv: expected a number, got \[1.0, 2.0\]"),
        (lambda: Pulse([{"duration_us": 1}]), "phases.amplitude: expected either amplitude_mv or amplitude_ua"),
        (lambda: Pulse(5), "phases: expected a list, got 5"),
        (lambda: one(electrodes=[100.5]), "electrodes: expected a whole number, got 100.5"),
        (lambda: one(electrodes=[True]), "electrodes: expected a whole number, got True"),
        (lambda: one(electrodes=100), "electrodes: expected several, got int"),
        (lambda: one(pulse=None), "pulse: expected a Pulse, got NoneType"),
        (lambda: FakeCulture().open().deliver([{"time_s": 0}], 1.0), "stimuli: expected Stimulus, got dict"),
        (lambda: FakeCulture().open().deliver(None, 1.0), "stimuli: expected several Stimulus, got NoneType"),
    ],
)
def test_what_stimuli_cannot_be_made_of_is_one_line(make: Callable[[], object], words: str) -> None:
    with pytest.raises(InvalidArgument, match=words) as refused:
        make()
    assert "\n" not in str(refused.value)


def test_a_request_that_can_be_read_once_is_delivered_whole() -> None:
    with Seen() as culture:
        culture.deliver((one(0.1 * number) for number in range(3)), 1.0)
        assert len(culture.seen) == 3


# Charge.


def test_what_pulses_leave_on_an_electrode_is_summed_over_a_session() -> None:
    limits = replace(SIMULATED_LIMITS, net_charge_per_session=100.0)
    with Seen(limits=limits) as culture:
        request = [one(0.1 * number, PUBLISHED_PULSE, (100 + number % 2,)) for number in range(10)]
        culture.deliver(request, 1.0)
        before = culture.now_s
        with pytest.raises(UnsafeStimulus, match="-100 to 100 mV ms on an electrode, got -120 on electrode 100") as no:
            culture.deliver([one(0.1, BALANCED_PULSE, (101,)), one(0.2, PUBLISHED_PULSE)], 1.0)
        assert no.value.limit == "net_charge_per_session"
        assert culture.now_s == before
        # What balances takes nothing, what goes the other way gives back.
        back = Pulse((Phase(400, amplitude_mv=-200), Phase(500, amplitude_mv=200)))
        culture.deliver([one(0.1), one(0.2, back), one(0.3, PUBLISHED_PULSE)], 1.0)
    with culture:
        culture.deliver([one(0.1, PUBLISHED_PULSE)], 1.0)


def test_the_papers_pulse_lives_through_the_papers_study_in_one_session() -> None:
    """Fifteen recordings of 500 stimuli and 100,000 iterations, all on one electrode: more than the paper has."""
    limits = replace(SIMULATED_LIMITS, stimuli_per_electrode_s=200)
    pulses = int(SIMULATED_LIMITS.net_charge_per_session / abs(PUBLISHED_PULSE.net_charge))
    assert pulses == 500_000 > 15 * 500 + 100_000
    guard = Guard(replace(limits, net_charge_per_session=1_000 * abs(PUBLISHED_PULSE.net_charge)), (100,))
    for number in range(1_000):
        guard.admit([one(0.0, PUBLISHED_PULSE)], 0.0125 * number)
    with pytest.raises(UnsafeStimulus, match="leave -20000 to 20000 mV ms on an electrode") as no:
        guard.admit([one(0.0, PUBLISHED_PULSE)], 12.5)
    assert no.value.limit == "net_charge_per_session"


# Budgets.


@pytest.mark.parametrize("value", [math.nan, math.inf, True, 1.5, "1", -1, np.array([1])])
@pytest.mark.parametrize("name", ["pulses", "pulses_per_electrode"])
def test_budgets_that_are_no_whole_number_are_refused(name: str, value: Any) -> None:
    with pytest.raises(InvalidArgument, match=f"budget.{name}: expected"):
        Budget(**{name: value})
    assert Budget(**{name: np.int16(3)}) == Budget(**{name: 3})
    assert type(getattr(Budget(**{name: np.int16(3)}), name)) is int


# Copies.


@pytest.mark.parametrize("is_open", [False, True], ids=["closed", "open"])
@pytest.mark.parametrize(
    "make", [copy.copy, copy.deepcopy, pickle.dumps, lambda it: replace(it), lambda it: copy.copy([it])[0].__copy__()]
)
def test_a_culture_cannot_be_copied(make: Callable[[Any], Any], is_open: bool) -> None:
    culture = FakeCulture()
    if is_open:
        culture.open()
    with pytest.raises((InvalidArgument, TypeError, AttributeError)):
        make(culture)


# JAX, where another test imported it, warns of every fork; the child does nothing of JAX.
@pytest.mark.filterwarnings("ignore:os.fork")
def test_what_a_fork_copied_delivers_nothing_and_closes_nothing(tmp_path: Path) -> None:
    report = tmp_path / "report"
    with Seen() as culture:
        child = os.fork()
        if child == 0:
            try:
                try:
                    culture.deliver([one()], 0.1)
                except InvalidArgument as error:
                    report.write_text(f"{error}; {len(culture.seen)}; ")
                closed: list[int] = []
                culture._close = lambda: closed.append(1)  # type: ignore[method-assign]
                culture.close()
                report.write_text(report.read_text() + f"closed {len(closed)}")
            finally:
                os._exit(0)
        os.waitpid(child, 0)
        assert report.read_text() == (
            "culture: expected one that this process opened, got a copy made by a fork; 0; closed 0"
        )
        culture.deliver([one()], 0.1)


def test_what_was_admitted_is_neither_changed_nor_copied() -> None:
    admitted = Guard(SIMULATED_LIMITS, (100,)).admit([one()], 0.0)
    for attempt in (
        lambda: setattr(admitted, "stimuli", ()),
        lambda: copy.copy(admitted),
        lambda: copy.deepcopy(admitted),
        lambda: pickle.dumps(admitted),
    ):
        with pytest.raises(InvalidArgument, match=r"^Admitted"):
            attempt()


# Subclasses.


@pytest.mark.parametrize(
    "name",
    [
        *("deliver", "stop", "limits", "__enter__", "_opened", "close", "_rehearse", "__exit__"),
        *("__getattribute__", "__setattr__", "__reduce_ex__", "__copy__", "__deepcopy__"),
    ],
)
def test_a_backend_cannot_take_the_place_of_what_is_not_its_own(name: str) -> None:
    with pytest.raises(TypeError, match=rf"Mine\.{name}: final in Culture"):
        type("Mine", (FakeCulture,), {name: lambda *_: None})
    with pytest.raises(TypeError, match=rf"Mine\.{name}: final in Culture"):
        type("Mine", (type("Beside", (), {name: lambda *_: None}), Culture), {})


def test_a_guard_or_a_history_that_a_backend_puts_in_by_accident_is_not_asked() -> None:
    class Mine(Seen):
        def _open(self) -> None:
            self._guard = self.guard = Guard(replace(SIMULATED_LIMITS, amplitude=1e9), (100,))
            self._history = self._turns = None

    with Mine() as culture, pytest.raises(UnsafeStimulus, match="amplitude"):
        culture.deliver([one(0.0, Pulse((Phase(100, amplitude_mv=-500), Phase(100, amplitude_mv=500))))], 0.1)


@pytest.mark.parametrize("device", [CL1Culture, MaxOneCulture])
def test_nobody_loosens_the_limits_of_a_device(device: type[Culture]) -> None:
    looser = property(lambda self: replace(SIMULATED_LIMITS, amplitude=1e9))
    beside = type("Beside", (), {"device_limits": looser})
    for bases, names in (((device,), {"device_limits": looser}), ((beside, device), {})):
        with pytest.raises(TypeError, match=rf"Mine\.device_limits: final in {device.__name__}"):
            type("Mine", bases, names)
    type("Mine", (device,), {})
    for culture in (CL1Culture(), VirtualCulture(1)):
        with pytest.raises(AttributeError):
            culture.device_limits = replace(culture.device_limits, amplitude=1e9)  # type: ignore[misc]


def test_limits_of_a_device_that_change_meanwhile_are_those_at_its_opening() -> None:
    class Mine(Seen):
        allows_mv = 100.0
        device_limits = property(lambda self: replace(SIMULATED_LIMITS, amplitude=self.allows_mv))  # type: ignore[assignment]

    with Mine() as culture:
        culture.allows_mv = 1e9
        assert culture.limits.amplitude == 100.0
        with pytest.raises(UnsafeStimulus, match="amplitude"):
            culture.deliver([one()], 0.1)


# One device.


def maxone(patch: pytest.MonkeyPatch, number: int) -> list[Culture]:
    rig = stand_in_maxlab.install(patch)
    sites = np.array([4430, 4455])
    selection = Selection(MAXONE, np.arange(13_000, 13_050), sites, np.array([[4430], [4455]]))
    return [MaxOneCulture(selection, stream=stand_in_maxlab.Stream(rig), settle=False) for _ in range(number)]


def cl1(patch: pytest.MonkeyPatch, number: int) -> list[Culture]:
    stand_in_cl.install(patch)
    return [CL1Culture() for _ in range(number)]


@pytest.mark.parametrize("is_simulator", [False, True])
@pytest.mark.parametrize(("make", "electrode", "pulse"), [(cl1, 1, CL1_PULSE), (maxone, 4430, BALANCED_PULSE)])
def test_a_device_is_held_by_one_object_and_forgets_nothing_when_another_takes_it(
    make: Any, electrode: int, pulse: Pulse, is_simulator: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = make(monkeypatch, 2)
    if make is cl1:
        sys.modules["cl"].is_simulator = lambda: is_simulator
    stimuli = [Stimulus(0.011 * number, (electrode,), pulse) for number in range(90)]
    with first:
        first.deliver(stimuli, 1.0)
        with pytest.raises(DeviceFailed, match="another culture object holds, in this program or another: close it"):
            second.open()
        assert not second.is_open
        ended_s = first.now_s
        first.advance(0.1)
    with second:
        # Its clock is the device's, or counts from here: either way a second passed that no rate looks back beyond.
        assert make is maxone or second.now_s >= ended_s + 1.0
        second.deliver(stimuli, 1.0)
    with first:
        first.deliver(stimuli, 1.0)
        # It had the device last itself, and knows what it delivered: nothing has to pass.
        ended_s = first.now_s
    with first:
        assert first.now_s < ended_s + 0.1


@pytest.mark.parametrize("limit", ["interval_us", "gap_us"])
def test_who_takes_a_device_over_waits_as_long_as_its_limits_look_back(
    limit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Seen, "device", holding.of_the_machine("shared"), raising=False)
    limits = replace(SIMULATED_LIMITS, **{limit: 3e6})
    with Seen(limits=limits):
        pass
    with Seen(limits=limits) as second:
        # Each counts from the same time.
        assert second.now_s == FakeCulture().now_s + 3


HOLD = """
import sys
from pathlib import Path
from animat.cultures import holding
holding.MACHINE = Path(sys.argv[1])
with holding.hold(holding.of_the_machine("maxone"), "another"):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_device_is_held_by_one_program(monkeypatch: pytest.MonkeyPatch) -> None:
    (culture,) = maxone(monkeypatch, 1)
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(holding.MACHINE)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(DeviceFailed, match="in this program or another"):
            culture.open()
        # However it ends.
        other.kill()
        other.wait()
    with culture:
        assert culture.now_s >= 1.0


def test_a_device_is_open_to_all_users_whatever_the_umask(tmp_path: Path) -> None:
    device = tmp_path / "animat-cl1"
    before = os.umask(0o077)
    try:
        for holder, is_handed_over in (("first", False), ("first", False), ("b", True), ("b", False)):
            with holding.hold(device, holder) as found:
                assert found is is_handed_over
    finally:
        os.umask(before)
    modes = [stat.S_IMODE(each.stat().st_mode) for each in (device, *device.iterdir())]
    # No user can remove another's.
    assert modes == [0o1777, 0o666]


def test_a_folder_that_cannot_hold_a_device_is_its_failure_and_no_link_is_followed(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir(mode=0o700)
    (mine / "letter").write_text("private")
    file, link, planted = (tmp_path / f"animat-{name}" for name in ("file", "link", "planted"))
    file.write_text("")
    link.symlink_to(mine)
    planted.mkdir()
    (planted / "held_last_by").symlink_to(mine / "letter")
    for device in (file, link, planted):
        with pytest.raises(DeviceFailed, match=f"^{device.name}: expected") as failed, holding.hold(device, "a"):
            pass
        assert "--out" not in str(failed.value)
    assert stat.S_IMODE(mine.stat().st_mode) == 0o700
    assert [(each.name, each.read_text()) for each in mine.iterdir()] == [("letter", "private")]


def test_a_device_that_cannot_be_opened_is_let_go_of(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = maxone(monkeypatch, 2)
    rig = first._given_stream.rig  # type: ignore[attr-defined]
    rig.is_gone = True
    with pytest.raises(DeviceFailed):
        first.open()
    rig.is_gone = False
    with second:
        pass
