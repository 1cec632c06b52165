"""Access control: only this machine, only the address with the token, only the page itself."""

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
"""The page may load only its own files and responses."""
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
"""Headers of every response."""


def guard(token: str, port: int) -> Callable[[Request, RequestResponseEndpoint], Awaitable[Response]]:
    """Middleware that answers 403 to any request that is not from the page or its address, and passes on the rest.

    A foreign name that resolves to this machine (DNS rebinding) appears in `Host`, a foreign page in `Origin`. Neither
    knows the token that begins every path. The time of the last request that was passed on is kept in
    the application's `state.asked_s`.
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
        response.headers.update(HEADERS)
        return response

    return guarded
