"""The page's server next to a command: `python -m animat.watch FOLDER PROCESS`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from animat.watch.serving import serve


def _announce(address: str) -> None:
    print(address, flush=True)
    # The reader of this pipe may end before the page does.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    # Give way to processes with a deadline, such as a closed loop.
    os.nice(10)
    serve(Path(sys.argv[1]), 0, _announce, parent=int(sys.argv[2]))
