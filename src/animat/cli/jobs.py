"""What commands that run jobs in a folder share: their options, and where the jobs run."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from animat.cli.command import FolderCommand

if TYPE_CHECKING:
    from animat.studies.specification import RobotSpec


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
        cores = len(os.sched_getaffinity(0))
        if self.workers is not None and self.workers > cores:
            print(f"warning: --workers: got {self.workers}; at most one per core is used, {cores}", file=sys.stderr)

    @contextmanager
    def executing(self, title: str) -> Iterator[dict[str, Any]]:
        """Arguments for what runs the jobs: workers, the executor of a cluster if one is given, and a progress bar."""
        from animat.execution.cluster import on_cluster
        from animat.progress import Bar

        with on_cluster(self.cluster, self.shared_folder) as executor, Bar(title) as progress:
            yield {"workers": self.workers, "executor": executor, "progress": progress}
