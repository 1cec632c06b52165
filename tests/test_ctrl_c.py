"""Ctrl-C and a kill in a callback of the garbage collector, where Python drops what is raised, and in an import."""

from __future__ import annotations

import gc
import importlib
import signal
import subprocess
import sys
import time
import weakref
from pathlib import Path
from typing import Any

import pytest

from animat.cli import main as animat
from animat.ctrl_c import interruptible

pytestmark = pytest.mark.usefixtures("in_the_foreground")

ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def interrupt_while_collecting(number: signal.Signals = signal.SIGINT) -> None:
    """One Ctrl-C, or another signal, that comes in a callback of the garbage collector."""
    sent = []

    def callback(phase: str, info: dict[str, Any]) -> None:
        if not sent:
            sent.append(phase)
            signal.raise_signal(number)

    gc.callbacks.append(callback)
    try:
        gc.collect()
    finally:
        gc.callbacks.remove(callback)
    assert sent


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_it_is_dropped_by_python_and_heard_here() -> None:
    interrupt_while_collecting()
    with pytest.raises(KeyboardInterrupt), interruptible():
        interrupt_while_collecting()
        time.sleep(5.0)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", ASKING)
def test_so_is_a_kill_and_where_a_weak_reference_is_notified_of_an_end(number: signal.Signals) -> None:
    class Body:
        pass

    hook = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt), interruptible():
        interrupt_while_collecting(number)
        time.sleep(5.0)
    body = Body()
    reference = weakref.ref(body, lambda _: signal.raise_signal(number))
    with pytest.raises(KeyboardInterrupt), interruptible():
        del body
        time.sleep(5.0)
    assert reference() is None
    assert sys.unraisablehook is hook


@pytest.mark.parametrize("number", ASKING)
def test_an_import_is_not_cut_short(number: signal.Signals, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    name = f"interrupted_by_{number.name}"
    (tmp_path / f"{name}.py").write_text(f"import signal\nsignal.raise_signal({number})\nwhole = True\n")
    with pytest.raises(KeyboardInterrupt), interruptible():
        importlib.import_module(name)
        time.sleep(5.0)
    assert sys.modules.pop(name).whole


@pytest.mark.oracle
def test_two_in_one_import_raise_once(tmp_path: Path, monkeypatch) -> None:
    """So that the second does not cut short what the first one's end closes."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "impatient.py").write_text(
        "import signal, time\nfor _ in range(2):\n    signal.raise_signal(signal.SIGTERM)\n    time.sleep(0.1)\n"
    )
    closed = False
    with pytest.raises(KeyboardInterrupt), interruptible():
        try:
            importlib.import_module("impatient")
            time.sleep(5.0)
        finally:
            time.sleep(0.4)
            closed = True
    assert closed


def test_an_import_that_does_not_end_is(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("animat.ctrl_c._LONGEST_IMPORT_S", 0.2)
    (tmp_path / "without_end.py").write_text(
        "import signal, time\nsignal.raise_signal(signal.SIGINT)\nwhile True:\n    time.sleep(5.0)\n"
    )
    with pytest.raises(KeyboardInterrupt), interruptible():
        importlib.import_module("without_end")


@pytest.mark.oracle
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("module", ["tyro", "jax._src.interpreters.mlir"])
def test_a_command_that_still_imports_ends_in_a_line(module: str, number: signal.Signals, tmp_path: Path) -> None:
    """The signal comes as this module is looked for: by the command line, and in the middle of JAX."""
    code = f"""
import signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == {module!r}:
            signal.raise_signal({number})
sys.meta_path.insert(0, Finder())
from animat.__main__ import main
sys.exit(main())
"""
    command = ["train", "cartpole", "--mapping", "none", "--policies", "1", "--iterations", "6000", "--out", "policies"]
    ran = subprocess.run([sys.executable, "-c", code, *command], cwd=tmp_path, capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (130, "animat: interrupted\n")
    assert not list(tmp_path.iterdir())


def test_elsewhere_it_is_raised_at_once() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(signal.SIGINT)


def test_whoever_handles_it_already_goes_on_to() -> None:
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(True))
    try:
        with interruptible():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard


def test_where_it_is_ignored_it_stays_so() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interruptible():
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_a_polite_kill_of_any_command_is_an_interrupt(tmp_path, monkeypatch, capsys) -> None:
    def killed(*_: Any, **__: Any) -> None:
        signal.raise_signal(signal.SIGTERM)
        time.sleep(5.0)

    monkeypatch.setattr("animat.cultures.series.record_series", killed)
    before = signal.getsignal(signal.SIGTERM)
    assert animat(["record", "--out", str(tmp_path / "recordings")]) == 130
    assert capsys.readouterr().err.endswith("animat: interrupted\n")
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "recording_0_min.nwb").touch()
    assert animat(["record", "--out", str(tmp_path / "recordings")]) == 130
    assert capsys.readouterr().err.endswith("animat: interrupted; finished work is kept; run it again to resume\n")
    (tmp_path / "recordings" / "recording_0_min.nwb").rename(tmp_path / "recordings" / "recording_0000_min.nwb")
    assert animat(["record", "--culture", "maxone", "--selection", "s", "--out", str(tmp_path / "recordings")]) == 130
    assert "clock of a MaxOne starts with each program: begin another series in an" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before


def test_ctrl_c_while_the_command_line_is_read_is_one_line(monkeypatch, capsys) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("animat.cli._parse", interrupted)
    assert animat(["robots"]) == 130
    assert capsys.readouterr().err == "animat: interrupted\n"


def test_an_interrupted_session_is_reported_as_not_resumable(tmp_path, monkeypatch, capsys) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("animat.cli.run.Run.run", interrupted)
    command = ["run", "policies", "--out", str(tmp_path)]
    assert animat(command) == 130
    assert capsys.readouterr().err == "animat: interrupted\n"
    (tmp_path / "session.log").touch()
    assert animat(command) == 130
    message = capsys.readouterr().err
    assert message.endswith("kept; a session cannot be resumed: start a new one in another folder\n")
    assert f"its recording is not written yet: animat recover {tmp_path};" in message
    (tmp_path / "session.nwb").touch()
    assert animat(command) == 130
    assert "recover" not in capsys.readouterr().err
    monkeypatch.setattr("animat.cli.live.Live.run", interrupted)
    assert animat(["live", "cartpole", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err.endswith("kept; a live run cannot be resumed: start a new one in another folder\n")
    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "session.log").touch()
    assert animat(["live", "cartpole", "--out", str(tmp_path)]) == 130
    assert f"not written yet: animat recover {tmp_path / 'session'}; finished" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("status", "printed"),
    [(0, "all\nat exit\n"), pytest.param(1, "all\nat exit\n", marks=pytest.mark.oracle), (130, "all\n")],
)
def test_an_interrupted_command_leaves_without_python_s_own_end(status: int, printed: str) -> None:
    code = f"""
import atexit, sys
import animat.cli
from animat.__main__ import main

def run():
    print("all", flush=True)
    return {status}

animat.cli.main = run
atexit.register(print, "at exit")
sys.exit(main())
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ran.returncode, ran.stdout, ran.stderr) == (status, printed, "")
