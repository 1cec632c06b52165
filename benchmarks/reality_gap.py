"""The headline table: predicted against measured return by recordings and presentation, over cultures and both robots.

    python benchmarks/reality_gap.py [--seeds 1 2 3 4 5] [--robots cartpole navigation]
        [--ways default paper mixed five memory memory9] [--policies 2] [--episodes 20] [--thresholds adaptive fixed]
        [--controls] [--out gap/]
    python benchmarks/reality_gap.py --backends virtual cl1 maxone --channels 1024 256 128 60 16

Each virtual culture is recorded at 0 and 10 min, and policies are trained on that and run in closed loop on the same
culture, in the state in which the last recording left it. The ways are: the commands without options, as in the README;
the paper's blocks with one pulse; mixed with one; mixed with five; and mixed with one, recorded five times as long and
simulated with memory, with one threshold and with nine. Everything is kept under `--out`, one folder each; existing
results are not computed again.

With `--backends` each culture is opened once, recorded at 0 and 10 min with default settings, and run by policies
trained with default settings: the virtual culture with `--channels` channels, the CL1 through its SDK's simulator and
the MaxOne through the tests' stand-in, the last two over the same tissue.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import backends
from animat.cli import main as animat

COLUMNS = (
    "culture",
    "robot",
    "recorded",
    "simulator",
    "mapping",
    "thresholds",
    "random: predicted, measured",
    "optimum",
    "predicted, 95 %",
    "measured",
    "gap, 95 %",
    "of the range",
    "pulses/action",
)


@dataclass(frozen=True)
class Way:
    """How a culture is recorded and simulated, and the mapping of the policies."""

    order: str = "mixed"
    pulses: int = 1
    trials: int = 100
    simulator: str = "histogram"
    mapping: str = "1-threshold"

    @property
    def recorded(self) -> str:
        """Order, pulses and trials."""
        return f"{self.order}, {self.pulses}, {self.trials} times"


WAYS = {
    "default": None,
    "paper": Way(order="blocked"),
    "mixed": Way(),
    "five": Way(pulses=5),
    "memory": Way(trials=500, simulator="memory"),
    "memory9": Way(trials=500, simulator="memory", mapping="9-thresholds"),
}


def recording_options(way: Way | None) -> list[str]:
    """Options of `animat record`."""
    if way is None:
        return []
    presented = ["--order", way.order, "--pulses", str(way.pulses), "--trials", str(way.trials)]
    return ["--sessions", "2", "--interval-min", "10", *presented]


def training_options(way: Way | None, robot: str, policies: int, iterations: int | None) -> list[str]:
    """Options of `animat train`; iterations are the paper's by default."""
    if way is None:
        return []
    given = ["--policies", str(policies), "--simulator", way.simulator, "--mapping", way.mapping]
    return [*given, "--iterations", str(iterations or {"cartpole": 800_000, "navigation": 500_000}[robot])]


def running_options(way: Way | None, thresholds: str, episodes: int, *, controls: bool) -> list[str]:
    """Options of `animat run`."""
    if way is None:
        return []
    return ["--episodes", str(episodes), "--controls", "all" if controls else "random", "--thresholds", thresholds]


