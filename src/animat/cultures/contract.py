"""The contract of a culture as tests, for authors of cultures: pytest runs them all on a subclass, `TestMine`."""

from __future__ import annotations

import abc
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np

from animat.cultures.base import Culture
from animat.cultures.observed import Observed
from animat.cultures.safety import Admitted
from animat.errors import AnimatError, DeviceFailed, InvalidArgument, UnsafeStimulus
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.stimulus import Stimulus
from animat.tables import UNKNOWN

E = TypeVar("E", bound=Exception)


class CultureContract(abc.ABC):
    """What every culture must do. Override `pulse`, `frequencies_hz` and `is_repeatable` where they do not fit.

    The tests take a few seconds of the culture's time and deliver a few dozen stimuli, all within its limits.
    """

    pulse: Pulse = PUBLISHED_PULSE
    """A pulse that the culture's limits allow."""
    frequencies_hz: tuple[float, ...] = (10.0, 40.0)
    """Frequencies at which it can be stimulated."""
    is_repeatable: bool = True
    """Whether two new cultures answer the same requests with the same spikes."""

    @abc.abstractmethod
    def make_culture(self) -> Culture:
        """A new culture, closed; simulated ones have the same seed."""

    def lose(self, culture: Culture) -> bool:
        """Make the device of an open or closed culture unreachable from now on; returns whether there is a device."""
        return False

    @property
    def protocol(self) -> Protocol:
        """A short protocol."""
        return Protocol(
            frequencies_hz=self.frequencies_hz, patterns=1, trials=4, setup_s=0.1, pause_s=0.1, pulse=self.pulse
        )

    def stimulus(self, culture: Culture, time_s: float = 0.0) -> Stimulus:
        """A stimulus within the limits."""
        electrodes = tuple(e for e in culture.patterns[0].tolist() if e != UNKNOWN)
        return Stimulus(time_s, electrodes, self.pulse, self.frequencies_hz[0], 0)

    def test_its_data_are_consistent(self) -> None:
        with self.make_culture() as culture:
            assert len(culture.channels) >= 1
            sites = set(culture.stimulation_electrodes)
            assert 0 < len(sites) == len(culture.stimulation_electrodes)
            for pattern in culture.patterns:
                used = [electrode for electrode in pattern.tolist() if electrode != UNKNOWN]
                assert 0 < len(set(used)) == len(used)
                assert sites >= set(used)
            culture.limits.check_within(culture.device_limits)
            assert culture.sampling_rate_hz > 0
            assert all(isinstance(k, str) and isinstance(v, str) for k, v in culture.provenance.items())

    def test_nothing_is_done_while_it_is_closed(self) -> None:
        culture = self.make_culture()
        _expect(InvalidArgument, lambda: culture.advance(0.1))
        _expect(InvalidArgument, lambda: culture.rest(0.1))
        with culture:
            stimulus = self.stimulus(culture)
            _expect(InvalidArgument, culture.open)
        _expect(InvalidArgument, lambda: culture.deliver([stimulus], 0.1))
        culture.close()

    def test_its_clock_advances_by_at_least_the_requested_time(self) -> None:
        with self.make_culture() as culture:
            for duration_s in (0.05, 0.0125, 0.0, 0.0003):
                before_s = culture.now_s
                observed = culture.deliver((), duration_s)
                assert observed.duration_s >= duration_s - 1e-9
                assert culture.now_s >= before_s + duration_s - 1e-9
                spikes = observed.spikes
                assert len(spikes.time_s) == len(spikes.channel)
                assert np.all(np.diff(spikes.time_s) >= 0)
                assert np.all((spikes.time_s >= 0) & (spikes.time_s <= observed.duration_s))
                assert np.all((spikes.channel >= 0) & (spikes.channel < len(culture.channels)))
            before_s = culture.now_s
            culture.rest(1.0)
            assert culture.now_s >= before_s + 1.0 - 1e-9
            _expect(InvalidArgument, lambda: culture.advance(-1.0))
            _expect(InvalidArgument, lambda: culture.advance(float("nan")))

    def test_a_stimulus_is_delivered_at_its_requested_time_or_later(self) -> None:
        with self.make_culture() as culture:
            stimuli = [self.stimulus(culture, 0.01), self.stimulus(culture, 0.11)]
            before_s = culture.now_s
            observed = culture.deliver(stimuli, 0.2)
            assert observed.stimulus_time_s.shape == (2,)
            began_s = observed.start_s + observed.stimulus_time_s
            assert np.all(began_s >= before_s + np.array([0.01, 0.11]) - 1e-9)
            # As long after a late stimulus as after one on time, to a millisecond as in a closed loop.
            assert observed.duration_s - observed.stimulus_time_s[1] >= 0.09 - 0.001
            assert culture.delivered == 2

    def test_times_can_be_counted_from_a_reading_of_its_clock(self) -> None:
        with self.make_culture() as culture:
            since_s = culture.now_s
            culture.rest(0.03)
            times_s = np.array([0.1, 0.2])
            observed = culture.deliver([self.stimulus(culture, t) for t in times_s.tolist()], 0.3, since_s=since_s)
            late_s = observed.start_s + observed.stimulus_time_s - (since_s + times_s)
            assert np.all(late_s >= -1e-9)
            assert observed.start_s + observed.duration_s >= since_s + 0.3 - 1e-9
            if self.is_repeatable:
                # Its time passes only in calls: delays are within a sample's rounding.
                assert np.all(late_s <= 1 / culture.sampling_rate_hz + 1e-9)
            # Both are overdue: the second comes after the first at the requested interval.
            again = culture.deliver([self.stimulus(culture, t) for t in times_s.tolist()], 0.3, since_s=since_s)
            assert again.start_s >= observed.start_s + observed.duration_s - 1e-9
            assert again.stimulus_time_s[1] - again.stimulus_time_s[0] >= 0.1 - 1e-9
            assert culture.delivered == 4
            assert culture.deliver((), 0.3, since_s=since_s).duration_s <= 0.1
            ahead_s = culture.now_s + 60.0
            _expect(InvalidArgument, lambda: culture.deliver((), 0.1, since_s=ahead_s))
            _expect(InvalidArgument, lambda: culture.deliver((), 0.1, since_s=float("nan")))

    def test_outside_its_limits_nothing_is_delivered_and_no_time_passes(self) -> None:
        with self.make_culture() as culture:
            good = self.stimulus(culture)
            limits = culture.limits
            unit = "amplitude_mv" if limits.kind == "voltage" else "amplitude_ua"
            too_high = Pulse((Phase(limits.phase_us[0], **{unit: 2 * limits.amplitude + 1}),))
            stranger = max(culture.stimulation_electrodes) + 1
            for limit, bad in (
                ("amplitude", replace(good, pulse=too_high, time_s=0.05)),
                ("sites", replace(good, electrodes=(stranger,), time_s=0.05)),
                ("electrodes_at_once", replace(good, electrodes=(), time_s=0.05)),
                ("overlap", replace(good, time_s=1e-9)),
            ):
                before_s = culture.now_s
                error = _expect(UnsafeStimulus, lambda bad=bad: culture.deliver([good, bad], 0.1))  # type: ignore[misc]
                assert error.limit == limit
                assert culture.delivered == 0
                # A simulated culture's time stands still; a living one's runs on.
                assert culture.now_s == before_s or not self.is_repeatable
            _expect(InvalidArgument, lambda: culture.deliver([replace(good, time_s=0.2)], 0.1))
            assert culture.delivered == 0

    def test_an_emergency_stop_holds_until_it_is_opened_again(self) -> None:
        culture = self.make_culture()
        with culture:
            stimulus = self.stimulus(culture)
            culture.stop("the test says so")
            assert culture.is_stopped
            error = _expect(UnsafeStimulus, lambda: culture.deliver([stimulus], 0.1))
            assert "the test says so" in str(error)
            _expect(UnsafeStimulus, lambda: culture.record(self.protocol))
            culture.advance(0.01)
            assert culture.delivered == 0
        with culture:
            culture.deliver([stimulus], 0.1)
            assert culture.delivered == 1

    def test_it_can_be_reopened_after_a_stop_from_another_thread_during_a_delivery(self) -> None:
        culture = self.make_culture()
        begun, ended = threading.Event(), threading.Event()
        with culture:
            stimulus, deliver = self.stimulus(culture), culture._deliver
            stimuli = [self.stimulus(culture, 0.1 * number) for number in range(20)]

            def signalling(admitted: Admitted, duration_s: float) -> Observed:
                begun.set()
                return deliver(admitted, duration_s)

            def request() -> None:
                # A simulation delivers everything in one go, and may have finished before it is stopped.
                with suppress(DeviceFailed, UnsafeStimulus):
                    culture.deliver(stimuli, 2.0)
                ended.set()

            culture._deliver = signalling  # type: ignore[method-assign]
            threading.Thread(target=request, daemon=True).start()
            assert begun.wait(60)
            culture.stop("from another thread")
            assert ended.wait(60)
            assert culture.is_stopped
            delivered = culture.delivered
            _expect(UnsafeStimulus, lambda: culture.deliver([stimulus], 0.1))
            assert culture.delivered == delivered
            culture._deliver = deliver  # type: ignore[method-assign]
        with culture:
            # How much was delivered is unknown: all of it counts as delivered just now.
            culture.rest(1.0)
            culture.deliver([stimulus], 0.1)
            assert culture.delivered == 1

    def test_an_unreachable_device_is_reported_as_failed(self) -> None:
        culture = self.make_culture()
        if not self.lose(culture):
            return
        _expect(DeviceFailed, culture.open)
        assert not culture.is_open
        acts: tuple[Callable[[Culture, Stimulus], object], ...] = (
            lambda culture, _: culture.advance(0.1),
            lambda culture, _: culture.rest(0.1),
            lambda culture, stimulus: culture.deliver([stimulus], 0.1),
            lambda culture, _: culture.record(self.protocol),
            lambda culture, _: culture.stop(),
        )
        for act in acts:
            culture = self.make_culture().open()
            stimulus = self.stimulus(culture)
            self.lose(culture)
            error = _expect(DeviceFailed, lambda: act(culture, stimulus))  # noqa: B023
            assert "\n" not in str(error)
            _expect(DeviceFailed, culture.close)
            assert not culture.is_open

    def test_reopening_does_not_circumvent_a_rate_limit(self) -> None:
        culture = self.make_culture()
        with culture:
            culture._asked_limits = replace(culture.device_limits, stimuli_per_s=1)
        with culture:
            culture.deliver([self.stimulus(culture)], 0.1)
        with culture:
            # On a device, opening may take longer than a second.
            if self.is_repeatable:
                error = _expect(UnsafeStimulus, lambda: culture.deliver([self.stimulus(culture)], 0.1))
                assert error.limit == "stimuli_per_s"
            assert culture.delivered == 0
            culture.rest(1.0)
            culture.deliver([self.stimulus(culture)], 0.1)
            assert culture.delivered == 1

    def test_a_recording_follows_the_protocol(self) -> None:
        protocol = self.protocol
        with self.make_culture() as culture:
            schedule = culture.schedule(protocol, seed=3)
            before_min = culture.now_s / 60
            recording = culture.record(protocol, seed=3)
            assert recording.start_min >= before_min - 1e-9
            assert culture.now_s / 60 >= before_min + schedule.duration_s / 60 - 1e-6
            expected = [block.stimuli for block in schedule.blocks]
            for name in ("frequency_hz", "pattern", "presentation", "electrodes"):
                requested = np.concatenate([getattr(table, name) for table in expected])
                np.testing.assert_array_equal(getattr(recording.stimuli, name), requested)
            assert recording.duration_s >= schedule.recorded_s - 1e-6
            assert recording.presentation == protocol.presentation
            assert recording.protocol == protocol
            assert culture.delivered == len(schedule)
            _expect(AnimatError, lambda: culture.record(replace(protocol, patterns=len(culture.patterns) + 1)))

    def test_a_response_is_a_window_after_the_pulse(self) -> None:
        with self.make_culture() as culture:
            stimulus = self.stimulus(culture)
            spikes = culture.stimulate(stimulus.electrodes, self.pulse, (2.0, 10.0))
            assert np.all((spikes.time_s >= 0.002 - 1e-9) & (spikes.time_s < 0.010))
            _expect(InvalidArgument, lambda: culture.stimulate(stimulus.electrodes, self.pulse, (5.0, 5.0)))

    def test_the_same_requests_give_the_same_spikes(self) -> None:
        if not self.is_repeatable:
            return
        recordings = []
        for _ in range(2):
            with self.make_culture() as culture:
                recording = culture.record(self.protocol, seed=1)
            # The date of a device's recording is its own.
            provenance = {**recording.provenance, "recorded_at": ""}
            recordings.append(replace(recording, provenance=provenance, recorded_at=None))
        assert recordings[0].equals(recordings[1])


def _expect(kind: type[E], act: Callable[[], object]) -> E:
    """The error of this kind that `act` raises."""
    try:
        act()
    except kind as error:
        return error
    raise AssertionError(f"expected {kind.__name__}, but nothing was raised")
