"""Fixtures that every test may use."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# Shapes and types in the signatures of the numerical core are checked while the tests run; this must come before
# animat is imported.
install_import_hook(
    [
        "animat.neurons.simulator",
        "animat.animat",
        "animat.training.sac",
        "animat.evaluation.rollouts",
    ],
    "beartype.beartype",
)

from animat.compilation import keep_compilations, user_cache  # noqa: E402
from animat.cultures import holding  # noqa: E402

# The same random examples each time; others with --hypothesis-profile=default.
settings.register_profile("the same", derandomize=True)
settings.load_profile("the same")


@pytest.fixture(scope="session", autouse=True)
def caches() -> Iterator[None]:
    """Compile each program once a machine, not once a run of the tests; libraries that want a cache have one."""
    keep_compilations()
    with user_cache():
        yield


_NUMBERS = itertools.count()


@pytest.fixture(autouse=True)
def devices_of_its_own(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """What stands in for a device is held by a test, not by all that run on this machine."""
    folder = tmp_path_factory.getbasetemp() / "devices" / str(next(_NUMBERS))
    monkeypatch.setattr(holding, "MACHINE", folder)
    monkeypatch.setattr(holding, "_own_folder", lambda: SimpleNamespace(name=folder))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings beside the project, or where ANIMAT_REAL_DATA points; skips where it is absent."""
    folder = Path(os.environ.get("ANIMAT_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}: set ANIMAT_REAL_DATA to the folder that holds them")
    return folder


@pytest.fixture
def in_the_foreground() -> Iterator[None]:
    """Signals as a program in the foreground of a terminal has them, also where the tests were started by `nohup`."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in zip((signal.SIGINT, signal.SIGHUP), before, strict=True):
        signal.signal(number, handler)
