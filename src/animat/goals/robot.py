"""A robot with a goal in place of its own task: the same body, with the reward and the ends that follow from the goal.

An episode ends as failed in an iteration that enters a region to avoid, or in which `within` is exceeded; as succeeded
in one that enters a region to reach. With w the weights, n of them, and c = 1 where there is anything to reach and 0
where there is not, the reward of an iteration is

    failed:     -100 n w_i / sum w - c episode_limit    of the objective i that failed, the largest of several
    succeeded:  50 n w_i / sum w                        of the objective i that was reached, the largest of several
    else:       sum (w_i r_i) / sum w - c

    r_i:  avoid 1,  reach 0,  drive 1 within its region and 0 outside,  minimize and maximize (1 + m_i) / 2

with m_i the margin in [-1, 1]: how far within the region the robot is, in scales of the quantity. So only the ratios of
weights matter; going on pays as long as there is nothing to reach, and costs where there is, so that sooner is better;
and failing never pays, as it costs more than all of an episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Int

from animat.errors import InvalidArgument, shown
from animat.goals.goal import Goal, Objective
from animat.goals.region import margin_of, region_in_units
from animat.goals.tally import Outcome, Seen, Tally, counted, nothing_yet, outcome
from animat.goals.text import read_goal
from animat.lazy import Array, jax, jnp
from animat.robots.base import WITHOUT, Quantity, Robot, capability
from animat.robots.grid import Grid
from animat.robots.host import HostRobot
from animat.robots.registry import robot_from_dict, robot_named, robot_to_dict

FAILED, REACHED = 100.0, 50.0
"""What an episode's end costs and is worth, where all weights are the same."""

POTENTIAL = 3.0
"""What a robot lacks that is a whole scale or more away from where it should be: three iterations' pay."""


class GoalState(NamedTuple):
    """Where an episode stands.

    Attributes:
        robot: the state of the body.
        outside: of each objective with `within`, for how many iterations in a row the robot has been outside.
    """

    robot: Any
    outside: tuple[Int[Array, ""], ...]
    tally: Tally


