"""Where each policy of a group stands in its lessons, and the best of it so far, by assessments at chunks' borders."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float64, Int64

from animat.compilation import FAST_TO_COMPILE
from animat.environment import Environment
from animat.errors import InvalidArgument
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorTimeline
from animat.training.assessment import assess
from animat.training.lessons import Lesson, stages_of
from animat.training.networks import Network
from animat.training.sac import Learner, begin, train_chunk
from animat.training.settings import MOST_POLICIES, SAC
from animat.training.specification import CHUNKS, Training
from animat.training.varied import Ranges, Varied, Varying, ranges_of, varying_in
from animat.wrappers import EpisodeLimit

ASSESSED = ("iterations", "minute", "lesson", "success", "mean_return")
"""The columns of a policy's assessments: the minute is that of the simulators, lessons count from 1; NaN: not known."""


class Standing(NamedTuple):
    """How far the policies of a group are; of one shape from the start, as a checkpoint has it.

    Attributes:
        lesson: of each policy, from 0.
        table: their assessments, a row a chunk, NaN for those to come; columns as `ASSESSED`.
        best: the network of each at its best assessment.
    """

    lesson: Int64[np.ndarray, " policies"]
    table: Float64[np.ndarray, "chunks policies columns"]
    best: Any


def best_assessment(assessments: Float64[np.ndarray, "assessments columns"]) -> int:
    """The row of the best one: at the latest lesson, there of the most successes, then of the largest mean return.

    Among equals it is the last, as a policy learns on.
    """
    ranked = [
        (lesson, np.nan_to_num(success), mean, row) for row, (*_, lesson, success, mean) in enumerate(assessments)
    ]
    return int(max(ranked)[-1])


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
        jax.jit(jax.vmap(beginning), compiler_options=FAST_TO_COMPILE),
        jax.jit(jax.vmap(chunk, in_axes=(0, 0, None, None, None)), donate_argnums=1, compiler_options=FAST_TO_COMPILE),
        jax.jit(jax.vmap(assessment, in_axes=(0, 0, None, None)), compiler_options=FAST_TO_COMPILE),
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
        self._training = training
        self._stages = stages_of(training.lessons)
        self._first_min = np.nan if timeline is None else float(timeline.start_min[0])
        varying = varying_in(self._stages, recordings=training.shadowing == "drawn")
        rows = rows_of(training, timeline)
        each = [
            ranges_of(*of, training.robot, row)
            for of, row in zip(((s, varying) for s in self._stages), rows, strict=True)
        ]
        self._ranges = jax.tree.map(lambda *ends: np.stack(ends), *each)
        self._programs = programs_with_ranges(environment, varying, training.algorithm, training.episodes_assessed)
        nothing = np.full((CHUNKS, policies, len(ASSESSED)), np.nan)
        self.standing = Standing(np.zeros(policies, np.int64), nothing, None)

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
        training, (lesson, table, best) = self._training, self.standing
        if not training.episodes_assessed:
            return
        key = jax.random.fold_in(jax.random.key(training.seed), MOST_POLICIES)
        returns, succeeded = map(np.asarray, self._programs[2](self.ranges, deployed, simulator, key))
        iterations = training.chunk(index)[1] * training.algorithm.environments
        tells = hasattr(training.robot, "succeeded")
        table, now = table.copy(), jax.device_get(deployed)
        for policy, stage in enumerate(lesson):
            success = succeeded[policy].mean() if tells else np.nan
            minute = self._first_min + training.minute(index)
            table[index, policy] = iterations, minute, stage + 1, success, returns[policy].mean(dtype=np.float64)
            if best_assessment(table[: index + 1, policy]) == index:
                for kept, new in zip(jax.tree.leaves(best), jax.tree.leaves(now), strict=True):
                    kept[policy] = new[policy]
        on = [_passes(self._stages[stage], *row[3:]) for stage, row in zip(lesson, table[index], strict=True)]
        self.standing = Standing(np.minimum(lesson + on, len(self._stages) - 1), table, best)

    def note(self) -> str:
        """Which lesson each policy is at, for whoever waits; nothing where there is one only."""
        if len(self._stages) == 1:
            return ""
        return f"lessons {' '.join(str(stage + 1) for stage in self.standing.lesson)} of {len(self._stages)}"


def _passes(lesson: Lesson, success: float, mean_return: float) -> bool:
    if lesson.success is not None:
        return bool(success >= lesson.success)
    return lesson.until_return is not None and bool(mean_return >= lesson.until_return)
