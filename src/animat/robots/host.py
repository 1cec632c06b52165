"""Robots that are stepped on the host, outside of anything compiled: the bodies of others, many side by side."""

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
"""How long a step of all bodies side by side may take, or making or resetting one, before it counts as hung."""

LONGEST_KEPT = 20_000
"""Iterations of an episode of which the commands are kept, so that a checkpoint can go on within it."""


class Body(abc.ABC):
    """One body with its state."""

    @abc.abstractmethod
    def reset(self, seed: int) -> Float[np.ndarray, " observations"]:
        """Start an episode, all draws of which follow from the seed; returns what is observed."""

    @abc.abstractmethod
    def step(self, action: Any) -> tuple[Float[np.ndarray, " observations"], float, bool, bool]:
        """One iteration by one of the robot's `actions`.

        Returns:
            what is observed after it, the reward in the task's own units, whether the task ended by itself, and
            whether it was cut off.
        """

    def picture(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The body as it is now; None where it gives none."""
        return None


class HostRobot(Robot[Any]):
    """A robot of which the bodies are stepped in Python, one call a step.

    What is compiled (the policy, the neurons, learning) sees of a body only its last observation, which is its state
    there. What needs whole episodes in one compiled program refuses such a robot.

    An episode is decided by its seed and its commands, where `keeps_state` says so: a checkpoint then goes on within it
    by its commands so far.
    """

    @property
    def versions(self) -> dict[str, str]:
        """Of the installed packages that decide what its bodies do, besides ours."""
        return {}

    keeps_state: bool
    """Whether the same seed and commands give the same episode, whatever was before it."""

    @property
    def keeps_episodes(self) -> bool:
        """Whether a checkpoint can go on within an episode."""
        return self.keeps_state and self.episode_limit <= LONGEST_KEPT

    @abc.abstractmethod
    def body(self, *, with_pictures: bool = False) -> Body:
        """A new body, that can be asked for its `picture` if it must.

        Raises:
            InvalidArgument: if it cannot be made, or is not what the parameters say.
        """

    @abc.abstractmethod
    def actions(self, commands: Float[np.ndarray, "bodies commands"]) -> Sequence[Any]:
        """What motor commands in [-1, 1] are as actions of the bodies, one a body."""

    def prepare(self) -> None:
        """Import what its bodies are made of; for a process that it came to from one where it was named."""

    def reset(self, key: Array) -> Float[Array, " observations"]:
        """Nothing was observed yet."""
        return jnp.zeros(len(self.observation_spec), jnp.float32)

    def advance(self, uniforms: Any, state: Any, u: Any) -> Any:
        """Refused: it is stepped on the host."""
        raise InvalidArgument(
            f"robot: expected one that is stepped in JAX, got {self.name}, which is stepped on the host: train, "
            "evaluate, run, live and studies take it, and nothing else does"
        )

    def observe(self, state: Float[Array, " observations"]) -> Float[Array, " observations"]:
        """What was observed last."""
        return state


class Stepped(NamedTuple):
    """What a step of several bodies did.

    Attributes:
        observation: after it, before ended episodes start anew.
        reward: in the task's own units.
        terminated: the task ended by itself.
        truncated: it was cut off, by the body or by the robot's `episode_limit`; never both.
    """

    observation: Float32[np.ndarray, "bodies observations"]
    reward: Float64[np.ndarray, " bodies"]
    terminated: Bool[np.ndarray, " bodies"]
    truncated: Bool[np.ndarray, " bodies"]

    @property
    def ended(self) -> Bool[np.ndarray, " bodies"]:
        """In either way."""
        return np.asarray(self.terminated | self.truncated)


class Standing(NamedTuple):
    """Where bodies stand, as data: from the seeds of their episodes and the commands since, they are there again.

    Attributes:
        observation: their last.
        episodes: how many each has begun.
        iterations: of the episode that each is in.
        commands: in that episode; empty where the robot's state cannot be kept.
    """

    observation: Float32[np.ndarray, "*some bodies observations"]
    episodes: Int32[np.ndarray, "*some bodies"]
    iterations: Int32[np.ndarray, "*some bodies"]
    commands: Float32[np.ndarray, "*some bodies iterations commands"]

    @classmethod
    def of_none(cls, robot: HostRobot, bodies: int) -> Standing:
        """Of bodies that have not begun."""
        kept = robot.episode_limit if robot.keeps_episodes else 0
        return cls(
            np.zeros((bodies, len(robot.observation_spec)), np.float32),
            np.zeros(bodies, np.int32),
            np.zeros(bodies, np.int32),
            np.zeros((bodies, kept, robot.n_commands), np.float32),
        )


class Bodies:
    """Bodies of one robot side by side, each with episodes of its own, one after the other.

    Args:
        robot: whose bodies they are.
        seeds: of each body; the seed of an episode follows from it and the episode's number.
        with_pictures: whether they can be asked for a picture.
    """

    def __init__(self, robot: HostRobot, seeds: Sequence[Sequence[int]], *, with_pictures: bool = False) -> None:
        self.robot, self._seeds = robot, [tuple(seed) for seed in seeds]
        make = partial(robot.body, with_pictures=True) if with_pictures else robot.body
        self._bodies = [tried(robot, "being made", make) for _ in seeds]
        self._at = Standing.of_none(robot, len(self._bodies))

    def __len__(self) -> int:
        return len(self._bodies)

    @property
    def standing(self) -> Standing:
        """Where they stand; a copy."""
        return Standing(*(part.copy() for part in self._at))

    @property
    def observation(self) -> Float32[np.ndarray, "bodies observations"]:
        """Their last ones; a copy."""
        return self._at.observation.copy()

    def take_seeds(self, seeds: Sequence[Sequence[int]]) -> None:
        """Have the seeds of new bodies from the next episodes on."""
        self._seeds = [tuple(seed) for seed in seeds]
        self._at.episodes[:] = 0

    def begin(self, which: Sequence[int] | None = None) -> Float32[np.ndarray, "bodies observations"]:
        """Start an episode of each, or of some; returns the last observations of all."""
        for body in range(len(self._bodies)) if which is None else which:
            self._begin(body)
        self._expect_finite()
        return self.observation

    def step(self, commands: Float[np.ndarray, "bodies commands"]) -> Stepped:
        """One iteration of each; ended episodes wait for `begin`.

        Raises:
            BodyFailed: naming the robot, if a body raised, hung, or gave what is no finite number.
        """
        robot, (observation, _, iterations, kept), bodies = self.robot, self._at, self._bodies
        actions = robot.actions(commands)
        reward = np.zeros(len(bodies))
        terminated, truncated = np.zeros(len(bodies), bool), np.zeros(len(bodies), bool)

        def step() -> None:
            for i, (body, action) in enumerate(zip(bodies, actions, strict=True)):
                observation[i], reward[i], terminated[i], truncated[i] = body.step(action)

        tried(robot, "step", step)
        if kept.shape[1]:
            kept[np.arange(len(bodies)), iterations] = commands
        iterations += 1
        self._expect_finite()
        if not np.isfinite(reward).all():
            raise BodyFailed(f"{robot.name}: expected finite rewards, got NaN or infinite ones")
        truncated |= iterations >= robot.episode_limit
        return Stepped(observation.copy(), reward, terminated, truncated & ~terminated)

    def picture(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The first body as it is now; None where it gives none."""
        return tried(self.robot, "render", self._bodies[0].picture)

    def stand(self, at: Standing) -> bool:
        """Bring new bodies to where others stood; returns whether they came there.

        Where they did not, as the robot's state is not kept or they answered otherwise than before, each has begun its
        next episode.
        """
        for part, kept in zip(self._at, at, strict=True):
            part[...] = kept
        if at.commands.shape[1] and at.episodes.all():
            if all(self._came(body, at) for body in range(len(self._bodies))):
                return True
            self._at.episodes[:] = at.episodes
        self.begin()
        return False

    def _came(self, body: int, at: Standing) -> bool:
        self._at.episodes[body] -= 1
        self._begin(body)
        seen: Any = self._at.observation[body]
        for action in self.robot.actions(at.commands[body, : at.iterations[body]]):
            seen = tried(self.robot, "step", self._bodies[body].step, action)[0]
        self._at.observation[body], self._at.iterations[body] = seen, at.iterations[body]
        return np.array_equal(self._at.observation[body], at.observation[body])

    def _begin(self, body: int) -> None:
        seed = np.random.SeedSequence((*self._seeds[body], int(self._at.episodes[body]))).generate_state(1)[0]

        def reset() -> None:
            # What it gives may be anything.
            self._at.observation[body] = self._bodies[body].reset(int(seed))

        tried(self.robot, "reset", reset)
        self._at.episodes[body] += 1
        self._at.iterations[body] = 0

    def _expect_finite(self) -> None:
        if not np.isfinite(self._at.observation).all():
            raise BodyFailed(f"{self.robot.name}: expected finite observations, got NaN or infinite ones")


def tried(robot: HostRobot, what: str, call: Callable[..., Answer], *arguments: Any) -> Answer:
    """Call what is somebody else's; whatever it raises becomes one line that names the robot (BodyFailed)."""
    try:
        with within(robot, what):
            return call(*arguments)
    except AnimatError:
        # What the house has said in one line stays as it is.
        raise
    except (Exception, SystemExit) as error:
        raise BodyFailed(f"{robot.name}: expected {what} to succeed, got {first_line(error)}") from error


class _TooLongError(BaseException):
    """Not an Exception: a body that catches those would catch this one."""


@contextmanager
def within(robot: HostRobot, what: str) -> Iterator[None]:
    """Give what is somebody else's `PATIENCE_S`.

    Only in a process's first thread, which alone takes signals, and once the body's code comes back to Python.

    Raises:
        BodyFailed: after that.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: Any) -> None:
        raise _TooLongError

    before = signal.signal(signal.SIGALRM, interrupt)
    # Again every second, as a bare `except:` would swallow it once.
    others = signal.setitimer(signal.ITIMER_REAL, PATIENCE_S, 1.0)
    try:
        yield
    except _TooLongError:
        raise BodyFailed(f"{robot.name}: expected {what} within {PATIENCE_S:g} s, got no answer: it hangs") from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL if before is None else before)
        if others[0]:
            signal.setitimer(signal.ITIMER_REAL, *others)
