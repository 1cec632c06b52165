"""Findings, inspection and figures: recordings made to have one fault each, and real cultures with theirs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from animat.errors import InvalidArgument, UnusableData
from animat.neurons.simulator import fit_empirical
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.report.array import draw_array
from animat.report.colours import condition_colours
from animat.report.inspection import draw_inspection, inspection_text
from animat.report.response_histograms import draw_burst_separation, draw_response_histograms, rate_edges
from animat.report.spikes import draw_psth, draw_raster
from animat.report.style import save_figure
from animat.responses.condition import Condition
from animat.responses.conditions import All, Assignment, ByElectrode, ByFrequency, ByInterval, ByPattern, Conditions
from animat.responses.extraction import extract_responses
from animat.responses.inspection import inspect_recording
from animat.responses.psth import post_stimulus_histogram
from animat.responses.quality.responses import _difference
from animat.responses.responses import Responses
from animat.stimulation.stimulus import Stimuli
from synthetic_recordings import SyntheticCulture, synthetic_recording
from test_responses import names, recording


def answering(
    spikes_of: dict[float, float],
    n: int = 60,
    n_channels: int = 40,
    seed: int = 0,
    window_s: tuple[float, float] = (0.003, 0.009),
) -> Recording:
    """A culture that answers each frequency with Poisson spikes of the given mean, with 1 Hz per channel besides."""
    rng = np.random.default_rng(seed)
    frequencies = np.repeat(list(spikes_of), n)
    rng.shuffle(frequencies)
    stimulus_s = 1 + 0.25 * np.arange(len(frequencies))
    duration_s = float(stimulus_s[-1] + 1)
    spikes = [(t, int(rng.integers(n_channels))) for t in rng.uniform(0, duration_s, int(n_channels * duration_s))]
    for time_s, frequency in zip(stimulus_s, frequencies, strict=True):
        count = rng.poisson(spikes_of[frequency])
        spikes += [(time_s + rng.uniform(*window_s), int(rng.integers(n_channels))) for _ in range(count)]
    return recording(spikes, stimulus_s, n_channels, duration_s, frequency_hz=frequencies)


def message(source: Recording, name: str, **options: object) -> str:
    found = {f.name: f.message for f in extract_responses(source, **options).findings}  # type: ignore[arg-type]
    return found[name]


def test_nothing_is_wrong_with_a_good_recording() -> None:
    source = SyntheticCulture(seed=1).record(0.0)
    inspection = inspect_recording(source)
    assert inspection.verdict == "usable"
    assert {f.severity for f in inspection.findings} == {"note"}
    assert names(inspection.responses)["difference"] == "note"
    assert [c.label for c in inspection.conditions] == ["5 Hz", "10 Hz", "20 Hz", "40 Hz", "80 Hz"]
    assert sum(c.n_responses for c in inspection.conditions) == 500
    assert sum(c.n_responses - c.n_non_burst for c in inspection.conditions) == inspection.n_bursts


def test_no_stimuli() -> None:
    inspection = inspect_recording(recording([(1.0, 0)], []))
    assert [f.name for f in inspection.findings].count("no-stimuli") == 1
    assert inspection.verdict == "not usable"
    assert json.loads(json.dumps(inspection.to_dict(), allow_nan=False))["mean_spikes_per_stimulus"] is None


def test_no_spikes_is_a_dead_window() -> None:
    assert names(extract_responses(recording([], [1, 2, 3])))["dead-window"] == "refuse"


def test_stimuli_that_leave_no_quiet_are_said_to_be_untested() -> None:
    stimulus_s = np.arange(0, 2, 0.0125)
    answered = recording([(t + 0.005, 0) for t in stimulus_s], stimulus_s)
    assert names(extract_responses(answered))["window-not-tested"] == "note"
    # An empty window needs no comparison.
    assert names(extract_responses(recording([], stimulus_s)))["dead-window"] == "refuse"


def test_a_burst_in_the_only_quiet_there_is_makes_no_window_dead() -> None:
    # Before the first of many fast stimuli there is a fifth of a second of quiet, and a burst fills it.
    stimulus_s = np.arange(1, 9, 0.05)
    burst = [(t, 0) for t in np.arange(0.8, 0.98, 1e-3)]
    answered = recording([*burst, *((t + 0.005, 0) for t in stimulus_s)], stimulus_s)
    found = names(extract_responses(answered))
    assert found["window-not-tested"] == "note" and "dead-window" not in found


def test_a_response_in_a_single_moment_is_one() -> None:
    stimulus_s = np.arange(1, 9, 0.25)
    source = recording([(t + 0.006, 0) for t in stimulus_s], stimulus_s)
    assert not {"dead-window", "window-not-tested"} & set(names(extract_responses(source)))


def test_a_window_without_the_response_says_where_it_is() -> None:
    # Silence where the window is, as after an artefact.
    source = answering({5: 30.0, 10: 40.0}, window_s=(0.030, 0.070))
    heard = (source.spike_times_s % 0.25 > 0.012) | (source.spike_times_s < 1)
    spikes = np.column_stack([source.spike_times_s, source.spike_channels])[heard]
    blanked = recording(spikes, source.stimuli.time_s, 40, source.duration_s, frequency_hz=source.stimuli.frequency_hz)
    assert "the response is at 30 to 70 ms: use --window-ms 30 70" in message(blanked, "dead-window")
    assert not {"dead-window", "response-elsewhere"} & set(names(extract_responses(blanked, window_ms=(30, 70))))


def test_a_window_on_a_later_wave_is_warned_about_the_first() -> None:
    source = answering({5: 30.0, 10: 40.0}, window_s=(0.010, 0.030))
    wave = np.column_stack([np.repeat(source.stimuli.time_s, 10) + 0.085, np.zeros(10 * len(source.stimuli))])
    spikes = np.vstack([np.column_stack([source.spike_times_s, source.spike_channels]), wave])
    waves = recording(spikes, source.stimuli.time_s, 40, source.duration_s, frequency_hz=source.stimuli.frequency_hz)
    assert "the response is at 10 to 30 ms" in message(waves, "response-elsewhere", window_ms=(80, 90))


def test_an_artefact_in_the_window_is_no_response() -> None:
    source = answering({5: 0.0, 10: 0.0})
    artefact = [(t + 0.0025, 0) for t in source.stimuli.time_s for _ in range(20)]
    spikes = [*zip(source.spike_times_s.tolist(), source.spike_channels.tolist(), strict=True), *artefact]
    blanked = [(t, c) for t, c in spikes if not 0.003 <= (t % 0.25) < 0.010]
    with_artefact = recording(
        blanked, source.stimuli.time_s, 40, source.duration_s, frequency_hz=source.stimuli.frequency_hz
    )
    assert names(extract_responses(with_artefact))["dead-window"] == "refuse"


def test_stimuli_closer_than_the_window_are_counted() -> None:
    source = recording([], [1, 1.005, 2, 2.010, 3])
    found = {f.name: f for f in extract_responses(source).findings}["stimuli-too-close"]
    assert found.value == 1  # 10 ms apart is not closer than a window that ends at 10 ms
    assert "1 of 5 stimuli" in found.message
    assert "stimuli-too-close" not in names(extract_responses(source, window_ms=(2, 5)))


def test_windows_past_the_end_are_left_out_and_counted() -> None:
    responses = extract_responses(recording([], [1, 2, 9.995]))
    assert len(responses) == 2
    assert names(responses)["window-past-end"] == "warning"


class Nothing(Conditions):
    """A rule of one's own that no stimulus meets."""

    def __str__(self) -> str:
        return "mine"

    def assign(self, stimuli: Stimuli) -> Assignment:
        return ByPattern((7,)).assign(stimuli)


