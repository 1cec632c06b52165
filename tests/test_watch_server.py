"""The page's server answers only this machine, at the address with the token, and serves nothing outside the folder."""

from __future__ import annotations

import asyncio
import re
import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from animat.cli import COMMANDS, main
from animat.closed_loop.log import LogWriter, read_log
from animat.closed_loop.session import LOG_FILE
from animat.closed_loop.tick import STOP_FILE
from animat.live.plan import LOG_FILE as LIVE
from animat.studies.cultures import MANIFEST as CULTURES
from animat.studies.folder import MANIFEST as STUDY
from animat.training.folder import MANIFEST as TRAINING
from animat.tuning.run import MANIFEST as TUNING
from animat.watch.discovery import _MARKS, find
from watching import OWN, PORT, TOKEN, asked, session_in

pytest.importorskip("starlette", reason="the extra [watch] is not installed")

from animat.watch.app import app_for


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("served")
    session_in(path / "in" / "session")
    session_in(path / "outside")
    return path


@pytest.fixture
def app(folder: Path) -> Any:
    return app_for(folder / "in", TOKEN, PORT)


def test_the_page_and_its_files_are_served(app: Any) -> None:
    page = asked(app, "")
    assert page.status == 200
    assert page.headers["content-type"].startswith("text/html")
    text = page.body.decode()
    for name in re.findall(r'(?:src|href)="([^"]+)"', text):
        assert asked(app, name).status == 200
    assert "<script>" not in text
    assert not re.search(r"\bon\w+=|style=", text)
    for name in ("page.js", "draw.js", "session.js", "style.css"):
        words = asked(app, name).body.decode()
        # Nothing is asked for elsewhere, and no text becomes markup.
        assert not re.search(
            r"https?://(?!www\.w3\.org)|innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(", words
        )


def test_every_answer_has_the_strict_policy(app: Any) -> None:
    for answer in (asked(app, ""), asked(app, "things"), asked(app, "nowhere"), asked(app, "", token="wrong")):
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in answer.headers


def test_a_session_is_shown(app: Any) -> None:
    (thing,) = asked(app, "things").json["things"]
    assert (thing["kind"], thing["place"]) == ("session", "session")
    about = asked(app, "about", kind="session", **{"in": "session"}).json
    assert about["title"].startswith("navigation on the ")
    view = asked(app, "view", kind="session", span=20, **{"in": "session"}).json
    assert view["n_ticks"] > 0
    picture = asked(app, "robot.png", at=view["picture"], **{"in": "session"})
    assert (picture.status, picture.headers["content-type"]) == (200, "image/png")
    assert picture.body.startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "wrong",
    [
        {"token": "wrong"},
        {"token": TOKEN[:-1]},
        {"token": TOKEN + "x"},
        {"token": ""},
        {"raw": "/"},
        {"raw": f"/{TOKEN}"},
        {"raw": f"//{TOKEN}/"},
        {"host": "rebound.example"},
        {"host": f"rebound.example:{PORT}"},
        {"host": "127.0.0.1"},
        {"host": f"127.0.0.1:{PORT + 1}"},
        {"host": f"127.0.0.1.example:{PORT}"},
        {"host": None},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": f"https://127.0.0.1:{PORT}"},
        {"origin": f"http://127.0.0.1:{PORT + 1}"},
        {"origin": f"http://127.0.0.1:{PORT}.evil.example"},
    ],
    ids=str,
)
def test_requests_from_elsewhere_are_refused(app: Any, folder: Path, wrong: dict[str, Any]) -> None:
    app.state.asked_s = 0.0
    for path, method in (("", "GET"), ("things", "GET"), ("stop?in=session", "POST")):
        answer = asked(app, path, method=method, **{"origin": OWN if method == "POST" else None, **wrong})
        assert answer.status == 403
        assert b"animat" not in answer.body
    # Nor do they keep the page's server up.
    assert app.state.asked_s == 0.0
    assert asked(app, "things").status == 200 and app.state.asked_s > 0.0
    assert not (folder / "in" / "session" / STOP_FILE).exists()


def test_a_websocket_is_refused(app: Any) -> None:
    sent = []

    async def receive() -> Any:
        return {"type": "websocket.connect"}

    async def send(message: Any) -> None:
        sent.append(message)

    headers = [(b"host", f"127.0.0.1:{PORT}".encode()), (b"origin", OWN.encode())]
    asyncio.run(app({"type": "websocket", "path": f"/{TOKEN}/", "headers": headers}, receive, send))
    assert sent == [{"type": "websocket.close", "code": 1008}]


