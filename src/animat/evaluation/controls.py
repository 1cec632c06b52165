"""Controls that ask whether it is the culture that does the work: what is run beside trained policies.

Each is defined once: a simulator runs it as it is here, and a closed loop makes its agents of it
(`animat.closed_loop.agents.agent_of`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from animat.environment import Animat, Environment
from animat.evaluation.commands import mean_commands
from animat.evaluation.coupling import best_coupling
from animat.evaluation.heuristic import Heuristic, heuristic_policy
from animat.evaluation.rollouts import Actor, Constant, Networks, Uniform
from animat.neurons.simulator import NeuronSimulator, indifferent, silenced
from animat.robots.host import HostRobot
from animat.wrappers import (
    GoalSwitch,
    IdealActuator,
    ReversedMapping,
    ShuffledDelivery,
    YokedDelivery,
    replace_innermost,
    unwrapped,
)

Delivered = Literal["chosen", "shuffled", "silent", "yoked"]
"""What neurons are given; a training (`animat.wrappers.Delivery`) has the first two alone."""


@dataclass(frozen=True, eq=False)
class Control:
    """Somebody who acts in place of the policies, or the policies with one thing changed.

    Attributes:
        name: `random`, `constant 5 Hz`, `heuristic`, `silent` or `shuffled`, or an intervention's.
        meaning: what it does, in a few words.
        actor: who chooses: one, or the policies side by side.
        n_actors: how many they are.
        delivery: `"chosen"`: neurons get what was chosen; `"shuffled"`: a condition drawn anew at each iteration;
            `"silent"`: nothing; `"yoked"`: the stimuli of another episode.
        is_drawn: whether any recorded response is drawn in place of the neurons' own.
        is_turned_round: whether every command is turned into its opposite.
        switch_at: after how many iterations the robot is given another goal; None: never.
        commands: of each condition, by which the robot is moved in place of the response; None: by the response.
    """

    name: str
    meaning: str
    actor: Actor
    n_actors: int = 1
    delivery: Delivered = "chosen"
    is_drawn: bool = False
    is_turned_round: bool = False
    switch_at: int | None = None
    commands: tuple[Any, ...] | None = None

    def within(
        self, environment: Environment[Any], simulator: NeuronSimulator | None
    ) -> tuple[Environment[Any], NeuronSimulator | None]:
        """What it is run in on a simulator, of what the policies are run in; the very same where nothing is changed."""
        if self.is_turned_round or self.commands is not None:
            animat = unwrapped(environment)
            assert isinstance(animat, Animat)
            through = animat.robot, animat.mapping, animat.n_conditions
            changed = ReversedMapping(*through) if self.commands is None else IdealActuator(*through, self.commands)
            environment = replace_innermost(environment, lambda _: changed)
        if self.delivery == "shuffled":
            environment = ShuffledDelivery(environment)
        elif self.delivery == "yoked":
            environment = YokedDelivery(environment)
        elif self.delivery == "silent" and simulator is not None:
            # Whatever reaches neurons whose responses are drawn makes no difference.
            simulator = indifferent(simulator) if self.is_drawn else silenced(simulator)
        if self.switch_at is not None:
            environment = GoalSwitch(environment, self.switch_at)
        return environment, simulator


RANDOM = Control("random", "any action, equally likely", Uniform())


def controls_of(
    environment: Environment[Any],
    simulator: NeuronSimulator | None,
    labels: Sequence[str],
    policies: Networks | None = None,
    n_policies: int = 0,
) -> list[Control]:
    """The controls of an environment.

    *random*, an action drawn at random; *constant*, one action always, for each of them; *heuristic*, the robot's
    `heuristic`, where it has one; and through neurons, with policies: *silent*, on a culture without stimuli;
    *shuffled*, with the delivered condition drawn anew at each iteration, whatever they chose.

    Args:
        environment, simulator: what the policies are evaluated in (no simulator without neurons).
        labels: of discrete actions.
        policies: several side by side; None leaves out what needs them.
    """
    controls = [RANDOM]
    for i, label in enumerate(labels):
        controls.append(Control(f"constant {label}", "this one always", Constant(jnp.array([i]))))
    if hasattr(environment.robot, "heuristic"):
        rule: Actor = Heuristic()
        meaning = "no learning: the command of the robot's heuristic"
        if environment.n_actions is not None:
            rule = heuristic_policy(environment, simulator)
            meaning = "no learning: the stimulus nearest to the command of the robot's heuristic"
        controls.append(Control("heuristic", meaning, rule))
    if policies is not None and isinstance(unwrapped(environment), Animat) and simulator is not None:
        controls += _without_effect(policies, n_policies)
    return controls


def coupling_of(environment: Environment[Any], simulator: NeuronSimulator | None, *, seed: int) -> Control:
    """The best coupling as a control; arguments and errors as of `best_coupling`, whose search takes seconds."""
    reflex = best_coupling(environment, simulator, seed=seed)
    return Control("coupling", "the best reflex: no memory, no goal", reflex)


def interventions_of(
    environment: Environment[Any],
    simulator: NeuronSimulator,
    policies: Networks,
    n_policies: int,
    *,
    switch_at: int | None = None,
) -> list[Control]:
    """The same policies with one thing changed each, to see whose work it is.

    *ideal actuator*, each condition's mean command, stretched to the full range, in place of the response; *random
    spikes*, the culture's rates, whatever is chosen; *silent* and *shuffled* as among the controls; *yoked*, the
    stimuli of another episode; *turned round*, the opposite command; *goal switched*, another goal in mid-episode.

    Args:
        environment, simulator: what the policies are evaluated in.
        switch_at: the iteration at which the goal is switched; None leaves that out, as a robot with one goal does.
    """
    # Mean commands from -1 to 1, of each command; 0 where all are equal.
    means = mean_commands(environment, simulator)[1]
    low, high = means.min(axis=0), means.max(axis=0)
    stretched = np.where(high > low, 2 * (means - low) / np.where(high > low, high - low, np.inf) - 1, 0.0)
    ideal = tuple(tuple(row) if means.ndim > 1 else row for row in stretched.tolist())

    def control(name: str, meaning: str, **changed: Any) -> Control:
        return Control(name, meaning, policies, n_policies, **changed)

    found = [
        control(
            "ideal actuator",
            "each condition's mean command, stretched to the full range, in place of the response",
            commands=ideal,
        ),
        control(
            "random spikes",
            "no pulse; any recorded response in place of the neurons' own",
            delivery="silent",
            is_drawn=True,
        ),
        *_without_effect(policies, n_policies),
    ]
    if not isinstance(environment.robot, HostRobot):
        found.append(control("yoked", "the stimuli of another episode", delivery="yoked"))
    found.append(control("turned round", "the opposite of every command", is_turned_round=True))
    if switch_at is not None and hasattr(environment.robot, "with_goal_of"):
        found.append(control("goal switched", f"another goal after {switch_at} actions", switch_at=switch_at))
    return found


def _without_effect(policies: Networks, n_policies: int) -> list[Control]:
    """Policies whose choices decide nothing."""
    silent = "no pulse; what is there without stimuli is read (0 on a simulator)"
    return [
        Control("silent", silent, policies, n_policies, "silent"),
        Control("shuffled", "the delivered condition is drawn anew", policies, n_policies, "shuffled"),
    ]
