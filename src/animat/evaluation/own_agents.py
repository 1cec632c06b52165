"""Agents of one's own, in JAX or not, as rows of the tables beside policies and controls."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from animat.environment import Environment, Neurons
from animat.errors import InvalidArgument, first_line, shown, some_of, within
from animat.evaluation.controllers import Called, CalledEpisodes, Controller, can_act, expect_condition, sees_neurons
from animat.evaluation.controls import OWN, Control
from animat.evaluation.rollouts import Actor, Seen, Uniforms, trajectories
from animat.registry import imported
from animat.responses.condition import Condition
from animat.robots.host import HostRobot
from animat.wrappers import unwrapped


@final
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RobotOnly(Actor):
    """An actor that sees the robot only, as it does in a closed loop, where the policies also see the neurons."""

    actor: Actor

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        inside = unwrapped(environment)
        return self.actor.act(inside, observation[:, : len(inside.observation_spec)], uniforms)


def controls_of_own(
    agents: Mapping[str, Actor | Controller], environment: Environment[Any], simulator: Neurons, taken: Collection[str]
) -> list[Control]:
    """Agents of one's own as controls.

    Raises InvalidArgument for one that cannot act in this environment, tried for some episodes if it is in JAX and at
    the start of one otherwise, and for a name that is `taken`.
    """
    if agents and environment.n_actions is None:
        raise InvalidArgument("agents: expected none, as these policies choose from no conditions, got some")
    controls = []
    for name, agent in agents.items():
        if name in taken:
            raise InvalidArgument(f"agents: expected names other than {some_of(sorted(taken))}, got {name}")
        if not name.strip():
            raise InvalidArgument(f"agents: expected a name for each, got {name!r}")
        with within(f"agents: {name}"):
            controls.append(Control(name, OWN, _actor_of(agent, environment, simulator)))
    return controls


def _actor_of(agent: Actor | Controller, environment: Environment[Any], simulator: Neurons) -> Actor | Called:
    if isinstance(agent, type):
        raise InvalidArgument(f"expected an instance, got the class {agent.__name__}: create one")
    if not can_act(agent):
        raise InvalidArgument(f"expected an Actor, or a method `act`, got {shown(agent)}")
    has_neurons = len(environment.observation_spec) > len(environment.robot.observation_spec)
    if isinstance(agent, Actor):
        actor = RobotOnly(agent) if has_neurons else agent
        _check_actions(actor, environment, simulator)
        return actor
    if sees_neurons(agent) and not has_neurons:
        got = "one with neural_observation, which these policies do not have"
        raise InvalidArgument(f"expected one that sees the robot only, got {got}")
    called = Called(agent)
    if not isinstance(environment.robot, HostRobot):
        # One that cannot act at the start of an episode is refused before others have theirs.
        seen = np.asarray(environment.observe(environment.reset(jax.random.key(0))))
        CalledEpisodes(called, environment).choose(seen[None], np.zeros((1, 1), np.float32), np.ones(1, bool))
    return called


def _check_actions(actor: Actor, environment: Environment[Any], simulator: Neurons) -> None:
    """Raise InvalidArgument for an actor that raises, or returns impossible actions, which JAX would not refuse."""
    parts = [np.shape(part) for part in jax.tree.leaves(actor)]
    if jax.tree.leaves(actor) == [actor]:
        expected = "expected a JAX pytree (jax.tree_util.register_static or register_dataclass)"
        raise InvalidArgument(f"{expected}, got {shown(actor)}")
    if any(shape[:1] != (1,) for shape in parts):
        expected = "expected one actor, each of its arrays with a first axis of length one"
        raise InvalidArgument(f"{expected}, got the shapes {', '.join(map(str, parts))}")
    try:
        if isinstance(environment.robot, HostRobot):
            # Whether an index is in range is checked later, in each step of its episodes.
            _expect_integers(actor, environment)
            return
        found = np.unique(trajectories(environment, simulator, actor, episodes=8, seed=1).actions).tolist()
    except Exception as error:
        raise InvalidArgument(f"expected it to act in JAX, got {first_line(error)}") from error
    for action in found:
        expect_condition(action, environment.n_actions or 0)


def _expect_integers(actor: Actor, environment: Environment[Any], episodes: int = 7) -> None:
    seen = jax.ShapeDtypeStruct((episodes, len(environment.observation_spec)), jnp.float32)
    drawn = jax.ShapeDtypeStruct((episodes, environment.n_drawn), jnp.float32)
    alone = jax.tree.map(lambda part: part[0], actor)
    chosen = jax.eval_shape(lambda *given: jnp.asarray(alone.act(environment, *given)), seen, drawn)
    if chosen.shape != (episodes,) or not jnp.issubdtype(chosen.dtype, jnp.integer):
        raise TypeError(f"act: expected a whole number for each of {episodes} observations, got {chosen}")


def agents_at(places: Sequence[str], conditions: Sequence[Condition]) -> dict[str, Any]:
    """Agents by where to import them from, `my_rule:Rule`; a class is made with the conditions to choose from.

    Each is named as in its module. Raises InvalidArgument for one that cannot be imported or made, and for equal names.
    """
    agents: dict[str, Any] = {}
    for place in places:
        name = place.partition(":")[2]
        if not name or name in agents:
            expected = "a module and what is in it, such as my_rule:Rule" if not name else "different names"
            remedy = ": import one of them under another name" if name else ""
            raise InvalidArgument(f"agents: expected {expected}, got {shown(place)}{remedy}")
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