def main() -> None:
    """Record, train, run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--robots", nargs="+", default=["cartpole", "navigation"])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--thresholds", nargs="+", default=["adaptive", "fixed"])
    parser.add_argument("--policies", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--iterations", type=int, help="default: the paper's")
    parser.add_argument("--controls", action="store_true", help="all controls, not only the random one")
    parser.add_argument("--out", type=Path, default=Path("gap"))
    parser.add_argument("--backends", nargs="+", choices=["virtual", "cl1", "maxone"], default=[])
    parser.add_argument(
        "--channels", type=int, nargs="+", default=[1024], help="numbers of channels of the virtual culture"
    )
    options = parser.parse_args()

    lines: list[str] = []
    if options.backends:
        asked = [
            (backend, n) for backend in options.backends for n in (options.channels if backend == "virtual" else [0])
        ]
        for seed, (backend, channels), robot in itertools.product(options.seeds, asked, options.robots):
            line = live_once(backend, channels, seed, robot, options)
            if line is not None:
                lines.append(f"| {backend} {channels or ''} {line}")
                print(lines[-1], flush=True)
        print(f"\n| backend | {' | '.join(COLUMNS)} |\n{'|---' * (len(COLUMNS) + 1)}|")
        print("\n".join(lines))
        return
    for seed, (name, way) in itertools.product(options.seeds, ((name, WAYS[name]) for name in options.ways)):
        of_recording = recording_options(way)
        recordings = str(options.out / f"culture{seed}" / ("-".join(of_recording[5::2]) or name))
        expect(["record", "--seed", str(seed), *of_recording, "--out", recordings])
        for robot in options.robots:
            folder = options.out / f"culture{seed}" / name / robot
            policies = str(folder / "policies")
            given = training_options(way, robot, options.policies, options.iterations)
            expect(["train", robot, "--recordings", recordings, *given, "--out", policies])
            for thresholds in options.thresholds if way else ["adaptive"]:
                table = table_of(folder, thresholds)
                if not table.exists():
                    run = ["run", policies, "--recordings", recordings, "--out", str(free(folder / thresholds))]
                    run += running_options(way, thresholds, options.episodes, controls=options.controls)
                    table.write_text(json.dumps(ran(run)) + "\n")
                lines.append(table_row(seed, way, thresholds, read_table(table)))
                print(lines[-1], flush=True)
    print(f"\n| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|")
    print("\n".join(lines))


def live_once(backend: str, channels: int, seed: int, robot: str, options: argparse.Namespace) -> str | None:
    """A row of the table: a culture is opened once, recorded, and driven by policies trained on that.

    None for a session that did not end as planned.
    """
    from animat.cultures.kinds import pulse_for
    from animat.cultures.series import record_series
    from animat.reality_gap import Calibration, run_policies
    from animat.recordings.reading import read_recording
    from animat.responses.extraction import extract_series
    from animat.stimulation.protocol import CLOSED_LOOP
    from animat.training.policy import load_policies

    folder = options.out / f"culture{seed}" / f"{backend}{channels or ''}" / robot
    table = folder / "once.json"
    if not table.exists():
        # A culture that was left half way cannot be resumed.
        attempt = next(path for i in itertools.count() if not (path := folder / f"attempt{i}").exists())
        with backends.opened(backend, channels, seed) as culture:
            pulse = pulse_for(backend)
            protocol = replace(CLOSED_LOOP, patterns=min(100, len(culture.patterns)), pulse=pulse)
            series = record_series(lambda: culture, protocol, attempt / "recordings", sessions=2, seed=seed)
            out = str(attempt / "policies")
            iterations = ["--iterations", str(options.iterations)] if options.iterations else []
            expect(["train", robot, "--recordings", str(attempt / "recordings"), *iterations, "--out", out])
            policies = load_policies(out)
            recordings = extract_series([read_recording(file) for file in series.files])
            gap = run_policies(
                policies,
                culture,
                Calibration.of_series(recordings, next(iter(policies.values()))),
                attempt / "session",
                episodes=options.episodes,
                with_controls=options.controls,
                pulse=pulse,
                patterns=protocol.patterns,
            )
        outcome = gap.to_dict()
        if outcome["session"]["ended_by"] != "plan":
            print(f"{attempt}: no row: {outcome['session']['ended']}", file=sys.stderr)
            return None
        table.write_text(json.dumps(outcome) + "\n")
    return table_row(seed, None, "adaptive", read_table(table))


FORMER = {"lived": "measured", "limit": "optimum"}
"""Keys in older tables."""
FORMER_FILES = {"adaptive": "follow", "fixed": "held"}
"""Names of older tables."""


def table_of(folder: Path, thresholds: str) -> Path:
    """Path of the table: the older one if it exists, else the new one."""
    former = folder / f"{FORMER_FILES[thresholds]}.json"
    return former if former.exists() else folder / f"{thresholds}.json"


def read_table(file: Path) -> dict[str, Any]:
    """The results of a run."""
    found: dict[str, Any] = json.loads(file.read_text(), object_hook=_renamed)
    return found


def _renamed(pairs: dict[str, Any]) -> dict[str, Any]:
    return {FORMER.get(key, key): value for key, value in pairs.items()}


def table_row(seed: int, way: Way | None, thresholds: str, ran: dict[str, Any]) -> str:
    """A row of the table; the range is from random to the optimum, both on the simulator."""
    policies, random = ran["rows"][0], next(row for row in ran["rows"] if row["name"] == "random")
    prediction, gap = policies["prediction"], policies["gap"]
    cells = (
        f"{seed}",
        ran["robot"],
        *((way.recorded, way.simulator, way.mapping) if way else ("default", "default", ran["mapping"])),
        thresholds,
        f"{random['predicted']:.1f}, {random['measured']:.1f}",
        "-" if ran["optimum"] is None else f"{ran['optimum']:.1f}",
        f"{prediction['value']:.1f} ({prediction['low']:.1f} to {prediction['high']:.1f})",
        f"{policies['measured']:.1f}",
        f"{gap['value']:+.1f} ({gap['low']:+.1f} to {gap['high']:+.1f})",
        "-" if ran["gap_share"] is None else f"{100 * ran['gap_share']:+.0f} %",
        f"{policies['pulses_per_action']:.0f}",
    )
    return f"| {' | '.join(cells)} |"


def free(folder: Path) -> Path:
    """A folder without a session: one that was killed before its table was written keeps its folder."""
    names = (folder.with_name(f"{folder.name}{number or ''}") for number in itertools.count())
    return next(name for name in names if not (name / "session.log").exists())


def expect(arguments: list[str]) -> None:
    """Run a command that must succeed."""
    status = animat(arguments)
    if status:
        raise SystemExit(status)


def ran(arguments: list[str]) -> dict[str, Any]:
    """Run a command and return its line of JSON."""
    import contextlib
    import io

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        expect([*arguments, "--json"])
    return json.loads(printed.getvalue().splitlines()[-1])  # type: ignore[no-any-return]


if __name__ == "__main__":
    main()
