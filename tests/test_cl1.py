"""The CL1's driver against a stand-in of the SDK; against the SDK itself in `test_cl1_sdk.py`."""

from __future__ import annotations

import contextlib
import itertools
import json
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from animat.cultures.base import Culture
from animat.cultures.contract import CultureContract
from animat.cultures.devices.cl1 import CL1_LIMITS, CL1_PULSE, SITES, CL1Culture
from animat.cultures.replay import ReplayCulture
from animat.cultures.same_culture import other_culture, other_patterns
from animat.cultures.virtual import VirtualCulture
from animat.errors import DeviceFailed, InvalidArgument, UnsafeStimulus
from animat.recordings.formats.stimulus_text import parse_line
from animat.recordings.recorded_culture import RecordedCulture, names_in
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import BALANCED_PULSE, Phase, Pulse
from animat.stimulation.stimulus import Stimulus
from stand_in_cl import Neurons, install


@pytest.fixture(autouse=True)
def neurons(monkeypatch: pytest.MonkeyPatch) -> Iterator[Neurons]:
    yield install(monkeypatch)


class TestCL1(CultureContract):
    pulse = CL1_PULSE

    @pytest.fixture(autouse=True)
    def _patch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.patch = monkeypatch

    def make_culture(self) -> Culture:
        # A device's clock goes on from session to session: a new one is another device.
        install(self.patch)
        return CL1Culture()

    def lose(self, culture: Culture) -> bool:
        sys.modules["cl"].neurons.is_gone = True
        return True


@pytest.mark.parametrize(
    ("channel", "what"), [(0, "ground"), (4, "reference"), (7, "ground"), (56, "ground"), (63, "ground")]
)
def test_a_channel_that_cannot_stimulate_is_refused_by_name(channel: int, what: str) -> None:
    with pytest.raises(InvalidArgument, match=f"got channel {channel} in number 1, which is {what}"):
        CL1Culture([[1, 2], [3, channel]])
    with CL1Culture() as culture, pytest.raises(UnsafeStimulus, match=f"got electrode {channel}") as refused:
        culture.deliver([Stimulus(0.0, (1, channel), CL1_PULSE)], 0.1)
    assert refused.value.limit == "sites"


def test_a_restarted_clock_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with CL1Culture() as culture:
        culture.rest(60.0)
        recording = culture.record(Protocol(pulse=CL1_PULSE, trials=2, patterns=2, setup_s=0.1), seed=1)
        assert other_culture(recording, culture) is None
    install(monkeypatch)
    with CL1Culture() as culture:
        culture.rest(62.0)
        found = other_culture(recording, culture)
    assert recording.duration_s > 5
    assert found is not None and found.name == "other-culture"
    assert "the CL1's clock is at 1.0 min, before the end of the recording at 1.0 min" in found.message


def test_another_chip_rig_or_kind_of_culture_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with CL1Culture() as culture:
        recording = culture.record(Protocol(pulse=CL1_PULSE, trials=2, patterns=2, setup_s=0.1), seed=1)
    names = {"system_id": "stand-in", "chip_id": "none", "cell_batch_id": "7"}

    def message(kind: RecordedCulture | None = recording.culture, **words: str) -> str | None:
        monkeypatch.setattr(sys.modules["cl"], "get_system_attributes", lambda: names)
        with CL1Culture() as culture:
            provenance = {**recording.provenance, **words}
            known = None if kind is None else replace(kind, names=names_in(provenance))
            found = other_culture(replace(recording, provenance=provenance, culture=known), culture)
        return None if found is None else found.message

    assert message() is message(cell_batch_id="7") is None
    assert message(chip_id="A3") == (
        "the recordings are of chip_id A3, but this is chip_id none: percentiles differ between cultures"
    )
    assert "system_id rig 2, but this is system_id stand-in" in str(message(system_id="rig 2"))
    assert "cell_batch_id 6, but this is cell_batch_id 7" in str(message(cell_batch_id="6"))
    assert "of a MaxOne, but this is a CL1" in str(message(RecordedCulture("maxone")))
    assert "of a virtual culture, but this is a CL1" in str(message(VirtualCulture(1).recorded_as))
    is_simulated = recording.culture is not None and recording.culture.is_simulated
    assert "of a CL1" in str(message(RecordedCulture("cl1", 1, not is_simulated)))
    # A converted file says nothing of where it comes from; and a replay answers from whatever was recorded.
    assert message(None, source="rig.h5") is None
    foreign = replace(recording, provenance={**recording.provenance, "chip_id": "A3"})
    with ReplayCulture([foreign]) as replayed:
        assert other_culture(recording, replayed) is None


