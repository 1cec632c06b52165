"""Whether a robot keeps to the contract, seen on its shapes and on a few real steps, before anything is trained."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from animat.errors import AnimatError, InvalidArgument, first_line, shown
from animat.lazy import jax, jnp
from animat.robots.base import LARGEST_SCALE, LEAST_SCALE, LONGEST_EPISODE, Quantity, Robot
from animat.robots.grid import Grid
from animat.robots.host import Bodies, HostRobot

_STEPS = 3
MOST_COMMANDS = 64


def check_robot(robot: Robot[Any]) -> None:
    """Reset a robot and step it a few times, and refuse it if something comes of it that no environment can use.

    Raises:
        InvalidArgument: naming the method or attribute, what was expected and what came.
    """
    _expect_attributes(robot)
    if isinstance(robot, HostRobot):
        _check_on_host(robot)
    else:
        _check_compiled(robot)
    if (value_grid := getattr(robot, "value_grid", None)) is not None:
        _expect_grid(f"{type(robot).__name__}.value_grid", value_grid)


@lru_cache(maxsize=64)
def _check_compiled(robot: Robot[Any]) -> None:
    """Once for each robot: compiling its episode takes some tenths of a second."""
    name, observations, noise = type(robot).__name__, len(robot.observation_spec), robot.noise_size
    one_command = () if robot.n_commands == 1 else (robot.n_commands,)
    heuristic = getattr(robot, "heuristic", None)

    def told_of(state: Any, reward: Any) -> tuple[Any, ...]:
        seen = _tried(f"{name}.observe", robot.observe, state)
        if isinstance(seen, list | tuple):
            raise InvalidArgument(f"{name}.observe: expected an array, as jnp.stack makes, got a {type(seen).__name__}")
        _expect_shape(f"{name}.observe", seen, (observations,), "one number for each of `observation_spec`")
        judged = {}
        for method, words, kind in (("succeeded", "true or false", bool), ("potential", "a number", float)):
            if (judge := getattr(robot, method, None)) is not None:
                judged[method] = _tried(f"{name}.{method}", judge, state)
                _expect_shape(f"{name}.{method}", judged[method], (), words, kind)
        return state, seen, jnp.asarray(reward, jnp.float32), judged.get("potential", 0.0)

    def episode(key: Any) -> Any:
        state = _tried(f"{name}.reset", robot.reset, key)
        told, over, wanted = [told_of(state, 0.0)], [], []
        # Commands at both ends and in the middle.
        for u in np.linspace(-1.0, 1.0, _STEPS, dtype=np.float32):
            uniforms = jnp.full(noise, 0.5, jnp.float32)
            words = f"it to run under jax.jit with {noise} uniforms (noise_size)"
            step = _tried(f"{name}.advance", robot.advance, uniforms, state, jnp.full(one_command, u), words=words)
            if not isinstance(step, tuple) or len(step) != 3:
                raise InvalidArgument(f"{name}.advance: expected (state, reward, whether it ended), got {shown(step)}")
            after, reward, ended = step
            _expect_alike(f"{name}.advance", after, state)
            _expect_shape(f"{name}.advance: reward", reward, (), "a number")
            _expect_shape(f"{name}.advance: whether it ended", ended, (), "true or false", bool)
            told.append(told_of(after, reward))
            over.append(ended)
            if heuristic is not None:
                command = _tried(f"{name}.heuristic", heuristic, told[-1][1])
                _expect_shape(f"{name}.heuristic", command, one_command, "a command")
                wanted.append(jnp.asarray(command, jnp.float32))
        return told, over, wanted

    def run(key: Any) -> Any:
        # Traced twice, by functions that JAX takes for different ones: what was kept of the first time fails in the
        # second. Under jit: what a step may not do there is seen here, and it is compiled once.
        jax.eval_shape(lambda key: episode(key), key)
        return jax.device_get(jax.jit(episode)(key))

    try:
        told, over, commands = _tried(name, run, jax.random.key(0))
    except InvalidArgument as error:
        # JAX has put a note of its own to it.
        raise InvalidArgument(str(error)) from error.__cause__
    if not np.all(np.abs(commands) <= 1):
        got = ", ".join(f"{command:g}" for command in np.ravel(commands))
        raise InvalidArgument(f"{name}.heuristic: expected commands from -1 to 1, got {got}")
    for values in told:
        for what, value in zip(("a state", "an observation", "a reward", "a potential"), values, strict=True):
            if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(value)):
                raise InvalidArgument(f"{name}: expected finite numbers, got NaN or infinite ones in {what}")
    last = [*over, True].index(True)
    _expect_within_bounds(robot, [seen for _, seen, *_ in told[: last + 2]])


def _expect_within_bounds(robot: Robot[Any], observations: list[Any]) -> None:
    """Of an episode's observations, the last one included; what float32 rounds is not held against a robot."""
    for seen in observations:
        for number, quantity in zip(seen, robot.observation_spec, strict=True):
            within = np.clip(number, quantity.low, quantity.high)
            if not np.isclose(number, within, rtol=1e-5, atol=1e-5 * quantity.scale):
                raise InvalidArgument(
                    f"{type(robot).__name__}.observe: {quantity.name}: expected from {quantity.low:g} to "
                    f"{quantity.high:g}, the bounds of its Quantity, got {number:g}"
                )


