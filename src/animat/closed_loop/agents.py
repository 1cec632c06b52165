"""The agents of a closed loop: policies, and controls that test whether the culture does the work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, get_args

import jax
import numpy as np
from jaxtyping import Array, Float, Float64

from animat.environment import Animat, Environment
from animat.errors import InvalidArgument, shown
from animat.evaluation.controllers import Called, Controller, can_act, sees_neurons
from animat.evaluation.controls import RANDOM, Control, ControlDelivery
from animat.evaluation.rollouts import Actor, Constant, Networks, Uniform


@dataclass(frozen=True)
class AnyCondition:
    """Every condition equally likely, whatever is observed: the random control."""

    n_conditions: int

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        return int(rng.integers(self.n_conditions))


@dataclass(frozen=True)
class OneCondition:
    """Always the same condition: the constant control."""

    condition: int

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        return self.condition


@dataclass(frozen=True)
class Greedy:
    """A policy's most probable condition, where the policy itself would draw one."""

    policy: Any

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        return self.policy.act_greedily(observation)


class ActorController:
    """An actor of the simulator (`animat.evaluation.rollouts.Actor`), for one observation at a time.

    Args:
        actor: its arrays have a leading axis of actors, of length one, as for `roll_out`.
        environment: in which it acts on the simulator, without the policies' observation of the neurons.
    """

    def __init__(self, actor: Actor, environment: Animat[Any]) -> None:
        self._actor: Actor = jax.tree.map(lambda x: x[0], actor)
        self._environment = environment
        # Compile now: in a loop the first call would come late.
        self.act(np.zeros(len(environment.observation_spec)), np.random.default_rng())

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        # From a generator of its own, so that the loop's other draws do not depend on the actor.
        uniforms = rng.spawn(1)[0].random(self._environment.n_drawn, np.float32)
        return int(_decided(self._environment, self._actor, np.asarray(observation, np.float32), uniforms))


@partial(jax.jit, static_argnums=0)
def _decided(environment: Environment[Any], actor: Actor, observation: Array, uniforms: Array) -> Array:
    return actor.act(environment, (observation / environment.scales)[None], uniforms[None])[0]


@dataclass(frozen=True, eq=False)
class Agent:
    """An agent, which acts in some of a session's episodes.

    Attributes:
        name: unique in its session.
        controller: chooses the conditions; several, by name, take turns, one episode each: a control then represents
            all policies, not one of them.
        delivery: as for a control (`animat.evaluation.controls.Control`). `"silent"`: spontaneous activity is read in
            place of the response; `"yoked"`: the stimuli of the last whole episode of one of its controllers are
            repeated.
        calibrates: whether its responses count for adaptive thresholds; responses to one condition differ when it is
            presented over and over. The warm-up of its episodes always counts.
        drawn_from: responses from which one is drawn in place of the culture's; None: the culture's own is read.
        is_turned_round: whether every command is reversed.
        switch_at: the iteration after which the robot gets another goal; None: never.

    Raises:
        InvalidArgument: for another delivery, or a controller without `act`.
    """

    name: str
    meaning: str
    controller: Controller | Mapping[str, Controller]
    delivery: ControlDelivery = "chosen"
    calibrates: bool = True
    drawn_from: Float64[np.ndarray, "responses *readouts"] | None = None
    is_turned_round: bool = False
    switch_at: int | None = None

    def __post_init__(self) -> None:
        if self.delivery not in get_args(ControlDelivery):
            kinds = ", ".join(get_args(ControlDelivery))
            raise InvalidArgument(f"{self.name}: delivery: expected one of {kinds}, got {self.delivery!r}")
        controllers = self.controller.values() if isinstance(self.controller, Mapping) else (self.controller,)
        for controller in controllers:
            if not can_act(controller):
                raise InvalidArgument(f"{self.name}: controller: expected a method `act`, got {shown(controller)}")

    def sees_neurons(self, turn: int) -> bool:
        """Whether the controller of its episode number `turn` also sees the history state."""
        return sees_neurons(self.acting(turn))

    def acting(self, turn: int) -> Controller:
        """The controller of the agent's episode number `turn`, counted from 0."""
        if not isinstance(self.controller, Mapping):
            return self.controller
        controllers = tuple(self.controller.values())
        return controllers[turn % len(controllers)]


def random_control(n_conditions: int) -> Agent:
    """The random control."""
    return Agent(RANDOM.name, RANDOM.meaning, AnyCondition(n_conditions))


def agent_of(
    control: Control,
    environment: Animat[Any],
    policies: Mapping[str, Controller],
    responses_hz: Float64[np.ndarray, "responses *readouts"],
) -> Agent:
    """A control of the simulator as an agent of a closed loop, in which policies take turns.

    Random spikes are drawn from `responses_hz`, the non-burst responses of all conditions. InvalidArgument is raised
    for a control whose commands do not come from responses, which no loop can run.
    """
    if control.commands is not None:
        raise InvalidArgument(f"control: expected one whose commands come from responses, got {control.name}")
    actor = control.actor
    controller: Controller | Mapping[str, Controller]
    if isinstance(actor, Networks):
        controller = policies
    elif isinstance(actor, Uniform):
        controller = AnyCondition(environment.n_conditions)
    elif isinstance(actor, Constant):
        controller = OneCondition(int(actor.action[0]))
    elif isinstance(actor, Called):
        controller = actor.controller
    else:
        controller = ActorController(actor, environment)
    return Agent(
        control.name,
        control.meaning,
        controller,
        control.delivery,
        # Responses to stimuli that repeat differ from responses to mixed ones.
        calibrates=control.delivery != "yoked" and not isinstance(actor, Constant),
        drawn_from=responses_hz if control.is_drawn else None,
        is_turned_round=control.is_turned_round,
        switch_at=control.switch_at,
    )


def interleave(episodes: Sequence[int], rng: np.random.Generator) -> list[int]:
    """The agent of each episode, in random order and spread evenly, so that drift affects all agents alike.

    For each agent the session is divided into as many equal parts as it has episodes, with one episode in each part. If
    all have equally many, they act in rounds.
    """
    places = [(part + rng.random()) / n for n in episodes for part in range(n)]
    agents = np.repeat(np.arange(len(episodes)), episodes)
    return [int(agent) for agent in agents[np.argsort(places, kind="stable")]]
