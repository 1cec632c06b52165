"""Fixtures that every test may use."""

from __future__ import annotations

import fcntl
import gc
import importlib
import itertools
import os
import shutil
import signal
import sys
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# Shapes and types in the signatures of the numerical core are checked while the tests run; this must come before
# animat is imported.
install_import_hook(
    [
        "animat.neurons.simulator",
        "animat.environment",
        "animat.wrappers",
        "animat.training.sac",
        "animat.evaluation.rollouts",
    ],
    "beartype.beartype",
)

from animat.cultures import holding  # noqa: E402

SOON_COMPILED = "--xla_backend_optimization_level=0"
if [int(part) for part in version("jaxlib").split(".")[:2]] < [0, 11]:
    # Later ones have no other way, and end a process that names this one.
    SOON_COMPILED += " --xla_cpu_use_fusion_emitters=false"
"""A sixth of the time to compile a training, which then takes three times as long, and here lasts for moments."""

# The same random examples each time; others with --hypothesis-profile=default. However long one takes: on a machine
# busy with other work it took more than Hypothesis allows.
settings.register_profile("the same", derandomize=True, deadline=None)
settings.load_profile("the same")


def pytest_configure(config: pytest.Config) -> None:
    """Compile soon, in this process and all that it starts; long oracles train for minutes, compiled as users are.

    Bytecode is kept as in any usual shell, also where the environment says otherwise: each of the processes that tests
    start would compile animat anew, and each worker rewrite all assertions.
    """
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    asked = config.getoption("markexpr")
    if asked and "long" not in asked.replace("not long", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {SOON_COMPILED}"


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Collect without looking for garbage: hardly anything is, and looking took a third of the time.

    In the tests it is looked for rarely: as often as usual it took 7 % of their time.
    """
    gc.disable()
    try:
        import_from_the_last_to_the_first(session.config)
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(50_000, 20, 100)
        gc.enable()


def import_from_the_last_to_the_first(config: pytest.Config) -> None:
    """In every other worker, where all tests are run: of two, each rewrites the assertions of half of the files.

    What one has rewritten, the other finds on disk; in the same order both would rewrite all of them.
    """
    worker = getattr(config, "workerinput", {"workerid": "gw0"})["workerid"]
    if int(worker[2:]) % 2 == 0 or [Path(each).resolve() for each in config.args] != [Path(__file__).parent]:
        return
    for file in sorted(Path(__file__).parent.glob("test_*.py"), reverse=True):
        # Errors are reported where the file is collected.
        with suppress(Exception, pytest.skip.Exception):
            importlib.import_module(file.stem)


def keep_contexts() -> None:
    """Let each thread put all its programs together in one context: JAX sets up another for each, a third of the time.

    It has no option for that. Where its insides have other names, it does as usual, and the tests take longer.
    """
    try:
        from jax._src.interpreters import mlir

        make, kept = mlir.make_ir_context, threading.local()
    except (ImportError, AttributeError):
        return

    def context_of_this_thread(*given: object, **named: object) -> object:
        if given or named:
            return make(*given, **named)
        if not hasattr(kept, "context"):
            kept.context = make()
        return kept.context

    mlir.make_ir_context = context_of_this_thread


@pytest.fixture(scope="session", autouse=True)
def caches() -> Iterator[None]:
    """Compile each program once a machine, not once a run of the tests; libraries that want a cache have one."""
    # Not before XLA's flags are set.
    from animat.compilation import keep_compilations, pynwb_importable

    keep_compilations()
    keep_contexts()
    with pynwb_importable():
        yield


@pytest.fixture(scope="session", autouse=True)
def not_waiting_for_the_disk() -> Iterator[None]:
    """No test cuts the power: what is written need not be on the disk when a test goes on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
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


@pytest.fixture(scope="session")
def tiny_study(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished folder of `tiny_study.toml`, run once for all workers of the tests, which change and lock copies."""
    from animat.studies.run import run_study
    from animat.studies.toml import read_study

    own, file = tmp_path_factory.getbasetemp(), Path(__file__).parent / "tiny_study.toml"
    common = own.parent if hasattr(request.config, "workerinput") else own
    folder, beside = common / "tiny_study", common / "tiny_study.partial"
    with (common / "tiny_study.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            # In this process, where its programs are compiled once.
            with ThreadPoolExecutor(1) as executor:
                run_study(read_study(file), beside, base=file.parent, executor=executor)
            beside.rename(folder)
    return folder


@pytest.fixture
def in_the_foreground() -> Iterator[None]:
    """Signals as a program in the foreground of a terminal has them, also where the tests were started by `nohup`."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in zip((signal.SIGINT, signal.SIGHUP), before, strict=True):
        signal.signal(number, handler)


class InThisProcess(ThreadPoolExecutor):
    """In place of processes, each on a core: one thread, in which what was imported and traced before is at hand."""

    def __init__(self, cores: Sequence[int]) -> None:
        super().__init__(1)


@pytest.fixture(scope="module")
def in_this_process() -> Iterator[None]:
    """Jobs are done here, for tests of what comes out of them; processes have tests of their own (`test_pinned`)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("animat.execution.jobs.PinnedProcesses", InThisProcess)
        yield


@pytest.fixture(autouse=True)
def quick_coupling(monkeypatch: pytest.MonkeyPatch) -> None:
    """A best coupling from a short search, except in processes that tests start; `test_coupling` tests the search."""
    monkeypatch.setattr("animat.evaluation.coupling.GENERATIONS", 2)
    monkeypatch.setattr("animat.evaluation.coupling.FRESH_EPISODES", 16)


@pytest.fixture
def few_bootstraps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Predictions with intervals from few simulators, for tests of what else a closed loop says and does."""
    monkeypatch.setattr("animat.reality_gap.calibration.BOOTSTRAPS", 4)


@pytest.fixture
def browser() -> Iterator[Any]:
    """Chromium without a window, driven by selenium; skips where one of them is absent."""
    needed = "needs chromium, chromedriver and selenium"
    webdriver = pytest.importorskip("selenium.webdriver", reason=needed)
    chromium, chromedriver = (shutil.which(name) for name in ("chromium", "chromedriver"))
    if not (chromium and chromedriver):
        pytest.skip(needed)
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ("--headless=new", "--no-sandbox", "--window-size=1400,1000", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(chromedriver))
    try:
        yield driver
    finally:
        driver.quit()
