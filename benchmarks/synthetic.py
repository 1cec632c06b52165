"""Rules, reflexes and trained policies on synthetic responses, for which no culture is needed.

python benchmarks/synthetic.py rules reflexes            # a few minutes
python benchmarks/synthetic.py averaging exploration     # some twenty minutes on one core
"""

from __future__ import annotations

import argparse
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from animat import SAC, Animat, Thresholds, Training, best_returns, robot_named, train
from animat.evaluation.commands import mean_commands
from animat.evaluation.coupling import Coupling, best_coupling, context_gap
from animat.evaluation.rollouts import Actor, Uniform, heuristic_policy, networks_of, roll_out
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.synthetic import LABELS, synthetic_simulator
from animat.neurons.timeline import SimulatorTimeline
from animat.responses.condition import Condition

APART = synthetic_simulator((18.0, 26.0, 38.0, 52.0, 66.0), shape=10.0)
"""Responses that differ more between conditions than those of `synthetic_simulator()`."""


def timeline(simulator: NeuronSimulator) -> SimulatorTimeline:
    """A simulator as a timeline of one recording."""
    return SimulatorTimeline(
        simulators=jax.tree.map(lambda leaf: leaf[None], simulator),
        start_min=np.zeros(1),
        conditions=tuple(Condition(label, float(label.split()[0]), "Hz") for label in LABELS),
        window_ms=(2.0, 10.0),
        presentation=None,
        fidelities=(),
        findings=(),
    )


def rules() -> None:
    """The returns to expect of docs/gymnasium.md."""
    print("| | random actions | a rule | optimal return |\n|---|---|---|---|")
    simulator = synthetic_simulator()
    for name in ("cartpole", "navigation", "swing-up"):
        for n in (1, 9):
            environment = Animat(robot_named(name), Thresholds(n), 5)
            rule: Actor = heuristic_policy(environment, simulator)
            if name == "cartpole":
                # That of the page's first example, for observations in units of their scales.
                weights = jnp.append(jnp.array([1.0, 2.0, 30.0, 4.0]) * environment.scales, -1e-9)[None, None]
                actions, means = (jnp.asarray(x, jnp.float32)[None] for x in mean_commands(environment, simulator))
                rule = Coupling(weights, actions.astype(jnp.int32), means, "switch", (0, 1, 2, 3))
            ran = [roll_out(environment, simulator, who, episodes=100_000, seed=1).returns for who in (Uniform(), rule)]
            (best,) = best_returns([(environment, simulator)], episodes=0)
            cells = (f"{value:.1f}" for value in (*(returns.mean() for returns in ran), best.value))
            print(f"| {name}, {n} | " + " | ".join(cells) + " |", flush=True)


def reflexes() -> None:
    """The best coupling and the optimal return on responses that are further apart."""
    print("| task | thresholds | random | best coupling | optimal return | context gap |\n|---|---|---|---|---|---|")
    for name in ("cartpole", "navigation", "swing-up"):
        for n in (1, 9):
            environment = Animat(robot_named(name), Thresholds(n), 5)
            (best,) = best_returns([(environment, APART)], episodes=0)
            actors = Uniform(), best_coupling(environment, APART)
            random, reflex = (roll_out(environment, APART, who, episodes=2000, seed=1).returns[0] for who in actors)
            gap = context_gap(reflex, random, best).gap
            assert gap is not None
            means = (f"{value:.1f}" for value in (random.mean(), reflex.mean(), best.value))
            print(f"| {name} | {n} | " + " | ".join((*means, f"{gap.value:z.2f}")) + " |", flush=True)


def trained(robot: str, n: int, iterations: int, policies: int, simulator: Any, **settings: int) -> np.ndarray:
    """The mean return of each policy in 3,000 episodes, sorted."""
    # What was compiled may be of another way of exploring.
    jax.clear_caches()
    mapping = Thresholds(n)
    training = Training(robot, mapping, policies=policies, iterations=iterations, algorithm=SAC(**settings))
    networks = networks_of(list(train(training, timeline(simulator), None).values()), greedy=True)
    environment = Animat(training.robot, mapping, 5)
    return np.sort(roll_out(environment, simulator, networks, episodes=3000, seed=1).returns.mean(axis=1))


def averaging() -> None:
    """Five policies with the actor averaged over about the last quarter of training, the last ninth, and not at all."""
    for exponent in (3, 8, 1_000_000):
        returns = trained("cartpole", 1, 400_000, 5, synthetic_simulator(), averaging_exponent=exponent)
        print(f"averaging_exponent {exponent}: {shown(returns)}", flush=True)


def exploration() -> None:
    """Policies trained without and with held actions."""
    runs = (
        ("swing-up", 9, 500_000, 10, APART),
        ("swing-up", 1, 500_000, 10, APART),
        ("cartpole", 9, 400_000, 6, synthetic_simulator()),
        ("navigation", 1, 250_000, 20, synthetic_simulator()),
        ("navigation", 1, 500_000, 20, synthetic_simulator()),
    )
    for run in runs:
        with mock.patch("animat.training.exploration.is_useful", lambda _: jnp.array(False)):
            print(f"{run[:4]}, none held: {shown(trained(*run))}", flush=True)
        print(f"{run[:4]}, default: {shown(trained(*run))}", flush=True)


def shown(returns: np.ndarray) -> str:
    """Their mean with its standard error, and all."""
    error = returns.std(ddof=1) / np.sqrt(len(returns))
    return f"{returns.mean():.1f} ± {error:.1f}: " + " ".join(f"{each:.1f}" for each in returns)


TABLES = {"rules": rules, "reflexes": reflexes, "averaging": averaging, "exploration": exploration}


def main() -> None:
    """Print the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="+", choices=TABLES)
    for name in parser.parse_args().tables:
        TABLES[name]()


if __name__ == "__main__":
    main()
