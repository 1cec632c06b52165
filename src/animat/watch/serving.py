"""The server of the page: on the loopback interface alone, at an address that nobody can guess."""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from animat.errors import AnimatError, InvalidArgument
from animat.watch.found import find

_NEEDS = ("starlette", "uvicorn")
_START_S = 60.0
"""How long a server may take to say its address."""
_LINGER_S = 60.0
"""For how long after its command, and the last look at its page, a server stays."""


def expect_installed() -> None:
    """Refuse where what the page needs is not installed (AnimatError, saying how to install it)."""
    if missing := [name for name in _NEEDS if find_spec(name) is None]:
        raise AnimatError(f"the page needs {' and '.join(missing)}: pip install 'animat[watch]'")


def serve(folder: Path, port: int, say: Callable[[str], None], *, beside: int | None = None) -> None:
    """Serve the page of a folder until Ctrl-C.

    Args:
        folder: that is watched.
        port: 0 for any that is free.
        say: is given the address.
        beside: a process: a minute after it ended and the page was last looked at, so does this.

    Raises:
        AnimatError: if what the page needs is not installed.
        InvalidArgument: for a port that cannot be listened on.
    """
    expect_installed()
    import uvicorn

    from animat.watch.app import app_for

    token = secrets.token_urlsafe(24)
    expected = "--port: expected one from 1 to 65,535 that is free, or 0 for any that is"
    if not 0 <= port < 2**16:
        raise InvalidArgument(f"{expected}, got {port}")
    try:
        listening = socket.create_server(("127.0.0.1", port))
    except OSError as error:
        raise InvalidArgument(f"{expected}, got {port}: {error.strerror or error}") from error
    with listening:
        port = listening.getsockname()[1]
        app = app_for(folder, token, port)
        app.state.asked_s = time.monotonic()
        settings: dict[str, Any] = {
            "log_level": "critical", "access_log": False, "lifespan": "off", "ws": "none", "proxy_headers": False,
        }  # fmt: skip
        # What is refused is told in no header.
        server = uvicorn.Server(uvicorn.Config(app, server_header=False, timeout_graceful_shutdown=1, **settings))
        if beside is not None:
            threading.Thread(target=_end_after, args=(beside, app, server), daemon=True).start()
        say(f"http://127.0.0.1:{port}/{token}/")
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listening])


def _end_after(process: int, app: Any, server: Any) -> None:
    # Whoever loses the process that started it gets another parent.
    while os.getppid() == process or time.monotonic() - app.state.asked_s < _LINGER_S:
        time.sleep(1.0)
    server.should_exit = True


@contextmanager
def watching(folder: Path) -> Iterator[None]:
    """Have the page of a folder served by a process of its own, which stays a minute for whoever looks.

    Its address is printed. What is in the block knows nothing of it.

    Raises:
        AnimatError: if it needs what is not installed, or does not start.
    """
    expect_installed()
    # A session of its own: Ctrl-C ends the command, and the page shows how.
    server = subprocess.Popen(
        [sys.executable, "-m", "animat.watch", str(folder.absolute()), str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    print(f"watch it at {_address(server)}", file=sys.stderr, flush=True)
    try:
        yield
    except AnimatError:
        if not find(folder):
            # It was refused before anything began.
            server.kill()
            server.wait()
        raise
    finally:
        # It goes on for whoever looks, and ends by itself: that it is not waited for is meant, and no leak.
        assert server.stdout is not None
        server.stdout.close()
        server.returncode = server.poll() or 0


def _address(server: subprocess.Popen[str]) -> str:
    assert server.stdout is not None
    late = threading.Timer(_START_S, server.kill)
    late.start()
    said = server.stdout.readline().strip()
    late.cancel()
    if not said.startswith("http://127.0.0.1:"):
        server.kill()
        server.communicate()
        raise AnimatError("--watch: the page's server did not start; run animat watch to see why, or go without")
    return said
