"""Users' robots and mappings: those that cannot be trained or loaded again are refused before the first iteration.

How a robot is registered, and used afterwards, is in `test_registered_robots.py`.
"""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.closed_loop.agents import ActorController
from animat.coding.checking import check_mapping
from animat.coding.mapping import Linear, Mapping, Thresholds
from animat.environment import Animat
from animat.errors import InvalidArgument, UnusableData, first_line
from animat.evaluation.rollouts import HeuristicPolicy
from animat.execution.training import train
from animat.robots import ROBOTS, Cartpole, Navigation, Quantity, Robot
from animat.robots.checking import check_robot
from animat.robots.grid import Axis, Grid, why_no_grid
from animat.robots.registry import REGISTRY, register_robot, robot_named
from animat.training.policy import load_policies
from animat.training.specification import Training
from test_training import SMALL, Kept, timeline_of


class At(NamedTuple):
    """The position of a slider."""

    x_m: Any


@dataclasses.dataclass(frozen=True)
class Slider(Robot[At]):
    """Moves by the command; staying in the middle is best."""

    gain_m: float = 0.1
    episode_limit: int = 20

    name: ClassVar[str] = "slider"
    noise_size: ClassVar[int] = 1
    paper_iterations: ClassVar[int] = 1000

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("x", "m", 1.0),)

    def reset(self, key: Any) -> At:
        return At(0.2 * jax.random.normal(key, (), jnp.float32))

    def advance(self, uniforms: Any, state: At, u: Any) -> tuple[At, Any, Any]:
        x_m = state.x_m + self.gain_m * u
        return At(x_m), -jnp.abs(x_m), jnp.abs(x_m) > 1

    def observe(self, state: At) -> Any:
        return jnp.stack([state.x_m])


KEPT: list[Any] = []


def keeping(self: Any, uniforms: Any, state: At, u: Any) -> tuple[At, Any, Any]:
    """An iteration that starts from the state of the first trace."""
    KEPT.append(state.x_m)
    return At(KEPT[0] + u), u, u > 2


def raising(*_: Any) -> Any:
    return 1 / 0


def slider(**changed: Any) -> Robot[Any]:
    """A slider with changed methods or attributes."""
    return type("Changed", (Slider,), changed)()  # type: ignore[no-any-return]


class Push(Mapping):
    """The same command for every response."""

    def __init__(self, command: Callable[[Any], Any] = lambda x: 0 * x + 0.5) -> None:
        self._command = command

    @property
    def name(self) -> str:
        return "linear"

    def command(self, x: Any, percentiles: Any) -> Any:
        return self._command(x)


def training(robot: Any, mapping: Any) -> Training:
    return Training(robot, mapping, policies=1, iterations=480, algorithm=SMALL)


def test_names_stand_for_robots_and_mappings() -> None:
    named = Training("cartpole", "9-thresholds")
    assert named == Training(Cartpole(), Thresholds(9)) and hash(named) == hash(Training(Cartpole(), Thresholds(9)))
    assert dataclasses.replace(named, mapping="linear").mapping == Linear()
    assert pickle.loads(pickle.dumps(named)) == named
    assert Training(Navigation(), None).mapping is None
    for arguments, words in (
        (
            ("cart", None),
            "robot: expected one of arm, cartpole, detour, navigation, shuttle, swing-up, wheels, got 'cart'",
        ),
        (("cartpole", "2-thresholds"), "mapping: expected one of 1-threshold"),
        ((7, None), "robot: expected a robot or the name of one, got 7"),
        ((Cartpole, None), "robot: expected a robot or the name of one, got <class"),
        ((Cartpole(), 1), "mapping: expected a mapping or the name of one, got 1"),
    ):
        with pytest.raises(InvalidArgument, match=words):
            Training(*arguments)  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        Training()  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("robot", "mapping", "words"),
    [
        (Slider(), Thresholds(1), "^robot: expected a registered one.* got Slider, .*register_robot.*in memory"),
        (Cartpole(), Push(), "^mapping: expected a registered one.* got Push, .*register_mapping.*in memory"),
        # The name of another, which would be loaded in its place.
        (slider(name="cartpole"), Thresholds(1), "^robot: expected a registered one.* got Changed"),
    ],
)
def test_what_could_not_be_loaded_again_is_refused_before_the_first_iteration(
    robot: Any, mapping: Any, words: str, tmp_path: Path
) -> None:
    progress = Kept()
    with pytest.raises(InvalidArgument, match=words) as raised:
        train(training(robot, mapping), timeline_of(), tmp_path / "out", progress=progress)
    assert "\n" not in str(raised.value) and not progress.updates and not (tmp_path / "out").exists()