@final
@dataclass(frozen=True)
class RobotWithGoal(Robot[GoalState]):
    """A robot with a goal in place of its own task; what the robot can do besides, it still can.

    Attributes:
        robot: the body; its own rewards and ends are not used.

    Raises:
        InvalidArgument: for a robot that is stepped on the host or has a goal already, and for a goal of other
            quantities or units than the robot observes, or of regions in which nothing is.
    """

    robot: Robot[Any]
    goal: Goal

    def __post_init__(self) -> None:
        robot = self.robot
        if not isinstance(robot, Robot) or isinstance(robot, RobotWithGoal):
            raise InvalidArgument(f"robot: expected a robot without a goal, got {shown(robot)}")
        if isinstance(robot, HostRobot):
            raise InvalidArgument(
                f"goal: expected a robot that is stepped in JAX, got {robot.name}, which is stepped on the host and "
                "has a reward of its own"
            )
        if not isinstance(self.goal, Goal):
            raise InvalidArgument(f"goal: expected a Goal, or a text for with_goal, got {shown(self.goal)}")
        if len(self._spec) != len(robot.observation_spec):
            raise InvalidArgument(f"goal: expected quantities of different names, got two of one name of {robot.name}")
        _ = self._objectives
        # Of other robots they are the class's own.
        for name in ("name", "n_commands", "noise_size", "paper_iterations", "baseline_commands", "episode_limit"):
            object.__setattr__(self, name, getattr(robot, name))

    def __getattr__(self, name: str) -> Any:
        # Of what a robot may lack it has what the robot in it has.
        if name in WITHOUT and hasattr(self.robot, name):
            return self._value_grid if name == "value_grid" else getattr(self.robot, name)
        if name == "with_goal_of" and hasattr(self.robot, name):
            return self._with_goal_of
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _with_goal_of(self, state: Any, other: Any) -> Any:
        return state._replace(robot=self.robot.with_goal_of(state.robot, other.robot))  # type: ignore[attr-defined]

    @cached_property
    def _spec(self) -> dict[str, Quantity]:
        unbounded = (replace(each, low=-math.inf, high=math.inf) for each in self.robot.observation_spec)
        return {quantity.name: quantity for quantity in unbounded}

    @cached_property
    def _objectives(self) -> tuple[Objective, ...]:
        """In the robot's units."""
        found = []
        for each in self.goal.objectives:
            try:
                found.append(replace(each, region=region_in_units(each.region, self._spec)))
            except InvalidArgument as error:
                raise InvalidArgument(f"goal: {str(each)!r} of {self.robot.name}: {error}") from error
        return tuple(found)

    @cached_property
    def _shares(self) -> tuple[float, ...]:
        """The weights, 1 on average."""
        weights = [each.weight for each in self._objectives]
        return tuple(weight * len(weights) / sum(weights) for weight in weights)

    @property
    def _cost(self) -> float:
        """Of every iteration: 1 where there is anything to reach, as an episode that waits then only costs."""
        return float(any(each.kind == "reach" for each in self._objectives))

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        """What the robot observes, without bounds: they may be those of episodes that its own task ends."""
        return tuple(self._spec.values())

    @property
    def return_range(self) -> tuple[float, float]:
        """From failing, at once or late where each iteration costs, to reaching at once or going on to the end."""
        told = list(zip(self._objectives, self._shares, strict=True))
        worst = max((share for each, share in told if each.can_fail), default=0.0)
        best = max((share for each, share in told if each.kind == "reach"), default=0.0)
        limit = float(self.episode_limit)
        lowest = -self._cost * limit - (FAILED * worst + self._cost * limit if worst else 0.0)
        return lowest, best * REACHED if best else limit

    def caveats(self) -> tuple[str, ...]:
        """Those of the robot, and where episodes start in a region that ends them."""
        start = self.robot.reset(jax.random.key(0))
        told = zip(self.goal.objectives, self._objectives, self._seen(start), strict=True)
        in_it = [str(given) for given, each, (_, inside) in told if inside and each.kind in ("avoid", "reach")]
        return (*self.robot.caveats(), *(f"goal: episodes of {self.name} start in the region: {of}" for of in in_it))

    def departures(self) -> tuple[tuple[str, str], ...]:
        return self.robot.departures()

    def reset(self, key: Array) -> GoalState:
        """The robot's own start."""
        return self.started(self.robot.reset(key))

    def observe(self, state: GoalState) -> Float[Array, " observations"]:
        return self.robot.observe(state.robot)

    def advance(
        self, uniforms: Float[Array, " noise_size"], state: GoalState, u: Float[Array, "*commands"]
    ) -> tuple[GoalState, Float[Array, ""], Bool[Array, ""]]:
        robot, _, _ = self.robot.advance(uniforms, state.robot, u)
        outside, tally, reward, ended = self._judged(self._seen(robot), state.outside, state.tally)
        return GoalState(robot, outside, tally), reward, ended

    def _judged(
        self, seen: Seen, outside: tuple[Int[Array, ""], ...], tally: Tally
    ) -> tuple[tuple[Int[Array, ""], ...], Tally, Float[Array, ""], Bool[Array, ""]]:
        """What an iteration comes to after which this is seen, and its reward and whether it ends the episode."""
        outside = self._outside(seen, outside)
        late = iter(outside)
        no = jnp.bool_(False)
        failures, reaches, running = [], [], jnp.float32(0.0)
        for each, share, (margin, inside) in zip(self._objectives, self._shares, seen, strict=True):
            is_late = no if each.within is None else next(late) > each.within
            failures.append(inside if each.kind == "avoid" else is_late)
            reaches.append(inside if each.kind == "reach" else no)
            worth: Any = {"avoid": 1.0, "reach": 0.0, "drive": inside}.get(each.kind, (1.0 + margin) / 2)
            running += share / len(seen) * worth
        failed, reached = reduce(jnp.logical_or, failures), reduce(jnp.logical_or, reaches)
        reward = jnp.where(reached, REACHED * self._largest(reaches), running - self._cost)
        failure = FAILED * self._largest(failures) + self._cost * self.episode_limit
        reward = jnp.where(failed, -failure, reward).astype(jnp.float32)
        tally = counted(self._objectives, tally, seen, failed, reached & ~failed)
        return outside, tally, reward, failed | reached

    def potential(self, state: GoalState) -> Float[Array, ""]:
        """For shaping: the weighted mean of how far it is to what is to be reached or kept, 0 in it.

            potential = POTENTIAL sum (w_i min(m_i, 0)) / sum w,    over what is to be reached or driven to

        What else is wanted pays on the way.
        """
        found: Array = jnp.float32(0.0)
        seen = self._seen(state.robot)
        for each, share, (margin, _) in zip(self._objectives, self._shares, seen, strict=True):
            if each.kind in ("reach", "drive"):
                found += POTENTIAL * share / len(seen) * jnp.minimum(margin, 0.0)
        return found

    def succeeded(self, state: GoalState) -> Bool[Array, ""]:
        """Whether an episode that has come to its end in this state succeeded."""
        return self.outcome(state).succeeded

    def outcome(self, state: GoalState) -> Outcome:
        """What an episode that has come to its end in this state came to."""
        return outcome(self._objectives, state.tally, self.episode_limit)

    def outcome_of(self, observations: Float[np.ndarray, "iterations observations"]) -> Outcome:
        """What a whole episode came to, by what was observed in it.

        Args:
            observations: at its start, and after each iteration.
        """
        # All of one length, for one compilation: what comes after the end is not counted.
        missing = self.episode_limit + 1 - len(observations)
        came_to: Outcome = jax.device_get(_outcome_along(self)(np.pad(observations, ((0, missing), (0, 0)), "edge")))
        return came_to

    def _seen(self, robot: Any) -> Seen:
        return self._seen_in(self.robot.observe(robot))

    def _seen_in(self, observation: Float[Array, " observations"]) -> Seen:
        seen = dict(zip(self._spec, observation, strict=True))
        return [margin_of(each.region, seen, self._spec) for each in self._objectives]

    def _outside(self, seen: Seen, before: Sequence[Int[Array, ""]] | None = None) -> tuple[Int[Array, ""], ...]:
        timed = [inside for each, (_, inside) in zip(self._objectives, seen, strict=True) if each.within is not None]
        before = [jnp.int32(0)] * len(timed) if before is None else before
        return tuple(jnp.where(inside, 0, of + 1).astype(jnp.int32) for inside, of in zip(timed, before, strict=True))

    def started(self, robot: Any) -> GoalState:
        """An episode that begins with the body in this state."""
        return GoalState(robot, self._outside(self._seen(robot)), nothing_yet(self._objectives))

    def _largest(self, flags: Sequence[Bool[Array, ""]]) -> Float[Array, ""]:
        """The largest share of the objectives that a flag is up for."""
        return reduce(jnp.maximum, (flag * share for flag, share in zip(flags, self._shares, strict=True)))

    def _value_grid(self) -> Grid:
        """The robot's own grid. A goal with `within` has none: how long a robot has been outside is no place on it."""
        if any(each.within is not None for each in self._objectives):
            raise InvalidArgument("goal: expected none with `within` for an optimal return, got one")
        grid: Grid = capability(self.robot, "value_grid")()
        of_goal = replace(
            grid,
            to_coordinates=lambda state: grid.to_coordinates(state.robot),
            to_state=lambda coordinates: self.started(grid.to_state(coordinates)),
        )
        if self._is_decided(grid):
            return of_goal
        return replace(of_goal, end_is_known=False, smooth_commands=None)

    def _is_decided(self, grid: Grid) -> bool:
        """Whether a state alone decides if the next iteration ends the episode, whatever the command, tried on some."""
        nodes = jax.random.randint(jax.random.key(0), (2, 256), 0, jnp.array([[grid.n_rows], [grid.along.stored]]))

        def seen_after(row: Array, node: Array, chance: float, u: float) -> Array:
            state = grid.state_at(row, node)
            robot, _, _ = self.robot.advance(jnp.full(self.noise_size, chance), state, jnp.float32(u))
            told = zip(self._objectives, self._seen(robot), strict=True)
            ends = [margin for each, (margin, _) in told if each.can_fail or each.kind == "reach"]
            return jnp.stack(ends) if ends else jnp.zeros(0)

        after = jax.vmap(seen_after, (0, 0, None, None))
        row, node = nodes
        return bool(jnp.allclose(after(row, node, 0.0, -1.0), after(row, node, 1.0, 1.0), atol=1e-5))


