"""The spontaneous activity of a bare tissue over hours, by the detector that real cultures are read with.

A network burst: the spikes of all neurons, in bins of 25 ms, pass four times their mean over ten minutes; stretches
less than 100 ms apart are one; at least 20 % of the active channels (above 0.02 Hz) take part. Written in plain NumPy,
apart from animat's own burst detection. Run it to print the table of the docs: `python tests/culture_hours.py 1 2 3`;
with `--under protocol` or `--under loop` the tissue is stimulated between the windows.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from animat.cultures.tissue import Tissue
from culture_figures import FREQUENCIES_HZ, PATTERNS, Rig

BIN_S, TIMES_MEAN, JOIN_S = 0.025, 4.0, 0.1
ACTIVE_HZ, LEAST_PARTICIPATION = 0.02, 0.2
WINDOW_MIN = 10
FIRST_MIN = (0, 10, 60, 140, 170)
LEADERS = 10


class Spontaneous(NamedTuple):
    """Ten minutes: bursts a minute, the variation of their intervals, their length, who takes part, who begins."""

    first_min: int
    rate_hz: float
    bursts_per_min: float
    interval_cv: float
    burst_ms: float
    participation: float
    participation_p10: float
    participation_p90: float
    led_share: float
    """Share of bursts that one of the ten most frequent leaders, of all channels, begins."""

    def missed(self) -> list[str]:
        """What is outside its bounds, in words."""
        bounds = {
            "1-10 bursts a minute": 1 <= self.bursts_per_min <= 10,
            "variation of intervals 0.3-1.5": 0.3 <= self.interval_cv <= 1.5,
            "150-800 ms": 150 <= self.burst_ms <= 800,
            "mean participation 0.5-0.9": 0.5 <= self.participation <= 0.9,
            "0.5-2 Hz per neuron": 0.5 <= self.rate_hz <= 2,
        }
        return [f"{name} at {self.first_min} min" for name, held in bounds.items() if not held]


def bursts_of(
    time_s: np.ndarray, neuron: np.ndarray, from_s: float, to_s: float, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Start and end of each burst in s, the share of active channels in it, and the channel that began it."""
    bins = round((to_s - from_s) / BIN_S)
    count = np.bincount(np.minimum(((time_s - from_s) / BIN_S).astype(int), bins - 1), minlength=bins)
    above = np.concatenate([[False], count > TIMES_MEAN * count.mean(), [False]]).astype(int)
    stretches: list[list[float]] = []
    for start, end in np.flatnonzero(np.diff(above)).reshape(-1, 2) * BIN_S + from_s:
        if stretches and start - stretches[-1][1] <= JOIN_S + 1e-9:
            stretches[-1][1] = end
        else:
            stretches.append([start, end])
    rates = np.bincount(neuron, minlength=seen.shape[1]) / (to_s - from_s)
    active = np.flatnonzero(seen @ rates > ACTIVE_HZ)
    rows = []
    for start, end in stretches:
        first, last = np.searchsorted(time_s, [start, end])
        fired = np.bincount(neuron[first:last], minlength=seen.shape[1])
        leads = np.flatnonzero(seen[:, neuron[first]]) if last > first else []
        rows.append((start, end, np.mean(seen[active] @ fired > 0), leads[0] if len(leads) else -1))
    table = np.array(rows).reshape(-1, 4)
    return tuple(table[table[:, 2] >= LEAST_PARTICIPATION].T)  # type: ignore[return-value]


def window(time_s: np.ndarray, neuron: np.ndarray, first_min: int, seen: np.ndarray) -> Spontaneous:
    """The figures of the ten minutes from `first_min`, of the spikes within them."""
    from_s, to_s = 60.0 * first_min, 60.0 * (first_min + WINDOW_MIN)
    start_s, end_s, share, leader = bursts_of(time_s, neuron, from_s, to_s, seen)
    rate_hz = len(neuron) / (to_s - from_s) / seen.shape[1]
    if len(start_s) < 3:
        nan = float("nan")
        return Spontaneous(first_min, rate_hz, len(start_s) / WINDOW_MIN, *6 * [nan])
    between_s = np.diff(start_s)
    leads = np.sort(np.unique(leader[leader >= 0], return_counts=True)[1])[::-1]
    return Spontaneous(
        first_min,
        rate_hz,
        len(start_s) / WINDOW_MIN,
        float(between_s.std() / between_s.mean()),
        float(1000 * np.mean(end_s - start_s)),
        float(share.mean()),
        *map(float, np.percentile(share, [10, 90])),
        float(leads[:LEADERS].sum() / leads.sum()),
    )


