"""The progress bar: drawn on a terminal, and never in the way of what is printed."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time

import pytest

from animat.progress import Bar, EqualPhases, Part, Speed, WorkPhase, in_phase

SCRIPT = """
from animat.progress import Bar
with Bar("counting") as progress:
    for i in range(5):
        progress.update(i, 5, f"at {i}")
    print("the result")
"""


PHASES = """
import time
from animat.progress import Bar, in_phase
with Bar("silent") as progress:
    progress = in_phase(progress, "predicting")
    progress.update(1, 4, "p0")
    loop = in_phase(progress, "closed loop", 30, "episodes")
    for i in range(3):
        loop.update(i, 30, f"p{i}: return 101.2 so far; means: p0 99.1, [p1] 98.2, random 20.3, constant 5 Hz 11.1")
        time.sleep(0.3)
"""


def drawn_by(script: str, columns: int = 80) -> tuple[str, str]:
    """What a script prints, and what it draws on a terminal."""
    terminal, line = pty.openpty()
    fcntl.ioctl(line, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    env = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    ran = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=line, text=True, env={**env, "TERM": "xterm"}
    )
    os.close(line)
    drawn = b""
    while True:
        try:
            piece = os.read(terminal, 65536)
        except OSError:
            break
        if not piece:
            break
        drawn += piece
    os.close(terminal)
    return ran.stdout, re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", drawn.decode())


def test_what_is_printed_under_a_bar_goes_where_it_should() -> None:
    printed, drawn = drawn_by(SCRIPT)
    assert printed == "the result\n"
    assert "counting" in drawn
    # Although the last report is of four fifths.
    assert "100 %" in drawn
    assert "the result" not in drawn


@pytest.mark.oracle
@pytest.mark.parametrize("columns", [80, 40])
def test_each_phase_has_a_bar_that_fits_the_terminal(columns: int) -> None:
    _, drawn = drawn_by(PHASES, columns)
    lines = [line.rstrip() for line in re.split(r"[\r\n]+", drawn)]
    assert max(map(len, lines)) <= columns
    assert "silent" not in drawn
    if columns == 80:
        assert any(re.match(r"predicting  ━+ 100 % 0:00:00", line) for line in lines)
        assert any(re.match(r"closed loop [━╸╺]+   3 % 0:00:0", line) for line in lines)
        assert any(line.startswith("1 of 30 episodes, ") for line in lines)
        assert any("p1: return 101.2 so far; means: p0 99.1, [p1]" in line for line in lines)


def test_a_line_comes_every_ten_seconds_where_there_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 0.0
    monkeypatch.setattr("animat.progress.time.monotonic", lambda: now_s)
    with Bar("counting") as progress:
        # Two in a hundred a second; a second phase begins at 40 s, a quarter as fast.
        for now_s in (1.0, 2.0, 10.0, 15.0, 21.0, 40.0):
            progress.update(2 * now_s, 100, f"at {now_s:g} s")
        in_phase(progress, "again", 400, "apples")
        for now_s in (41.0, 43.0, 55.0, 65.0):
            progress.update((now_s - 41) / 2, 100)
    lines = [
        "counting: 20 %, 40 s left, at 10 s",
        "counting: 42 %, 29 s left, at 21 s",
        "counting: 80 %, 10 s left, at 40 s",
        "again: 7 %, 28 of 400 apples, 2.0 a second, 3 min left",
        "again: 12 %, 48 of 400 apples, 2.0 a second, 3 min left",
    ]
    assert capsys.readouterr() == ("", "\n".join(lines) + "\n")


def test_a_line_that_says_nothing_new_comes_every_minute(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s, lines = 0.0, []
    monkeypatch.setattr("animat.progress.time.monotonic", lambda: now_s)
    with Bar("recording") as progress:
        for now_s in map(float, range(161)):
            # One step at 5 s and another at 115 s. In between the note changes once, and otherwise only the time left.
            progress.update((now_s >= 5) + (now_s >= 115), 4, "first" if now_s < 95 else "second")
            if line := capsys.readouterr().err:
                lines.append((now_s, line))
    assert lines == [
        (10.0, "recording: 25 %, first\n"),
        (70.0, "recording: 25 %, first\n"),
        (95.0, "recording: 25 %, second\n"),
        (115.0, "recording: 50 %, 2 min left, second\n"),
    ]


def test_work_that_reports_nothing_for_long_gets_lines_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("animat.progress.LINE_EVERY_S", 0.02)
    monkeypatch.setattr("animat.progress.SAME_EVERY_S", 0.02)
    monkeypatch.setattr("animat.progress._CHECK_EVERY_S", 0.01)
    lines = ""
    with Bar("silent") as progress:
        in_phase(progress, "solving").update(0, 1, "optimal return")
        until_s = time.monotonic() + 5
        while lines.count("\n") < 2 and time.monotonic() < until_s:
            time.sleep(0.01)
            lines += capsys.readouterr().err
    assert lines.startswith("solving: 0 %, optimal return\n" * 2)


def test_nothing_is_said_about_the_rest_before_there_is_something_to_tell_by(monkeypatch: pytest.MonkeyPatch) -> None:
    """A share of a rounding's size made an estimate of 1,647,536,472,192,901 minutes."""
    at_s = 0.0
    monkeypatch.setattr("animat.progress.time.monotonic", lambda: at_s)
    phase = WorkPhase("study")
    left = []
    for at, share in ((0.0, 0.0), (5.0, 1e-16), (10.0, 2e-16), (20.0, 0.004), (30.0, 0.02), (60.0, 0.04)):
        at_s = at
        phase.update(share, 1)
        left.append(phase.left())
    assert left == ["", "", "", "", "10 min left", "24 min left"]
    # Ends are ends, whatever sums of parts come to.
    for at, share in ((70.0, -1e-16), (80.0, 1 + 1e-12)):
        at_s = at
        phase.update(share, 1)
        left.append(phase.left())
    assert (phase.share, left[-1]) == (1.0, "")


