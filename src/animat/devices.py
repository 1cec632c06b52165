"""Which devices of a machine JAX may use: its GPU is for training (`animat.execution.gpu`), cores are for the rest."""

from __future__ import annotations

import importlib.util
import os


def may_use_gpu() -> bool:
    """Whether JAX looks for a GPU in a process like this one: there is a plugin, and `JAX_PLATFORMS` allows it."""
    first = os.environ.get("JAX_PLATFORMS", "").split(",")[0]
    return first != "cpu" and importlib.util.find_spec("jax_plugins") is not None


GPU_IS_ALLOWED = may_use_gpu()
"""As whoever started this process wants it."""


def stay_on_cores() -> None:
    """Keep JAX off the GPU in this process, before it is imported; training, in one of its own, has the GPU's memory.

    So recordings, simulators and evaluations have the same bits with a GPU and without, and whatever else
    `JAX_PLATFORMS` asks for.
    """
    os.environ["JAX_PLATFORMS"] = "cpu"


def gpu_here() -> str | None:
    """The kind of GPU that JAX uses in this process, as last bits depend on it; None for cores."""
    if not may_use_gpu():
        return None
    import jax

    device = jax.devices()[0]
    return str(device.device_kind) if device.platform == "gpu" else None
