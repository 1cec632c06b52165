"""HDF5 files are read in a process of their own, so that a damaged one cannot take the program with it.

The HDF5 library itself can crash, or turn in circles for ever, on a few bytes in the wrong place (seen: three of 2,000
damaged files). So another Python reads them, under limits on processor time and memory that the operating system keeps;
if it dies, the file was damaged, and the next file gets a new one. It is started with the first file and stays for the
next ones, which takes a few tenths of a second once. What it sends back are plain arrays and JSON.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import json
import math
import os
import select
import struct
import subprocess
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from animat import errors
from animat.errors import AnimatError, InvalidFile
from animat.recordings.recording import Channels, Recording
from animat.recordings.told import from_words, in_words
from animat.stimulation.protocol import Presentation
from animat.stimulation.stimulus import Stimuli

PROCESSOR_S, PROCESSOR_S_PER_MB = 2.0, 0.2
"""Processor time that a file may take: for any, and more by its size."""
WAIT_S, WAIT_S_PER_MB = 8.0, 2.0
"""By the clock, for a machine that is busy with other things, or files that cannot be got at."""
START_S = 60.0
"""For the process to start."""
MEMORY_BYTES, MEMORY_PER_BYTE = 800 * 2**20, 12
_HEADER, _READY = struct.Struct("<cQ"), b"ready"
_ARRAYS = ("spike_times_s", "spike_channels")
_CHANNELS = ("label", "electrode", "x_um", "y_um")
_STIMULI = ("time_s", "frequency_hz", "pattern", "electrodes", "presentation")
_NUMBERS = ("sampling_rate_hz", "start_s", "duration_s", "start_min")


def read_hdf5_apart(path: Path, *, part: str | None = None, stimuli: str | None = None) -> Recording:
    """Read a recording as `animat.recordings.formats.hdf5_formats.read_hdf5` does, in the process kept for it.

    Raises:
        InvalidFile: as there; also if the HDF5 library crashes on the file, or needs more time or memory than it may.
        InvalidArgument: as there.
    """
    # Messages name the path as it was given, so it goes with the folder that it is counted from.
    return _reader.read({"folder": str(Path.cwd()), "path": str(path), "part": part, "stimuli": stimuli}, path)


class _Reader:
    """The process that reads, and how to talk to it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0
        self._lock = threading.Lock()

    def read(self, request: dict[str, Any], path: Path) -> Recording:
        with self._lock:
            try:
                megabytes = path.stat().st_size / 1e6
                answer = self._ask(request, WAIT_S + WAIT_S_PER_MB * megabytes)
            except BaseException:
                self.end()
                raise
        if answer is None:
            raise InvalidFile(
                f"{path}: expected a whole HDF5 recording, but it is damaged: the HDF5 library crashed on it, or took "
                "more time or memory than its size allows; copy or record it again"
            )
        kind, payload = answer
        if kind == b"E":
            said = json.loads(payload)
            raise getattr(errors, said["kind"])(said["message"])
        return _unpacked(payload)

    def end(self) -> None:
        """End the process, if this one started it."""
        process, self._process = self._process, None
        if process is not None and self._owner == os.getpid():
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()

    def _ask(self, request: dict[str, Any], wait_s: float) -> tuple[bytes, bytes] | None:
        """The answer; None if the process died over it or did not answer in time."""
        if self._process is None or self._owner != os.getpid() or self._process.poll() is not None:
            self.end()
            self._start()
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        until = time.monotonic() + wait_s  # from here on, as the process is ready
        try:
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.flush()
            header = _received(process.stdout, _HEADER.size, until)
            if header is not None:
                kind, size = _HEADER.unpack(header)
                payload = _received(process.stdout, size, until)
                if payload is not None:
                    return kind, payload
        except BrokenPipeError:
            pass
        self.end()
        return None

    def _start(self) -> None:
        paths = [folder for folder in sys.path if folder]
        # One thread: several would only take memory that the limit counts.
        single = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-W", "ignore", "-m", "animat.recordings.apart"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=-1,
            env=os.environ | single | {"PYTHONPATH": os.pathsep.join(paths)},
        )
        self._owner = os.getpid()
        until = time.monotonic() + START_S
        if _received(self._process.stdout, len(_READY), until) != _READY:
            is_late = time.monotonic() >= until
            why = f"not ready after {START_S:g} s, is the machine busy?" if is_late else "is animat installed whole?"
            raise InvalidFile(f"the process that reads HDF5 files could not be started: {why}")


def _received(pipe: Any, size: int, until: float) -> bytes | None:
    """So many bytes of a pipe; None if it ends before, or they do not come in time."""
    parts, missing = [], size
    while missing:
        left_s = until - time.monotonic()
        if left_s <= 0 or not select.select([pipe], [], [], left_s)[0]:
            return None
        piece = os.read(pipe.fileno(), min(missing, 2**20))
        if not piece:
            return None
        parts.append(piece)
        missing -= len(piece)
    return b"".join(parts)


def packed(recording: Recording) -> bytes:
    """All of a recording as bytes, the same for recordings that are equal."""
    arrays: dict[str, Any] = {name: getattr(recording, name) for name in _ARRAYS}
    arrays |= {f"channels_{name}": getattr(recording.channels, name) for name in _CHANNELS}
    arrays |= {f"stimuli_{name}": getattr(recording.stimuli, name) for name in _STIMULI}
    words = {
        "numbers": {name: float(getattr(recording, name)) for name in _NUMBERS},
        "presentation": None if recording.presentation is None else asdict(recording.presentation),
        "told": list(in_words(recording).items()),
    }
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, words=np.frombuffer(json.dumps(words).encode(), np.uint8), **arrays)
    return buffer.getvalue()


def _unpacked(payload: bytes) -> Recording:
    with np.load(io.BytesIO(payload), allow_pickle=False) as arrays:
        words = json.loads(arrays["words"].tobytes())
        presentation = words["presentation"]
        return Recording(
            **{name: arrays[name] for name in _ARRAYS},
            channels=Channels(**{name: arrays[f"channels_{name}"] for name in _CHANNELS}),
            stimuli=Stimuli(**{name: arrays[f"stimuli_{name}"] for name in _STIMULI}),
            **words["numbers"],
            presentation=None if presentation is None else Presentation(**presentation),
            **from_words(dict(words["told"])),
        )


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


def _serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Read what is asked for until nothing more is."""
    from animat.recordings.formats.hdf5 import DAMAGE, first_line
    from animat.recordings.formats.hdf5_formats import read_hdf5

    answers.write(_READY)
    answers.flush()
    for line in requests:
        request = json.loads(line)
        path = Path(request["path"])
        try:
            os.chdir(request["folder"])
            _limit(path)
            kind, payload = b"R", packed(read_hdf5(path, part=request["part"], stimuli=request["stimuli"]))
        except AnimatError as error:
            kind, payload = b"E", json.dumps({"kind": type(error).__name__, "message": str(error)}).encode()
        except (*DAMAGE, RecursionError, AssertionError) as error:
            message = f"{path}: expected a recording, but it cannot be read ({first_line(error)})"
            kind, payload = b"E", json.dumps({"kind": "InvalidFile", "message": message}).encode()
        answers.write(_HEADER.pack(kind, len(payload)))
        answers.write(payload)
        answers.flush()


_reader = _Reader()
atexit.register(_reader.end)

if __name__ == "__main__":
    _serve(sys.stdin.buffer, sys.stdout.buffer)
