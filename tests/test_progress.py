"""The progress bar: drawn on a terminal, and never in the way of what is printed."""

from __future__ import annotations

import os
import pty
import subprocess
import sys

import pytest

from animat.progress import Bar, Part

SCRIPT = """
from animat.progress import Bar
with Bar("counting") as progress:
    for i in range(5):
        progress.update(i, 5, f"at {i}")
    print("the result")
"""


def test_what_is_printed_under_a_bar_goes_where_it_should() -> None:
    terminal, line = pty.openpty()
    ran = subprocess.run([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, stderr=line, text=True)
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
    assert ran.stdout == "the result\n"
    assert b"counting" in drawn
    assert b"the result" not in drawn


def test_a_line_comes_every_ten_seconds_where_there_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 0.0
    monkeypatch.setattr("animat.progress.time.monotonic", lambda: now_s)
    with Bar("counting") as progress:
        # Two in a hundred a second; a second part begins at 40 s, four times as slow.
        for now_s in (1.0, 9.9, 10.0, 15.0, 21.0, 40.0):
            progress.update(2 * now_s, 100, f"at {now_s:g} s")
        for now_s in (41.0, 55.0, 65.0):
            progress.update((now_s - 41) / 2, 100)
    told = [
        "counting: 20 %, 40 s left, at 10 s",
        "counting: 42 %, 29 s left, at 21 s",
        "counting: 80 %, 10 s left, at 40 s",
        "counting: 7 %, 3 min left",
        "counting: 12 %, 3 min left",
    ]
    assert capsys.readouterr() == ("", "\n".join(told) + "\n")


def test_parts_make_up_the_whole() -> None:
    told: list[tuple[float, float, str]] = []

    class Kept:
        def update(self, done: float, total: float, note: str = "") -> None:
            told.append((done, total, note))

    whole = Kept()
    for before, units, note in ((0, 2, "first"), (2, 6, "")):
        part = Part(whole, before, units, 8, note)
        # Parts of parts, each in two steps.
        for half in (0, 1):
            within = Part(part, half, 1, 2)
            within.update(1, 2)
            within.update(2, 2, "done")
    assert told == [
        (0.5, 8, "first"), (1.0, 8, "done"), (1.5, 8, "first"), (2.0, 8, "done"),
        (3.5, 8, ""), (5.0, 8, "done"), (6.5, 8, ""), (8.0, 8, "done"),
    ]  # fmt: skip
