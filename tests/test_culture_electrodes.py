"""The virtual culture as its electrodes see it. Oracles: distances by brute force, and the tissue asked directly."""

from __future__ import annotations

import gc
import itertools
import json
import weakref
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cultures.replay import ReplayCulture
from animat.cultures.tissue import Pulse as TissuePulse
from animat.cultures.tissue import Tissue, TissueParameters
from animat.cultures.tissue.parameters import ShortTerm
from animat.cultures.tissue.tissue import Spikes
from animat.cultures.virtual import WARM_UP_S, VirtualCulture
from animat.cultures.visibility import NOISE_UV, Pairs
from animat.errors import InvalidArgument, InvalidFile, Mismatch, UnusableData
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.stimulation.array import MAXONE
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.selection import Selection, SelectionRule
from animat.stimulation.stimulus import Stimulus
from cultures import FEW, small_culture
from fake_culture import FakeCulture
from test_tissue import interrupted_after

SHORT = Protocol((10.0, 40.0), patterns=5, trials=5, setup_s=0.5, pause_s=0.2)


@pytest.fixture(scope="module")
def culture() -> VirtualCulture:
    return small_culture().open()


def stimulus(culture: VirtualCulture, time_s: float, pattern: int = 0) -> Stimulus:
    return Stimulus(time_s, tuple(culture.patterns[pattern].tolist()), PUBLISHED_PULSE)


def test_an_electrode_sees_every_neuron_within_25_um_and_no_other(culture: VirtualCulture) -> None:
    tissue, pairs = culture.tissue, culture.visibility.pairs
    electrodes = np.arange(len(MAXONE))
    x_um, y_um = (position + MAXONE.pitch_um / 2 for position in MAXONE.position_um(electrodes))
    for neuron in range(0, 300, 7):
        distance_um = np.hypot(x_um - tissue.x_um[neuron], y_um - tissue.y_um[neuron])
        seen_by = pairs.electrode[pairs.neuron == neuron]
        assert seen_by.tolist() == electrodes[distance_um <= 25.0].tolist()
        np.testing.assert_allclose(pairs.distance_um[pairs.neuron == neuron], distance_um[seen_by])


def test_spikes_are_smaller_with_distance_and_never_lost_in_noise(culture: VirtualCulture) -> None:
    seen = culture.visibility
    every = np.arange(300)
    at_soma, halfway, far = (seen.amplitude_at(Pairs(every, every, np.full(300, d))) for d in (0.0, 15.0, 25.0))
    assert np.all((at_soma >= 60) & (at_soma <= 300))
    np.testing.assert_allclose(halfway, at_soma / 2)
    assert far.min() > 5 * NOISE_UV


def test_the_scan_measures_what_the_neurons_do() -> None:
    culture = small_culture()
    with culture:
        scan = culture.scan
        assert scan is not None
        assert len(scan) == len(MAXONE)
        # The same tissue, asked neuron by neuron: what it fires in the second in which all blocks are scanned at once.
        tissue = Tissue(1, FEW)
        tissue.advance(WARM_UP_S)
        fired = np.bincount(tissue.advance(1.0).neuron, minlength=300)
        for block in MAXONE.scan_blocks():
            for electrode in block[::50]:
                seen = culture.visibility.pairs.neuron[culture.visibility.pairs.electrode == electrode]
                assert scan.rate_hz[electrode] == fired[seen].sum()
        silent = scan.rate_hz == 0
        assert np.all(np.isnan(scan.amplitude_uv[silent]))
        assert not np.any(scan.signal_to_noise[silent])


def test_the_scan_does_not_age_the_culture() -> None:
    with small_culture() as scanned:
        recording = scanned.record(SHORT)
    with small_culture(selection=scanned.selection) as given:
        assert given.scan is None
        again = given.record(SHORT)
    assert np.array_equal(again.spike_times_s, recording.spike_times_s)
    assert np.array_equal(again.spike_channels, recording.spike_channels)


def test_sites_sit_on_neurons_and_stimulation_sites_on_excitatory_ones(culture: VirtualCulture) -> None:
    selection, tissue = culture.selection, culture.tissue
    pairs = culture.visibility.pairs_of(selection.stimulation)
    nearest = [
        pairs.neuron[pairs.electrode == i][np.argmin(pairs.distance_um[pairs.electrode == i])]
        for i in range(len(selection.stimulation))
    ]
    assert np.mean(tissue.is_excitatory[nearest]) > 0.8
    assert set(culture.stimulation_electrodes) <= set(selection.recording.tolist())


