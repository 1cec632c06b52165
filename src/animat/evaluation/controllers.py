"""Controllers: what chooses conditions outside JAX, one observation after the other."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import jax
import numpy as np
from jaxtyping import Bool, Float, Int32

from animat.environment import Environment
from animat.errors import InvalidArgument, first_line, shown

_GRID = 2**24
"""Uniforms of single precision are multiples of 1 / 2^24."""
_ASKED_AGAIN = 20
"""So many decisions are asked for again at the end of a roll-out, or of each wave of bodies on the host."""


class Controller(Protocol):
    """What chooses conditions: a `Policy`, or anything else that acts like one.

    One that remembers earlier observations also has a method `begin`, which returns what acts in the next episode.
    """

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The index of the condition to present, for the robot's observation in its own units."""


def can_act(controller: object) -> bool:
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


def sees_neurons(controller: Controller) -> bool:
    """Whether a controller, or the policy that it makes greedy, also observes the neurons' history state."""
    return bool(getattr(getattr(controller, "policy", controller), "neural_observation", False))


def index_of(chosen: Any) -> int:
    """The chosen index as a plain number; TypeError for anything else, also for True, which numpy does not take."""
    if isinstance(chosen, bool):
        raise TypeError(f"expected the index of a condition, got {chosen}")
    return operator.index(chosen)


def expect_condition(chosen: Any, n: int) -> int:
    """The chosen index as a plain number; InvalidArgument if it is none of n conditions."""
    try:
        index = index_of(chosen)
    except TypeError:
        index = -1
    if not 0 <= index < n:
        expected = f"the index of a condition, a whole number from 0 to {n - 1}"
        raise InvalidArgument(f"act: expected {expected}, got {shown(chosen)}")
    return index


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class Called:
    """A controller in the place of an `Actor`: it is called for every observation of every episode, up to its end."""

    controller: Controller
    n_actors: ClassVar[int] = 1


class CalledEpisodes:
    """A controller in the episodes of one roll-out or wave, which take turns.

    InvalidArgument is raised for what its controller raises, Ctrl-C excepted.
    """

    def __init__(self, called: Called, environment: Environment[Any]) -> None:
        self._controller, self._n_actions = called.controller, environment.n_actions or 0
        n_robot = len(environment.robot.observation_spec)
        self._seen = slice(None if sees_neurons(called.controller) else n_robot)
        self._in_episodes: list[Controller] = []
        self._answers: list[tuple[np.ndarray, float, int]] = []

    def choose(
        self,
        observation: Float[np.ndarray, "episodes observations"],
        uniforms: Float[np.ndarray, "episodes drawn"],
        going: Bool[np.ndarray, " episodes"],
    ) -> Int32[np.ndarray, " episodes"]:
        """A condition for each episode that is `going`, and 0 for the others; observations in the robot's units."""
        chosen = np.zeros(len(going), np.int32)
        for episode in np.flatnonzero(going).tolist():
            seen, uniform = observation[episode, self._seen], uniforms[episode, 0]
            chosen[episode] = self._choose(episode, seen, uniform)
            if not episode and len(self._answers) < _ASKED_AGAIN:
                self._answers.append((seen, uniform, int(chosen[0])))
        return chosen

    def _choose(self, episode: int, observation: np.ndarray, uniform: float) -> int:
        try:
            if episode == len(self._in_episodes):
                acting = begun(self._controller)
                if acting is not self._controller and any(acting is other for other in self._in_episodes):
                    raise InvalidArgument("begin: expected another object for each episode, got the same one twice")
                self._in_episodes.append(acting)
            rng = np.random.default_rng(int(uniform * _GRID))
            return expect_condition(self._in_episodes[episode].act(np.array(observation), rng), self._n_actions)
        except (InvalidArgument, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise InvalidArgument(first_line(error)) from error

    def end(self) -> None:
        """InvalidArgument if it answers differently now: its episodes, which take turns, would share its memory."""
        for observation, uniform, chosen in [] if hasattr(self._controller, "begin") else self._answers:
            again = self._choose(0, observation, uniform)
            if again != chosen:
                expected = "expected one condition for the same observation and random numbers"
                remedy = "draw only from rng, and give an agent that remembers a method begin (docs/agents.md)"
                raise InvalidArgument(f"act: {expected}, got {chosen}, then {again}: {remedy}")
