"""The server of a page beside a command: `python -m animat.watch FOLDER PROCESS`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from animat.watch.serving import serve


def _say(address: str) -> None:
    print(address, flush=True)
    # Whoever reads this may end before the page does.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    # What has a deadline comes first.
    os.nice(10)
    serve(Path(sys.argv[1]), 0, _say, beside=int(sys.argv[2]))
