"""Standard output and standard error, made such that they do not end a command for reasons of their own."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import Any


class _Lossy(io.FileIO):
    """A file that never fails: what cannot be written, as its disk is full or nobody reads it, is lost."""

    def write(self, data: Any, /) -> int:
        written = None
        with suppress(OSError):
            written = super().write(data)
        return memoryview(data).nbytes if written is None else written


def prepare_streams() -> None:
    """Let a command go on if its streams are closed, or lack a character, or standard error cannot be written.

    A full disk with the log of a session must not end that session. Results go to standard output, where it is an error
    if they cannot be written.
    """
    # Closed streams are None, which the parser and others do not expect: discard what is written to them.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115, PTH123
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115, PTH123
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A character that the encoding lacks, such as an accent in a name in ASCII, is printed as a question mark.
        sys.stdout.reconfigure(errors="replace")
    if sys.stderr is sys.__stderr__ and isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr = io.TextIOWrapper(
            io.BufferedWriter(_Lossy(sys.stderr.fileno(), "w", closefd=False)),
            encoding=sys.stderr.encoding,
            errors=sys.stderr.errors,
            line_buffering=True,
        )
