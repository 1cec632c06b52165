"""Which devices JAX may use: the GPU for training (`animat.execution.gpu`), CPU cores for everything else."""

from __future__ import annotations

import importlib.util
import os


def may_use_gpu() -> bool:
    """Whether JAX looks for a GPU in a process like this one: a plugin is installed and `JAX_PLATFORMS` allows it."""
    first = os.environ.get("JAX_PLATFORMS", "").split(",")[0]
    return first != "cpu" and importlib.util.find_spec("jax_plugins") is not None


GPU_IS_ALLOWED = may_use_gpu()
"""Whether the user who started this process allows a GPU."""


def stay_on_cores() -> None:
    """Keep JAX off the GPU in this process, before JAX is imported; training, in a separate process, has its memory.

    So recordings, simulators and evaluations are identical to the bit with and without a GPU, whatever
    `JAX_PLATFORMS` requests.
    """
    os.environ["JAX_PLATFORMS"] = "cpu"


def gpu_here() -> str | None:
    """The kind of GPU that JAX uses in this process, on which the last bits depend; None for CPU cores."""
    if not may_use_gpu():
        return None
    import jax

    device = jax.devices()[0]
    return str(device.device_kind) if device.platform == "gpu" else None
