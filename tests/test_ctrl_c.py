"""Ctrl-C in a callback of the garbage collector, where Python prints what is raised and goes on."""

from __future__ import annotations

import gc
import signal
import time
from typing import Any

import pytest

from animat.cli import main as animat
from animat.ctrl_c import heard_everywhere

pytestmark = pytest.mark.usefixtures("in_the_foreground")


def interrupt_while_collecting() -> None:
    """One Ctrl-C that comes in a callback of the garbage collector."""
    sent = []

    def callback(phase: str, info: dict[str, Any]) -> None:
        if not sent:
            sent.append(phase)
            signal.raise_signal(signal.SIGINT)

    gc.callbacks.append(callback)
    try:
        gc.collect()
    finally:
        gc.callbacks.remove(callback)
    assert sent


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_it_is_dropped_by_python_and_heard_here() -> None:
    interrupt_while_collecting()
    with pytest.raises(KeyboardInterrupt), heard_everywhere():
        interrupt_while_collecting()
        time.sleep(5.0)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_elsewhere_it_is_raised_at_once() -> None:
    with pytest.raises(KeyboardInterrupt), heard_everywhere():
        signal.raise_signal(signal.SIGINT)


def test_whoever_handles_it_already_goes_on_to() -> None:
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(True))
    try:
        with heard_everywhere():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard


def test_where_it_is_ignored_it_stays_so() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with heard_everywhere():
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_a_polite_kill_of_any_command_is_an_interrupt(tmp_path, monkeypatch, capsys) -> None:
    def killed(*_: Any, **__: Any) -> None:
        signal.raise_signal(signal.SIGTERM)
        time.sleep(5.0)

    monkeypatch.setattr("animat.cultures.series.record_series", killed)
    before = signal.getsignal(signal.SIGTERM)
    assert animat(["record", "--out", str(tmp_path / "recordings")]) == 130
    assert capsys.readouterr().err.endswith("animat: interrupted; what was finished is kept; start again to go on\n")
    assert signal.getsignal(signal.SIGTERM) is before


def test_an_interrupted_session_is_told_to_be_no_start_for_another(tmp_path, monkeypatch, capsys) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("animat.cli.run.Run.run", interrupted)
    command = ["run", "policies", "--out", str(tmp_path)]
    assert animat(command) == 130
    assert capsys.readouterr().err == "animat: interrupted; what was finished is kept\n"
    (tmp_path / "session.log").touch()
    assert animat(command) == 130
    told = capsys.readouterr().err
    assert told.endswith("kept; a session cannot be resumed: start a new one in another folder\n")
    assert f"its recording is not written yet: animat recover {tmp_path};" in told
    (tmp_path / "session.nwb").touch()
    assert animat(command) == 130
    assert "recover" not in capsys.readouterr().err
