"""What was predicted of a session before it began, kept beside its log for whoever watches or reads it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from animat.errors import InvalidFile
from animat.plain_file import read_plain_text
from animat.writing import write_whole

PREDICTED_FILE = "predicted.json"
_MOST_BYTES = 2**24


def write_predicted(folder: Path, returns: Mapping[str, tuple[float, float, float]]) -> None:
    """Write the mean return that is predicted of each agent, with the ends of its 95 % interval.

    Raises:
        InvalidFile: if it cannot be written.
    """
    words = {name: dict(zip(("mean", "low", "high"), map(float, of), strict=True)) for name, of in returns.items()}
    write_whole(folder / PREDICTED_FILE, json.dumps({"predicted_returns": words}, indent=1) + "\n")


def read_predicted(folder: Path) -> dict[str, tuple[float, float, float]]:
    """The predicted returns of a session's agents; none where nothing was predicted.

    Raises:
        InvalidFile: for a file that holds something else.
    """
    path = folder / PREDICTED_FILE
    if not path.exists():
        return {}
    text = read_plain_text(path, _MOST_BYTES)
    try:
        words = json.loads(text)["predicted_returns"]
        return {str(name): (float(of["mean"]), float(of["low"]), float(of["high"])) for name, of in words.items()}
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise InvalidFile(f"{path}: expected predicted returns by agent, got something else ({error!r})") from error
