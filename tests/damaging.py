"""Damage recordings in every way and read them, in a process with a limit on memory and time.

    python damaging.py KIND SEED COUNT FOLDER

Prints how many were read and how many refused. Ends with another status than 0 at the first file that is neither: a
traceback, an error of several lines, ten seconds, a gigabyte, or code of the file that ran.
"""

from __future__ import annotations

import io
import pickle
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from animat.errors import AnimatError
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.hdf5_subprocess import end_reader
from animat.recordings.reading import read_recording
from animat.responses.inspection import inspect_recording
from rig_files import (
    BITS,
    FIRST_FRAME,
    Bomb,
    event_table,
    mapping_table,
    packed_text,
    spike_table,
    write_cl1,
    write_maxwell,
    write_old_maxwell,
)
from synthetic_recordings import synthetic_recording

GIGABYTE = 2**30
SECONDS = 10

N = 400


def sound(kind: str, path: Path) -> None:
    """Write an undamaged file of a kind."""
    rng = np.random.default_rng(7)
    seconds, channels = np.sort(rng.random(N)) * 9, rng.choice([3, 9, 40], N)
    table = mapping_table([3, 9, 40], [1000, 2000, 26_399])
    stimuli = np.arange(1, 9)
    if kind == "nwb":
        write_nwb(synthetic_recording(3, patterns=3, channels=16), path.with_suffix(".nwb"))
        path.with_suffix(".nwb").rename(path)
    elif kind == "other-nwb":
        from test_rig_readers import other_nwb

        other_nwb(path)
    elif kind == "maxwell":
        events = event_table(stimuli, ['{"frequency_hz": 5, "electrodes": [9, 10]}'] * 8)
        write_maxwell(path, mapping=table, spikes=spike_table(seconds, channels), events=events, recorded=[3, 9, 40],
                      frames=2000, linked=True)  # fmt: skip
    elif kind == "old-maxwell":
        bits = np.zeros(8, BITS)
        bits["frameno"], bits["bits"] = FIRST_FRAME + 20_000 * stimuli, [1, 0] * 4
        write_old_maxwell(path, mapping=table, spikes=spike_table(seconds, channels), bits=bits)
    elif kind == "cl1":
        write_cl1(path, spikes=[(int(s * 25_000), int(c)) for s, c in zip(seconds, channels, strict=True)],
                  stims=[(int(s) * 25_000, 9) for s in stimuli],
                  stream=[(0, packed_text('{"frequency_hz": 5}'))])  # fmt: skip
    elif kind == "npz":
        np.savez_compressed(path.with_suffix(".npz"), spike_time_s=seconds, spike_channel=channels,
                            stimulus_time_s=stimuli, channel_label=np.array([3, 9, 40]))  # fmt: skip
        path.with_suffix(".npz").rename(path)
    else:
        rows = "".join(f"{s:.5f},{c}\n" for s, c in zip(seconds, channels, strict=True))
        path.write_text("time_s,channel\n" + rows)
        path.with_name(path.name + "_stimuli.csv").write_text("".join(f"{s}\n" for s in stimuli))


def _cut(rng: np.random.Generator, content: bytearray, mark: Path) -> bytes:
    return bytes(content[: int(rng.integers(0, len(content)))])


def _flip(rng: np.random.Generator, content: bytearray, mark: Path) -> bytes:
    for at in rng.integers(0, len(content), int(rng.choice([1, 3, 30, 300]))):
        content[at] ^= 1 << int(rng.integers(8))
    return bytes(content)


def _flip_head(rng: np.random.Generator, content: bytearray, mark: Path) -> bytes:
    # What a file says about itself is mostly at its start.
    for at in rng.integers(0, min(len(content), 4096), int(rng.choice([1, 3, 10]))):
        content[at] ^= 1 << int(rng.integers(8))
    return bytes(content)


def _overwrite(rng: np.random.Generator, content: bytearray, mark: Path) -> bytes:
    size = int(rng.choice([4, 16, 64, 512]))
    at = int(rng.integers(0, len(content)))
    fill = [rng.bytes(size), bytes(size), b"\xff" * size][int(rng.integers(3))]
    content[at : at + size] = fill
    return bytes(content)


def _insert(rng: np.random.Generator, content: bytearray, mark: Path) -> bytes:
    at = int(rng.integers(0, len(content)))
    content[at:at] = rng.bytes(int(rng.integers(1, 64)))
    return bytes(content)


