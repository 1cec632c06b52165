"""What commands that read responses share: their options, and how findings are said."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from animat.errors import InvalidArgument
from animat.recordings.findings import Finding

if TYPE_CHECKING:
    from animat.neurons.timeline import SimulatorTimeline


@dataclass(frozen=True)
class Responding:
    """How responses are read from recordings; the same in every command that reads them."""

    conditions: str | None = None
    """What the agent picks from: frequency, interval:5,10+-25%, electrode, pattern, all; default: by frequency"""
    window_ms: tuple[float, float] = (2.0, 10.0)
    """Start and end of the response window after a stimulus, in ms"""
    burst_threshold: float | None = None
    """Share of active channels above which a response is a burst; 1 keeps all; default: by Otsu's method"""


@dataclass(frozen=True)
class Fitting(Responding):
    """How a neuron simulator is made of responses."""

    simulator: Literal["histogram", "empirical", "memory"] | None = None
    """histogram (the paper, default); empirical: draw a measured value; memory: one with a like past"""
    bins: int | None = None
    """Bins of a histogram; default: 20"""
    range_hz: float | None = None
    """Bins equally wide from 0 to here, in Hz (the paper: 120); default: edges at percentiles of each recording"""
    despite: tuple[str, ...] = ()
    """Findings to go on in spite of, by name, such as dead-window"""

    def timeline(self, recordings: Sequence[Path], trained: Mapping[str, Any] | None = None) -> SimulatorTimeline:
        """Read the recordings and fit a simulator to each: as those that policies were trained on, unless asked."""
        from animat.neurons.conditions import conditions_named
        from animat.neurons.series import extract_series
        from animat.neurons.timeline import fit_timeline
        from animat.recordings.reading import read_recordings

        fit = fit_as(trained or {}, self.simulator, self.bins, self.range_hz)
        if not recordings:
            raise InvalidArgument("--recordings: expected files or folders of recordings, got none")
        by = None if self.conditions is None else conditions_named(self.conditions)
        series = extract_series(
            read_recordings(recordings),
            by,
            self.window_ms,
            burst_threshold=self.burst_threshold,
            despite=self.despite,
        )
        timeline = fit_timeline(series, **fit)
        say_findings(timeline.findings)
        return timeline


def fit_as(trained: Mapping[str, Any], kind: str | None, bins: int | None, range_hz: float | None) -> dict[str, Any]:
    """How simulators are made: as those that policies were trained on, unless another kind is asked for.

    Raises:
        InvalidArgument: for bins of a kind that has none.
    """
    usual = {"kind": "histogram", "bins": 20, "range_hz": None}
    asked = {"kind": kind, "bins": bins, "range_hz": range_hz}
    given = (asked,) if kind is not None else (trained, asked)
    made = usual | {name: value for known in given for name, value in known.items() if value is not None}
    for option, value in (("--bins", bins), ("--range-hz", range_hz)):
        if value is not None and made["kind"] != "histogram":
            raise InvalidArgument(
                f"{option}: expected none, as a simulator of kind {made['kind']} has no bins; got {value:g}"
            )
    return made


def say_findings(findings: Sequence[Finding]) -> None:
    """Warnings go to standard error, so that they are seen and results stay readable; notes are for `inspect`.

    What is found in several recordings is told once, where it is worst, with how many others there are.
    """
    warnings: dict[str, list[Finding]] = {}
    for finding in findings:
        if finding.severity != "note":
            warnings.setdefault(finding.name, []).append(finding)
    for alike in warnings.values():
        worst = max(alike, key=_gravity)
        others = f" (and {len(alike) - 1} more like it)" if len(alike) > 1 else ""
        print(f"warning: {worst.sentence}{others}", file=sys.stderr)


def _gravity(finding: Finding) -> float:
    """What makes one of several findings of a name the worst: a number far from 0, or close to it where few is bad."""
    value = abs(finding.value or 0.0)
    return -value if finding.name in ("few-samples", "bursts-not-separable", "no-difference") else value