def test_other_patterns_than_the_recorded_ones_are_reported() -> None:
    protocol = Protocol(pulse=CL1_PULSE, trials=2, patterns=2, setup_s=0.1)
    (one, two, three) = pairs = [[1, 2], [3, 5], [9, 10]]
    with CL1Culture(pairs[:2]) as culture:
        recording = culture.record(protocol, seed=1)
        assert other_patterns(recording, culture) is None
    # The order of a pattern's electrodes, and of patterns, does not matter; nor do patterns that were not recorded.
    with CL1Culture([three, two[::-1], one]) as culture:
        assert other_patterns(recording, culture) is None
    with CL1Culture(pairs[1:]) as culture:
        found = other_patterns(recording, culture)
        elsewhere = culture.record(protocol, seed=1)
    assert found is not None and (found.name, found.value) == ("other-patterns", 1.0)
    assert "1 of the 2 sets of electrodes that were stimulated in the recordings is not a pattern" in found.message
    # A replay's patterns are those of its first recording, but it answers from all.
    with ReplayCulture([recording, replace(elsewhere, start_min=10.0)]) as replayed:
        assert other_patterns(elsewhere, replayed) is None


def pulse(*numbers: float) -> Pulse:
    return Pulse(tuple(Phase(us, amplitude_ua=ua) for us, ua in zip(numbers[::2], numbers[1::2], strict=True)))


@pytest.mark.parametrize(
    ("limit", "bad", "words"),
    [
        ("net_charge", pulse(160, -1, 180, 1), "expected phases that balance"),
        ("net_charge", pulse(160, -1), "expected phases that balance"),
        ("amplitude", pulse(160, -3.01, 160, 3.01), "-3 to 3 uA"),
        ("charge_per_phase", pulse(1500, -2.5, 1500, 2.5), "-3 to 3 nC per phase"),
        ("phase_step_us", pulse(150, -1, 150, 1), "steps of 20 us, got 150"),
        ("alternates", pulse(160, -1, 160, -1, 320, 1), "different signs"),
        ("phases_per_pulse", pulse(20, -1, 20, 1, 20, -1, 20, 1), "at most 3 phases"),
        ("kind", BALANCED_PULSE, "pulse: expected a current pulse, .* got a voltage pulse"),
    ],
)
def test_what_the_sdk_would_refuse_or_not_look_at_is_refused_by_the_guard(limit: str, bad: Pulse, words: str) -> None:
    with CL1Culture() as culture, pytest.raises(UnsafeStimulus, match=words) as refused:
        culture.deliver([Stimulus(0.0, (1,), bad)], 0.1)
    assert refused.value.limit == limit


def test_pulses_with_a_gap_of_current_0_and_three_phases_pass(neurons: Neurons) -> None:
    with CL1Culture() as culture:
        culture.deliver([Stimulus(0.0, (1,), pulse(160, -1.1, 40, 0.0, 320, 0.55))], 0.1)
    assert neurons.pulses[0][2].durations_us == (160, 40, 320)


def test_pulses_faster_than_200_hz_are_refused_on_one_channel_and_not_on_two() -> None:
    with CL1Culture() as culture:
        with pytest.raises(UnsafeStimulus, match="interval_us: expected 5000 us or more"):
            culture.deliver([Stimulus(t, (1,), CL1_PULSE) for t in (0.0, 0.00496)], 0.1)
        with pytest.raises(UnsafeStimulus, match="gap_us: expected 80 us or more"):
            culture.deliver([Stimulus(0.0, (1,), CL1_PULSE), Stimulus(0.00036, (2,), CL1_PULSE)], 0.1)
        culture.deliver([Stimulus(t, (1 + i,), CL1_PULSE) for i, t in enumerate((0.0, 0.0004))], 0.1)
        culture.deliver([Stimulus(t, (1,), CL1_PULSE) for t in (0.0, 0.005)], 0.1)