def test_stimuli_without_a_condition_are_counted() -> None:
    source = recording([], [1, 2, 3], pattern=[0, 0, 1])
    found = {f.name: f for f in extract_responses(source, ByPattern((0,))).findings}
    assert (found["no-condition"].severity, found["no-condition"].value) == ("note", 1)
    assert names(extract_responses(source, ByPattern((7,))))["no-condition"] == "refuse"
    none = message(source, "no-condition", by=ByPattern((7,)))
    there = "the recording has pattern 0, pattern 1: choose others (--conditions"
    assert f"none of 3 stimuli belongs to the conditions pattern:7; {there}" in none
    # What other kinds could be had is not a list of what the recording has.
    for by in (ByElectrode(), ByInterval((7.0,)), Nothing()):
        none = message(source, "no-condition", by=by)
        others = " or ".join(each for each in ("frequency", "interval:5,10", "electrode", "pattern") if each != str(by))
        assert f"none of 3 stimuli belongs to the conditions {by}: choose others (--conditions {others})" in none


def test_empty_and_thin_conditions() -> None:
    source = answering({5: 10.0, 10: 14.0})
    responses = extract_responses(source, ByFrequency((5, 10, 20)), burst_threshold=1)
    assert names(responses)["empty-condition"] == "refuse"
    assert "condition 20 Hz: no stimulus" in message(source, "empty-condition", by=ByFrequency((5, 20)))
    assert np.isnan(responses.shares_above_median()[2])
    thin = extract_responses(answering({5: 10.0, 10: 14.0}, n=29), burst_threshold=1)
    assert names(thin)["few-samples"] == "warning"
    one = message(answering({5: 10.0, 10: 14.0}, n=1), "few-samples", burst_threshold=1)
    assert one.endswith("1 non-burst response; a distribution needs 30 or more")
    assert "few-samples" not in names(extract_responses(answering({5: 10.0, 10: 14.0}, n=30), burst_threshold=1))
    # Frequencies that were computed from intervals may make a condition of each stimulus.
    many = extract_responses(answering({5 + i / 8: 10.0 for i in range(40)}, n=2), burst_threshold=1)
    (finding,) = [finding for finding in many.findings if finding.name == "few-samples"]
    assert finding.message.startswith(
        "40 of 40 conditions have fewer than 30 non-burst responses, as 5 Hz (2), 5.125 Hz"
    )
    assert finding.value == 2