def _rebuild(rng: np.random.Generator, content: bytearray, mark: Path) -> bytes:
    """Change what stands at a place of an HDF5 file: another type, size, a link, a pickle, nothing."""
    buffer = io.BytesIO(bytes(content))
    with h5py.File(buffer, "r+") as file:
        places: list[str] = []
        file.visititems(lambda name, node: places.append(name))
        at = places[int(rng.integers(len(places)))]
        kind = int(rng.integers(12))
        if kind == 0:
            _attributes(rng, file[at], mark)
            return bytes(_closed(file, buffer))
        del file[at]
        if kind == 1:
            file[at] = h5py.ExternalLink("/etc/passwd", "/x")
        elif kind == 2:
            file[at] = h5py.SoftLink("/" + at)
        elif kind == 3:
            file[at] = h5py.SoftLink("/" + places[int(rng.integers(len(places)))])
        elif kind == 4:
            file.create_dataset(at, (2 ** int(rng.integers(20, 60)),), rng.choice(["f8", "i1"]), chunks=(4096,))
        elif kind == 5:
            file.create_dataset(at, (2**20,), "i8", chunks=(2**20,), compression="gzip", fillvalue=3)
        elif kind == 6:
            file[at] = np.array([[np.nan, np.inf], [-1e308, 1e308]])
        elif kind == 7:
            file[at] = np.array([b"\x80\x04", b"text"])
        elif kind == 8:
            file.create_dataset(at, (2,), h5py.string_dtype())[:] = ["a" * 1000, "\u2603"]
        elif kind == 9:
            file[at] = np.zeros(3, [("timestamp", "f8"), ("channel", "S3"), ("frameno", "O" if False else "c16")])
        elif kind == 10:
            file.create_group(at)
        else:
            file[at] = rng.integers(-(2**62), 2**62, 5)
        return bytes(_closed(file, buffer))


def _closed(file: h5py.File, buffer: io.BytesIO) -> bytes:
    file.close()
    return buffer.getvalue()


def _attributes(rng: np.random.Generator, node: h5py.Group | h5py.Dataset, mark: Path) -> None:
    for name in ("rate", "neurodata_type", "frames_per_second", "channel_count", "application", "resolution"):
        choice = int(rng.integers(4))
        node.attrs[name] = [2**62, -1.5, np.bytes_(pickle.dumps(Bomb(mark), 0)), np.zeros((3, 3))][choice]


def _pickled(rng: np.random.Generator, content: bytearray, mark: Path) -> bytes:
    buffer = io.BytesIO()
    bomb = np.array([Bomb(mark)], dtype=object)
    keys = ["spike_time_s", "spike_channel", "stimulus_time_s", "channel_label"]
    np.savez(buffer, **{key: bomb if rng.random() < 0.5 else np.zeros(1) for key in keys})
    return buffer.getvalue() if rng.random() < 0.7 else pickle.dumps(Bomb(mark))


def _bomb(rng: np.random.Generator, content: bytearray, mark: Path) -> bytes:
    """A small archive that unpacks to much."""
    buffer = io.BytesIO()
    if content[:2] == b"PK":
        np.savez_compressed(buffer, **{key: np.zeros(2**25) for key in ("spike_time_s", "spike_channel")},
                            stimulus_time_s=np.zeros(1))  # fmt: skip
        return buffer.getvalue()
    import gzip

    return gzip.compress(b"time_s,channel\n" + b"1,1\n" * 2 ** int(rng.integers(20, 25)), 1)


HDF5_WAYS: list[Callable[[np.random.Generator, bytearray, Path], bytes]] = [
    _cut, _flip, _flip, _flip_head, _overwrite, _overwrite, _insert, _rebuild, _rebuild, _rebuild,
]  # fmt: skip
OTHER_WAYS = [_cut, _flip, _flip, _flip_head, _overwrite, _overwrite, _insert, _pickled]
KINDS = ("nwb", "other-nwb", "maxwell", "old-maxwell", "cl1", "npz", "csv")


def main(kind: str, seed: int, count: int, folder: Path) -> None:
    """Damage and read."""
    path, mark = folder / f"{kind}.file", folder / "code_ran"
    sound(kind, path)
    inspect_recording(read_recording(path))
    content = path.read_bytes()
    ways = HDF5_WAYS if kind not in ("npz", "csv") else OTHER_WAYS
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (in_use + GIGABYTE, in_use + GIGABYTE))
    # The system's own answer to the alarm ends the process, also within a library.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    read = refused = 0
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        way = _bomb if kind in ("npz", "csv") and i % 200 == 199 else ways[int(rng.integers(len(ways)))]
        path.write_bytes(way(rng, bytearray(content), mark))
        (folder / "last").write_text(f"{kind} {seed} {i} {way.__name__}")
        signal.alarm(SECONDS)
        try:
            inspect_recording(read_recording(path))
            read += 1
        except AnimatError as error:
            refused += 1
            if "\n" in str(error) or not str(error):
                raise RuntimeError(f"not one line: {error!r}") from error
        signal.alarm(0)
        if mark.exists():
            raise RuntimeError("code of the file ran")
    # The process that reads HDF5 files counts once it has ended.
    end_reader()
    # This process's own peak: ru_maxrss would also count what the process that started it held before.
    own = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    peak = 1024 * max(int(own.split()[1]), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
    print(f"{kind}: {read} read, {refused} refused, peak {peak / 2**20:.0f} MiB")
    if peak > GIGABYTE:
        raise RuntimeError(f"{peak:,} bytes of memory")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
