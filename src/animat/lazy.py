"""JAX for modules that must be importable without it, imported on first use; the other names are annotations."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__all__ = ["Array", "Axes", "Figure", "jax", "jnp"]


class _LazyModule:
    """A module that is imported when one of its attributes is first used."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
    from jax import Array
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    jax, jnp = _LazyModule("jax"), _LazyModule("jax.numpy")
    Array = Axes = Figure = Any
