"""Who acts in a closed loop: policies, and the controls that ask whether it is the culture that does the work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Array, Float, Float32, Float64

from animat.environment import Animat, Environment
from animat.errors import InvalidArgument
from animat.evaluation.controls import RANDOM, Control, Delivered
from animat.evaluation.rollouts import Actor, Constant, Networks, Uniform


class Controller(Protocol):
    """Whoever chooses conditions: a `Policy`, or anything else that acts like one."""

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The index of the condition to present, given the robot's observation in its own units."""


@dataclass(frozen=True)
class AnyCondition:
    """Every condition equally likely, whatever is observed: the random control."""

    n_conditions: int

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        """Draw."""
        return int(rng.integers(self.n_conditions))


@dataclass(frozen=True)
class OneCondition:
    """One condition always: the constant control."""

    condition: int

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        """That one."""
        return self.condition


@dataclass(frozen=True)
class Greedy:
    """A policy's most probable condition, where the policy itself would draw one."""

    policy: Any

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The most probable one."""
        return self.policy.act_greedily(observation)


class ActorController:
    """Whoever acts on a simulator (`animat.evaluation.rollouts.Actor`), for one observation at a time.

    Args:
        actor: one, its arrays with a leading axis of actors, as for `roll_out`.
        environment: that it acts in on the simulator, without what policies see of the neurons.
    """

    def __init__(self, actor: Actor, environment: Animat[Any]) -> None:
        self._actor: Actor = jax.tree.map(lambda x: x[0], actor)
        self._environment = environment
        # Now: what JAX compiles for a first call would come late in a loop.
        self.act(np.zeros(len(environment.observation_spec)), np.random.default_rng())

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        """As on the simulator."""
        # Drawn apart: most actors draw nothing, and whatever else the loop draws is the same beside them.
        uniforms = rng.spawn(1)[0].random(self._environment.n_drawn, np.float32)
        return int(_decided(self._environment, self._actor, np.asarray(observation, np.float32), uniforms))


@partial(jax.jit, static_argnums=0)
def _decided(
    environment: Environment[Any],
    actor: Actor,
    observation: Float32[Array, " observations"],
    uniforms: Float32[Array, " drawn"],
) -> Array:
    return actor.act(environment, (observation / environment.scales)[None], uniforms[None])[0]


@dataclass(frozen=True)
class InTurn:
    """Several who take turns, an episode each: a control is then one of all policies, and not of one of them.

    Attributes:
        by_name: who, in their order.
    """

    by_name: Mapping[str, Controller]

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The first one's choice; the loop takes each at its turn (`Agent.acting`)."""
        return self.acting(0).act(observation, rng)

    def acting(self, turn: int) -> Controller:
        """Whose turn it is."""
        controllers = tuple(self.by_name.values())
        return controllers[turn % len(controllers)]


@dataclass(frozen=True, eq=False)
class Agent:
    """Someone who acts in some of a session's episodes.

    Attributes:
        name: unique in its session.
        meaning: what it is, in a few words.
        controller: who chooses.
        delivery: as of a control (`animat.evaluation.controls.Control`). `"silent"`: what the culture fires by itself
            is read where the response would be; `"yoked"`: what was given in the last whole episode of those who take
            turns here, over and over.
        calibrates: whether its responses count for adaptive thresholds; one condition presented over and over is
            answered otherwise than between others. The warm-up of its episodes always counts.
        drawn_from: responses that one is drawn from in place of the culture's; None: the culture's own is read.
        is_turned_round: whether every command is turned into its opposite.
        switch_at: after how many iterations the robot is given another goal; None: never.
    """

    name: str
    meaning: str
    controller: Controller
    delivery: Delivered = "chosen"
    calibrates: bool = True
    drawn_from: Float64[np.ndarray, "responses *readouts"] | None = None
    is_turned_round: bool = False
    switch_at: int | None = None

    def sees_neurons(self, turn: int) -> bool:
        """Whether whoever chooses in its episode number `turn` sees the history state too."""
        controller = self.acting(turn)
        policy = controller.policy if isinstance(controller, Greedy) else controller
        return bool(getattr(policy, "neural_observation", False))

    def acting(self, turn: int) -> Controller:
        """Who chooses in the agent's episode number `turn`, counted from 0."""
        return self.controller.acting(turn) if isinstance(self.controller, InTurn) else self.controller


def random_control(n_conditions: int) -> Agent:
    """The control that chooses any condition."""
    return Agent(RANDOM.name, RANDOM.meaning, AnyCondition(n_conditions))


def agent_of(
    control: Control,
    environment: Animat[Any],
    policies: Mapping[str, Controller],
    responses_hz: Float64[np.ndarray, "responses *readouts"],
) -> Agent:
    """A control of the simulator as an agent of a closed loop, where policies take turns in what is done with them.

    Args:
        environment: robot and mapping.
        policies: by name.
        responses_hz: non-burst responses of all conditions, for random spikes.

    Raises:
        InvalidArgument: for a control that moves the robot by commands of its own: no loop can.
    """
    if control.commands is not None:
        raise InvalidArgument(
            f"control: expected one whose commands come from responses, got {control.name}; it runs on a simulator only"
        )
    actor = control.actor
    controller: Controller
    if isinstance(actor, Networks):
        controller = InTurn(dict(policies))
    elif isinstance(actor, Uniform):
        controller = AnyCondition(environment.n_conditions)
    elif isinstance(actor, Constant):
        controller = OneCondition(int(actor.action[0]))
    else:
        controller = ActorController(actor, environment)
    return Agent(
        control.name,
        control.meaning,
        controller,
        control.delivery,
        # The same stimuli over and over are answered otherwise than among others.
        calibrates=control.delivery != "yoked" and not isinstance(actor, Constant),
        drawn_from=responses_hz if control.is_drawn else None,
        is_turned_round=control.is_turned_round,
        switch_at=control.switch_at,
    )


def interleaved(episodes: Sequence[int], rng: np.random.Generator) -> list[int]:
    """Whose turn each episode is, in random order and spread evenly: whatever drifts in the culture hits all alike.

    The session is cut into as many equal parts as an agent has episodes, and one of them is in each part. Where all
    have as many, round follows round of all of them.

    Args:
        episodes: of each agent.
        rng: of the places within the parts.
    """
    places = [(part + rng.random()) / n for n in episodes for part in range(n)]
    whose = np.repeat(np.arange(len(episodes)), episodes)
    return [int(who) for who in whose[np.argsort(places, kind="stable")]]
