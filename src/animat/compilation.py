"""Compiled programs: kept on disk, so that each is compiled once a machine and not once a run, and soon compiled."""

from __future__ import annotations

import gc
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from animat.devices import may_use_gpu

_FAST_TO_COMPILE = {"xla_backend_optimization_level": 1, "xla_cpu_parallel_codegen_split_count": 1}
_DETERMINISTIC = {"xla_gpu_deterministic_ops": True}

COMPILER_OPTIONS = {
    option: value
    for option, value in (_DETERMINISTIC if may_use_gpu() else _FAST_TO_COMPILE).items()
    if f"--{option}" not in os.environ.get("XLA_FLAGS", "")
}
"""For programs of loops over small networks, as options of `jax.jit`.

On a processor: a fifth less time to compile, and as fast. At level 2 LLVM looks longer at what XLA made, and finds
nothing; several parts are for more cores than a worker has. XLA for GPUs refuses a level below 2; there, the same bits
each time. What `XLA_FLAGS` says of them is left as it is.
"""


def cache_folder() -> Path:
    """Where compiled programs are kept: `JAX_COMPILATION_CACHE_DIR`, or a folder of ours in the user's cache."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    return Path(chosen) if chosen else _usual_cache() / "animat" / "xla"


def keep_compilations() -> None:
    """Let JAX keep what it compiles in `cache_folder()`, if that can be written; for a process that will compile.

    Where it cannot, each process compiles anew, a few seconds each.

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
    if not os.access(folder, os.W_OK | os.X_OK):
        # JAX would warn of every program that it cannot keep.
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@contextmanager
def pynwb_importable() -> Iterator[None]:
    """As long as this lasts, pynwb can be imported: it cannot without a folder for the user's cache.

    Its own cache there is left out: of two processes that import it for the first time, one reads what the other has
    half written, and a process that is killed then leaves a file with which no import works again.
    """
    usual = _usual_cache()
    with suppress(OSError):
        usual.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        changed = {"PYNWB_NO_CACHE_DIR": "1"}
        if not os.access(usual, os.W_OK | os.X_OK):
            changed["XDG_CACHE_HOME"] = folder
        before = {name: os.environ.get(name) for name in changed}
        os.environ.update(changed)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` that keeps what it compiles beside the source or in the user's cache.

    Where neither can be written (a package of the system's, no home), each process compiles anew, instead of failing.
    """
    import numba

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:
            return numba.njit(**options)(function)

    return compiled


def _usual_cache() -> Path:
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        # Nobody's home is known: a place that nothing can be written to.
        return Path(os.devnull)
