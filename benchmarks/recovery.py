"""How the virtual culture's responses fall in 12 s of uninterrupted 80 Hz, and recover in a pause after it.

python benchmarks/recovery.py 1 2 3 4 5     # cultures; a minute each at most
"""

from __future__ import annotations

import sys

import numpy as np

from animat import Protocol, VirtualCulture, extract_responses

PAUSES_S = (10.0, 30.0, 100.0)


def rates_hz(culture: VirtualCulture, duration_s: float, seed: int) -> np.ndarray:
    """Responses to consecutive pulses on random patterns at 80 Hz."""
    protocol = Protocol((80.0,), trials=round(80 * duration_s), setup_s=0.0, pause_s=0.0)
    return extract_responses(culture.record(protocol, seed=seed), burst_threshold=1.0).rate_hz


if __name__ == "__main__":
    print("| culture | first 2 s | last 2 s |" + "".join(f" 2 s after {each:g} s |" for each in PAUSES_S))
    print("|---" * (3 + len(PAUSES_S)) + "|")
    for number in map(int, sys.argv[1:]):
        medians = []
        for pause_s in PAUSES_S:
            with VirtualCulture(number) as virtual:
                tiring = rates_hz(virtual, 12.0, 1)
                virtual.rest(pause_s)
                medians.append(np.median(rates_hz(virtual, 2.0, 2)))
        cells = (f"{hz:.1f}" for hz in (np.median(tiring[:160]), np.median(tiring[-160:]), *medians))
        print(f"| {number} | " + " | ".join(cells) + " |", flush=True)