def test_in_memory_they_are_trained_and_act(tmp_path: Path) -> None:
    progress = Kept()
    policies = train(training(Slider(), Push()), timeline_of(), None, progress=progress)
    assert list(policies) == ["p0"] and progress.updates[-1] == (60, 60)
    for policy in policies.values():
        assert policy.act(np.zeros(1, np.float32), np.random.default_rng(0)) in range(3)
        with pytest.raises(InvalidArgument, match="expected a registered one"):
            policy.save(tmp_path / "p0.safetensors")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"observe": lambda self, state: jnp.stack([state.x_m] * 2)}, r"observe: .*shape \(1,\), got shape \(2,\)"),
        ({"observe": lambda self, state: state.x_m}, r"observe: .*shape \(1,\), got shape \(\)"),
        ({"observe": lambda self, state: jnp.stack([state.x_m + 1j])}, "observe: expected one number .* got complex64"),
        ({"observe": lambda self, state: jnp.stack([state.x_m / 0])}, "NaN or infinite ones in an observation"),
        ({"observe": lambda self, state: jnp.stack([state.y])}, "observe: expected it to run .* AttributeError"),
        ({"reset": lambda self, key: At(jnp.float32(jnp.nan))}, "NaN or infinite ones in a state"),
        (
            {"reset": lambda self, key: At(key)},
            "reset: expected a state of numbers, got a key: store jax.random.key_data",
        ),
        ({"reset": lambda self: At(0.0)}, "reset: expected it to run under jax.jit, got TypeError"),
        ({"reset": lambda self, key: At(0)}, "advance: expected the state's structure from reset"),
        ({"advance": lambda self, uniforms, state, u: (state, u)}, r"advance: expected \(state, reward, whether"),
        ({"advance": lambda self, uniforms, state, u: (At(u[None]), u, u > 2)}, r"float32\[\]\), got another .*\[1\]"),
        ({"advance": lambda self, uniforms, state, u: (state, jnp.stack([u]), u > 2)}, r"reward: .*got shape \(1,\)"),
        ({"advance": lambda self, uniforms, state, u: (state, u, u)}, "whether it ended: expected true or false"),
        ({"advance": lambda self, uniforms, state, u: (state, "a", u > 2)}, "reward: expected a number"),
        ({"advance": lambda self, uniforms, state, u: (state, jnp.log(u - 1), u > 2)}, "infinite ones in a reward"),
        ({"advance": lambda self, uniforms, state, u: (state, float(u), u > 2)}, "advance: expected it to run"),
        ({"heuristic": lambda self, seen: seen}, r"heuristic: expected a command, shape \(\), got shape \(1,\)"),
        ({"heuristic": lambda self, seen: seen.x}, "heuristic: expected it to run .* AttributeError"),
        ({"observe": lambda self, state: [state.x_m]}, "observe: expected an array, as from jnp.stack, got a list"),
        ({"advance": keeping}, "Changed: expected methods that keep nothing from one call to the next"),
        ({"succeeded": lambda self, state: state.x_m}, "succeeded: expected true or false, got float32"),
        ({"succeeded": raising}, "succeeded: expected it to run under jax.jit, got ZeroDivisionError"),
        ({"potential": lambda self, state: jnp.stack([state.x_m])}, r"potential: expected a number, .*shape \(1,\)"),
        ({"potential": lambda self, state: state.x_m / 0}, "NaN or infinite ones in a potential"),
        ({"potential": raising}, "potential: expected it to run under jax.jit, got ZeroDivisionError"),
        ({"with_goal_of": lambda self, state, other: state.x_m}, "with_goal_of: expected the state's structure"),
        ({"with_goal_of": raising}, "with_goal_of: expected it to run under jax.jit, got ZeroDivisionError"),
        ({"value_grid": lambda self: 3}, "Changed.value_grid: expected a Grid, got 3"),
        ({"value_grid": raising}, "Changed.value_grid: expected a Grid, got ZeroDivisionError"),
        ({"observation_spec": property(raising)}, "observation_spec: expected a tuple of Quantity, got ZeroDivision"),
        ({"observation_spec": (Quantity("x", "m", 1.0),) * 2}, "observation_spec: expected each name once, got 'x'"),
        ({"noise_size": None}, "noise_size: expected a whole number"),
        ({"noise_size": -1}, "noise_size: expected a whole number"),
        ({"episode_limit": 0}, "episode_limit: expected a whole number"),
        ({"name": None}, "name: expected a string"),
        ({"observation_spec": ()}, "observation_spec: expected a tuple of Quantity"),
        ({"observation_spec": (Quantity("x", "m", 0.0),)}, "x: expected a scale from 1e-12 to 1e.12, got 0"),
        ({"observation_spec": (Quantity("x", "m", 1e13),)}, "x: expected a scale from 1e-12 to 1e.12, got 1e.13"),
        ({"observation_spec": (Quantity("x", "m", np.nan),)}, "x: expected a scale from 1e-12 to 1e.12, got nan"),
        ({"__hash__": None}, "expected a frozen dataclass"),
        (
            {"observation_spec": (Quantity("x", "m", 1.0, low=-0.01, high=0.01),)},
            "Changed.observe: x: expected from -0.01 to 0.01, the bounds of its Quantity, got",
        ),
        (
            {
                "noise_size": 0,
                "advance": lambda self, uniforms, state, u: (At(state.x_m + uniforms[0]), u, u > 2),
            },
            r"advance: expected it to run under jax.jit with 0 uniforms \(noise_size\), got IndexError",
        ),
    ],
)
def test_what_breaks_the_contract_is_named(changed: dict[str, Any], words: str) -> None:
    if "episode_limit" in changed:
        robot: Robot[Any] = Slider(**changed)
    else:
        robot = slider(**changed)
    with pytest.raises(InvalidArgument, match=words) as raised:
        train(training(robot, "1-threshold"), timeline_of(), None)
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 400


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("x", "m", "big"), "x: scale of a Quantity: expected a number, got 'big'"),
        (("x", "m", None), "x: scale of a Quantity: expected a number, got None"),
        (("x", "m", np.ones(2)), r"x: scale of a Quantity: expected a number, got array\("),
        (("x", "m", 1.0, "low"), "x: low of a Quantity: expected a number, got 'low'"),
        (("x", "m", 1.0, 0.0, ()), r"x: high of a Quantity: expected a number, got \(\)"),
        (("x", "m", 1.0, 1.0, -1.0), "x: expected low < high of a Quantity, got 1 and -1"),
        (("x", "m", 1.0, 1.0, np.float32(1)), "x: expected low < high of a Quantity, got 1 and 1"),
        (("x", "m", 1.0, np.nan), "x: expected low < high of a Quantity, got nan and inf"),
        ((1.0, "m", 1.0), "name of a Quantity: expected a string, got 1.0"),
        (("x", 1.0, 1.0), "unit of a Quantity: expected a string, got 1.0"),
    ],
)
def test_a_quantity_is_of_texts_and_numbers(given: Any, words: str) -> None:
    with pytest.raises(InvalidArgument, match=f"^{words}"):
        Quantity(*given)


