"""The page next to a running command: Stop ends a session, and a separate server shows it in a browser."""

from __future__ import annotations

import contextlib
import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError

import pytest

from animat.closed_loop.session import LOG_FILE, Session, read_session
from animat.closed_loop.tick import STOP_FILE
from animat.errors import AnimatError, InvalidArgument
from animat.watch.serving import watching
from watching import OWN, PORT, TOKEN, asked, session_in

pytest.importorskip("starlette", reason="the extra [watch] is not installed")
pytest.importorskip("uvicorn", reason="the extra [watch] is not installed")

from animat.watch.app import app_for
from animat.watch.session import SessionView


@contextlib.contextmanager
def running(folder: Path) -> Iterator[list[Session]]:
    """Run a session in real time in another thread; the list receives its result."""
    ended: list[Session] = []
    loop = threading.Thread(target=lambda: ended.append(session_in(folder, episodes=500, real_time=True)))
    loop.start()
    try:
        wait_for(lambda: (folder / LOG_FILE).exists() and (folder / LOG_FILE).stat().st_size > 2**14)
        yield ended
    finally:
        (folder / STOP_FILE).touch()
        loop.join()


def wait_for(what: Any) -> Any:
    """Wait until a condition is true; returns it."""
    for _ in range(600):
        if found := what():
            return found
        time.sleep(0.05)
    pytest.fail("it never came")


def test_stop_ends_a_session_before_the_next_pulse(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    app = app_for(tmp_path, TOKEN, PORT)
    with running(folder) as ended:
        seen = asked(app, "view", kind="session", **{"in": "session"}).json
        assert (seen["state"], seen["stop"]) == ("running", False)
        assert asked(app, "stop", method="POST", origin=OWN, **{"in": "session"}).status == 200
        wait_for(lambda: ended)
    session = read_session(folder)
    assert session.ending.by == "person"
    assert "the file STOP" in session.ending.message
    after = asked(app, "view", kind="session", span=60, **{"in": "session"}).json
    assert after["state"] == "ended"
    assert after["pulses"] == session.outline.pulses


def test_a_command_that_is_watched_serves_its_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session_in(tmp_path, episodes=1)
    with watching(tmp_path):
        address = re.search(r"http://127\.0\.0\.1:\d+/[\w-]+/", capsys.readouterr().err)
        assert address is not None
        with http(address[0] + "things") as answer:
            assert b'"session"' in answer.read()
        with pytest.raises(HTTPError, match="403") as refused:
            http(re.sub(r"/[\w-]+/$", "/wrong/", address[0]))
        refused.value.close()
    end_servers()


@pytest.mark.oracle
def test_a_command_that_is_refused_leaves_no_server(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument), watching(tmp_path / "none"):
        raise InvalidArgument("--seed: expected another")
    assert not servers()


def test_a_server_that_does_not_start_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    with pytest.raises(AnimatError, match="the page's server did not start"), watching(tmp_path):
        pass


def http(address: str) -> Any:
    from urllib.request import urlopen

    return urlopen(address, timeout=30)


def servers() -> list[int]:
    """Process ids of the page's servers that this process started."""
    found = []
    for each in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            words = each.read_bytes().split(b"\0")
            if b"animat.watch" in words and str(os.getpid()).encode() in words:
                found.append(int(each.parent.name))
    return found


def end_servers() -> None:
    for number in servers():
        os.kill(number, signal.SIGTERM)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(number, 0)


@pytest.mark.oracle
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_session_is_watched_and_stopped_in_a_browser(tmp_path: Path, browser: Any) -> None:
    folder = tmp_path / "<img src=x onerror=alert(1)>"

    def said(css: str) -> str:
        return str(browser.execute_script("return document.querySelector(arguments[0])?.textContent ?? ''", css))

    with running(folder) as ended, served(tmp_path) as address:
        browser.get(address)
        wait_for(lambda: said("#state").startswith("● running"))
        first = wait_for(lambda: said("#now dd"))
        wait_for(lambda: said("#now dd") != first)
        wait_for(lambda: browser.execute_script("return document.querySelector('canvas.robot')?.hidden === false"))
        browser.find_element("id", "pause").click()
        wait_for(lambda: said("#pause") == "Follow")
        browser.find_element("id", "stop").click()
        assert_no_more_pulses(folder, ended)
        wait_for(lambda: said("#state").startswith("■ ended: stopped by a person"))
        browser.find_element("id", "pause").click()
        with (folder / "ticks.csv").open(newline="") as file:
            *_, row = csv.DictReader(file)
        wait_for(lambda: said("#now dd").replace(",", "") == row["tick"])
        values = browser.execute_script(
            "return [...document.querySelectorAll('#now dd')].map((each) => each.textContent)"
        )
        numbers = [
            float(each.replace("\u2212", "-").replace(",", "")) for each in (values[1][:-2], values[5].split(" ")[0])
        ]
        assert numbers == pytest.approx([float(row["time_s"]), float(row["rate_hz"])], rel=1e-5)
        assert not [line for line in browser.get_log("browser") if "favicon" not in line["message"]]
        assert not browser.execute_script("return document.querySelectorAll('option img, header img').length")


@pytest.mark.oracle
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_with_the_server_killed_the_page_says_how_to_stop_a_session(tmp_path: Path, browser: Any) -> None:
    folder = tmp_path / "session"
    command = [sys.executable, "-m", "animat", "watch", str(tmp_path)]
    with running(folder) as ended, subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        browser.get(server.stdout.readline().split()[0])
        wait_for(lambda: browser.find_element("id", "state").text.startswith("● running"))
        server.kill()
        trouble = browser.find_element("id", "trouble")
        wait_for(lambda: "a session is stopped by a file STOP in its folder" in trouble.text)
        browser.quit()
        assert not ended
        (folder / STOP_FILE).touch()
        assert_no_more_pulses(folder, ended)


def assert_no_more_pulses(folder: Path, ended: list[Session]) -> None:
    """Assert that only ticks under way follow once STOP is in the session's folder."""
    wait_for(lambda: ended or (folder / STOP_FILE).exists())
    before = SessionView(folder).view(None, 60.0)["n_ticks"]
    wait_for(lambda: ended)
    assert ended[0].ending.by == "person"
    # The tick that was under way, and the one that was being written.
    assert ended[0].outline.ticks <= before + 2


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "animat", "watch", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            yield server.stdout.readline().split()[0]
        finally:
            server.send_signal(signal.SIGINT)
            server.communicate()
    assert server.returncode == 0
