"""What is heavy, for files that are read without it: JAX is imported when something of it is first used, not before.

`Array` and `Axes` stand in annotations only.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__all__ = ["Array", "Axes", "jax", "jnp"]


class _Late:
    """A module that is not imported yet."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
    from jax import Array
    from matplotlib.axes import Axes
else:
    jax, jnp, Array, Axes = _Late("jax"), _Late("jax.numpy"), Any, Any
