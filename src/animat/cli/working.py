"""What commands that run the jobs of a folder share: their options, and where the jobs are run."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from animat.studies.specification import RobotSpec


@dataclass(frozen=True)
class Working:
    """Where jobs are run, and where everything goes; the same in every command that has some."""

    workers: int | None = None
    """Processes, each on its own core; default: one a core"""
    cluster: str | None = None
    """On other machines instead: a Dask scheduler's address, tcp://HOST:8786, or its scheduler file"""
    shared_folder: bool = True
    """With --cluster: workers do not see --out at the same place, and files go to them and back through this process"""
    out: Path = Path("study")
    """Folder for everything; the report is report.html in it"""
    watch: bool = False
    """Serve a page of it beside, for a browser on this machine; needs animat[watch]"""
    json: bool = False
    """End with a line of JSON"""

    def say_first(self, robots: Iterable[RobotSpec]) -> None:
        """Warn of what is to be known of the robots, and of more workers than there are cores."""
        for spec in robots:
            for caveat in spec.robot().caveats():
                print(f"warning: {caveat}", file=sys.stderr)
        cores = len(os.sched_getaffinity(0))
        if self.workers is not None and self.workers > cores:
            print(f"warning: --workers: {self.workers} were asked for; there is one a core, {cores}", file=sys.stderr)

    @contextmanager
    def at_work(self, title: str) -> Iterator[dict[str, Any]]:
        """Workers, the executor of a cluster where one is asked for, and a progress bar, for what runs the jobs."""
        from animat.execution.cluster import on_cluster
        from animat.progress import Bar

        with on_cluster(self.cluster, self.shared_folder) as executor, Bar(title) as progress:
            yield {"workers": self.workers, "executor": executor, "progress": progress}
