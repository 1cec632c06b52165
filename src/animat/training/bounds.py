"""What a training may ask for at most. JAX is not imported here: studies are read without it."""

from __future__ import annotations

from collections.abc import Mapping

MOST_POLICIES = 1_000
MOST_ITERATIONS = 2_000_000_000
"""Iterations are counted in 32 bits, with room for a last round of all environments."""

MOST_OF: Mapping[str, int] = {
    "environments": 65_536,
    "updates": 1_024,
    "batch": 16_384,
    # As float32 numbers no more.
    "replay": 2**23,
    "hidden": 1_024,
    "averaging": 1_000_000,
}
"""Each count of Soft Actor-Critic's settings; a group of five policies then takes some gigabytes."""
