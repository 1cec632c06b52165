"""Opening, closing and stopping a culture: sessions."""

from __future__ import annotations

import abc
import atexit
import os
import sys
import threading
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NoReturn, Self, final

from animat.cultures.failures import as_device_failure, while_open
from animat.cultures.holding import hold
from animat.cultures.limits import Limits, plain_limits
from animat.cultures.safety import Guard, History
from animat.errors import InvalidArgument, UnsafeStimulus
from animat.stimulation.plain import seconds

_LOOK_S = 0.02
"""How often a waiting call checks for an emergency stop."""


def _close_at_exit(opened: Callable[[], Openable | None]) -> None:
    culture = opened()
    try:
        if culture is not None:
            culture.close()
    except Exception as error:
        print(f"warning: {error}", file=sys.stderr)


class Turns:
    """The turns of one session: `with turns:` waits until no other thread has one.

    Each session has its own, so that a call that hangs in an earlier session blocks nothing in the next. Waiting calls
    are refused when the guard is stopped, as the call they wait for may never end.
    """

    def __init__(self, guard: Guard) -> None:
        self.guard = guard
        self._lock = threading.RLock()
        self._is_taken = self._is_over = False

    def __enter__(self) -> Guard:
        while not self._lock.acquire(timeout=_LOOK_S):
            if (reason := self.guard.stopped) is not None:
                waiting = f"an emergency stop is in force ({reason}), and another thread's call has not returned"
                raise UnsafeStimulus("stopped", f"{waiting}: close and open again")
        if self._is_over or self._is_taken:
            self._lock.release()
            if self._is_over:
                raise InvalidArgument("culture: expected an open one, got one that was closed meanwhile")
            raise InvalidArgument("culture: expected one call to end before the next, got one from within another")
        self._is_taken = True
        return self.guard

    def __exit__(self, *_: Any) -> None:
        self._is_taken = False
        self._lock.release()

    def end(self, halt: Callable[[], None], wait_s: float) -> None:
        """Allow no further turn; halt another thread's, and wait for it up to `wait_s`, below 0 without limit."""
        self._is_over = True
        if not self._lock.acquire(blocking=False):
            halt()
            if not self._lock.acquire(timeout=wait_s):
                return
        self._lock.release()


