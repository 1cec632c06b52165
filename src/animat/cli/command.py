"""What commands share: how they are run, options of several, how named numbers are read, and what ends a session."""

from __future__ import annotations

import abc
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from animat.errors import InvalidArgument, InvalidFile, LoopEnded, expect_at_least
from animat.process import own_cores

if TYPE_CHECKING:
    from animat.closed_loop.session import Session
    from animat.cultures.budget import Account
    from animat.studies.specification import RobotSpec
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

    def print_caveats(self, robots: Iterable[RobotSpec]) -> None:
        """Print the robots' caveats, and a warning for more workers than cores."""
        for spec in robots:
            for caveat in spec.robot().caveats():
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
    """Which virtual culture, patterns of a CL1 or draws of a replay; default: in run that of the recordings, else 1"""
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
        # Later it would be called `seed`, as the policies' is.
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
        # An option has no tables, of which a setting could be at the top.
        raise InvalidArgument(f"--sac: {str(error).replace(' at the top', '')}") from error
