"""The figures that the virtual culture must hold, measured on a bare tissue, seed by seed.

An independent reading of the method: electrodes, patterns, protocols, responses and burst separation are written here
anew, in plain NumPy, so that neither the recorder nor the responses of animat are trusted. Run it to print the table of
the docs: `python tests/culture_figures.py 1 2 3 4 5`. With `--often` each culture is recorded ten times from its
beginning, as its activity comes out otherwise each time.
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import numpy as np

from animat.cultures.tissue import Pulse, Spikes, Tissue, TissueParameters

FREQUENCIES_HZ = (5, 10, 20, 40, 80)
PITCH_UM, COLUMNS, ROWS = 17.5, 220, 120
CHANNELS, SITES, PATTERNS, PER_PATTERN = 1024, 32, 100, 5
SEEN_UM, APART_UM = 25.0, 100.0
WINDOW_S = (0.002, 0.010)
RECORDINGS, INTERVAL_S = 15, 600.0
SET_UP_S = 16.0
REPEATED = 6
OFTEN = 10
"""Realisations of a culture's beginning, each with a recording of its own."""

Responses = dict[int, tuple[np.ndarray, np.ndarray]]
"""Of each frequency: firing rate per channel in Hz, and the ratio of active channels, of each stimulus."""


class Rig:
    """A tissue with electrodes: 1,024 channels at the most active neurons, 32 sites near excitatory ones."""

    def __init__(self, seed: int, parameters: TissueParameters | None = None, spontaneous_s: float = 120.0) -> None:
        self.tissue = tissue = Tissue(seed, parameters)
        self.rng = rng = np.random.default_rng([seed, 1000])
        x_um, y_um = tissue.x_um, tissue.y_um
        tissue.advance(5.0)
        self.spontaneous_from_s, self.spontaneous_s = tissue.now_s, spontaneous_s
        self.spontaneous = tissue.advance(spontaneous_s)
        self.neuron_rate_hz = np.bincount(self.spontaneous.neuron, minlength=len(x_um)) / spontaneous_s

        column = np.clip(np.floor(x_um / PITCH_UM), 0, COLUMNS - 1)
        row = np.clip(np.floor(y_um / PITCH_UM), 0, ROWS - 1)
        electrodes = np.unique((np.stack([column, row], axis=1) + 0.5) * PITCH_UM, axis=0)
        distance_um = np.hypot(electrodes[:, :1] - x_um, electrodes[:, 1:] - y_um)
        seen = distance_um <= SEEN_UM
        chosen = np.argsort(-(seen @ self.neuron_rate_hz), kind="stable")[:CHANNELS]
        self.seen = seen[chosen].astype(np.float32)
        self.channel_rate_hz = self.seen @ self.neuron_rate_hz
        nearest_e_um = np.where(tissue.is_excitatory, distance_um[chosen], np.inf).min(axis=1)
        self.sites = electrodes[chosen][rng.choice(np.flatnonzero(nearest_e_um < 15.0), SITES, replace=False)]
        self.patterns: list[tuple[int, ...]] = []
        while len(self.patterns) < PATTERNS:
            pattern = tuple(sorted(int(i) for i in rng.choice(SITES, PER_PATTERN, replace=False)))
            place = self.sites[list(pattern)]
            between_um = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1))[np.triu_indices(PER_PATTERN, 1)]
            if between_um.min() > APART_UM and pattern not in self.patterns:
                self.patterns.append(pattern)

    def pulse(self, time_s: float, pattern: int) -> Pulse:
        place = self.sites[list(self.patterns[pattern])]
        return Pulse(time_s, place[:, 0], place[:, 1])

    def set_up(self) -> float:
        """The pause before a block; returns when the block may begin."""
        self.tissue.rest(SET_UP_S)
        return self.tissue.now_s + 0.001

    def read(self, times_s: np.ndarray, spikes: Spikes) -> tuple[np.ndarray, np.ndarray]:
        first = np.searchsorted(spikes.time_s, times_s + WINDOW_S[0] - 1e-9)
        last = np.searchsorted(spikes.time_s, times_s + WINDOW_S[1] - 1e-9)
        neurons = self.seen.shape[1]
        counts = np.stack(
            [np.bincount(spikes.neuron[a:b], minlength=neurons) for a, b in zip(first, last, strict=True)]
        )
        on_channels = counts.astype(np.float32) @ self.seen.T
        rate_hz = on_channels.sum(axis=1) / ((WINDOW_S[1] - WINDOW_S[0]) * CHANNELS)
        return rate_hz, (on_channels > 0).mean(axis=1)

    def block(self, frequency_hz: int, patterns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One stimulus of each pattern given, 1/f apart."""
        times_s = self.set_up() + np.arange(len(patterns)) / frequency_hz
        pulses = [self.pulse(float(t), int(p)) for t, p in zip(times_s, patterns, strict=True)]
        return self.read(times_s, self.tissue.advance(len(patterns) / frequency_hz + 0.05, pulses))

    def blocked(self) -> Responses:
        """The paper's recording: the frequencies in random order, every pattern once at each."""
        order = [FREQUENCIES_HZ[i] for i in self.rng.permutation(5)]
        return {f: self.block(f, self.rng.permutation(PATTERNS)) for f in order}

    def mixed(self, pulses: int) -> Responses:
        """As a closed loop presents: frequency and pattern drawn at random, a train of pulses, the last one read."""
        frequency_hz = self.rng.permutation(np.repeat(FREQUENCIES_HZ, 100))
        each_hz = np.repeat(frequency_hz, pulses)
        times_s = self.set_up() + np.cumsum(1 / each_hz)
        train = [self.pulse(float(t), int(self.rng.integers(PATTERNS))) for t in times_s]
        spikes = self.tissue.advance(times_s[-1] - self.tissue.now_s + 0.05, train)
        rate_hz, active = self.read(times_s[pulses - 1 :: pulses], spikes)
        return {f: (rate_hz[frequency_hz == f], active[frequency_hz == f]) for f in FREQUENCIES_HZ}


def otsu(values: np.ndarray) -> tuple[float, float]:
    """Otsu's threshold, by trying every value, and the between-class over the total variance."""
    best = (0.0, float(values.max()))
    for threshold in np.unique(values)[:-1]:
        low = values <= threshold
        share = low.mean()
        between = share * (1 - share) * (values[low].mean() - values[~low].mean()) ** 2
        best = max(best, (float(between), float(threshold)))
    return best[1], best[0] / float(values.var())


def without_bursts(responses: Responses, threshold: float) -> dict[int, np.ndarray]:
    return {f: rate_hz[active <= threshold] for f, (rate_hz, active) in responses.items()}


def short_of(kept: dict[int, np.ndarray]) -> float:
    """How far the distribution at 80 Hz falls short of lying right of that at 5 Hz, at the worst of 20 bins' edges."""
    top_hz = np.ceil(max(rate_hz.max() for rate_hz in kept.values()) / 10) * 10
    edges_hz = np.linspace(0, top_hz, 21)
    return max(0.0, *(float(np.mean(kept[5] > edge) - np.mean(kept[80] > edge)) for edge in edges_hz))


def network_bursts_s(rig: Rig) -> np.ndarray:
    """Durations of network bursts: the rate over all neurons, smoothed over 30 ms, leaves 2.5 times its median (and
    3 Hz) and passes 8 times it (and 8 Hz) before it is back."""
    bin_s = 0.01
    bins = round(rig.spontaneous_s / bin_s)
    at = ((rig.spontaneous.time_s - rig.spontaneous_from_s) / bin_s).astype(int)
    rate_hz = np.bincount(at, minlength=bins)[:bins] / (bin_s * len(rig.neuron_rate_hz))
    rate_hz = np.convolve(rate_hz, np.ones(3) / 3, "same")
    usual_hz = float(np.median(rate_hz))
    raised = np.concatenate([[False], rate_hz > max(2.5 * usual_hz, 3.0), [False]])
    edges = np.flatnonzero(np.diff(raised.astype(int)))
    return np.array(
        [(b - a) * bin_s for a, b in edges.reshape(-1, 2) if rate_hz[a:b].max() > max(8 * usual_hz, 8.0)], dtype=float
    )


@dataclasses.dataclass
class Figures:
    """The acceptance figures of one seed, or of several; lists are over the five frequencies."""

    seed: int
    channel_rate_hz: float
    bursts_per_min: float
    burst_ms: float
    medians_hz: list[float]
    ratio: float
    right_short: float
    """How far the distribution at 80 Hz falls short of lying right of that at 5 Hz, at the worst bin edge; 0 if not."""
    separability: float
    smallest_share: float
    one_pattern_ratio: float
    without_nmda_ratio: float
    large_at_start: float
    large_left: float
    burst_share_start: float
    burst_share_end: float
    half_active_start: float
    half_active_end: float
    """Share of responses in which more than half of the channels are active."""
    mixed_hz: list[float]
    mixed_five_hz: list[float]
    over_median: dict[str, list[float]]
    kept: dict[int, np.ndarray]
    """Responses of the first recording that are no bursts, in Hz."""


def measure(seed: int, parameters: TissueParameters | None = None) -> Figures:
    """All figures of one seed; some 9,000 s of culture."""
    parameters = parameters or TissueParameters()
    rig = Rig(seed, parameters)
    durations_s = network_bursts_s(rig)
    channel_rate_hz, spontaneous_s = float(rig.channel_rate_hz.mean()), rig.spontaneous_s
    proper = durations_s[(durations_s >= 0.1) & (durations_s <= 0.8)]

    series = []
    began_s = rig.tissue.now_s
    for number in range(RECORDINGS):
        due_s = began_s + number * INTERVAL_S
        if rig.tissue.now_s < due_s:
            rig.tissue.rest(due_s - rig.tissue.now_s)
        series.append(rig.blocked())
    first = series[0]
    threshold, separability = otsu(np.concatenate([active for _, active in first.values()]))
    quiet = without_bursts(first, threshold)
    medians_hz = [float(np.median(quiet[f])) for f in FREQUENCIES_HZ]
    large, burst_share, half_active = [], [], []
    for recording in series:
        every = np.concatenate([active for _, active in recording.values()])
        own, _ = otsu(every)
        half_active.append(float(np.mean(every > 0.5)))
        pooled = np.concatenate(list(without_bursts(recording, own).values()))
        large.append(float(np.mean(pooled > 18.0)))
        burst_share.append(1 - len(pooled) / 500)

    # Guards and other presentations start from a fresh culture each, not from one that is two hours old.
    rig = Rig(seed, parameters, spontaneous_s=10.0)
    one = {f: [rig.block(f, np.full(100, pattern)) for pattern in range(REPEATED)] for f in (5, 80)}
    one_hz = {
        f: np.mean([np.median(rate_hz[active <= threshold]) for rate_hz, active in blocks]) for f, blocks in one.items()
    }
    rig = Rig(seed, dataclasses.replace(parameters, nmda_ratio=0.0), spontaneous_s=10.0)
    blocked = without_bursts(rig.blocked(), threshold)
    rig = Rig(seed, parameters, spontaneous_s=10.0)
    presented = {"blocked, 1 pulse": first, "mixed, 1 pulse": rig.mixed(1), "mixed, 5 pulses": rig.mixed(5)}
    over_median, median_of = {}, {}
    for name, responses in presented.items():
        own, _ = otsu(np.concatenate([active for _, active in responses.values()]))
        kept = without_bursts(responses, own)
        p50 = np.percentile(np.concatenate(list(kept.values())), 50)
        over_median[name] = [float(np.mean(kept[f] >= p50)) for f in FREQUENCIES_HZ]
        median_of[name] = [float(np.median(kept[f])) for f in FREQUENCIES_HZ]
    return Figures(
        seed=seed,
        channel_rate_hz=channel_rate_hz,
        bursts_per_min=len(proper) * 60 / spontaneous_s,
        burst_ms=float(1000 * proper.mean()) if len(proper) else float("nan"),
        medians_hz=medians_hz,
        ratio=medians_hz[-1] / medians_hz[0],
        right_short=short_of(quiet),
        separability=separability,
        smallest_share=min(len(quiet[f]) / len(first[f][0]) for f in FREQUENCIES_HZ),
        one_pattern_ratio=float(one_hz[80] / one_hz[5]),
        without_nmda_ratio=float(np.median(blocked[80]) / np.median(blocked[5])),
        large_at_start=large[0],
        large_left=large[-1] / large[0],
        burst_share_start=float(np.mean(burst_share[:3])),
        burst_share_end=float(np.mean(burst_share[-3:])),
        half_active_start=float(np.mean(half_active[:3])),
        half_active_end=float(np.mean(half_active[-3:])),
        mixed_hz=median_of["mixed, 1 pulse"],
        mixed_five_hz=median_of["mixed, 5 pulses"],
        over_median=over_median,
        kept=quiet,
    )


def missed(figures: Figures) -> list[str]:
    """The figures that are outside their bounds, in words; that seed means rise is not among them."""
    f = figures
    bounds = {
        "spontaneous rate 0.3-4 Hz": 0.3 <= f.channel_rate_hz <= 4,
        "2-15 network bursts a minute of 100-800 ms": 2 <= f.bursts_per_min <= 15,
        "80/5 ratio 1.6-3": 1.6 <= f.ratio <= 3,
        "80 Hz right of 5 Hz at every bin edge": f.right_short == 0,
        "separability above 0.6": f.separability > 0.6,
        "non-burst share 0.9 or more at every frequency": f.smallest_share >= 0.9,
        "one pattern repeated: ratio under 0.8": f.one_pattern_ratio < 0.8,
        "NMDA off: ratio under 1.1": f.without_nmda_ratio < 1.1,
        "P(x > 18 Hz) at 140 min at most 40 % of 0 min": f.large_left <= 0.4,
        "burst share falls": f.burst_share_end < f.burst_share_start,
        "share with more than half of the channels active falls": f.half_active_end < f.half_active_start,
    }
    return [name for name, held in bounds.items() if not held]


@dataclasses.dataclass
class Often:
    """What does not depend on how one recording came out: of 1,000 responses to each frequency."""

    seed: int
    medians_hz: list[float]
    right_short: float
    separability: float
    smallest_share: float

    def missed(self) -> list[str]:
        """What is outside its bounds, in words."""
        bounds = {
            "medians rise": bool(np.all(np.diff(self.medians_hz) > 0)),
            "80/5 ratio 1.6-3": 1.6 <= self.medians_hz[-1] / self.medians_hz[0] <= 3,
            "80 Hz right of 5 Hz at every bin edge": self.right_short == 0,
            "separability above 0.6": self.separability > 0.6,
            "non-burst share 0.9 or more at every frequency": self.smallest_share >= 0.9,
        }
        return [name for name, held in bounds.items() if not held]


def measure_often(seed: int) -> Often:
    """The figures of ten recordings together, after 30, 37, ..., 93 s, each with channels and sites of its own."""
    recordings = [Rig(seed, spontaneous_s=30.0 + 7 * number).blocked() for number in range(OFTEN)]
    together = {
        f: (np.concatenate([each[f][0] for each in recordings]), np.concatenate([each[f][1] for each in recordings]))
        for f in FREQUENCIES_HZ
    }
    threshold, separability = otsu(np.concatenate([active for _, active in together.values()]))
    kept = without_bursts(together, threshold)
    shares = [len(kept[f]) / len(together[f][0]) for f in FREQUENCIES_HZ]
    return Often(seed, [float(np.median(kept[f])) for f in FREQUENCIES_HZ], short_of(kept), separability, min(shares))


def print_often(seeds: list[int]) -> None:
    """Print the figures of the docs' table, a row for each seed."""
    print("| seed | medians at 5, 10, 20, 40, 80 Hz | 80/5 | 80 Hz short | between-class | non-burst | missed |")
    print("|---" * 7 + "|")
    for seed in seeds:
        f = measure_often(seed)
        medians = " ".join(f"{hz:.1f}" for hz in f.medians_hz)
        print(
            f"| {seed} | {medians} | {f.medians_hz[-1] / f.medians_hz[0]:.2f} | {f.right_short:.4f} | "
            f"{f.separability:.2f} | {f.smallest_share:.3f} | {'; '.join(f.missed()) or 'none'} |",
            flush=True,
        )


def of_all(rows: list[Figures]) -> Figures:
    """Means over seeds; the ratio is that of the mean medians, and 80 Hz is compared with 5 Hz over all responses."""
    together = {f: np.concatenate([row.kept[f] for row in rows]) for f in FREQUENCIES_HZ}
    averaged: dict[str, Any] = {
        field.name: np.mean([getattr(row, field.name) for row in rows], axis=0).tolist()
        for field in dataclasses.fields(Figures)
        if field.type in ("float", "list[float]")
    }
    averaged["ratio"] = averaged["medians_hz"][-1] / averaged["medians_hz"][0]
    averaged["right_short"] = short_of(together)
    return dataclasses.replace(rows[0], **averaged, kept=together)


def main(seeds: list[int]) -> None:
    """Print the table of the docs."""
    rows = [measure(seed) for seed in seeds]
    columns = [*rows, of_all(rows)]

    def line(name: str, bound: str, values: list[str]) -> None:
        print(f"| {name} | {bound} | {' | '.join(values)} |")

    def hz(values: list[float]) -> str:
        return " ".join(f"{value:.1f}" for value in values)

    line("figure", "bound", [*(f"seed {f.seed}" for f in rows), "all"])
    print("|---" * (2 + len(columns)) + "|")
    line("spontaneous rate, Hz per channel", "0.3-4", [f"{f.channel_rate_hz:.2f}" for f in columns])
    bursts = [f"{f.bursts_per_min:.1f}" for f in columns]
    line("network bursts a minute (100-800 ms), first two minutes", "2-15", bursts)
    line("their mean duration, ms", "100-800", [f"{f.burst_ms:.0f}" for f in columns])
    line("medians at 5, 10, 20, 40, 80 Hz", "seed means rise", [hz(f.medians_hz) for f in columns])
    line("80/5 ratio", "1.6-3", [f"{f.ratio:.2f}" for f in columns])
    right = [f"no, by {f.right_short:.3f}" if f.right_short else "yes" for f in columns]
    line("80 Hz right of 5 Hz at every edge", "yes", right)
    line("between-class over total variance", "> 0.6", [f"{f.separability:.2f}" for f in columns])
    line("smallest non-burst share", "0.9 or more", [f"{f.smallest_share:.2f}" for f in columns])
    line("one pattern repeated: 80/5", "< 0.8", [f"{f.one_pattern_ratio:.2f}" for f in columns])
    line("NMDA off: 80/5", "< 1.1", [f"{f.without_nmda_ratio:.2f}" for f in columns])
    line("P(x > 18 Hz) at 140 min over 0 min", "0.4 or less", [f"{f.large_left:.2f}" for f in columns])
    shares = [f"{f.burst_share_start:.3f} to {f.burst_share_end:.3f}" for f in columns]
    line("burst share, first and last three recordings", "falls", shares)
    halves = [f"{f.half_active_start:.3f} to {f.half_active_end:.3f}" for f in columns]
    line("responses with more than half of the channels active", "falls", halves)
    line("mixed, one pulse: medians", "seed means rise", [hz(f.mixed_hz) for f in columns])
    line("mixed, five pulses: medians", "", [hz(f.mixed_five_hz) for f in columns])
    out = [missed(f) for f in columns]
    for name, medians_hz in (("in blocks", columns[-1].medians_hz), ("mixed", columns[-1].mixed_hz)):
        if np.any(np.diff(medians_hz) <= 0):
            out[-1].append(f"seed means rise {name}")
    line("missed", "none", ["; ".join(names) or "none" for names in out])
    print("\n| P(x >= P50) at 5, 10, 20, 40, 80 Hz | " + " | ".join(f"seed {f.seed}" for f in rows) + " |")
    print("|---" * (1 + len(rows)) + "|")
    for name in rows[0].over_median:
        print(f"| {name} | " + " | ".join(" ".join(f"{v:.2f}" for v in f.over_median[name]) for f in rows) + " |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("seeds", type=int, nargs="*", default=[1, 2, 3, 4, 5])
    parser.add_argument("--often", action="store_true")
    options = parser.parse_args()
    (print_often if options.often else main)(options.seeds)
