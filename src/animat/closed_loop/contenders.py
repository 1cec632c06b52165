"""Who acts in a closed loop: policies, and the controls that ask whether it is the culture that does the work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float

from animat.errors import InvalidArgument
from animat.robots.base import Robot
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation

Delivery = Literal["chosen", "shuffled", "silent"]

FORESIGHT_S = 0.1
"""The hand-made rule for the cartpole looks at where the pole will be after this time."""


class Controller(Protocol):
    """Whoever chooses conditions: a `Policy`, or anything else that acts like one."""

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int | float:
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
        """The same as ever."""
        return self.condition


@dataclass(frozen=True)
class Greedy:
    """A policy's most probable condition, where the policy itself would draw one."""

    policy: Any

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int | float:
        """The most probable one."""
        return self.policy.act_greedily(observation)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class HandMadeRule:
    """Lean right, push right: the condition that is answered most strongly where the command should be positive.

    Attributes:
        robot: one of those that `lean` knows.
        up, down: the conditions with the largest and the smallest mean command.
    """

    robot: Robot[Any]
    up: int
    down: int

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        """Up or down."""
        return self.up if lean(self.robot, observation) > 0 else self.down


def lean(robot: Robot[Any], observation: Any, xp: Any = np) -> Any:
    """What a hand-made rule steers by, positive where the command should be: no learning, one line a robot.

    Cartpole: the pole's angle 0.1 s from now at its present rate, rad. Navigation: the turn that would face the goal,
    in (-pi, pi], rad.

    Args:
        robot: whose observation it is.
        observation: in the robot's own units, the observations on the last axis.
        xp: the array library, numpy or jax.numpy.

    Raises:
        InvalidArgument: for a robot that no rule was made for.
    """
    if isinstance(robot, Cartpole):
        return observation[..., 2] + FORESIGHT_S * observation[..., 3]
    if isinstance(robot, Navigation):
        x_m, y_m, heading_rad = observation[..., 0], observation[..., 1], observation[..., 2]
        turn_rad = xp.arctan2(robot.goal_y_m - y_m, robot.goal_x_m - x_m) - heading_rad
        return xp.pi - (xp.pi - turn_rad) % (2 * xp.pi)
    raise InvalidArgument(f"robot: expected one with a hand-made rule (cartpole, navigation), got {robot.name}")


@dataclass(frozen=True, eq=False)
class Contender:
    """Someone who acts in some of a session's episodes.

    Attributes:
        name: unique in its session.
        meaning: what it is, in a few words.
        controller: who chooses.
        delivery: `"chosen"`: the culture gets what was chosen; `"shuffled"`: a condition drawn anew at each iteration;
            `"silent"`: no pulse, and what the culture fires by itself is read where the response would be.
        calibrates: whether its responses count where percentiles follow the culture; one condition presented over
            and over is answered otherwise than between others.
    """

    name: str
    meaning: str
    controller: Controller
    delivery: Delivery = "chosen"
    calibrates: bool = True


def controls(
    robot: Robot[Any], labels: Sequence[str], *, strongest: int, weakest: int, policy: Controller | None = None
) -> list[Contender]:
    """The controls of the study.

    Args:
        robot: that is driven; without a hand-made rule for it, that control is left out.
        labels: of the conditions, in the order of their index.
        strongest, weakest: the conditions with the largest and the smallest mean command: for the hand-made rule.
        policy: what acts under the silent and the shuffled control; without one these two are left out.
    """
    found = [Contender("random", "any condition, equally likely", AnyCondition(len(labels)))]
    for i, label in enumerate(labels):
        found.append(Contender(f"constant {label}", "this one always", OneCondition(i), calibrates=False))
    if policy is not None:
        found.append(Contender("silent", "no pulse; the culture's own activity is read", policy, "silent"))
        found.append(Contender("shuffled", "the delivered condition is drawn anew", policy, "shuffled"))
    if isinstance(robot, Cartpole | Navigation):
        rule = HandMadeRule(robot, strongest, weakest)
        found.append(Contender("hand-made", f"lean right, push right: {labels[strongest]} or {labels[weakest]}", rule))
    return found


def interleaved(contenders: int, episodes: int, rng: np.random.Generator) -> list[int]:
    """Whose turn each episode is: round after round of all contenders, each round in random order.

    So whatever drifts in the culture hits all of them alike.
    """
    return [int(who) for _ in range(episodes) for who in rng.permutation(contenders)]