def test_bounds_hold_from_the_start_of_an_episode_to_its_end() -> None:
    """Each step goes on from the state of the last, or from a start if that was the end of an episode."""
    spec = (Quantity("x", "m", 1.0, -1.0, 1.0),)

    def moving(start_m: float, end: Callable[[Any], Any]) -> Robot[Any]:
        return slider(
            observation_spec=spec,
            reset=lambda self, key: At(jnp.float32(start_m)),
            advance=lambda self, uniforms, state, u: (At(state.x_m + 0.6), u, end(u)),
        )

    never, at_once = (lambda u: u > 2), (lambda u: u < 2)
    with pytest.raises(InvalidArgument, match=r"x: expected from -1 to 1, the bounds of its Quantity, got 1\.2"):
        check_robot(moving(0.0, never))
    check_robot(moving(0.0, at_once))
    check_robot(dataclasses.replace(moving(0.0, never), episode_limit=1))
    with pytest.raises(InvalidArgument, match=r"x: expected from -1 to 1, the bounds of its Quantity, got 1\.6"):
        check_robot(moving(1.0, at_once))
    # What float32 rounds is not held against it, at a bound of 0 either.
    just_below = {"observation_spec": (Quantity("x", "m", 1.0, 0.0, 1.0),), "observe": lambda *_: jnp.full(1, -1e-9)}
    check_robot(slider(**just_below))


def test_a_robot_without_a_grid_for_its_parameters_says_why() -> None:
    def without(self: Any) -> Any:
        raise InvalidArgument("gain_m: expected 0.1 or less for an optimal return")

    robot = slider(value_grid=without)
    check_robot(robot)
    assert why_no_grid(robot) == "gain_m: expected 0.1 or less for an optimal return"


