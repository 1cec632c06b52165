"""How fast the virtual culture's tissue runs relative to real time, with Brian2 in the same run.

    python benchmarks/culture.py [--seconds 20] [--repeats 3] [--pairs 60]

Pin it to one core. Brian2 2.9 needs NumPy below 2.4, so install it with animat in a separate environment for the
comparison. If it is missing, the benchmark says so and measures the rest.
"""

from __future__ import annotations

import argparse
import gc
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from animat.cultures.tissue import Pulse, Tissue, TissueParameters
from animat.cultures.virtual import VirtualCulture

Living = TypeVar("Living", Tissue, VirtualCulture)

PIECE_S = 0.0125
PAIR_S = 2.0
COLD = "from animat.cultures.tissue import Tissue; Tissue(1).advance(0.001)"


def real_time_factor(run: Callable[[float], None], culture_s: float, repeats: int) -> tuple[float, float]:
    """Culture seconds per second of processor time, and per wall-clock second: the medians of several runs.

    The two differ if other programs share the core.
    """
    processor, wall = [], []
    for _ in range(repeats):
        began, began_wall = time.process_time(), time.perf_counter()
        run(culture_s)
        processor.append(culture_s / (time.process_time() - began))
        wall.append(culture_s / (time.perf_counter() - began_wall))
    return statistics.median(processor), statistics.median(wall)


def piece_us(living: Living, pairs: int) -> tuple[float, float]:
    """The cost of a piece of 12.5 ms, and of a longer piece per same time, in us of processor time.

    Two seconds are simulated in one piece and two in pieces, in turns; each figure is the median of all turns.
    """
    pieces = round(PAIR_S / PIECE_S)
    took_s: dict[int, list[float]] = {1: [], pieces: []}
    for _ in range(pairs):
        for number in took_s:
            gc.collect()
            gc.disable()
            began = time.process_time()
            for _ in range(number):
                living.advance(PAIR_S / number)
            took_s[number].append(time.process_time() - began)
            gc.enable()
    return 1e6 * statistics.median(took_s[pieces]) / pieces, 1e6 * statistics.median(took_s[1]) / pieces


def compare_pieces(name: str, living: Living, pairs: int) -> None:
    """Print the cost of cutting time into pieces."""
    piece, whole = piece_us(living, pairs)
    print(
        f"{name}: a piece of 12.5 ms takes {piece:.1f} us ({PIECE_S * 1e6 / piece:.0f} times real time), as part of a "
        f"longer one {whole:.1f} us: {piece - whole:.1f} us more, {100 * (piece / whole - 1):.1f} %"
    )


def cold_start_s() -> tuple[float, float]:
    """The first step of a new process without, then with, the compiled kernel in the cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"NUMBA_CACHE_DIR": folder}
        seconds = []
        for _ in range(2):
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", COLD], check=True, env=environment)
            seconds.append(time.perf_counter() - began)
    return seconds[0], seconds[1]


def stimulated(tissue: Tissue, frequency_hz: float) -> Callable[[float], None]:
    """Pieces of 12.5 ms with patterns of five electrodes out of 32, one every 1/f, as a closed loop delivers them."""
    rng = np.random.default_rng(1)
    site = np.flatnonzero(tissue.is_excitatory)[:32]
    x_um, y_um = tissue.x_um[site], tissue.y_um[site]

    def run(culture_s: float) -> None:
        every = round(1 / frequency_hz / PIECE_S)
        for piece in range(round(culture_s / PIECE_S)):
            pulses = []
            if piece % every == 0:
                chosen = rng.choice(32, 5, replace=False)
                pulses = [Pulse(tissue.now_s, x_um[chosen], y_um[chosen])]
            tissue.advance(PIECE_S, pulses)

    return run


def brian2_runs(seconds: float) -> list[tuple[str, float]] | None:
    """Brian2's real-time factor in one piece and in pieces of 12.5 ms, compiled; None if it is not installed."""
    try:
        import brian2  # type: ignore[import-not-found]
    except ImportError:
        return None
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from brian2_tissue import Brian2Tissue  # type: ignore[import-not-found]

    brian2.BrianLogger.log_level_error()
    tissue = Tissue(1)
    reference = Brian2Tissue(
        tissue.parameters,
        tissue._network,
        tissue._wiring.needed,
        tissue._state.v_mv.astype(float),
        tissue._state.drive_mv.astype(float),
        noise=True,
        target="cython",
        at_spikes=True,
    )
    reference.run(200.0)

    def in_pieces(culture_s: float) -> None:
        for _ in range(round(culture_s / PIECE_S)):
            reference.run(1000 * PIECE_S)

    whole, _ = real_time_factor(lambda s: void(reference.run(1000 * s)), seconds, 1)
    pieces, _ = real_time_factor(in_pieces, 20 * PIECE_S, 1)
    return [("in one piece", whole), ("in pieces of 12.5 ms", pieces)]


def void(_: object) -> None:
    """Discard a run's results."""


def main() -> None:
    """Measure and print."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else None)
    arguments.add_argument("--seconds", type=float, default=20.0, help="seconds of culture per run")
    arguments.add_argument("--repeats", type=int, default=3)
    arguments.add_argument("--pairs", type=int, default=60, help="turns in which one piece is compared with many")
    options = arguments.parse_args()

    def in_pieces(culture_s: float) -> None:
        for _ in range(round(culture_s / PIECE_S)):
            tissue.advance(PIECE_S)

    tissue = Tissue(1)
    tissue.advance(1.0)
    parameters = TissueParameters()
    print(f"{parameters.neurons} neurons, {len(tissue._network.target)} synapses, steps of {parameters.step_ms} ms")
    ours = {}
    for name, run in (
        ("in one piece", lambda s: void(tissue.advance(s))),
        ("in pieces of 12.5 ms", in_pieces),
        ("in pieces of 12.5 ms, stimulated at 80 Hz", stimulated(tissue, 80.0)),
    ):
        ours[name], wall = real_time_factor(run, options.seconds, options.repeats)
        print(f"animat, {name}: {ours[name]:.0f} times real time in processor time ({wall:.0f} on the wall)")
    compare_pieces("the tissue", tissue, options.pairs)
    with VirtualCulture(1) as culture:
        compare_pieces(f"the culture with its {len(culture.channels)} channels", culture, options.pairs)
    reference = brian2_runs(options.seconds / 4)
    if reference is None:
        print("Brian2 is not installed here: no ratio")
    for name, factor in reference or []:
        faster = ours[name] / factor
        print(f"Brian2, {name}: {factor:.2f} times real time in processor time; animat is {faster:.0f} times as fast")
    first_s, second_s = cold_start_s()
    print(f"A new process to its first step: {first_s:.1f} s when it compiles, {second_s:.1f} s from the cache")


if __name__ == "__main__":
    main()
