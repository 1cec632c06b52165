"""Reads HDF5 files in a separate process, so that a damaged file cannot crash the program.

The HDF5 library itself can crash, or loop for ever, on a few misplaced bytes (seen in three of 2,000 damaged files).
The operating system limits the process's time and memory; it is kept for later files, until one kills it.
"""

from __future__ import annotations

import atexit
import math
import os
import pickle
import threading
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from pathlib import Path

from animat.errors import AnimatError, InvalidFile, first_line
from animat.process import Process
from animat.recordings.recording import Recording

PROCESSOR_S, PROCESSOR_S_PER_MB = 2.0, 0.2
"""Processor time that a file may take, and how much more per megabyte."""
WAIT_S, WAIT_S_PER_MB = 8.0, 2.0
"""Wall-clock time, for busy machines and inaccessible files."""
START_S = 60.0
"""Time for the process to start."""
MEMORY_BYTES, MEMORY_PER_BYTE = 800 * 2**20, 12

_lock = threading.Lock()
_reader: Process | None = None


def read_hdf5_in_subprocess(path: Path, *, part: str | None = None, stimuli: str | None = None) -> Recording:
    """As `read_hdf5`, in the separate process; also InvalidFile if the library crashes or exceeds its limits."""
    # Messages name the path as it was given, so the folder that it is relative to is passed too.
    call = pickle.dumps((_read, (Path.cwd(), path, part, stimuli), {}))
    wait_s = WAIT_S + WAIT_S_PER_MB * path.stat().st_size / 1e6
    with _lock:
        reader = _reader if _reader is not None and not _reader.is_spent else _start()
        try:
            recording: Recording = reader.answer(call, wait_s)
        except AnimatError:
            raise
        except (BrokenExecutor, TimeoutError) as error:
            what = "the HDF5 library crashed on it, or took more time or memory than its size allows"
            expected = "expected a complete HDF5 recording, but it is damaged"
            raise InvalidFile(f"{path}: {expected}: {what}; copy or record it again") from error
        except Exception as error:
            raise InvalidFile(f"{path}: expected a recording, but it cannot be read ({first_line(error)})") from error
    return recording


def _start() -> Process:
    global _reader
    end_reader()
    _reader = Process("plain")
    try:
        _reader.answer(pickle.dumps((_import_readers, (), {})), START_S)
    except Exception as error:
        is_late = isinstance(error, TimeoutError)
        why = f"not ready after {START_S:g} s, is the machine busy?" if is_late else "is animat fully installed?"
        raise InvalidFile(f"the process that reads HDF5 files could not be started: {why}") from error
    return _reader


@atexit.register
def end_reader() -> None:
    """End the process if there is one; the next file gets a new one."""
    if _reader is not None:
        _reader.end()


def _import_readers() -> None:
    """Import the readers before the time limit of a file starts."""
    from animat.recordings.formats import hdf5_formats  # noqa: F401


def _read(folder: Path, path: Path, part: str | None, stimuli: str | None) -> Recording:
    from animat.recordings.formats.hdf5_formats import read_hdf5

    os.chdir(folder)
    _limit_resources(path)
    return read_hdf5(path, part=part, stimuli=stimuli)


def _limit_resources(path: Path) -> None:
    """Make the operating system end this process if a file takes too much time or memory."""
    import resource

    size = path.stat().st_size
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = used.ru_utime + used.ru_stime + PROCESSOR_S + PROCESSOR_S_PER_MB * size / 1e6
    limits = {resource.RLIMIT_CPU: math.ceil(seconds)}
    with suppress(FileNotFoundError):  # Only Linux reports and limits the memory in use.
        in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        limits[resource.RLIMIT_AS] = in_use + MEMORY_BYTES + MEMORY_PER_BYTE * size
    for kind, limit in limits.items():
        _, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (limit if hard < 0 else min(limit, hard), hard))
