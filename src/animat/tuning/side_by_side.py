"""Trials that are trained side by side: one compiled program, which takes their settings as arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from animat.compilation import COMPILER_OPTIONS
from animat.environment import Environment
from animat.errors import InvalidFile
from animat.evaluation.rollouts import Networks
from animat.neurons.simulator import NeuronSimulator
from animat.training.sac import Learner, begin, train_chunk
from animat.training.settings import SAC
from animat.training.specification import Training
from animat.tuning.space import NUMBERS
from animat.wrappers import EpisodeLimit
from animat.writing import atomic_write


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

    def chunk(learner: Learner, numbers: Numbers, simulator: NeuronSimulator | None, first: Array, last: Array) -> Any:
        return train_chunk(limited, _traced(algorithm, numbers), learner, simulator, first, last)

    return (
        jax.jit(jax.vmap(beginning), compiler_options=COMPILER_OPTIONS),
        jax.jit(jax.vmap(chunk, in_axes=(0, 0, None, None, None)), donate_argnums=0, compiler_options=COMPILER_OPTIONS),
    )


def _traced(algorithm: SAC, numbers: Numbers) -> SAC:
    """The settings with traced numbers among them, which no check of a record could look at."""
    settings = object.__new__(SAC)
    vars(settings).update({**vars(algorithm), **numbers._asdict()})
    return settings


class SideBySide:
    """Policies of several trials while they are trained; the first ones are the first trial's.

    Args:
        training: of all of them, but for its settings that are `NUMBERS`.
        n_conditions: that policies choose from; 0 without neurons.
        algorithms: of each trial, which differ in `NUMBERS` only.
        members: numbers of the policies of each, which decide their random numbers: those of two trials are the same.
    """

    def __init__(
        self, training: Training, n_conditions: int, algorithms: Sequence[SAC], members: Sequence[int]
    ) -> None:
        self._environment = training.environment(n_conditions)
        usual = {name: value for name, value in asdict(SAC()).items() if name in NUMBERS}
        self._n, self._policies = len(algorithms), len(members)
        # With the same numbers in place, so that trials with others find the program that is compiled.
        self._beginning, self._chunk = programs(self._environment, replace(algorithms[0], **usual))
        self._numbers = Numbers(
            *(
                jnp.repeat(jnp.array([getattr(each, name) for each in algorithms], jnp.float32), self._policies)
                for name in Numbers._fields
            )
        )
        keys = [jax.random.fold_in(jax.random.key(training.seed), member) for member in members]
        self._keys = jnp.tile(jnp.stack(keys), self._n)
        self._learners: Learner | None = None

    def begin(self) -> None:
        """Have policies that have learned nothing yet."""
        self._learners = self._beginning(self._numbers, self._keys)

    def train(self, first_round: int, last_round: int, simulator: NeuronSimulator | None) -> None:
        """Train for the rounds from the first up to, not including, the last."""
        first, last = jnp.int32(first_round), jnp.int32(last_round)
        self._learners, _ = self._chunk(self._learners, self._numbers, simulator, first, last)

    def networks(self, trial: int, *, greedy: bool) -> Networks | None:
        """The policies of a trial as they would be deployed; None where what was learned is no finite number."""
        assert self._learners is not None
        ours = self._of(trial)
        network = jax.tree.map(lambda leaf: leaf[ours], self._learners.deployed)
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(network)):
            return None
        scales = jnp.tile(jnp.asarray(self._environment.scales, jnp.float32), (self._policies, 1))
        return Networks(network, scales, greedy)

    def keep(self, file: Path, done: int, trial: int | None = None) -> None:
        """Write what a trial's policies are, or those of all, and how many chunks are done; complete or absent."""
        assert self._learners is not None
        ours = slice(None) if trial is None else self._of(trial)
        leaves = jax.tree.leaves(self._learners._replace(key=jax.random.key_data(self._learners.key)))
        arrays: dict[str, Any] = {f"leaf{i}": np.asarray(leaf)[ours] for i, leaf in enumerate(leaves)}
        with atomic_write(file) as beside, beside.open("wb") as opened:
            np.savez(opened, done=np.array(done), **arrays)

    def resume(self, files: Sequence[Path]) -> int:
        """Go on from what was kept, of all or of each trial in order; returns how many chunks are done."""
        like = jax.eval_shape(self._beginning, self._numbers, self._keys)
        leaves, structure = jax.tree.flatten(like)
        read: list[list[np.ndarray]] = []
        done = 0
        for file in files:
            try:
                with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
                    done = int(arrays["done"])
                    read.append([arrays[f"leaf{i}"] for i in range(len(leaves))])
            except Exception as error:  # numpy, zipfile and zlib have a dozen kinds of errors for a damaged archive
                raise InvalidFile(f"{file}: expected what was learned so far ({error}); remove it") from error
        learners = jax.tree.unflatten(structure, [jnp.concatenate(parts) for parts in zip(*read, strict=True)])
        self._learners = learners._replace(key=jax.random.wrap_key_data(learners.key))
        return done

    def _of(self, trial: int) -> slice:
        return slice(trial * self._policies, (trial + 1) * self._policies)
