"""A validation as text for a terminal and as a figure: calibration, autocorrelation and runs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.lazy import Figure
from animat.neurons.prediction import LAGS
from animat.neurons.validation import FREE_RUNS, MARGINAL, PIT_BINS, Band, Validation, pit_shares
from animat.report.colours import BLACK, BLUE, GREEN, GREY, ORANGE
from animat.report.style import add_common_legend, new_figure, style_axes
from animat.terminal_table import align_columns

COLUMNS = """\
marginal: all conditions pooled; recorded: the held-out responses themselves
bits/trial: log-likelihood of the commands of nine thresholds, more is better; CRPS: of the responses, less is better
off by: the largest error of the predicted distribution, 0 to 1; p: the probability of so large an error by chance
lag 1: the correlation of successive responses; run length: of runs at or above the median, in trials (middle 95 %)
a simulator's lag 1 and run length are those of free runs, in which it draws all responses itself"""
"""What the rows and columns of `validation_text` are."""

_COLOURS = {MARGINAL: GREY, "histogram": ORANGE, "empirical": GREEN, "memory": BLUE}


def validation_text(name: str, validation: Validation) -> str:
    """Lines for a terminal: the verdict, the predictions and the recording."""
    v = validation
    lines = [
        f"{name}: {v.verdict}",
        f"  fitted to {sum(v.n_fitted):,} responses of the first half, scored on {sum(v.n_held):,} of the second"
        + ("" if np.isnan(v.drift) else f"; medians moved by {100 * v.drift:+z.0f} %"),
        "",
    ]
    cells = []
    for s in v.scores:
        off, runs = f"{s.distance:.3f}" + ("" if s.p_value is None else f" ({s.p_value:.3f})"), s.run_length
        length = f"{runs.mean:.2f} ({runs.low:.2f} to {runs.high:.2f})"
        means = f"{s.bits.mean():.3f}", f"{s.crps_hz.mean():.3f}"
        cells.append([s.kind, *means, off, f"{s.autocorrelation.mean[0]:.2f}", length])
    cells.append(["recorded", "", "", "", f"{v.autocorrelation[0]:.2f}", f"{v.run_length:.2f}"])
    lines += align_columns(["simulator", "bits/trial", "CRPS (Hz)", "off by (p)", "lag 1", "run length"], cells)
    gains = [("conditions bring", v.gain("empirical", MARGINAL)), ("memory brings", v.gain("memory", "empirical"))]
    lines.append("  " + "; ".join(f"{of} {gain.value:.3f} +- {gain.error:.3f} bits per trial" for of, gain in gains))
    cells = []
    for c, label in enumerate(v.labels):
        n, medians = f"{v.n_fitted[c]:,}, {v.n_held[c]:,}", f"{v.medians_hz[0, c]:.2f}, {v.medians_hz[1, c]:.2f}"
        cells.append([label, n, medians, f"{v.of(v.kind).above[c]:.2f}, {v.above[c]:.2f}"])
    head = ["condition", "responses", "median x (Hz)", f"P(x >= P50) {v.kind}, recorded"]
    return "\n".join([*lines, "", *align_columns(head, cells)])


def correlations_text(names: Sequence[str], correlations: Float64[np.ndarray, "2 pairs"]) -> str:
    """Spearman's correlation of each pair of readouts, in the half to which simulators are fitted and the other one."""
    lines = ["  readouts, Spearman's correlation within conditions: first half, second half"]
    for (one, other), (first, second) in zip(itertools.combinations(names, 2), correlations.T, strict=True):
        lines.append(f"  {one}, {other}: {first:.2f}, {second:.2f}")
    return "\n".join(lines)


def draw_validation(name: str, validation: Validation) -> Figure:
    """Three panels: histograms of the transforms, the autocorrelation, and the lengths of runs above P50."""
    v = validation
    shaded = f"shaded: 95 % of chance, and of {FREE_RUNS} free runs of the simulators"
    figure = new_figure(10.5, 3.7, f"{name}: {sum(v.n_held):,} held-out responses; {shaded}")
    calibration, correlation, runs = figure.subplots(1, 3)
    # The empirical kind would coincide with the histogram.
    shown = [v.of(kind) for kind in dict.fromkeys(("histogram", v.kind, "memory"))]

    style_axes(calibration, "calibration", "probability integral transform (-)", "share of responses (-)")
    low, high = v.pit_band
    calibration.axhspan(low, high, color="#DDDDDD", label="uniform", linewidth=0)
    edges = np.linspace(0, 1, PIT_BINS + 1)
    for s in (v.of(MARGINAL), *shown):
        # Without lines down to 0, which would pass for data.
        style: Any = {"baseline": None, "color": _COLOURS[s.kind], "linewidth": 1.6}
        label = "histogram (and empirical)" if s.kind == "histogram" else s.kind
        calibration.stairs(pit_shares(s.transforms), edges, label=label, **style)
    calibration.set_ylim(bottom=0)

    lags = np.arange(1, LAGS + 1)
    style_axes(correlation, "successive responses", "lag (trials)", "autocorrelation (-)")
    style_axes(runs, "runs of x ≥ P50 (command above 0)", "run length (trials)", "share at least as long (-)")
    for axes, of in ((correlation, "autocorrelation"), (runs, "lasting")):
        for s in shown:
            band: Band = getattr(s, of)
            axes.fill_between(lags, band.low, band.high, color=_COLOURS[s.kind], alpha=0.2, linewidth=0)
            axes.plot(lags, band.mean, color=_COLOURS[s.kind], linewidth=1.2)
        recorded = getattr(v, of)
        # A share of 0 cannot be drawn on a logarithmic axis.
        recorded = np.where(recorded > 0, recorded, np.nan) if of == "lasting" else recorded
        axes.plot(lags, recorded, "o-", color=BLACK, markersize=4, linewidth=1.2, label="recorded")
        axes.set_xticks(lags)
    correlation.axhline(0, color=GREY, linewidth=0.6)
    runs.set_yscale("log")
    if len(positive := v.lasting[v.lasting > 0]):
        runs.set_ylim(positive.min() / 3, 1.2)
    runs.yaxis.set_major_formatter("{x:g}")
    add_common_legend(figure, [calibration, correlation], columns=6)
    return figure
