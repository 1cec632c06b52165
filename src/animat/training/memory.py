"""How much memory training needs on a device, and how many groups of policies fit into it at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from animat.training.group import Group, programs

_SHARE = 0.9
"""Share of the device's memory for arrays; programs and copies in progress take the rest."""


def device_memory_bytes() -> float:
    """The memory that JAX may use on its device; infinite for a CPU, which does not report it."""
    stats = jax.devices()[0].memory_stats()
    return math.inf if stats is None else float(stats["bytes_limit"])


def bytes_at_once(groups: Sequence[Group]) -> int:
    """The memory of the program that trains these groups at once: policies, replays, simulators, temporaries."""
    training, timeline = groups[0].training, groups[0].timeline
    environment = training.environment_on(timeline)
    own_simulators = len({group.fingerprint for group in groups}) > 1
    compiled: tuple[Any, Any] = programs(environment, training.algorithm, own_simulators)
    beginning, chunk = compiled
    policies = sum(len(group.members) for group in groups)
    learners = jax.eval_shape(beginning, jax.eval_shape(lambda: jax.random.split(jax.random.key(0), policies)))
    simulator = None if timeline is None else timeline.at(float(timeline.start_min[0]))
    leading = (policies,) if own_simulators else ()
    simulators = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leading, *leaf.shape)), simulator)
    needed = chunk.lower(learners, simulators, jnp.int32(0), jnp.int32(1)).compile().memory_analysis()
    held = needed.argument_size_in_bytes + needed.output_size_in_bytes - needed.alias_size_in_bytes
    return int(held + needed.temp_size_in_bytes)


def parts_that_fit(groups: Sequence[Group]) -> list[list[int]]:
    """Divide groups into parts, as even as possible, that each fit into the device's memory; returns their indices.

    A part has at least one group, however large.
    """
    available = _SHARE * device_memory_bytes()
    parts = 1 if math.isinf(available) else math.ceil(bytes_at_once(groups) / available)
    return [part.tolist() for part in np.array_split(np.arange(len(groups)), min(parts, len(groups)))]
