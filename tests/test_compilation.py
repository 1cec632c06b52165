"""Compiled programs are kept where they can be; where they cannot, everything works all the same."""

from __future__ import annotations

import errno
import os
import runpy
import subprocess
import sys
from pathlib import Path

import jax
import numba
import pytest

import animat
from animat import compilation, devices
from animat.compilation import cache_folder, cached_njit


def test_what_cannot_be_kept_is_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def doubled(x: int) -> int:
        return 2 * x

    kept = cached_njit(error_model="numpy")
    # As in a package of the system's, for a user without a home.
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    with pytest.raises(RuntimeError, match="no locator available"):
        numba.njit(cache=True)(doubled)
    assert kept(doubled)(4) == 8


def test_what_a_full_disk_cannot_keep_is_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def tripled(x: int) -> int:
        return 3 * x

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(numba.core.caching.IndexDataCacheFile, "save", full)
    with pytest.raises(OSError, match="No space left"):
        numba.njit(cache=True)(tripled)(4)
    assert cached_njit(error_model="numpy")(tripled)(4) == 12


def test_with_compilation_turned_off_it_is_the_function_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    def halved(x: int) -> float:
        return x / 2

    monkeypatch.setattr(numba.config, "DISABLE_JIT", True)
    assert cached_njit(error_model="numpy")(halved) is halved


def test_nobody_s_home_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", unknown)
    with pytest.raises(OSError, match="Not a directory"):
        cache_folder().mkdir(parents=True)


def test_a_cache_with_a_name_that_the_system_refuses_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    before = jax.config.jax_compilation_cache_dir
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", f"/tmp/{'x' * 300}")
    compilation.keep_compilations()
    assert jax.config.jax_compilation_cache_dir == before


@pytest.mark.parametrize(
    ("flags", "level"), [(None, 1), ("--xla_dump_to=x", 1), ("--xla_backend_optimization_level=2", None)]
)
def test_what_xla_flags_say_is_left_as_it_is(
    flags: str | None, level: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if flags is not None:
        monkeypatch.setenv("XLA_FLAGS", flags)
    options = runpy.run_path(compilation.__file__)["COMPILER_OPTIONS"]
    assert options.get("xla_backend_optimization_level") == level
    assert options["xla_cpu_parallel_codegen_split_count"] == 1


def test_options_of_the_processor_s_compiler_do_not_reach_that_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """XLA for GPUs ends the process at an optimisation level below 2."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    monkeypatch.setattr(devices.importlib.util, "find_spec", lambda name: name)
    assert runpy.run_path(compilation.__file__)["COMPILER_OPTIONS"] == {"xla_gpu_deterministic_ops": True}
    # As in pinned workers, and in commands.
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert "xla_gpu_deterministic_ops" not in runpy.run_path(compilation.__file__)["COMPILER_OPTIONS"]


COMPILING = """
import sys
from animat.compilation import keep_compilations
keep_compilations()
import jax
one = jax.jit(lambda x: x + 1)(0)
print(one, one.dtype, jax.config.jax_compilation_cache_dir)
from synthetic_recordings import synthetic_recording
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
recording = synthetic_recording(1)
write_nwb(recording, sys.argv[1])
print(read_recording(sys.argv[1]).equals(recording))
"""


@pytest.mark.oracle
def test_a_home_that_is_a_file_keeps_nothing_and_says_nothing(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.touch()
    kept = ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME", "MPLCONFIGDIR")
    without = {name: value for name, value in os.environ.items() if name not in kept}
    # In plain C, Python itself cannot read where an editable installation lies, if that has an umlaut.
    language = "C" if sys.prefix.isascii() and animat.__file__.isascii() else "C.UTF-8"
    done = subprocess.run(
        [sys.executable, "-c", COMPILING, str(tmp_path / "für mich.nwb")],
        cwd=Path(__file__).parent,
        env=without | {"HOME": str(home), "LC_ALL": language, "JAX_ENABLE_X64": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "1 int32 None\nTrue\n", "")


@pytest.mark.oracle
@pytest.mark.parametrize("setting", [{}, {"JAX_DEFAULT_PRNG_IMPL": "rbg"}, {"JAX_THREEFRY_PARTITIONABLE": "0"}])
def test_random_numbers_are_those_of_any_other_process(setting: dict[str, str]) -> None:
    program = (
        "from animat.compilation import keep_compilations; keep_compilations()\n"
        "import jax; print(jax.random.bits(jax.random.fold_in(jax.random.key(3), 1), (3,)).tolist())"
    )
    done = subprocess.run([sys.executable, "-c", program], env=os.environ | setting, capture_output=True, text=True)
    expected = jax.random.bits(jax.random.fold_in(jax.random.key(3), 1), (3,)).tolist()
    assert done.stdout == f"{expected}\n"
