"""What thresholds that are off cost on the cartpole, and how far the simulators of two recordings of a culture agree.

    python benchmarks/reality_gap.py --ways default --robots cartpole --seeds 1 2 3 4 5 6 7 8 9 10 --out gap/
    python benchmarks/lagging_thresholds.py gap/culture*/default

For a whole episode all ranks of the thresholds are off by the same error, drawn from a normal distribution.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import ndtri

from animat import Animat, extract_series, fit_timeline, load_policies, read_recordings
from animat.evaluation.rollouts import networks_of, roll_out

DEVIATIONS = (0.0, 0.02, 0.03, 0.04, 0.05)
_QUANTILES = ndtri((np.arange(11) + 0.5) / 11)
ERRORS = _QUANTILES / _QUANTILES.std()
"""Equally likely values of a normal error with a standard deviation of 1."""


def returns_of(culture: Path) -> list[float]:
    """Mean returns on the last simulator for each standard deviation of the error, then that on the first one."""
    policies = load_policies(culture / "cartpole" / "policies")
    first, timeline = next(iter(policies.values())), fit_timeline(extract_series(read_recordings(culture)))
    environment = Animat(first.robot, first.mapping, len(timeline.conditions))
    networks = networks_of(list(policies.values()), greedy=True)

    def returned(row: int, error: float) -> float:
        simulator, rates_hz = timeline.at(timeline.start_min[row]), timeline.responses[row].non_burst_rate_hz
        off_hz = np.quantile(rates_hz, np.clip(np.arange(11) / 10 + error, 0, 1)).astype(np.float32)
        moved = replace(simulator, percentiles=off_hz)
        return float(roll_out(environment, moved, networks, episodes=100, seed=1).returns.mean())

    return [
        *(float(np.mean([returned(-1, error) for error in np.unique(each * ERRORS)])) for each in DEVIATIONS),
        returned(0, 0.0),
    ]


if __name__ == "__main__":
    print("| culture | " + " | ".join(map(str, DEVIATIONS)) + " | the first recording |\n" + "|---" * 7 + "|")
    found = []
    for folder in sys.argv[1:]:
        found.append(returns_of(Path(folder)))
        print(f"| {folder} | " + " | ".join(f"{value:.1f}" for value in found[-1]) + " |", flush=True)
    print("| mean | " + " | ".join(f"{value:.1f}" for value in np.mean(found, axis=0)) + " |")
    apart = np.array(found)[:, 0] - np.array(found)[:, -1]
    print(f"\nroot mean square of the difference between the two recordings: {np.sqrt(np.mean(apart**2)):.1f}")