@pytest.mark.parametrize("begins_us", [0, 20, 50, 100, 130, 300])
def test_a_train_at_the_limit_keeps_its_pace_wherever_it_begins(neurons: Neurons, begins_us: int) -> None:
    """Half of these begin half-way between two frames: rounded to even, every other interval would be too short."""
    with CL1Culture() as culture:
        train = [Stimulus((begins_us + 5000 * n) / 1e6, (1,), CL1_PULSE) for n in range(20, 60)]
        observed = culture.deliver(train, 0.4)
    began = [frame for frame, *_ in neurons.pulses]
    assert np.rint((observed.start_s + observed.stimulus_time_s) * 25_000).tolist() == began
    # To the nearest frame of 40 us from the request at 0, halves up.
    assert began[0] == (begins_us + 100_000 + 20) // 40
    assert set(np.diff(began)) == {125}


def test_a_pulse_at_the_very_end_of_a_delivery_is_waited_for(neurons: Neurons) -> None:
    with CL1Culture(ticks_per_s=25_000) as culture:
        # Its nearest frame is the one after the last: 250.
        observed = culture.deliver([Stimulus(0.009999, (1,), CL1_PULSE)], 0.01)
    assert np.rint(observed.stimulus_time_s * 25_000).tolist() == [250]


def test_the_five_frequencies_are_delivered_to_a_frame(neurons: Neurons) -> None:
    with CL1Culture() as culture:
        recording = culture.record(Protocol(pulse=CL1_PULSE, trials=20, setup_s=0.1, pause_s=0.5), seed=2)
        schedule = culture.schedule(Protocol(pulse=CL1_PULSE, trials=20, setup_s=0.1, pause_s=0.5), seed=2)
    delivered = sorted({frame for frame, _, _ in neurons.pulses})
    asked = np.concatenate([block.stimuli.time_s for block in schedule.blocks])
    assert len(delivered) == len(asked) == 100
    for block in range(5):
        rows = slice(20 * block, 20 * block + 20)
        # The pause before the first pulse leaves time to be in time.
        frames = np.floor(np.round(asked[rows] * 25_000, 6) + 0.5)
        np.testing.assert_array_equal(np.diff(delivered[rows]), np.diff(frames))
    assert recording.presentation == Protocol().presentation
    assert len(neurons.pulses) == 500
    for row, electrodes in enumerate(recording.stimuli.electrodes):
        assert {c for f, c, _ in neurons.pulses if f == delivered[row]} == set(electrodes.tolist())


def test_what_begins_late_keeps_its_distance_from_what_was_before(neurons: Neurons) -> None:
    with CL1Culture() as culture:
        neurons.late_frames = 200
        culture.deliver([Stimulus(0.0, (1,), CL1_PULSE)], 0.0001)
        neurons.late_frames = 0
        culture.deliver([Stimulus(0.0, (1,), CL1_PULSE)], 0.1)
    first, second = [frame for frame, _, _ in neurons.pulses]
    # Without its wait the second would come 50 frames after the first: 2 ms, not 5.
    assert 125 <= second - first <= 150


def test_the_time_that_a_pulse_began_at_is_the_devices(neurons: Neurons) -> None:
    with CL1Culture() as culture:
        observed = culture.deliver([Stimulus(0.0, (1, 9), CL1_PULSE), Stimulus(0.05, (1, 9), CL1_PULSE)], 0.06)
        np.testing.assert_array_equal(
            np.rint((observed.start_s + observed.stimulus_time_s) * 25_000),
            sorted({frame for frame, _, _ in neurons.pulses}),
        )
        assert observed.duration_s >= 0.06 + observed.stimulus_time_s[0] - 1e-9


