"""What commands share: how they are run, options of several and how they are read, and what ends a session."""

from __future__ import annotations

import abc
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from animat.errors import InvalidArgument, InvalidFile, LoopEnded, Mismatch, expect_at_least
from animat.process import own_cores
from animat.recordings.findings import Finding, warnings_once, without_notes

if TYPE_CHECKING:
    from animat.closed_loop.session import Session
    from animat.cultures.budget import Account
    from animat.neurons.timeline import SimulatorTimeline
    from animat.responses.readouts import Readouts
    from animat.robots.base import Robot
    from animat.training.policy import Policy
    from animat.training.settings import SAC


@dataclass(frozen=True)
class Command(abc.ABC):
    """A command, whose options are its fields."""

    last: ClassVar[tuple[str, ...]] = ("json",)
    """The options that come last in help, in this order, wherever they are declared."""

    json: bool = field(default=False, kw_only=True)
    """End with a line of JSON"""

    @abc.abstractmethod
    def run(self) -> dict[str, Any]:
        """Do the work, print results, and return them as data for JSON."""


@dataclass(frozen=True)
class FolderCommand(Command):
    """A command that leaves its work in a folder as it goes; the others finish theirs only at their end."""

    last = ("workers", "cluster", "shared_folder", "tensorboard", "out", "watch", "json")

    out: Path = field(kw_only=True)
    watch: bool = field(default=False, kw_only=True)
    """Serve a live page for a browser on this machine; needs animat[watch]"""


@dataclass(frozen=True)
class JobOptions(FolderCommand):
    """Where jobs run, and where results go; the same in every command that runs jobs."""

    workers: int | None = None
    """Processes, each on its own core; default: one per core"""
    cluster: str | None = None
    """Run on other machines instead: a Dask scheduler's address, tcp://HOST:8786, or its scheduler file"""
    shared_folder: bool = True
    """With --cluster: workers do not see --out at the same path, so files are passed through this process"""
    out: Path = Path("study")
    """Folder for all results; the report is its report.html"""

    def print_caveats(self, robots: Iterable[Robot[Any]]) -> None:
        """Print the robots' caveats, and a warning for more workers than cores."""
        for robot in robots:
            for caveat in robot.caveats():
                print(f"warning: {caveat}", file=sys.stderr)
        cores = len(own_cores())
        if self.workers is not None and self.workers > cores:
            print(f"warning: --workers: got {self.workers}; at most one per core is used, {cores}", file=sys.stderr)

    @contextmanager
    def executing(self, title: str) -> Iterator[dict[str, Any]]:
        """Arguments for what runs the jobs: workers, the executor of a cluster if one is given, and a progress bar."""
        from animat.execution.cluster import Cluster
        from animat.progress import Bar

        if self.cluster is None and not self.shared_folder:
            raise InvalidArgument("--no-shared-folder: expected only with --cluster, got no cluster")
        cluster = None if self.cluster is None else Cluster(self.cluster, has_shared_folder=self.shared_folder)
        with cluster or nullcontext() as executor, Bar(title) as progress:
            yield {"workers": self.workers, "executor": executor, "progress": progress}


@dataclass(frozen=True)
class StimulationOptions(FolderCommand):
    """Which culture is stimulated, and how much; the same in every command that stimulates one."""

    culture: Literal["virtual", "replay", "cl1", "maxone"] = "virtual"
    """virtual: simulated neurons on a simulated array; replay: responds from recordings; cl1 and maxone: the devices"""
    selection: Path | None = None
    """For a MaxOne: the file of its electrodes"""
    culture_seed: int | None = None
    """Seed of the virtual culture, a CL1's patterns or a replay's draws; default: in run the recordings', else 1"""
    budget_pulses: int | None = None
    """Most pulses in all, in live including those of the recordings; default: no limit but the culture's own"""
    budget_per_electrode: int | None = None
    """Most pulses on any one electrode"""
    thresholds: Literal["adaptive", "fixed"] = "adaptive"
    """The mapping's thresholds in closed loop: adapted to the culture's newest responses, or fixed by the recording"""
    on_burst: Literal["use", "repeat", "skip"] = "use"
    """A response that is a burst: use it, repeat the stimulus, or skip it and keep the command"""
    on_late: Literal["continue", "stop"] = "continue"
    """A pulse that comes late: continue and log it, or stop"""
    pause_s: float = 2.0
    """Seconds without stimulation before each episode, and each time in the settling"""
    warm_up: int | None = None
    """Trials of each condition before the robot moves in an episode; default: 2 with one pulse, else 0"""
    settling: int | None = None
    """How many times a pause and six trials of each condition precede the first episode, so that thresholds adapt;
    default: 10 with one pulse and adaptive thresholds, else 0"""
    patience_s: float = 10.0
    """Seconds beyond the expected time that a culture, robot or agent may take before the session ends"""

    def _check_culture_seed(self) -> None:
        # Checked here, as a later error would call it `seed`, like the policies'.
        expect_at_least("--culture-seed", self.culture_seed, 0)
        if self.culture_seed is not None and self.culture == "maxone":
            raise InvalidArgument(f"--culture-seed: expected none for --culture maxone, got {self.culture_seed}")

    def _account(self) -> Account:
        from animat.cultures.budget import Account, Budget

        expect_at_least("--budget-pulses", self.budget_pulses, 1)
        expect_at_least("--budget-per-electrode", self.budget_per_electrode, 1)
        return Account(Budget(self.budget_pulses, self.budget_per_electrode))

    def _loop_settings(self) -> dict[str, Any]:
        names = ("on_burst", "on_late", "pause_s", "warm_up", "settling", "patience_s")
        return {name: getattr(self, name) for name in names}


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
    training, and only with a histogram (--simulator histogram)"""
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
        from animat.responses.windows import DEFAULT_WINDOW_MS

        fitted = {} if trained is None else trained.fitted
        fit = simulator_settings(fitted, self.simulator, self.bins, self.range_hz)
        if not recordings:
            raise InvalidArgument("--recordings: expected files or folders, as animat record makes them, got none")
        by = self.conditions or fitted.get("by")
        # Before recordings are read, which can take a while.
        conditions = None if by is None else conditions_named(by)
        # The usual window of a policy is none that was given, so a table's own takes its place.
        window_ms = None if trained is None or trained.window_ms == DEFAULT_WINDOW_MS else trained.window_ms
        series = extract_series(
            read_sources(recordings),
            conditions,
            self.window_ms or window_ms,
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
                several = value if isinstance(value, tuple) else (value,)
                typed = " ".join(f"{each:g}" if isinstance(each, float) else str(each) for each in several)
                raise InvalidArgument(f"--{name}: expected none {where}, got {typed}")


_OF_SIMULATORS = (
    *("conditions", "window_ms", "burst_threshold", "allow"),
    *("simulator", "bins", "range_hz", "recordings", "at_min", "duration_min", "percentiles", "delivery"),
)
"""Options that choose simulators, or how they are made and used."""


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


def warnings_of(timeline: SimulatorTimeline | None) -> tuple[Finding, ...]:
    """What was printed about the simulators' recordings, for JSON."""
    return () if timeline is None else without_notes(timeline.findings)


