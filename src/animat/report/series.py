"""The figures of a series of recordings of one culture, in a folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from animat.errors import InvalidArgument, Mismatch
from animat.recordings.recording import Recording
from animat.report.array import draw_array
from animat.report.drift import draw_drift
from animat.report.responses_over_time import draw_responses_over_time
from animat.report.style import save_figure
from animat.responses.responses import Responses


def draw_series(
    first: Recording | None, series: Sequence[Responses], folder: str | os.PathLike[str], file_format: str = "png"
) -> list[Path]:
    """Draw a series: `series-array`, `series-over-time`, `series-drift`; `file_format` is one of `FORMATS`.

    The array is drawn if the positions of the first recording are known, the other figures if there are two recordings
    or more. `series` may be in any order.

    Raises:
        InvalidArgument: for no responses.
        Mismatch: for recordings with different conditions.
        InvalidFile: if a file cannot be written.
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
    return [save_figure(figure, Path(folder) / f"series-{what}.{file_format}") for what, figure in figures.items()]
