"""Agents of one's own, in JAX or not, as rows of the tables beside policies and controls."""

from __future__ import annotations

import operator
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from threading import Thread
from typing import Any, Protocol, TypeVar, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from animat.environment import Environment, Neurons
from animat.errors import InvalidArgument, first_line, shown, some_of, within
from animat.evaluation.controls import OWN, Control
from animat.evaluation.rollouts import Actor, Seen, Uniforms, trace
from animat.registry import imported
from animat.responses.condition import Condition
from animat.robots.host import HostRobot
from animat.wrappers import unwrapped

T = TypeVar("T")

_GRID = 2**24
"""Uniforms of single precision are multiples of 1 / 2^24."""
_GRACE_S = 2.0
"""How long Ctrl-C waits for a controller that is being called."""
_ASKED_AGAIN = 20
"""So many decisions of a roll-out are asked for again at its end."""


class Controller(Protocol):
    """What chooses conditions: a `Policy`, or anything else that acts like one.

    One that remembers earlier observations also has a method `begin`, which returns what acts in the next episode.
    """

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The index of the condition to present, for the robot's observation in its own units."""


@final
@jax.tree_util.register_static
class Called(Actor):
    """A controller outside JAX as an actor: it is called for every observation of every episode, up to its end.

    What goes wrong in a call is kept, as JAX would report it in its own words; see `expect_no_failure`. Only one
    roll-out at a time can use it.
    """

    def __init__(self, name: str, controller: Controller) -> None:
        self.name, self.controller = name, controller
        self._failure: BaseException | None = None
        self._in_episodes: list[Controller] = []
        self._answers: list[tuple[np.ndarray, float, int, int]] = []

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        return self.act_while(environment, observation, uniforms, jnp.ones(len(observation), bool))

    def act_while(
        self, environment: Environment[Any], observation: Seen, uniforms: Uniforms, going: Bool[Array, " episodes"]
    ) -> Array:
        n, seen = environment.n_actions or 0, observation * environment.scales
        if not sees_neurons(self.controller):
            seen = seen[:, : len(environment.robot.observation_spec)]

        def choose(observation: np.ndarray, uniforms: np.ndarray, going: np.ndarray) -> np.ndarray:
            chosen = np.zeros(len(observation), np.int32)
            for episode in np.flatnonzero(going).tolist():
                chosen[episode] = self._choose(episode, observation[episode], uniforms[episode], n)
            return chosen

        chosen = jax.ShapeDtypeStruct(observation.shape[:1], jnp.int32)
        called: Array = jax.pure_callback(choose, chosen, seen, uniforms[:, 0], going, vmap_method="sequential")
        return called

    def _choose(self, episode: int, observation: np.ndarray, uniform: float, n_actions: int) -> int:
        if self._failure is not None:
            return 0
        try:
            if episode == len(self._in_episodes):
                acting = begun(self.controller)
                if acting is not self.controller and any(acting is other for other in self._in_episodes):
                    raise InvalidArgument("begin: expected another object for each episode, got the same one twice")
                self._in_episodes.append(acting)
            rng = np.random.default_rng(int(uniform * _GRID))
            chosen = _expect_condition(self._in_episodes[episode].act(np.array(observation), rng), n_actions)
        except BaseException as error:
            self._failure = error
            return 0
        if not episode and len(self._answers) < _ASKED_AGAIN:
            self._answers.append((np.array(observation), uniform, n_actions, chosen))
        return chosen

    def begin(self) -> None:
        self._in_episodes, self._answers = [], []

    def apart(self, run: Callable[[], T]) -> T:
        # Ctrl-C reaches the main thread only, and not while it waits for JAX, which would be after the last episode.
        result = Future[T]()

        def complete() -> None:
            try:
                result.set_result(run())
            except BaseException as error:
                result.set_exception(error)

        thread = Thread(target=complete, name=f"agent {self.name}", daemon=True)
        thread.start()
        try:
            while thread.is_alive():
                # With a timeout, as a plain join would not notice a Ctrl-C that another thread received.
                thread.join(0.1)
            return result.result()
        except BaseException as error:
            # The controller is called no more, so the thread ends soon, unless the controller hangs.
            self._failure = error
            thread.join(_GRACE_S)
            raise

    def expect_no_failure(self) -> None:
        for observation, uniform, n_actions, chosen in [] if hasattr(self.controller, "begin") else [*self._answers]:
            again = self._choose(0, observation, uniform, n_actions)
            if again != chosen and self._failure is None:
                expected = "expected one condition for the same observation and random numbers"
                remedy = "draw only from rng, and give an agent that remembers a method begin (docs/agents.md)"
                self._failure = InvalidArgument(f"act: {expected}, got {chosen}, then {again}: {remedy}")
        if (failure := self._failure) is not None:
            self._failure = None
            if isinstance(failure, KeyboardInterrupt):
                # Ctrl-C, where JAX called this in the main thread.
                raise failure
            what = str(failure) if isinstance(failure, InvalidArgument) else first_line(failure)
            raise InvalidArgument(f"agents: {self.name}: {what}") from failure