def test_a_recording_is_what_the_tissue_does_on_its_own() -> None:
    with small_culture() as culture:
        schedule = culture.schedule(SHORT, seed=2)
        snapshot = culture.tissue.snapshot()
        start_s = culture.tissue.now_s
        recording = culture.record(SHORT, seed=2)
        tissue = Tissue(1, FEW)
        tissue.restore(snapshot)
        assert recording.start_min == 0.0
        table, pairs = culture.selection.recording, culture.visibility.pairs
        expected = []
        recorded_s, passed_s = 0.0, start_s
        for block in schedule.blocks:
            tissue.rest(round(block.setup_s / 2e-4) * 2e-4)
            passed_s += block.setup_s
            pulses = []
            for row, time_s in enumerate(block.stimuli.time_s):
                x_um, y_um = MAXONE.position_um(block.stimuli.electrodes[row])
                pulses.append(TissuePulse(passed_s + time_s, x_um + 8.75, y_um + 8.75))
            spikes = tissue.advance(block.duration_s, pulses)
            for time_s, neuron in zip(spikes.time_s.tolist(), spikes.neuron.tolist(), strict=True):
                for electrode in pairs.electrode[pairs.neuron == neuron]:
                    if electrode in table:
                        since_s = time_s - passed_s
                        expected.append(
                            (round((recorded_s + since_s) * 20_000), int(np.searchsorted(table, electrode)))
                        )
            passed_s += block.duration_s
            recorded_s += block.duration_s
        frames = np.rint(recording.spike_times_s * 20_000).astype(int).tolist()
        assert sorted(zip(frames, recording.spike_channels.tolist(), strict=True)) == sorted(expected)
        assert recording.duration_s == pytest.approx(schedule.recorded_s)
        assert culture.now_s == pytest.approx(schedule.duration_s)


@pytest.mark.oracle
@pytest.mark.parametrize("piece_s", [0.0125, 0.00007, 0.3])
def test_the_same_spikes_however_time_is_cut(piece_s: float) -> None:
    whole, cut = small_culture().open(), small_culture().open()
    total_s = 0.6
    stimuli = [stimulus(whole, 0.0201 * i, i % 5) for i in range(1, 20)]
    expected = whole.deliver(stimuli, total_s)
    times, channels, now_s = [], [], 0.0
    for i in range(1, round(total_s / piece_s) + 1):
        end_s = min(i * piece_s, total_s)
        due = [s for s in stimuli if now_s <= s.time_s < end_s]
        moved = [Stimulus(max(0.0, s.time_s - now_s), s.electrodes, s.pulse) for s in due]
        observed = cut.deliver(moved, end_s - now_s)
        times.append(now_s + observed.spikes.time_s)
        channels.append(observed.spikes.channel)
        now_s = cut.now_s
    known = expected.spikes.time_s < now_s - 1e-9
    np.testing.assert_allclose(np.concatenate(times), expected.spikes.time_s[known], atol=2e-9)
    assert np.array_equal(np.concatenate(channels), expected.spikes.channel[known])
    assert len(np.concatenate(times)) > 50


def test_electrodes_that_see_no_neuron_record_nothing(culture: VirtualCulture) -> None:
    blind = np.setdiff1d(np.arange(MAXONE.columns * MAXONE.rows), culture.visibility.pairs.electrode)[:3]
    known = culture.selection
    with small_culture(selection=Selection(known.array, blind, known.stimulation, known.patterns)) as other:
        observed = other.deliver([stimulus(other, 0.0)], 0.5)
        assert len(other.fired[0]) > 50
        assert len(observed.spikes.time_s) == len(observed.spikes.channel) == 0


