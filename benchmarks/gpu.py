"""How fast a GPU trains many policies at once, compared with one core and all cores of the same machine.

    python benchmarks/gpu.py --recordings recordings/ [--policies 4 20 100 400 1000]

Cartpole with nine thresholds on the first recording, as `animat train` runs it. Every measurement is a separate
process; those on cores train five policies and are pinned before JAX is imported.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
from typing import Any

from training import finish

ITERATIONS = 400_000
POLICIES_A_CORE = 5
CHUNKS = 8
"""Sixtieths of a training run that are timed: seconds, in which all cores work at the same time."""


def main() -> None:
    """Measure the cores, then each number of policies in turn, and print the table."""
    parser = argparse.ArgumentParser(
        description="How fast a GPU trains many policies, compared with this machine's cores."
    )
    parser.add_argument("--recordings", required=True)
    parser.add_argument("--policies", type=int, nargs="+", default=[4, 20, 100, 400, 1000])
    parser.add_argument("--measure", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--core", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        if options.core is not None:
            os.sched_setaffinity(0, {options.core})
        print(json.dumps(measured(options.recordings, options.measure)))
        return
    if finish(started(options.recordings, 1))["device"] == "cpu":
        sys.exit("gpu.py: JAX finds no GPU here")
    cores = sorted(os.sched_getaffinity(0))
    one = finish(started(options.recordings, POLICIES_A_CORE, cores[0]))
    running = [started(options.recordings, POLICIES_A_CORE, core) for core in cores]
    together = [finish(each) for each in running]
    one_per_s, all_per_s = one["iterations_per_s"], sum(each["iterations_per_s"] for each in together)
    print(f"one core: {one_per_s:,.0f} iterations per second; {len(cores)} cores: {all_per_s:,.0f}\n")
    print(
        "| policies | iterations per second | times one core | times all cores | ms per round | compiling, s | hash |"
    )
    print("|---" * 7 + "|")
    for policies in options.policies:
        at_once = finish(started(options.recordings, policies))
        per_s = at_once["iterations_per_s"]
        row = (f"{per_s:,.0f}", f"{per_s / one_per_s:.1f}", f"{per_s / all_per_s:.1f}", f"{at_once['round_ms']:.2f}")
        print("|", policies, "|", " | ".join((*row, f"{at_once['first_s']:.1f}", at_once["bits"])), "|", flush=True)
    print(f"\n{at_once['device']}, {at_once['versions']}")


def started(recordings: str, policies: int, core: int | None = None) -> subprocess.Popen[str]:
    """Run a measurement in a separate process: on a core, or on the device that JAX finds."""
    command = [sys.executable, __file__, "--recordings", recordings, "--measure", str(policies)]
    command += [] if core is None else ["--core", str(core)]
    environment = os.environ | ({} if core is None else {"JAX_PLATFORMS": "cpu"})
    return subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True)


def measured(recordings: str, policies: int) -> dict[str, Any]:
    """Seconds of the first chunk, which compiles, and of later ones; and a hash of all networks at the end."""
    import jax
    import numpy as np

    from animat.neurons.timeline import fit_timeline
    from animat.recordings.reading import read_sources
    from animat.responses.extraction import extract_series
    from animat.training.group import Group, SideBySide
    from animat.training.specification import Training

    timeline = fit_timeline(extract_series(read_sources([recordings])))
    training = Training("cartpole", "9-thresholds", policies=policies, iterations=ITERATIONS)
    together = SideBySide(Group(training, tuple(range(policies)), timeline, "", {}))
    simulator, times = timeline.at(float(timeline.start_min[0])), [time.perf_counter()]
    for chunk in range(1 + CHUNKS):
        together.train(chunk, simulator)
        times.append(time.perf_counter())
    networks = [each for policy in together.policies() for each in (*policy.weights, *policy.biases)]
    rounds, seconds = training.chunk(CHUNKS)[1] - training.chunk(0)[1], times[-1] - times[1]
    return {
        "device": jax.devices()[0].device_kind,
        "versions": f"jax {jax.__version__}, numpy {np.__version__}",
        "first_s": times[1] - times[0],
        "round_ms": 1e3 * seconds / rounds,
        "iterations_per_s": policies * training.algorithm.environments * rounds / seconds,
        "bits": hashlib.sha256(b"".join(each.tobytes() for each in networks)).hexdigest()[:12],
    }


if __name__ == "__main__":
    main()