def acts(controller: object) -> bool:
    """Whether an object is a controller: it has a method `act`, or `begin`, which returns one for an episode."""
    return any(callable(getattr(controller, name, None)) for name in ("act", "begin"))


def begun(controller: Controller) -> Controller:
    """The controller of one episode: a new one from `begin` if it has this method, otherwise itself."""
    if not callable(begin := getattr(controller, "begin", None)):
        return controller
    acting: Controller = begin()
    if acting is controller or not callable(getattr(acting, "act", None)):
        got = "the agent itself" if acting is controller else shown(acting)
        raise InvalidArgument(f"begin: expected another object, which acts in the next episode, got {got}")
    return acting


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
        if not name.strip():
            raise InvalidArgument(f"agents: expected a name for each, got {name!r}")
        if not acts(agent):
            raise InvalidArgument(f"agents: {name}: expected an Actor, or a method `act`, got {shown(agent)}")
        has_neurons = len(environment.observation_spec) > len(environment.robot.observation_spec)
        if isinstance(agent, Actor):
            actor = RobotOnly(agent) if has_neurons else agent
            _expect_actions(name, actor, environment, simulator)
        elif sees_neurons(agent) and not has_neurons:
            got = "one with neural_observation, which these policies do not have"
            raise InvalidArgument(f"agents: {name}: expected one that sees the robot only, got {got}")
        else:
            actor = Called(name, agent)
        controls.append(Control(name, OWN, actor))
    return controls


def _expect_actions(name: str, actor: Actor, environment: Environment[Any], simulator: Neurons) -> None:
    """Raise InvalidArgument for an actor that raises, or returns impossible actions, which JAX would not refuse."""
    parts = [np.shape(part) for part in jax.tree.leaves(actor)]
    if jax.tree.leaves(actor) == [actor]:
        expected = "expected a JAX pytree (jax.tree_util.register_static or register_dataclass)"
        raise InvalidArgument(f"agents: {name}: {expected}, got {shown(actor)}")
    if any(shape[:1] != (1,) for shape in parts):
        expected = "expected one actor, each of its arrays with a first axis of length one"
        raise InvalidArgument(f"agents: {name}: {expected}, got the shapes {', '.join(map(str, parts))}")
    try:
        if isinstance(environment.robot, HostRobot):
            # Whether an index is in range is checked later, in each step of its episodes.
            _expect_integers(actor, environment)
            return
        found = np.unique(trace(environment, simulator, actor, episodes=8, seed=1).actions).tolist()
    except Exception as error:
        raise InvalidArgument(f"agents: {name}: expected it to act in JAX, got {first_line(error)}") from error
    for action in found:
        with within(f"agents: {name}"):
            _expect_condition(action, environment.n_actions or 0)


def _expect_integers(actor: Actor, environment: Environment[Any], episodes: int = 7) -> None:
    seen = jax.ShapeDtypeStruct((episodes, len(environment.observation_spec)), jnp.float32)
    drawn = jax.ShapeDtypeStruct((episodes, environment.n_drawn), jnp.float32)
    alone = jax.tree.map(lambda part: part[0], actor)
    chosen = jax.eval_shape(lambda *given: jnp.asarray(alone.act(environment, *given)), seen, drawn)
    if chosen.shape != (episodes,) or not jnp.issubdtype(chosen.dtype, jnp.integer):
        raise TypeError(f"act: expected a whole number for each of {episodes} observations, got {chosen}")


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