def test_stimulate_sees_what_a_delivery_sees() -> None:
    one, other = small_culture().open(), small_culture().open()
    for window_ms in (5, (5,), (1.0, 2.0, 3.0)):
        with pytest.raises(InvalidArgument, match="window_ms: expected a start and an end"):
            one.stimulate(one.patterns[0].tolist(), PUBLISHED_PULSE, window_ms)  # type: ignore[arg-type]
    seen = one.stimulate(one.patterns[0].tolist(), PUBLISHED_PULSE, (2.0, 10.0))
    spikes = other.deliver([stimulus(other, 0.0)], 0.01).spikes
    inside = (spikes.time_s >= 0.002 - 1e-9) & (spikes.time_s < 0.010 - 1e-9)
    np.testing.assert_allclose(seen.time_s, spikes.time_s[inside], atol=1e-9)
    assert sorted(seen.channel.tolist()) == sorted(spikes.channel[inside].tolist())
    assert len(seen.time_s) > 0


def test_the_strength_of_a_pulse_is_its_cathodic_charge() -> None:
    def answer(pulse: Pulse) -> int:
        with small_culture() as culture:
            return sum(
                len(culture.stimulate(culture.patterns[i].tolist(), pulse, (0.0, 10.0)).time_s) for i in range(10)
            )

    published = answer(PUBLISHED_PULSE)
    same_charge = Pulse((Phase(1000, amplitude_mv=-100), Phase(1000, amplitude_mv=100)))
    half = Pulse((Phase(250, amplitude_mv=-200), Phase(250, amplitude_mv=200)))
    anodic = Pulse((Phase(50, amplitude_mv=100), Phase(50, amplitude_mv=0)))
    assert answer(same_charge) == published
    assert answer(anodic) < answer(half) < published


