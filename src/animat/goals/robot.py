"""A robot with a goal in place of its own task: the same body, with the rewards and ends that follow from the goal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial, reduce
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Int

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, shown, within
from animat.goals.goal import Goal, Margins, Objective, is_text, margins_of, of_kind, read_goal, region_in_units
from animat.goals.grid import grid_with_goal
from animat.goals.tally import Outcome, Tally, add_iteration, empty_tally, outcome
from animat.lazy import Array, jax, jnp
from animat.robots.base import WITHOUT, Quantity, Robot, Transition, Uniforms
from animat.robots.grid import Grid
from animat.robots.host import HostRobot
from animat.robots.registry import robot_from_dict, robot_named, robot_to_dict

FAILED, REACHED = 100.0, 50.0
"""Cost of failing and reward of reaching, with equal weights."""
POTENTIAL = 3.0
"""Depth of the potential a whole scale or more away from a region: the pay of three iterations."""
MOST_INSIDE = 0.1
"""Share of starts in a region that ends the episode, above which there is a warning: of random starts a few may be."""


class GoalState(NamedTuple):
    """The state of an episode; `outside` counts consecutive iterations outside each region with `within`."""

    robot: Any
    outside: tuple[Int[Array, ""], ...]
    tally: Tally


@final
@dataclass(frozen=True)
class RobotWithGoal(Robot[GoalState]):
    """A robot with a goal in place of its own rewards and ends; it keeps the robot's other abilities.

    An episode fails in an iteration that enters a region to avoid, or exceeds `within`. It succeeds in one that enters
    a region to reach. With w the n weights, and c = 1 if there is anything to reach, else 0, an iteration's reward is

        failed:     -100 n w_i / sum w - c episode_limit    with i the objective that failed, the largest of several
        succeeded:  50 n w_i / sum w                        with i the objective that was reached, likewise
        otherwise:  sum (w_i r_i) / sum w - c
        r_i:        avoid 1,  reach 0,  drive 1 in its region and 0 outside,  minimize and maximize (1 + m_i) / 2

    with m_i the margin in [-1, 1]: how far inside the region the robot is, in scales of the quantity.

    Raises:
        InvalidArgument: for a robot that is stepped outside JAX or already has a goal, and for a goal with quantities
            or units that the robot does not observe, or with an empty region.
    """

    robot: Robot[Any]
    goal: Goal

    def __post_init__(self) -> None:
        robot = self.robot
        if not isinstance(robot, Robot) or isinstance(robot, RobotWithGoal):
            raise InvalidArgument(f"robot: expected a robot without a goal, got {shown(robot)}")
        if isinstance(robot, HostRobot):
            raise InvalidArgument(
                f"goal: expected a robot that is stepped in JAX, got {robot.name}, which is stepped outside JAX "
                "and has its own reward"
            )
        if not isinstance(self.goal, Goal):
            raise InvalidArgument(f"goal: expected a Goal, or a string for with_goal, got {shown(self.goal)}")
        if len(self._spec) != len(robot.observation_spec):
            raise InvalidArgument(f"goal: expected quantities of different names, {robot.name} has one name twice")
        # Converted now, so that a wrong quantity or unit is refused.
        _ = self._objectives
        if not is_text(self.goal):
            raise InvalidArgument(
                "goal: expected quantities and units that can be read back from its text, which files hold, such as "
                f"pole_angle and rad/s, got {shown(str(self.goal))}"
            )
        # Other robots have these as class attributes.
        for name in ("name", "n_commands", "noise_size", "paper_iterations", "baseline_commands", "episode_limit"):
            object.__setattr__(self, name, getattr(robot, name))

    def __getattr__(self, name: str) -> Any:
        # The optional methods are those of its robot.
        if name in (*WITHOUT, "with_goal_of") and hasattr(self.robot, name):
            own = {"value_grid": partial(_grid_of, self), "with_goal_of": self._with_goal_of}
            return own.get(name) or getattr(self.robot, name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _with_goal_of(self, state: Any, other: Any) -> Any:
        return state._replace(robot=self.robot.with_goal_of(state.robot, other.robot))  # type: ignore[attr-defined]

    @cached_property
    def _spec(self) -> dict[str, Quantity]:
        unbounded = (replace(quantity, low=-math.inf, high=math.inf) for quantity in self.robot.observation_spec)
        return {quantity.name: quantity for quantity in unbounded}

    @cached_property
    def _objectives(self) -> tuple[Objective, ...]:
        """The objectives in the robot's units."""
        converted = []
        for objective in self.goal.objectives:
            with within(f"goal: {str(objective)!r} of {self.robot.name}"):
                converted.append(replace(objective, region=region_in_units(objective.region, self._spec)))
        return tuple(converted)

    @cached_property
    def _shares(self) -> tuple[float, ...]:
        """The weights, scaled to 1 on average."""
        weights = [objective.weight for objective in self._objectives]
        return tuple(weight * len(weights) / sum(weights) for weight in weights)

    @property
    def _cost(self) -> float:
        """The cost of every iteration: 1 if there is anything to reach, so that waiting gains nothing."""
        return float(any(objective.kind == "reach" for objective in self._objectives))

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        """The robot's quantities without bounds, which may hold only for episodes that end by its own task."""
        return tuple(self._spec.values())

    @property
    def return_range(self) -> tuple[float, float]:
        """From failing, early or late (if each iteration costs), to reaching immediately or lasting to the end."""
        pairs = list(zip(self._objectives, self._shares, strict=True))
        worst = max((share for objective, share in pairs if objective.can_fail), default=0.0)
        best = max((share for objective, share in pairs if objective.kind == "reach"), default=0.0)
        limit = float(self.episode_limit)
        lowest = -self._cost * limit - (FAILED * worst + self._cost * limit if worst else 0.0)
        return lowest, best * REACHED if best else limit

    def caveats(self) -> tuple[str, ...]:
        """Those of the robot, and a warning if many episodes start in a region that ends them."""
        keys = jax.random.split(jax.random.key(0), 256)
        inside = jax.vmap(lambda key: jnp.stack(self._margins(self.observe(self.reset(key)))[1]))(keys)
        shares = np.mean(inside & of_kind(self.goal.objectives, "avoid", "reach"), axis=0)
        return *self.robot.caveats(), *(
            f"goal: {100 * share:.0f} % of the episodes of {self.name} start in the region: {objective}"
            for share, objective in zip(shares.tolist(), self.goal.objectives, strict=True)
            if share > MOST_INSIDE
        )

    def departures(self) -> tuple[tuple[str, str], ...]:
        return self.robot.departures()

    def reset(self, key: Array) -> GoalState:
        """The robot's own start."""
        return self.started(self.robot.reset(key))

    def observe(self, state: GoalState) -> Float[Array, " observations"]:
        return self.robot.observe(state.robot)

    def advance(self, uniforms: Uniforms, state: GoalState, u: Float[Array, "*commands"]) -> Transition[GoalState]:
        robot, _, _ = self.robot.advance(uniforms, state.robot, u)
        outside, tally, reward, ended = self._judge(self.robot.observe(robot), state.outside, state.tally)
        return GoalState(robot, outside, tally), reward, ended

    def _judge(
        self, observation: Float[Array, " observations"], outside: tuple[Int[Array, ""], ...], tally: Tally
    ) -> tuple[tuple[Int[Array, ""], ...], Tally, Float[Array, ""], Bool[Array, ""]]:
        """The counts and tally after an iteration, its reward, and whether it ends the episode."""
        margins = self._margins(observation)
        outside, never = self._outside(margins, outside), jnp.bool_(False)
        counts = iter(outside)
        failures, reaches, running = [], [], jnp.float32(0.0)
        for objective, share, margin, inside in zip(self._objectives, self._shares, *margins, strict=True):
            is_late = never if objective.within is None else next(counts) > objective.within
            failures.append(inside if objective.kind == "avoid" else is_late)
            reaches.append(inside if objective.kind == "reach" else never)
            worth: Any = {"avoid": 1.0, "reach": 0.0, "drive": inside}.get(objective.kind, (1.0 + margin) / 2)
            running += share / len(self._shares) * worth
        failed, reached = reduce(jnp.logical_or, failures), reduce(jnp.logical_or, reaches)
        reward = jnp.where(reached, REACHED * self._largest(reaches), running - self._cost)
        failure = FAILED * self._largest(failures) + self._cost * self.episode_limit
        reward = jnp.where(failed, -failure, reward).astype(jnp.float32)
        tally = add_iteration(self._objectives, tally, margins, failed, reached & ~failed)
        return outside, tally, reward, failed | reached

    def potential(self, state: GoalState) -> Float[Array, ""]:
        """For shaping: the weighted mean distance to the regions to reach or drive to, 0 inside them.

            potential = POTENTIAL sum (w_i min(m_i, 0)) / sum w,    over the `reach` and `drive` objectives

        The other objectives pay on the way.
        """
        potential: Array = jnp.float32(0.0)
        margins, _ = self._margins(self.observe(state))
        for objective, share, margin in zip(self._objectives, self._shares, margins, strict=True):
            if objective.kind in ("reach", "drive"):
                potential += POTENTIAL * share / len(self._shares) * jnp.minimum(margin, 0.0)
        return potential

    def succeeded(self, state: GoalState) -> Bool[Array, ""]:
        """Whether an episode that ended in this state succeeded."""
        return self.outcome(state).succeeded

    def outcome(self, state: GoalState) -> Outcome:
        """The outcome of an episode that ended in this state."""
        return outcome(self._objectives, state.tally, self.episode_limit)

    def outcome_of(self, observations: Float[np.ndarray, "iterations observations"]) -> Outcome:
        """The outcome of a whole episode by its observations: at the start, and after each iteration."""
        # Padded to one length, to compile once: nothing after the end is counted.
        missing = self.episode_limit + 1 - len(observations)
        result: Outcome = jax.device_get(_outcome_along(self)(np.pad(observations, ((0, missing), (0, 0)), "edge")))
        return result

    def _margins(self, observation: Float[Array, " observations"]) -> Margins:
        return margins_of(self._objectives, self._spec, observation)

    def _outside(self, margins: Margins, before: Sequence[Int[Array, ""]] | None = None) -> tuple[Int[Array, ""], ...]:
        timed = [inside for of, inside in zip(self._objectives, margins[1], strict=True) if of.within is not None]
        before = [jnp.int32(0)] * len(timed) if before is None else before
        return tuple(jnp.where(inside, 0, n + 1).astype(jnp.int32) for inside, n in zip(timed, before, strict=True))

    def started(self, robot: Any) -> GoalState:
        """An episode that begins with the body in this state."""
        return GoalState(robot, self._outside(self._margins(self.robot.observe(robot))), empty_tally(self._objectives))

    def _largest(self, flags: Sequence[Bool[Array, ""]]) -> Float[Array, ""]:
        """The largest share of the flagged objectives."""
        return reduce(jnp.maximum, (flag * share for flag, share in zip(flags, self._shares, strict=True)))