def test_a_pulse_that_never_comes_is_an_error_that_names_it(neurons: Neurons) -> None:
    neurons.drop = {9}
    with CL1Culture() as culture, pytest.raises(DeviceFailed, match=r"expected a pulse on channel 9 .* left it out"):
        culture.deliver([Stimulus(0.0, (1, 9), CL1_PULSE)], 0.1)


@pytest.mark.parametrize("ticks", [0, 3])
def test_a_loop_that_ends_before_all_was_sent_is_an_error(ticks: int, neurons: Neurons) -> None:
    loop = neurons.loop
    neurons.loop = lambda *given, **more: itertools.islice(loop(*given, **more), ticks)  # type: ignore[method-assign]
    with CL1Culture() as culture, pytest.raises(DeviceFailed, match="expected a loop over 1 s, got one that ended"):
        culture.deliver([Stimulus(0.5, (1,), CL1_PULSE)], 1.0)


def test_a_timeout_interrupts_every_channel_and_is_one_line(neurons: Neurons) -> None:
    with CL1Culture() as culture:
        before = neurons.interrupted
        neurons.fail = TimeoutError("Loop fell behind by 1 frame (40 us)\nwhen entering the 3rd\niteration.")
        with pytest.raises(DeviceFailed, match="TimeoutError: Loop fell behind by 1 frame") as failed:
            culture.deliver([Stimulus(0.0, (1,), CL1_PULSE)], 0.1)
        assert "\n" not in str(failed.value)
        assert neurons.interrupted > before
        neurons.fail = None