def test_conditions_that_do_not_differ_are_said_to_give_no_control() -> None:
    same = answering({5: 20.0, 10: 20.0}, n=400, n_channels=60)
    assert names(extract_responses(same, burst_threshold=1))["no-difference"] == "warning"
    assert "no policy can steer" in message(same, "no-difference", burst_threshold=1)
    other = answering({5: 10.0, 10: 30.0}, n=400, n_channels=60)
    assert "P(x >= P50): 0.0" in message(other, "difference", burst_threshold=1)
    assert "one-condition" in names(extract_responses(same, All()))


@pytest.mark.parametrize(("above", "name"), [(46, "no-difference"), (42, "little-difference"), (38, "difference")])
def test_how_far_conditions_can_steer_is_said(above: int, name: str) -> None:
    """`above` and 100 - `above` of 100 responses above the median of all: the choice moves the mean command by both."""
    rates_hz = [20.0] * above + [10.0] * (100 - above) + [20.0] * (100 - above) + [10.0] * above
    responses = Responses(
        condition=np.repeat([0, 1], 100),
        rate_hz=np.array(rates_hz),
        active_ratio=np.zeros(200),
        is_burst=np.zeros(200, bool),
        conditions=(Condition("5 Hz", 5.0, "Hz"), Condition("10 Hz", 10.0, "Hz")),
        window_ms=(2.0, 10.0),
        n_channels=10,
        threshold=1.0,
        separability=0.5,
    )
    (found,) = _difference(responses)
    assert (found.name, found.severity) == (name, "note" if name == "difference" else "warning")
    assert f"0.{above} for 5 Hz, 0.{100 - above} for 10 Hz" in found.message
    assert f"from {above / 50 - 1:+.2f} to {1 - above / 50:+.2f}" in found.message
    assert ("a robot can hardly be steered" in found.message) == (name == "little-difference")


