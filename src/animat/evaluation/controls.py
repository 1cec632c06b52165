"""Controls that ask whether it is the culture that does the work: what is run beside trained policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from animat.environment import Animat, Environment
from animat.evaluation.heuristic import Heuristic, heuristic_policy
from animat.evaluation.rollouts import Actor, Constant, Networks, Uniform
from animat.neurons.simulator import NeuronSimulator, silenced
from animat.wrappers import ShuffledDelivery, unwrapped


@dataclass(frozen=True, eq=False)
class Control:
    """Somebody who acts in place of the policies, or the policies in a changed environment.

    Attributes:
        name: `random`, `constant 5 Hz`, `heuristic`, `silent` or `shuffled`.
        meaning: what it does, in a few words.
        environment, simulator: that it is run in.
        actor: who acts.
        n_actors: how many they are.
    """

    name: str
    meaning: str
    environment: Environment[Any]
    simulator: NeuronSimulator | None
    actor: Actor
    n_actors: int = 1


def controls_of(
    environment: Environment[Any],
    simulator: NeuronSimulator | None,
    labels: Sequence[str],
    policies: Networks | None = None,
    n_policies: int = 0,
) -> list[Control]:
    """The controls of an environment, each with what it is run in.

    *random*, an action drawn at random; *constant*, one action always, for each of them; *heuristic*, the robot's
    `heuristic`, where it has one; and through neurons, with policies: *silent*, on a culture that always answers 0;
    *shuffled*, with the delivered condition drawn anew at each iteration, whatever they chose.

    Args:
        environment, simulator: what the policies are evaluated in (no simulator without neurons).
        labels: of discrete actions.
        policies: several side by side; None leaves out what needs them.
        n_policies: how many.
    """
    controls = [Control("random", "any action, equally likely", environment, simulator, Uniform())]
    for i, label in enumerate(labels):
        constant = Constant(jnp.array([i]))
        controls.append(Control(f"constant {label}", "this one always", environment, simulator, constant))
    if hasattr(environment.robot, "heuristic"):
        rule: Actor = Heuristic()
        meaning = "no learning: the command of the robot's heuristic"
        if environment.n_actions is not None:
            rule = heuristic_policy(environment, simulator)
            meaning = "no learning: the stimulus nearest to the command of the robot's heuristic"
        controls.append(Control("heuristic", meaning, environment, simulator, rule))
    if policies is not None and isinstance(unwrapped(environment), Animat) and simulator is not None:
        silent, shuffled = silenced(simulator), ShuffledDelivery(environment)
        controls += [
            Control("silent", "the culture always answers 0", environment, silent, policies, n_policies),
            Control("shuffled", "the delivered condition is drawn anew", shuffled, simulator, policies, n_policies),
        ]
    return controls
