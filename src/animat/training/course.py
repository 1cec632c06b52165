"""Where each policy of a group stands in its lessons, and the best of it so far, by assessments at chunks' borders."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64, PRNGKeyArray

from animat.compilation import COMPILER_OPTIONS
from animat.environment import Environment
from animat.errors import InvalidArgument
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorTimeline
from animat.training.lessons import Lesson, stages_of
from animat.training.networks import Network, likeliest_action
from animat.training.sac import Learner, begin, train_chunk
from animat.training.settings import MOST_POLICIES, SAC
from animat.training.specification import CHUNKS, Training
from animat.training.varied import Ranges, Varied, Varying, ranges_of, varying_in
from animat.wrappers import EpisodeLimit

ASSESSED = ("iterations", "minute", "lesson", "success", "mean_return")
"""The columns of a policy's assessments: the minute is that of the simulators, lessons count from 1; NaN: not known."""


def assess(
    environment: Varied[Any], episodes: int, actor: Network, simulator: NeuronSimulator | None, key: PRNGKeyArray
) -> tuple[Float[Array, " episodes"], Bool[Array, " episodes"]]:
    """Run a policy's most probable actions on the configurations that `key` decides.

    Args:
        environment: what is varied, and between what.
        episodes: how many (static).
        actor: the policy's network.
        simulator: the neurons; None without.
        key: the same in each assessment of a training, so that policies and minutes compare.

    Returns:
        of each episode the return, and whether it succeeded.
    """
    limited = EpisodeLimit(environment)
    of_starts, of_iterations = jax.random.split(key)
    started = jax.vmap(limited.reset)(jax.random.split(of_starts, episodes)).carried
    none = jnp.zeros(episodes)

    def iteration(at: tuple[Any, ...]) -> tuple[Any, ...]:
        index, state, going, returns, succeeded = at
        uniforms = jax.random.uniform(jax.random.fold_in(of_iterations, index), (episodes, limited.noise_size))
        action = likeliest_action(limited, actor, jax.vmap(limited.observe)(state) / limited.scales)
        after = jax.vmap(limited.advance, (0, 0, 0, None))(uniforms, state, action, simulator)
        ends = going & jnp.logical_or(*after.ended)
        succeeded |= ends & jax.vmap(environment.succeeded)(after)
        return index + 1, after.carried, going & ~ends, returns + jnp.where(going, after.reward, 0.0), succeeded

    first = (jnp.int32(0), started, none == 0, none, none > 0)
    *_, returns, succeeded = jax.lax.while_loop(lambda at: jnp.any(at[2]), iteration, first)
    return returns, succeeded


class Standing(NamedTuple):
    """How far the policies of a group are; of one shape from the start, as a checkpoint has it.

    Attributes:
        lesson: of each policy, from 0.
        table: their assessments, a row a chunk, NaN for those to come; columns as `ASSESSED`.
        best: the network of each at its best assessment.
        best_at: the row of that assessment.
        score: the share of successes and the mean return of `best`, on the simulator in use.
    """

    lesson: Int64[np.ndarray, " policies"]
    table: Float64[np.ndarray, "chunks policies columns"]
    best: Any
    best_at: Int64[np.ndarray, " policies"]
    score: Float64[np.ndarray, "policies 2"]


def rows_of(training: Training, timeline: SimulatorTimeline | None) -> list[tuple[int, int]]:
    """The first and the last recording that each lesson's episodes draw: of those that shadowing would have used.

    Raises:
        InvalidArgument: for a lesson that none is left for.
    """
    stages = stages_of(training.lessons)
    if timeline is None or training.shadowing != "drawn":
        return [(0, 0)] * len(stages)
    first_min = float(timeline.start_min[0])
    until_min = np.inf if training.duration_min is None else first_min + training.minute(CHUNKS - 1)
    rows = []
    for number, lesson in enumerate(stages, 1):
        low, high = lesson.recordings_min or (-np.inf, np.inf)
        drawn = np.flatnonzero((timeline.start_min >= low) & (timeline.start_min <= min(high, until_min)))
        if not len(drawn):
            told = ", ".join(f"{minute:g}" for minute in timeline.start_min if minute <= until_min)
            raise InvalidArgument(
                f"lesson {number}: recordings_min: expected minutes with a recording ({told}), got [{low:g}, {high:g}]"
            )
        rows.append((int(drawn[0]), int(drawn[-1])))
    return rows


@lru_cache(maxsize=8)
def programs_with_ranges(
    environment: Environment[Any], varying: Varying, algorithm: SAC, episodes: int
) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """`begin`, `train_chunk` and `assess` for several policies side by side, each with the ranges of its lesson."""

    def varied(ranges: Ranges) -> Varied[Any]:
        return Varied(environment, varying, ranges)

    def beginning(ranges: Ranges, key: Any) -> Learner:
        return begin(EpisodeLimit(varied(ranges)), algorithm, key)

    def chunk(ranges: Ranges, learner: Learner, simulator: NeuronSimulator | None, first: Any, last: Any) -> Any:
        return train_chunk(EpisodeLimit(varied(ranges)), algorithm, learner, simulator, first, last)

    def assessment(ranges: Ranges, actor: Network, simulator: NeuronSimulator | None, key: Any) -> Any:
        return assess(varied(ranges), episodes, actor, simulator, key)

    return (
        jax.jit(jax.vmap(beginning), compiler_options=COMPILER_OPTIONS),
        jax.jit(jax.vmap(chunk, in_axes=(0, 0, None, None, None)), donate_argnums=1, compiler_options=COMPILER_OPTIONS),
        jax.jit(jax.vmap(assessment, in_axes=(0, 0, None, None)), compiler_options=COMPILER_OPTIONS),
    )


