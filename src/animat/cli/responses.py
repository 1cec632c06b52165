"""What commands that read responses share: their options, and how warnings are printed."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from animat.cli.command import Command
from animat.errors import InvalidArgument, Mismatch
from animat.recordings.findings import Finding, warnings_once

if TYPE_CHECKING:
    from animat.neurons.timeline import SimulatorTimeline
    from animat.responses.readouts import Readouts
    from animat.training.policy import Policy


@dataclass(frozen=True)
class ResponseOptions(Command):
    """How responses are read from recordings; the same in every command that reads them."""

    conditions: str | None = None
    """What the agent chooses from: frequency, interval:5,10+-25%, electrode, pattern, "frequency x electrode", all;
    default: by frequency, and by place where places were recorded; in evaluate and replay: as in the policies'
    training"""
    window_ms: tuple[float, float] | None = None
    """Start and end of the response window after a stimulus, in ms; default: 2 10; in evaluate and replay: as in the
    policies' training"""
    burst_threshold: float | None = None
    """Share of active channels above which a response is a burst; 1 keeps all; default: where two groups separate;
    in evaluate and replay: as in the policies' training"""


@dataclass(frozen=True)
class SimulatorOptions(ResponseOptions):
    """How a neuron simulator is made from responses."""

    simulator: Literal["histogram", "empirical", "memory"] | None = None
    """memory: draw a response that was measured after a similar history, the default except for recordings in blocks;
    histogram: the paper's; empirical: draw any measured value; default in evaluate and replay: as in the policies'
    training"""
    bins: int | None = None
    """Bins of a histogram, which is then the simulator; default: 20; in evaluate and replay: as in the policies'
    training"""
    range_hz: float | None = None
    """Equally wide bins from 0 to this rate, in Hz (the paper: 120); default: edges at percentiles of each recording;
    in evaluate and replay: as in the policies' training"""
    allow: tuple[str, ...] = ()
    """Findings to allow, by name, such as dead-window"""

    def timeline(
        self, recordings: Sequence[Path], trained: Policy | None = None, readouts: str | Readouts | None = None
    ) -> SimulatorTimeline:
        """Read the recordings and fit a simulator to each, by the options and otherwise as in a policy's training."""
        from animat.neurons.timeline import fit_timeline
        from animat.recordings.reading import read_sources
        from animat.responses.conditions import conditions_named
        from animat.responses.extraction import extract_series
        from animat.responses.readouts import ALL

        fitted = {} if trained is None else trained.fitted
        fit = simulator_settings(fitted, self.simulator, self.bins, self.range_hz)
        if not recordings:
            raise InvalidArgument("--recordings: expected files or folders of recordings, got none")
        by = self.conditions or fitted.get("by")
        # Before recordings are read, which can take a while.
        conditions = None if by is None else conditions_named(by)
        series = extract_series(
            read_sources(recordings),
            conditions,
            self.window_ms or (None if trained is None else trained.window_ms),
            burst_threshold=fitted.get("burst_threshold") if self.burst_threshold is None else self.burst_threshold,
            allow=self.allow,
            readouts=readouts or (ALL if trained is None else trained.readouts),
        )
        timeline = fit_timeline(series, **fit)
        print_warnings(timeline.findings)
        return timeline

    def timeline_for(self, policies: Mapping[str, Policy], recordings: Sequence[Path]) -> SimulatorTimeline | None:
        """Simulators as in the training of the first policy with a mapping; None if no policy has one."""
        trained = next((policy for policy in policies.values() if policy.mapping is not None), None)
        if trained is not None:
            return self.timeline(recordings, trained)
        self.expect_no_simulator("for policies without neurons")
        return None

    def expect_no_simulator(self, where: str) -> None:
        """Refuse options of recordings and simulators where there are none, as they would have no effect."""
        for option in fields(self):
            value = getattr(self, option.name)
            if option.name in _OF_SIMULATORS and value != option.default:
                # A folder may have the name of an option, such as `recordings`.
                name = option.name.replace("_", "-")
                raise InvalidArgument(f"--{name}: expected none {where}, got {_typed(value)}")


_OF_SIMULATORS = (
    *("conditions", "window_ms", "burst_threshold", "allow"),
    *("simulator", "bins", "range_hz", "recordings", "at_min", "duration_min", "percentiles", "delivery"),
)
"""Options that choose simulators, or how they are made and used."""


def _typed(value: Any) -> str:
    """An option's value as on the command line."""
    several = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{each:g}" if isinstance(each, float) else str(each) for each in several)


def simulator_settings(
    trained: Mapping[str, Any], kind: str | None, bins: int | None, range_hz: float | None
) -> dict[str, Any]:
    """Settings of simulators: those of the policies' training, unless a kind is requested; bins request a histogram.

    With a kind of None the recordings decide (`fit_timeline`). Bins of a kind that has none are refused.
    """
    defaults = {"kind": None, "bins": 20, "range_hz": None}
    requested = {"kind": kind, "bins": bins, "range_hz": range_hz}
    sources = (requested,) if kind is not None else (trained, requested)
    settings = defaults | {name: each[name] for each in sources for name in defaults if each.get(name) is not None}
    for option, value in (("--bins", bins), ("--range-hz", range_hz)):
        if value is None:
            continue
        settings["kind"] = settings["kind"] or "histogram"
        if settings["kind"] != "histogram":
            raise InvalidArgument(
                f"{option}: expected none, as a simulator of kind {settings['kind']} has no bins; got {value:g}"
            )
    return settings


def print_warnings(findings: Sequence[Finding]) -> None:
    """Print warnings, each once, to standard error, where they do not mix with results; notes are for `inspect`."""
    for message in warnings_once(findings):
        print(f"warning: {message}", file=sys.stderr)


def policies_for(robot: str | None, mapping: str | None, path: Path) -> dict[str, Policy]:
    """Load the policies of a file or a folder, after importing their custom robot and mapping, if they have these."""
    from animat.coding.checking import check_mapping
    from animat.coding.mapping import REGISTRY as MAPPINGS
    from animat.goals.robot import without_goal
    from animat.registry import is_ours
    from animat.robots.checking import check_robot
    from animat.robots.registry import REGISTRY
    from animat.training.policy import load_policies

    expected = None if robot is None else REGISTRY.name_of(robot)
    expected_mapping = mapping if mapping in (None, "none") else MAPPINGS.name_of(mapping)
    policies = load_policies(path)
    for name, policy in policies.items():
        if expected not in (None, policy.robot.name):
            raise Mismatch(
                f"{path}, {name}: expected a policy for {expected}, got one for {policy.robot.name}; give others, "
                "or no --robot"
            )
        got = "none" if policy.mapping is None else policy.mapping.name
        if expected_mapping not in (None, got):
            raise Mismatch(
                f"{path}, {name}: expected a policy with the mapping {expected_mapping}, got one with {got}; give "
                "others, or no --mapping"
            )
        if not is_ours(without_goal(policy.robot)):
            check_robot(policy.robot)
        if policy.mapping is not None and not is_ours(policy.mapping):
            check_mapping(policy.mapping)
    return policies
