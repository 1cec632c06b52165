"""Inspections as text for a terminal, and as a folder of figures: of each recording, and of the series."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from animat.errors import InvalidArgument, Mismatch, counted
from animat.lazy import Figure
from animat.recordings.findings import Finding
from animat.recordings.recording import Recording, ResponseTable
from animat.report.array import draw_array
from animat.report.drift import draw_drift
from animat.report.response_histograms import draw_burst_separation, draw_response_histograms, draw_responses_over_time
from animat.report.spikes import draw_psth, draw_raster, draw_spontaneous
from animat.report.style import save_figure
from animat.responses.bursts import BIN_S, NetworkBursts
from animat.responses.inspection import Inspection
from animat.responses.psth import PostStimulusHistogram, post_stimulus_histogram
from animat.responses.responses import Responses
from animat.terminal_table import align_columns

_MOST_CONDITIONS = 16


def inspection_text(inspection: Inspection) -> str:
    """Lines for a terminal: the verdict, the recording's contents, its responses, the conditions, and the findings."""
    responses = inspection.responses
    start_ms, end_ms = responses.window_ms
    spikes = "rates" if inspection.n_spikes is None else counted(inspection.n_spikes, "spike")
    duration_s = inspection.duration_s
    span = f" in {duration_s:,.1f} s ({duration_s / 60:.1f} min)" if math.isfinite(duration_s) else ""
    start = f"from {responses.start_min:g} min on the culture's clock"
    lines = [
        f"{inspection.name}: {inspection.verdict}",
        f"  {spikes} on {counted(responses.n_channels, 'channel')}{span}, {start}",
        f"  {counted(inspection.n_stimuli, 'stimulus', 'stimuli')}"
        + (f" in {counted(inspection.n_trials, 'trial')}" if inspection.n_trials != inspection.n_stimuli else "")
        + (f", {responses.presentation}" if responses.presentation else ""),
    ]
    if inspection.network_bursts is not None:
        lines += _spontaneous(inspection, inspection.network_bursts)
    if math.isfinite(inspection.mean_spikes_per_stimulus):
        quiet_hz = inspection.spontaneous_rate_hz
        quiet = f"; {quiet_hz:.3g} Hz per channel without stimuli" if math.isfinite(quiet_hz) else ""
        per_stimulus = f"{inspection.mean_spikes_per_stimulus:.2f} spikes in {start_ms:g}-{end_ms:g} ms per stimulus"
        lines.append(f"  {per_stimulus}{quiet}")
    if len(responses):
        lines.append(
            f"  bursts: {inspection.n_bursts:,} of {len(responses):,} responses, above {responses.threshold:.3f} of "
            f"the channels active (separability {responses.separability:.2f})"
            if inspection.n_bursts
            else "  bursts: none is set apart"
        )
        lines += ["", *_table(inspection)]
    if inspection.findings:
        lines += ["", *finding_lines(inspection.findings)]
    return "\n".join(lines)


def finding_lines(findings: Sequence[Finding]) -> list[str]:
    """A line for each finding: its severity, its name and what was found."""
    return [f"  {finding.severity:<7}  {finding.name}: {finding.message}" for finding in findings]


def _spontaneous(inspection: Inspection, bursts: NetworkBursts) -> list[str]:
    lines = [f"  {inspection.spontaneous_rate_hz:.3g} Hz per channel"] if inspection.duration_s else []
    if len(bursts):
        per_min = 60 * len(bursts) / inspection.duration_s
        lines.append(
            f"  {counted(len(bursts), 'network burst')} ({per_min:.3g} per minute) of {bursts.median_s:.2f} s (median) "
            f"{'contains' if len(bursts) == 1 else 'contain'} {100 * bursts.share:.0f} % of all spikes"
        )
    elif inspection.n_spikes:
        lines.append("  no network bursts")
    if (bin_s := float(bursts.edges_s[1] - bursts.edges_s[0])) > 1.01 * BIN_S:
        lines[-1] += f"; detected in bins of {bin_s:.3g} s, as the recording is long"
    return lines


