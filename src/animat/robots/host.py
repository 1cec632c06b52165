"""Robots that are stepped outside JAX: external bodies, many side by side."""

from __future__ import annotations

import abc
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, UInt8

from animat.errors import AnimatError, BodyFailed, InvalidArgument, first_line
from animat.lazy import Array, jnp
from animat.robots.base import Robot

Answer = TypeVar("Answer")
PATIENCE_S = 120.0
"""How long a step of all bodies may take, or making or resetting one, before it counts as hung."""
LONGEST_KEPT = 20_000
"""Longest episode, in iterations, whose commands are kept so that training can continue within it."""


class Body(abc.ABC):
    """One body with its state."""

    @abc.abstractmethod
    def reset(self, seed: int) -> Float[np.ndarray, " observations"]:
        """Start an episode, all draws of which follow from the seed; returns the observation."""

    @abc.abstractmethod
    def step(self, action: Any) -> tuple[Float[np.ndarray, " observations"], float, bool, bool]:
        """One iteration by one of the robot's `actions`: observation, reward, whether the task ended or was cut off."""

    def picture(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The body as it is now; None if it has no picture."""
        return None


class HostRobot(Robot[Any]):
    """A robot whose bodies are stepped in Python, one call per step.

    Compiled code (the policy, the neurons, learning) sees only the last observation of a body, which serves as its
    state. Functions that need whole episodes in one compiled program refuse such a robot.

    If `keeps_state`, an episode's seed and commands determine it, and training continues within it by replaying them.
    """

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the installed packages that determine how its bodies behave, except ours."""
        return {}

    keeps_state: bool
    """Whether the same seed and commands give the same episode, whatever came before it."""

    @property
    def keeps_episodes(self) -> bool:
        """Whether training can continue within an episode after a checkpoint."""
        return self.keeps_state and self.episode_limit <= LONGEST_KEPT

    @abc.abstractmethod
    def body(self, *, with_pictures: bool = False) -> Body:
        """A new body, with a `picture` if requested; InvalidArgument if that fails or does not match the parameters."""

    @abc.abstractmethod
    def actions(self, commands: Float[np.ndarray, "bodies commands"]) -> Sequence[Any]:
        """Motor commands in [-1, 1] as actions of the bodies, one per body."""

    def prepare(self) -> None:
        """Import what its bodies need, in a process other than the one that named the robot."""

    def reset(self, key: Array) -> Float[Array, " observations"]:
        """Zeros: nothing has been observed yet."""
        return jnp.zeros(len(self.observation_spec), jnp.float32)

    def advance(self, uniforms: Any, state: Any, u: Any) -> Any:
        """Refused: it is stepped outside JAX."""
        got = f"{self.name}, which only train, evaluate, run, live, replay and studies take"
        raise InvalidArgument(f"robot: expected one that is stepped in JAX, got {got}")

    def observe(self, state: Float[Array, " observations"]) -> Float[Array, " observations"]:
        """The last observation."""
        return state


class StepResult(NamedTuple):
    """The result of a step of several bodies, before ended episodes restart; a body or the limit may truncate one."""

    observation: Float32[np.ndarray, "bodies observations"]
    reward: Float64[np.ndarray, " bodies"]
    terminated: Bool[np.ndarray, " bodies"]
    truncated: Bool[np.ndarray, " bodies"]

    @property
    def ended(self) -> Bool[np.ndarray, " bodies"]:
        """Whether an episode ended in either way."""
        return np.asarray(self.terminated | self.truncated)


class BodiesSnapshot(NamedTuple):
    """The state of several bodies as data, which the seeds of their episodes and the commands since then restore.

    Attributes:
        observation: the last of each.
        episodes: number of episodes that each has begun.
        iterations, commands: of each in its current episode; no commands if the robot's state cannot be kept.
    """

    observation: Float32[np.ndarray, "*some bodies observations"]
    episodes: Int32[np.ndarray, "*some bodies"]
    iterations: Int32[np.ndarray, "*some bodies"]
    commands: Float32[np.ndarray, "*some bodies iterations commands"]

    @classmethod
    def initial(cls, robot: HostRobot, bodies: int) -> BodiesSnapshot:
        """The state of bodies that have not begun."""
        kept = robot.episode_limit if robot.keeps_episodes else 0
        observation = np.zeros((bodies, len(robot.observation_spec)), np.float32)
        commands = np.zeros((bodies, kept, robot.n_commands), np.float32)
        return cls(observation, np.zeros(bodies, np.int32), np.zeros(bodies, np.int32), commands)


class Bodies:
    """Bodies of one robot side by side; the seeds of its episodes follow from a body's seed and their numbers."""

    def __init__(self, robot: HostRobot, seeds: Sequence[Sequence[int]], *, with_pictures: bool = False) -> None:
        self.robot, self._seeds = robot, [tuple(seed) for seed in seeds]
        make = partial(robot.body, with_pictures=True) if with_pictures else robot.body
        self._bodies = [call_body(robot, "being made", make) for _ in seeds]
        self._now = BodiesSnapshot.initial(robot, len(self._bodies))

    def __len__(self) -> int:
        return len(self._bodies)

    @property
    def snapshot(self) -> BodiesSnapshot:
        """A copy of their current state."""
        return BodiesSnapshot(*(part.copy() for part in self._now))

    @property
    def observation(self) -> Float32[np.ndarray, "bodies observations"]:
        """A copy of their last observations."""
        return self._now.observation.copy()

    def reseed(self, seeds: Sequence[Sequence[int]]) -> None:
        """Use the seeds of new bodies from the next episodes on."""
        self._seeds = [tuple(seed) for seed in seeds]
        self._now.episodes[:] = 0

    def begin(self, which: Sequence[int] | None = None) -> Float32[np.ndarray, "bodies observations"]:
        """Start an episode of each body, or of some; returns the last observations of all."""
        for body in range(len(self._bodies)) if which is None else which:
            self._begin(body)
        self._expect_finite()
        return self.observation

    def step(self, commands: Float[np.ndarray, "bodies commands"]) -> StepResult:
        """One iteration of each body; ended episodes wait for `begin`.

        Raises BodyFailed if a body raised, hung, or returned a number that is not finite.
        """
        robot, (observation, _, iterations, kept), bodies = self.robot, self._now, self._bodies
        actions, reward = robot.actions(commands), np.zeros(len(bodies))
        terminated, truncated = np.zeros((2, len(bodies)), bool)

        def step() -> None:
            for i, (body, action) in enumerate(zip(bodies, actions, strict=True)):
                observation[i], reward[i], terminated[i], truncated[i] = body.step(action)

        call_body(robot, "step", step)
        if kept.shape[1]:
            kept[np.arange(len(bodies)), iterations] = commands
        iterations += 1
        self._expect_finite()
        if not np.isfinite(reward).all():
            raise BodyFailed(f"{robot.name}: expected finite rewards, got NaN or infinite ones")
        truncated |= iterations >= robot.episode_limit
        return StepResult(observation.copy(), reward, terminated, truncated & ~terminated)

    def picture(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The first body as it is now; None if it has no picture."""
        return call_body(self.robot, "render", self._bodies[0].picture)

    def restore(self, snapshot: BodiesSnapshot) -> bool:
        """Bring new bodies to the state of others; returns whether that succeeded: if not, each begins another."""
        for part, kept in zip(self._now, snapshot, strict=True):
            part[...] = kept
        if snapshot.commands.shape[1] and snapshot.episodes.all():
            if all(self._replay(body, snapshot) for body in range(len(self._bodies))):
                return True
            self._now.episodes[:] = snapshot.episodes
        self.begin()
        return False

    def _replay(self, body: int, snapshot: BodiesSnapshot) -> bool:
        self._now.episodes[body] -= 1
        self._begin(body)
        observation: Any = self._now.observation[body]
        for action in self.robot.actions(snapshot.commands[body, : snapshot.iterations[body]]):
            observation = call_body(self.robot, "step", self._bodies[body].step, action)[0]
        self._now.observation[body], self._now.iterations[body] = observation, snapshot.iterations[body]
        return np.array_equal(self._now.observation[body], snapshot.observation[body])

    def _begin(self, body: int) -> None:
        seed = np.random.SeedSequence((*self._seeds[body], int(self._now.episodes[body]))).generate_state(1)[0]

        def reset() -> None:
            # The assignment may raise too: a body may return anything.
            self._now.observation[body] = self._bodies[body].reset(int(seed))

        call_body(self.robot, "reset", reset)
        self._now.episodes[body] += 1
        self._now.iterations[body] = 0

    def _expect_finite(self) -> None:
        if not np.isfinite(self._now.observation).all():
            raise BodyFailed(f"{self.robot.name}: expected finite observations, got NaN or infinite ones")


def call_body(robot: HostRobot, what: str, function: Callable[..., Answer], *arguments: Any) -> Answer:
    """Call external code; whatever it raises becomes a one-line BodyFailed that names the robot."""
    try:
        with time_limit(robot.name, what):
            return function(*arguments)
    except AnimatError:
        # Ours already have a one-line message.
        raise
    except (Exception, SystemExit) as error:
        # MuJoCo's pictures need a display, or to be told that there is none.
        remedy = ": without a display set MUJOCO_GL=egl (or osmesa)" if "OpenGL" in str(error) else ""
        raise BodyFailed(f"{robot.name}: expected {what} to succeed, got {first_line(error)}{remedy}") from error


class _TooLongError(BaseException):
    """Not an Exception, which a body might catch."""


@contextmanager
def time_limit(name: str, what: str) -> Iterator[None]:
    """Raise BodyFailed if external code takes longer than `PATIENCE_S`, when it returns to Python."""
    # Only the main thread receives signals.
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: Any) -> None:
        raise _TooLongError

    before = signal.signal(signal.SIGALRM, interrupt)
    # Repeated every second, as a bare `except:` might swallow it.
    others = signal.setitimer(signal.ITIMER_REAL, PATIENCE_S, 1.0)
    try:
        yield
    except _TooLongError:
        raise BodyFailed(f"{name}: expected {what} within {PATIENCE_S:g} s, got no response: it hangs") from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL if before is None else before)
        if others[0]:
            signal.setitimer(signal.ITIMER_REAL, *others)
