"""How much memory training takes on a device, and how many groups of policies fit into it at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from animat.training.group import Group, programs

_SHARE = 0.9
"""Of the device's memory, for what is compiled; programs and what is being cut into pieces take the rest."""


def device_memory_bytes() -> float:
    """What JAX may have of the memory of the device that it uses; infinite for a processor, which does not tell."""
    stats = jax.devices()[0].memory_stats()
    return math.inf if stats is None else float(stats["bytes_limit"])


def bytes_at_once(groups: Sequence[Group]) -> int:
    """What the program that trains some groups at once has in memory: policies, replays, simulators, its own work.

    Args:
        groups: that can be trained at once.
    """
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
    """Groups cut into parts, each of which fits into the device's memory; their numbers, parts as even as possible.

    One group is a part of its own, however large.
    """
    available = _SHARE * device_memory_bytes()
    parts = 1 if math.isinf(available) else math.ceil(bytes_at_once(groups) / available)
    return [part.tolist() for part in np.array_split(np.arange(len(groups)), min(parts, len(groups)))]