def test_burst_separation_that_separates_nothing_is_said_so() -> None:
    found = {f.name: f for f in extract_responses(answering({5: 20.0, 10: 20.0}, n=300)).findings}
    assert "bursts" not in found
    assert found["bursts-not-separable"].severity == "note"
    assert "no response is set apart as a burst" in found["bursts-not-separable"].message
    responses = extract_responses(answering({5: 20.0, 10: 20.0}, n=300))
    assert not responses.is_burst.any()
    assert responses.threshold == 1


def test_if_every_response_is_kept_no_separability_is_reported_and_no_panel_of_bursts_drawn() -> None:
    source = answering({5: 20.0, 10: 20.0}, n=300)
    for threshold, is_known in ((1.0, False), (None, True)):
        inspection = inspect_recording(source, burst_threshold=threshold)
        assert "bursts: none is set apart" in inspection_text(inspection)
        assert "separability 0.00" not in inspection_text(inspection)
        assert (inspection.to_dict()["burst_separability"] is not None) == is_known
        titles = [axes.get_title(loc="left") for axes in draw_burst_separation(inspection.responses).axes]
        assert titles[1:] == ["response against active channels", "no response is set apart as a burst"]


def test_stimuli_of_no_condition_are_drawn_and_nothing_is_fitted_to_them() -> None:
    source = answering({5: 20.0}, n=60)
    none = extract_responses(source, ByPattern())
    assert not none.conditions
    draw_raster(source, none)
    with pytest.raises(UnusableData, match="conditions: expected one or more to fit, got none"):
        fit_empirical(none)


def test_too_few_bursts_are_distinguished_from_none() -> None:
    # Of 103 stimuli three make every channel fire.
    spikes = [(t, c) for t in range(1, 104) for c in range(40) if t > 100 or c < 4]
    at = [(t + 0.005, c) for t, c in spikes]
    found = extract_responses(recording(at, list(range(1, 104)), 40, 105.0)).findings
    (said,) = (f.message for f in found if f.name == "bursts-not-separable")
    assert (
        "set apart as a burst, as one of two groups would have fewer than 5: Otsu's threshold" in said
        and "part 3 of 103" in said
    )


def test_many_clear_bursts_may_be_the_responses() -> None:
    # Half of all stimuli fail altogether, the others make most channels fire.
    found = names(extract_responses(answering({5: 0.0, 10: 60.0}, n=100)))
    assert found["many-bursts"] == "warning"


def test_organoid(real_data: Path) -> None:
    source = read_recording(real_data / "organoid_cartpole_maxone.npz")
    inspection = inspect_recording(source, ByInterval((5, 10)))
    text = inspection_text(inspection)
    assert "2,775 stimuli" in text
    assert "20.26 spikes in 2-10 ms per stimulus" in text
    assert inspection.verdict == "usable with care"
    found = {f.name: f for f in inspection.findings}
    # One hump of ratios: Otsu would drop more than half of the responses.
    assert inspection.n_bursts == 0
    assert found["bursts-not-separable"].value == pytest.approx(0.62, abs=0.01)
    assert "a robot can hardly be steered" in found["little-difference"].message
    assert inspection.response is not None
    assert (inspection.response.start_ms, inspection.response.end_ms) == pytest.approx((3, 18), abs=1)


def test_brainoware_is_refused_and_shown_the_way(real_data: Path) -> None:
    source = read_recording(real_data / "brainoware_spikes.csv.gz")
    inspection = inspect_recording(source)
    assert inspection.verdict == "not usable"
    assert inspection.findings[0].name == "dead-window"
    assert "the window from 2 to 10 ms is dead" in inspection.findings[0].message
    response = inspection.response
    assert response is not None
    assert 10 <= response.start_ms <= 20 and 400 <= response.end_ms <= 500
    assert f"--window-ms {response.start_ms:g} {response.end_ms:g}" in inspection.findings[0].message
    # No other finding names another window.
    assert sum("--window-ms" in finding.message for finding in inspection.findings) == 1
    there = inspect_recording(source, window_ms=(response.start_ms, response.end_ms))
    assert there.verdict != "not usable"


