"""The progress of a group's policies through the lessons, and each policy's best version, assessed after each chunk."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64, PRNGKeyArray

from animat.compilation import jit_side_by_side
from animat.environment import Environment, Neurons
from animat.errors import InvalidArgument
from animat.neurons.timeline import SimulatorTimeline
from animat.training.lessons import Lesson, stages_of
from animat.training.networks import Network, likeliest_action
from animat.training.sac import Learner, begin, train_chunk
from animat.training.settings import MOST_POLICIES, SAC
from animat.training.specification import CHUNKS, Training
from animat.training.varied import Ranges, Varied, Varying, ranges_of, varying_in
from animat.wrappers import EpisodeLimit

ASSESSED = ("iterations", "minute", "lesson", "success", "mean_return")
"""The columns of a policy's assessments: the minute is that of the simulators, lessons count from 1; NaN: unknown."""


def assess(
    environment: Varied[Any], episodes: int, actor: Network, simulator: Neurons, key: PRNGKeyArray
) -> tuple[Float[Array, " episodes"], Bool[Array, " episodes"]]:
    """The return of each episode of a policy's most probable actions, and whether it succeeded."""
    limited = EpisodeLimit(environment)
    start_key, iteration_key = jax.random.split(key)
    started = jax.vmap(limited.reset)(jax.random.split(start_key, episodes)).carried
    zeros = jnp.zeros(episodes)

    def iteration(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        index, state, running, returns, succeeded = carry
        uniforms = jax.random.uniform(jax.random.fold_in(iteration_key, index), (episodes, limited.noise_size))
        action = likeliest_action(limited, actor, jax.vmap(limited.observe)(state) / limited.scales)
        after = jax.vmap(limited.advance, (0, 0, 0, None))(uniforms, state, action, simulator)
        ends = running & jnp.logical_or(*after.ended)
        succeeded |= ends & jax.vmap(environment.succeeded)(after)
        return index + 1, after.carried, running & ~ends, returns + jnp.where(running, after.reward, 0.0), succeeded

    first = (jnp.int32(0), started, zeros == 0, zeros, zeros > 0)
    *_, returns, succeeded = jax.lax.while_loop(lambda carry: jnp.any(carry[2]), iteration, first)
    return returns, succeeded


class CourseState(NamedTuple):
    """The progress of a group's policies, as part of a checkpoint, whose shapes are fixed from the start.

    Attributes:
        lesson: each policy's lesson, counted from 0.
        table: assessments, NaN for those still to come; columns as `ASSESSED`.
        best: each policy's network at its best assessment, which is row `best_at`.
        score: share of successes and mean return of `best`, on the simulator in use.
    """

    lesson: Int64[np.ndarray, " policies"]
    table: Float64[np.ndarray, "chunks policies columns"]
    best: Any
    best_at: Int64[np.ndarray, " policies"]
    score: Float64[np.ndarray, "policies 2"]


def rows_of(training: Training, timeline: SimulatorTimeline | None) -> list[tuple[int, int]]:
    """The first and the last recording that each lesson's episodes draw from, among those that shadowing would use."""
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
            known = ", ".join(f"{minute:g}" for minute in timeline.start_min if minute <= until_min)
            expected = f"minutes with a recording ({known})"
            raise InvalidArgument(f"lesson {number}: recordings_min: expected {expected}, got [{low:g}, {high:g}]")
        rows.append((int(drawn[0]), int(drawn[-1])))
    return rows


@lru_cache(maxsize=8)
def programs_with_ranges(
    environment: Environment[Any], varying: Varying, algorithm: SAC, episodes: int
) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """`begin`, `train_chunk` and `assess` for several policies, each with the ranges of its lesson."""

    def varied(ranges: Ranges) -> Varied[Any]:
        return Varied(environment, varying, ranges)

    def chunk(ranges: Ranges, *arguments: Any) -> Any:
        return train_chunk(varied(ranges), algorithm, *arguments)

    return (
        jit_side_by_side(lambda ranges, key: begin(varied(ranges), algorithm, key)),
        jit_side_by_side(chunk, (0, 0, None, None, None), donate_argnums=1),
        jit_side_by_side(lambda ranges, *arguments: assess(varied(ranges), episodes, *arguments), (0, 0, None, None)),
    )


class Course:
    """The lessons of a group's policies during training."""

    def __init__(
        self, training: Training, environment: Environment[Any], timeline: SimulatorTimeline | None, policies: int
    ) -> None:
        self._training, self._timeline = training, timeline
        self._stages = stages_of(training.lessons)
        varying = varying_in(self._stages, recordings=training.shadowing == "drawn")
        stages = zip(self._stages, rows_of(training, timeline), strict=True)
        ranges = [ranges_of(stage, varying, training.robot, rows) for stage, rows in stages]
        self._ranges = jax.tree.map(lambda *ends: np.stack(ends), *ranges)
        self._programs = programs_with_ranges(environment, varying, training.algorithm, training.episodes_assessed)
        zeros = np.zeros(policies, np.int64)
        table = np.full((CHUNKS, policies, len(ASSESSED)), np.nan)
        self.state = CourseState(zeros, table, None, zeros, np.full((policies, 2), -np.inf))

    @property
    def ranges(self) -> Ranges:
        """The ranges of each policy's current lesson."""
        return jax.tree.map(lambda stages: stages[self.state.lesson], self._ranges)  # type: ignore[no-any-return]

    def begin(self, keys: Any) -> Learner:
        learners: Learner = self._programs[0](self.ranges, keys)
        self.state = self.state._replace(best=jax.tree.map(np.zeros_like, jax.device_get(learners.deployed)))
        return learners

    def train(self, learners: Learner, *arguments: Any) -> Any:
        return self._programs[1](self.ranges, learners, *arguments)

    def assess(self, index: int, deployed: Network, simulator: Neurons) -> None:
        """At the end of a chunk: assess the policies, keep the best so far, and move them on to the next lesson."""
        training, (lesson, table, best, best_at, score) = self._training, self.state
        if not training.episodes_assessed:
            return
        minute = self._minute(index)
        timeline = self._timeline
        if timeline and index and timeline.row_at(minute) != timeline.row_at(self._minute(index - 1)):
            # Scores on different simulators cannot be compared: assess the best one again on the simulator now in use.
            score = self._scores(best, simulator)
        new_score = self._scores(deployed, simulator)
        iterations = training.chunk(index)[1] * training.algorithm.environments
        table[index] = [(iterations, minute, stage + 1, *row) for stage, row in zip(lesson, new_score, strict=True)]
        policies = np.arange(len(lesson))
        old_rank = np.column_stack([table[best_at, policies, 2], np.nan_to_num(score)]).tolist()
        new_rank = np.column_stack([lesson + 1, np.nan_to_num(new_score)]).tolist()
        # Of equal scores the latest counts, as a policy keeps learning.
        is_best = np.array([new >= old for new, old in zip(new_rank, old_rank, strict=True)])
        for kept, new in zip(jax.tree.leaves(best), jax.tree.leaves(deployed), strict=True):
            kept[is_best] = np.asarray(new)[is_best]
        passed = [_passes(self._stages[stage], *row) for stage, row in zip(lesson, new_score, strict=True)]
        self.state = self.state._replace(
            lesson=np.minimum(lesson + passed, len(self._stages) - 1),
            best_at=np.where(is_best, index, best_at),
            score=np.where(is_best[:, None], new_score, score),
        )

    def _scores(self, networks: Network, simulator: Neurons) -> Float64[np.ndarray, "policies 2"]:
        """Each policy's share of successes (NaN for a robot that does not report success) and mean return."""
        # The same in each assessment of a training, so that its policies and minutes are comparable.
        key = jax.random.fold_in(jax.random.key(self._training.seed), MOST_POLICIES)
        returns, succeeded = map(np.asarray, self._programs[2](self.ranges, networks, simulator, key))
        success = np.where(hasattr(self._training.robot, "succeeded"), succeeded.mean(axis=1), np.nan)
        return np.column_stack([success, returns.mean(axis=1, dtype=np.float64)])

    def _minute(self, index: int) -> float:
        """The culture's clock at a chunk; NaN without neurons, or if each episode draws its simulator."""
        if self._timeline is None or self._training.shadowing == "drawn":
            return np.nan
        return float(self._timeline.start_min[0]) + self._training.minute(index)

    def note(self) -> str:
        """The lesson of each policy, for the progress line; empty if there is only one."""
        if len(self._stages) == 1:
            return ""
        return f"lessons {' '.join(str(stage + 1) for stage in self.state.lesson)} of {len(self._stages)}"


def _passes(lesson: Lesson, success: float, mean_return: float) -> bool:
    if lesson.success is not None:
        return bool(success >= lesson.success)
    return lesson.until_return is not None and bool(mean_return >= lesson.until_return)
