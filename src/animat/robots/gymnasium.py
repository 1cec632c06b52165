"""Any environment of Gymnasium as a body: `gymnasium:Reacher-v5`, `gymnasium:my_package.envs:Rover-v0`."""

from __future__ import annotations

import importlib
import importlib.metadata
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, final

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from animat.errors import InvalidArgument, first_line, shown, within
from animat.extras import install_command, pip_install
from animat.records import Flag, Number, Whole, read_record, record
from animat.robots.base import LARGEST_SCALE, LEAST_SCALE, Iterations, Quantity
from animat.robots.host import LONGEST_KEPT, Bodies, Body, HostRobot, time_limit
from animat.robots.own_code import code_at
from animat.robots.registry import REGISTRY

FAMILY = "gymnasium"
_ID = re.compile(r"(?:[A-Za-z_][\w.]{0,200}:)?[\w./:-]{1,200}")
MOST_OBSERVED = 4_096
"""Most numbers in an observation: a policy is a small network."""
MOST_LEVELS = 1_024
LARGEST_BOUND = 1e6
"""Of an observation: a larger bound says nothing about its usual size."""
_MEASURED_STEPS = 1_000
"""Random commands, in consecutive episodes, by which scales are measured."""
_REPEATED_STEPS = 50
_SEED = 20_260_000
Scale = Annotated[Number, Field(ge=LEAST_SCALE, le=LARGEST_SCALE)]


@lru_cache(maxsize=1)
def _distributions() -> Mapping[str, list[str]]:
    """The installed distributions of each package; to look through all of them takes a third of a second."""
    return importlib.metadata.packages_distributions()