def _expect_grid(what: str, value_grid: Callable[[], Any]) -> None:
    try:
        grid = value_grid()
    except (AnimatError, NotImplementedError):
        # With these parameters it has none, and says why where one is asked for.
        return
    except Exception as error:
        raise InvalidArgument(f"{what}: expected a Grid, got {first_line(error)}") from error
    if not isinstance(grid, Grid):
        raise InvalidArgument(f"{what}: expected a Grid, got {shown(grid)}")


def _check_on_host(robot: HostRobot) -> None:
    bodies = Bodies(robot, [(0,)])
    bodies.begin()
    for u in np.linspace(-1.0, 1.0, _STEPS):
        if bodies.step(np.full((1, robot.n_commands), u)).ended[0]:
            bodies.begin()


def _expect_attributes(robot: Any) -> None:
    kind = type(robot).__name__
    if not isinstance(robot, Robot):
        raise InvalidArgument(f"robot: expected a robot or the name of one, got {shown(robot)}")
    for name, least, most in (
        ("n_commands", 1, MOST_COMMANDS),
        ("noise_size", 0, 10_000),
        ("episode_limit", 1, LONGEST_EPISODE),
    ):
        value = getattr(robot, name, None)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise InvalidArgument(f"{kind}.{name}: expected a whole number from {least} to {most}, got {shown(value)}")
    if not isinstance(getattr(robot, "name", None), str):
        raise InvalidArgument(f"{kind}.name: expected a text, got {shown(getattr(robot, 'name', None))}")
    wanted = "a tuple of Quantity"
    spec = _tried(f"{kind}.observation_spec", lambda: robot.observation_spec, words=wanted)
    if not isinstance(spec, tuple) or not spec or not all(isinstance(q, Quantity) for q in spec):
        raise InvalidArgument(f"{kind}.observation_spec: expected {wanted}, got {shown(spec)}")
    if twice := [name for name, times in Counter(quantity.name for quantity in spec).items() if times > 1]:
        raise InvalidArgument(f"{kind}.observation_spec: expected each name once, got {shown(twice[0])} twice")
    for quantity in spec:
        if not LEAST_SCALE <= quantity.scale <= LARGEST_SCALE:
            raise InvalidArgument(
                f"{kind}.observation_spec: {quantity.name}: expected a scale from {LEAST_SCALE:g} to "
                f"{LARGEST_SCALE:g}, got {quantity.scale:g}; give it in another unit"
            )
    try:
        hash(robot)
        json.dumps(dataclasses.asdict(robot))  # type: ignore[call-overload]
    except (TypeError, ValueError) as error:
        raise InvalidArgument(f"{kind}: expected a frozen dataclass of plain parameters ({error})") from error


def _tried(what: str, call: Callable[..., Any], *arguments: Any, words: str = "it to run under jax.jit") -> Any:
    try:
        return call(*arguments)
    except AnimatError:
        raise
    except Exception as error:
        # Anything may go wrong in somebody else's robot.
        if isinstance(error, jax.errors.UnexpectedTracerError):
            raise InvalidArgument(
                f"{what}: expected methods that keep nothing of a call for a later one, got a traced value that was "
                "kept: put it into the state, or make it of numpy where it is always the same"
            ) from error
        raise InvalidArgument(f"{what}: expected {words}, got {first_line(error)}") from error


def _expect_shape(what: str, value: Any, shape: tuple[int, ...], words: str, kind: type = float) -> None:
    try:
        array = jnp.asarray(value)
    except TypeError as error:
        raise InvalidArgument(f"{what}: expected {words}, shape {shape}, got {shown(value)}") from error
    if array.shape != shape:
        raise InvalidArgument(f"{what}: expected {words}, shape {shape}, got shape {array.shape}")
    if kind is bool and array.dtype != bool:
        raise InvalidArgument(f"{what}: expected {words}, got {array.dtype}")


def _expect_alike(what: str, after: Any, before: Any) -> None:
    """A state keeps its form: it is carried through a loop that is compiled once."""
    forms = [
        (jax.tree.structure(state), [(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in jax.tree.leaves(state)])
        for state in (before, after)
    ]
    if forms[0] != forms[1]:
        told = [", ".join(f"{dtype}{list(shape)}" for shape, dtype in leaves) for _, leaves in forms]
        raise InvalidArgument(f"{what}: expected a state as reset gives it ({told[0]}), got another ({told[1]})")