def test_to_dict_is_json_and_says_what_the_text_says() -> None:
    inspection = inspect_recording(SyntheticCulture(seed=2).record(0.0), name="culture.nwb")
    data = json.loads(json.dumps(inspection.to_dict(), allow_nan=False))
    text = inspection_text(inspection)
    assert text.startswith(f"culture.nwb: {data['verdict']}")
    assert f"{data['mean_spikes_per_stimulus']:.2f} spikes in 2-10 ms per stimulus" in text
    assert all(finding["message"] in text and "\n" not in finding["message"] for finding in data["findings"])
    assert all(condition["label"] in text for condition in data["conditions"])


UNITS = ("(s)", "(ms)", "(Hz per channel)", "(row)", "(count)", "(fraction)", "fraction")


def axes_of(figure):  # type: ignore[no-untyped-def]
    return [axes for axes in figure.axes if axes.get_visible()]


def test_figures_name_units_and_conditions() -> None:
    source = SyntheticCulture(seed=1).record(0.0)
    responses = extract_responses(source)
    labels = [condition.label for condition in responses.conditions]
    raster = draw_raster(source, responses)
    legend = [text.get_text() for text in raster.legends[0].get_texts()]
    assert legend == ["window 2-10 ms", "stimulus"]
    assert [text.get_text() for text in axes_of(raster)[1].get_yticklabels()] == labels
    histograms = draw_response_histograms(responses)
    titles = [axes.get_title(loc="left") for axes in axes_of(histograms)]
    assert [title.split(":")[0] for title in titles] == labels
    assert all(f"P(x ≥ P50) = {p:.2f}" in t for p, t in zip(responses.shares_above_median(), titles, strict=True))
    psth = draw_psth(post_stimulus_histogram(source), responses.window_ms, 0.5)
    assert "window 2-10 ms" in [text.get_text() for text in psth.axes[0].get_legend().get_texts()]
    panels = draw_burst_separation(responses)
    assert len(panels.axes) == 4
    for figure in (raster, psth, panels):
        for axes in axes_of(figure):
            assert axes.get_label() == "<colorbar>" or axes.get_xlabel().endswith(UNITS), axes.get_xlabel()
            assert axes.get_ylabel().endswith(UNITS), axes.get_ylabel()
    assert histograms.get_supxlabel().endswith(UNITS)


def test_titles_of_figures_say_one_in_the_singular() -> None:
    source = SyntheticCulture(seed=1, patterns=1, channels=1, frequencies_hz=(5.0,), means_hz=(30.0,)).record(0.0)
    responses = extract_responses(source)
    figures = (
        draw_raster(source, responses),
        draw_psth(post_stimulus_histogram(source), responses.window_ms),
        draw_burst_separation(responses),
        draw_array(source),
    )
    titles = [figure.get_suptitle() or figure.axes[0].get_title(loc="left") for figure in figures]
    assert titles == [
        "1 stimulus in the middle of the recording, each spike a dot",
        "1 stimulus, 1 channel, bins of 1 ms",
        "1 response",
        titles[3],
    ]
    assert titles[3].startswith("1 recording site at") and len(axes_of(figures[0])) == 2
    assert axes_of(figures[0])[1].get_title(loc="left") == "1 stimulus, one row each; each spike a dot"


