"""Opening and closing what can be stimulated, and stopping it: what a session is."""

from __future__ import annotations

import abc
import os
import threading
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, NoReturn, Self, final

from animat.cultures.failing import as_device_failure
from animat.cultures.history import History
from animat.cultures.holding import held
from animat.cultures.limits import Limits, plain_limits
from animat.cultures.safety import Guard
from animat.errors import InvalidArgument, UnsafeStimulus
from animat.stimulation.plain import seconds

_LOOK_S = 0.02
"""How often whoever waits looks whether an emergency stop ended what it waits for."""


class Turns:
    """The turns of one session: `with turns:` waits until no other thread has one.

    A session ends with its turns. What hangs in an earlier one keeps nobody waiting in the next. Whoever waits is
    refused when the guard is stopped, as what it waits for may never end.

    Args:
        guard: of the session.
    """

    def __init__(self, guard: Guard) -> None:
        self.guard = guard
        self._lock = threading.RLock()
        self._is_taken = self._is_over = False
        self._process = os.getpid()

    @property
    def is_elsewhere(self) -> bool:
        """Whether this is the copy of another process, which a fork made."""
        return self._process != os.getpid()

    def __enter__(self) -> Guard:
        if not self._lock.acquire(blocking=False):
            while not self._lock.acquire(timeout=_LOOK_S):
                if (reason := self.guard.stopped) is not None:
                    raise UnsafeStimulus(
                        "stopped",
                        f"an emergency stop is in force ({reason}) and a call from another thread has not come back: "
                        "close and open again",
                    )
        wrong = None
        if self._is_over:
            wrong = "an open one, got one that was closed meanwhile"
        elif self._is_taken:
            wrong = "one call to be over before the next, got one from within another"
        if wrong is not None:
            self._lock.release()
            raise InvalidArgument(f"culture: expected {wrong}")
        self._is_taken = True
        return self.guard

    def __exit__(self, *_: Any) -> None:
        self._is_taken = False
        self._lock.release()

    def end(self, wait_s: float) -> None:
        """Let no further call have a turn, and wait for the one that has it to end.

        Args:
            wait_s: at most so long; below 0: however long.
        """
        self._is_over = True
        if self._lock.acquire(timeout=wait_s):
            self._lock.release()

    @property
    def is_taken_elsewhere(self) -> bool:
        """Whether a call from another thread has its turn now."""
        if self._lock.acquire(blocking=False):
            self._lock.release()
            return False
        return True


