"""What commands that read responses share: their options, and how findings are said."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from animat.errors import InvalidArgument, Mismatch
from animat.recordings.findings import Finding, warnings_once

if TYPE_CHECKING:
    from animat.neurons.timeline import SimulatorTimeline
    from animat.responses.readouts import Readouts
    from animat.training.policy import Policy


@dataclass(frozen=True)
class Responding:
    """How responses are read from recordings; the same in every command that reads them."""

    conditions: str | None = None
    """What the agent picks from: frequency, interval:5,10+-25%, electrode, pattern, "frequency x electrode", all;
    default: by frequency, and by place where places were recorded"""
    window_ms: tuple[float, float] | None = None
    """Start and end of the response window after a stimulus, in ms; default: 2 10"""
    burst_threshold: float | None = None
    """Share of active channels above which a response is a burst; 1 keeps all; default: where two groups part"""


@dataclass(frozen=True)
class Fitting(Responding):
    """How a neuron simulator is made of responses."""

    simulator: Literal["histogram", "empirical", "memory"] | None = None
    """memory: draw a response that was measured after a similar history, the default but for recordings in blocks;
    histogram: the paper's; empirical: draw any measured value"""
    bins: int | None = None
    """Bins of a histogram; default: 20"""
    range_hz: float | None = None
    """Bins equally wide from 0 to here, in Hz (the paper: 120); default: edges at percentiles of each recording"""
    allow: tuple[str, ...] = ()
    """Findings to allow, by name, such as dead-window"""

    def timeline(
        self, recordings: Sequence[Path], trained: Policy | None = None, readouts: str | Readouts | None = None
    ) -> SimulatorTimeline:
        """Read the recordings and fit a simulator to each: as those that a policy was trained on, unless asked."""
        from animat.neurons.timeline import fit_timeline
        from animat.recordings.reading import read_sources
        from animat.responses.conditions import conditions_named
        from animat.responses.readouts import ALL
        from animat.responses.series import extract_series
        from animat.responses.windows import DEFAULT_WINDOW_MS

        fitted = {} if trained is None else trained.fitted
        fit = fit_as(fitted, self.simulator, self.bins, self.range_hz)
        if not recordings:
            raise InvalidArgument("--recordings: expected files or folders of recordings, got none")
        by = self.conditions or fitted.get("by")
        series = extract_series(
            read_sources(recordings),
            None if by is None else conditions_named(by),
            self.window_ms or (trained and trained.window_ms) or DEFAULT_WINDOW_MS,
            burst_threshold=fitted.get("burst_threshold") if self.burst_threshold is None else self.burst_threshold,
            allow=self.allow,
            readouts=readouts or (ALL if trained is None else trained.readouts),
        )
        timeline = fit_timeline(series, **fit)
        say_findings(timeline.findings)
        return timeline

    def timeline_for(self, policies: Mapping[str, Policy], recordings: Sequence[Path]) -> SimulatorTimeline | None:
        """As the training of policies had it, by the first that has a mapping; None where none has one."""
        trained = next((policy for policy in policies.values() if policy.mapping is not None), None)
        return None if trained is None else self.timeline(recordings, trained)


def fit_as(trained: Mapping[str, Any], kind: str | None, bins: int | None, range_hz: float | None) -> dict[str, Any]:
    """How simulators are made: as those that policies were trained on, unless another kind is asked for.

    Whoever asks for bins asks for a histogram. A kind of None is what suits the recordings (`fit_timeline`).

    Raises:
        InvalidArgument: for bins of a kind that has none.
    """
    usual = {"kind": None, "bins": 20, "range_hz": None}
    asked = {"kind": kind, "bins": bins, "range_hz": range_hz}
    given = (asked,) if kind is not None else (trained, asked)
    made = usual | {name: known[name] for known in given for name in usual if known.get(name) is not None}
    for option, value in (("--bins", bins), ("--range-hz", range_hz)):
        if value is None:
            continue
        made["kind"] = made["kind"] or "histogram"
        if made["kind"] != "histogram":
            raise InvalidArgument(
                f"{option}: expected none, as a simulator of kind {made['kind']} has no bins; got {value:g}"
            )
    return made


def say_findings(findings: Sequence[Finding]) -> None:
    """Warnings go to standard error, so that they are seen and results stay readable; notes are for `inspect`.

    What is found in several recordings is told once, where it is worst, with how many others there are.
    """
    for message in warnings_once(findings):
        print(f"warning: {message}", file=sys.stderr)


def policies_for(robot: str | None, mapping: str | None, path: Path) -> dict[str, Policy]:
    """The policies of a file or a folder, and a robot and a mapping of one's own imported for them.

    Raises:
        Mismatch: for policies of another robot or mapping than was named.
    """
    from animat.coding.checking import check_mapping
    from animat.coding.mapping import REGISTRY as MAPPINGS
    from animat.goals.robot import without_goal
    from animat.registry import is_ours
    from animat.robots.checking import check_robot
    from animat.robots.registry import REGISTRY
    from animat.training.policy import load_policies

    expected = None if robot is None else REGISTRY.name_of(robot)
    asked = mapping if mapping in (None, "none") else MAPPINGS.name_of(mapping)
    policies = load_policies(path)
    for name, policy in policies.items():
        if expected not in (None, policy.robot.name):
            raise Mismatch(
                f"{path}, {name}: expected a policy for {expected}, got one for {policy.robot.name}; give others, "
                "or no --robot"
            )
        got = "none" if policy.mapping is None else policy.mapping.name
        if asked not in (None, got):
            raise Mismatch(
                f"{path}, {name}: expected a policy with the mapping {asked}, got one with {got}; give others, or "
                "no --mapping"
            )
        if not is_ours(without_goal(policy.robot)):
            check_robot(policy.robot)
        if policy.mapping is not None and not is_ours(policy.mapping):
            check_mapping(policy.mapping)
    return policies
