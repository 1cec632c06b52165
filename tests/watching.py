"""Helpers of the page's tests: sessions, and requests without a server."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode

import numpy as np

from animat.closed_loop.agents import Agent, AnyCondition, OneCondition
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session
from animat.coding.mapping import Thresholds
from animat.responses.condition import Condition
from animat.robots import Navigation
from fake_culture import FakeCulture

AGENTS = [Agent("random", "any", AnyCondition(5)), Agent("silent", "", OneCondition(0), "silent")]
PORT, TOKEN = 8123, "a-token"
OWN = f"http://127.0.0.1:{PORT}"


def session_in(folder: Path, *, episodes: int = 2, **settings: Any) -> Session:
    """A session of some seconds, with six iterations per episode."""
    loop = Loop(
        robot=Navigation(episode_limit=6),
        mapping=Thresholds(9),
        conditions=tuple(Condition(f"{f:g} Hz", f, "Hz") for f in (5.0, 10.0, 20.0, 40.0, 80.0)),
        percentiles=np.linspace(0.0, 125.0, 11),
        **{"pause_s": 0.1, "warm_up": 1, **settings},
    )
    with FakeCulture(1) as culture:
        return run_session(culture, loop, AGENTS, folder, episodes=episodes, seed=1)


class Answer(NamedTuple):
    """A response."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body, parse_constant=lambda name: {}[name])


def asked(
    app: Any,
    path: str,
    *,
    method: str = "GET",
    host: str | None = f"127.0.0.1:{PORT}",
    origin: str | None = None,
    token: str = TOKEN,
    raw: str | None = None,
    **query: Any,
) -> Answer:
    """Send a request to an application, as a server would."""
    headers = [(b"host", host.encode())] if host is not None else []
    headers += [(b"origin", origin.encode())] if origin is not None else []
    full = f"/{token}/{path}" if raw is None else raw
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "scheme": "http",
        "path": full, "raw_path": full.encode(), "root_path": "", "query_string": urlencode(query).encode(),
        "headers": headers, "client": ("127.0.0.1", 50000), "server": ("127.0.0.1", PORT),
    }  # fmt: skip
    sent: list[Any] = []
    received = iter([{"type": "http.request", "body": b"", "more_body": False}])

    async def receive() -> Any:
        # Nothing follows the request while the client waits for the answer.
        return next(received, None) or await asyncio.Event().wait()

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(app(scope, receive, send))
    head = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return Answer(sent[0]["status"], head, b"".join(message.get("body", b"") for message in sent[1:]))