class Course:
    """The lessons of a group's policies while they are trained.

    Args:
        training: what is trained.
        environment: what its policies act in.
        timeline: the culture's simulators; None without neurons.
        policies: how many.
    """

    def __init__(
        self, training: Training, environment: Environment[Any], timeline: SimulatorTimeline | None, policies: int
    ) -> None:
        self._training, self._timeline = training, timeline
        self._stages = stages_of(training.lessons)
        varying = varying_in(self._stages, recordings=training.shadowing == "drawn")
        of_each = zip(self._stages, rows_of(training, timeline), strict=True)
        ranges = [ranges_of(stage, varying, training.robot, rows) for stage, rows in of_each]
        self._ranges = jax.tree.map(lambda *ends: np.stack(ends), *ranges)
        self._programs = programs_with_ranges(environment, varying, training.algorithm, training.episodes_assessed)
        none = np.zeros(policies, np.int64)
        to_come = np.full((CHUNKS, policies, len(ASSESSED)), np.nan)
        self.standing = Standing(none, to_come, None, none, np.full((policies, 2), -np.inf))

    @property
    def ranges(self) -> Ranges:
        """Each policy's, by its lesson."""
        return jax.tree.map(lambda stages: stages[self.standing.lesson], self._ranges)  # type: ignore[no-any-return]

    def begin(self, keys: Any) -> Learner:
        """As `animat.training.sac.begin`, for all policies."""
        learners: Learner = self._programs[0](self.ranges, keys)
        self.standing = self.standing._replace(best=jax.tree.map(np.zeros_like, jax.device_get(learners.deployed)))
        return learners

    def train(self, learners: Learner, *arguments: Any) -> Any:
        """As `animat.training.sac.train_chunk`, for all policies."""
        return self._programs[1](self.ranges, learners, *arguments)

    def assess(self, index: int, deployed: Network, simulator: NeuronSimulator | None) -> None:
        """At the end of a chunk: assess the policies, keep those that are the best so far, and let them go on."""
        training, (lesson, table, best, best_at, score) = self._training, self.standing
        if not training.episodes_assessed:
            return
        minute = self._minute(index)
        if index and self._row(minute) != self._row(self._minute(index - 1)):
            # A culture is not as easy to control at all minutes: the best so far has to be the better one now.
            score = self._assessed(best, simulator)
        now = self._assessed(deployed, simulator)
        iterations = training.chunk(index)[1] * training.algorithm.environments
        table[index] = [(iterations, minute, stage + 1, *each) for stage, each in zip(lesson, now, strict=True)]
        policies = np.arange(len(lesson))
        before = np.column_stack([table[best_at, policies, 2], np.nan_to_num(score)]).tolist()
        today = np.column_stack([lesson + 1, np.nan_to_num(now)]).tolist()
        # Of equals the last, as a policy learns on.
        is_best = np.array([new >= old for new, old in zip(today, before, strict=True)]) | (index == 0)
        for kept, new in zip(jax.tree.leaves(best), jax.tree.leaves(deployed), strict=True):
            kept[is_best] = np.asarray(new)[is_best]
        on = [_passes(self._stages[stage], *each) for stage, each in zip(lesson, now, strict=True)]
        self.standing = Standing(
            np.minimum(lesson + on, len(self._stages) - 1),
            table,
            best,
            np.where(is_best, index, best_at),
            np.where(is_best[:, None], now, score),
        )

    def _assessed(self, networks: Network, simulator: NeuronSimulator | None) -> Float64[np.ndarray, "policies 2"]:
        """Each policy's share of successes, NaN for a robot that does not tell, and mean return."""
        key = jax.random.fold_in(jax.random.key(self._training.seed), MOST_POLICIES)
        returns, succeeded = map(np.asarray, self._programs[2](self.ranges, networks, simulator, key))
        success = np.where(hasattr(self._training.robot, "succeeded"), succeeded.mean(axis=1), np.nan)
        return np.column_stack([success, returns.mean(axis=1, dtype=np.float64)])

    def _minute(self, index: int) -> float:
        """Of the culture's clock at a chunk, whose newest simulator is in use; NaN without one of them."""
        if self._timeline is None or self._training.shadowing == "drawn":
            return np.nan
        return float(self._timeline.start_min[0]) + self._training.minute(index)

    def _row(self, minute: float) -> int:
        return 0 if self._timeline is None or np.isnan(minute) else self._timeline.row_at(minute)

    def note(self) -> str:
        """Which lesson each policy is at, for whoever waits; nothing where there is one only."""
        if len(self._stages) == 1:
            return ""
        return f"lessons {' '.join(str(stage + 1) for stage in self.standing.lesson)} of {len(self._stages)}"


def _passes(lesson: Lesson, success: float, mean_return: float) -> bool:
    if lesson.success is not None:
        return bool(success >= lesson.success)
    return lesson.until_return is not None and bool(mean_return >= lesson.until_return)