@lru_cache(maxsize=8)
def _outcome_along(robot: RobotWithGoal) -> Callable[[Any], Outcome]:
    """`RobotWithGoal.outcome_of` episodes of the limit, compiled."""

    def along(observations: Float[Array, "iterations observations"]) -> Outcome:
        def iteration(carry: Any, observation: Array) -> tuple[Any, None]:
            return robot._judged(robot._seen_in(observation), *carry)[:2], None

        begun = robot._outside(robot._seen_in(observations[0])), nothing_yet(robot._objectives)
        (_, tally), _ = jax.lax.scan(iteration, begun, observations[1:])
        return outcome(robot._objectives, tally, robot.episode_limit)

    return jax.jit(along)


def with_goal(robot: Robot[Any] | str, goal: Goal | str) -> RobotWithGoal:
    """A robot with a goal in place of its own task.

    Args:
        robot: or its name.
        goal: or its text, `"avoid pole_angle outside -12..12 deg"` (`animat.goals.text`).

    Raises:
        InvalidArgument: as `RobotWithGoal`, and for a text that is no goal.
    """
    robot = robot_named(robot) if isinstance(robot, str) else robot
    return RobotWithGoal(robot, goal if isinstance(goal, Goal) else read_goal(goal))


def without_goal(robot: Robot[Any]) -> Robot[Any]:
    """The robot alone."""
    return robot.robot if isinstance(robot, RobotWithGoal) else robot


def objectives_of(robot: Robot[Any]) -> tuple[str, ...]:
    """The objectives of its goal as texts; none of a robot without one."""
    return tuple(map(str, robot.goal.objectives)) if isinstance(robot, RobotWithGoal) else ()


def body_and_goal(robot: Robot[Any]) -> dict[str, Any]:
    """The robot as JSON data, and the text of its goal where it has one."""
    goal = {"goal": str(robot.goal)} if isinstance(robot, RobotWithGoal) else {}
    return {"robot": robot_to_dict(without_goal(robot)), **goal}


def robot_of(data: Mapping[str, Any]) -> Robot[Any]:
    """What `body_and_goal` made this of; other keys may be beside.

    Raises:
        InvalidArgument: as `robot_from_dict` and `with_goal`.
    """
    robot = robot_from_dict(data["robot"])
    return robot if data.get("goal") is None else with_goal(robot, data["goal"])
