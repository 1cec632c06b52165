"""Limits hold whatever is closed and opened in between. Oracle: what was delivered, counted in all windows."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
import pytest

import stand_in_cl
import stand_in_maxlab
from animat.cultures.base import Culture
from animat.cultures.devices.cl1 import CL1_LIMITS, CL1_PULSE, CL1Culture
from animat.cultures.devices.maxone import MAXONE_LIMITS, MaxOneCulture
from animat.cultures.observed import Observed, Spikes
from animat.cultures.safety import SIMULATED_LIMITS, Admitted, Limits
from animat.errors import DeviceFailed, UnsafeStimulus
from animat.recordings.recording import Channels
from animat.stimulation.array import MAXONE
from animat.stimulation.pulse import BALANCED_PULSE
from animat.stimulation.selection import Selection
from animat.stimulation.stimulus import Stimulus

SITES = tuple(range(10, 16))
LIMITS = replace(
    SIMULATED_LIMITS,
    electrodes_at_once=3,
    stimuli_per_electrode_s=4,
    stimuli_per_s=6,
    stimuli_per_session=25,
    interval_us=1_300_000 / 8,
    gap_us=2_000.0,
)
DURATION_US = round(BALANCED_PULSE.duration_us)
Clock = Literal["goes on", "begins anew"]


@dataclass
class Given:
    """A stimulus that was delivered: when in truth, on what, and in which session."""

    us: int
    electrodes: tuple[int, ...]
    session: int


class Bench(Culture):
    """Records what it is given, on a clock that no session ends; it fails where the test asks it to."""

    name: ClassVar[str] = "bench"

    def __init__(self, clock: Clock, limits: Limits) -> None:
        super().__init__(limits)
        self.given: list[Given] = []
        self.us, self.zero_us, self.session = 0, 0, 0
        self.break_after_us: int | None = None
        self._clock = clock

    channels = property(lambda self: Channels(np.array(["0"]), np.array([0]), np.zeros(1), np.zeros(1)))  # type: ignore[assignment]
    stimulation_electrodes = property(lambda self: SITES)  # type: ignore[assignment]
    patterns = property(lambda self: np.array([SITES]))  # type: ignore[assignment]
    device_limits = property(lambda self: SIMULATED_LIMITS)  # type: ignore[assignment]
    now_s = property(lambda self: (self.us - self.zero_us) / 1_000_000)  # type: ignore[assignment]
    sampling_rate_hz = property(lambda self: 20_000.0)  # type: ignore[assignment]
    provenance = property(lambda self: {})  # type: ignore[assignment]

    def _open(self) -> None:
        self.session += 1
        if self._clock == "begins anew":
            self.zero_us = self.us

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        end_us, broken_us = round(duration_s * 1_000_000), self.break_after_us
        for stimulus in admitted.stimuli:
            since_us = round(stimulus.time_s * 1_000_000)
            if broken_us is None or since_us < broken_us:
                self.given.append(Given(self.us + since_us, stimulus.electrodes, self.session))
        if broken_us is not None:
            self.us += min(end_us, broken_us)
            raise DeviceFailed("bench: broken off")
        self.us += end_us
        times_s = np.array([stimulus.time_s for stimulus in admitted.stimuli])
        return Observed(self.now_s, duration_s, Spikes(np.empty(0), np.empty(0, np.int64)), times_s)

    def _rest(self, duration_s: float) -> None:
        self.us += round(duration_s * 1_000_000)

    def _halt(self) -> None:
        pass

    def _close(self) -> None:
        pass


def broken_limit(limits: Limits, given: list[Given]) -> str | None:
    """The first limit that stimuli break together, looked at window by window."""
    if max(Counter(one.session for one in given).values(), default=0) > limits.stimuli_per_session:
        return "stimuli_per_session"
    for before, after in pairwise(given):
        if after.us < before.us + DURATION_US + limits.gap_us:
            return "gap_us"
    for electrode in (None, *SITES):
        times_us = [one.us for one in given if electrode is None or electrode in one.electrodes]
        most = limits.stimuli_per_s if electrode is None else limits.stimuli_per_electrode_s
        for last, time_us in enumerate(times_us):
            if sum(time_us - 1_000_000 < earlier_us for earlier_us in times_us[: last + 1]) > most:
                return f"rate of {electrode}"
        if electrode is not None and any(b - a < limits.interval_us for a, b in pairwise(times_us)):
            return "interval_us"
    return None


def request(rng: np.random.Generator) -> tuple[list[Stimulus], int]:
    """Stimuli, each safe by itself, at times about the edges of what is safe together; and how long they take."""
    us, stimuli = int(rng.choice([0, 2_000, 100_000])), []
    for _ in range(rng.integers(0, 6)):
        electrodes = tuple(rng.choice(SITES, rng.integers(1, 4), replace=False).tolist())
        stimuli.append(Stimulus(us / 1_000_000, electrodes, BALANCED_PULSE))
        last_us, us = us, us + int(rng.choice([2_000 + DURATION_US, 100_000, 162_500, 200_000, 333_333, 1_000_000]))
    # The last pulse may still be going on when the delivery ends.
    us = last_us if stimuli and rng.random() < 0.5 else us
    return stimuli, us + int(rng.choice([1, 500, 2_000 + DURATION_US, 50_000, 300_000]))


@pytest.mark.parametrize(
    ("clock", "breaks"),
    [
        pytest.param("goes on", False, id="goes on-whole"),
        pytest.param("begins anew", True, id="begins anew-broken off"),
        pytest.param("goes on", True, id="goes on-broken off", marks=pytest.mark.oracle),
        pytest.param("begins anew", False, id="begins anew-whole", marks=pytest.mark.oracle),
    ],
)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.oracle) for seed in range(1, 5))])
def test_no_second_holds_more_than_the_limits_whatever_is_opened_anew(seed: int, clock: Clock, breaks: bool) -> None:
    rng = np.random.default_rng(seed)
    culture = Bench(clock, LIMITS).open()
    passed, refused, opened = 0, 0, 0
    for _ in range(700):
        if rng.random() < 0.3:
            culture.close()
            if rng.random() < 0.2:
                culture.us += int(rng.choice([1_000, 400_000, 1_000_000, 5_000_000]))
            culture.open()
            opened += 1
        if rng.random() < 0.2:
            culture.rest(float(rng.choice([0.1, 0.5, 1.0, 2.0])))
        stimuli, us = request(rng)
        culture.break_after_us = int(rng.integers(0, us)) if breaks and rng.random() < 0.1 else None
        wanted = [Given(culture.us + round(s.time_s * 1_000_000), s.electrodes, culture.session) for s in stimuli]
        allowed = broken_limit(LIMITS, [*culture.given[-60:], *wanted]) is None
        try:
            culture.deliver(stimuli, us / 1_000_000)
            passed += 1
        except DeviceFailed:
            # What was admitted beyond the break blocks this session, and no later one for longer than a second.
            culture.close()
            culture.open()
        except UnsafeStimulus as error:
            refused += 1
            # A clock that goes on shows exactly when everything was given: nothing that is safe is refused.
            assert not allowed or clock == "begins anew" or breaks, f"{error}: {stimuli}"
    assert broken_limit(LIMITS, culture.given) is None
    assert min(passed, refused, opened) > 100


@pytest.mark.parametrize("clock", ["goes on", "begins anew"])
def test_a_second_after_it_was_broken_off_nothing_holds_it_back(clock: Clock) -> None:
    culture = Bench(clock, LIMITS).open()
    culture.break_after_us = 500_000
    with pytest.raises(DeviceFailed):
        culture.deliver([Stimulus(0.3 * i, (10 + i % 6,), BALANCED_PULSE) for i in range(20)], 100.0)
    assert len(culture.given) == 2
    culture.break_after_us = None
    culture.close()
    culture.open()
    culture.advance(1.0)
    culture.deliver([Stimulus(0.18 * i, (10 + i,), BALANCED_PULSE) for i in range(6)], 1.0)
    assert len(culture.given) == 8
    # Nor does a stimulus of long ago, on a clock that begins anew before it.
    culture.advance(2.0)
    culture.advance(0.1)
    culture.close()
    culture.open()
    culture.deliver([Stimulus(0.0, (10,), BALANCED_PULSE)], 0.1)
    assert len(culture.given) == 9


def test_a_limit_on_intervals_may_be_longer_than_a_second() -> None:
    culture = Bench("goes on", replace(LIMITS, interval_us=2_500_000)).open()
    culture.deliver([Stimulus(0.0, (10,), BALANCED_PULSE), Stimulus(0.5, (11,), BALANCED_PULSE)], 2.0)
    culture.deliver([Stimulus(0.0, (12,), BALANCED_PULSE)], 0.4)
    for _ in range(2):
        with pytest.raises(
            UnsafeStimulus, match=r"interval_us: expected 2.5e\+06 us or more .* got 2.4e\+06 on electrode 10"
        ):
            culture.deliver([Stimulus(0.0, (10,), BALANCED_PULSE)], 0.1)
        culture.close()
        culture.open()
    culture.deliver([Stimulus(0.1, (10,), BALANCED_PULSE)], 0.2)


@pytest.mark.parametrize("clock", ["goes on", "begins anew"])
def test_a_cl1_opened_anew_goes_no_faster(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    neurons = stand_in_cl.install(monkeypatch)
    culture = CL1Culture(limits=replace(CL1_LIMITS, stimuli_per_electrode_s=5, interval_us=100_000.0))
    frames, zero = [], 0
    # Late starts move pulses towards what comes after: what holds is the device's own clock.
    neurons.late_frames = 700
    for session in range(60):
        with culture:
            for _ in range(1 + 7 * session % 40):
                try:
                    culture.deliver([Stimulus(0.0, (1,), CL1_PULSE)], 0.05)
                except UnsafeStimulus:
                    culture.rest(0.05)
        frames += [zero + frame for frame, *_ in neurons.pulses]
        neurons.pulses.clear()
        if clock == "begins anew":
            zero, neurons.now = zero + neurons.now, 0
    assert len(frames) > 40
    assert all(b - a >= 2_500 for a, b in pairwise(frames))
    assert all(last - first >= 25_000 for first, last in zip(frames, frames[5:], strict=False))


@pytest.mark.oracle
@pytest.mark.parametrize("clock", ["goes on", "begins anew"])
def test_a_maxone_opened_anew_goes_no_faster_and_its_clock_goes_on(
    monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    rig = stand_in_maxlab.install(monkeypatch)
    sites = np.array([4430, 4455])
    selection = Selection(MAXONE, np.arange(13_000, 13_050), sites, np.array([[4430], [4455]]))
    limits = replace(MAXONE_LIMITS, stimuli_per_electrode_s=5)
    culture = MaxOneCulture(selection, stream=stand_in_maxlab.Stream(rig), settle=False, limits=limits)
    frames, zero, now_s = [], 0, 0.0
    for session in range(60):
        with culture:
            assert culture.now_s >= now_s
            for _ in range(1 + 7 * session % 40):
                try:
                    culture.deliver([Stimulus(0.0, (4430,), BALANCED_PULSE)], 0.05)
                except UnsafeStimulus:
                    culture.rest(0.05)
            now_s = culture.now_s
        frames += [zero + pulse.frame for pulse in rig.delivered]
        rig.delivered.clear()
        if clock == "begins anew":
            zero, rig.now, rig.busy_until = zero + rig.now, 0, 0
    assert len(frames) > 40
    assert now_s > 50
    assert all(last - first >= 20_000 for first, last in zip(frames, frames[5:], strict=False))