@pytest.mark.parametrize("place", ["../outside", "..", "/etc", "session/../../outside", "a\0b", "linked"])
def test_a_path_outside_of_the_folder_is_refused(app: Any, folder: Path, place: str) -> None:
    linked = folder / "in" / "linked"
    if not linked.is_symlink():
        linked.symlink_to(folder / "outside")
    for path in ("about", "view"):
        answer = asked(app, path, kind="session", **{"in": place})
        assert answer.status == 409
        assert "expected a folder inside the watched one" in answer.json["error"]
    assert asked(app, "stop", method="POST", origin=OWN, **{"in": place}).status == 409
    assert not (folder / "outside" / STOP_FILE).exists()
    assert [each.place for each in find(folder / "in")] == ["session"]


@pytest.mark.parametrize("path", ["../app.py", "%2e%2e/app.py", "page/index.html", "session.log", "serving.py"])
def test_no_other_file_is_served(app: Any, path: str) -> None:
    assert asked(app, path).status == 404


def test_stop_is_posted_from_the_page_alone(folder: Path, tmp_path: Path) -> None:
    header = read_log(folder / "outside" / LOG_FILE).header
    LogWriter(tmp_path / LOG_FILE, header).close()
    app = app_for(tmp_path, TOKEN, PORT)
    assert asked(app, "stop").status == 404
    assert asked(app, "stop", method="POST").status == 403
    assert not (tmp_path / STOP_FILE).exists()
    assert asked(app, "stop", method="POST", origin=OWN, **{"in": ""}).json == {"stopped": True}
    assert (tmp_path / STOP_FILE).exists()


def test_nothing_but_stop_changes_anything(app: Any, folder: Path) -> None:
    def state() -> dict[str, Any]:
        return {str(f): (f.stat().st_mtime_ns, f.stat().st_size) for f in folder.rglob("*")}

    before = state()
    for path in ("", "things", "about", "view", "robot.png"):
        for method in ("GET", "HEAD", "POST", "PUT", "DELETE"):
            asked(app, path, method=method, origin=OWN, kind="session", **{"in": "session"})
    assert asked(app, "stop", method="POST", origin=OWN, **{"in": "session"}).status == 409
    assert state() == before


def test_wrong_requests_are_reported(app: Any) -> None:
    for query in ({"span": "x"}, {"span": "nan"}, {"span": "1e9"}, {"to": "1e99"}, {"kind": "other"}):
        answer = asked(app, "view", **{"kind": "session", "in": "session", **query})
        assert answer.status == 409
        assert "expected" in answer.json["error"]
    assert asked(app, "robot.png", at="-5", **{"in": "session"}).status == 409


def test_the_working_folder_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path / "mine")
    assert asked(app_for(Path(), TOKEN, PORT), "things").json["folder"] == "mine"


def test_an_empty_folder_says_so_and_is_looked_at_again(tmp_path: Path) -> None:
    app = app_for(tmp_path / "to come", TOKEN, PORT)
    assert asked(app, "things").json == {"folder": "to come", "things": []}
    session_in(tmp_path / "to come", episodes=1)
    assert [each["place"] for each in asked(app, "things").json["things"]] == [""]


def test_folders_are_identified_by_the_files_that_are_written() -> None:
    assert dict(_MARKS) == {
        "session": LOG_FILE,
        "training": TRAINING,
        "tuning": TUNING,
        "study": STUDY,
        "cultures": CULTURES,
        "live": LIVE,
    }


def test_each_command_that_takes_watch_has_its_folder_served(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {"record": [], "reproduce": [], "train": [], "live": [], "run": ["x"], "study": ["x"], "tune": ["x"]}
    assert {name for name, command in COMMANDS.items() if "watch" in command.__dataclass_fields__} == set(given)
    served: list[Path] = []
    monkeypatch.setattr("animat.watch.serving.watching", lambda folder: nullcontext(served.append(folder)))
    for name, words in given.items():
        monkeypatch.setattr(COMMANDS[name], "run", lambda self: {})
        for asked_for, expected in (([], []), (["--watch"], [tmp_path])):
            served.clear()
            assert main([name, *words, "--out", str(tmp_path), *asked_for]) == 0, capsys.readouterr().err
            assert served == expected


def test_the_command_says_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["watch", str(tmp_path / "none")]) == 1
    assert "expected a folder to watch, got none" in capsys.readouterr().err
    assert main(["watch", str(tmp_path), "--port", "70000"]) == 1
    assert "--port: expected a free port from 1 to 65,535" in capsys.readouterr().err
    monkeypatch.setattr("animat.watch.serving.find_spec", lambda name: None)
    assert main(["watch", str(tmp_path)]) == 1
    command = f"{shlex.quote(sys.executable)} -m pip install 'animat[watch]'"
    expected = f"expected starlette and uvicorn to be installed, got none: {command}\n"
    assert capsys.readouterr().err == f"animat: watch: {expected}"
    assert main(["record", "--out", str(tmp_path), "--watch"]) == 1
    assert capsys.readouterr().err == f"animat: --watch: {expected}"