@pytest.mark.parametrize("is_simulator", [True, False])
def test_if_the_simulator_does_not_keep_up_the_error_says_what_helps(
    is_simulator: bool, neurons: Neurons, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(*_: object) -> None:
        raise TimeoutError("Timeout waiting for timestamp 5000")

    helps = "the simulator did not keep up: run without CL_SDK_ACCELERATED_TIME, or with nothing else running"
    monkeypatch.setattr(sys.modules["cl"], "is_simulator", lambda: is_simulator)
    with CL1Culture() as culture:
        neurons.fail = TimeoutError("Timeout waiting for timestamp 5000")
        with pytest.raises(DeviceFailed, match="waiting for timestamp 5000: what had not begun") as failed:
            culture.deliver([Stimulus(0.0, (1,), CL1_PULSE)], 0.1)
        assert (helps in str(failed.value)) == is_simulator
        neurons.fail = None
        monkeypatch.setattr(neurons, "read", late)
        with pytest.raises(DeviceFailed, match=r"expected to rest 0\.5 s, got TimeoutError: Timeout waiting") as failed:
            culture.rest(0.5)
        assert (helps in str(failed.value)) == is_simulator


def test_a_failed_interruption_is_reported(neurons: Neurons, monkeypatch: pytest.MonkeyPatch) -> None:
    with CL1Culture() as culture:
        with monkeypatch.context() as patch:
            patch.setattr(neurons, "interrupt", lambda _: [][0])
            neurons.fail = TimeoutError("Loop fell behind")
            with pytest.raises(
                DeviceFailed, match=r"fell behind: and it could not be interrupted \(IndexError.* no more"
            ):
                culture.deliver([Stimulus(0.0, (1,), CL1_PULSE)], 0.1)
        neurons.fail = None
        neurons.is_gone = True
        for ask in (lambda: culture.now_s, lambda: culture.provenance):
            with pytest.raises(DeviceFailed, match="got ConnectionResetError: the device is gone"):
                ask()
        neurons.is_gone = False


def test_an_emergency_stop_half_way_delivers_nothing_more(neurons: Neurons) -> None:
    with CL1Culture() as culture:
        stamp, ticks = neurons.timestamp, [0]

        def count() -> int:
            ticks[0] += 1
            if ticks[0] == 20:
                culture.stop("half way")
            return stamp()

        neurons.timestamp = count  # type: ignore[method-assign]
        with pytest.raises(DeviceFailed, match="stopped while delivering"):
            culture.deliver([Stimulus(0.0125 * i, (1,), CL1_PULSE) for i in range(40)], 1.0)
        delivered = len(neurons.pulses)
        assert delivered < 20
        assert neurons.queue == []
        culture.advance(0.5)
        assert len(neurons.pulses) == delivered


def test_a_stop_after_the_last_pulse_was_sent_ends_the_delivery_too(neurons: Neurons) -> None:
    with CL1Culture() as culture:
        ticks, loop = [0], neurons.loop

        def stopping(*given: int, **more: object) -> Iterator[object]:
            for tick in loop(*given, **more):
                ticks[0] += 1
                if ticks[0] == 100:
                    culture.stop("seen enough")
                yield tick

        neurons.loop = stopping  # type: ignore[method-assign]
        with pytest.raises(DeviceFailed, match="stopped while delivering: 1 of 1 stimuli had been sent"):
            culture.deliver([Stimulus(0.05, (1,), CL1_PULSE)], 1.0)
        assert ticks == [100] and len(neurons.pulses) == 1


def test_a_stop_from_another_thread_lets_nothing_through_after_it(neurons: Neurons) -> None:
    """Stops at random times: no pulse is handed over once `stop` has returned."""
    for delay_s in np.random.default_rng(0).uniform(0, 0.02, 30).tolist():
        with CL1Culture() as culture:

            def stop(culture: CL1Culture = culture, delay_s: float = delay_s) -> None:
                time.sleep(delay_s)
                culture.stop("from outside")

            thread = threading.Thread(target=stop)
            thread.start()
            with contextlib.suppress(DeviceFailed, UnsafeStimulus):
                culture.deliver([Stimulus(0.0125 * i, (1,), CL1_PULSE) for i in range(400)], 6.0)
            thread.join()
            assert neurons.queue == []
            delivered = len(neurons.pulses)
            culture.advance(0.5)
            assert len(neurons.pulses) == delivered


def test_queueing_that_hangs_does_not_keep_a_stop_from_clearing_the_queue(
    neurons: Neurons, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.cultures.devices.cl1_delivery.QUEUEING_S", 0.1)
    hanging, released, made = threading.Event(), threading.Event(), neurons.create_stim_plan

    def plan() -> object:
        if neurons.queue:
            hanging.set()
            released.wait(30)
        return made()

    neurons.create_stim_plan = plan  # type: ignore[method-assign]
    failed: list[Exception] = []
    with CL1Culture() as culture:

        def deliver() -> None:
            try:
                culture.deliver([Stimulus(0.0125 * i, (1,), CL1_PULSE) for i in range(8)], 0.2)
            except DeviceFailed as error:
                failed.append(error)

        thread = threading.Thread(target=deliver)
        thread.start()
        assert hanging.wait(30)
        assert neurons.queue
        culture.stop("it hangs")
        assert neurons.queue == []
        released.set()
        thread.join(30)
        # What hung was handed over after all: it is taken back as well.
        assert len(failed) == 1
        assert neurons.queue == []


def test_a_delivery_that_hung_hands_over_nothing_in_a_later_session(neurons: Neurons) -> None:
    hanging, released, loop = threading.Event(), threading.Event(), neurons.loop

    def hang(*given: int, **more: object) -> Iterator[object]:
        for tick in loop(*given, **more):
            if not hanging.is_set():
                hanging.set()
                released.wait(30)
            yield tick

    neurons.loop = hang  # type: ignore[method-assign]
    failed: list[Exception] = []
    culture = CL1Culture()

    def deliver() -> None:
        try:
            culture.deliver([Stimulus(0.01, (1,), CL1_PULSE)], 0.1)
        except DeviceFailed as error:
            failed.append(error)

    with culture:
        thread = threading.Thread(target=deliver)
        thread.start()
        assert hanging.wait(30)
    with culture:
        released.set()
        thread.join(30)
        assert len(failed) == 1
        assert neurons.queue == []
        culture.advance(0.5)
        assert neurons.pulses == []


def test_the_stimuli_are_kept_beside_the_devices_own_recording(neurons: Neurons, tmp_path) -> None:  # type: ignore[no-untyped-def]
    with CL1Culture(record_to=tmp_path) as culture:
        culture.deliver([Stimulus(0.0, (1, 9), CL1_PULSE, 20.0, 0, 7)], 0.01)
    ((frame, text),) = neurons.stream
    assert frame == neurons.pulses[0][0]
    assert parse_line(text) == {"electrodes": [1, 9], "frequency_hz": 20.0, "pattern": 0, "presentation": 7}
    assert Pulse.from_list(json.loads(text)["phases"]) == CL1_PULSE


def test_without_the_sdk_the_error_says_where_it_comes_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cl", None)
    with pytest.raises(
        DeviceFailed, match=r"culture: expected .* cl-sdk for a cl1, .* pip install 'animat\[cl1\]'"
    ) as failed:
        CL1Culture().open()
    assert "\n" not in str(failed.value)


def test_spikes_on_ground_are_counted_and_not_recorded(neurons: Neurons) -> None:
    with CL1Culture() as culture:
        neurons.queue = [(frame, channel, None) for frame in (7, 14) for channel in (4, 8)]  # type: ignore[list-item]
        spikes = culture.advance(0.1)
        assert [culture.channels.label[row] for row in spikes.channel] == ["8", "8"]
        assert culture.spikes_not_on_electrodes == 2
        # A recording says what it does not have; what was before it is not its own.
        neurons.queue = [(neurons.now + 14 - neurons.now % 7, 4, None)]  # type: ignore[list-item]
        protocol = Protocol(pulse=CL1_PULSE, trials=1, patterns=5, setup_s=0.0)
        assert culture.record(protocol).provenance["left_out"] == "1 spikes on ground or reference"
        assert "left_out" not in culture.record(protocol).provenance
        # A spike that is reported after its time would be before the recording.
        neurons.queue = [(7, 8, None)]  # type: ignore[list-item]
        assert culture.record(protocol).provenance["left_out"] == "1 spikes reported late"
        assert culture.spikes_reported_late == 1


def test_patterns_use_every_kind_of_channel_that_can_and_positions_are_a_grid() -> None:
    culture = CL1Culture(seed=5, pitch_um=200.0)
    assert culture.patterns.shape == (100, 5)
    assert set(culture.patterns.ravel().tolist()) <= set(SITES)
    x_um, y_um = culture.channels.x_um, culture.channels.y_um
    assert (x_um.max(), y_um.max()) == (1400.0, 1400.0)
    row = culture.channels.electrode.tolist().index(17)
    assert (x_um[row], y_um[row]) == (400.0, 200.0)
    assert not CL1Culture().channels.has_positions


def test_limits_that_are_looser_in_a_new_way_are_refused() -> None:
    for looser in (
        replace(CL1_LIMITS, alternates=False),
        replace(CL1_LIMITS, phase_step_us=10.0),
        replace(CL1_LIMITS, phase_step_us=0.0),
        replace(CL1_LIMITS, interval_us=0.0),
        replace(CL1_LIMITS, phases_per_pulse=4),
    ):
        with pytest.raises(InvalidArgument, match="tightened, never loosened"):
            CL1Culture(limits=looser).open()
    with CL1Culture(limits=replace(CL1_LIMITS, phase_step_us=40.0, interval_us=12_500.0)) as culture:
        assert culture.is_open


def test_a_pulse_that_a_stall_makes_late_delays_those_after_it(
    neurons: Neurons, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, stalls = neurons.create_stim_plan, [250]

    def stalled() -> Any:
        # The program is held up for 10 ms between the device's time and the plan.
        neurons.now += stalls.pop() if stalls else 0
        return plan()

    monkeypatch.setattr(neurons, "create_stim_plan", stalled)
    with CL1Culture() as culture:
        culture.deliver([Stimulus(0.0125 * i, (8,), CL1_PULSE) for i in range(5)], 0.1)
        first = [frame for frame, _, _ in neurons.pulses]
        assert np.all(np.diff(first) >= 312)
        stalls.append(250)
        # Across deliveries the limit holds: 5 ms.
        culture.deliver([Stimulus(0.0, (8,), CL1_PULSE)], 0.0001)
        culture.deliver([Stimulus(0.0, (8,), CL1_PULSE)], 0.1)
    *_, one, other = [frame for frame, _, _ in neurons.pulses]
    assert other - one >= 125
