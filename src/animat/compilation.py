"""Compiled programs: kept on disk, so that each is compiled once a machine and not once a run, and soon compiled."""

from __future__ import annotations

import gc
import os
from pathlib import Path

FAST_TO_COMPILE = {"xla_backend_optimization_level": 1, "xla_cpu_parallel_codegen_split_count": 1}
"""For programs of loops over small networks, as options of `jax.jit`: a fifth less time to compile, and as fast.

At level 2 LLVM looks longer at what XLA made, and finds nothing; several parts are for more cores than a worker has.
"""


def cache_folder() -> Path:
    """Where compiled programs are kept: `JAX_COMPILATION_CACHE_DIR`, or a folder of ours in the user's cache."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "animat" / "xla"


def keep_compilations() -> None:
    """Let JAX keep what it compiles in `cache_folder()`, if that can be written; for a process that will compile.

    What is imported by now is taken out of the garbage collector's view, too: looking through all of JAX, again and
    again, was a quarter of the time of tracing.
    """
    import jax

    gc.freeze()
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
