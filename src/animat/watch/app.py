"""The page's requests: its own files, the list of items to watch, and each view."""

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
from animat.watch.discovery import Kind, find, place_within
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
"""The page's files, by address."""
_MOST_VIEWS = 8
"""Most views kept open."""


_VIEWS: dict[Kind, Callable[[Path], View]] = {
    "session": SessionView,
    "training": TrainingView,
    "study": StudyView,
    "cultures": CulturesView,
    "tuning": TuningView,
    "recording": RecordingView,
}


class Watched:
    """A folder, which need not exist yet, and views of its contents; used by one thread at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._views: OrderedDict[tuple[str, str], View] = OrderedDict()
        self._lock = threading.Lock()

    def things(self) -> dict[str, Any]:
        """The items in the folder."""
        items = [
            {"kind": item.kind, "place": item.place}
            for item in find(self.folder)
            # A name that is not valid text cannot be requested.
            if text(item.place, 4096) == item.place
        ]
        return {"folder": text(self.folder.resolve().name or str(self.folder)), "things": items}

    def about(self, kind: str, place: str) -> dict[str, Any]:
        """The unchanging description of an item."""
        with self._lock:
            return self._view(kind, place).about()

    def view(self, kind: str, place: str, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The current view of an item."""
        with self._lock:
            return self._view(kind, place).view(to_s, span_s)

    def picture(self, place: str, at: int) -> bytes | None:
        """The robot of a session at a record, as PNG."""
        with self._lock:
            view = self._view("session", place)
            assert isinstance(view, SessionView)
            tick, robot = view.tick_at(at), view.robot_data
        return None if tick is None else picture_of(robot, *tick)

    def stop(self, place: str) -> None:
        """End a session, without waiting for the lock."""
        stop_session(place_within(self.folder, place))

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
    """The page of a folder as a guarded ASGI application."""
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
    files = importlib.resources.files("animat.watch") / "page"

    async def file(content: bytes, kind: str, request: Request) -> Response:
        return Response(content, media_type=kind)

    def answering(answer: Callable[[Any], Any]) -> Callable[[Request], Any]:
        @functools.wraps(answer)
        async def endpoint(request: Request) -> Response:
            status, kind, body = await run_in_threadpool(_response, answer, request.query_params)
            return Response(body, status, media_type=kind)

        return endpoint

    def view(query: Any) -> dict[str, Any]:
        to_s, span_s = _number(query, "to"), _number(query, "span") or 8.0
        return watched.view(query.get("kind", ""), query.get("in", ""), to_s, span_s)

    def picture(query: Any) -> bytes:
        png = watched.picture(query.get("in", ""), int(_number(query, "at") or 0))
        if png is None:
            raise InvalidArgument("at: no picture of the robot there")
        return png

    def stop(query: Any) -> dict[str, Any]:
        watched.stop(query.get("in", ""))
        return {"stopped": True}

    async def refuse(socket: WebSocket) -> None:
        await socket.send({"type": "websocket.close", "code": 1008})

    routes: list[BaseRoute] = [
        Route(f"/{address}", functools.partial(file, (files / name).read_bytes(), kind))
        for address, (name, kind) in _FILES.items()
    ]
    routes += [
        Route("/things", answering(lambda query: watched.things())),
        Route("/about", answering(lambda query: watched.about(query.get("kind", ""), query.get("in", "")))),
        Route("/view", answering(view)),
        Route("/robot.png", answering(picture)),
        Route("/stop", answering(stop), methods=["POST"]),
        WebSocketRoute("/{path:path}", refuse),
    ]
    guarded = Middleware(BaseHTTPMiddleware, dispatch=guard(token, port))
    return Starlette(routes=[Mount(f"/{token}", routes=routes)], middleware=[guarded])


def _response(answer: Callable[[Any], Any], query: Any) -> tuple[int, str, bytes]:
    """Status, media type and content of a response."""
    try:
        content = answer(query)
        if isinstance(content, bytes):
            return 200, "image/png", content
        return 200, "application/json", json.dumps(content, allow_nan=False).encode()
    except AnimatError as error:
        return 409, "application/json", _error(str(error))
    except Exception as error:
        # Anything may be in a file.
        return 500, "application/json", _error(f"cannot be shown: {first_line(error)}")


def _error(message: str) -> bytes:
    return json.dumps({"error": text(" ".join(message.split()), 1000)}).encode()


def _number(query: Any, name: str) -> float | None:
    raw = query.get(name)
    if raw is None:
        return None
    try:
        value = float(raw)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e15:
        raise InvalidArgument(f"{name}: expected a number, got {text(raw, 40)}")
    return value


def stop_session(folder: Path) -> None:
    """Ask a session to end, without waiting or reading anything first, as it may be urgent.

    Raises:
        InvalidArgument: if there is no session, or it has ended.
        InvalidFile: if the file cannot be created.
    """
    if not (folder / LOG_FILE).is_file():
        raise InvalidArgument(f"{folder.name}: expected a session to stop, got none")
    if (folder / RECORDING_FILE).exists():
        raise InvalidArgument(f"{folder.name}: the session has ended: there is nothing to stop")
    try:
        # Never through a link, which may lead anywhere.
        os.close(os.open(folder / STOP_FILE, os.O_CREAT | os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666))
    except OSError as error:
        raise InvalidFile(f"{folder / STOP_FILE}: cannot be created: {error.strerror or error}") from error
