"""The virtual culture's figures as animat itself records and reads them: scan, chosen electrodes, protocol, responses.

`culture_figures.py` measures the bare tissue and trusts nothing of the recorder; this is the other end: what a user's
recordings hold. Run it to print the table of the docs: `python tests/recorded_figures.py 1 2 3 4 5`.
"""

from __future__ import annotations

import dataclasses
import sys

import numpy as np

from animat.cultures.observed import Spikes
from animat.cultures.tissue import TissueParameters
from animat.cultures.virtual import VirtualCulture
from animat.responses.extraction import extract_responses
from animat.responses.responses import Responses
from animat.stimulation.protocol import PAPER, Protocol
from animat.stimulation.selection import Selection

PRESENTED = {
    "blocked, 1 pulse": PAPER,
    "mixed, 1 pulse": Protocol(order="mixed", pulses=1),
    "mixed, 5 pulses": Protocol(order="mixed", pulses=5),
}
REPEATED = 6
SPONTANEOUS_S = 120.0


@dataclasses.dataclass
class Recorded:
    """The figures of one seed; lists are over the five frequencies."""

    seed: int
    channels: int
    rate_hz: float
    bursts_per_min: float
    burst_ms: float
    medians_hz: list[float]
    separability: float
    smallest_share: float
    right_short: float
    """How far the distribution at 80 Hz falls short of lying right of that at 5 Hz, at the worst bin edge; 0 if not."""
    one_pattern_ratio: float
    without_nmda_ratio: float
    large_left: float
    burst_share_start: float
    burst_share_end: float
    over_median: dict[str, list[float]]

    @property
    def ratio(self) -> float:
        return self.medians_hz[-1] / self.medians_hz[0]

    def missed(self) -> list[str]:
        """What is outside its bound."""
        held = {
            "rate 0.3-4 Hz": 0.3 <= self.rate_hz <= 4,
            "2-15 network bursts a minute of 100-800 ms": 2 <= self.bursts_per_min <= 15,
            "80/5 ratio 1.6-3": 1.6 <= self.ratio <= 3,
            "separability above 0.6": self.separability > 0.6,
            "non-burst share 0.9 or more": self.smallest_share >= 0.9,
            "80 Hz right of 5 Hz at every edge": self.right_short == 0,
            "one pattern repeated under 0.8": self.one_pattern_ratio < 0.8,
            "NMDA off under 1.1": self.without_nmda_ratio < 1.1,
            "P(x > 18 Hz) left at most 0.4": self.large_left <= 0.4,
            "burst share falls": self.burst_share_end < self.burst_share_start,
        }
        return [name for name, holds in held.items() if not holds]


def network_bursts_ms(spikes: Spikes, channels: int) -> np.ndarray:
    """Durations of network bursts of 100-800 ms: the rate per channel, smoothed over 30 ms, leaves 2.5 times its median
    (and 3 Hz) and passes 8 times it (and 8 Hz) before it is back."""
    rate_hz = np.histogram(spikes.time_s, np.arange(0, SPONTANEOUS_S + 1e-9, 0.01))[0] / (0.01 * channels)
    rate_hz = np.convolve(rate_hz, np.ones(3) / 3, "same")
    usual_hz = np.median(rate_hz)
    raised = np.concatenate([[False], rate_hz > max(2.5 * usual_hz, 3.0), [False]])
    edges = np.flatnonzero(np.diff(raised.astype(int))).reshape(-1, 2)
    durations_ms = [10.0 * (b - a) for a, b in edges if rate_hz[a:b].max() > max(8 * usual_hz, 8.0)]
    return np.array([ms for ms in durations_ms if 100 <= ms <= 800])


def medians(responses: Responses) -> list[float]:
    return [float(np.median(responses.rates_of(i))) for i in range(len(responses.conditions))]