@pytest.mark.oracle
@pytest.mark.parametrize("scale", [1e-12, 1e-7, 1e7, 1e12])
def test_policies_trained_on_any_accepted_scale_act(scale: float) -> None:
    # In the unit that the robot is observed in, it moves as far as the scale says.
    robot = slider(
        observation_spec=(Quantity("x", "m", scale),), observe=lambda self, state: jnp.stack([state.x_m * scale])
    )
    for policy in train(training(robot, "1-threshold"), timeline_of(), None).values():
        assert np.all(np.isfinite(policy.act_greedily(np.array([scale], np.float32))))


@pytest.mark.oracle
def test_a_robot_of_another_size_is_trained_and_loaded(tmp_path: Path) -> None:
    # Its track is of so many metres that the scale is 5e7.
    robot = robot_named("cartpole", track_length_m=1e8)
    train(training(robot, "1-threshold"), timeline_of(), tmp_path)
    assert [policy.robot for policy in load_policies(tmp_path).values()] == [robot]


def test_what_a_callback_of_jax_raises_is_said_without_its_traceback() -> None:
    def fall_off(x: Any) -> Any:
        raise ValueError("the wheel fell off")

    with pytest.raises(jax.errors.JaxRuntimeError) as raised:
        jax.jit(lambda x: jax.pure_callback(fall_off, jax.ShapeDtypeStruct((), np.float32), x))(1.0)
    assert first_line(raised.value, with_place=False) == "ValueError: the wheel fell off"


@pytest.mark.parametrize(
    "changed",
    [
        {"reset": lambda self, key: At(jnp.float32(np.random.default_rng().random()))},
        {"observe": lambda self, state: jnp.stack(state) + np.random.default_rng().random(1).astype(np.float32) / 10},
    ],
)
def test_random_numbers_of_numpy_are_refused(changed: dict[str, Any]) -> None:
    """They would be drawn once, when it is compiled: every episode would start alike."""
    with pytest.raises(InvalidArgument, match=r"^Changed: expected steps that depend on nothing but their arguments"):
        check_robot(slider(**changed))


@pytest.mark.parametrize(
    ("to_coordinates", "to_state", "words"),
    [
        (lambda state: (state.x_m,), lambda c: At(-c[0]), r"value_grid: expected .*\(\(0\.4\)\)\) to .* got \(-0\.4\)"),
        (lambda state: (state.x_m,), lambda c: At(c[0] * jnp.nan), r"value_grid: .* to be the same, got \(nan\)"),
        (lambda state: (state.x_m,) * 2, lambda c: At(c[0]), r"value_grid: .* to be the same, got \(-0\.4, -0\.4\)"),
        (lambda state: (state.v,), lambda c: At(c[0]), r"value_grid\.to_coordinates: expected .* no attribute 'v'"),
        (lambda state: (state.x_m,), lambda c: 1 / 0, r"value_grid\.to_state: expected .* ZeroDivisionError"),
        (lambda state: (state.x_m,), lambda c: c, r"value_grid\.to_state: expected the state's structure from reset"),
    ],
)
def test_a_grid_whose_states_are_not_those_of_its_coordinates_is_refused(
    to_coordinates: Any, to_state: Any, words: str
) -> None:
    """The optimal return would be that of another task."""
    grid = Grid(Axis("x", "m", -1.0, 1.0, 9), (), to_coordinates, to_state)
    with pytest.raises(InvalidArgument, match=f"^Changed.{words}"):
        check_robot(slider(value_grid=lambda self: grid))
    check_robot(slider(value_grid=lambda self: Grid(grid.along, (), lambda state: (state.x_m,), lambda c: At(c[0]))))


def test_parameters_that_a_file_changes_are_said_to_be_so() -> None:
    @dataclasses.dataclass(frozen=True)
    class Bounded(Slider):
        bound_m: float = float("nan")
        name: ClassVar[str] = "bounded"

    register_robot(Bounded)
    with pytest.raises(InvalidArgument, match=r"parameters that a policy's file can hold, .*: bound_m$"):
        REGISTRY.expect_loadable(Bounded())


def test_a_method_that_is_missing_is_named() -> None:
    with pytest.raises(TypeError, match=r"abstract method.*observe"):
        type("Blind", (Slider,), {"observe": Robot.observe})()


@pytest.mark.oracle
def test_robots_that_keep_to_the_contract_pass() -> None:
    for robot in (Slider(), Cartpole.as_printed(), Navigation.as_printed(), *map(robot_named, ROBOTS)):
        check_robot(robot)
    for mapping in (Thresholds(1), Thresholds(9), Linear(), Push()):
        check_mapping(mapping)