class Openable(abc.ABC):
    """Opened for a session, with limits and a guard, and closed; `Culture` adds what happens in between."""

    name: ClassVar[str]
    ends_within_s: ClassVar[float] = 0.5
    """How long closing waits for a stopped delivery of another thread to end; below 0: without limit."""

    def __init__(self, limits: Limits | None = None) -> None:
        self._asked_limits = None if limits is None else plain_limits(limits)
        # Mangled names, which no subclass can use by accident.
        self.__turns: Turns | None = None
        # Covers all sessions: closing and reopening must not circumvent a rate limit.
        self.__history = History()
        self.__stops: list[str] = []
        # Re-entrant: a signal handler that closes a culture during opening must not wait for itself.
        self.__open_close_lock = threading.RLock()
        self.__is_opening = False
        self.__process = os.getpid()
        self.__hold = ExitStack()
        self.__token = os.urandom(8).hex()
        self.__at_exit = partial(_close_at_exit, weakref.ref(self))

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise InvalidArgument("culture: expected no copies, got a request to copy or pickle it: create another one")

    @property
    @abc.abstractmethod
    def stimulation_electrodes(self) -> tuple[int, ...]:
        """The electrodes that can stimulate."""

    @property
    @abc.abstractmethod
    def device_limits(self) -> Limits:
        """What the device and the culture tolerate."""

    @property
    @abc.abstractmethod
    def now_s(self) -> float:
        """The culture's clock; if it can, it keeps running while the culture is closed."""

    @property
    def device(self) -> Path | None:
        """The folder that represents a device that only one culture object can hold (`holding`); None: not shared."""
        return None

    @abc.abstractmethod
    def _open(self) -> None:
        """Get ready: connect, route, scan."""

    @abc.abstractmethod
    def _rest(self, duration_s: float) -> None:
        """Let time pass unobserved."""

    @abc.abstractmethod
    def _halt(self) -> None:
        """Stop any delivery immediately; may be called from another thread, and without a delivery."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Leave the device safe and release it; also called when `_open` failed half way."""

    @final
    def open(self) -> Self:
        """Get ready, and begin a session: counts of stimuli restart and an emergency stop is lifted.

        Stimuli of the last second are remembered from session to session. If the last delivery was interrupted, or the
        clock was restarted, everything in its last second counts as delivered just now. If another culture object had
        the device last, opening first lets a second pass.

        Raises:
            InvalidArgument: if it is already open, or its limits are looser than the device's.
            DeviceFailed: if it cannot be opened, or another culture object holds the device; it is then closed.
        """
        if self.__is_opening or not self.__open_close_lock.acquire(blocking=False):
            raise InvalidArgument("culture: expected a closed one to open, got one that is being opened or closed")
        try:
            if self.__turns is not None:
                raise InvalidArgument("culture: expected a closed one to open, got one that is open")
            self.__is_opening, self.__process = True, os.getpid()
            self.__stops.clear()
            if self._asked_limits is not None:
                # Checked again once open: some devices report their amplitude step only then.
                replace(plain_limits(self._asked_limits), amplitude_step=0.0).check_within(self.device_limits)
            with as_device_failure(self.name, "open"):
                device, holder = self.device, f"{self.__token} {os.getpid()}"
                is_handed_over = device is not None and self.__hold.enter_context(hold(device, holder))
            try:
                with as_device_failure(self.name, "open"):
                    self._open()
                    limits = self.limits
                    plain_limits(self._asked_limits or limits).check_within(self.device_limits)
                    if is_handed_over:
                        # What the other program delivered is unknown: wait as long as any limit on pace looks back.
                        self._rest(max(1.0, limits.interval_us * 1e-6, limits.gap_us * 1e-6))
                    now_s = seconds("now_s", self.now_s)
                    self.__turns = Turns(Guard(limits, self.stimulation_electrodes, self.__history, now_s))
                    if self.ends_within_s >= 0:
                        # A program may end without closing it, which would leave a device's stimulation on.
                        atexit.register(self.__at_exit)
            except BaseException as error:
                self.__turns = None
                try:
                    with as_device_failure(self.name, "close"), self.__hold.pop_all():
                        self._close()
                except Exception as failed:
                    error.add_note(f"and then: {failed}")
                raise
            for reason in self.__stops:
                self.__turns.guard.stop(reason)
            return self
        finally:
            self.__is_opening = False
            self.__open_close_lock.release()

    @final
    def close(self) -> None:
        """Leave the device safe and release it; a closed culture stays closed.

        A delivery in progress in another thread is stopped; opening in another thread is waited for. Raises
        DeviceFailed if the device does not confirm that it is safe; the culture is closed all the same.
        """
        # A fork copies a lock that another thread holds, but not the thread that would release it.
        is_ours = self.__process == os.getpid()
        lock: AbstractContextManager[object] = self.__open_close_lock if is_ours else nullcontext()
        with lock:
            turns, self.__turns = self.__turns, None
            atexit.unregister(self.__at_exit)
            if turns is None:
                return
            with as_device_failure(self.name, "close"), self.__hold.pop_all():
                if not is_ours:
                    # A fork's copy is not a culture of this process, which must not close the device.
                    return
                try:
                    turns.guard.stop("it was closed")
                    turns.end(self._halt, self.ends_within_s)
                finally:
                    self._close()

    @final
    def __enter__(self) -> Self:
        return self.open()

    @final
    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        try:
            self.close()
        except Exception as failed:
            if error is None:
                raise
            error.add_note(f"and then: {failed}")

    @property
    @final
    def limits(self) -> Limits:
        """The limits in force; the amplitude step is always the device's own."""
        if (turns := self.__turns) is not None:
            return turns.guard.limits
        device, asked = plain_limits(self.device_limits), self._asked_limits
        return device if asked is None else replace(plain_limits(asked), amplitude_step=device.amplitude_step)

    @property
    @final
    def is_open(self) -> bool:
        """Whether a session is in progress."""
        return self.__turns is not None

    @property
    @final
    def is_stopped(self) -> bool:
        """Whether an emergency stop is in force."""
        return (turns := self.__turns) is not None and turns.guard.stopped is not None

    @property
    @final
    def delivered(self) -> int:
        """Number of stimuli delivered in this session."""
        return self._opened().guard.delivered

    @final
    def stop(self, reason: str = "requested") -> None:
        """Emergency stop: deliver nothing more until the culture is closed and opened again. Safe from any thread.

        Raises DeviceFailed if the device does not confirm that it stopped; later stimuli are refused all the same.
        """
        # Waits for no turn: the call that has it may hang. A culture being opened finds the reason and opens stopped.
        self.__stops.append(reason)
        if (turns := self.__turns) is not None:
            turns.guard.stop(reason)
        with as_device_failure(self.name, "stop"):
            self._halt()

    def _opened(self) -> Turns:
        turns = while_open(self.__turns)
        if self.__process != os.getpid():
            raise InvalidArgument("culture: expected one that this process opened, got a copy made by a fork")
        return turns
