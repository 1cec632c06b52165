"""The optimal return on synthetic responses, on finer and coarser grids, and how often its interval contains it.

    python benchmarks/optimal_return.py mappings grids
    python benchmarks/optimal_return.py memory [--recordings recordings/]
    python benchmarks/optimal_return.py coverage [--series 60]

*mappings*, *grids* and *memory* (of the last of some recordings) take a few minutes. *coverage* takes seconds for each
series of responses, so hours in all.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

import animat
from animat import Animat, Cartpole, Linear, Navigation, Thresholds, WithoutNeurons, best_returns
from animat.environment import Environment
from animat.evaluation.optimal_returns import WellSampled
from animat.evaluation.optimum import Optimum, best_return
from animat.evaluation.rollouts import Uniform, roll_out
from animat.neurons.simulator import NeuronSimulator, fit_histogram
from animat.neurons.synthetic import synthetic_simulator
from animat.responses.responses import Responses

EPISODES = 4000
SPREADS = {
    "5 conditions, small differences": (0.8, 0.9, 1.0, 1.1, 1.25),
    "5, two of them different": (0.7, 1.0, 1.0, 1.0, 1.4),
    "2 conditions": (0.7, 1.4),
    "5 conditions, no difference": (1.0,) * 5,
}
"""Mean responses to the conditions, relative to each other."""
RESOLUTION = 0.3
"""Of the grid on which intervals are computed: coarse, so that a series takes seconds."""


def mappings() -> None:
    """Both published robots with every mapping, on synthetic responses, and without neurons."""
    print("| robot | mapping | random | optimal return | grid error | run with the clock | without the clock |")
    print("|---" * 7 + "|")
    simulator = synthetic_simulator()
    for robot, commands in ((Cartpole(), (-1.0, 1.0)), (Navigation(), None)):
        through = [(Animat(robot, mapping, 5), simulator) for mapping in (Thresholds(1), Thresholds(9), Linear())]
        for environment, neurons in [*through, (WithoutNeurons(robot, commands), None)]:
            (best,) = best_returns([(environment, neurons)], episodes=EPISODES)
            random = roll_out(environment, neurons, Uniform(), episodes=EPISODES, seed=1).returns.mean()
            mapping = environment.mapping.name if isinstance(environment, Animat) else "no neurons"
            cells = (robot.name, mapping, f"{random:.1f}", f"{best.value:.1f}", f"{best.grid_error:.1f}")
            played = (f"{mean:.1f}" for mean in (best.monte_carlo, best.without_clock))
            print("| " + " | ".join((*cells, *played)) + " |", flush=True)


def grids() -> None:
    """The cartpole's optimum on synthetic responses, on coarser and finer grids."""
    print("| resolution | optimal return, 1 threshold | optimal return, 9 thresholds |\n|---|---|---|")
    cases = [(Animat(Cartpole(), Thresholds(n), 5), synthetic_simulator()) for n in (1, 9)]
    for resolution in (0.75, 1.0, 1.2, 1.4):
        found = best_returns(cases, resolution=resolution, episodes=0)
        print(f"| {resolution} | " + " | ".join(f"{each.value:.2f}" for each in found) + " |", flush=True)


def memory(recordings: str) -> None:
    """The cartpole's optimum on the simulator with memory of the last recording, with several numbers of classes."""
    print("| thresholds | classes | optimal return | run with the clock | without the clock |\n|---|---|---|---|---|")
    responses = animat.extract_series(animat.read_recordings(recordings))[-1]
    simulator = animat.fit_memory(responses)
    for n in (1, 9):
        environment = Animat(Cartpole(), Thresholds(n), len(responses.conditions))
        for classes in (4, 6, 10):
            in_commands = mock.patch("animat.evaluation.commands.CLASSES", classes)
            with in_commands, mock.patch("animat.evaluation.optimum.CLASSES", classes):
                (best,) = best_returns([(environment, simulator)], resolution=0.6, episodes=EPISODES)
            with_clock = f"{best.monte_carlo:.1f} ± {best.standard_error:.1f}"
            without = f"{best.without_clock:.1f} ± {best.without_clock_standard_error:.1f}"
            print(f"| {n} | {classes} | {best.value:.1f} | {with_clock} | {without} |", flush=True)


def coverage(series: int) -> None:
    """How often the 95 % interval, without the grid's error, contains the optimum of the true distributions."""
    print("| responses per condition | " + " | ".join(SPREADS) + " |\n|---" + "|---" * len(SPREADS) + "|")
    true = {spread: _best(*_case(drawn(40_000, spread, 0))).value for spread in SPREADS.values()}
    for n in (10, 30, 100):
        held = dict.fromkeys(SPREADS.values(), 0)
        for spread in held:
            for seed in range(1, series + 1):
                responses = drawn(n, spread, seed)
                environment, simulator = _case(responses)
                exact = replace(_best(environment, simulator), grid_error=0.0)
                sampled = WellSampled(environment, simulator, responses, (), fit_histogram)
                interval = sampled.with_interval(exact, resolution=RESOLUTION).interval
                assert interval is not None
                held[spread] += interval.low <= true[spread] <= interval.high
        shares = (f"{100 * count / series:.0f} %" for count in held.values())
        print(f"| {n} | " + " | ".join(shares) + " |", flush=True)


def drawn(n: int, spread: Sequence[float], seed: int) -> Responses:
    """n responses to each condition from gamma distributions of shape 3, with means of 15 Hz times `spread`."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from test_optimal_returns import answers

    return answers([n] * len(spread), seed, spread)


def _case(responses: Responses) -> tuple[Animat, NeuronSimulator]:
    return Animat(Cartpole(), Thresholds(1), len(responses.conditions)), fit_histogram(responses)


def _best(environment: Environment, simulator: NeuronSimulator) -> Optimum:
    return best_return(environment, simulator, resolution=RESOLUTION, episodes=0)


def main() -> None:
    """Print the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="+", choices=("mappings", "grids", "memory", "coverage"))
    parser.add_argument("--recordings", default="recordings", help="for memory")
    parser.add_argument("--series", type=int, default=60, help="of responses, for each number of them")
    given = parser.parse_args()
    if "mappings" in given.tables:
        mappings()
    if "grids" in given.tables:
        grids()
    if "memory" in given.tables:
        memory(given.recordings)
    if "coverage" in given.tables:
        coverage(given.series)


if __name__ == "__main__":
    main()