@final
@record
class GymnasiumRobot(HostRobot):
    """A Gymnasium environment with a Box or Discrete action space, with its own rewards and ends of episodes.

    A command in [-1, 1] becomes low + (u + 1) / 2 (high - low) for each dimension of a Box, or one of n equal levels of
    a Discrete(n). `GymnasiumRobot.named` makes one by inspecting the environment. The result is plain data, so a policy
    can be loaded where the environment is not installed.

    Attributes:
        id: as for `gymnasium.make`, prefixed by `module:` if importing that module registers it.
        settings: arguments of `gymnasium.make`, by name.
        low, high: for each dimension of a Box; empty for a Discrete.
        levels: n of a Discrete(n); 0: a Box.
        scales: of each number of the flattened observation.
    """

    id: str
    settings: tuple[tuple[str, Number], ...]
    episode_limit: Iterations
    low: Annotated[tuple[Number, ...], Field(max_length=64)]
    high: Annotated[tuple[Number, ...], Field(max_length=64)]
    levels: Annotated[Whole, Field(ge=0, le=MOST_LEVELS)]
    scales: Annotated[tuple[Scale, ...], Field(min_length=1, max_length=MOST_OBSERVED)]
    keeps_state: Flag

    def __post_init__(self) -> None:
        if not _ID.fullmatch(self.id):
            raise InvalidArgument(f"id: expected the id of a Gymnasium environment, got {shown(self.id)}")
        if len(self.low) != len(self.high) or bool(self.low) == bool(self.levels):
            raise InvalidArgument("low, high, levels: expected the bounds of a Box, or the levels of a Discrete")

    @property
    def name(self) -> str:  # type: ignore[override]
        """`gymnasium:` and its id."""
        return f"{FAMILY}:{self.id}"

    @property
    def n_commands(self) -> int:  # type: ignore[override]
        """One per dimension of a Box; one for a Discrete."""
        return len(self.low) or 1

    @property
    def baseline_commands(self) -> tuple[float, ...] | None:  # type: ignore[override]
        """The middle of each level."""
        return tuple((2 * i + 1) / self.levels - 1 for i in range(self.levels)) or None

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return tuple(Quantity(f"observation_{i}", "1", scale) for i, scale in enumerate(self.scales))

    def actions(self, commands: Float[np.ndarray, "bodies commands"]) -> Sequence[Any]:
        shares = (np.asarray(commands, np.float64) + 1.0) / 2.0
        if self.levels:
            levels: list[int] = np.clip(shares[:, 0] * self.levels, 0, self.levels - 1).astype(int).tolist()
            return levels
        low, high = np.array(self.low), np.array(self.high)
        return np.clip(low + shares * (high - low), low, high)  # type: ignore[no-any-return]

    @property
    def versions(self) -> dict[str, str]:
        import gymnasium

        point: Any = gymnasium.spec(self.id.rpartition(":")[2]).entry_point
        # A partial function has no name.
        entry = point if isinstance(point, str) else f"{point.__module__}:{getattr(point, '__qualname__', '')}"
        engines = {"gymnasium.envs.mujoco": "mujoco", "gymnasium.envs.box2d": "Box2D"}
        engine = next((engine for made_in, engine in engines.items() if entry.startswith(made_in)), "")
        known = _distributions()
        packages = known.get(entry.partition(".")[0].partition(":")[0], ())
        names = ["gymnasium", *known.get(engine, ()), *packages]
        module, _, place = entry.partition(":")
        own = code_at(module, self.name) if place and not packages else {}
        return {name: importlib.metadata.version(name) for name in dict.fromkeys(names)} | own

    def body(self, *, with_pictures: bool = False) -> Body:
        module = self.id.rpartition(":")[0]
        # Not imported here: a policy file could name any module.
        if module and module not in sys.modules:
            how = f"import it first (on the command line: --robot {self.name})"
            raise InvalidArgument(f"{self.name}: expected {module} to be imported, got only a policy: {how}")
        body = _Environment(self.id, self.settings, with_pictures=with_pictures)
        if (body.low, body.high, body.levels, body.observed) != (self.low, self.high, self.levels, len(self.scales)):
            raise InvalidArgument(f"{self.name}: expected the policy's spaces, got those of another version")
        return body

    def prepare(self) -> None:
        self.import_module(self.id)

    def caveats(self) -> tuple[str, ...]:
        if self.keeps_episodes:
            return ()
        why = "the same seed and commands do not give the same episode, so an episode cannot continue from a checkpoint"
        if self.keeps_state:
            limit = f"{self.episode_limit:,} iterations is longer than the {LONGEST_KEPT:,}"
            why = f"an episode of {limit} whose commands are kept"
        return (f"{self.name}: {why}: episodes restart at each checkpoint",)

    @staticmethod
    def import_module(id: str) -> None:
        """Import the module that an id names, if any; raises as `named`."""
        try:
            if module := id.rpartition(":")[0]:
                importlib.import_module(module)
        except (Exception, SystemExit) as error:
            expected = f"{FAMILY}:module:Id with a module that can be imported"
            raise InvalidArgument(f"robot: expected {expected}, got {first_line(error)}") from error

    @classmethod
    def named(cls, id: str, /, *, episode_limit: int | None = None, **settings: float) -> GymnasiumRobot:
        """The environment with this id, which is made, inspected, and moved at random for some steps.

        Args:
            id, settings: as for `gymnasium.make`.
            episode_limit: iterations after which an episode is cut off; None: the registered limit.

        Raises:
            InvalidArgument: if it does not exist or is not installed, has unsupported spaces, or has no limit.
            BodyFailed: if it raises, hangs, or returns NaN.
        """
        if not _ID.fullmatch(id):
            raise InvalidArgument(f"robot: expected gymnasium: and an environment's id, got {shown(f'{FAMILY}:{id}')}")
        with within(f"{FAMILY}:{id}"):
            limit = None if episode_limit is None else read_record(Iterations, episode_limit, "episode_limit")
            items = tuple((name, read_record(Number, value, name)) for name, value in settings.items())
        return _inspected(id, limit, items)


