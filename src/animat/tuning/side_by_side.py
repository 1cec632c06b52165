"""Trials that are trained side by side by one compiled program, which takes their settings as arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from animat.compilation import jit_side_by_side
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

Numbers = dict[str, Array]


@lru_cache(maxsize=8)
def programs(environment: Environment[Any], algorithm: SAC) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`begin` and `train_chunk` for several policies, each with its own values of `NUMBERS` as the first argument.

    The programs of ordinary training (`animat.training.group.programs`) have these settings compiled in.
    """
    limited = EpisodeLimit(environment)

    def beginning(numbers: Numbers, key: Array) -> Learner:
        learner = begin(limited, algorithm, key)
        return learner._replace(trained=learner.trained._replace(log_alpha=jnp.log(numbers["initial_alpha"])))

    def chunk(numbers: Numbers, learner: Learner, simulator: NeuronSimulator | None, first: Array, last: Array) -> Any:
        # Traced numbers bypass the record's checks.
        settings = object.__new__(SAC)
        vars(settings).update({**vars(algorithm), **numbers})
        return train_chunk(limited, settings, learner, simulator, first, last)

    return jit_side_by_side(beginning), jit_side_by_side(chunk, (0, 0, None, None, None), donate_argnums=1)


class Trials(SideBySide):
    """The policies of several trials during training, one group per trial.

    Args:
        training: the training of all trials, except for the settings in `NUMBERS`.
        timeline: the simulators they are trained on; None without neurons.
        algorithms: settings of each trial, which differ only in `NUMBERS`.
        members: numbers of each trial's policies, which decide their random numbers: all trials use the same ones.
    """

    def __init__(
        self, training: Training, timeline: SimulatorTimeline | None, algorithms: Sequence[SAC], members: Sequence[int]
    ) -> None:
        # The default numbers stand in, so that trials with other numbers reuse the compiled program.
        defaults = {name: getattr(SAC(), name) for name in NUMBERS}
        training = replace(training, algorithm=replace(algorithms[0], **defaults))
        numbers = {
            name: jnp.repeat(jnp.array([getattr(settings, name) for settings in algorithms], jnp.float32), len(members))
            for name in NUMBERS
        }
        compiled = programs(training.environment_on(timeline), training.algorithm)
        groups = [Group(training, tuple(members), timeline, "", {})] * len(algorithms)
        # Nobody reads their curves, and a diverging trial must not stop the others.
        super().__init__(*groups, own_programs=[partial(program, numbers) for program in compiled], is_diagnosed=False)

    def networks(self, trial: int, *, greedy: bool) -> Networks | None:
        """The deployable policies of a trial; None if their parameters are not finite."""
        network = jax.tree.map(lambda leaf: self.split(np.asarray(leaf))[trial], self._learners.deployed)
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(network)):
            return None
        scales = jnp.tile(jnp.asarray(self._environment.scales, jnp.float32), (len(network[0].weight), 1))
        return Networks(network, scales, greedy)
