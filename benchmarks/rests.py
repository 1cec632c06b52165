"""What rests do to responses: how well the slowest and the fastest frequency can be told apart after them.

    python benchmarks/rests.py [--cultures 1 2 3 4 5] [--rests 2 30] [--trials 300]

Each virtual culture is recorded without rests, its conditions mixed at random. Then, from the state after that, in
blocks of some ten seconds, as long as an episode: each after a rest, and after the longest rest also with the
after-hyperpolarisation of every neuron put back to what it was before the rest. The first ten trials of a block are
left out, as the warm-up of a closed loop. The output is a Markdown table.

P is the probability that a response to the fastest frequency is larger than one to the slowest (ties count half), of
each culture and on average. The other columns are means over cultures, of y = log(1 + x / Hz): the difference between
the mean y of the two frequencies, the standard deviation of y at the slowest, and the correlation of what is left of y
without the mean of its frequency with the same three trials later.
"""

from __future__ import annotations

import argparse
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float64, Int64

from animat.cultures.virtual import VirtualCulture
from animat.responses.extraction import extract_responses
from animat.stimulation.protocol import Protocol

_TRIALS, _WARM_UP, _LAG = 26, 10, 3
"""Trials of each frequency in a block; trials of a block that are left out; of the correlation."""
_PAUSE_S = 0.2

Block = tuple[Int64[np.ndarray, " trials"], Float64[np.ndarray, " trials"]]


def blocks(culture: VirtualCulture, trials: int, rest_s: float, *, keeps: bool = False) -> list[Block]:
    """Condition and y of the trials of each block, bursts as NaN; `keeps`: the after-hyperpolarisation is put back."""
    found = []
    for seed in range(max(1, trials // _TRIALS)):
        before = culture.tissue._state.potassium.copy()
        culture.rest(max(0.0, rest_s - _PAUSE_S))
        if keeps:
            culture.tissue._state.potassium[:] = before
        protocol = Protocol(order="mixed", trials=_TRIALS, setup_s=0.0, pause_s=min(rest_s, _PAUSE_S))
        responses = extract_responses(culture.record(protocol, seed), burst_threshold=0.5)
        y = np.where(responses.is_burst, np.nan, np.log1p(responses.rate_hz))
        found.append((responses.condition[_WARM_UP:], y[_WARM_UP:]))
    return found


def measures(found: list[Block]) -> list[float]:
    """P, and the other columns of the table."""
    condition, y = (np.concatenate(each) for each in zip(*found, strict=True))
    of = [y[(condition == c) & ~np.isnan(y)] for c in range(condition.max() + 1)]
    slow, fast = of[0][:, None], of[-1]
    p = float(np.mean(slow < fast) + np.mean(slow == fast) / 2)
    mean = np.array([each.mean() for each in of])
    left = [own - mean[which] for which, own in found]
    pairs = np.concatenate([np.stack([each[:-_LAG], each[_LAG:]]) for each in left], axis=1)
    correlation = np.corrcoef(pairs[:, ~np.isnan(pairs).any(axis=0)])[0, 1]
    return [p, float(mean[-1] - mean[0]), float(of[0].std()), float(correlation)]


def main() -> None:
    """Record and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cultures", type=int, nargs="+", default=[1, 2, 3, 4, 5], help="seeds")
    parser.add_argument("--rests", type=float, nargs="+", default=[2.0, 30.0], help="s")
    parser.add_argument("--trials", type=int, default=300, help="trials of each frequency in each row")
    given = parser.parse_args()
    rows: dict[str, list[list[float]]] = {}
    after = [*((rest_s, False) for rest_s in given.rests), (max(given.rests), True)]
    for seed in given.cultures:
        with TemporaryDirectory() as folder:
            with VirtualCulture(seed) as culture:
                rows.setdefault("none", []).append(measures(blocks(culture, given.trials, 0.0)))
                culture.save_state(f"{folder}/culture.state")
            for rest_s, keeps in after:
                culture = VirtualCulture(seed)
                culture.restore_state(f"{folder}/culture.state")
                name = f"{rest_s:g} s" + ", after-hyperpolarisation put back" * keeps
                with culture:
                    rows.setdefault(name, []).append(measures(blocks(culture, given.trials, rest_s, keeps=keeps)))
    each = " | ".join(map(str, given.cultures))
    print(f"| rest | P: {each} | mean | difference | spread | correlation |")
    print("|---" * (len(given.cultures) + 5) + "|")
    for name, of_cultures in rows.items():
        means = np.mean(of_cultures, axis=0)
        cells = [f"{of[0]:.2f}" for of in of_cultures] + [f"{mean:.2f}" for mean in means]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
