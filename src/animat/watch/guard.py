"""Who may ask: this machine alone, by the address with the token, from the page itself."""

from __future__ import annotations

import hmac
import time
from collections.abc import Awaitable, Callable

from starlette.middleware.base import RequestResponseEndpoint
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What the page may load, and from where: its own files and answers, and nothing else."""
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
"""Of every answer."""


def guard(token: str, port: int) -> Callable[[Request, RequestResponseEndpoint], Awaitable[Response]]:
    """What answers 403 to whatever is not asked by the page, or by its address, and hands the rest on.

    A name that leads here (DNS rebinding) is in `Host`, another page in `Origin`; neither knows the token, with which
    every address begins. When something was last asked is noted in the application's `state.asked_s`.
    """
    hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}
    origins = {f"http://{host}" for host in hosts}

    def why_not(request: Request) -> str:
        """Why something is refused; empty where it is not."""
        host, origin = (request.headers.getlist(name) for name in ("host", "origin"))
        if len(host) != 1 or host[0] not in hosts:
            return "this page is for this machine alone, by the address that was printed"
        if len(origin) > 1 or any(each not in origins for each in origin):
            return "another page may not ask"
        if request.method not in ("GET", "HEAD") and not origin:
            return "expected an Origin with what changes something"
        given, slash, _ = request.scope["path"].removeprefix("/").partition("/")
        if not slash or not hmac.compare_digest(given.encode("utf-8", "replace"), token.encode()):
            return "expected the token of the address that was printed"
        return ""

    async def guarded(request: Request, answer: RequestResponseEndpoint) -> Response:
        request.app.state.asked_s = time.monotonic()
        refused = why_not(request)
        response = PlainTextResponse(refused, 403) if refused else await answer(request)
        response.headers.update(HEADERS)
        return response

    return guarded