def test_a_raster_of_many_spikes_shades_rates_and_names_only_conditions_with_rows() -> None:
    """Dots run into one if there are more than can be distinguished."""
    few = answering({5: 10.0, 10: 10.0})
    lower = axes_of(draw_raster(few, extract_responses(few)))[1]
    assert len(lower.images) == 0 and len(lower.collections) == 1
    many = SyntheticCulture(seed=1).record(0.0)
    responses = extract_responses(many)
    lower = axes_of(draw_raster(many, responses))[1]
    (image,) = lower.images
    rows = image.get_array()
    # The rate of a row within the window is its response, as it is read: the window is whole bins.
    assert rows.shape == (300, 70)
    chosen = np.linspace(0, len(responses) - 1, 300).round().astype(int)
    chosen = chosen[np.argsort(responses.condition[chosen], kind="stable")]
    np.testing.assert_allclose(rows[:, 22:30].mean(axis=1), responses.rate_hz[chosen], atol=0.5)
    assert [text.get_text() for text in lower.get_yticklabels()] == [c.label for c in responses.conditions]
    without = replace(responses, condition=np.where(responses.condition == 2, 1, responses.condition))
    lower = axes_of(draw_raster(many, without))[1]
    assert [text.get_text() for text in lower.get_yticklabels()] == ["5 Hz", "10 Hz", "40 Hz", "80 Hz"]


def test_spikes_on_a_sampling_grid_fall_into_one_bin_each() -> None:
    """Every spike is 25 ms after a pulse, both in whole samples: it belongs into the bin that begins there."""
    samples = 500 * np.arange(1, 400)
    spikes = [(sample / 20_000, channel) for sample in samples[1:] for channel in range(12)]
    source = recording(spikes, samples[:-1] / 20_000, 12, 20.0, frequency_hz=np.full(len(samples) - 1, 40.0))
    edges_ms, count = (of := post_stimulus_histogram(source)).edges_ms, of.count
    assert set(edges_ms[:-1][count > 0].round(6)) == {0.0, 25.0}
    assert count[edges_ms[:-1].round(6) == 25].sum() == 12 * 398
    upper, lower = axes_of(draw_raster(source, extract_responses(source, burst_threshold=1)))[:2]
    (image,) = lower.images
    assert set(np.flatnonzero(image.get_array().any(axis=0))) == {20, 45}
    # Channels are counted.
    assert all(tick == round(tick) for tick in upper.get_yticks())


def test_an_artefact_does_not_dwarf_the_response_in_the_figure() -> None:
    source = answering({5: 10.0, 10: 10.0})
    artefact = [(t + 0.0005, 0) for t in source.stimuli.time_s for _ in range(200)]
    spikes = [*zip(source.spike_times_s.tolist(), source.spike_channels.tolist(), strict=True), *artefact]
    histogram = post_stimulus_histogram(recording(spikes, source.stimuli.time_s, 40, source.duration_s))
    axes = draw_psth(histogram, (2, 10)).axes[0]
    assert axes.get_ylim()[1] < histogram.rate_hz.max() / 2
    assert "is cut off" in axes.get_title(loc="left")


def test_bins_hold_equally_many_possible_rates() -> None:
    responses = extract_responses(answering({5: 10.0, 10: 30.0}))
    edges_hz = rate_edges(responses, responses.rate_hz, 12)
    step_hz = 1 / (0.008 * 40)
    inside = [np.count_nonzero((k * step_hz >= edges_hz[:-1]) & (k * step_hz < edges_hz[1:])) for k in range(60)]
    per_bin = np.histogram(np.arange(round(edges_hz[-1] / step_hz + 0.5)) * step_hz, edges_hz)[0]
    assert len(per_bin) <= 12
    assert len(set(per_bin.tolist())) == 1
    assert set(inside) <= {0, 1}
    assert np.histogram(responses.rate_hz, edges_hz)[0].sum() == len(responses)


def test_many_conditions_have_a_colour_each_and_at_most_16_panels() -> None:
    n = 40
    source = recording([(t + 0.005, 0) for t in range(1, n + 1)], np.arange(1, n + 1), 4, n + 2, pattern=list(range(n)))
    responses = extract_responses(source, ByPattern())
    assert len(set(condition_colours([c.unit for c in responses.conditions]))) == n
    figure = draw_response_histograms(responses)
    assert len(axes_of(figure)) == 16
    assert "24 more are not drawn" in figure.get_suptitle()
    draw_raster(source, responses)


