"""Responses: recordings counted by hand, a plain-loop extraction, Poisson spikes, and real cultures."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.errors import InvalidArgument, Mismatch, UnusableData
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from animat.recordings.recording import Channels, Recording
from animat.responses.conditions import All, ByFrequency, ByInterval, ByPattern, Conditions
from animat.responses.extraction import extract_responses
from animat.responses.inspection import inspect_recording
from animat.responses.psth import find_response, post_stimulus_histogram, spontaneous_rate
from animat.responses.responses import Responses
from animat.stimulation.protocol import Presentation, Protocol
from animat.stimulation.stimulus import NOTHING, Stimuli
from fake_culture import FakeCulture
from synthetic_recordings import synthetic_recording


def recording(
    spikes: list[tuple[float, int]] | np.ndarray,
    stimulus_s: list[float] | np.ndarray,
    n_channels: int = 4,
    duration_s: float = 10.0,
    frequency_hz: list[float] | np.ndarray | None = None,
    presentation: list[int] | None = None,
    pattern: list[int] | None = None,
) -> Recording:
    ordered = np.array(spikes, dtype=float).reshape(-1, 2)
    ordered = ordered[np.lexsort((ordered[:, 1], ordered[:, 0]))]
    n = len(stimulus_s)
    unknown = np.full(n_channels, np.nan)
    return Recording(
        ordered[:, 0],
        ordered[:, 1].astype(np.int64),
        Channels(np.arange(n_channels).astype(str), np.full(n_channels, -1), unknown, unknown),
        Stimuli(
            np.array(stimulus_s, dtype=float),
            np.full(n, 5.0) if frequency_hz is None else np.array(frequency_hz, dtype=float),
            np.full(n, -1) if pattern is None else np.array(pattern),
            np.full((n, 1), -1),
            np.arange(n) if presentation is None else np.array(presentation),
        ),
        sampling_rate_hz=float("nan"),
        start_s=0.0,
        duration_s=duration_s,
        start_min=30.0,
        presentation=Presentation("mixed", 2) if presentation else None,
    )


def names(responses: Responses) -> dict[str, str]:
    return {finding.name: finding.severity for finding in responses.findings}


# Counted by hand. Times are sums of powers of two, so that edges are exact: the window is 2^-9 to 2^-7 s.
WINDOW_MS = (1e3 * 2**-9, 1e3 * 2**-7)
START_S, END_S = 2**-9, 2**-7


def test_by_hand() -> None:
    first = [(1 + START_S, 0), (1 + 0.003, 0), (1 + 0.004, 2)]  # a spike on the lower edge counts
    second = [(2 + END_S, 1), (2 + 0.001, 1), (2 + 0.005, 3)]  # one on the upper edge does not, nor one before
    responses = extract_responses(recording([*first, *second], [1, 2, 3]), window_ms=WINDOW_MS)
    length_s = END_S - START_S
    assert responses.rate_hz.tolist() == pytest.approx([3 / (length_s * 4), 1 / (length_s * 4), 0])
    assert responses.active_ratio.tolist() == [0.5, 0.25, 0]
    assert responses.condition.tolist() == [0, 0, 0]
    assert [condition.label for condition in responses.conditions] == ["5 Hz"]
    assert responses.time_s is not None and responses.time_s.tolist() == [1, 2, 3]
    assert (responses.n_channels, responses.start_min, responses.window_ms) == (4, 30.0, WINDOW_MS)


def test_the_paper_equation_at_its_own_numbers() -> None:
    # 256 spikes on 1,024 channels in 8 ms: 256 / (0.008 x 1,024) = 31.25 Hz.
    spikes = [(1.005, channel) for channel in range(256)]
    responses = extract_responses(recording(spikes, [1], n_channels=1024))
    assert responses.rate_hz.tolist() == pytest.approx([31.25])
    assert responses.active_ratio.tolist() == [0.25]


def test_a_response_is_read_after_the_last_pulse_of_its_presentation() -> None:
    spikes = [(1.005, 0), (1.105, 1), (1.106, 1), (2.105, 2)]
    responses = extract_responses(
        recording(spikes, [1, 1.1, 2, 2.1, 3], presentation=[0, 0, 1, 1, 2]), All(), burst_threshold=1
    )
    assert responses.rate_hz.tolist() == pytest.approx([2 / 0.032, 1 / 0.032, 0])
    assert responses.time_s is not None and responses.time_s.tolist() == [1.1, 2.1, 3]
    assert responses.presentation == Presentation("mixed", 2)


def test_trials_are_kept_with_bursts_and_rests_also_where_they_have_no_condition() -> None:
    # Times are sums of powers of two. A second without a pulse is not yet a rest, and a trial's own pulses are none.
    pulses_s, trials = [1, 1.125, 2.125, 3.1875, 4.0, 4.75, 5.5], [0, 0, 1, 2, 3, 3, 3]
    spikes = [(t + 0.005, channel) for t, n in ((1.125, 1), (2.125, 2), (5.5, 1)) for channel in range(n)]
    given = recording(spikes, pulses_s, frequency_hz=[5, 5, np.nan, 5, 5, 5, 5], presentation=trials)
    responses = extract_responses(given, burst_threshold=0.25)
    presented, place = responses.presentations
    assert presented.condition.tolist() == [0, -1, 0, 0] and place.tolist() == [0, 2, 3]
    assert presented.is_rested.tolist() == [True, False, True, False]
    assert presented.is_burst.tolist() == [False, True, False, False]


def test_a_window_that_ends_with_the_recording_counts_however_times_are_rounded() -> None:
    assert 1.12 + 0.01 > 1.13
    for duration_s, n in ((1.13, 2), (1.13 - 2e-9, 1)):
        responses = extract_responses(recording([(1.125, 0)], [0.5, 1.12], duration_s=duration_s))
        assert responses.rate_hz.tolist() == pytest.approx([0, 31.25][:n])


def test_the_median_and_the_shares_above_it() -> None:
    responses = Responses(
        condition=np.array([0, 0, 0, 1, 1, 1]),
        rate_hz=np.array([1.0, 2, 9, 3, 4, 99]),
        active_ratio=np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.9]),
        is_burst=np.array([False] * 5 + [True]),
        conditions=ByFrequency((5, 80)).assign(recording([], []).stimuli).conditions,
        window_ms=(2, 10),
        n_channels=10,
        threshold=0.1,
        separability=1.0,
    )
    assert responses.median_rate_hz == 3  # of 1 2 3 4 9: the burst does not count
    assert responses.shares_above_median().tolist() == pytest.approx([1 / 3, 1])
    assert responses.rates_of(1).tolist() == [3, 4]


def test_responses_refuse_columns_that_do_not_belong_together() -> None:
    some = extract_responses(recording([(1.005, 0)], [1, 2]))
    with pytest.raises(Mismatch, match="rate_hz: expected 2 values"):
        Responses(
            some.condition, some.rate_hz[:1], some.active_ratio, some.is_burst, some.conditions, (2, 10), 4, 0.0, 0.0
        )
    with pytest.raises(Mismatch, match="expected indices of 0 conditions"):
        Responses(some.condition, some.rate_hz, some.active_ratio, some.is_burst, (), (2, 10), 4, 0.0, 0.0)
    for each in (some, pickle.loads(pickle.dumps(some))):
        for column in (each.rate_hz, each.presented.rate_hz):
            with pytest.raises(ValueError, match="read-only"):
                column[0] = 1


@pytest.mark.parametrize("window_ms", [(10.0, 2.0), (5.0, 5.0), (-1.0, 5.0), (0.0, float("inf")), (float("nan"), 1.0)])
def test_a_window_that_is_none_is_refused(window_ms: tuple[float, float]) -> None:
    with pytest.raises(InvalidArgument, match="window_ms: expected 0 <= start < end"):
        extract_responses(recording([], [1]), window_ms=window_ms)


def test_a_window_may_be_a_list_or_an_array() -> None:
    for window_ms in ([2, 10], np.array([2.0, 10.0])):
        assert extract_responses(recording([], [1]), window_ms=window_ms).window_ms == (2.0, 10.0)  # type: ignore[arg-type]
    with pytest.raises(InvalidArgument, match="window_ms: expected two numbers of milliseconds, start and end, got"):
        extract_responses(recording([], [1]), window_ms=(2, 10, 20))  # type: ignore[arg-type]


def test_conditions_may_be_text_and_what_is_not_a_recording_is_named(tmp_path: Path) -> None:
    source = recording([(1.004, 0), (2.004, 1)], [1.0, 2.0], frequency_hz=[5.0, 40.0])
    assert [c.label for c in extract_responses(source, "frequency:40").conditions] == ["40 Hz"]
    assert [c.label for c in inspect_recording(source, "frequency:5").responses.conditions] == ["5 Hz"]
    with pytest.raises(InvalidArgument, match="conditions: expected"):
        extract_responses(source, "colour")
    with pytest.raises(InvalidArgument, match="readouts: expected all, halves, quadrants or groups of electrodes"):
        extract_responses(source, readouts="thirds")
    with pytest.raises(UnusableData, match=r"responses\.rate_hz: expected finite numbers"):
        replace(extract_responses(source), rate_hz=np.full(2, np.nan))
    for wrong in ([source], "culture.nwb", None):
        for use in (extract_responses, inspect_recording, lambda given: write_nwb(given, tmp_path / "of-nothing.nwb")):
            with pytest.raises(InvalidArgument, match=r"expected a recording, as animat\.read_recording returns, got"):
                use(wrong)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_recording_without_channels_is_refused() -> None:
    with pytest.raises(UnusableData, match="channels: expected at least one"):
        extract_responses(recording([], [1], n_channels=0))


def by_loops(source: Recording, condition: list[int], window_ms: tuple[float, float]) -> list[tuple[int, int, int]]:
    """Condition, spikes and active channels of every response, in plain loops over everything."""
    rows = []
    times_s, presentations = source.stimuli.time_s.tolist(), source.stimuli.presentation.tolist()
    for i, time_s in enumerate(times_s):
        if presentations[i] in presentations[i + 1 :] or condition[i] < 0:
            continue
        if time_s + window_ms[1] * 1e-3 > source.stop_s + 1e-9:
            continue
        channels = [
            channel
            for spike_s, channel in zip(source.spike_times_s.tolist(), source.spike_channels.tolist(), strict=True)
            if time_s + window_ms[0] * 1e-3 <= spike_s < time_s + window_ms[1] * 1e-3
        ]
        rows.append((condition[i], len(channels), len(set(channels))))
    return rows


# On a grid of 0.05 ms as of 20 kHz, so that spikes do fall on edges, and dense enough that windows overlap.
samples = st.integers(0, 2000)


@settings(max_examples=150)
@given(
    spikes=st.lists(st.tuples(samples, st.integers(0, 4)), max_size=60),
    stimuli=st.lists(st.tuples(samples, st.booleans(), st.integers(-1, 2)), max_size=12),
    window=st.tuples(st.integers(0, 400), st.integers(1, 400)),
    by=st.sampled_from([All(), ByPattern((0, 1)), ByInterval((50, 200)), ByPattern((2, 7))]),
)
def test_agrees_with_plain_loops(
    spikes: list[tuple[int, int]],
    stimuli: list[tuple[int, bool, int]],
    window: tuple[int, int],
    by: Conditions,
) -> None:
    stimuli = sorted(stimuli)
    window_ms = (window[0] * 0.05, (window[0] + window[1]) * 0.05)
    source = recording(
        [(sample * 5e-5, channel) for sample, channel in spikes],
        [sample * 5e-5 for sample, _, _ in stimuli],
        n_channels=5,
        duration_s=0.1,
        presentation=np.cumsum([starts for _, starts, _ in stimuli], dtype=int).tolist(),
        pattern=[pattern for _, _, pattern in stimuli],
    )
    responses = extract_responses(source, by, window_ms)
    expected = by_loops(source, by.assign(source.stimuli).condition.tolist(), window_ms)
    length_s = (window_ms[1] - window_ms[0]) * 1e-3
    assert responses.condition.tolist() == [condition for condition, _, _ in expected]
    assert responses.rate_hz.tolist() == pytest.approx([n / (length_s * 5) for _, n, _ in expected])
    assert responses.active_ratio.tolist() == pytest.approx([active / 5 for _, _, active in expected])
    assert responses.is_burst.tolist() == [active / 5 > responses.threshold for _, _, active in expected]
    # What is left out is counted.
    left_out = sum(f.value or 0 for f in responses.findings if f.name in ("no-condition", "window-past-end"))
    assert len(responses) + left_out == np.count_nonzero(source.stimuli.is_last_of_presentation)


def poisson(rng: np.random.Generator, rate_hz: float, n_channels: int, duration_s: float) -> Recording:
    """Spikes at a constant rate whatever the stimulus, with a stimulus every 0.25 s."""
    n = rng.poisson(rate_hz * n_channels * duration_s)
    spikes = np.column_stack([np.sort(rng.uniform(0, duration_s, n)), rng.integers(0, n_channels, n)])
    stimulus_s = np.arange(0.5, duration_s - 0.5, 0.25)
    return recording(spikes, stimulus_s, n_channels, duration_s, frequency_hz=np.full(len(stimulus_s), 4.0))


def test_active_channels_are_those_with_a_spike_in_the_window() -> None:
    source = poisson(np.random.default_rng(0), rate_hz=50, n_channels=7, duration_s=20)
    responses, times_s = extract_responses(source), source.spike_times_s
    assert responses.time_s is not None
    for stimulus_s, ratio in zip(responses.time_s, responses.active_ratio, strict=True):
        inside = (times_s >= stimulus_s + 0.002) & (times_s < stimulus_s + 0.01)
        assert ratio == len(set(source.spike_channels[inside].tolist())) / 7


def test_poisson_spikes_give_their_rate() -> None:
    rng = np.random.default_rng(1)
    rate_hz, n_channels = 20.0, 50
    source = poisson(rng, rate_hz, n_channels, duration_s=200)
    responses = extract_responses(source, burst_threshold=1)
    length_s = 0.008
    # The mean of x is the rate, its variance rate / (T N), and a channel is active with 1 - exp(-rate T).
    standard_error = np.sqrt(rate_hz / (length_s * n_channels) / len(responses))
    assert responses.rate_hz.mean() == pytest.approx(rate_hz, abs=4 * standard_error)
    assert responses.rate_hz.var() == pytest.approx(rate_hz / (length_s * n_channels), rel=0.2)
    active = 1 - np.exp(-rate_hz * length_s)
    error = np.sqrt(active * (1 - active) / n_channels / len(responses))
    assert responses.active_ratio.mean() == pytest.approx(active, abs=4 * error)
    found, quiet_s = spontaneous_rate(source)
    # Quiet: from 100 ms after the previous stimulus to 20 ms before the next; the first has 200 ms.
    assert quiet_s == pytest.approx(0.13 * (len(source.stimuli) - 1) + 0.2)
    assert found == pytest.approx(rate_hz * n_channels, rel=0.05)
    assert find_response(source) is None


def test_a_response_put_into_poisson_spikes_is_found() -> None:
    rng = np.random.default_rng(2)
    plain = poisson(rng, rate_hz=5, n_channels=50, duration_s=100)
    n = 30 * len(plain.stimuli)
    evoked_s = np.repeat(plain.stimuli.time_s, 30) + rng.uniform(0.020, 0.060, n)
    spikes = np.column_stack([plain.spike_times_s, plain.spike_channels])
    evoked = np.column_stack([evoked_s, rng.integers(0, 50, n)])
    source = recording(np.vstack([spikes, evoked]), plain.stimuli.time_s, 50, 100)
    found = find_response(source)
    assert found is not None
    assert (found.start_ms, found.end_ms) == pytest.approx((20, 60), abs=1.5)
    findings = {f.name: f for f in extract_responses(source).findings}
    outside = findings.get("dead-window") or findings["response-elsewhere"]
    assert f"use --window-ms {found.start_ms:g} {found.end_ms:g}" in outside.message


def test_a_response_of_few_spikes_is_found_in_wider_bins() -> None:
    rng = np.random.default_rng(4)
    plain = poisson(rng, rate_hz=0.2, n_channels=50, duration_s=100)
    stimulus_s = plain.stimuli.time_s[::2]
    # 10 spikes a second are 10 in each bin of 5 ms, and one after each of 198 stimuli makes 33 more in six bins.
    evoked = np.column_stack([stimulus_s + rng.uniform(0.022, 0.052, len(stimulus_s)), np.zeros(len(stimulus_s))])
    spikes = np.vstack([np.column_stack([plain.spike_times_s, plain.spike_channels]), evoked])
    found = find_response(recording(spikes, stimulus_s, 50, 100))
    assert found is not None and (found.start_ms, found.end_ms) == (22, 52)


def test_responses_are_sought_after_pulses_that_no_other_follows_soon() -> None:
    rng = np.random.default_rng(5)
    first_s = np.arange(1.0, 41.0)
    spikes_s = np.sort(rng.uniform(0, 42, 250 * 42))
    # Pulses in pairs 0.1 s apart: the first of each evokes spikes after 5 ms, the second after 30 ms.
    evoked_s = [first_s + lag_s for lag_s in (*rng.uniform(0.005, 0.015, 15), *rng.uniform(0.130, 0.140, 15))]
    every_s = np.concatenate([spikes_s, *evoked_s])
    spikes = np.column_stack([every_s, rng.integers(0, 50, len(every_s))])
    pairs_s = np.sort(np.concatenate([first_s, first_s + 0.1]))
    found = find_response(recording(spikes, pairs_s, 50, 42))
    assert found is not None and (found.start_ms, found.end_ms) == pytest.approx((30, 40), abs=1.5)
    # There is no time for a response between most pulses of these trains.
    trains_s = (first_s[:15, None] + 0.004 * np.arange(10)).ravel()
    assert find_response(recording(spikes, trains_s, 50, 42)) is None


def test_histogram_bins_add_up_to_the_window() -> None:
    source = poisson(np.random.default_rng(3), 20, 10, 20)
    histogram = post_stimulus_histogram(source, -20, 50, 1)
    assert len(histogram.count) == 70
    responses = extract_responses(source, burst_threshold=1)
    inside = (histogram.edges_ms[:-1] >= 2) & (histogram.edges_ms[:-1] < 10)
    spikes = np.rint(responses.rate_hz * 0.008 * 10).sum()
    assert histogram.count[inside].sum() == spikes
    assert np.mean(histogram.rate_hz[inside]) == pytest.approx(responses.rate_hz.mean())
    wider = post_stimulus_histogram(source, -20, 50, 2)
    np.testing.assert_allclose(wider.rate_hz, histogram.rate_hz.reshape(-1, 2).mean(axis=1))
    with pytest.raises(InvalidArgument, match="bin_ms"):
        post_stimulus_histogram(source, bin_ms=0)
    with pytest.raises(InvalidArgument, match="from_ms"):
        post_stimulus_histogram(source, 5, 5)


def test_a_real_culture_has_the_numbers_known_of_it(real_data: Path) -> None:
    source = read_recording(real_data / "organoid_cartpole_maxone.npz")
    assert len(source.stimuli) == 2775
    by_frequency = ByInterval((5, 10, 20)).assign(source.stimuli).condition
    # In whole samples of the file's 20 kHz, where a tolerance has an edge: d f from 1/1.25 to 1.25.
    samples = np.rint(np.diff(np.load(real_data / "organoid_cartpole_maxone.npz")["stim_time_s"]) * 20_000)
    counted = [
        int(np.count_nonzero((samples * f * 5 >= 4 * 20_000) & (samples * f * 4 <= 5 * 20_000))) for f in (5, 10, 20)
    ]
    assert [int(np.count_nonzero(by_frequency == i)) for i in range(3)] == counted == [975, 183, 7]
    # The file names no end, so it ends with its last stimulus, whose window is lost. To keep it: the 15 min it lasted.
    whole = Recording(
        source.spike_times_s,
        source.spike_channels,
        source.channels,
        source.stimuli,
        source.sampling_rate_hz,
        source.start_s,
        900.0,
    )
    responses = extract_responses(whole)
    spikes = np.rint(responses.rate_hz * 0.008 * 108)
    assert len(responses) == 2775
    assert spikes.mean() == pytest.approx(20.26, abs=0.005)
    assert spikes.std() == pytest.approx(6.4, abs=0.05)
    assert names(responses)["response-time"] == "note"
    cut = extract_responses(source)
    assert len(cut) == 2774
    assert names(cut)["window-past-end"] == "note"
    assert np.rint(cut.rate_hz * 0.008 * 108).mean() == pytest.approx(20.26, abs=0.005)


def test_a_table_of_responses_has_a_row_for_each() -> None:
    recording = synthetic_recording(1, patterns=4, channels=16, start_min=5.0)
    responses = extract_responses(recording, readouts="halves")
    table = responses.to_frame()
    names = [f"rate_hz_{name}" for name in responses.readouts.names]
    assert list(table) == ["condition", "rate_hz", "active_ratio", "is_burst", "start_min", "time_s", *names]
    # Each half has 8 of the 16 channels, so x of all channels is the mean of both.
    np.testing.assert_allclose(table[names].mean(axis="columns"), table["rate_hz"])
    for i, condition in enumerate(responses.conditions):
        kept = table[(table["condition"] == condition.label) & ~table["is_burst"]]
        np.testing.assert_array_equal(kept["rate_hz"], responses.rates_of(i))
    assert set(table["start_min"]) == {5.0} and "time_s" not in replace(responses, time_s=None).to_frame()


def test_rests_are_no_responses_to_the_stimuli_that_share_their_frequency() -> None:
    pattern, times = [0, NOTHING] * 40, 1.0 + 0.2 * np.arange(80)
    spikes = [(t + 0.005, c) for t, p in zip(times.tolist(), pattern, strict=True) if p == 0 for c in (0, 1)]
    source = recording(spikes, times, duration_s=20.0, pattern=pattern)
    for by in ("frequency", "all", "interval:5"):
        responses = extract_responses(source, by, burst_threshold=1.0)
        assert len(responses) == 40 - (by == "interval:5")
        assert np.all(responses.rate_hz > 0)
        # They still are the history of the others.
        assert len(responses.presentations[0].rate_hz) == 80
        (left_out,) = (f.message for f in responses.findings if f.name == "no-condition")
        assert "40 of which deliver nothing (--conditions electrode)" in left_out
    alone = extract_responses(recording([], times, duration_s=20.0, pattern=[NOTHING] * 80), "all", burst_threshold=1.0)
    assert len(alone) == 80


@pytest.mark.parametrize("seed", range(3))
def test_pulses_at_1_hz_never_come_after_a_silence(seed: int) -> None:
    jitter_s = np.random.default_rng(seed).integers(-1, 2, 200) / 20_000
    times = np.round(1.0 + np.arange(200) + jitter_s, 6)
    source = recording([(t + 0.005, 0) for t in times.tolist()], times, duration_s=202.0, frequency_hz=np.ones(200))
    presented = extract_responses(source, burst_threshold=1.0).presentations[0]
    assert np.flatnonzero(presented.is_rested).tolist() == [0]


@pytest.mark.parametrize("conditions", [[-1], [0, 0], [2]])
def test_conditions_that_a_recording_lacks_cannot_be_chosen(conditions: list[int]) -> None:
    times = np.arange(1.0, 9.0, 0.2)
    source = recording([(1.005, 0)], times, frequency_hz=np.tile([5.0, 10.0], 20))
    with pytest.raises(InvalidArgument, match="conditions: expected some of 0 to 1, each once, got"):
        extract_responses(source, burst_threshold=1.0).only(conditions)


@pytest.mark.parametrize(("pause_s", "tail_s", "setup_s"), [(0.5, 0.1, 14.0), (0.5, 0.005, 14.0), (0.2, 0.1, 0.3)])
def test_the_set_up_between_blocks_which_the_clock_leaves_out_is_a_silence(
    pause_s: float, tail_s: float, setup_s: float
) -> None:
    protocol = Protocol((10.0, 20.0, 40.0), patterns=4, trials=8, setup_s=setup_s, pause_s=pause_s, tail_s=tail_s)
    with FakeCulture() as culture:
        recording = culture.record(protocol, 1)
    found = extract_responses(recording, burst_threshold=1.0)
    first_hz = recording.stimuli.frequency_hz[[0, 8, 16]]
    silent_s = setup_s + pause_s + 1 / first_hz + tail_s
    rested = [0, *(row for row, gap_s in zip((8, 16), silent_s[1:], strict=True) if gap_s > 1.05)]
    # The windows of the last trials are cut off, if the tail is shorter.
    read = [row for row in range(24) if tail_s > 0.01 or row % 8 < 7]
    assert found.time_s is not None and found.time_s.tolist() == recording.stimuli.time_s[read].tolist()
    assert np.asarray(read)[found.presentations[0].is_rested].tolist() == rested
    left_out = [f.message for f in found.findings if f.name == "window-past-end"]
    assert (len(left_out) == 1) == (tail_s < 0.01) and all("3 of 24" in each for each in left_out)