@pytest.mark.oracle
def test_a_state_goes_on_bit_for_bit(tmp_path: Path) -> None:
    with small_culture() as culture:
        culture.record(SHORT, seed=1)
        # Ends in the middle of a step, with a pulse just given.
        culture.deliver([stimulus(culture, 0.01)], 0.01013)
        culture.save_state(tmp_path / "culture.state", sessions=1)
        expected = culture.record(SHORT, seed=2)
    again = small_culture()
    assert again.restore_state(tmp_path / "culture.state") == {"sessions": 1}
    with again:
        assert again.record(SHORT, seed=2).equals(expected)
    with pytest.raises(Mismatch, match="which differs in seed"):
        small_culture(2).restore_state(tmp_path / "culture.state")
    with pytest.raises(Mismatch, match="which differs in scan_s"):
        small_culture(scan_s=2.0).restore_state(tmp_path / "culture.state")
    fewer = replace(again.selection, recording=again.selection.recording[:50])
    with pytest.raises(Mismatch, match=r"which differs in selection: use the same electrodes"):
        small_culture(selection=fewer).restore_state(tmp_path / "culture.state")
    small_culture(selection=again.selection).restore_state(tmp_path / "culture.state")
    whole = (tmp_path / "culture.state").read_bytes()
    for damaged in (b"", whole[:100], whole[: len(whole) // 2], b"text", whole[:-200]):
        (tmp_path / "bad.state").write_bytes(damaged)
        with pytest.raises(InvalidFile, match=r"bad.state: expected the whole state"):
            small_culture().restore_state(tmp_path / "bad.state")
    refused = 0
    for place in range(len(whole) // 3, len(whole) // 2, 97):
        # One byte within: some zlib finds, some the checksum, and a few (a date) do not matter. No other error comes.
        (tmp_path / "bad.state").write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        try:
            small_culture().restore_state(tmp_path / "bad.state")
        except InvalidFile:
            refused += 1
    assert refused >= 10
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(InvalidFile, match=r"other.npz: expected the whole state"):
        small_culture().restore_state(tmp_path / "other.npz")
    with pytest.raises(InvalidFile, match="no such file"):
        small_culture().restore_state(tmp_path / "none.state")


def test_the_settings_of_a_culture_do_not_depend_on_how_numbers_are_written() -> None:
    facilitated = ShortTerm(1, 750, 0)
    whole = VirtualCulture(
        1, parameters=TissueParameters(ampa_ms=3, i_to_any=facilitated), rule=SelectionRule(spacing_um=18), scan_s=20
    )
    with_fractions = VirtualCulture(
        1, parameters=TissueParameters(ampa_ms=3.0, i_to_any=ShortTerm(1.0, 750.0)), rule=SelectionRule(), scan_s=20.0
    )
    assert whole.settings == with_fractions.settings
    # As existing recordings state them, with all defaults.
    stated = VirtualCulture(1).settings
    assert stated["scan_s"] == "20.0"
    rule, parameters = stated["selection_rule"], stated["tissue_parameters"]
    assert rule == json.dumps(asdict(SelectionRule()))
    assert '"recording_sites": 1024, "signal_to_noise": 6.0, "spacing_um": 18.0, "stimulation_sites": 32' in rule
    assert parameters == json.dumps(asdict(TissueParameters()))
    assert parameters.startswith('{"neurons": 1200, "excitatory_share": 0.8, "width_um": 3850.0')


class Pressing:
    """A progress at which a person presses Ctrl-C, the first time that there is any."""

    pressed = False

    def update(self, done: float, total: float, note: str = "") -> None:
        if not self.pressed:
            self.pressed = True
            raise KeyboardInterrupt


def test_a_culture_whose_opening_was_broken_off_can_be_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with small_culture() as undisturbed:
        recording = undisturbed.record(SHORT)
    culture = small_culture(progress=Pressing())
    with pytest.raises(KeyboardInterrupt):
        culture.open()
    with pytest.raises(InvalidArgument, match="expected one that was opened, got a new one"):
        _ = culture.tissue
    with culture:
        assert culture.now_s == 0.0
        assert culture.record(SHORT).equals(recording)
    # The same in the warm-up, where there is no scan.
    given = small_culture(selection=undisturbed.selection)
    with monkeypatch.context() as patched:
        patched.setattr("animat.cultures.virtual.WARM_UP_S", -1.0)
        with pytest.raises(InvalidArgument):
            given.open()
    with given:
        assert given.now_s == 0.0
        assert np.array_equal(given.record(SHORT).spike_times_s, recording.spike_times_s)


def test_a_culture_for_which_no_electrodes_were_found_stays_a_new_one() -> None:
    culture = small_culture(rule=SelectionRule(signal_to_noise=1000.0))
    for _ in range(2):
        with pytest.raises(InvalidArgument, match="pass a signal-to-noise ratio of 1000"):
            culture.open()


def test_a_culture_that_another_s_state_was_given_to_is_what_it_was(tmp_path: Path) -> None:
    with small_culture() as first:
        first.advance(0.3)
        first.save_state(tmp_path / "first.state")
        recording = first.record(SHORT)
    with small_culture(2) as other:
        other.save_state(tmp_path / "other.state")
        begun = other.record(SHORT)
    culture = small_culture(2)
    with pytest.raises(Mismatch, match="differs in seed"):
        culture.restore_state(tmp_path / "first.state")
    with culture:
        assert culture.record(SHORT).equals(begun)
    restored = small_culture()
    restored.restore_state(tmp_path / "first.state")
    with pytest.raises(Mismatch, match="differs in seed"):
        restored.restore_state(tmp_path / "other.state")
    with restored:
        assert restored.record(SHORT).equals(recording)


def test_a_dropped_culture_is_freed_without_garbage_collection() -> None:
    gc.disable()
    try:
        with small_culture() as culture:
            culture.deliver([stimulus(culture, 0.0)], 0.1)
        tissue = culture.tissue
        freed = [weakref.ref(each) for each in (culture, tissue, tissue._coupling, tissue._network)]
        del culture, tissue
        assert [each() for each in freed] == [None] * 4
    finally:
        gc.enable()


def test_a_recording_comes_back_equal_from_its_file(tmp_path: Path) -> None:
    with small_culture() as culture:
        recording = culture.record(SHORT)
    write_nwb(recording, tmp_path / "one.nwb")
    again = read_recording(tmp_path / "one.nwb")
    assert again.equals(recording)
    assert again.protocol == SHORT


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(InvalidArgument, match="seed: expected 0 or more, got -1"):
        VirtualCulture(-1)
    for seed, got in ((1.5, "1.5"), ("a", "str"), (None, "None"), (True, "True")):
        with pytest.raises(InvalidArgument, match=f"seed: expected a whole number, got {got}"):
            VirtualCulture(seed)  # type: ignore[arg-type]
    assert VirtualCulture(np.int64(3)).settings == VirtualCulture(3).settings  # type: ignore[arg-type]
    with pytest.raises(InvalidArgument, match="scan_s: expected above 0"):
        VirtualCulture(1, scan_s=0.0)
    with pytest.raises(InvalidArgument, match="expected one that was opened"):
        _ = VirtualCulture(1).channels


def test_a_replay_answers_with_what_was_measured() -> None:
    protocol = Protocol((10.0, 40.0), order="mixed", pulses=2, patterns=5, trials=8, setup_s=0.0, pause_s=0.2)
    with small_culture() as culture:
        source = culture.record(protocol)

    def responses(recording: Recording, frequency_hz: float, pattern: int) -> list[tuple[tuple[int, int], ...]]:
        found = []
        stimuli = recording.stimuli
        asked = (stimuli.frequency_hz == frequency_hz) & (stimuli.pattern == pattern)
        for i in np.flatnonzero(stimuli.is_last_of_presentation & asked):
            until_s = stimuli.time_s[i] + 0.012
            first, last = np.searchsorted(recording.spike_times_s, [stimuli.time_s[i] - 1e-9, until_s - 1e-9])
            frames = np.rint((recording.spike_times_s[first:last] - stimuli.time_s[i]) * 20_000).astype(int)
            found.append(
                tuple(sorted(zip(frames.tolist(), recording.spike_channels[first:last].tolist(), strict=True)))
            )
        return found

    with ReplayCulture([source], seed=3) as replay:
        drawn = replay.record(protocol, seed=9)
    for frequency_hz, pattern in itertools.product((10.0, 40.0), range(5)):
        assert set(responses(drawn, frequency_hz, pattern)) <= set(responses(source, frequency_hz, pattern))
    with (
        ReplayCulture([source]) as replay,
        pytest.raises(InvalidArgument, match=r"expected one that was recorded \(10, 40 Hz\), got 20"),
    ):
        replay.deliver([Stimulus(0.0, replay.stimulation_electrodes[:1], PUBLISHED_PULSE, 20.0)], 0.01)


def test_a_replay_answers_a_frequency_that_its_recordings_state_rounded() -> None:
    with FakeCulture() as fake:
        source = fake.record(Protocol((20.0, 40.0), patterns=2, trials=4))
    rounded_hz = np.nextafter(source.stimuli.frequency_hz, np.inf)
    with ReplayCulture([replace(source, stimuli=replace(source.stimuli, frequency_hz=rounded_hz))]) as replay:
        replay.deliver([Stimulus(0.0, replay.stimulation_electrodes[:1], PUBLISHED_PULSE, 20.0)], 0.01)


def test_a_replay_answers_from_the_newest_recording_at_its_clock() -> None:
    with FakeCulture() as fake:
        source = fake.record(Protocol((20.0,), patterns=2, trials=4))

    def answering(channel: int, start_min: float) -> Recording:
        times_s = source.stimuli.time_s + 0.003
        channels = np.full(len(times_s), channel)
        return replace(source, start_min=start_min, spike_times_s=times_s, spike_channels=channels)

    with ReplayCulture([answering(1, 40.0), answering(0, 30.0)]) as replay:
        replay.rest(599.99)
        pulses = [Stimulus(t, replay.stimulation_electrodes[:1], PUBLISHED_PULSE, 20.0) for t in (0.0, 0.02)]
        observed = replay.deliver(pulses, 0.05)
        assert observed.start_s == pytest.approx(2399.99)
        assert (observed.spikes.time_s.tolist(), observed.spikes.channel.tolist()) == ([0.003, 0.023], [0, 1])
        # A rest ends before the spike at its very end.
        replay.deliver(pulses[:1], 0.001)
        replay.rest(0.002)
        assert replay.advance(0.01).time_s.tolist() == [0.0]


def test_a_replay_answers_from_no_pulse_whose_response_was_not_recorded_to_its_end() -> None:
    with FakeCulture() as fake:
        source = fake.record(Protocol((20.0,), patterns=2, trials=4))
    times_s = source.stimuli.time_s + 0.003
    source = replace(source, spike_times_s=times_s[:-1], spike_channels=np.zeros(len(times_s) - 1, np.int64))
    ended = replace(source, duration_s=source.stimuli.time_s[-1] + 0.002 - source.start_s)
    answered = []
    for recording in (source, ended):
        with ReplayCulture([recording]) as replay:
            pulses = [Stimulus(0.02 * n, replay.stimulation_electrodes[:1], PUBLISHED_PULSE, 20.0) for n in range(60)]
            answered.append(len(replay.deliver(pulses, 1.25).spikes.time_s))
    # The last pulse was followed by none as long as it was recorded.
    assert answered[0] < answered[1] == 60


def test_what_a_replay_cannot_answer_from_is_refused() -> None:
    with FakeCulture() as fake:
        source = fake.record(Protocol((20.0,), patterns=2, trials=4))
    n = len(source.stimuli)
    others = replace(source.channels, label=np.array([f"other {label}" for label in source.channels.label]))
    for recordings, kind, words in (
        ([], InvalidArgument, "recordings: expected at least one"),
        ([source, replace(source, channels=others)], Mismatch, "recordings: expected the same channels in all"),
        *(
            ([replace(source, stimuli=replace(source.stimuli, **{name: unknown}))], UnusableData, "known frequency and")
            for name, unknown in (("frequency_hz", np.full(n, np.nan)), ("electrodes", np.full((n, 1), -1)))
        ),
    ):
        with pytest.raises(kind, match=words):
            ReplayCulture(recordings)


def test_a_replay_is_stimulated_wherever_its_recordings_were() -> None:
    """A place that is one of the culture's patterns has a number, and one that is not has none."""
    places = ((100, 101), (103, 105, 107))
    with FakeCulture() as fake:
        sources = [fake.record(Protocol((20.0, 40.0), places=places, trials=3), seed) for seed in (0, 1)]
        sources.append(fake.record(Protocol((20.0,), places=((102, 106),), trials=3), 2))
    with ReplayCulture(sources) as replay:
        assert replay.stimulation_electrodes == (100, 101, 102, 103, 105, 106, 107)
        assert len(replay.record(Protocol((20.0, 40.0), places=places, trials=2)).stimuli) == 8
    # Without any number, each set of electrodes is a pattern.
    unnumbered = replace(sources[0].stimuli, pattern=np.full(len(sources[0].stimuli), -1))
    patterns = ReplayCulture([replace(sources[0], stimuli=unnumbered)]).patterns
    assert patterns.tolist() == [[100, 101, -1], [103, 105, 107]]
    for recorded_hz, rate_hz in ((25_000.0, 25_000.0), (np.nan, 20_000.0)):
        assert ReplayCulture([replace(sources[0], sampling_rate_hz=recorded_hz)]).sampling_rate_hz == rate_hz


def test_a_rest_that_is_broken_off_was_as_long_as_the_tissue_has_rested(monkeypatch: pytest.MonkeyPatch) -> None:
    with small_culture() as culture:
        began_s, advance, minutes = culture.now_s, Tissue.advance, []

        def stopped(self: Tissue, *of: Any) -> Spikes:
            minutes.append(1)
            if len(minutes) == 2:
                raise KeyboardInterrupt
            return advance(self, *of)

        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(Tissue, "advance", stopped)
            culture.rest(180.0)
        assert culture.now_s - began_s == pytest.approx(60.0)
        seen = culture.deliver([], 1.0)
        assert len(seen.spikes.time_s) > 0
        assert seen.spikes.time_s.min() >= 0


def pressed(*_: Any) -> Any:
    raise KeyboardInterrupt


def test_a_delivery_that_is_broken_off_ends_where_the_tissue_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with small_culture() as culture:
        stimuli = [stimulus(culture, 0.5 * number) for number in range(40)]
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            interrupted_after(1, patch)
            culture.deliver(stimuli, 20.0)
        # The warm-up took 5 s of the tissue's first mark.
        assert culture.now_s == 5.0 and culture.delivered == 40
        # Pulses that did not come count as if they had come just now.
        culture.rest(1.0)
        seen = culture.deliver(stimuli[:1], 1.0)
        assert seen.start_s == 6.0 and seen.spikes.time_s.min() >= 0 and seen.spikes.time_s.max() < 1.0
        culture.save_state(tmp_path / "culture.state")
        # Pressed when the tissue has come to the end.
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr("animat.cultures.virtual.np.rint", pressed)
            culture.deliver([], 3.0)
        assert culture.now_s == 10.0 and culture.deliver(stimuli[:1], 1.0).spikes.time_s.min() >= 0
    small_culture().restore_state(tmp_path / "culture.state")