@pytest.mark.oracle
@pytest.mark.parametrize("file_format", ["png", "svg", "pdf"])
def test_figures_are_written_whole_and_the_same_each_time(tmp_path: Path, file_format: str) -> None:
    source = answering({5: 10.0, 10: 30.0}, n=20, n_channels=16)
    inspection = inspect_recording(source, name="a/b/culture.csv.gz")
    files = draw_inspection(source, inspection, tmp_path / "figures", file_format)
    assert [file.name for file in files] == [
        f"culture-{what}.{file_format}" for what in ("raster", "psth", "burst-separation", "responses")
    ]
    first = [file.read_bytes() for file in files]
    draw_inspection(source, inspection, tmp_path / "figures", file_format)
    assert [file.read_bytes() for file in files] == first
    assert len(list((tmp_path / "figures").iterdir())) == 4


def test_a_response_far_above_all_others_does_not_squeeze_them_and_is_counted() -> None:
    responses = extract_responses(answering({5: 10.0, 10: 14.0}), burst_threshold=1.0)
    assert draw_response_histograms(responses).get_suptitle() == ""
    rate_hz = np.where(np.arange(len(responses)) == 3, 50 * responses.rate_hz.max(), responses.rate_hz)
    figure = draw_response_histograms(replace(responses, rate_hz=rate_hz))
    assert f"1 of {len(responses):,} responses are larger than " in figure.get_suptitle()
    assert axes_of(figure)[0].get_xlim()[1] < 3 * responses.rate_hz.max()


def test_another_ending_is_refused(tmp_path: Path) -> None:
    figure = draw_response_histograms(extract_responses(answering({5: 10.0})))
    with pytest.raises(InvalidArgument, match="expected a figure's name to end in"):
        save_figure(figure, tmp_path / "figure.xyz")


@pytest.mark.oracle
def test_the_users_settings_of_matplotlib_do_not_change_a_commands_figures(tmp_path: Path) -> None:
    (tmp_path / "matplotlib").mkdir()
    (tmp_path / "matplotlib/matplotlibrc").write_text("text.usetex: True\nlines.linewidth: 9\nfont.size: 30\n")
    np.savez(tmp_path / "a.npz", spike_time_s=[0.5, 2.5], spike_channel=[0, 1], stimulus_time_s=[])
    command = [sys.executable, "-m", "animat", "inspect", "a.npz", "--out"]
    for out, settings in (("with", {"XDG_CONFIG_HOME": str(tmp_path), "MPLBACKEND": "Qt4Agg"}), ("without", {})):
        done = subprocess.run([*command, out], cwd=tmp_path, env=os.environ | settings, capture_output=True, text=True)
        assert done.returncode == 1 and "no-stimuli" in done.stdout, done.stderr
    figures = [(tmp_path / out / "a-raster.png").read_bytes() for out in ("with", "without")]
    assert figures[0] == figures[1]


def test_a_recording_without_stimuli_can_be_drawn(tmp_path: Path) -> None:
    source = recording([(1.0, 0)], [])
    assert [f.name for f in draw_inspection(source, inspect_recording(source, name="x.nwb"), tmp_path)] == [
        "x-raster.png"
    ]
    assert "not usable" in inspection_text(inspect_recording(source))


@pytest.mark.parametrize("is_row", [True, False])
def test_sites_in_a_row_or_a_column_have_room_in_the_figure_of_the_array(is_row: bool) -> None:
    source = synthetic_recording(1, patterns=5, channels=32)
    along_um, nothing = 17.5 * np.arange(32), np.zeros(32)
    x_um, y_um = (along_um, nothing) if is_row else (nothing, along_um)
    figure = draw_array(replace(source, channels=replace(source.channels, x_um=x_um, y_um=y_um)))
    axes = figure.axes[0]
    # A twentieth of the length on each side of the row.
    thin = axes.get_ylim() if is_row else axes.get_xlim()
    assert np.ptp(thin) == pytest.approx(along_um[-1] / 10)
