"""Who may ask: this machine alone, by the address with the token, from the page itself."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What the page may load, and from where: its own files and answers, and nothing else."""
HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)
"""Of every answer."""


class Guard:
    """Answers 403 to whatever is not asked by the page, or by its address, and hands the rest on without the token.

    A name that leads here (DNS rebinding) is in `Host`, another page in `Origin`; neither knows the token, with which
    every address begins.
    """

    def __init__(self, app: App, token: str, port: int) -> None:
        self._app, self._token = app, token.encode()
        self._hosts = {f"{name}:{port}".encode() for name in ("127.0.0.1", "localhost")}
        self._origins = {b"http://" + host for host in self._hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Look at one request."""
        if scope["type"] not in ("http", "websocket"):
            return
        refused = self._why_not(scope)
        if scope["type"] == "websocket":
            # There are none here.
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        elif refused:
            await _refuse(send, refused)
        else:
            _, _, path = scope["path"].removeprefix("/").partition("/")
            inner = {**scope, "path": f"/{path}", "raw_path": None, "root_path": ""}
            await self._app(inner, receive, _with_headers(send))

    def _why_not(self, scope: Scope) -> str:
        """Why something is refused; empty where it is not."""
        headers: dict[bytes, list[bytes]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.lower(), []).append(value)
        if len(headers.get(b"host", [])) != 1 or headers[b"host"][0] not in self._hosts:
            return "this page is for this machine alone, by the address that was printed"
        origins = headers.get(b"origin", [])
        if len(origins) > 1 or any(origin not in self._origins for origin in origins):
            return "another page may not ask"
        if scope.get("method", "GET") not in ("GET", "HEAD") and not origins:
            return "expected an Origin with what changes something"
        given, slash, _ = scope["path"].removeprefix("/").partition("/")
        if not slash or not hmac.compare_digest(given.encode("utf-8", "replace"), self._token):
            return "expected the token of the address that was printed"
        return ""


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", ()), *HEADERS]}
        await send(message)

    return sending


async def _refuse(send: Send, why: str) -> None:
    body = why.encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode()), *HEADERS]
    await send({"type": "http.response.start", "status": 403, "headers": headers})
    await send({"type": "http.response.body", "body": body})