def draw_inspection(
    recording: Recording | ResponseTable,
    inspection: Inspection,
    folder: str | os.PathLike[str],
    file_format: str = "png",
) -> list[Path]:
    """Draw raster, post-stimulus histogram, burst separation and response histograms into a folder.

    Files are named after the inspection; `file_format` is one of `FORMATS`. For a recording without stimuli only a
    raster with its bursts is drawn, for a response table neither raster nor post-stimulus histogram.
    """
    responses, figures = inspection.responses, {}
    if isinstance(recording, Recording):
        bursts = inspection.network_bursts
        figures["raster"] = draw_raster(recording, responses) if bursts is None else draw_spontaneous(recording, bursts)
        if inspection.n_trials:
            histogram = _histogram(recording, inspection)
            figures["psth"] = draw_psth(histogram, responses.window_ms, inspection.spontaneous_rate_hz)
    if len(responses):
        figures["burst-separation"] = draw_burst_separation(responses)
        figures["responses"] = draw_response_histograms(responses)
    return _save(figures, folder, figure_stem(inspection.name), file_format)


def draw_series(
    first: Recording | None, series: Sequence[Responses], folder: str | os.PathLike[str], file_format: str = "png"
) -> list[Path]:
    """Draw a series: `series-array`, `series-over-time`, `series-drift`; `file_format` is one of `FORMATS`.

    The array is drawn if the positions of the first recording are known, the other figures for two recordings or more.
    `series` may be in any order. InvalidArgument for no responses, Mismatch for recordings with different conditions.
    """
    if not series:
        raise InvalidArgument("series: expected the responses of at least one recording, got none")
    ordered = sorted(series, key=lambda responses: responses.start_min)
    for responses in ordered[1:]:
        if [c.label for c in responses.conditions] != [c.label for c in ordered[0].conditions]:
            raise Mismatch(
                f"conditions: expected the same in all recordings of a series, but those at {responses.start_min:g} "
                f"min differ from those at {ordered[0].start_min:g} min: inspect them separately"
            )
    figures = {}
    if first is not None and first.channels.has_positions:
        figures["array"] = draw_array(first)
    if len(ordered) > 1 and all(len(responses) for responses in ordered):
        figures["over-time"] = draw_responses_over_time(ordered)
        figures["drift"] = draw_drift(ordered)
    return _save(figures, folder, "series", file_format)


def _save(figures: Mapping[str, Figure], folder: str | os.PathLike[str], stem: str, file_format: str) -> list[Path]:
    return [save_figure(figure, Path(folder) / f"{stem}-{what}.{file_format}") for what, figure in figures.items()]


def figure_stem(name: str) -> str:
    """How the names of a recording's figures begin: with its file's name without suffix."""
    return Path(name).name.removesuffix(".gz").rsplit(".", 1)[0]


def expect_unique_stems(names: Sequence[str], *others: str) -> None:
    """Raise InvalidArgument if figures of several recordings, or one of `others`, would have the same name."""
    stems = [*others, *map(figure_stem, names)]
    for stem in stems:
        if stems.count(stem) > 1:
            raise InvalidArgument(
                f"--out: expected recordings with different names, got figures that would all be called {stem}-...; "
                "pass them separately, or rename one"
            )


def _histogram(recording: Recording, inspection: Inspection) -> PostStimulusHistogram:
    """A histogram that includes the window, and also the response if that comes later."""
    end_ms, response = inspection.responses.window_ms[1], inspection.response
    if response is not None and response.start_ms >= end_ms:
        end_ms = response.end_ms
    to_ms = max(50.0, min(2 * end_ms, end_ms + 100))
    return post_stimulus_histogram(recording, -0.4 * to_ms, to_ms, 1.0 if to_ms <= 100 else 5.0)


def _table(inspection: Inspection) -> list[str]:
    cells = []
    for c in inspection.conditions[:_MOST_CONDITIONS]:
        median, share = (f"{c.median_rate_hz:.2f}", f"{c.share_above_median:.2f}") if c.n_non_burst else ("-", "-")
        cells.append([c.label, f"{c.n_responses:,}", f"{c.n_non_burst:,}", median, share])
    chosen = " (chosen by default)" if inspection.by_default else ""
    head = ["condition", "responses", "non-burst", "median x (Hz)", "P(x >= P50)"]
    lines = [f"  conditions: {inspection.responses.by}{chosen}", *align_columns(head, cells)]
    more = len(inspection.conditions) - len(cells)
    return [*lines, f"  ... and {more} more"] if more else lines
