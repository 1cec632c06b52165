"""The table over bodies: trained on recordings of a virtual culture, and measured in closed loop on that culture.

    python benchmarks/bodies_on_a_culture.py [--bodies cartpole wheels ...] [--seed 1] [--policies 10] [--episodes 3]
        [--out bodies/]

Bodies with one command are trained on `animat record`, those with two on `animat record --places corners`, with default
settings except for the number of policies and episodes. The same is trained without neurons, so that actions move the
body directly. Everything is kept under `--out`; existing results are not computed again. MuJoCo bodies need the extra
`[mujoco]`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pandas as pd

from animat.robots.registry import robot_named
from reality_gap import expect, free, ran

BODIES = (
    "cartpole",
    "navigation",
    "swing-up",
    "wheels",
    "arm",
    "gymnasium:MountainCarContinuous-v0",
    "gymnasium:Pendulum-v1",
    "gymnasium:Reacher-v5",
    "gymnasium:Swimmer-v5",
)


def main() -> None:
    """Record, train, run, and print the table."""
    parser = argparse.ArgumentParser(description="Bodies on a culture: predicted and measured returns.")
    parser.add_argument("--bodies", nargs="+", default=list(BODIES))
    parser.add_argument("--seed", type=int, default=1, help="of the virtual culture")
    parser.add_argument("--policies", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=3, help="of each policy, in closed loop")
    parser.add_argument("--out", type=Path, default=Path("bodies"))
    options = parser.parse_args()
    print("| body | " + " | ".join(COLUMNS) + " |\n|---" + "|---" * len(COLUMNS) + "|")
    for body in options.bodies:
        print(row(body, options), flush=True)


COLUMNS = (
    "random: predicted, measured",
    "heuristic",
    "policies: predicted, 95 %",
    "measured",
    "gap, 95 %",
    "ended by itself",
    "without neurons",
    "optimum",
)


def row(body: str, options: argparse.Namespace) -> str:
    """A row of the table."""
    places = ["--places", "corners"] if robot_named(body).n_commands == 2 else []
    recordings = str(options.out / f"culture{options.seed}" / (places or ["one-place"])[-1])
    expect(["record", "--seed", str(options.seed), *places, "--out", recordings])
    folder = options.out / f"culture{options.seed}" / body.rpartition(":")[2]
    count = ["--policies", str(options.policies)]
    alone = folder / "without.json"
    if not alone.exists():
        outcome = ran(["train", body, "--mapping", "none", *count, "--out", str(folder / "without")])
        alone.write_text(json.dumps(outcome) + "\n")
    table = folder / "run.json"
    if not table.exists():
        expect(["train", body, "--recordings", recordings, *count, "--out", str(folder / "policies")])
        session = free(folder / "session")
        run = ["run", str(folder / "policies"), "--recordings", recordings, "--out", str(session)]
        # A body from an importable module is imported only where it is named.
        outcome = ran([*run, "--robot", body, "--episodes", str(options.episodes)])
        ticks = pd.read_csv(session / "ticks.csv")
        ours = ticks[ticks["agent"].str.fullmatch(r"p\d+")]
        outcome["episodes"] = int((ours["is_terminated"] | ours["is_truncated"]).sum())
        outcome["terminated"] = int(ours["is_terminated"].sum())
        table.write_text(json.dumps(outcome) + "\n")
    return line(body, json.loads(table.read_text()), json.loads(alone.read_text()))


def line(body: str, measured: dict[str, Any], without: dict[str, Any]) -> str:
    """The results as a line of Markdown."""
    rows = {each["name"]: each for each in measured["rows"]}
    policies, heuristic = measured["rows"][0], rows.get("heuristic")
    prediction, gap = policies["prediction"], policies["gap"]
    returns = pd.Series(without["returns"])
    cells = (
        body,
        f"{rows['random']['predicted']:.1f}, {rows['random']['measured']:.1f}",
        "-" if heuristic is None else f"{heuristic['predicted']:.1f}, {heuristic['measured']:.1f}",
        f"{prediction['value']:.1f} ({prediction['low']:.1f} to {prediction['high']:.1f})",
        f"{policies['measured']:.1f}",
        f"{gap['value']:+.1f} ({gap['low']:+.1f} to {gap['high']:+.1f})",
        f"{measured['terminated']} of {measured['episodes']}",
        f"{returns.mean():.1f} ({returns.min():.1f} to {returns.max():.1f})",
        "-" if measured["optimum"] is None else f"{measured['optimum']:.1f}",
    )
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
