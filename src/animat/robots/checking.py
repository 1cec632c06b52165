"""Check that a robot keeps to the contract, by its shapes and a few real steps, before anything is trained."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from animat.errors import AnimatError, InvalidArgument, first_line, shown
from animat.lazy import jax, jnp
from animat.robots.base import LARGEST_SCALE, LEAST_SCALE, LONGEST_EPISODE, MOST_ITERATIONS, Quantity, Robot
from animat.robots.grid import Grid
from animat.robots.host import Bodies, HostRobot

_STEPS = 3
MOST_COMMANDS = 64


def check_robot(robot: Robot[Any]) -> None:
    """Reset a robot and step it a few times, and refuse it (InvalidArgument) if an environment cannot use it."""
    _expect_attributes(robot)
    if isinstance(robot, HostRobot):
        bodies = Bodies(robot, [(0,)])
        bodies.begin()
        for u in np.linspace(-1.0, 1.0, _STEPS):
            if bodies.step(np.full((1, robot.n_commands), u)).ended[0]:
                bodies.begin()
    else:
        _check_compiled(robot)
    if (value_grid := getattr(robot, "value_grid", None)) is not None:
        _expect_grid(f"{type(robot).__name__}.value_grid", robot, value_grid)
    expected = "a tuple of strings"
    caveats = _call(what := f"{type(robot).__name__}.caveats", robot.caveats, expected=expected)
    if not isinstance(caveats, tuple) or not all(isinstance(caveat, str) for caveat in caveats):
        raise InvalidArgument(f"{what}: expected {expected}, got {shown(caveats)}")


@lru_cache(maxsize=64)
def _check_compiled(robot: Robot[Any]) -> None:
    """Cached per robot: compiling its episode takes some tenths of a second."""
    name = type(robot).__name__
    episode = partial(_checked_episode, robot)

    def run(key: Any) -> Any:
        # Traced twice, by functions that JAX takes to be different: a value kept from the first trace fails in the
        # second. Under jit, which shows what a step may not do there, and compiles it once.
        jax.eval_shape(lambda key: episode(key), key)
        ran = jax.device_get(jax.jit(episode)(key))
        # Numbers that are drawn while it is traced are constants of the program.
        one, other = (jax.make_jaxpr(lambda key: episode(key))(key) for _ in range(2))
        if str(one) != str(other) or not all(map(np.array_equal, one.consts, other.consts)):
            expected = "steps that depend on nothing but their arguments"
            got = "different ones each time: draw random numbers from reset's key, or use advance's uniforms"
            raise InvalidArgument(f"{name}: expected {expected}, got {got}")
        return ran

    try:
        outputs, commands = _call(name, run, jax.random.key(0))
    except InvalidArgument as error:
        # Without the note that JAX adds.
        raise InvalidArgument(str(error)) from error.__cause__
    if not np.all(np.abs(commands) <= 1):
        got = ", ".join(f"{command:g}" for command in np.ravel(commands))
        raise InvalidArgument(f"{name}.heuristic: expected commands from -1 to 1, got {got}")
    for values in outputs:
        for what, value in zip(("a state", "an observation", "a reward", "a potential"), values, strict=True):
            if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(value)):
                raise InvalidArgument(f"{name}: expected finite numbers, got NaN or infinite ones in {what}")
    for _, observation, *_ in outputs:
        for number, quantity in zip(observation, robot.observation_spec, strict=True):
            within = np.clip(number, quantity.low, quantity.high)
            # Up to rounding in float32.
            if not np.isclose(number, within, rtol=1e-5, atol=1e-5 * quantity.scale):
                bounds = f"from {quantity.low:g} to {quantity.high:g}, the bounds of its Quantity"
                raise InvalidArgument(f"{name}.observe: {quantity.name}: expected {bounds}, got {number:g}")


def _checked_episode(robot: Robot[Any], key: Any) -> tuple[list[tuple[Any, ...]], list[Any]]:
    """A start and a few steps, whose shapes are checked: their `_outputs`, and the commands of the heuristic, if any.

    To be traced by JAX.
    """
    name, noise = type(robot).__name__, robot.noise_size
    heuristic = getattr(robot, "heuristic", None)
    first = state = _call(f"{name}.reset", robot.reset, key)
    if any(jnp.issubdtype(jnp.result_type(leaf), jax.dtypes.prng_key) for leaf in jax.tree.leaves(state)):
        raise InvalidArgument(f"{name}.reset: expected a state of numbers, got a key: store jax.random.key_data")
    if hasattr(robot, "with_goal_of"):
        switched = _call(f"{name}.with_goal_of", robot.with_goal_of, first, first)
        _expect_same_structure(f"{name}.with_goal_of", switched, first)
    outputs, commands = [_outputs(robot, state, 0.0)], []
    # Commands at both ends and in the middle.
    for number, u in enumerate(np.linspace(-1.0, 1.0, _STEPS, dtype=np.float32), 1):
        uniforms, given = jnp.full(noise, 0.5, jnp.float32), jnp.full(robot.command_shape, u)
        expected = f"it to run under jax.jit with {noise} uniforms (noise_size)"
        step = _call(f"{name}.advance", robot.advance, uniforms, state, given, expected=expected)
        if not isinstance(step, tuple) or len(step) != 3:
            raise InvalidArgument(f"{name}.advance: expected (state, reward, whether it ended), got {shown(step)}")
        after, reward, ended = step
        _expect_same_structure(f"{name}.advance", after, state)
        _expect_shape(f"{name}.advance: reward", reward, (), "a number")
        _expect_shape(f"{name}.advance: whether it ended", ended, (), "true or false", bool)
        outputs.append(_outputs(robot, after, reward))
        if heuristic is not None:
            command = _call(f"{name}.heuristic", heuristic, outputs[-1][1])
            _expect_shape(f"{name}.heuristic", command, robot.command_shape, "a command")
            commands.append(jnp.asarray(command, jnp.float32))
        # After its end an episode starts again.
        is_over = jnp.logical_or(ended, number % robot.episode_limit == 0)
        state = jax.tree.map(partial(jnp.where, is_over), first, after)
    return outputs, commands


def _outputs(robot: Robot[Any], state: Any, reward: Any) -> tuple[Any, ...]:
    """A state, with its observation, the reward that led to it, and its potential, if there is one."""
    name, observations = type(robot).__name__, len(robot.observation_spec)
    observation = _call(f"{name}.observe", robot.observe, state)
    if isinstance(observation, list | tuple):
        kind = type(observation).__name__
        raise InvalidArgument(f"{name}.observe: expected an array, as from jnp.stack, got a {kind}")
    _expect_shape(f"{name}.observe", observation, (observations,), "one number for each of `observation_spec`")
    values = {}
    for method, expected, dtype in (("succeeded", "true or false", bool), ("potential", "a number", float)):
        if (function := getattr(robot, method, None)) is not None:
            values[method] = _call(f"{name}.{method}", function, state)
            _expect_shape(f"{name}.{method}", values[method], (), expected, dtype)
    return state, observation, jnp.asarray(reward, jnp.float32), values.get("potential", 0.0)


def _expect_grid(what: str, robot: Robot[Any], value_grid: Callable[[], Any]) -> None:
    try:
        grid = value_grid()
    except (AnimatError, NotImplementedError):
        # There is none with these parameters, and the reason is reported where one is needed.
        return
    except Exception as error:
        raise InvalidArgument(f"{what}: expected a Grid, got {first_line(error)}") from error
    if not isinstance(grid, Grid):
        raise InvalidArgument(f"{what}: expected a Grid, got {shown(grid)}")
    # At a place within it that differs from axis to axis.
    axes = (grid.along, *grid.rows)
    shares = np.linspace(0.3, 0.6, len(axes))
    given = [axis.low + share * (axis.high - axis.low) for axis, share in zip(axes, shares, strict=True)]

    def located(at: Sequence[float]) -> list[float]:
        state = _call(f"{what}.to_state", grid.to_state, tuple(map(jnp.float32, at)))
        _expect_same_structure(f"{what}.to_state", state, robot.reset(jax.random.key(0)))
        return list(_call(f"{what}.to_coordinates", lambda: [float(each) for each in grid.to_coordinates(state)]))

    # A coordinate that does not matter may be left out of the state, once for all.
    given = located(given)
    back = np.array(located(given))
    lengths = np.array([axis.high - axis.low if axis.periodic else np.inf for axis in axes])
    if len(back) == len(given) == len(axes):
        off = np.abs(back - given)
        if np.all(np.minimum(off, np.abs(off - lengths)) < [axis.step / 100 for axis in axes]):
            return
    expected, got = ", ".join(f"{each:g}" for each in given), ", ".join(f"{each:g}" for each in back)
    raise InvalidArgument(f"{what}: expected to_coordinates(to_state(({expected}))) to be the same, got ({got})")


def _expect_attributes(robot: Robot[Any]) -> None:
    kind = type(robot).__name__
    for name, least, most in (
        ("n_commands", 1, MOST_COMMANDS),
        ("noise_size", 0, 10_000),
        ("episode_limit", 1, LONGEST_EPISODE),
        ("paper_iterations", 1, MOST_ITERATIONS),
    ):
        value = getattr(robot, name, None)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise InvalidArgument(f"{kind}.{name}: expected a whole number from {least} to {most}, got {shown(value)}")
    if not isinstance(getattr(robot, "name", None), str):
        raise InvalidArgument(f"{kind}.name: expected a string, got {shown(getattr(robot, 'name', None))}")
    expected = "a tuple of Quantity"
    spec = _call(f"{kind}.observation_spec", lambda: robot.observation_spec, expected=expected)
    if not isinstance(spec, tuple) or not spec or not all(isinstance(q, Quantity) for q in spec):
        raise InvalidArgument(f"{kind}.observation_spec: expected {expected}, got {shown(spec)}")
    if repeated := [name for name, times in Counter(quantity.name for quantity in spec).items() if times > 1]:
        raise InvalidArgument(f"{kind}.observation_spec: expected each name once, got {shown(repeated[0])} twice")
    for quantity in spec:
        if not LEAST_SCALE <= quantity.scale <= LARGEST_SCALE:
            expected = f"a scale from {LEAST_SCALE:g} to {LARGEST_SCALE:g}"
            raise InvalidArgument(f"{kind}: {quantity.name}: expected {expected}, got {quantity.scale:g}")
    expected = "two numbers, the lowest and the highest return of an episode"
    limits = _call(f"{kind}.return_range", lambda: list(map(float, robot.return_range)), expected=expected)
    if len(limits) != 2 or not limits[0] <= limits[1]:
        raise InvalidArgument(f"{kind}.return_range: expected {expected}, got {shown(robot.return_range)}")
    try:
        hash(robot)
        json.dumps(dataclasses.asdict(robot))  # type: ignore[call-overload]
    except (TypeError, ValueError) as error:
        raise InvalidArgument(f"{kind}: expected a frozen dataclass of plain parameters ({error})") from error


def _call(what: str, function: Callable[..., Any], *arguments: Any, expected: str = "it to run under jax.jit") -> Any:
    try:
        return function(*arguments)
    except AnimatError:
        raise
    except Exception as error:
        # Anything may go wrong in a user's robot.
        got = first_line(error)
        if isinstance(error, jax.errors.UnexpectedTracerError):
            expected = "methods that keep nothing from one call to the next"
            got = "a traced value that was kept: put it into the state, or make it a NumPy array if it never changes"
        raise InvalidArgument(f"{what}: expected {expected}, got {got}") from error


def _expect_shape(what: str, value: Any, shape: tuple[int, ...], expected: str, dtype: type = float) -> None:
    try:
        array = jnp.asarray(value)
    except TypeError as error:
        raise InvalidArgument(f"{what}: expected {expected}, shape {shape}, got {shown(value)}") from error
    if array.shape != shape:
        raise InvalidArgument(f"{what}: expected {expected}, shape {shape}, got shape {array.shape}")
    if jnp.iscomplexobj(array) or (dtype is bool and array.dtype != bool):
        raise InvalidArgument(f"{what}: expected {expected}, got {array.dtype}")


def _expect_same_structure(what: str, after: Any, before: Any) -> None:
    """A state keeps its structure: it is carried through a loop that is compiled once."""
    leaves = [
        ", ".join(f"{jnp.result_type(leaf)}{list(jnp.shape(leaf))}" for leaf in jax.tree.leaves(state))
        for state in (before, after)
    ]
    if (jax.tree.structure(before), leaves[0]) != (jax.tree.structure(after), leaves[1]):
        reset, other = leaves
        raise InvalidArgument(f"{what}: expected the state's structure from reset ({reset}), got another ({other})")