def over_hours(seed: int) -> list[Spontaneous]:
    """The figures of a tissue that nothing stimulates; what lies between the windows is rested."""
    seen = Rig(seed).seen
    tissue, rows = Tissue(seed), []
    for minute in FIRST_MIN:
        tissue.rest(60.0 * minute - tissue.now_s)
        spikes = [tissue.advance(60.0) for _ in range(WINDOW_MIN)]
        rows.append(window(*(np.concatenate(column) for column in zip(*spikes, strict=True)), minute, seen))
    return rows


def under_protocol(seed: int) -> list[Spontaneous]:
    """The same with the paper's protocol, a recording every ten minutes for 140; each window follows a recording."""
    rig, rows = Rig(seed), []
    for minute in range(0, 141, 10):
        rig.tissue.rest(max(0.0, 60.0 * minute - rig.tissue.now_s))
        rig.blocked()
        if minute in (10, 60, 140):
            rows.append(_after(rig))
    return rows


def under_loop(seed: int, loop_min: float = 40.0) -> list[Spontaneous]:
    """The same after a loop of 40 min: episodes of 70 presentations, conditions and patterns at random, 2 s between."""
    rig = Rig(seed)
    tissue, until_s = rig.tissue, rig.tissue.now_s + 60.0 * loop_min
    while tissue.now_s < until_s:
        tissue.rest(2.0)
        times_s = tissue.now_s + np.cumsum(1 / rig.rng.choice(FREQUENCIES_HZ, 70))
        pulses = [rig.pulse(float(time_s), int(rig.rng.integers(PATTERNS))) for time_s in times_s]
        tissue.advance(times_s[-1] - tissue.now_s + 0.05, pulses)
    return [_after(rig)]


def _after(rig: Rig) -> Spontaneous:
    """The ten minutes that begin now."""
    from_s = rig.tissue.now_s
    spikes = [rig.tissue.advance(60.0) for _ in range(WINDOW_MIN)]
    time_s, neuron = (np.concatenate(column) for column in zip(*spikes, strict=True))
    found = window(time_s - from_s, neuron, 0, rig.seen)
    return found._replace(first_min=round(from_s / 60.0))


def main(seeds: list[int], measure: Callable[[int], list[Spontaneous]]) -> None:
    """Print the table of the docs."""
    names = "seed, from min, Hz per neuron, bursts a minute, variation of intervals, ms"
    columns = [*names.split(", "), "participation (10th-90th percentile)", "begun by ten channels", "missed"]
    print(f"| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    for seed in seeds:
        for row in measure(seed):
            spread = f"{row.participation:.2f} ({row.participation_p10:.2f}-{row.participation_p90:.2f})"
            bursts = f"{row.bursts_per_min:.1f} | {row.interval_cv:.2f} | {row.burst_ms:.0f} | {spread}"
            missed = "; ".join(row.missed()) or "none"
            print(
                f"| {seed} | {row.first_min} | {row.rate_hz:.2f} | {bursts} | {row.led_share:.2f} | {missed} |",
                flush=True,
            )


if __name__ == "__main__":
    asked = argparse.ArgumentParser()
    asked.add_argument("seeds", nargs="*", type=int, default=[1, 2, 3, 4, 5])
    asked.add_argument("--under", choices=["nothing", "protocol", "loop"], default="nothing")
    given = asked.parse_args()
    main(given.seeds, {"nothing": over_hours, "protocol": under_protocol, "loop": under_loop}[given.under])
