"""Policies trained on one recording, by shadowing, and on randomly drawn recordings, over 90 minutes of closed loop.

    python benchmarks/over_drift.py [--seeds 1 2 3 4 5] [--robot cartpole] [--episodes 12] [--pause-s 30] [--out drift/]

Each virtual culture is recorded every ten minutes up to 60 min, as `animat record` does. The same policies are trained
on that in three ways. Then all of them run in one session, in turn, with pauses that make it an hour and a half long:
once with adaptive thresholds, and once with fixed ones on the culture in the same state. Everything is kept under
`--out`.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import pandas as pd

from reality_gap import expect

WAYS = {"one recording": "off", "shadowing": "on", "drawn": "drawn"}
THRESHOLDS = ("adaptive", "fixed")
PERIOD_MIN = 40


def main() -> None:
    """Record, train, run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--robot", default="cartpole")
    parser.add_argument("--policies", type=int, default=4)
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--pause-s", type=float, default=30.0)
    parser.add_argument("--out", type=Path, default=Path("drift"))
    options = parser.parse_args()
    parts = []
    for seed in options.seeds:
        run_through(seed, options)
        for thresholds in THRESHOLDS:
            episodes = episodes_of(options.out / f"culture{seed}" / thresholds)
            parts.append(episodes.assign(culture=seed, thresholds=thresholds))
            print(f"\nculture {seed}, {thresholds} thresholds\n{table(parts[-1])}", flush=True)
    print(f"\nmean over {len(options.seeds)} cultures\n{table(pd.concat(parts, ignore_index=True))}")


def run_through(seed: int, options: argparse.Namespace) -> None:
    """Make a culture's recordings, policies and two sessions; an existing session is not run again."""
    culture = options.out / f"culture{seed}"
    recordings, together = culture / "recordings", culture / "policies"
    expect(["record", "--seed", str(seed), "--sessions", "7", "--interval-min", "10", "--out", str(recordings)])
    for way, shadowing in WAYS.items():
        apart = culture / way.replace(" ", "-")
        given = ["--shadowing", shadowing, "--policies", str(options.policies)]
        expect(["train", options.robot, "--recordings", str(recordings), *given, "--out", str(apart)])
        together.mkdir(exist_ok=True)
        for policy in sorted(apart.glob("p*.safetensors")):
            shutil.copy(policy, together / f"{shadowing}-{policy.name}")
    for thresholds in THRESHOLDS:
        session = culture / thresholds
        if (session / "ticks.csv").exists():
            continue
        shutil.rmtree(session, ignore_errors=True)
        run = ["run", str(together), "--recordings", str(recordings), "--at-min", "60", "--thresholds", thresholds]
        run += ["--episodes", str(options.episodes), "--pause-s", str(options.pause_s), "--controls", "random"]
        expect([*run, "--out", str(session)])


def episodes_of(session: Path) -> pd.DataFrame:
    """The way of training, minute and return of each complete episode."""
    ticks = pd.read_csv(session / "ticks.csv")
    grouped = ticks.groupby("episode")
    episodes = pd.DataFrame(
        {
            "way": grouped["agent"].first(),
            "minute": grouped["time_s"].first() / 60,
            "return": grouped["reward"].sum(),
            "is_whole": grouped["is_terminated"].max() + grouped["is_truncated"].max() > 0,
        }
    )
    named = {shadowing: way for way, shadowing in WAYS.items()}
    episodes["way"] = episodes["way"].str.rsplit("-", n=1).str[0].map(lambda name: named.get(name, name))
    return episodes[episodes["is_whole"]]


def table(episodes: pd.DataFrame) -> str:
    """Mean return, its standard error and the number of episodes, by way, thresholds and time."""
    periods = (episodes["minute"] // PERIOD_MIN * PERIOD_MIN).astype(int)
    starts = sorted(periods.unique())
    lines = []
    for (way, thresholds), rows in episodes.groupby(["way", "thresholds"]):
        parts = [rows["return"][periods == start] for start in starts]
        cells = [f"{part.mean():.1f} ({part.sem():.1f}, {len(part)})" if len(part) else "-" for part in parts]
        lines.append(f"| {way} | {thresholds} | {' | '.join(cells)} | {rows['return'].mean():.1f} |")
    heads = " | ".join(f"{start} to {start + PERIOD_MIN} min" for start in starts)
    return "\n".join([f"| trained | thresholds | {heads} | all |", "|---" * (len(starts) + 3) + "|", *lines])


if __name__ == "__main__":
    main()
