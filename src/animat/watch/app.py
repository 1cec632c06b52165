"""The page's requests: who may ask, and the answers: its own files, the list of items to watch, and each view."""

from __future__ import annotations

import hmac
import threading
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from animat.errors import AnimatError, InvalidArgument, first_line
from animat.watch.discovery import find, place_within
from animat.watch.files import text
from animat.watch.live import LiveView
from animat.watch.recording import RecordingView
from animat.watch.session import SessionView, stop_session
from animat.watch.study import CulturesView, StudyView
from animat.watch.training import TrainingView
from animat.watch.tuning import TuningView
from animat.watch.view import View

_MOST_VIEWS = 8
_VIEWS: dict[str, type[View]] = {
    view.kind: view
    for view in (LiveView, SessionView, TrainingView, StudyView, CulturesView, TuningView, RecordingView)
}
_Query = Mapping[str, str]

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The page may load only its own files and responses."""
_HEADERS = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Watched:
    """A folder, which need not exist yet, and the answers to requests on it; views are used by one thread at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._views: OrderedDict[tuple[str, str], View] = OrderedDict()
        self._lock = threading.Lock()

    def things(self, query: _Query) -> dict[str, Any]:
        """The items in the folder; a name that is not valid text cannot be requested."""
        items = [item for item in find(self.folder) if text(item.place, 4096) == item.place]
        things = [{"kind": item.kind, "place": item.place} for item in items]
        return {"folder": text(self.folder.resolve().name or str(self.folder)), "things": things}

    def about(self, query: _Query) -> dict[str, Any]:
        """The unchanging description of an item."""
        with self._lock:
            return self._view(query.get("kind", ""), query).about()

    def view(self, query: _Query) -> dict[str, Any]:
        """The current view of an item."""
        with self._lock:
            return self._view(query.get("kind", ""), query).view(_number(query, "to"), _number(query, "span") or 8.0)

    def picture(self, query: _Query) -> bytes:
        """The robot of a session at a record, as PNG."""
        with self._lock:
            view = self._view("session", query)
            assert isinstance(view, SessionView)
            png = view.picture(int(_number(query, "at") or 0))
        if png is None:
            raise InvalidArgument("at: no picture of the robot there")
        return png

    def stop(self, query: _Query) -> dict[str, Any]:
        """End a session, without waiting for the lock."""
        stop_session(place_within(self.folder, query.get("in", "")))
        return {"stopped": True}

    def _view(self, kind: str, query: _Query) -> View:
        key = kind, query.get("in", "")
        if key not in self._views:
            if kind not in _VIEWS:
                raise InvalidArgument(f"kind: expected one of {', '.join(_VIEWS)}, got {text(kind, 40)}")
            self._views[key] = _VIEWS[kind](place_within(self.folder, key[1]))
            if len(self._views) > _MOST_VIEWS:
                self._views.popitem(last=False)[1].close()
        self._views.move_to_end(key)
        return self._views[key]


def app_for(folder: Path, token: str, port: int) -> Starlette:
    """The page of a folder as a guarded ASGI application."""
    watched = Watched(folder)

    async def refuse(socket: WebSocket) -> None:
        await socket.send({"type": "websocket.close", "code": 1008})

    routes = [
        Route("/things", partial(_response, watched.things)),
        Route("/about", partial(_response, watched.about)),
        Route("/view", partial(_response, watched.view)),
        Route("/robot.png", partial(_response, watched.picture)),
        Route("/stop", partial(_response, watched.stop), methods=["POST"]),
        WebSocketRoute("/{path:path}", refuse),
        Mount("/", StaticFiles(packages=[("animat.watch", "page")], html=True)),
    ]
    guarded = Middleware(BaseHTTPMiddleware, dispatch=_guard(token, port))
    return Starlette(routes=[Mount(f"/{token}", routes=routes)], middleware=[guarded])


def _response(answer: Callable[[_Query], Any], request: Request) -> Response:
    # Not `async`: starlette calls it in a thread, as an answer may take a while.
    try:
        content = answer(request.query_params)
        return Response(content, media_type="image/png") if isinstance(content, bytes) else JSONResponse(content)
    except AnimatError as error:
        status, message = 409, str(error)
    except Exception as error:
        status, message = 500, f"cannot be shown: {first_line(error)}"
    return JSONResponse({"error": text(" ".join(message.split()), 1000)}, status)


def _number(query: _Query, name: str) -> float | None:
    if name not in query:
        return None
    with suppress(ValueError):
        if abs(value := float(query[name])) < 1e15:
            return value
    raise InvalidArgument(f"{name}: expected a number, got {text(query[name], 40)}")


def _guard(token: str, port: int) -> Callable[[Request, RequestResponseEndpoint], Awaitable[Response]]:
    """Middleware that answers 403 to any request that is not from the page or its address, and passes on the rest.

    A foreign name that resolves to this machine (DNS rebinding) appears in `Host`, a foreign page in `Origin`. Neither
    knows the token that begins every path. When the last request was passed on is the application's `state.asked_s`.
    """
    hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}
    origins = {f"http://{host}" for host in hosts}

    def refusal(request: Request) -> str:
        """Why a request is refused; empty if it is not."""
        host, origin = (request.headers.getlist(name) for name in ("host", "origin"))
        if len(host) != 1 or host[0] not in hosts:
            return "this page is only for this machine, at the printed address"
        if len(origin) > 1 or any(page not in origins for page in origin):
            return "requests from other pages are refused"
        if request.method not in ("GET", "HEAD") and not origin:
            return "expected an Origin with a request that changes something"
        prefix, slash, _ = request.scope["path"].removeprefix("/").partition("/")
        if not slash or not hmac.compare_digest(prefix.encode("utf-8", "replace"), token.encode()):
            return "expected the token of the printed address"
        return ""

    async def guarded(request: Request, answer: RequestResponseEndpoint) -> Response:
        if reason := refusal(request):
            response: Response = PlainTextResponse(reason, 403)
        else:
            request.app.state.asked_s = time.monotonic()
            response = await answer(request)
        response.headers.update(_HEADERS)
        return response

    return guarded
