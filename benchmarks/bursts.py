"""How often burst separation splits responses that are of one group, compared with Otsu's method without the test.

    python benchmarks/bursts.py [--rounds 20]

Ratios of active channels are drawn from the 24 distributions with one peak of `tests/test_bursts.py`, on arrays of five
sizes, so each round has 120 samples of each number of responses.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from animat.responses.bursts import otsu_threshold, separate_bursts


def main() -> None:
    """Print a row for each number of responses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args().rounds
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from test_bursts import of_one_peak

    print(
        "| responses | split kept | set apart | by Otsu's method | split kept, without lognormals | most often split |"
    )
    print("|---" * 6 + "|")
    for n in (60, 200, 500, 1500):
        rng, kept, otsu = np.random.default_rng(n), dict[str, list[float]](), []
        for name, ratio, channels in (each for _ in range(rounds) for each in of_one_peak(rng, n)):
            kept.setdefault(name, []).append(float(separate_bursts(ratio, n_channels=channels).is_burst.mean()))
            otsu.append(float(np.mean(ratio > otsu_threshold(ratio))))
        split = {name: np.mean(np.array(shares) > 0) for name, shares in kept.items()}
        others = [share for name, share in split.items() if not name.startswith("lognormal")]
        worst = max(split, key=lambda name: split[name])
        cells = (
            f"{100 * np.mean(list(split.values())):.1f} %",
            f"{100 * np.mean(list(kept.values())):.2f} %",
            f"{100 * np.mean(otsu):.0f} %",
            f"{100 * np.mean(others):.1f} %",
            f"{worst}: {100 * split[worst]:.0f} %",
        )
        print(f"| {n:,} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
