"""The MaxOne's driver against a stand-in of the vendor's module, written from notes: no device was at hand."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from animat.cultures.base import Culture
from animat.cultures.contract import CultureContract
from animat.cultures.devices import maxone_stream
from animat.cultures.devices.maxone import MAXONE_LIMITS, MaxOneCulture
from animat.cultures.devices.maxone_commands import dac_code
from animat.cultures.devices.maxone_stream import EVENT_16, EVENT_24, ZmqSpikes
from animat.cultures.same_culture import other_channels
from animat.errors import DeviceFailed, InvalidArgument, UnsafeStimulus
from animat.recordings.formats.stimulus_text import parse_line
from animat.stimulation.array import MAXONE
from animat.stimulation.patterns import draw_patterns
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import BALANCED_PULSE, PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.selection import Selection
from animat.stimulation.stimulus import Stimulus
from animat.tables import UNKNOWN
from stand_in_maxlab import LSB_MV, Rig, Stream, install

SITES = [(20 + 25 * (i // 8)) * 220 + 15 + 25 * (i % 8) for i in range(32)]
RECORDED = [*SITES, *range(13_000, 13_100)]


@pytest.fixture(autouse=True)
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    yield install(monkeypatch)


def selection(recording: list[int] = RECORDED, sites: list[int] = SITES) -> Selection:
    patterns = draw_patterns(MAXONE, np.array(sites), seed=1)
    return Selection(MAXONE, np.array(recording), np.array(sites), patterns)


def culture_on(rig: Rig, **settings: object) -> MaxOneCulture:
    return MaxOneCulture(selection(), stream=Stream(rig), settle=False, **settings)  # type: ignore[arg-type]


class TestMaxOne(CultureContract):
    pulse = BALANCED_PULSE

    @pytest.fixture(autouse=True)
    def _patch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.patch = monkeypatch

    def make_culture(self) -> Culture:
        self.rig = install(self.patch)
        return culture_on(self.rig)

    def lose(self, culture: Culture) -> bool:
        self.rig.is_gone = True
        return True


def test_stimulation_electrodes_that_were_not_routed_are_refused_by_name(rig: Rig) -> None:
    rig.drop = {SITES[3], SITES[9], 13_050}
    with pytest.raises(DeviceFailed, match=f"but not electrodes {SITES[3]}, {SITES[9]}: choose others") as failed:
        culture_on(rig).open()
    assert "\n" not in str(failed.value)
    assert not rig.powered


def test_recording_electrodes_that_were_not_routed_are_left_out_and_counted(rig: Rig) -> None:
    rig.drop = {13_052}
    with culture_on(rig) as culture:
        recording = culture.record(Protocol((40.0,), trials=2, setup_s=0.0, pause_s=0.0, pulse=BALANCED_PULSE))
        assert other_channels(recording, culture) is None
    rig.drop = {13_050, 13_051}
    with culture_on(rig) as culture:
        found = other_channels(recording, culture)
        assert found is not None and (found.name, found.value) == ("other-channels", 3)
        unknown = replace(recording.channels, electrode=np.full(len(recording.channels), UNKNOWN))
        assert other_channels(replace(recording, channels=unknown), culture) is None
        assert culture.not_routed == (13_050, 13_051)
        assert len(culture.channels) == len(RECORDED) - 2
        assert culture.provenance["not_routed"] == "13050 13051"


def test_electrodes_that_share_a_unit_are_refused_by_name(rig: Rig) -> None:
    rig.same_unit = {SITES[5]: SITES[2]}
    with pytest.raises(DeviceFailed, match=f"electrodes {SITES[2]} and {SITES[5]} share unit 2: choose another"):
        culture_on(rig).open()
    assert not rig.powered


def test_electrodes_without_a_unit_are_refused_by_name(rig: Rig) -> None:
    rig.without_unit = {SITES[1]}
    with pytest.raises(DeviceFailed, match=f"there is none for electrode {SITES[1]}: choose others"):
        culture_on(rig).open()


def test_codes_are_inverted_and_rounded_alike_on_both_sides() -> None:
    assert dac_code(0.0, LSB_MV) == 512
    # What the vendor's notes give as examples: 100 mV is 512 - 33.5.
    assert dac_code(100.0, LSB_MV) == 478
    assert dac_code(-100.0, LSB_MV) == 546
    for amplitude_mv in np.linspace(0, 400, 1001).tolist():
        assert dac_code(amplitude_mv, LSB_MV) - 512 == -(dac_code(-amplitude_mv, LSB_MV) - 512)
        assert abs((512 - dac_code(amplitude_mv, LSB_MV)) * LSB_MV - amplitude_mv) <= LSB_MV / 2 + 1e-9


def test_what_comes_out_is_the_pulse_on_the_patterns_electrodes_and_nowhere_else(rig: Rig) -> None:
    with culture_on(rig) as culture:
        pattern = tuple(culture.patterns[4].tolist())
        start = rig.now
        observed = culture.deliver([Stimulus(0.02, pattern, BALANCED_PULSE, 20.0, 4, 0)], 0.05)
    assert sorted(pulse.electrode for pulse in rig.delivered) == sorted(pattern)
    for pulse in rig.delivered:
        assert pulse.frame == start + 400 == start + round(observed.stimulus_time_s[0] * 20_000)
        assert [samples for samples, _ in pulse.phases] == [10, 10]
        np.testing.assert_allclose([mv for _, mv in pulse.phases], [-200, 200], atol=LSB_MV / 2)
        assert sum(samples * mv for samples, mv in pulse.phases) == 0
    assert parse_line(rig.events[0][1]) == {"electrodes": list(pattern), "pattern": 4}


def test_pulses_that_do_not_balance_after_rounding_are_refused(rig: Rig) -> None:
    with culture_on(rig) as culture:
        assert culture.limits.amplitude_step == LSB_MV
        uneven = Pulse((Phase(500, amplitude_mv=-200), Phase(1000, amplitude_mv=100)))
        assert uneven.net_charge == 0
        with pytest.raises(UnsafeStimulus, match=r"net_charge: .* which the device makes of"):
            culture.deliver([Stimulus(0.0, (SITES[0],), uneven)], 0.1)
        with pytest.raises(UnsafeStimulus, match="net_charge"):
            culture.deliver([Stimulus(0.0, (SITES[0],), PUBLISHED_PULSE)], 0.1)
        # 66 and 33 steps balance.
        even = Pulse((Phase(500, amplitude_mv=-66 * LSB_MV), Phase(1000, amplitude_mv=33 * LSB_MV)))
        culture.deliver([Stimulus(0.0, (SITES[0],), even)], 0.1)
        with pytest.raises(UnsafeStimulus, match="phase_step_us: expected phases in steps of 50 us, got 460"):
            culture.deliver([Stimulus(0.0, (SITES[0],), Pulse((Phase(460, amplitude_mv=1),)))], 0.1)
    assert rig.delivered[0].phases[0][0] * rig.delivered[0].phases[0][1] == -20 * rig.delivered[0].phases[1][1]


def test_each_pattern_is_one_sequence_that_stays_on_the_device(rig: Rig) -> None:
    with culture_on(rig) as culture:
        for pattern in (0, 1, 0, 1, 0):
            electrodes = tuple(culture.patterns[pattern].tolist())
            culture.deliver([Stimulus(0.0, electrodes, BALANCED_PULSE, 20.0, pattern)], 0.05)
        assert len(set(rig.sent)) == 2
        assert rig.sent[0] == rig.sent[2] == rig.sent[4]
        assert len(rig.sequences) == 2
        # The event that a sequence writes names its pattern, or none.
        culture.deliver([Stimulus(0.0, electrodes, BALANCED_PULSE, 20.0)], 0.05)
        assert [parse_line(text).get("pattern") for _, text in rig.events] == [0, 1, 0, 1, 0, None]
    assert rig.sequences == {}


def test_a_recording_is_delivered_to_the_sample_within_a_sequence(rig: Rig) -> None:
    rig.jitter = 13
    protocol = Protocol(pulse=BALANCED_PULSE, order="mixed", pulses=5, trials=4, setup_s=0.1)
    with culture_on(rig) as culture:
        recording = culture.record(protocol, seed=1)
        asked = np.concatenate([block.stimuli.time_s for block in culture.schedule(protocol, 1).blocks])
    frames = np.array(sorted({pulse.frame for pulse in rig.delivered}))
    assert len(frames) == len(asked) == 100
    assert len(rig.delivered) == 500
    gap, wished = np.diff(frames), np.rint(np.diff(asked) * 20_000)
    assert np.all(gap >= wished)
    assert np.mean(gap == wished) > 0.6
    for row, frame in enumerate(frames):
        out = {pulse.electrode for pulse in rig.delivered if pulse.frame == frame}
        assert out == set(recording.stimuli.electrodes[row].tolist())


def test_what_begins_late_is_observed_as_much_longer(rig: Rig) -> None:
    with culture_on(rig) as culture:
        observed = culture.deliver([Stimulus(0.0, (SITES[0],), BALANCED_PULSE)], 0.05)
    # All of a sequence has to arrive before its first pulse, for which it waits 5 ms.
    assert observed.stimulus_time_s.tolist() == [0.005]
    assert observed.duration_s == 0.055


def test_a_sequence_waits_for_the_last_pulse_of_the_one_before(rig: Rig) -> None:
    # The stand-in fails for two at once.
    with culture_on(rig, sequence_s=0.1) as culture:
        stimuli = [Stimulus(t, (SITES[i],), BALANCED_PULSE) for i, t in enumerate((0.01, 0.109, 0.1115))]
        observed = culture.deliver(stimuli, 0.2)
    assert len(rig.sent) == 2
    assert np.diff(observed.stimulus_time_s)[1] >= 0.001 + 0.005


def test_its_clock_begins_at_0_and_goes_on_where_the_devices_frames_begin_anew(rig: Rig) -> None:
    culture = culture_on(rig)
    with culture:
        assert culture.now_s == 0.0
        culture.rest(3.0)
    rig.now += 20_000
    with culture:
        assert culture.now_s == 4.0
    rig.now = 100
    with culture:
        assert culture.now_s == 4.0
        observed = culture.deliver([], 1.0)
        assert (observed.start_s, observed.duration_s, len(observed.spikes.time_s)) == (4.0, 1.0, 0)
        assert culture.now_s == 5.0


def test_each_step_of_opening_settles_as_long_as_the_vendor_says(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr("animat.cultures.devices.maxone.time.sleep", slept.append)
    timing = SimpleNamespace(waitInit=1, waitAfterDownload=2.5)
    monkeypatch.setattr(sys.modules["maxlab"], "Timing", timing, raising=False)
    with MaxOneCulture(selection(), stream=Stream(rig)):
        # The last is unknown to this version of the module.
        assert slept == [1.0, 2.5, 5.0]


def test_spikes_are_by_channel_and_those_of_no_electrode_are_counted(rig: Rig) -> None:
    stream = Stream(rig)
    with MaxOneCulture(selection(), stream=stream, settle=False) as culture:
        stream.extra = [(rig.now + 20, 31), (rig.now + 30, 1000), (rig.now + 31, 32), (rig.now + 5000, 3)]
        spikes = culture.advance(0.1)
        assert spikes.time_s.tolist() == [0.001, 0.00155]
        assert culture.channels.electrode[spikes.channel].tolist() == [RECORDED[31], RECORDED[32]]
        assert culture.channels.label[spikes.channel].tolist() == ["31", "32"]
        assert culture.spikes_not_recorded == 1
        without = {"spikes on amplifiers without an electrode": 1, "frames lost on the way": 0}
        without["spikes dropped, as too many came in one delivery"] = 0
        assert culture.left_out == without | {"spikes reported late": 0}
        stream.late_spikes = 2  # type: ignore[attr-defined]
        assert culture.left_out == without | {"spikes reported late": 2}


def test_a_stop_takes_the_power_and_says_what_was_sent(rig: Rig) -> None:
    with culture_on(rig, sequence_s=0.1) as culture:
        rig.on_send = lambda: culture.stop("smoke") if len(rig.sent) == 3 else None
        stimuli = [Stimulus(0.05 * i, (SITES[0],), BALANCED_PULSE) for i in range(20)]
        with pytest.raises(DeviceFailed, match="stopped while delivering: 6 of 20 stimuli had been sent"):
            culture.deliver(stimuli, 1.0)
        assert len(rig.delivered) == 4
        assert not rig.powered
        with pytest.raises(UnsafeStimulus, match="smoke"):
            culture.deliver(stimuli[:1], 1.0)
    with culture:
        rig.on_send = None
        # Which of those admitted came is not known: all count as just delivered.
        with pytest.raises(UnsafeStimulus, match="overlap"):
            culture.deliver(stimuli[:1], 1.0)
        culture.rest(1.0)
        culture.deliver(stimuli[:1], 1.0)
    assert len(rig.delivered) == 5


def test_power_that_stays_on_is_reported(rig: Rig) -> None:
    def refuse(command: Any) -> str:
        return "Error" if command.kind == "core" else str(send(command))

    module = sys.modules["maxlab"]
    send, culture = module.send, culture_on(rig).open()
    module.send = refuse
    for act in (culture.stop, culture.close):
        with pytest.raises(DeviceFailed, match="expected stimulation power to be switched off, got 'Error'"):
            act()
    # What else can be done is done.
    assert not any(unit["power"] or unit["connected"] for unit in rig.units.values())


def test_whatever_goes_wrong_meanwhile_takes_the_power(rig: Rig) -> None:
    for wrong in (KeyboardInterrupt, DeviceFailed):
        with culture_on(rig) as culture:

            def on_send(wrong: type[BaseException] = wrong) -> None:
                raise wrong("now")

            rig.on_send = on_send
            with pytest.raises(wrong):
                culture.deliver([Stimulus(0.0, (SITES[0],), BALANCED_PULSE)], 0.1)
            assert not rig.powered
            assert culture.is_stopped
            rig.on_send = None
            with pytest.raises(UnsafeStimulus, match=f"stopped: .* interrupted by {wrong.__name__}: now"):
                culture.deliver([Stimulus(0.1, (SITES[0],), BALANCED_PULSE)], 0.2)
        assert rig.delivered == []


def test_ctrl_c_while_nothing_is_stimulated_stops_it_too(rig: Rig) -> None:
    class Interrupted(Stream):
        def wait(self, frame: int) -> None:
            raise KeyboardInterrupt

    with MaxOneCulture(selection(), stream=Interrupted(rig), settle=False) as culture:
        with pytest.raises(KeyboardInterrupt):
            culture.advance(0.1)
        assert not rig.powered
        assert culture.is_stopped
        with pytest.raises(UnsafeStimulus, match="stopped"):
            culture.deliver([Stimulus(0.0, (SITES[0],), BALANCED_PULSE)], 0.2)


def test_a_delivery_that_hung_sends_nothing_in_a_later_session(rig: Rig) -> None:
    hanging, released = threading.Event(), threading.Event()

    class Hanging(Stream):
        def wait(self, frame: int) -> None:
            if threading.current_thread() is not threading.main_thread() and not hanging.is_set():
                hanging.set()
                released.wait(30)
            super().wait(frame)

    failed: list[Exception] = []
    culture = MaxOneCulture(selection(), stream=Hanging(rig), settle=False)

    def deliver() -> None:
        try:
            culture.deliver([Stimulus(0.5, (SITES[0],), BALANCED_PULSE)], 1.0)
        except DeviceFailed as error:
            failed.append(error)

    with culture:
        thread = threading.Thread(target=deliver)
        thread.start()
        assert hanging.wait(30)
    with culture:
        # Without a stop in between: the session alone is another.
        released.set()
        thread.join(30)
        assert len(failed) == 1
        assert rig.sent == []
        assert rig.delivered == []


def test_closing_leaves_no_unit_powered(rig: Rig) -> None:
    with culture_on(rig):
        assert sum(bool(unit["power"]) for unit in rig.units.values()) == 32
        assert not any(unit["connected"] for unit in rig.units.values())
    assert not rig.powered
    assert not any(unit["power"] or unit["connected"] for unit in rig.units.values())


def test_a_device_that_does_not_answer_is_one_line(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.dead = True
    with pytest.raises(DeviceFailed, match="expected stimulation power to be switched on, got 'Error'"):
        culture_on(rig).open()
    rig.dead = False
    rig.is_gone = True
    with pytest.raises(DeviceFailed, match=r"got ConnectionRefusedError: .* is MaxLab Live's server running") as failed:
        culture_on(rig).open()
    # What could not be done about it is in the notes: that the power is on, for one, which is not known.
    assert any("expected it to close, got ConnectionRefusedError" in note for note in failed.value.__notes__)
    rig.is_gone = False
    for step in ("", None, "nan", "-1"):
        rig.lsb_mv = step
        with pytest.raises(DeviceFailed, match="expected the converter's step"):
            culture_on(rig).open()
    monkeypatch.setattr(sys.modules["maxlab"], "initialize", lambda: [][0])
    with pytest.raises(DeviceFailed, match="MaxLab Live's server running"):
        culture_on(rig).open()
    monkeypatch.setitem(sys.modules, "maxlab", None)
    with pytest.raises(DeviceFailed, match="comes with MaxLab Live") as failed:
        culture_on(rig).open()
    assert "\n" not in str(failed.value)


def test_tighter_limits_take_the_devices_step_and_looser_ones_are_refused(rig: Rig) -> None:
    with culture_on(rig, limits=replace(MAXONE_LIMITS, amplitude=300.0)) as culture:
        assert culture.limits.amplitude_step == LSB_MV
    with pytest.raises(InvalidArgument, match=r"limits\.amplitude"):
        culture_on(rig, limits=replace(MAXONE_LIMITS, amplitude=401.0)).open()
    rig.lsb_mv = "0.5"
    with pytest.raises(InvalidArgument, match=r"limits\.amplitude: expected no looser than the device's 255.5"):
        culture_on(rig, limits=replace(MAXONE_LIMITS, amplitude=300.0)).open()


def test_a_selection_that_cannot_be_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="1 to 32 stimulation sites, got 132 and 33"):
        MaxOneCulture(selection(sites=[*SITES, 26_000]))
    many = Selection(MAXONE, np.arange(1025), np.array([1]), np.array([[1]]))
    with pytest.raises(InvalidArgument, match=r"expected 1 to 1,024 recording .* sites, got 1,025 and 1"):
        MaxOneCulture(many)
    with pytest.raises(InvalidArgument, match=r"selection: expected a selection, .*, got 'selection.json'"):
        MaxOneCulture("selection.json")  # type: ignore[arg-type]
    with pytest.raises(InvalidArgument, match="expected one on a MaxOne, got one on a CL1"):
        MaxOneCulture(_on_another_array())


def _on_another_array() -> Selection:
    other = replace(MAXONE, name="CL1", columns=8, rows=8)
    return Selection(other, np.array([1]), np.array([1]), np.array([[1]]))


@pytest.mark.parametrize(("layout", "size"), [(EVENT_24, 24), (EVENT_16, 16)])
def test_messages_of_the_stream_in_both_versions(layout: np.dtype, size: int) -> None:
    assert layout.itemsize == size
    stream = ZmqSpikes()
    # Six spikes of 16 bytes are as long as four of 24.
    for count in (2, 6, 3, 1):
        spikes = np.zeros(count, layout)
        spikes["frame"], spikes["channel"], spikes["amplitude"] = 41, np.arange(count) * 170 + 5, -30.5
        stream.hear([np.uint64(42).tobytes(), b"", spikes.tobytes()])
        frames, channels = stream.take(0, 100)
        assert (frames.tolist(), channels.tolist()) == ([41] * count, list(range(5, 5 + 170 * count, 170)))
    stream.hear([np.uint64(45).tobytes(), b""])
    assert (stream.frame(), stream.lost_frames) == (45, 2)


def test_spikes_that_come_out_of_order_are_taken_by_their_frame() -> None:
    stream = ZmqSpikes()
    for message, frames in ((1000, [1010, 990]), (1020, [1015, 1004])):
        spikes = np.zeros(2, EVENT_16)
        spikes["frame"], spikes["channel"] = frames, [1, 2]
        stream.hear([np.uint64(message).tobytes(), b"", spikes.tobytes()])
    assert stream.take(980, 1005)[0].tolist() == [990, 1004]
    # One comes after the frames around it were taken.
    spikes["frame"] = [1001, 1022]
    stream.hear([np.uint64(1024).tobytes(), b"", spikes.tobytes()])
    assert stream.take(1005, 1030)[0].tolist() == [1010, 1015, 1022]
    assert stream.late_spikes == 1
    stream.take(1040, 1040)
    assert stream.late_spikes == 1


@pytest.mark.parametrize("layout", [EVENT_24, EVENT_16])
def test_a_message_that_is_laid_out_in_no_known_way_is_refused(layout: np.dtype) -> None:
    stream = ZmqSpikes()
    spike = np.zeros(1, layout)
    spike["frame"], spike["channel"] = 100_000, 5
    stream.hear([np.uint64(100_000).tobytes(), b"", spike.tobytes()])
    for name, value in (("channel", 1024), ("frame", 70_000), ("frame", 2**63)):
        bad = spike.copy()
        bad[name] = value
        with pytest.raises(DeviceFailed, match="of frame 100001 on amplifiers 0 to 1023, of 24 or 16 bytes each"):
            stream.hear([np.uint64(100_001).tobytes(), b"", bad.tobytes()])
    with pytest.raises(DeviceFailed, match="got 3 bytes that are neither"):
        stream.hear([np.uint64(100_001).tobytes(), b"", b"123"])
    with pytest.raises(DeviceFailed, match="a frame's number in 8 bytes, got 3"):
        stream.hear([b"123"])
    assert stream.take(0, 2**62)[0].tolist() == [100_000]


def test_spikes_on_amplifiers_that_are_none_are_refused(rig: Rig) -> None:
    for channel in (-1, 1024):
        stream = Stream(rig)
        with MaxOneCulture(selection(), stream=stream, settle=False) as culture:
            stream.extra = [(rig.now + 20, channel)]
            with pytest.raises(DeviceFailed, match=f"amplifiers 0 to 1023, got one on {channel}"):
                culture.advance(0.1)


def test_a_stream_that_falls_silent_is_a_lost_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.cultures.devices.maxone_stream.PATIENCE_S", 0.0)
    stream = ZmqSpikes()
    stream.hear([np.uint64(42).tobytes(), b""])
    with pytest.raises(DeviceFailed, match="got none for 0 s: is MaxLab Live's server running") as failed:
        stream.wait(43)
    assert isinstance(failed.value.__cause__, ConnectionError)


def test_frames_that_begin_anew_are_refused_as_no_wait_for_a_later_one_would_end() -> None:
    stream = ZmqSpikes()
    for number in (1000, 1001):
        stream.hear([np.uint64(number).tobytes(), b""])
    with pytest.raises(DeviceFailed, match="expected frames after 1001, got 3: MaxLab Live's server was restarted"):
        stream.hear([np.uint64(3).tobytes(), b""])
    assert stream.frame() == 1001


def test_the_stream_hears_a_server() -> None:
    zmq = pytest.importorskip("zmq", reason="pyzmq is not installed")
    with zmq.Context() as context, context.socket(zmq.PUB) as server:
        port = server.bind_to_random_port("tcp://127.0.0.1")
        stream = ZmqSpikes(f"tcp://127.0.0.1:{port}")
        going = threading.Event()
        going.set()

        def serve() -> None:
            number = 0
            while going.is_set():
                spike = np.zeros(1, EVENT_24)
                spike["frame"], spike["channel"] = number, number % 7
                server.send_multipart([np.uint64(number).tobytes(), b"\0" * 4108, spike.tobytes()])
                number += 1
                if number % 50 == 0:
                    threading.Event().wait(0.002)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            stream.start()
            first = stream.frame()
            stream.wait(first + 500)
            frames, channels = stream.take(first, first + 500)
            np.testing.assert_array_equal(channels, frames % 7)
            assert len(frames) + stream.lost_frames >= 500
        finally:
            stream.stop()
            going.clear()
            thread.join()


def test_spikes_for_which_there_is_no_room_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maxone_stream, "KEPT_SPIKES", 5)
    stream = ZmqSpikes()
    spikes = np.zeros(2, EVENT_16)
    for message in (10, 20, 30, 40):
        spikes["frame"] = message
        stream.hear([np.uint64(message).tobytes(), b"", spikes.tobytes()])
    assert stream.take(0, 100)[0].tolist() == [20, 30, 30, 40, 40]
    assert stream.dropped_spikes == 3
