"""Importance: how much each setting of a search had to do with what was got."""

from __future__ import annotations

from collections.abc import Mapping

from animat.report.style import BLUE, Figure, new_figure, style_axes


def draw_importance(shares: Mapping[str, float], title: str) -> Figure:
    """A bar a setting, by the shares of settings, which come the largest first and together are 1."""
    figure = new_figure(6.0, 1.1 + 0.27 * len(shares))
    axes = figure.subplots()
    places = range(0, -len(shares), -1)
    percent = [100 * share for share in shares.values()]
    axes.barh(places, percent, height=0.65, color=BLUE)
    for place, share in zip(places, percent, strict=True):
        axes.annotate(f"{share:.0f}", (share, place), (3, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(places, list(shares))
    axes.set_xlim(0, max(1.0, 1.1 * max(percent)))
    style_axes(axes, title, "importance (%)", "")
    return figure
