"""Compiled programs: cached on disk, so that each is compiled once per machine, not once per run; and compiled fast."""

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
"""Options of `jax.jit` for programs that loop over small networks.

On a CPU they compile in a fifth less time and run as fast: LLVM's level 2 takes longer and gains nothing, and splitting
code generation is for more cores than a worker has. XLA for GPUs refuses a level below 2; there, the option makes
results reproducible to the bit. Options that `XLA_FLAGS` sets are left alone.
"""


def jit_side_by_side(
    program: Callable[..., Any], in_axes: int | tuple[int | None, ...] = 0, donate_argnums: int | tuple[int, ...] = ()
) -> Callable[..., Any]:
    """Compile a program of one policy, when it is first called, for several policies side by side."""
    import jax

    several = jax.vmap(program, in_axes)
    return jax.jit(several, donate_argnums=donate_argnums, compiler_options=COMPILER_OPTIONS)


def cache_folder() -> Path:
    """Where compiled programs are kept: `JAX_COMPILATION_CACHE_DIR`, or our folder in the user's cache."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    return Path(chosen) if chosen else _user_cache() / "animat" / "xla"


def keep_compilations() -> None:
    """Let JAX keep what it compiles in `cache_folder()`, if that is writable; for a process that will compile.

    It also turns off 64 bits and other generators of random numbers, whatever the environment says, on which results
    must not depend, and hides everything imported so far from the garbage collector: scanning all of JAX again and
    again took a quarter of the tracing time.
    """
    import jax

    jax.config.update("jax_enable_x64", False)
    jax.config.update("jax_default_prng_impl", "threefry2x32")
    jax.config.update("jax_threefry_partitionable", True)
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    jax.config.update("jax_numpy_rank_promotion", "allow")
    gc.freeze()
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK | os.X_OK):
        # JAX would warn about every program that it cannot keep.
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@contextmanager
def pynwb_importable() -> Iterator[None]:
    """Make pynwb importable within this context, even without a writable cache folder of the user.

    Its own cache is disabled: if two processes import it for the first time, one reads what the other has half written,
    and a process killed at that moment leaves a file that breaks every later import.
    """
    cache = _user_cache()
    with suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        changed = {"PYNWB_NO_CACHE_DIR": "1"}
        if not os.access(cache, os.W_OK | os.X_OK):
            changed["XDG_CACHE_HOME"] = folder
        before = {name: os.environ[name] for name in changed if name in os.environ}
        os.environ.update(changed)
        try:
            yield
        finally:
            for name in changed:
                os.environ.pop(name, None)
            os.environ.update(before)


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` with its cache next to the source or in the user's cache.

    If neither is writable (a system package, no home, a full disk), each process compiles again instead of failing.
    """
    import numba

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            dispatcher = numba.njit(cache=True, **options)(function)
        except RuntimeError:
            return numba.njit(**options)(function)
        # With NUMBA_DISABLE_JIT it is the function itself.
        if (cache := getattr(dispatcher, "_cache", None)) is not None:
            save = cache.save_overload

            def save_if_possible(*program: Any) -> None:
                # Numba has no option for a disk that is full by the time the program is compiled.
                with suppress(OSError):
                    save(*program)

            cache.save_overload = save_if_possible
        return dispatcher

    return compiled


def _user_cache() -> Path:
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        # The home folder is unknown: return a place that cannot be written to.
        return Path(os.devnull)
