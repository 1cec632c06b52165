"""Trials that are trained side by side: one compiled program, which takes their settings as arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from animat.compilation import COMPILER_OPTIONS
from animat.environment import Environment
from animat.evaluation.rollouts import Networks
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorTimeline
from animat.training.group import Group, SideBySide
from animat.training.sac import Learner, begin, train_chunk
from animat.training.settings import SAC
from animat.training.specification import Training
from animat.tuning.space import NUMBERS
from animat.wrappers import EpisodeLimit


class Numbers(NamedTuple):
    """The settings that need no compilation, of one policy; `NUMBERS` are their names."""

    learning_rate: Float[Array, ""]
    discount: Float[Array, ""]
    tau: Float[Array, ""]
    reward_scale: Float[Array, ""]
    initial_alpha: Float[Array, ""]
    target_entropy_ratio: Float[Array, ""]
    entropy_nats: Float[Array, ""]


@lru_cache(maxsize=8)
def programs(environment: Environment[Any], algorithm: SAC) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`begin` and `train_chunk` for policies side by side, each with `Numbers` of its own.

    Those of ordinary training (`animat.training.group.programs`) have them compiled in: theirs stay as they are.
    """
    limited = EpisodeLimit(environment)

    def beginning(numbers: Numbers, key: Array) -> Learner:
        learner = begin(limited, algorithm, key)
        return learner._replace(trained=learner.trained._replace(log_alpha=jnp.log(numbers.initial_alpha)))

    def chunk(numbers: Numbers, learner: Learner, simulator: NeuronSimulator | None, first: Array, last: Array) -> Any:
        return train_chunk(limited, _traced(algorithm, numbers), learner, simulator, first, last)

    return (
        jax.jit(jax.vmap(beginning), compiler_options=COMPILER_OPTIONS),
        jax.jit(jax.vmap(chunk, in_axes=(0, 0, None, None, None)), donate_argnums=1, compiler_options=COMPILER_OPTIONS),
    )


def _traced(algorithm: SAC, numbers: Numbers) -> SAC:
    """The settings with traced numbers among them, which no check of a record could look at."""
    settings = object.__new__(SAC)
    vars(settings).update({**vars(algorithm), **numbers._asdict()})
    return settings


class Trials(SideBySide):
    """Policies of several trials while they are trained, a group a trial.

    Args:
        training: of all of them, but for its settings that are `NUMBERS`.
        timeline: what they are trained on; None without neurons.
        algorithms: of each trial, which differ in `NUMBERS` only.
        members: numbers of the policies of each, which decide their random numbers: those of two trials are the same.
    """

    def __init__(
        self, training: Training, timeline: SimulatorTimeline | None, algorithms: Sequence[SAC], members: Sequence[int]
    ) -> None:
        # With the same numbers in place, so that trials with others find the program that is compiled.
        usual = {name: getattr(SAC(), name) for name in NUMBERS}
        training = replace(training, algorithm=replace(algorithms[0], **usual))
        numbers = Numbers(
            *(
                jnp.repeat(jnp.array([getattr(each, name) for each in algorithms], jnp.float32), len(members))
                for name in Numbers._fields
            )
        )
        ours = [partial(each, numbers) for each in programs(training.environment_on(timeline), training.algorithm)]
        groups = [Group(training, tuple(members), timeline, "", {})] * len(algorithms)
        # Nobody reads their curves, and a trial that diverges leaves those beside it alone.
        super().__init__(*groups, own_programs=ours, is_followed=False)

    def networks(self, trial: int, *, greedy: bool) -> Networks | None:
        """The policies of a trial as they would be deployed; None where what was learned is no finite number."""
        network = jax.tree.map(lambda leaf: self.split(np.asarray(leaf))[trial], self._learners.deployed)
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(network)):
            return None
        scales = jnp.tile(jnp.asarray(self._environment.scales, jnp.float32), (len(network[0].weight), 1))
        return Networks(network, scales, greedy)
