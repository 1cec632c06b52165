"""The command that shows a folder in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from animat.cli.command import Command
from animat.errors import InvalidArgument


@dataclass(frozen=True)
class Watch(Command):
    """Serve a page of all work in a folder (running, finished or killed) to a browser on this machine, until Ctrl-C."""

    folder: Positional[Path]
    """Folder of a session, a training, a live run, a study, a tuning, recordings, or several of these"""
    port: int = 0
    """Port to listen on, on this machine only; 0: any free port"""

    def run(self) -> dict[str, Any]:
        from animat.watch.serving import serve

        if not self.folder.is_dir():
            got = "a file" if self.folder.exists() else "none"
            raise InvalidArgument(f"{self.folder}: expected a folder to watch, got {got}")
        serve(self.folder, self.port, lambda address: print(f"{address}  (Ctrl-C ends only the page)", flush=True))
        return {"folder": str(self.folder)}