@lru_cache(maxsize=32)  # a study asks for its robots often
def _inspected(id: str, episode_limit: int | None, settings: tuple[tuple[str, float], ...]) -> GymnasiumRobot:
    GymnasiumRobot.import_module(id)
    with time_limit(f"{FAMILY}:{id}", "being made"):
        body = _Environment(id, settings)
    limit = body.limit if episode_limit is None else episode_limit
    if limit is None:
        got = "an environment without one: --parameters episode_limit=1000"
        raise InvalidArgument(f"{FAMILY}:{id}: expected an episode limit, got {got}")
    robot = GymnasiumRobot(id, settings, limit, body.low, body.high, body.levels, (1.0,) * body.observed, False)
    return replace(robot, scales=measured_scales(robot, body.bounds), keeps_state=is_repeatable(robot))


REGISTRY.add_family(FAMILY, GymnasiumRobot)


class _Environment(Body):
    """One environment, without Gymnasium's checks and time limit."""

    def __init__(self, id: str, settings: tuple[tuple[str, float], ...], *, with_pictures: bool = False) -> None:
        import gymnasium
        from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker

        name = f"{FAMILY}:{id}"
        # Files have 5.0 for 5, and an environment may need a whole number (`frame_skip`).
        arguments: dict[str, Any] = {key: int(value) if value.is_integer() else value for key, value in settings}
        arguments |= {"render_mode": "rgb_array"} if with_pictures else {}
        try:
            self.limit: int | None = gymnasium.spec(id.rpartition(":")[2]).max_episode_steps
            env: Any = gymnasium.make(id, max_episode_steps=-1, disable_env_checker=True, **arguments)
            actions, observations = env.action_space, env.observation_space
        except (Exception, SystemExit) as error:
            # Anything may go wrong in an external environment.
            raise InvalidArgument(f"{name}: expected a Gymnasium environment, got {_reason(error)}") from error
        _expect_sound_mujoco(name, env)
        while isinstance(env, OrderEnforcing | PassiveEnvChecker):
            env = env.env
        self._env, self._step = env, env.step
        self.low, self.high, self.levels = _commands(name, actions)
        self._shape, self._dtype = actions.shape, actions.dtype
        self._start = int(getattr(actions, "start", 0))
        self.bounds = _observed(name, observations)
        self.observed = len(self.bounds)
        self._name, self._is_flat = name, observations.shape == (self.observed,)

    def reset(self, seed: int) -> Float[np.ndarray, " observations"]:
        return self._flat(self._env.reset(seed=seed)[0])

    def step(self, action: Any) -> tuple[Float[np.ndarray, " observations"], float, bool, bool]:
        raw = action + self._start if self.levels else action.astype(self._dtype).reshape(self._shape)
        observation, reward, terminated, truncated, _ = self._step(raw)
        return self._flat(observation), reward, terminated, truncated

    def picture(self) -> UInt8[np.ndarray, "height width 3"] | None:
        frame = np.asarray(self._env.render())
        return frame if frame.ndim == 3 and frame.dtype == np.uint8 and frame.shape[2] == 3 else None

    def _flat(self, observation: Any) -> Float[np.ndarray, " observations"]:
        if not self._is_flat:
            observation = np.reshape(observation, -1)
        if len(observation) != self.observed:
            n = self.observed
            raise InvalidArgument(f"{self._name}: expected observations of {n} numbers, got one of {len(observation)}")
        return observation  # type: ignore[no-any-return]


def _reason(error: Exception | SystemExit) -> str:
    """Gymnasium's message, with our extra for MuJoCo, which installs a version without faults."""
    message = first_line(error)
    is_missing = type(error).__name__ == "DependencyNotInstalled" or isinstance(error, ImportError)
    if is_missing and "mujoco" in message.lower():
        return f"{message.partition(',')[0]}: {install_command('mujoco')}"
    return message


def _expect_sound_mujoco(name: str, env: Any) -> None:
    is_of_mujoco = hasattr(env.unwrapped, "model") and "mujoco" in sys.modules
    if is_of_mujoco and getattr(sys.modules["mujoco"], "__version__", "") == "4.0.0":
        expected = "a MuJoCo that computes accelerations correctly"
        raise InvalidArgument(f"{name}: expected {expected}, got 4.0.0, which does not: {pip_install('mujoco<4')}")


