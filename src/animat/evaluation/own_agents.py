"""Agents of one's own, in JAX or not, as rows of the tables beside policies and controls."""

from __future__ import annotations

import operator
import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from animat.environment import Environment, Neurons
from animat.errors import InvalidArgument, first_line, shown, some_of, within
from animat.evaluation.controls import Control
from animat.evaluation.rollouts import Actor, Seen, Uniforms, trace
from animat.registry import imported
from animat.responses.condition import Condition
from animat.robots.host import HostRobot
from animat.wrappers import unwrapped

_GRID = 2**24
"""Uniforms of single precision are multiples of 1 / 2^24."""


class Controller(Protocol):
    """What chooses conditions: a `Policy`, or anything else that acts like one."""

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The index of the condition to present, for the robot's observation in its own units."""


@final
@jax.tree_util.register_static
class Called(Actor):
    """A controller outside JAX as an actor: it is called for every observation of every episode.

    What goes wrong in a call is kept, as JAX would report it in its own words; see `expect_no_failure`.
    """

    def __init__(self, name: str, controller: Controller) -> None:
        self.name, self.controller = name, controller
        self._failure: BaseException | None = None
        self._lock = threading.Lock()

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        n, seen = environment.n_actions or 0, observation * environment.scales
        if not sees_neurons(self.controller):
            seen = seen[:, : len(environment.robot.observation_spec)]

        def choose(observation: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
            # A prediction uses several threads, which the controller need not know.
            with self._lock:
                return np.array([self._choose(*each, n) for each in zip(observation, uniforms, strict=True)], np.int32)

        chosen = jax.ShapeDtypeStruct(observation.shape[:1], jnp.int32)
        called: Array = jax.pure_callback(choose, chosen, seen, uniforms[:, 0], vmap_method="sequential")
        return called

    def _choose(self, observation: np.ndarray, uniform: float, n_actions: int) -> int:
        if self._failure is not None:
            return 0
        try:
            chosen = self.controller.act(np.array(observation), np.random.default_rng(int(uniform * _GRID)))
            return _expect_condition(chosen, n_actions)
        except (Exception, SystemExit) as error:
            self._failure = error
            return 0

    def expect_no_failure(self) -> None:
        if (failure := self._failure) is not None:
            self._failure = None
            what = str(failure) if isinstance(failure, InvalidArgument) else first_line(failure)
            raise InvalidArgument(f"agents: {self.name}: {what}") from failure


@final
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RobotOnly(Actor):
    """An actor that sees the robot only, as it does in a closed loop, where the policies also see the neurons."""

    actor: Actor

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        inside = unwrapped(environment)
        return self.actor.act(inside, observation[:, : len(inside.observation_spec)], uniforms)


def sees_neurons(controller: Controller) -> bool:
    """Whether a controller, or the policy that it makes greedy, also observes the neurons' history state."""
    return bool(getattr(getattr(controller, "policy", controller), "neural_observation", False))


def controls_of_own(
    agents: Mapping[str, Actor | Controller], environment: Environment[Any], simulator: Neurons, taken: Collection[str]
) -> list[Control]:
    """Agents of one's own as controls.

    Raises InvalidArgument for one that cannot act in this environment, tried for some episodes if it is in JAX, and for
    a name that is `taken`.
    """
    if agents and environment.n_actions is None:
        raise InvalidArgument("agents: expected none, as these policies choose from no conditions, got some")
    controls = []
    for name, agent in agents.items():
        if name in taken:
            raise InvalidArgument(f"agents: expected names other than {some_of(sorted(taken))}, got {name}")
        if not callable(getattr(agent, "act", None)):
            raise InvalidArgument(f"agents: {name}: expected an Actor, or a method `act`, got {shown(agent)}")
        has_neurons = len(environment.observation_spec) > len(environment.robot.observation_spec)
        if isinstance(agent, Actor):
            actor = RobotOnly(agent) if has_neurons else agent
            _try(name, actor, environment, simulator)
        elif sees_neurons(agent) and not has_neurons:
            got = "one with neural_observation, which these policies do not have"
            raise InvalidArgument(f"agents: {name}: expected one that sees the robot only, got {got}")
        else:
            actor = Called(name, agent)
        controls.append(Control(name, "your own agent", actor))
    return controls


def _try(name: str, actor: Actor, environment: Environment[Any], simulator: Neurons) -> None:
    """Raise InvalidArgument for an actor that raises, or whose actions, which JAX would not refuse, are none."""
    if actor.n_actors != 1:
        raise InvalidArgument(f"agents: {name}: expected one actor, got {actor.n_actors} side by side")
    if isinstance(environment.robot, HostRobot):
        return
    try:
        actions = trace(environment, simulator, actor, episodes=8, seed=1).actions
        found = np.unique(actions).tolist()
    except Exception as error:
        raise InvalidArgument(f"agents: {name}: expected it to act in JAX, got {first_line(error)}") from error
    for action in found:
        with within(f"agents: {name}"):
            _expect_condition(action, environment.n_actions or 0)


def _expect_condition(chosen: Any, n: int) -> int:
    """The chosen index as a plain number, by the same rule as in a closed loop."""
    try:
        index = operator.index(chosen)
    except TypeError:
        index = -1
    if not 0 <= index < n:
        expected = f"the index of a condition, a whole number from 0 to {n - 1}"
        raise InvalidArgument(f"act: expected {expected}, got {shown(chosen)}")
    return index


def agents_at(places: Sequence[str], conditions: Sequence[Condition]) -> dict[str, Any]:
    """Agents by where to import them from, `my_rule:Rule`; a class is made with the conditions to choose from.

    Each is named as in its module. Raises InvalidArgument for one that cannot be imported or made, and for equal names.
    """
    agents: dict[str, Any] = {}
    for place in places:
        name = place.partition(":")[2]
        if not name or name in agents:
            expected = "a module and what is in it, such as my_rule:Rule" if not name else "different names"
            raise InvalidArgument(f"agents: expected {expected}, got {shown(place)}")
        agent = imported("agents", place)
        if isinstance(agent, type):
            try:
                agent = agent(tuple(conditions))
            except Exception as error:
                how = "to be created with the conditions to choose from"
                got = f"{first_line(error)}: name an instance of it instead"
                raise InvalidArgument(f"agents: expected {place} {how}, got {got}") from error
        agents[name] = agent
    return agents
