"""Every culture that ships passes the contract that ships."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest

from animat.cultures.base import Culture
from animat.cultures.contract import CultureContract
from animat.cultures.replay import ReplayCulture
from animat.cultures.safety import SIMULATED_LIMITS
from animat.cultures.virtual import VirtualCulture
from animat.errors import DeviceFailed, InvalidArgument, UnsafeStimulus
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import PUBLISHED_PULSE
from cultures import small_culture
from fake_culture import FakeCulture
from synthetic_recordings import synthetic_recording


class TestVirtualCulture(CultureContract):
    def make_culture(self) -> Culture:
        return small_culture()


class TestReplay(CultureContract):
    def make_culture(self) -> Culture:
        return ReplayCulture([synthetic_recording(1, channels=32), synthetic_recording(1, channels=32, start_min=10.0)])


class Leaky(ReplayCulture):
    """Breaks the contract: its clock stands still."""

    @property
    def now_s(self) -> float:
        return 0.0


def test_the_contract_finds_a_backend_that_breaks_it() -> None:
    class OfLeaky(CultureContract):
        def make_culture(self) -> Culture:
            return Leaky([synthetic_recording(1, channels=32)])

    with pytest.raises(AssertionError):
        OfLeaky().test_its_clock_advances_by_at_least_the_requested_time()


def test_a_device_that_fails_while_it_is_opened_is_let_go_of() -> None:
    class Broken(FakeCulture):
        closed = 0

        @property
        def stimulation_electrodes(self) -> tuple[int, ...]:
            raise DeviceFailed("the wiring cannot be asked for")

        def _close(self) -> None:
            self.closed += 1

    culture = Broken()
    with pytest.raises(DeviceFailed, match="wiring"):
        culture.open()
    assert not culture.is_open
    assert culture.closed == 1


def test_a_close_that_fails_is_reported_and_replaces_no_other_error() -> None:
    class Stuck(ReplayCulture):
        def _close(self) -> None:
            raise OSError("no route to host")

    culture = Stuck([synthetic_recording(1, channels=32)]).open()
    with pytest.raises(DeviceFailed, match="no route to host"):
        culture.close()
    assert not culture.is_open
    with pytest.raises(KeyError) as raised, culture:
        raise KeyError("of the user")
    assert any("no route to host" in note for note in raised.value.__notes__)
    assert not culture.is_open


def test_limits_can_be_tightened_and_never_loosened() -> None:
    with small_culture(limits=replace(SIMULATED_LIMITS, stimuli_per_session=1)) as culture:
        stimulus = TestVirtualCulture().stimulus(culture)
        culture.deliver([stimulus], 0.1)
        with pytest.raises(UnsafeStimulus) as refused:
            culture.deliver([stimulus], 0.1)
        assert refused.value.limit == "stimuli_per_session"
    with pytest.raises(InvalidArgument, match="never loosened"):
        small_culture(limits=replace(SIMULATED_LIMITS, amplitude=2 * SIMULATED_LIMITS.amplitude + 1)).open()


@pytest.mark.parametrize(
    ("limit", "value"),
    [
        ("stimuli_per_session", 19),
        ("stimuli_per_s", 8),
        ("stimuli_per_electrode_s", 2),
        ("net_charge_per_session", 80.0),
    ],
)
def test_a_protocol_that_breaks_a_limit_at_its_end_is_refused_before_its_first_pulse(limit: str, value: float) -> None:
    """Ten pulses at 2 Hz are within each limit, and ten at 10 Hz after them are not."""
    protocol = Protocol(frequencies_hz=(2, 10), trials=10, patterns=8, setup_s=1.0, pulse=PUBLISHED_PULSE)
    for changed in ({}, {limit: value}):
        with FakeCulture(limits=replace(SIMULATED_LIMITS, **changed)) as culture:
            now_s = culture.now_s
            if not changed:
                assert len(culture.record(protocol).stimuli) == culture.pulses == 20
                continue
            with pytest.raises(UnsafeStimulus) as refused:
                culture.record(protocol)
            assert refused.value.limit == limit
            assert (culture.pulses, culture.deliveries, culture.now_s) == (0, 0, now_s)
            assert len(culture.record(replace(protocol, frequencies_hz=(2,))).stimuli) == 10


@pytest.mark.parametrize("kind", [VirtualCulture, ReplayCulture, FakeCulture])
def test_what_is_final_cannot_be_overridden(kind: type[Culture]) -> None:
    beside = type("Beside", (), {"deliver": lambda *_: None})
    for bases, names in (((kind,), {"deliver": lambda *_: None}), ((kind,), {"limits": None}), ((beside, kind), {})):
        with pytest.raises(TypeError, match="final in Culture"):
            type("Around", bases, names)


def test_the_contract_needs_no_pytest_and_no_compiled_tissue() -> None:
    script = "import sys, animat.cultures.contract, animat.cultures.virtual, animat.cultures.series;"
    script += "print([m for m in ('pytest', 'numba', 'jax', 'pynwb', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
