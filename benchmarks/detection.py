"""How fast spikes are detected in raw traces relative to real time, compared with SpikeInterface in the same run.

    python benchmarks/detection.py [--channels 1024] [--seconds 20] [--stimuli-hz 0] [--json results.json]

The traces are synthetic: noise of 5 uV with spikes of 60 uV at known times, 16-bit integers at 20 kHz, in an HDF5 file
as a rig writes it, so that reading counts. Each row is a separate process on all cores; its memory is the peak resident
memory of the process and its children. With `--stimuli-hz`, ours removes artefacts around that many stimuli per second,
and spikes in blanked intervals are lost; SpikeInterface is not informed of stimuli. Reading and detection count,
importing does not. Processor time is reported as well as wall-clock time, as other programs on the machine affect it
less: with c cores, c / (processor seconds per second of traces) is the highest real-time factor. SpikeInterface is
optional (`animat[raw]`).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

RATE_HZ = 20_000.0
STEP_UV = 0.5
SPIKES_PER_S = 5.0
ENGINES = ("animat", "spikeinterface")


def write_traces(path: Path, channels: int, seconds: float) -> None:
    """Traces (samples, channels) and the true spikes of each channel, made second by second to save memory."""
    rng = np.random.default_rng(1)
    shape = -60 / STEP_UV * np.exp(-((np.arange(-20, 41) / 3.0) ** 2) / 2)
    samples = round(seconds * RATE_HZ)
    with h5py.File(path, "w") as file:
        raw = file.create_dataset("raw", (samples, channels), "i2", chunks=(500, channels))
        truth_sample, truth_channel = [], []
        for start in range(0, samples, round(RATE_HZ)):
            stop = min(start + round(RATE_HZ), samples)
            piece = rng.normal(0, 5 / STEP_UV, (stop - start, channels)).astype(np.float32)
            for channel in range(channels):
                # No two within 3 ms, and none at the ends of the second.
                at = 100 + np.cumsum(60 + rng.exponential(RATE_HZ / SPIKES_PER_S - 60, 20).astype(int))
                at = at[at < stop - start - 100]
                for sample in at:
                    piece[sample - 20 : sample + 41, channel] += shape
                truth_sample.append(start + at)
                truth_channel.append(np.full(len(at), channel))
            raw[start:stop] = np.rint(piece)
        file["truth/sample"] = np.concatenate(truth_sample)
        file["truth/channel"] = np.concatenate(truth_channel)


def measure(engine: str, path: Path, stimuli_hz: float) -> dict[str, float]:
    """One row, in this process."""
    from animat.recordings.detection.spikes import detect_spikes
    from animat.recordings.raw import RawTraces, in_microvolts
    from animat.recordings.recording import Channels

    with h5py.File(path, "r") as file:
        samples, n = file["raw"].shape
        truth = set(zip(file["truth/sample"][:].tolist(), file["truth/channel"][:].tolist(), strict=True))
    table = Channels(np.arange(n).astype(str), np.arange(n), np.arange(n) % 220 * 17.5, np.arange(n) // 220 * 17.5)

    def read_uv(start: int, stop: int) -> np.ndarray:
        with h5py.File(path, "r") as file:
            return in_microvolts(file["raw"][start:stop], STEP_UV)

    traces = RawTraces(read_uv, table, samples, RATE_HZ)
    if engine == "spikeinterface":
        import spikeinterface.sortingcomponents.peak_detection  # noqa: F401
    began, began_processor = time.perf_counter(), time.process_time()
    if engine == "spikeinterface":
        sample, channel = by_spikeinterface(path, n)
    else:
        pulses_s = np.arange(0.05, samples / RATE_HZ, 1 / stimuli_hz) if stimuli_hz > 0 else None
        found = detect_spikes(traces, pulses_s)
        sample, channel = np.rint(found.time_s * RATE_HZ).astype(int), found.channel
    took_s, processor_s = time.perf_counter() - began, time.process_time() - began_processor
    spikes = {(s + d, c) for s, c in zip(sample.tolist(), channel.tolist(), strict=True) for d in (-1, 0, 1)}
    return {
        "times_real_time": samples / RATE_HZ / took_s,
        "processor_s_per_s": processor_s / (samples / RATE_HZ),
        "memory_gib": sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        / 2**20,
        "found": len(truth & spikes),
        "true": len(truth),
        "detected": len(sample),
    }


def by_spikeinterface(path: Path, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """SpikeInterface's noise estimate, filter and detection with default settings, on the same samples in memory."""
    import spikeinterface.core as core
    import spikeinterface.preprocessing as preprocessing
    from spikeinterface.sortingcomponents.peak_detection import detect_peaks

    with h5py.File(path, "r") as file:
        recording = core.NumpyRecording([file["raw"][:]], RATE_HZ)
    recording.set_dummy_probe_from_locations(np.column_stack([np.arange(channels) * 1e3, np.zeros(channels)]))
    recording.set_channel_gains(STEP_UV)
    recording.set_channel_offsets(0.0)
    filtered = preprocessing.bandpass_filter(recording, freq_min=100, freq_max=3000, dtype="float32")
    peaks = detect_peaks(
        filtered,
        method="by_channel",
        method_kwargs={"peak_sign": "neg", "detect_threshold": 5, "exclude_sweep_ms": 1.0},
        job_kwargs={
            "n_jobs": len(os.sched_getaffinity(0)),
            "pool_engine": "thread",
            "chunk_duration": "0.5s",
            "progress_bar": False,
        },
    )
    return peaks["sample_index"], peaks["channel_index"]


def main() -> None:
    """Measure and print."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else None)
    arguments.add_argument("--channels", type=int, default=1024)
    arguments.add_argument("--seconds", type=float, default=20.0, help="of traces")
    arguments.add_argument("--stimuli-hz", type=float, default=0.0, help="stimuli around which artefacts are removed")
    arguments.add_argument("--json", type=Path, help="write all measurements to a file")
    arguments.add_argument("--measure", help=argparse.SUPPRESS)
    arguments.add_argument("--path", type=Path, help=argparse.SUPPRESS)
    options = arguments.parse_args()
    if options.measure:
        print(json.dumps(measure(options.measure, options.path, options.stimuli_hz)))
        return
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "traces.h5"
        write_traces(path, options.channels, options.seconds)
        print(f"{options.channels} channels x {options.seconds:g} s at 20 kHz on {len(os.sched_getaffinity(0))} cores")
        for engine in ENGINES:
            if engine == "spikeinterface" and importlib.util.find_spec("spikeinterface") is None:
                print(f"{engine}: not installed")
                continue
            command = [sys.executable, __file__, "--measure", engine, "--path", str(path)]
            command += ["--stimuli-hz", str(options.stimuli_hz)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            row = rows[engine] = json.loads(done.stdout.splitlines()[-1])
            print(
                f"{engine}: {row['times_real_time']:.2f} times real time ({row['processor_s_per_s']:.2f} s of "
                f"processor time per second), {row['memory_gib']:.2f} GiB; "
                f"{row['found']:,} of {row['true']:,} true spikes found, {row['detected']:,} detected"
            )
    if len(rows) == 2:
        ratio = rows["animat"]["times_real_time"] / rows["spikeinterface"]["times_real_time"]
        print(f"animat against SpikeInterface: {ratio:.2f} times as fast")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
