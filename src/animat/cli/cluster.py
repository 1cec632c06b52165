"""The command that starts a cluster on this machine, to try one out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from animat.cli.command import Command
from animat.errors import AnimatError, counted, expect_at_least
from animat.process import own_cores
from animat.writing import expect_writable


@dataclass(frozen=True)
class ClusterCommand(Command):
    """Run a Dask scheduler and workers until Ctrl-C, for --cluster of train, study, reproduce and tune."""

    where: Positional[Literal["local"]]
    """local: on this machine, to try it out; docs/cluster.md has the few lines for several machines"""
    workers: int | None = None
    """Processes, each on its own core; default: one per core"""
    file: Path = Path("cluster.json")
    """Where the scheduler writes its address; removed at the end"""

    def run(self) -> dict[str, Any]:
        from animat.execution.cluster import local_cluster

        workers = len(own_cores()) if self.workers is None else self.workers
        expect_at_least("--workers", workers, 1)
        expect_writable(self.file.parent, "--file")
        with local_cluster(workers, self.file) as processes:
            print(f"{counted(workers, 'worker')}; to use them: --cluster {self.file}; to end them: Ctrl-C", flush=True)
            try:
                while all(process.poll() is None for process in processes):
                    time.sleep(0.2)
            except KeyboardInterrupt:
                return {"workers": workers}
        raise AnimatError("the scheduler or the workers ended; start again")
