"""How well two commands can be separated: the readouts' responses to each condition of place and frequency.

    python benchmarks/readouts.py [--cultures 1 2 3] [--places halves] [--frequencies 5 80] [--trials 500]
    python benchmarks/readouts.py --places corners --frequencies 20

Each virtual culture is recorded once, with its conditions mixed, one pulse each. The output is a Markdown table. It
shows for each condition how often each readout gives a command above 0 (x of P50 or more), how often each corner of
commands is hit, and Spearman's correlation of the readouts within the condition.
"""

from __future__ import annotations

import argparse
import itertools

import numpy as np
from scipy.stats import spearmanr

from animat.cultures.virtual import VirtualCulture
from animat.responses.conditions import conditions_named
from animat.responses.extraction import extract_responses
from animat.responses.readouts import readouts_on
from animat.responses.responses import Responses
from animat.stimulation.places import NAMED
from animat.stimulation.protocol import Protocol


def recorded(seed: int, places: str, frequencies_hz: tuple[float, ...], trials: int) -> Responses:
    """The responses of a virtual culture, read by halves or quadrants."""
    with VirtualCulture(seed) as culture:
        protocol = Protocol(order="mixed", places=places, frequencies_hz=frequencies_hz, trials=trials)
        recording = culture.record(protocol, seed=1)
    by = conditions_named("frequency x electrode")
    readouts = readouts_on("halves" if places == "corners" else places, recording.channels)
    return extract_responses(recording, by, readouts=readouts)


def table(responses: Responses) -> list[str]:
    """A row for each condition."""
    names, p50_hz = responses.readouts.names, np.median(responses.read_hz[~responses.is_burst], axis=0)
    corners = list(itertools.product((False, True), repeat=len(names)))
    signs = ["".join("+" if up else "-" for up in corner) for corner in corners]
    head = ["condition", "responses", *(f"P({name} > 0)" for name in names), *signs, "correlation"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for i, condition in enumerate(responses.conditions):
        x_hz = responses.read_of(i)
        above = x_hz >= p50_hz
        hit = [float(np.mean(np.all(above == corner, axis=1))) for corner in corners]
        together = np.atleast_2d(spearmanr(x_hz).statistic)
        rho = float(together[0, 0] if together.size == 1 else together[0, 1])
        (electrodes,), (hz,) = condition.electrodes or ((),), condition.frequencies_hz
        place = f"{hz:g} Hz, {len(electrodes)} electrodes from {min(electrodes)}"
        cells = [place, str(len(x_hz)), *(f"{p:.2f}" for p in (*above.mean(axis=0), *hit, rho))]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def main() -> None:
    """Record and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cultures", type=int, nargs="+", default=[1, 2, 3], help="seeds")
    parser.add_argument("--places", default="halves", choices=NAMED)
    parser.add_argument("--frequencies", type=float, nargs="+", default=[5.0, 80.0], help="Hz")
    parser.add_argument("--trials", type=int, default=500, help="trials of each condition")
    given = parser.parse_args()
    for seed in given.cultures:
        responses = recorded(seed, given.places, tuple(given.frequencies), given.trials)
        print(f"\nculture {seed}; corners are of {', '.join(responses.readouts.names)}\n")
        print("\n".join(table(responses)), flush=True)


if __name__ == "__main__":
    main()