def print_warnings(findings: Sequence[Finding]) -> None:
    """Print warnings, each once, to standard error, where they do not mix with results; notes are for `inspect`."""
    for message in warnings_once(findings):
        print(f"warning: {message}", file=sys.stderr)


def robot_for(name: str, goal: str | None = None, /, **parameters: float) -> Robot[Any]:
    """A robot by its name, checked if it is not one of ours, with a goal in place of its own task if one is given."""
    from animat.goals.robot import with_goal
    from animat.registry import is_ours
    from animat.robots.checking import check_robot
    from animat.robots.registry import robot_named

    robot = robot_named(name, **parameters)
    if not is_ours(robot):
        check_robot(robot)
    return robot if goal is None else with_goal(robot, goal)


def policies_for(robot: str | None, mapping: str | None, path: Path) -> dict[str, Policy]:
    """Load the policies of a file or a folder, after importing their custom robot and mapping, if they have these."""
    from animat.coding.checking import check_mapping
    from animat.coding.mapping import REGISTRY as MAPPINGS
    from animat.goals.robot import without_goal
    from animat.registry import is_ours
    from animat.robots.checking import check_robot
    from animat.robots.registry import REGISTRY
    from animat.training.folder import missing_policies
    from animat.training.policy import load_policies

    expected = None if robot is None else REGISTRY.name_of(robot)
    expected_mapping = mapping if mapping in (None, "none") else MAPPINGS.name_of(mapping)
    missing, planned = missing_policies(path)
    unfinished = f"{path}: {missing} of the {planned} policies of its training are missing"
    if missing and missing == planned:
        raise InvalidFile(f"{unfinished}: run animat train again, which continues it")
    policies = load_policies(path)
    if missing:
        print(f"warning: {unfinished}; the others are used (animat train continues it)", file=sys.stderr)
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


def expect_no_fault(session: Session, folder: Path) -> None:
    """Raise if the session ended early; called once everything is reported and written."""
    ending = session.ending
    if ending.by == "person":
        raise KeyboardInterrupt
    if ending.by != "plan":
        raise LoopEnded(f"{folder}: the session ended before its plan was completed: {ending.message}")
    if not session.recording_file.is_file():
        raise InvalidFile(ending.message)


def read_numbers(option: str, pairs: Sequence[str]) -> dict[str, float]:
    """Read `NAME=NUMBER` pairs, each name once (else InvalidArgument); whole numbers stay whole."""
    numbers: dict[str, float] = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        if name in numbers:
            raise InvalidArgument(f"{option}: expected {name} once, got it twice")
        try:
            numbers[name] = int(value) if value.lstrip("-").isdecimal() else float(value)
        except ValueError:
            raise InvalidArgument(f"{option}: expected NAME=NUMBER, got {pair!r}") from None
    return numbers


def read_sac(pairs: Sequence[str]) -> SAC:
    """The algorithm's settings, with `pairs` in place of its defaults; InvalidArgument for an impossible one."""
    from animat.training.settings import SAC

    numbers = read_numbers("--sac", pairs)
    try:
        return SAC(**numbers)  # type: ignore[arg-type]
    except InvalidArgument as error:
        # "At the top" is meant for files, whose settings may be in tables.
        raise InvalidArgument(f"--sac: {str(error).replace(' at the top', '')}") from error
