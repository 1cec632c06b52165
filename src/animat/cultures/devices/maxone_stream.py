"""Live spikes of a MaxOne: the interface that the driver needs, and the stream of the vendor's server."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, Protocol

import numpy as np
from jaxtyping import Int64

from animat.cultures.failures import describe_error, vendor_module
from animat.errors import DeviceFailed
from animat.extras import pip_install

ADDRESS = "tcp://localhost:7205"
"""The filtered stream, in which the server detects spikes: one message per frame."""
PATIENCE_S = 2.0
KEPT_SPIKES = 5_000_000
AMPLIFIERS = 1024
NEAR_FRAMES = 20_000
"""Largest distance of a spike's frame from its message's, a second: read with the wrong layout it is anywhere."""
FRAME = np.dtype("<u8")
EVENT_24 = np.dtype([("pad", "V7"), ("well", "u1"), ("frame", "<u8"), ("channel", "<i4"), ("amplitude", "<f4")])
EVENT_16 = np.dtype([("frame", "<u8"), ("amplitude", "<f4"), ("channel", "<u2"), ("well", "u1"), ("pad", "V1")])
"""A spike in servers of version 24.1; other versions, as far as known, use the other layout. Messages show which."""


class SpikeStream(Protocol):
    """Frames of 50 us and their spikes; channels are amplifiers."""

    def start(self) -> None:
        """Begin to listen; returns after the first frame."""

    def stop(self) -> None:
        """Stop listening; may be called without `start`."""

    def frame(self) -> int:
        """The number of the newest frame received."""

    def wait(self, frame: int) -> None:
        """Return when that frame has been received; raises DeviceFailed if no more frames come."""

    def take(self, start: int, stop: int) -> tuple[Int64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
        """Frames and channels of the spikes with start <= frame < stop; earlier ones are discarded."""


class ZmqSpikes:
    """The stream of MaxLab Live's server through ZeroMQ (the package pyzmq), read by a thread.

    A message has up to three parts: the frame's number, the samples of all channels, and the spikes of that frame.
    Frames lost in transmission are counted in `lost_frames`, spikes that came after theirs were taken in `late_spikes`,
    and spikes for which there was no room, the oldest, in `dropped_spikes`.
    """

    def __init__(self, address: str = ADDRESS) -> None:
        self._address = address
        self._layouts = [EVENT_24, EVENT_16]
        self._spikes: deque[tuple[int, int]] = deque(maxlen=KEPT_SPIKES)
        self._frame = -1
        self._came_s = 0.0
        self._thread: threading.Thread | None = None
        self._going = threading.Event()
        self._failed: Exception | None = None
        self.lost_frames = self.late_spikes = self.dropped_spikes = self._taken = 0

    def start(self) -> None:
        missing = "culture: expected the package pyzmq to read a maxone, which is not installed"
        zmq = vendor_module("zmq", f"{missing}: {pip_install('pyzmq')}")
        self._frame, self._failed = -1, None
        self.lost_frames = self.late_spikes = self.dropped_spikes = self._taken = 0
        self._spikes.clear()
        self._going.set()
        self._came_s = time.monotonic()
        self._thread = threading.Thread(target=self._listen, args=(zmq,), name="maxone-spikes", daemon=True)
        self._thread.start()
        self.wait(0)

    def stop(self) -> None:
        self._going.clear()
        if self._thread is not None:
            self._thread.join(timeout=5)
            self._thread = None

    def frame(self) -> int:
        return self._frame

    def wait(self, frame: int) -> None:
        """Poll every tenth of a millisecond."""
        while self._frame < frame:
            failed = self._failed
            if isinstance(failed, DeviceFailed):
                raise DeviceFailed(str(failed)) from failed
            if failed is not None or time.monotonic() - self._came_s > PATIENCE_S:
                got = f"none for {PATIENCE_S:g} s" if failed is None else describe_error(failed)
                # ZeroMQ does not report a lost connection to a subscriber: it just falls silent.
                expected = f"MaxOne: expected frames from {self._address}"
                cause = failed or ConnectionError(f"nothing came for {PATIENCE_S:g} s")
                raise DeviceFailed(f"{expected}, got {got}: is MaxLab Live's server running?") from cause
            time.sleep(1e-4)

    def take(self, start: int, stop: int) -> tuple[Int64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
        # Check all spikes, as they may be out of order; the listener may add some meanwhile.
        spikes = [self._spikes.popleft() for _ in range(len(self._spikes))]
        self._spikes.extendleft(spike for spike in reversed(spikes) if spike[0] >= stop)
        self.late_spikes += sum(spike[0] < self._taken for spike in spikes)
        self._taken = stop
        table = np.array([spike for spike in spikes if start <= spike[0] < stop], dtype=np.int64).reshape(-1, 2)
        return table[:, 0], table[:, 1]

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
            self._failed = error

    def hear(self, parts: list[bytes]) -> None:
        """Process one message; raises DeviceFailed for a layout of no known version, and if frames begin anew."""
        if len(parts[0]) != FRAME.itemsize:
            raise DeviceFailed(f"MaxOne: expected a frame's number in 8 bytes, got {len(parts[0])}")
        number = int(np.frombuffer(parts[0], FRAME)[0])
        if number < self._frame:
            why = "MaxLab Live's server was restarted; close and open again"
            raise DeviceFailed(f"MaxOne: expected frames after {self._frame}, got {number}: {why}")
        if len(parts) > 2 and parts[2]:
            spikes = self._read(parts[2], number)
            self.dropped_spikes += max(0, len(self._spikes) + len(spikes) - KEPT_SPIKES)
            self._spikes.extend(spikes)
        if self._frame >= 0 and number > self._frame + 1:
            self.lost_frames += number - self._frame - 1
        self._frame, self._came_s = number, time.monotonic()

    def _read(self, spikes: bytes, number: int) -> list[tuple[int, int]]:
        """Frames and channels of a message's spikes, by the layout that fits."""
        for place, layout in enumerate(self._layouts):
            if len(spikes) % layout.itemsize:
                continue
            table = np.frombuffer(spikes, layout)
            read = list(zip(table["frame"].tolist(), table["channel"].tolist(), strict=True))
            if all(abs(frame - number) <= NEAR_FRAMES and 0 <= channel < AMPLIFIERS for frame, channel in read):
                # Later messages are from the same server: try this layout first.
                self._layouts.insert(0, self._layouts.pop(place))
                return read
        expected = f"the spikes of frame {number} on amplifiers 0 to {AMPLIFIERS - 1}, of 24 or 16 bytes each"
        unknown = "this version of MaxLab Live is not known; pass your own stream"
        raise DeviceFailed(f"MaxOne: expected {expected}, got {len(spikes)} bytes that are neither: {unknown}")
