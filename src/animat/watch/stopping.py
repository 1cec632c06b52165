"""Ending a closed loop from outside, by the file that it looks for before each trial."""

from __future__ import annotations

import os
from pathlib import Path

from animat.closed_loop.gathering import LOG_FILE, RECORDING_FILE, STOP_FILE
from animat.errors import InvalidArgument, InvalidFile


def stop_session(folder: Path) -> None:
    """Ask a session to end. Nothing is waited for or read first: it may be urgent.

    Raises:
        InvalidArgument: where no session is, or one that has ended.
        InvalidFile: if the file cannot be made.
    """
    if not (folder / LOG_FILE).is_file():
        raise InvalidArgument(f"{folder.name}: expected a session to stop, got none")
    if (folder / RECORDING_FILE).exists():
        raise InvalidArgument(f"{folder.name}: the session has ended: there is nothing to stop")
    try:
        # Not through a link, which may lead anywhere.
        os.close(os.open(folder / STOP_FILE, os.O_CREAT | os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666))
    except OSError as error:
        raise InvalidFile(f"{folder / STOP_FILE}: cannot be made: {error.strerror or error}") from error
