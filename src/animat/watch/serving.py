"""The page's server: only on the loopback interface, at an address that cannot be guessed."""

from __future__ import annotations

import os
import secrets
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from animat.errors import AnimatError, InvalidArgument
from animat.extras import install_command
from animat.watch.discovery import find

_NEEDS = ("starlette", "uvicorn")
_START_S = 60.0
"""How long a server may take to report its address."""
_LINGER_S = 60.0
"""How long a server stays up after its command has ended and the page was last requested."""


def expect_installed() -> None:
    """Raise AnimatError, with the command to install them, if the page's requirements are missing."""
    if missing := [name for name in _NEEDS if find_spec(name) is None]:
        raise AnimatError(
            f"watch: expected {' and '.join(missing)} to be installed, got none: {install_command('watch')}"
        )


def serve(folder: Path, port: int, announce: Callable[[str], None], *, parent: int | None = None) -> None:
    """Serve the page of a folder until Ctrl-C, on a port (0: any free one); `announce` is called with the address.

    With a `parent`, the id of a process, it ends a minute after that process has ended and the page was last requested.
    Raises AnimatError if the page's requirements are not installed, and InvalidArgument if the port is not available.
    """
    expect_installed()
    import uvicorn

    from animat.watch.app import app_for

    token = secrets.token_urlsafe(24)
    expected = "--port: expected a free port from 1 to 65,535, or 0 for any"
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
        config = uvicorn.Config(
            app, log_level="critical", access_log=False, lifespan="off", ws="none", proxy_headers=False,
            # No header names the server, not even in refusals.
            server_header=False, timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = uvicorn.Server(config)
        if parent is not None:
            threading.Thread(target=_end_after, args=(parent, app, server), daemon=True).start()
        announce(f"http://127.0.0.1:{port}/{token}/")
        with suppress(KeyboardInterrupt):
            server.run(sockets=[listening])


def _end_after(parent: int, app: Any, server: Any) -> None:
    # A process whose parent ends gets another one.
    while os.getppid() == parent or time.monotonic() - app.state.asked_s < _LINGER_S:
        time.sleep(1.0)
    server.should_exit = True


@contextmanager
def watching(folder: Path) -> Iterator[None]:
    """Serve the page of a folder in a separate process, which stays up for a minute after the last request.

    Its address is printed. Raises AnimatError if its requirements are not installed, or it does not start.
    """
    expect_installed()
    # In its own session: Ctrl-C ends only the command, and the page shows how it ended.
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
            # The command was refused before it began.
            server.kill()
            server.wait()
        raise
    finally:
        # The server continues for viewers and ends by itself: not waiting for it is intended, and not a leak.
        assert server.stdout is not None
        server.stdout.close()
        server.returncode = server.poll() or 0


def _address(server: subprocess.Popen[str]) -> str:
    assert server.stdout is not None
    timeout = threading.Timer(_START_S, server.kill)
    timeout.start()
    address = server.stdout.readline().strip()
    timeout.cancel()
    if not address.startswith("http://127.0.0.1:"):
        server.kill()
        server.communicate()
        raise AnimatError("--watch: the page's server did not start; run animat watch to see why, or omit --watch")
    return address
