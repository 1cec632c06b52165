"""Spikes of a MaxOne as they come: what the driver needs of a stream, and the stream of the vendor's server."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, Protocol

import numpy as np
from jaxtyping import Int64

from animat.errors import DeviceFailed

ADDRESS = "tcp://localhost:7205"
"""The filtered stream, in which the server detects spikes: one message a frame."""
PATIENCE_S = 2.0
KEPT_SPIKES = 5_000_000
FRAME = np.dtype("<u8")
EVENT_24 = np.dtype([("pad", "V7"), ("well", "u1"), ("frame", "<u8"), ("channel", "<i4"), ("amplitude", "<f4")])
EVENT_16 = np.dtype([("frame", "<u8"), ("amplitude", "<f4"), ("channel", "<u2"), ("well", "u1"), ("pad", "V1")])
"""A spike in servers up to and after version 24.1."""


class SpikeStream(Protocol):
    """Frames of 50 us that pass, and the spikes in them; channels are amplifiers."""

    def start(self) -> None:
        """Begin to listen; returns when the first frame came."""

    def stop(self) -> None:
        """Listen no more; also when it was not started."""

    def frame(self) -> int:
        """The number of the newest frame that came."""

    def wait(self, frame: int) -> None:
        """Return when that frame has come, at once if it is over.

        Raises:
            DeviceFailed: when no frame comes any more.
        """

    def take(self, start: int, stop: int) -> tuple[Int64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
        """Frames and channels of the spikes with start <= frame < stop; what lies before is forgotten."""

    def forget(self, before: int) -> None:
        """Let go of spikes before a frame."""


class ZmqSpikes:
    """The stream of MaxLab Live's server through ZeroMQ (the package pyzmq), read by a thread.

    A message has up to three parts: the frame's number, the samples of all channels, and the spikes of that frame.
    Frames that were lost on the way are counted in `lost_frames`.

    Args:
        address: of the server.
        event_bytes: how long a spike is in this version of the server, 24 or 16.
    """

    def __init__(self, address: str = ADDRESS, *, event_bytes: int = 24) -> None:
        self._address = address
        self._event = {24: EVENT_24, 16: EVENT_16}[event_bytes]
        self._spikes: deque[tuple[int, int]] = deque(maxlen=KEPT_SPIKES)
        self._frame = -1
        self._came_s = 0.0
        self._thread: threading.Thread | None = None
        self._going = threading.Event()
        self._failed: str | None = None
        self.lost_frames = 0

    def start(self) -> None:
        """Listen from now on."""
        try:
            import zmq
        except ImportError as error:
            raise DeviceFailed(
                "zmq: expected the package pyzmq to hear a MaxOne, got none: pip install pyzmq"
            ) from error
        self._frame, self._failed, self.lost_frames = -1, None, 0
        self._spikes.clear()
        self._going.set()
        self._came_s = time.monotonic()
        self._thread = threading.Thread(target=self._listen, args=(zmq,), name="maxone-spikes", daemon=True)
        self._thread.start()
        self.wait(0)

    def stop(self) -> None:
        """Listen no more."""
        self._going.clear()
        if self._thread is not None:
            self._thread.join(timeout=5)
            self._thread = None

    def frame(self) -> int:
        """The newest frame."""
        return self._frame

    def wait(self, frame: int) -> None:
        """Sleep until it came, in pieces of a tenth of a millisecond."""
        while self._frame < frame:
            if self._failed is not None or time.monotonic() - self._came_s > PATIENCE_S:
                raise DeviceFailed(
                    f"MaxOne: expected frames from {self._address}, got {self._failed or 'none any more'}: is MaxLab "
                    "Live's server running?"
                )
            time.sleep(1e-4)

    def take(self, start: int, stop: int) -> tuple[Int64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
        """The spikes between two frames."""
        self.forget(start)
        taken = []
        while self._spikes and self._spikes[0][0] < stop:
            taken.append(self._spikes.popleft())
        table = np.array(taken, dtype=np.int64).reshape(-1, 2)
        return table[:, 0], table[:, 1]

    def forget(self, before: int) -> None:
        """Let go of spikes before a frame."""
        while self._spikes and self._spikes[0][0] < before:
            self._spikes.popleft()

    def _listen(self, zmq: Any) -> None:
        try:
            with zmq.Context() as context, context.socket(zmq.SUB) as socket:
                socket.setsockopt(zmq.RCVHWM, 0)
                socket.setsockopt(zmq.RCVTIMEO, 100)
                socket.setsockopt(zmq.LINGER, 0)
                socket.setsockopt(zmq.SUBSCRIBE, b"")
                socket.connect(self._address)
                while self._going.is_set():
                    try:
                        parts = socket.recv_multipart()
                    except zmq.Again:
                        continue
                    self.hear(parts)
        except Exception as error:
            self._failed = f"{type(error).__name__}: {' '.join(str(error).split())}"

    def hear(self, parts: list[bytes]) -> None:
        """Take in one message.

        Raises:
            DeviceFailed: for one that is not laid out as the version says.
        """
        if len(parts[0]) != FRAME.itemsize:
            raise DeviceFailed(f"MaxOne: expected a frame's number in 8 bytes, got {len(parts[0])}")
        number = int(np.frombuffer(parts[0], FRAME)[0])
        if len(parts) > 2 and parts[2]:
            if len(parts[2]) % self._event.itemsize:
                raise DeviceFailed(
                    f"MaxOne: expected spikes of {self._event.itemsize} bytes, got {len(parts[2])} bytes: is "
                    "event_bytes that of this version of the server?"
                )
            spikes = np.frombuffer(parts[2], self._event)
            self._spikes.extend(zip(spikes["frame"].tolist(), spikes["channel"].tolist(), strict=True))
        if self._frame >= 0 and number > self._frame + 1:
            self.lost_frames += number - self._frame - 1
        self._frame, self._came_s = number, time.monotonic()