@lru_cache(maxsize=8)
def _grid_of(robot: RobotWithGoal) -> Grid:
    return grid_with_goal(robot.robot, robot._objectives, robot._spec, robot.started)


@lru_cache(maxsize=8)
def _outcome_along(robot: RobotWithGoal) -> Callable[[Any], Outcome]:
    """`RobotWithGoal.outcome_of`, compiled for episodes of full length."""

    def along(observations: Float[Array, "iterations observations"]) -> Outcome:
        def iteration(carry: Any, observation: Array) -> tuple[Any, None]:
            return robot._judge(observation, *carry)[:2], None

        start = robot._outside(robot._margins(observations[0])), empty_tally(robot._objectives)
        (_, tally), _ = jax.lax.scan(iteration, start, observations[1:])
        return outcome(robot._objectives, tally, robot.episode_limit)

    return jax.jit(along)


@checked_arguments
def with_goal(robot: Robot[Any] | str, goal: Goal | str) -> RobotWithGoal:
    """A robot with a goal in place of its own task.

    Args:
        goal: a goal or its text, `"avoid pole_angle outside -12..12 deg"` (`animat.goals.goal`).

    Raises:
        InvalidArgument: as `RobotWithGoal`, and for a text that is not a goal.
    """
    robot = robot_named(robot) if isinstance(robot, str) else robot
    return RobotWithGoal(robot, goal if isinstance(goal, Goal) else read_goal(goal))


def without_goal(robot: Robot[Any]) -> Robot[Any]:
    """The robot without its goal, if it has one."""
    return robot.robot if isinstance(robot, RobotWithGoal) else robot


def objectives_of(robot: Robot[Any]) -> tuple[str, ...]:
    """The objectives of its goal as texts; none for a robot without a goal."""
    return tuple(map(str, robot.goal.objectives)) if isinstance(robot, RobotWithGoal) else ()


def body_and_goal(robot: Robot[Any]) -> dict[str, Any]:
    """The robot as JSON data, with the text of its goal if it has one."""
    goal = {"goal": str(robot.goal)} if isinstance(robot, RobotWithGoal) else {}
    return {"robot": robot_to_dict(without_goal(robot)), **goal}


def robot_of(data: Mapping[str, Any]) -> Robot[Any]:
    """The inverse of `body_and_goal`; other keys are ignored, and errors are those of its parts."""
    robot = robot_from_dict(data["robot"])
    return robot if data.get("goal") is None else with_goal(robot, data["goal"])