class Openable(abc.ABC):
    """What is opened for a session, with limits and a guard, and closed; `Culture` says what is done meanwhile.

    Args:
        limits: tighter limits than the device's; None: the device's.
    """

    name: ClassVar[str]
    ends_within_s: ClassVar[float] = 0.5
    """How long closing waits for a delivery from another thread, which it stopped, to end; below 0: until it does."""

    def __init__(self, limits: Limits | None = None) -> None:
        self._asked_limits = None if limits is None else plain_limits(limits)
        # What follows has names that no subclass takes by accident.
        self.__turns: Turns | None = None
        # Of all sessions: a rate limit must not be passed by closing and opening again.
        self.__history = History()
        self.__stops: list[str] = []
        # One thread may come back to it: a signal's handler that closes what is being opened must not wait for itself.
        self.__door = threading.RLock()
        self.__is_opening = False
        self.__process = os.getpid()
        self.__hold = ExitStack()
        self.__token = os.urandom(8).hex()

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise InvalidArgument(
            "culture: expected to stay the one that it is, got a request to copy it: make another one"
        )

    # What a backend is, and does.

    @property
    @abc.abstractmethod
    def stimulation_electrodes(self) -> tuple[int, ...]:
        """The electrodes that can stimulate."""

    @property
    @abc.abstractmethod
    def device_limits(self) -> Limits:
        """What the device and the culture stand."""

    @property
    @abc.abstractmethod
    def now_s(self) -> float:
        """The culture's clock; where it can, it goes on while the culture is closed."""

    @property
    def device(self) -> Path | None:
        """The folder that stands for what only one culture object can hold (`holding`); None: each has its own."""
        return None

    @abc.abstractmethod
    def _open(self) -> None:
        """Get ready: connect, route, scan."""

    @abc.abstractmethod
    def _rest(self, duration_s: float) -> None:
        """Let time pass unobserved."""

    @abc.abstractmethod
    def _halt(self) -> None:
        """Stop whatever is being delivered, at once; may be called from another thread, and when nothing is."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Leave the device safe and let go of it; also called where `_open` failed half way."""

    # What a user calls.

    @final
    def open(self) -> Self:
        """Get ready, and begin a session: stimuli are counted anew and an emergency stop is lifted.

        What was delivered in the second before is remembered from session to session. Where the last delivery was
        broken off, or the clock began anew, all of its last second counts as delivered just now. Where another culture
        object had the device last, a second is let pass first.

        Raises:
            InvalidArgument: if it is open already, or its limits are looser than the device's.
            DeviceFailed: if it cannot be opened, or another culture object holds the device; it is then closed.
        """
        if self.__is_opening or not self.__door.acquire(blocking=False):
            raise InvalidArgument("culture: expected a closed one to open, got one that is being opened or closed")
        try:
            if self.__turns is not None:
                raise InvalidArgument("culture: expected a closed one to open, got one that is open")
            self.__is_opening, self.__process = True, os.getpid()
            self.__stops.clear()
            if self._asked_limits is not None:
                # Again when it is open: some devices tell their step of amplitude only then.
                replace(plain_limits(self._asked_limits), amplitude_step=0.0).check_within(self.device_limits)
            with as_device_failure(self.name, "open"):
                device = self.device
                holder = f"{self.__token} {os.getpid()}"
                is_handed_over = device is not None and self.__hold.enter_context(held(device, holder))
            try:
                with as_device_failure(self.name, "open"):
                    self._open()
                    limits = self.limits
                    plain_limits(self._asked_limits or limits).check_within(self.device_limits)
                    if is_handed_over:
                        # What the other one delivered is not known here: rates and intervals look back as long.
                        self._rest(max(1.0, limits.interval_us * 1e-6))
                    now_s = seconds("now_s", self.now_s)
                    self.__turns = Turns(Guard(limits, self.stimulation_electrodes, self.__history, now_s))
            except BaseException as error:
                self.__turns = None
                self._close_after(error, None)
                raise
            for reason in self.__stops:
                self.__turns.guard.stop(reason)
            return self
        finally:
            self.__is_opening = False
            self.__door.release()

    @final
    def close(self) -> None:
        """Leave the device safe and let go of it; a closed culture stays closed.

        A delivery that is under way in another thread is stopped; one that opens it is waited for.

        Raises:
            DeviceFailed: if the device does not say that it is safe; it is closed all the same.
        """
        with self.__one_at_the_door():
            turns, self.__turns = self.__turns, None
            if turns is not None:
                with as_device_failure(self.name, "close"):
                    self._end(turns)

    @final
    def __enter__(self) -> Self:
        return self.open()

    @final
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            with self.__one_at_the_door():
                turns, self.__turns = self.__turns, None
                if turns is not None:
                    self._close_after(error, turns)

    def __one_at_the_door(self) -> AbstractContextManager[object]:
        # A fork copies a lock that another thread has, but not the thread, which would let go of it.
        return self.__door if self.__process == os.getpid() else nullcontext()

    @property
    @final
    def limits(self) -> Limits:
        """The limits in force; amplitudes are rounded to the device's own step, whatever was asked for."""
        if (turns := self.__turns) is not None:
            return turns.guard.limits
        device, asked = plain_limits(self.device_limits), self._asked_limits
        return device if asked is None else replace(plain_limits(asked), amplitude_step=device.amplitude_step)

    @property
    @final
    def is_open(self) -> bool:
        """Whether a session is under way."""
        return self.__turns is not None

    @property
    @final
    def is_stopped(self) -> bool:
        """Whether an emergency stop is in force."""
        return (turns := self.__turns) is not None and turns.guard.stopped is not None

    @property
    @final
    def delivered(self) -> int:
        """Stimuli delivered in this session."""
        return self._opened().guard.delivered

    @final
    def stop(self, reason: str = "asked for") -> None:
        """Emergency stop: deliver nothing more until the culture is closed and opened again. Safe from any thread.

        Raises:
            DeviceFailed: if the device does not say that it stopped; whatever is asked for from now on is refused.
        """
        # No turn is waited for: what has it may hang. One that is being opened finds the reason, and opens stopped.
        self.__stops.append(reason)
        if (turns := self.__turns) is not None:
            turns.guard.stop(reason)
        with as_device_failure(self.name, "stop"):
            self._halt()

    def _end(self, turns: Turns | None) -> None:
        """End a session, leave the device safe and let go of it."""
        with self.__hold.pop_all():
            if turns is not None and turns.is_elsewhere:
                # What a fork copied is no culture of this process: the device is not its to close.
                return
            try:
                if turns is not None:
                    turns.guard.stop("it was closed")
                    if turns.is_taken_elsewhere:
                        self._halt()
                    turns.end(self.ends_within_s)
            finally:
                self._close()

    def _close_after(self, error: BaseException, turns: Turns | None) -> None:
        """Close because of an error, which goes on; that closing failed too is a note of it."""
        try:
            with as_device_failure(self.name, "close"):
                self._end(turns)
        except Exception as failed:
            error.add_note(f"and then: {failed}")

    def _opened(self) -> Turns:
        turns = self.__turns
        if turns is None:
            raise InvalidArgument("culture: expected an open one, got a closed one: use it as `with culture:`")
        if turns.is_elsewhere:
            raise InvalidArgument("culture: expected one that this process opened, got a copy that a fork made")
        return turns