def measure(seed: int, recordings: int = 15) -> Recorded:
    """All figures of one seed; about 1,800 s of culture, and the ten minutes from one recording to the next."""
    with VirtualCulture(seed) as culture:
        selection = culture.selection
        spontaneous = culture.advance(SPONTANEOUS_S)
        rate_hz = len(spontaneous.time_s) / SPONTANEOUS_S / len(culture.channels)
        bursts_ms = network_bursts_ms(spontaneous, len(culture.channels))
        began_s, series = culture.now_s, []
        for session in range(recordings):
            culture.rest(max(0.0, began_s + 600 * session - culture.now_s))
            series.append(extract_responses(culture.record(PAPER, session)))
    first = series[0]

    def fresh(selection: Selection, protocol: Protocol, parameters: TissueParameters | None = None) -> Responses:
        with VirtualCulture(seed, selection=selection, parameters=parameters) as culture:
            # The threshold of the whole recording: a guard's own responses need not hold two classes.
            return extract_responses(culture.record(protocol, 0), burst_threshold=first.threshold)

    repeated = []
    for row in range(REPEATED):
        one = dataclasses.replace(selection, patterns=selection.patterns[row : row + 1])
        repeated.append(medians(fresh(one, Protocol((5.0, 80.0), patterns=1))))
    slow_hz, fast_hz = np.mean(repeated, axis=0)
    blocked = medians(fresh(selection, PAPER, dataclasses.replace(TissueParameters(), nmda_ratio=0.0)))
    over_median = {"blocked, 1 pulse": first.shares_above_median().tolist()}
    for name in ("mixed, 1 pulse", "mixed, 5 pulses"):
        with VirtualCulture(seed, selection=selection) as culture:
            over_median[name] = extract_responses(culture.record(PRESENTED[name], 0)).shares_above_median().tolist()

    top_hz = np.ceil(first.non_burst_rate_hz.max() / 10) * 10
    slow, fast = first.rates_of(0), first.rates_of(4)
    large = [float(np.mean(r.non_burst_rate_hz > 18.0)) for r in series]
    bursts = [float(np.mean(r.is_burst)) for r in series]
    shares = [np.mean(~first.is_burst[first.condition == i]) for i in range(5)]
    return Recorded(
        seed=seed,
        channels=first.n_channels,
        rate_hz=rate_hz,
        bursts_per_min=len(bursts_ms) * 60 / SPONTANEOUS_S,
        burst_ms=float(bursts_ms.mean()) if len(bursts_ms) else float("nan"),
        medians_hz=medians(first),
        separability=first.separability,
        smallest_share=float(min(shares)),
        right_short=max(0.0, *(float(np.mean(slow > e) - np.mean(fast > e)) for e in np.linspace(0, top_hz, 21))),
        one_pattern_ratio=float(fast_hz / slow_hz),
        without_nmda_ratio=blocked[4] / blocked[0],
        large_left=large[-1] / large[0],
        burst_share_start=float(np.mean(bursts[:3])),
        burst_share_end=float(np.mean(bursts[-3:])),
        over_median=over_median,
    )


def main(seeds: list[int]) -> None:
    """Print the tables of the docs."""
    rows = []
    for seed in seeds:
        rows.append(measure(seed))
        print(seed, rows[-1], file=sys.stderr, flush=True)

    def line(name: str, bound: str, values: list[str]) -> None:
        print(f"| {name} | {bound} | {' | '.join(values)} |")

    line("figure", "bound", [f"seed {r.seed}" for r in rows])
    print("|---" * (2 + len(rows)) + "|")
    line("channels", "at most 1,024", [f"{r.channels}" for r in rows])
    line("spontaneous rate, Hz per channel", "0.3-4", [f"{r.rate_hz:.2f}" for r in rows])
    line("network bursts a minute (100-800 ms)", "2-15", [f"{r.bursts_per_min:.1f}" for r in rows])
    line("their mean duration, ms", "100-800", [f"{r.burst_ms:.0f}" for r in rows])
    hz = [" ".join(f"{x:.1f}" for x in r.medians_hz) for r in rows]
    line("medians at 5, 10, 20, 40, 80 Hz", "seed means rise", hz)
    line("80/5 ratio", "1.6-3", [f"{r.ratio:.2f}" for r in rows])
    line(
        "80 Hz right of 5 Hz at every edge",
        "yes",
        [f"no, by {r.right_short:.2f}" if r.right_short else "yes" for r in rows],
    )
    line("separability", "> 0.6", [f"{r.separability:.2f}" for r in rows])
    line("smallest non-burst share", "0.9 or more", [f"{r.smallest_share:.2f}" for r in rows])
    line("one pattern repeated: 80/5", "< 0.8", [f"{r.one_pattern_ratio:.2f}" for r in rows])
    line("NMDA off: 80/5", "< 1.1", [f"{r.without_nmda_ratio:.2f}" for r in rows])
    line("P(x > 18 Hz) at 140 min over 0 min", "0.4 or less", [f"{r.large_left:.2f}" for r in rows])
    bursts = [f"{r.burst_share_start:.3f} to {r.burst_share_end:.3f}" for r in rows]
    line("burst share, first and last three recordings", "falls", bursts)
    line("missed", "none", ["; ".join(r.missed()) or "none" for r in rows])
    print("\n| P(x >= P50) at 5, 10, 20, 40, 80 Hz | " + " | ".join(f"seed {r.seed}" for r in rows) + " |")
    print("|---" * (1 + len(rows)) + "|")
    for name in PRESENTED:
        print(f"| {name} | " + " | ".join(" ".join(f"{x:.2f}" for x in r.over_median[name]) for r in rows) + " |")


if __name__ == "__main__":
    main([int(seed) for seed in sys.argv[1:]] or [1, 2, 3, 4, 5])
