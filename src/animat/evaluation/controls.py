"""Controls and interventions that test whether the culture contributes to policies' returns, and their results."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from animat import wrappers
from animat.environment import Animat, Environment, Neurons
from animat.errors import within
from animat.evaluation.commands import mean_commands
from animat.evaluation.controllers import Called
from animat.evaluation.coupling import best_coupling
from animat.evaluation.rollouts import Actor, Constant, Episodes, Networks, Uniform, heuristic_policy, roll_out
from animat.evaluation.statistics import standard_error
from animat.neurons.simulator import NeuronSimulator, indifferent, silenced
from animat.robots.host import HostRobot
from animat.robots.starts import Starts

OWN = "your own agent"
ControlDelivery = Literal["chosen", "shuffled", "silent", "yoked"]
"""What neurons are given; in training (`animat.wrappers.Delivery`) only the first two exist."""


@dataclass(frozen=True, eq=False)
class Control:
    """An actor in place of the policies, or the policies with one change.

    Attributes:
        name: `random`, `constant 5 Hz`, `heuristic`, `silent` or `shuffled`, or the name of an intervention.
        actor: one actor, or the policies side by side; or a controller outside JAX.
        delivery: `"chosen"`: neurons get what was chosen; `"shuffled"`: a condition drawn at random in each iteration;
            `"silent"`: nothing; `"yoked"`: the stimuli of another episode.
        is_drawn: whether a random recorded response replaces the neurons' own.
        is_turned_round: whether every command is reversed.
        switch_at: number of iterations after which the robot's goal is switched; None: never.
        commands: of each condition, which move the robot in place of the response; None: the response moves it.
    """

    name: str
    meaning: str
    actor: Actor | Called
    delivery: ControlDelivery = "chosen"
    is_drawn: bool = False
    is_turned_round: bool = False
    switch_at: int | None = None
    commands: tuple[Any, ...] | None = None

    def within(self, environment: Environment[Any], simulator: Neurons) -> tuple[Environment[Any], Neurons]:
        """The policies' environment and simulator, changed for this control; the same objects if nothing changes."""
        if self.is_turned_round or self.commands is not None:
            animat = wrappers.unwrapped(environment)
            assert isinstance(animat, Animat)
            # Not `replace`: a user's subclass of Animat may have further attributes.
            of = animat.robot, animat.mapping, animat.n_conditions
            changed: Animat[Any] = wrappers.ReversedMapping(*of)
            if self.commands is not None:
                changed = wrappers.IdealActuator(*of, self.commands)
            environment = wrappers.replace_innermost(environment, lambda _: changed)
        if self.delivery == "shuffled":
            environment = wrappers.ShuffledDelivery(environment)
        elif self.delivery == "yoked":
            environment = wrappers.YokedDelivery(environment)
        elif self.delivery == "silent" and simulator is not None:
            # Where responses are drawn at random, they do not depend on whether anything is delivered.
            simulator = indifferent(simulator) if self.is_drawn else silenced(simulator)
        if self.switch_at is not None:
            environment = wrappers.GoalSwitch(environment, self.switch_at)
        return environment, simulator

    def run(
        self,
        environment: Environment[Any],
        simulator: Neurons,
        *,
        episodes: int,
        seed: int,
        starts: Starts | None = None,
    ) -> Episodes:
        """Its episodes in the policies' environment and simulator, changed for it; errors as in `roll_out`."""
        changed = self.within(environment, simulator)
        with within(f"agents: {self.name}") if self.meaning == OWN else nullcontext():
            return roll_out(*changed, self.actor, episodes=episodes, seed=seed, starts=starts)


RANDOM = Control("random", "any action, equally likely", Uniform())


def controls_of(
    environment: Environment[Any], simulator: Neurons, labels: Sequence[str], policies: Networks | None = None
) -> list[Control]:
    """The controls of an environment.

    *random*, an action drawn at random; *constant*, always the same action, one control for each; *heuristic*, the
    robot's `heuristic`, if it has one; and, through neurons, with policies: *silent*, on a culture without stimuli;
    *shuffled*, with the delivered condition drawn at random in each iteration, whatever they choose.

    `labels` are those of discrete actions; without `policies`, the controls that need them are left out.
    """
    controls = [RANDOM]
    for i, label in enumerate(labels):
        controls.append(Control(f"constant {label}", "always this one", Constant(jnp.array([i]))))
    if hasattr(environment.robot, "heuristic"):
        chosen = "stimulus" if isinstance(wrappers.unwrapped(environment), Animat) else "action"
        action = "the command" if environment.n_actions is None else f"the {chosen} nearest to the command"
        meaning = f"no learning: {action} of the robot's heuristic"
        controls.append(Control("heuristic", meaning, heuristic_policy(environment, simulator)))
    if policies is not None and isinstance(wrappers.unwrapped(environment), Animat):
        controls += _without_influence(policies)
    return controls


