"""Controls that ask whether it is the culture that does the work: what is run beside trained policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from animat.environment import Animat, Environment
from animat.evaluation.commands import mean_commands
from animat.evaluation.heuristic import Heuristic, heuristic_policy
from animat.evaluation.rollouts import Actor, Constant, Networks, Uniform
from animat.neurons.simulator import NeuronSimulator, indifferent, silenced
from animat.robots.host import HostRobot
from animat.wrappers import (
    GoalSwitch,
    IdealActuator,
    ShuffledDelivery,
    TurnedRound,
    YokedDelivery,
    unwrapped,
    with_inmost,
)


@dataclass(frozen=True, eq=False)
class Control:
    """Somebody who acts in place of the policies, or the policies in a changed environment.

    Attributes:
        name: `random`, `constant 5 Hz`, `heuristic`, `silent` or `shuffled`.
        meaning: what it does, in a few words.
        is_stimulated: whether any pulse is delivered.
    """

    name: str
    meaning: str
    environment: Environment[Any]
    simulator: NeuronSimulator | None
    actor: Actor
    n_actors: int = 1
    is_stimulated: bool = True


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
        controls += _without_effect(environment, simulator, policies, n_policies)
    return controls


def interventions_of(
    environment: Environment[Any],
    simulator: NeuronSimulator,
    policies: Networks,
    n_policies: int,
    *,
    switch_at: int | None = None,
) -> list[Control]:
    """The same policies in what is changed in one way each, to see whose work it is.

    *ideal actuator*, each condition's mean command, stretched to the full range, in place of the response; *random
    spikes*, the culture's rates, whatever is delivered; *silent* and *shuffled* as among the controls; *yoked*, the
    stimuli of another episode; *turned round*, the opposite command; *goal switched*, another goal in mid-episode.

    Args:
        environment, simulator: what the policies are evaluated in.
        switch_at: the iteration at which the goal is switched; None leaves that out, as a robot with one goal does.
    """
    animat = unwrapped(environment)
    assert isinstance(animat, Animat)
    # Mean commands from -1 to 1, of each command; 0 where all are equal.
    means = mean_commands(environment, simulator)[1]
    low, high = means.min(axis=0), means.max(axis=0)
    stretched = np.where(high > low, 2 * (means - low) / np.where(high > low, high - low, np.inf) - 1, 0.0)
    levels = tuple(tuple(row) if means.ndim > 1 else row for row in stretched.tolist())
    ideal = IdealActuator(animat.robot, animat.mapping, animat.n_conditions, levels)

    def control(name: str, meaning: str, changed: Environment[Any], culture: NeuronSimulator = simulator) -> Control:
        return Control(name, meaning, changed, culture, policies, n_policies)

    found = [
        control(
            "ideal actuator",
            "each condition's mean command, stretched to the full range, in place of the response",
            with_inmost(environment, lambda _: ideal),
        ),
        control("random spikes", "at the culture's rates, whatever is delivered", environment, indifferent(simulator)),
        *_without_effect(environment, simulator, policies, n_policies),
    ]
    if not isinstance(environment.robot, HostRobot):
        found.append(control("yoked", "the stimuli of another episode", YokedDelivery(environment)))
    found.append(control("turned round", "the opposite of every command", turned_round(environment)))
    if switch_at is not None and hasattr(environment.robot, "with_goal_of"):
        switched = GoalSwitch(environment, switch_at)
        found.append(control("goal switched", f"another goal after {switch_at} actions", switched))
    return found


def turned_round(environment: Environment[Any]) -> Environment[Any]:
    """The same with the opposite of every command."""
    animat = unwrapped(environment)
    assert isinstance(animat, Animat)
    turned = TurnedRound(animat.robot, animat.mapping, animat.n_conditions)
    return with_inmost(environment, lambda _: turned)


def _without_effect(
    environment: Environment[Any], simulator: NeuronSimulator, policies: Networks, n_policies: int
) -> list[Control]:
    """Policies whose choices decide nothing."""
    silent, shuffled = silenced(simulator), ShuffledDelivery(environment)
    return [
        Control("silent", "the culture always answers 0", environment, silent, policies, n_policies, False),
        Control("shuffled", "the delivered condition is drawn anew", shuffled, simulator, policies, n_policies),
    ]