def test_a_mapping_that_works_in_place_is_refused_and_leaves_the_next_check_alone() -> None:
    for _ in range(2):
        with pytest.raises(InvalidArgument, match=r"^Push\.command: expected commands, got ValueError: .* read-only"):
            check_mapping(Push(lambda x: np.clip(x, -1, 1, out=x)))
    check_mapping(Thresholds(9))


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (lambda x: 0.5, "expected 25 commands from -1 to 1, got 0.5"),
        (lambda x: x, "expected commands from -1 to 1, got 1.5 at 1.5 Hz"),
        # A little above 1, at the largest response only.
        (lambda x: x / 9_900, "expected commands from -1 to 1, got 1.0101 at 10000 Hz"),
        (
            lambda x: -x / (x + 100),
            "expected commands that never fall as the response rises, got -0 at 0 Hz and -0.0",
        ),
        (
            lambda x: 0.5 * (x > np.median(x)),
            "expected the same command for a single response as in an array, 0.5, got 0.0",
        ),
        (lambda x: np.tanh(np.asarray(x)), "expected it to run under jax.jit, got TracerArrayConversionError"),
        (
            lambda x: x * 0 + isinstance(x, np.ndarray),
            "expected the same command for a single response as in an array, 1, got 0",
        ),
        # A line without its ends, which only a response far above the largest measured one shows.
        (lambda x: (x - 6) / 12, "expected commands from -1 to 1, got 832.833 at 10000 Hz"),
        (lambda x: x * np.nan, "expected commands from -1 to 1, got nan at 0 Hz"),
        (lambda x: x.command, "expected commands, got AttributeError"),
    ],
)
def test_mappings_without_valid_commands_are_named(command: Callable[[Any], Any], words: str) -> None:
    with pytest.raises(InvalidArgument, match=f"^Push.command: {words}"):
        train(training("cartpole", Push(command)), timeline_of(), None)


@pytest.mark.parametrize("wanted", [float("nan"), 1.5])
def test_the_command_of_a_heuristic_is_valid(wanted: float) -> None:
    robot = slider(heuristic=lambda self, observation: 0 * observation[0] + wanted)
    with pytest.raises(InvalidArgument, match=f"Changed.heuristic: expected commands from -1 to 1, got {wanted:g}"):
        check_robot(robot)


@pytest.mark.parametrize(("wanted", "nearest"), [(0.15, 1), (0.3, 2), (-1.0, 0)])
def test_the_rule_takes_the_condition_whose_mean_command_is_the_nearest(wanted: float, nearest: int) -> None:
    robot = slider(heuristic=lambda self, observation: 0 * observation[0] + wanted)
    means = (-0.4, 0.1, 0.4)
    environment = Animat(robot, Thresholds(1), 3)
    rule = HeuristicPolicy(jnp.arange(3), jnp.asarray(means, jnp.float32))
    one = jax.tree.map(lambda x: x[None], rule)
    assert ActorController(one, environment).act(np.zeros(1), np.random.default_rng()) == nearest
    assert rule.act(environment, jnp.zeros((1, 1)), jnp.zeros((1, 1))).tolist() == [nearest]


def test_a_grid_that_fails_gives_the_reason() -> None:
    def broken(self: Any) -> Any:
        return 1 / 0

    said = "slider.value_grid: expected a Grid, got ZeroDivisionError: division by zero"
    line = broken.__code__.co_firstlineno + 1
    assert why_no_grid(slider(value_grid=broken)) == f"{said} ({Path(__file__).name}, line {line})"


@dataclasses.dataclass(frozen=True)
class LaterNaN(Slider):
    """Rewards the square root of the remainder of ten steps: NaN after these."""

    name: ClassVar[str] = "later"

    def advance(self, uniforms: Any, state: At, u: Any) -> tuple[At, Any, Any]:
        return At(state.x_m + 0.1), jnp.sqrt(1.0 - state.x_m), jnp.bool_(False)


@pytest.mark.oracle
def test_a_reward_that_becomes_nan_later_is_named() -> None:
    with pytest.raises(UnusableData, match="later: expected finite rewards and observations, got NaN or infinite ones"):
        train(training(LaterNaN(), None), None, None)


@pytest.mark.oracle
def test_a_training_that_is_refused_leaves_nothing_in_the_way_of_the_next(tmp_path: Path) -> None:
    register_robot(LaterNaN)
    try:
        for iterations in (480, 960):
            refused = dataclasses.replace(training(LaterNaN(), None), iterations=iterations)
            with ThreadPoolExecutor(1) as executor, pytest.raises(UnusableData, match="later: expected finite rewards"):
                train(refused, None, tmp_path / "policies", executor=executor, checkpoint_s=0)
            assert not (tmp_path / "policies").exists()
    finally:
        REGISTRY._registered.pop("later")