def coupling_of(environment: Environment[Any], simulator: Neurons, *, seed: int) -> Control:
    """The best coupling as a control; arguments and errors as in `best_coupling`, whose search takes seconds."""
    reflex = best_coupling(environment, simulator, seed=seed)
    return Control("coupling", "the best reflex: no memory, no goal", reflex)


def interventions_of(
    environment: Environment[Any], simulator: NeuronSimulator, policies: Networks, *, switch_at: int | None = None
) -> list[Control]:
    """The same policies with one change each, to find out what the culture contributes.

    *ideal actuator*, each condition's mean command, stretched to the full range, in place of the response; *random
    spikes*, the culture's rates, whatever is chosen; *silent* and *shuffled*, as in the controls; *yoked*, the stimuli
    of another episode; *turned round*, the opposite command; *goal switched*, a different goal in mid-episode.

    Without `switch_at`, the iteration of the goal's switch, that one is left out, as for a robot with one goal.
    """
    # Mean commands stretched to -1 to 1, each dimension separately; 0 where all are equal. They belong to delivered
    # conditions: under shuffled delivery all chosen ones would have the same.
    means = mean_commands(wrappers.unwrapped(environment), simulator)[1]
    low, high = means.min(axis=0), means.max(axis=0)
    stretched = 2 * (means - low) / np.where(high > low, high - low, np.inf) - (high > low)
    ideal = tuple(tuple(row) if means.ndim > 1 else row for row in stretched.tolist())
    by_means = "each condition's mean command, stretched to the full range, in place of the response"
    at_random = "no pulse; a random recorded response in place of the neurons' own"
    changed = [
        Control("ideal actuator", by_means, policies, commands=ideal),
        Control("random spikes", at_random, policies, "silent", is_drawn=True),
        *_without_influence(policies),
    ]
    if not isinstance(environment.robot, HostRobot):
        changed.append(Control("yoked", "the stimuli of another episode", policies, "yoked"))
    changed.append(Control("turned round", "the opposite of every command", policies, is_turned_round=True))
    if switch_at is not None and hasattr(environment.robot, "with_goal_of"):
        meaning = f"a different goal after {switch_at} actions"
        changed.append(Control("goal switched", meaning, policies, switch_at=switch_at))
    return changed


def _without_influence(policies: Networks) -> list[Control]:
    """Policies whose choices have no effect."""
    silent = "no pulse; only spontaneous activity is read (0 on a simulator)"
    return [
        Control("silent", silent, policies, "silent"),
        Control("shuffled", "the delivered condition is drawn at random", policies, "shuffled"),
    ]


@dataclass(frozen=True, eq=False)
class EvaluationRow:
    """A row of the table: `policies` or a control, with its returns.

    Attributes:
        changed: whether its environment differs from that of the policies: another culture, or another delivery.
        electrode_pulses: mean number per episode, for each actor; None if the conditions' electrodes are not known.
        pulse_cost: of one electrode pulse, in the units of the return.
    """

    name: str
    meaning: str
    episodes: Episodes
    changed: bool = False
    electrode_pulses: Float64[np.ndarray, " actors"] | None = None
    pulse_cost: float = 0.0

    @property
    def mean_returns(self) -> Float64[np.ndarray, " actors"]:
        """Each actor's mean return over its episodes, which the paper calls a policy's performance."""
        return self.episodes.returns.mean(axis=1)  # type: ignore[no-any-return]

    def to_dict(self) -> dict[str, Any]:
        """The row as plain data; the net return is the mean return less the cost of pulses, if these are known."""
        means = self.mean_returns
        pulses = None if self.electrode_pulses is None else float(self.electrode_pulses.mean())
        # The samples are the actors; a control has one actor, whose episodes are the samples.
        samples = means if len(means) > 1 else self.episodes.returns[0]
        return {
            "name": self.name,
            "meaning": self.meaning,
            "actors": len(means),
            "episodes": self.episodes.returns.shape[1],
            "mean_return": float(means.mean()),
            "standard_error": standard_error(samples) if len(samples) > 1 else None,
            "mean_length": float(self.episodes.lengths.mean()),
            "terminated_share": float(self.episodes.terminated.mean()),
            "mean_returns": means.tolist(),
            "electrode_pulses": pulses,
            "net_return": None if pulses is None else float(means.mean()) - self.pulse_cost * pulses,
            **self.met,
        }

    @property
    def met(self) -> dict[str, Any]:
        """How the goal was met (`animat.goals.tally.Outcome.means`); empty for a robot without one."""
        return {} if self.episodes.outcome is None else self.episodes.outcome.means()
