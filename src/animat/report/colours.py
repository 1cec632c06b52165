"""The colours of all figures: Okabe and Ito's, which people with any common colour blindness can tell apart."""

from __future__ import annotations

from collections.abc import Sequence

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, RED, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#8C8C8C"
PALETTE = (BLUE, ORANGE, GREEN, PURPLE, SKY, RED)
"""In the order of use."""
WINDOW, OPTIMUM = ORANGE, BLACK
MEDIAN = RED


def condition_colours(units: Sequence[str]) -> list[str]:
    """A colour for each condition: along cividis for frequencies, which are ordered; Okabe-Ito for others."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    n = len(units)
    if n > 1 and (n > 6 or all(unit == "Hz" for unit in units)):
        # The last tenth of cividis is too pale on white.
        return [to_hex(colormaps["cividis"](0.88 * i / (n - 1))) for i in range(n)]
    return list(PALETTE[:n])