def _commands(name: str, space: Any) -> tuple[tuple[float, ...], tuple[float, ...], int]:
    """Bounds of a Box, or levels of a Discrete."""
    from gymnasium.spaces import Box, Discrete

    if isinstance(space, Discrete):
        if space.n > MOST_LEVELS:
            raise InvalidArgument(f"{name}: expected at most {MOST_LEVELS:,} actions, got {space.n:,}")
        return (), (), int(space.n)
    if not isinstance(space, Box):
        raise InvalidArgument(f"{name}: expected an action space of kind Box or Discrete, got {type(space).__name__}")
    if not np.issubdtype(space.dtype, np.floating):
        raise InvalidArgument(f"{name}: expected actions that are floating-point numbers, got {space.dtype}")
    low, high = space.low.ravel().astype(float), space.high.ravel().astype(float)
    if not 1 <= len(low) <= 64:
        raise InvalidArgument(f"{name}: expected actions of 1 to 64 dimensions, got {len(low)}")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise InvalidArgument(f"{name}: expected actions with finite bounds, low below high, got {shown(space)}")
    return tuple(low.tolist()), tuple(high.tolist()), 0


def _observed(name: str, space: Any) -> list[float]:
    """Largest size of each number of the flattened observation; 0 if not known."""
    from gymnasium.spaces import Box

    if not isinstance(space, Box):
        raise InvalidArgument(f"{name}: expected an observation space of kind Box, got {type(space).__name__}")
    bound = np.maximum(np.abs(space.low.astype(float)), np.abs(space.high.astype(float))).ravel()
    if not 1 <= len(bound) <= MOST_OBSERVED:
        raise InvalidArgument(f"{name}: expected observations of 1 to {MOST_OBSERVED:,} numbers, got {len(bound):,}")
    known = np.where((bound >= LEAST_SCALE) & (bound <= LARGEST_BOUND), bound, 0.0)
    # Without the digits that float32 adds.
    return [float(f"{size:.6g}") for size in known]


def measured_scales(robot: HostRobot, bounds: Sequence[float]) -> tuple[float, ...]:
    """The scale of each observed number: its bound, or, where that is 0 (not known), its root mean square.

    That is over random commands, and 1 for a number that is always 0. It has two digits: processors round differently.
    """
    if all(bounds):
        return tuple(map(float, bounds))
    rng = np.random.default_rng(_SEED)
    bodies = Bodies(robot, [(_SEED,)])
    observed = [bodies.begin()[0]]
    for _ in range(_MEASURED_STEPS):
        stepped = bodies.step(_random_command(robot, rng))
        observed.append(stepped.observation[0])
        if stepped.ended[0]:
            observed.append(bodies.begin()[0])
    size = np.sqrt(np.mean(np.square(observed, dtype=np.float64), axis=0))
    return tuple(
        float(bound or f"{min(float(rms), 1e9):.2g}") if bound or rms > 1e-9 else 1.0
        for bound, rms in zip(bounds, size, strict=True)
    )


def is_repeatable(robot: HostRobot) -> bool:
    """Whether its seed and commands determine an episode, in a new body as in one that was used before."""
    used, new = Bodies(robot, [(_SEED, 1)]), Bodies(robot, [(_SEED, 2)])
    rng = np.random.default_rng(_SEED)
    used.begin()
    for _ in range(_REPEATED_STEPS):
        if used.step(_random_command(robot, rng)).ended[0]:
            break
    again = Bodies(robot, [(_SEED, 2)])
    # The same episode in fresh bodies and in one that has run another.
    used.reseed([(_SEED, 2)])
    starts = [bodies.begin() for bodies in (used, new, again)]
    if any(not np.array_equal(start, starts[0]) for start in starts):
        return False
    for _ in range(_REPEATED_STEPS):
        command = _random_command(robot, rng)
        one, *others = (bodies.step(command) for bodies in (used, new, again))
        if any(not np.array_equal(a, b) for other in others for a, b in zip(one, other, strict=True)):
            return False
        if one.ended[0]:
            break
    return True


def _random_command(robot: HostRobot, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (1, robot.n_commands)).astype(np.float32)
