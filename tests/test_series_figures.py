"""The figures of a series: marks are counted and numbers read back from the axes."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex

from animat.errors import InvalidArgument, Mismatch
from animat.recordings.recording import Recording
from animat.report.array import draw_array, draw_selection
from animat.report.colours import MEDIAN, condition_colours
from animat.report.drift import draw_drift
from animat.report.inspection import draw_series
from animat.report.response_histograms import draw_response_histograms, draw_responses_over_time
from animat.responses.conditions import conditions_named
from animat.responses.extraction import extract_responses
from animat.responses.responses import Responses
from animat.stimulation.array import MAXONE
from animat.stimulation.selection import Selection
from animat.stimulation.stimulus import Stimuli
from synthetic_recordings import synthetic_recording


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return [synthetic_recording(1, start_min=m, patterns=40, channels=64) for m in (0.0, 30.0, 60.0)]


@pytest.fixture(scope="module")
def series(recordings: list[Recording]) -> list[Responses]:
    return [extract_responses(recording) for recording in recordings]


@pytest.mark.oracle
def test_a_series_has_its_figures(recordings: list[Recording], series: list[Responses], tmp_path: Path) -> None:
    files = draw_series(recordings[0], series[::-1], tmp_path / "figures", "svg")
    assert [file.name for file in files] == ["series-array.svg", "series-over-time.svg", "series-drift.svg"]
    assert [file.name for file in draw_series(recordings[0], series[:1], tmp_path)] == ["series-array.png"]
    nowhere = replace(recordings[0].channels, x_um=np.full(64, np.nan))
    assert draw_series(replace(recordings[0], channels=nowhere), series[:1], tmp_path) == []
    with pytest.raises(InvalidArgument, match="at least one recording"):
        draw_series(recordings[0], [], tmp_path)
    others = extract_responses(recordings[1], conditions_named("pattern"))
    with pytest.raises(Mismatch, match="at 30 min differ from those at 0 min"):
        draw_series(recordings[0], [series[0], others], tmp_path)


def test_the_array_shows_every_site_and_counts_what_it_cannot_place(recordings: list[Recording]) -> None:
    axes = draw_array(recordings[0]).axes[0]
    assert len(axes.collections[0].get_offsets()) == 64
    # Synthetic cultures stimulate electrodes that no channel reads.
    assert len(axes.collections) == 1
    assert "32 stimulated electrodes that no channel reads are not drawn" in axes.figure.get_suptitle()
    bar = axes.figure.axes[1]
    assert bar.get_ylabel() == "firing rate, stimulated time included (Hz)"
    stimuli = recordings[0].stimuli
    none = Stimuli(*(getattr(stimuli, each.name)[:0] for each in fields(stimuli)))
    unstimulated = replace(recordings[0], stimuli=none)
    assert draw_array(unstimulated).axes[1].get_ylabel() == "firing rate (Hz)"
    unknown = recordings[0].channels.x_um.copy()
    unknown[:3] = np.nan
    some = draw_array(replace(recordings[0], channels=replace(recordings[0].channels, x_um=unknown))).axes[0]
    assert len(some.collections[0].get_offsets()) == 61
    assert "3 channels at unknown positions" in some.figure.get_suptitle()


@pytest.mark.parametrize(("width_um", "height_um"), [(3800, 2100), (1200, 1800), (700, 2100), (0, 0)])
def test_the_arrays_title_is_whole_and_little_of_the_figure_is_empty(
    recordings: list[Recording], width_um: float, height_um: float
) -> None:
    rng = np.random.default_rng(0)
    channels = replace(recordings[0].channels, x_um=width_um * rng.random(64), y_um=height_um * rng.random(64))
    figure = draw_array(replace(recordings[0], channels=channels))
    figure.canvas.draw()
    whole = figure.bbox
    title = figure._suptitle.get_window_extent()
    assert title.x0 >= whole.x0 and title.x1 <= whole.x1
    assert title.y1 <= whole.y1
    if width_um:
        drawn = figure.axes[0].get_tightbbox().width + figure.axes[1].get_tightbbox().width
        assert drawn > 0.45 * whole.width


def test_a_selection_shows_its_sites_with_their_numbers() -> None:
    selection = Selection(MAXONE, np.arange(0, 20_000, 200), np.array([200, 4000, 8000]), np.array([[200, 8000]]))
    axes = draw_selection(selection).axes[0]
    assert [len(drawn.get_offsets()) for drawn in axes.collections] == [100, 3, 2]
    assert [text.get_text() for text in axes.texts] == ["200", "4000", "8000"]
    np.testing.assert_allclose(axes.collections[2].get_offsets(), np.column_stack(MAXONE.position_um([200, 8000])))


def test_the_drift_is_the_percentiles(series: list[Responses]) -> None:
    upper, middle, lower = draw_drift(series).axes
    medians = [np.median(r.rate_hz[~r.is_burst]) for r in series]
    np.testing.assert_allclose(upper.lines[0].get_xydata(), np.column_stack([[0, 30, 60], medians]))
    for i, line in enumerate(middle.lines[:5]):
        np.testing.assert_allclose(line.get_ydata(), [r.shares_above_median()[i] for r in series])
    np.testing.assert_allclose(lower.lines[0].get_ydata(), [r.is_burst.mean() for r in series])
    # A share of 0 or 1 is a whole dot.
    assert not any(line.get_clip_on() for line in (*middle.lines[:5], lower.lines[0]))


def test_responses_over_time_mark_each_median(series: list[Responses]) -> None:
    panels = draw_responses_over_time(series).axes
    assert [axes.get_title(loc="left") for axes in panels] == [c.label for c in series[0].conditions]
    for i, axes in enumerate(panels):
        marks = [line.get_xdata()[0] for line in axes.lines if to_hex(line.get_color()) == MEDIAN.lower()]
        np.testing.assert_allclose(marks, [np.median(r.rates_of(i)) for r in series])
    assert [text.get_text() for text in panels[0].get_yticklabels()] == ["0", "30", "60"]
    many = [replace(series[0], start_min=float(m)) for m in range(50)]
    assert draw_responses_over_time(many).get_suptitle() == "20 of 50 recordings"


@pytest.mark.oracle
@pytest.mark.parametrize("draw", [draw_response_histograms, lambda each: draw_responses_over_time([each] * 2)])
def test_titles_of_many_electrodes_are_whole_and_do_not_overlap(draw: Any) -> None:
    labels = conditions_named("electrode")
    figure = draw(extract_responses(synthetic_recording(1, patterns=20, channels=64), labels))
    figure.draw_without_rendering()
    titles = [axes.title if axes.title.get_text() else axes._left_title for axes in figure.axes if axes.get_visible()]  # type: ignore[attr-defined]
    assert all("electrodes" in title.get_text() for title in titles)
    boxes = [title.get_window_extent() for title in titles]
    assert not any(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])
    assert max(box.x1 for box in boxes) <= figure.bbox.x1


def test_the_drawn_conditions_of_a_drift_have_all_of_the_colours() -> None:
    responses = extract_responses(synthetic_recording(1, patterns=60, channels=64), conditions_named("pattern"))
    assert len(responses.conditions) == 60
    colours = [to_hex(line.get_color()) for line in draw_drift([responses] * 2).axes[1].lines[:12]]
    assert colours == condition_colours([""] * 12)


def test_a_few_bursts_that_were_kept_do_not_squeeze_the_other_responses(series: list[Responses]) -> None:
    rates = series[1].rate_hz.copy()
    rates[:3] = 50 * rates.max()
    kept = replace(series[1], rate_hz=rates, is_burst=series[1].is_burst & (np.arange(len(rates)) >= 3))
    figure = draw_responses_over_time([series[0], kept, series[2]])
    n = sum(len(r.non_burst_rate_hz) for r in (series[0], kept, series[2]))
    assert figure.get_suptitle().startswith(f"3 of {n:,} responses are larger than ")
    without = draw_responses_over_time(series)
    assert without.get_suptitle() == ""
    reach_hz, before_hz = (each.axes[0].get_xlim()[1] for each in (figure, without))
    assert reach_hz < 1.6 * before_hz
    # Shares are of all responses, those beyond too.
    drawn, *_ = figure.axes[0].patches[1].get_data()
    assert np.count_nonzero(drawn) > 3


def test_the_last_recording_is_an_outline_that_holds_every_response(series: list[Responses]) -> None:
    panels = draw_response_histograms(series[0], series[-1]).axes
    assert len(panels) == 5
    for i, panel in enumerate(panels):
        outline, edges_hz, _ = panel.patches[-1].get_data()
        assert outline.sum() == pytest.approx(1.0)
        x = series[-1].rates_of(i)
        np.testing.assert_allclose(outline, [np.mean((low <= x) & (x < high)) for low, high in pairwise(edges_hz)])
        assert sum(bar.get_height() for bar in panel.patches[:-1]) == pytest.approx(1.0)
        assert [line.get_xdata()[0] for line in panel.lines] == [r.median_rate_hz for r in (series[0], series[-1])]
    assert "P50 at 60 min" in panels[0].get_legend().get_texts()[1].get_text()
