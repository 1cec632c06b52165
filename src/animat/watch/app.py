"""What the page asks for: its own files, what there is to watch, and each view of it."""

from __future__ import annotations

import functools
import importlib.resources
import json
import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from animat.closed_loop.session_data import LOG_FILE, RECORDING_FILE, STOP_FILE
from animat.errors import AnimatError, InvalidArgument, InvalidFile, first_line
from animat.watch.cultures import CulturesView
from animat.watch.found import Kind, find, place_within
from animat.watch.picture import picture_of
from animat.watch.plain import text
from animat.watch.recording import RecordingView
from animat.watch.session import SessionView
from animat.watch.study import StudyView
from animat.watch.training import TrainingView
from animat.watch.tuning import TuningView
from animat.watch.view import View

if TYPE_CHECKING:
    from starlette.applications import Starlette

_FILES = {
    "": ("index.html", "text/html"),
    "style.css": ("style.css", "text/css"),
    "icon.svg": ("icon.svg", "image/svg+xml"),
    **{name: (name, "text/javascript") for name in ("page.js", "draw.js", "session.js", "blocks.js")},
}
"""Of the page, by their addresses."""
_MOST_VIEWS = 8
"""That are kept open."""


_VIEWS: dict[Kind, Callable[[Path], View]] = {
    "session": SessionView,
    "training": TrainingView,
    "study": StudyView,
    "cultures": CulturesView,
    "tuning": TuningView,
    "recording": RecordingView,
}


class Watched:
    """A folder, which may come to be later, and the views of what is in it; asked by one thread at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._views: OrderedDict[tuple[str, str], View] = OrderedDict()
        self._lock = threading.Lock()

    def things(self) -> dict[str, Any]:
        """What there is."""
        found = [
            {"kind": each.kind, "place": each.place}
            for each in find(self.folder)
            # A name that is no text cannot be asked for.
            if text(each.place, 4096) == each.place
        ]
        return {"folder": text(self.folder.resolve().name or str(self.folder)), "things": found}

    def about(self, kind: str, place: str) -> dict[str, Any]:
        """What something is."""
        with self._lock:
            return self._view(kind, place).about()

    def view(self, kind: str, place: str, to_s: float | None, span_s: float) -> dict[str, Any]:
        """How it is."""
        with self._lock:
            return self._view(kind, place).view(to_s, span_s)

    def picture(self, place: str, at: int) -> bytes | None:
        """The robot of a session at a record, as PNG."""
        with self._lock:
            view = self._session(place)
            tick, robot = view.tick_at(at), view.robot_data
        return None if tick is None else picture_of(robot, *tick)

    def stop(self, place: str) -> None:
        """End a session; nothing else is waited for."""
        stop_session(place_within(self.folder, place))

    def _session(self, place: str) -> SessionView:
        view = self._view("session", place)
        assert isinstance(view, SessionView)
        return view

    def _view(self, kind: str, place: str) -> View:
        key = kind, place
        if key not in self._views:
            if kind not in _VIEWS:
                raise InvalidArgument(f"kind: expected one of {', '.join(_VIEWS)}, got {text(kind, 40)}")
            self._views[key] = _VIEWS[kind](place_within(self.folder, place))
            if len(self._views) > _MOST_VIEWS:
                self._views.popitem(last=False)[1].close()
        self._views.move_to_end(key)
        return self._views[key]


def app_for(folder: Path, token: str, port: int) -> Starlette:
    """The page of a folder as an ASGI application, guarded."""
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.middleware import Middleware
    from starlette.middleware.base import BaseHTTPMiddleware
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
    from starlette.websockets import WebSocket

    from animat.watch.guard import guard

    watched = Watched(folder)
    own = importlib.resources.files("animat.watch") / "page"

    async def file(content: bytes, kind: str, request: Request) -> Response:
        return Response(content, media_type=kind)

    def answering(answer: Callable[[Any], Any]) -> Callable[[Request], Any]:
        @functools.wraps(answer)
        async def endpoint(request: Request) -> Response:
            status, kind, body = await run_in_threadpool(_answered, answer, request.query_params)
            return Response(body, status, media_type=kind)

        return endpoint

    def picture(asked: Any) -> bytes:
        found = watched.picture(asked.get("in", ""), int(_number(asked, "at") or 0))
        if found is None:
            raise InvalidArgument("at: no picture of the robot there")
        return found

    def stop(asked: Any) -> dict[str, Any]:
        watched.stop(asked.get("in", ""))
        return {"stopped": True}

    async def refuse(socket: WebSocket) -> None:
        await socket.send({"type": "websocket.close", "code": 1008})

    routes: list[BaseRoute] = [
        Route(f"/{address}", functools.partial(file, (own / name).read_bytes(), kind))
        for address, (name, kind) in _FILES.items()
    ]
    routes += [
        Route("/things", answering(lambda asked: watched.things())),
        Route("/about", answering(lambda asked: watched.about(asked.get("kind", ""), asked.get("in", "")))),
        Route(
            "/view",
            answering(
                lambda asked: watched.view(
                    asked.get("kind", ""), asked.get("in", ""), _number(asked, "to"), _number(asked, "span") or 8.0
                )
            ),
        ),
        Route("/robot.png", answering(picture)),
        Route("/stop", answering(stop), methods=["POST"]),
        WebSocketRoute("/{path:path}", refuse),
    ]
    guarded = Middleware(BaseHTTPMiddleware, dispatch=guard(token, port))
    return Starlette(routes=[Mount(f"/{token}", routes=routes)], middleware=[guarded])


def _answered(answer: Callable[[Any], Any], asked: Any) -> tuple[int, str, bytes]:
    """Status, kind and content of an answer."""
    try:
        found = answer(asked)
        if isinstance(found, bytes):
            return 200, "image/png", found
        return 200, "application/json", json.dumps(found, allow_nan=False).encode()
    except AnimatError as error:
        return 409, "application/json", _told(str(error))
    except Exception as error:
        # Anything may be in a file.
        return 500, "application/json", _told(f"cannot be shown: {first_line(error)}")


def _told(message: str) -> bytes:
    return json.dumps({"error": text(" ".join(message.split()), 1000)}).encode()


def _number(asked: Any, name: str) -> float | None:
    given = asked.get(name)
    if given is None:
        return None
    try:
        value = float(given)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e15:
        raise InvalidArgument(f"{name}: expected a number, got {text(given, 40)}")
    return value


def stop_session(folder: Path) -> None:
    """Ask a session to end. Nothing is waited for or read first: it may be urgent.

    Raises:
        InvalidArgument: where no session is, or one that has ended.
        InvalidFile: if the file cannot be made.
    """
    if not (folder / LOG_FILE).is_file():
        raise InvalidArgument(f"{folder.name}: expected a session to stop, got none")
    if (folder / RECORDING_FILE).exists():
        raise InvalidArgument(f"{folder.name}: the session has ended: there is nothing to stop")
    try:
        # Not through a link, which may lead anywhere.
        os.close(os.open(folder / STOP_FILE, os.O_CREAT | os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666))
    except OSError as error:
        raise InvalidFile(f"{folder / STOP_FILE}: cannot be made: {error.strerror or error}") from error
