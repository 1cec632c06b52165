"""HDF5 files are read in a process of their own, so that a damaged one cannot take the program with it.

The HDF5 library itself can crash, or turn in circles for ever, on a few bytes in the wrong place (seen: three of 2,000
damaged files). So another Python reads them, under limits on processor time and memory that the operating system keeps;
if it dies, the file was damaged, and the next file gets a new one. It is started with the first file and stays for the
next ones, which takes a few tenths of a second once.
"""

from __future__ import annotations

import atexit
import math
import os
import pickle
import threading
from concurrent.futures import BrokenExecutor
from pathlib import Path

from animat.errors import AnimatError, InvalidFile
from animat.process import Process
from animat.recordings.formats.hdf5 import first_line
from animat.recordings.recording import Recording

PROCESSOR_S, PROCESSOR_S_PER_MB = 2.0, 0.2
"""Processor time that a file may take: for any, and more by its size."""
WAIT_S, WAIT_S_PER_MB = 8.0, 2.0
"""By the clock, for a machine that is busy with other things, or files that cannot be got at."""
START_S = 60.0
"""For the process to start."""
MEMORY_BYTES, MEMORY_PER_BYTE = 800 * 2**20, 12

_lock = threading.Lock()
_reader: Process | None = None


def read_hdf5_in_subprocess(path: Path, *, part: str | None = None, stimuli: str | None = None) -> Recording:
    """Read a recording as `animat.recordings.formats.hdf5_formats.read_hdf5` does, in the process kept for it.

    Raises:
        InvalidFile: as there; also if the HDF5 library crashes on the file, or needs more time or memory than it may.
        InvalidArgument: as there.
    """
    # Messages name the path as it was given, so it goes with the folder that it is counted from.
    call = pickle.dumps((_read, (Path.cwd(), path, part, stimuli), {}))
    wait_s = WAIT_S + WAIT_S_PER_MB * path.stat().st_size / 1e6
    with _lock:
        reader = _reader if _reader is not None and not _reader.is_spent else _start()
        try:
            recording: Recording = reader.answer(call, wait_s)
        except AnimatError:
            raise
        except (BrokenExecutor, TimeoutError) as error:
            raise InvalidFile(
                f"{path}: expected a whole HDF5 recording, but it is damaged: the HDF5 library crashed on it, or took "
                "more time or memory than its size allows; copy or record it again"
            ) from error
        except Exception as error:
            raise InvalidFile(f"{path}: expected a recording, but it cannot be read ({first_line(error)})") from error
    return recording


def _start() -> Process:
    global _reader
    end_reader()
    _reader = Process("plain")
    try:
        _reader.answer(pickle.dumps((_get_ready, (), {})), START_S)
    except Exception as error:
        is_late = isinstance(error, TimeoutError)
        why = f"not ready after {START_S:g} s, is the machine busy?" if is_late else "is animat installed whole?"
        raise InvalidFile(f"the process that reads HDF5 files could not be started: {why}") from error
    return _reader


@atexit.register
def end_reader() -> None:
    """End the process, if there is one; the next file gets a new one."""
    if _reader is not None:
        _reader.end()


def _get_ready() -> None:
    """Import what reads, before the time of a file begins."""
    from animat.recordings.formats import hdf5_formats  # noqa: F401


def _read(folder: Path, path: Path, part: str | None, stimuli: str | None) -> Recording:
    from animat.recordings.formats.hdf5_formats import read_hdf5

    os.chdir(folder)
    _limit(path)
    return read_hdf5(path, part=part, stimuli=stimuli)


def _limit(path: Path) -> None:
    """Let the operating system end this process if a file takes too much of it."""
    import resource

    size = path.stat().st_size
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = used.ru_utime + used.ru_stime + PROCESSOR_S + PROCESSOR_S_PER_MB * size / 1e6
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), hard))
    statm = Path("/proc/self/statm")
    if statm.exists():
        in_use = int(statm.read_text().split()[0]) * resource.getpagesize()
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        limit = in_use + MEMORY_BYTES + MEMORY_PER_BYTE * size
        resource.setrlimit(resource.RLIMIT_AS, (limit if hard < 0 else min(limit, hard), hard))
