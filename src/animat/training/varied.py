"""An environment whose episodes are drawn from ranges of the robot's parameters, its starts, and the recordings.

The ranges are arrays, traced like the simulator: for another lesson nothing is recompiled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.errors import JAXTypeError
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from animat.environment import Environment, Neurons, Responded, RobotState, State, Uniforms
from animat.errors import InvalidArgument, did_you_mean, first_line
from animat.goals.robot import RobotWithGoal, without_goal
from animat.neurons.simulator import Stored
from animat.robots.base import Robot
from animat.training.lessons import Lesson
from animat.wrappers import Wrapper, replace_innermost

Kind = TypeVar("Kind", bound=Robot[Any])


@dataclass(frozen=True)
class Varying:
    """What varies in any lesson of a training; static, as the compiled program depends on it."""

    parameters: tuple[str, ...]
    starts: tuple[str, ...]
    recordings: bool


class Ranges(NamedTuple):
    """The low and the high end of whatever varies, in the order of `Varying`; a start of NaN is as `reset` sets it."""

    parameters: Float[Stored, "*policies 2 parameters"]
    starts: Float[Stored, "*policies 2 starts"]
    recordings: Int[Stored, "*policies 2"]


def varying_in(lessons: Sequence[Lesson], *, recordings: bool) -> Varying:
    """Everything that varies in any of the lessons."""
    parameters = dict.fromkeys(name for lesson in lessons for name in lesson.parameters)
    starts = dict.fromkeys(name for lesson in lessons for name in lesson.starts)
    return Varying(tuple(parameters), tuple(starts), recordings)


def ranges_of(lesson: Lesson, varying: Varying, robot: Robot[Any], rows: tuple[int, int]) -> Ranges:
    """A lesson's ranges; a parameter that varies only in other lessons keeps the robot's value."""
    body = without_goal(robot)
    parameters = [lesson.parameters.get(name, (getattr(body, name),) * 2) for name in varying.parameters]
    starts = [lesson.starts.get(name, (np.nan, np.nan)) for name in varying.starts]
    low_high = [np.array(ends, np.float32).reshape(-1, 2).T for ends in (parameters, starts)]
    return Ranges(low_high[0], low_high[1], np.array(rows, np.int32))


@final
@dataclass(frozen=True, eq=False)
class Varied(Wrapper[RobotState]):
    """Draws what varies at each reset; the episode keeps it until its end, even if the ranges change.

    Where recordings vary, `simulator` is a stack of simulators, one per recording. `State.info` holds the `parameters`
    drawn, and the row of the `recording`. The ranges may be traced.
    """

    varying: Varying
    ranges: Ranges

    def reset(self, key: PRNGKeyArray) -> State:
        parameter_key, start_key, recording_key = jax.random.split(jax.random.fold_in(key, 1), 3)
        parameters = _between(parameter_key, self.ranges.parameters)
        environment = self._with(parameters)
        state = environment.reset(key)
        drawn = dict(zip(self.varying.starts, _between(start_key, self.ranges.starts), strict=True))
        first, last = self.ranges.recordings
        recording = jax.random.randint(recording_key, (), first, last + 1)
        info = state.info | {"parameters": parameters, "recording": recording}
        return state._replace(robot=_with_drawn_start(environment.robot, state.robot, drawn), info=info)

    def observe(self, state: State) -> Float[Array, " observations"]:
        return self._in(state).observe(state)

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> Responded:
        return self._in(state).respond(uniforms, state, action, self._drawn(state, simulator))

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> State:
        return self._in(state).advance(uniforms, state, action, self._drawn(state, simulator))

    def succeeded(self, state: State) -> Bool[Array, ""]:
        """Whether an episode that ended in this state succeeded; False for a robot that does not report success."""
        succeeded = getattr(self._in(state).robot, "succeeded", None)
        return jnp.bool_(False) if succeeded is None else succeeded(state.robot)  # type: ignore[no-any-return]

    def _in(self, state: State) -> Environment[RobotState]:
        return self._with(state.info["parameters"])

    def _with(self, parameters: Float[Array, " parameters"]) -> Environment[RobotState]:
        values = dict(zip(self.varying.parameters, parameters, strict=True))
        if not values:
            return self.inside
        varied = with_parameters(self.robot, values)
        return replace_innermost(self.inside, lambda inmost: dataclasses.replace(inmost, robot=varied))  # type: ignore[type-var]

    def _drawn(self, state: State, simulator: Neurons) -> Neurons:
        if not self.varying.recordings:
            return simulator
        row = state.info["recording"]
        return jax.tree.map(lambda stacked: stacked[row], simulator)  # type: ignore[no-any-return]


def with_parameters(robot: Kind, values: Mapping[str, Any]) -> Kind:
    """The robot with changed parameters, which may be traced: created without its checks; a goal stays unchanged."""
    if isinstance(robot, RobotWithGoal):
        with_goal = copy(robot)
        object.__setattr__(with_goal, "robot", with_parameters(robot.robot, values))
        return with_goal
    varied = object.__new__(type(robot))
    for field in dataclasses.fields(robot):  # type: ignore[arg-type]
        object.__setattr__(varied, field.name, values.get(field.name, getattr(robot, field.name)))
    return varied


def expect_varied(robot: Robot[Any], varying: Varying) -> None:
    """Refuse what cannot vary in this robot, by tracing it."""
    state = jax.eval_shape(without_goal(robot).reset, jax.random.key(0))
    leaves = {name: getattr(state, name) for name in getattr(state, "_fields", ())}
    known = [n for n, x in leaves.items() if getattr(x, "shape", None) == () and jnp.issubdtype(x.dtype, jnp.floating)]
    for name in varying.starts:
        if name not in known:
            near = did_you_mean(name, known) or f"; there are {', '.join(known) or 'none'}"
            raise InvalidArgument(f"lessons: starts: expected numbers of the state of {robot.name}, got {name!r}{near}")

    def once(value: Any, name: str) -> Any:
        varied = with_parameters(robot, {name: value})
        state = varied.reset(jax.random.key(0))
        after, reward, _ = varied.advance(jnp.zeros(robot.noise_size), state, jnp.zeros(robot.command_shape))
        return varied.observe(after), reward

    for name in varying.parameters:
        try:
            jax.eval_shape(lambda value, name=name: once(value, name), jnp.float32(getattr(without_goal(robot), name)))
        except (JAXTypeError, TypeError, ValueError, AttributeError) as error:
            expected = f"a parameter that {robot.name} uses only in arithmetic"
            got = f"one that must be known at compile time ({first_line(error)})"
            raise InvalidArgument(f"lessons: parameters.{name}: expected {expected}, got {got}") from error


def _with_drawn_start(robot: Robot[Any], state: Any, drawn: Mapping[str, Array]) -> Any:
    """The initial state with the numbers that were drawn; NaN: unchanged."""
    if not drawn:
        return state
    body = state.robot if isinstance(robot, RobotWithGoal) else state
    body = body._replace(**{n: jnp.where(jnp.isnan(value), getattr(body, n), value) for n, value in drawn.items()})
    return robot.started(body) if isinstance(robot, RobotWithGoal) else body


def _between(key: PRNGKeyArray, ends: Float[Stored, "2 numbers"]) -> Float[Array, " numbers"]:
    low, high = jnp.asarray(ends)
    drawn: Float[Array, " numbers"] = low + (high - low) * jax.random.uniform(key, low.shape)
    return drawn
