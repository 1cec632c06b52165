"""The responses from recording to recording: fatigue shows as a shift of each condition's distribution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from animat.report.response_histograms import rate_edges
from animat.report.style import MEDIAN, Figure, condition_colours, new_figure, style_axes, wrapped
from animat.responses.responses import Responses
from animat.tables import evenly

_BINS = 24
_MOST_ROWS = 20
_MOST_CONDITIONS = 8


def draw_responses_over_time(series: Sequence[Responses]) -> Figure:
    """One column per condition, one row per recording, the first at the top: non-burst responses and their median.

    At most 20 recordings, evenly over the series, and 8 conditions are drawn, up to 1.5 times the 99th percentile of
    all responses; the title states what is left out. Recordings are in order of time and have the same conditions.
    """
    shown = [series[row] for row in evenly(len(series), _MOST_ROWS)]
    conditions = shown[0].conditions[:_MOST_CONDITIONS]
    rates = [[responses.rates_of(i) for responses in shown] for i in range(len(conditions))]
    all_hz = np.concatenate([x for of in rates for x in of])
    # A few bursts that were not separated must not squeeze all others into one bin.
    reach_hz = 1.5 * float(np.quantile(all_hz, 0.99)) if len(all_hz) else 0.0
    edges_hz = rate_edges(shown[0], all_hz[all_hz <= reach_hz], _BINS)
    beyond = int(np.count_nonzero(all_hz > edges_hz[-1]))
    columns = len(conditions) if len(conditions) <= 5 else 4
    down = -(-len(conditions) // columns)
    wide_in = 2.2 if columns <= 4 else 1.9
    titles = [wrapped(condition.label, wide_in) for condition in conditions]
    more_lines = max([title.count("\n") for title in titles], default=0)
    figure = new_figure(1.0 + wide_in * columns, 0.6 + down * (0.7 + 0.17 * more_lines + 0.3 * len(shown)))
    panels = figure.subplots(down, columns, sharex=True, squeeze=False).reshape(-1)
    colours = condition_colours([condition.unit for condition in shown[0].conditions])
    for i, (axes, title, of) in enumerate(zip(panels, titles, rates, strict=False)):
        shares = [np.histogram(x, edges_hz)[0] / max(len(x), 1) for x in of]
        # All recordings of a condition have the same scale.
        height = 0.92 / max(max(share.max() for share in shares), 1e-9)
        for row, (share, x) in enumerate(zip(shares, of, strict=True)):
            base = -float(row)
            axes.stairs(base + height * share, edges_hz, baseline=base, fill=True, color=colours[i])
            if len(x):
                axes.plot([np.median(x)] * 2, [base, base + 0.92], color=MEDIAN, linewidth=1.6)
        at = [f"{responses.start_min:g}" for responses in shown]
        axes.set_yticks([-float(row) for row in range(len(shown))], at if i % columns == 0 else [""] * len(at))
        axes.set_xlim(0, edges_hz[-1])
        axes.set_ylim(-len(shown) + 0.9, 1.0)
        axes.tick_params(labelbottom=True)
        style_axes(axes, title, "", "start (min)" if i % columns == 0 else "")
    for axes in panels[len(conditions) :]:
        axes.set_visible(False)
    left_out = []
    if len(shown) < len(series):
        left_out.append(f"{len(shown)} of {len(series)} recordings")
    if len(conditions) < len(shown[0].conditions):
        left_out.append(f"{len(conditions)} of {len(shown[0].conditions)} conditions")
    if beyond:
        left_out.append(f"{beyond:,} of {len(all_hz):,} responses are larger than {edges_hz[-1]:.3g} Hz and not drawn")
    if left_out:
        figure.suptitle(", ".join(left_out), fontsize=10)
    figure.supxlabel("response x (Hz per channel)", fontsize=9)
    return figure
