"""Every culture that ships passes the contract that ships."""

from __future__ import annotations

import subprocess
import sys

import pytest

from animat.cultures.base import Culture
from animat.cultures.contract import CultureContract
from animat.cultures.replay import ReplayCulture
from animat.errors import DeviceFailed
from animat.recordings.synthetic import synthetic_recording
from cultures import small_culture
from fake_culture import FakeCulture


class TestVirtualCulture(CultureContract):
    def make_culture(self) -> Culture:
        return small_culture()


class TestReplay(CultureContract):
    def make_culture(self) -> Culture:
        return ReplayCulture([synthetic_recording(1, channels=32), synthetic_recording(1, channels=32, start_min=10.0)])


class TestReplayInOrder(CultureContract):
    def make_culture(self) -> Culture:
        return ReplayCulture([synthetic_recording(2, channels=32)], how="in order")


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
        OfLeaky().test_its_clock_runs_forward_by_at_least_what_was_asked()


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


def test_the_contract_needs_no_pytest_and_no_compiled_tissue() -> None:
    told = "import sys, animat.cultures.contract, animat.cultures.virtual, animat.cultures.series;"
    told += "print([m for m in ('pytest', 'numba', 'jax', 'pynwb', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