def test_compiling_and_going_on_from_a_checkpoint_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr("animat.progress.time.monotonic", lambda: now_s)
    phase = WorkPhase("training", 1000, "iterations")
    # 20 s of compiling, half of it from the checkpoint, then one in a hundred every two seconds.
    for second in range(81):
        now_s = float(second)
        phase.update(0.0 if now_s < 20 else 0.5 + (now_s - 20) / 200, 1)
    assert phase.left() == "40 s left"
    assert phase.counted() == ["800 of 1,000 iterations", "5.0 a second"]
    # What a sum of parts loses by rounding is no new work; anything more is.
    phase.update(0.8 - 1e-15, 1)
    assert phase.left() == "40 s left"
    phase.update(0.799, 1)
    assert phase.left() == ""


def test_the_speed_of_the_last_minute_is_that_of_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    speed, now_s = Speed(60.0), 0.0
    monkeypatch.setattr("animat.progress.time.monotonic", lambda: now_s)
    assert speed.left_s(10) is None
    for second in range(201):
        now_s = float(second)
        speed.see(min(second, 100) * 1.0 + 3.0 * max(0, second - 100))
    assert speed.per_s == pytest.approx(3.0)
    assert speed.left_s(30.0) == pytest.approx(10.0)


def test_parts_make_up_the_whole() -> None:
    reports: list[tuple[float, float, str]] = []

    class Kept:
        def update(self, done: float, total: float, note: str = "") -> None:
            reports.append((done, total, note))

    whole = Kept()
    for before, units, note in ((0, 2, "first"), (2, 6, "")):
        part = Part(whole, before, units, 8, note)
        # Parts of parts, each in two steps.
        for half in (0, 1):
            within = Part(part, half, 1, 2)
            within.update(1, 2)
            within.update(2, 2, "done")
    assert reports == [
        (0.5, 8, "first"), (1.0, 8, "done"), (1.5, 8, "first"), (2.0, 8, "done"),
        (3.5, 8, ""), (5.0, 8, "done"), (6.5, 8, ""), (8.0, 8, "done"),
    ]  # fmt: skip


def test_phases_of_a_part_never_go_back() -> None:
    seen: list[float] = []

    class Seen:
        def update(self, done: float, total: float, note: str = "") -> None:
            seen.append(done / total)

    whole = EqualPhases(Seen(), 4)
    for done in (0, 5, 10):
        whole.update(done, 10)
    # A phase that reports nothing adds nothing.
    for title in ("silent", "second", "third", "one more than planned"):
        phase = in_phase(whole, title)
        for done in () if title == "silent" else (0, 1):
            phase.update(done, 1)
    assert seen == [0, 0.125, 0.25, 0.25, 0.5, 0.5, 0.75, 0.75, 1]
