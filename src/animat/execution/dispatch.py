"""Dispatch of calls to the workers of a Dask cluster: assignment, batches of small calls, and retries.

Dask only transports calls and answers: it would blame a worker's death on all calls that the worker had been given.
"""

from __future__ import annotations

import asyncio
import pickle
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from animat.execution.dask_worker import PLACE_PREFIX, CallResult, topic_of, work

ATTEMPTS = 3
"""How often a call may fail, or its process end, before this is reported."""
LONGEST_S = 30.0
"""Longest expected duration of a batch."""
_SMALL_S = 3.0
"""Calls expected to take less than this are batched, as sending one takes some hundredths of a second."""
_LOOK_EVERY_S = 1.0
_SILENT_S = 60.0
"""Silence after which a worker, or the scheduler, is considered frozen."""


@dataclass(eq=False)
class Call:
    """A call that waits or runs, how often it has failed, and how often its process or worker ended (`deaths`).

    Attributes:
        pickled: returns the pickled function, arguments and keyword arguments for a worker with this folder.
        reads: files that are sent along, by the digests under which they are stored.
        finish: function applied here to the returned value.
    """

    name: str
    pickled: Callable[[Path], bytes]
    cost_s: float | None = None
    reads: Mapping[str, Path] = field(default_factory=dict)
    finish: Callable[[Any], Any] | None = None
    future: Future[Any] = field(default_factory=Future)
    failures: int = 0
    deaths: int = 0


@dataclass(eq=False)
class _Batch:
    """Calls that are done one after the other; `done` of them are done, and `answered` have been answered.

    `has_begun` is set when the place is lost: a batch that must run alone has not begun while others run.
    """

    calls: list[Call]
    is_alone: bool
    place: _Place
    done: int = 0
    answered: int = 0
    has_begun: bool = True


@dataclass(eq=False)
class _Place:
    """A worker from its start to its end: a worker that replaces it is a new place."""

    address: str
    resource: str
    threads: int
    folder: Path
    lost: asyncio.Future[str] = field(default_factory=lambda: asyncio.get_running_loop().create_future())
    batches: list[_Batch] = field(default_factory=list)
    stored: set[str] = field(default_factory=set)
    last_seen: float = 0.0
    heard_s: float = field(default_factory=time.monotonic)

    @property
    def free(self) -> int:
        """The calls or batches that it has room for."""
        return 0 if any(batch.is_alone for batch in self.batches) else self.threads - len(self.batches)


@final
class Dispatch:
    """A client's calls, and where they run; everything but `submit` happens in the client's own thread.

    A call whose process or worker ended runs alone on a worker from then on, so that neither it nor another call is
    blamed for the other's death. Of the workers, those that `usable_of` returns get work.
    """

    def __init__(self, client: Any, usable_of: Callable[[dict[str, Any]], dict[str, Any]], longest_s: float) -> None:
        self._client, self._usable_of, self._longest_s = client, usable_of, longest_s
        self._waiting: deque[Call] = deque()
        self._places: dict[str, _Place] = {}
        self._batches: dict[str, _Batch] = {}
        self._running: set[asyncio.Task[None]] = set()
        self._expected_s = self._took_s = 1.0
        self._has_ended, self._is_silent, self._waits_for_workers = False, False, True
        client.loop.add_callback(self._begin)

    def submit(self, call: Call) -> None:
        """Submit a call, from any thread."""
        self._client.loop.add_callback(self._enqueue, call)

    def close(self) -> None:
        """Stop dispatching."""
        self._has_ended = True

    async def _begin(self) -> None:
        self._client.subscribe_topic(topic_of(self._client.id), self._on_call_done)
        while not self._has_ended:
            try:
                await self._poll_workers()
            except Exception as error:
                self._end(error)
            await asyncio.sleep(_LOOK_EVERY_S)

    def _enqueue(self, call: Call) -> None:
        if self._has_ended:
            _give_up([call])
        else:
            self._waiting.append(call)
            self._assign()

    async def _poll_workers(self) -> None:
        info = None
        with suppress(TimeoutError, OSError):
            if self._client.status == "running":
                info = await asyncio.wait_for(self._client.scheduler.identity(n_workers=-1), _SILENT_S)
        if self._client.status != "running":
            self._end()
        elif info is not None:
            self._is_silent = False
            self._update_places(self._usable_of(info["workers"]))
        elif not self._is_silent:
            self._is_silent = True
            _warn(f"the scheduler has not answered for {_SILENT_S:.0f} s; waiting for it")

    def _update_places(self, usable: dict[str, Any]) -> None:
        """Take note of the workers that came, ended, froze or continue."""
        workers = {}
        for address, worker in usable.items():
            resource = next(name for name in worker["resources"] if name.startswith(PLACE_PREFIX))
            workers[resource] = address, worker
        for resource in self._places.keys() - workers.keys():
            self._mark_lost(self._places.pop(resource), "ended")
        for resource, (address, worker) in workers.items():
            if resource not in self._places:
                folder = Path(worker["local_directory"])
                self._places[resource] = _Place(address, resource, worker["nthreads"], folder)
            place = self._places[resource]
            if worker["last_seen"] != place.last_seen:
                place.last_seen, place.heard_s = worker["last_seen"], time.monotonic()
                if place.lost.done():
                    # It was frozen, and continues.
                    place.lost = asyncio.get_running_loop().create_future()
            elif time.monotonic() - place.heard_s > _SILENT_S:
                self._mark_lost(place, f"has been silent for {_SILENT_S:.0f} s (frozen, or cut off)")
        if self._waiting and not self._places and not self._waits_for_workers:
            print("cluster: waiting for workers", file=sys.stderr)
        self._waits_for_workers = not self._places
        self._assign()

    def _mark_lost(self, place: _Place, reason: str) -> None:
        if not place.lost.done():
            for batch in place.batches:
                batch.has_begun = not batch.is_alone or all(other.is_alone for other in place.batches)
            place.lost.set_result(reason)
            n = sum(len(batch.calls) - batch.answered for batch in place.batches)
            _warn(f"worker {place.address} {reason}; its tasks ({n}) go to others")

    def _assign(self) -> None:
        while self._waiting and not self._has_ended:
            ready = [place for place in self._places.values() if place.free > 0 and not place.lost.done()]
            if not ready:
                return
            calls = self._next_calls()
            if calls:
                place = max(ready, key=lambda place: place.free)
                place.batches.append(_Batch(calls, calls[0].deaths > 0, place))
                task = asyncio.create_task(self._run(place.batches[-1]))
                self._running.add(task)
                task.add_done_callback(self._running.discard)

    def _next_calls(self) -> list[Call]:
        """The first waiting call; if it is small, further small ones, leaving enough for the other workers."""
        shares = 2 * sum(place.threads for place in self._places.values())
        waiting_s = 0.0
        for call in self._waiting:
            waiting_s += self._expected_s_of(call)
            if waiting_s > shares * self._longest_s:
                # Thousands may be waiting.
                break
        # If little is waiting, less is taken, so that all cores finish together.
        most_s = min(self._longest_s, waiting_s / shares)
        calls: list[Call] = []
        total_s = 0.0
        while self._waiting:
            call = self._waiting[0]
            is_small = self._expected_s_of(call) < _SMALL_S and not call.deaths
            if calls and not (is_small and total_s + self._expected_s_of(call) <= most_s):
                break
            self._waiting.popleft()
            if not call.future.done():
                calls.append(call)
                total_s += self._expected_s_of(call)
                if not is_small:
                    break
        return calls

    def _expected_s_of(self, call: Call) -> float:
        """The expected duration of a call, by the ratio of actual to expected durations so far."""
        return _SMALL_S if call.cost_s is None else call.cost_s * self._took_s / self._expected_s

    async def _run(self, batch: _Batch) -> None:
        try:
            await self._send(batch)
        except Exception as error:
            _give_up(batch.calls, error)
        batch.place.batches.remove(batch)
        self._assign()

    async def _send(self, batch: _Batch) -> None:
        place = batch.place
        needed = {digest: path for call in batch.calls for digest, path in call.reads.items()}
        with warnings.catch_warnings():
            # Dask warns of large messages.
            warnings.simplefilter("ignore", UserWarning)
            future = self._client.submit(
                work,
                [call.pickled(place.folder) for call in batch.calls],
                self._client.id,
                self._longest_s,
                {digest: path.read_bytes() for digest, path in needed.items() if digest not in place.stored},
                resources={place.resource: place.threads if batch.is_alone else 1},
                pure=False,
            )
        self._batches[future.key] = batch

        def cancel_if_unwanted(_: object) -> None:
            if all(call.future.cancelled() for call in batch.calls[batch.answered :]):
                self._client.loop.add_callback(future.cancel)

        for call in batch.calls:
            call.future.add_done_callback(cancel_if_unwanted)
        answers = asyncio.ensure_future(future)
        await asyncio.wait({answers, place.lost}, return_when=asyncio.FIRST_COMPLETED)
        del self._batches[future.key]
        left = batch.calls[batch.answered :]
        if not answers.done():
            await future.cancel()
            answers.cancel()
            if batch.has_begun:
                _count_death(left[batch.done - batch.answered], f"worker {place.address} {place.lost.result()}")
        elif answers.cancelled() or answers.exception() is not None:
            self._handle_failure(left, answers)
        else:
            place.stored |= needed.keys()
            # The last ones may not have been begun.
            for call, answer in zip(left, answers.result()[batch.answered :], strict=False):
                self._answer(call, pickle.loads(answer))
        self._waiting.extendleft(call for call in reversed(left) if not call.future.done())

    def _handle_failure(self, left: Sequence[Call], answers: asyncio.Future[Any]) -> None:
        """Handle a batch that was not done: the scheduler or the worker ended, or it could not be sent."""
        error = None if answers.cancelled() else answers.exception()
        if type(error).__name__ == "KilledWorker":
            _count_death(left[0], "its worker ended")
        elif error is not None and "Cancelled" not in type(error).__name__:
            _give_up(left, error)
        elif self._client.status != "running":
            self._end()
        if self._has_ended:
            _give_up(left)

    async def _on_call_done(self, event: tuple[float, dict[str, Any]]) -> None:
        _, message = event
        batch = self._batches.get(message["batch"])
        if batch is None:
            return
        batch.done = message["number"] + 1
        batch.place.stored.update(*(call.reads for call in batch.calls))
        # A large answer arrives only with the whole batch.
        if message["number"] == batch.answered and message["answer"] is not None:
            # One that cannot be read arrives with the whole batch again, which then fails.
            answer = pickle.loads(message["answer"])
            batch.answered += 1
            call = batch.calls[message["number"]]
            self._answer(call, answer)
            if not call.future.done():
                self._waiting.appendleft(call)

    def _answer(self, call: Call, answer: CallResult) -> None:
        """Set a call's result, unless it is to be tried again."""
        if call.cost_s is not None:
            self._expected_s += call.cost_s
            self._took_s += answer.took_s
        if answer.ended is not None:
            _count_death(call, answer.ended)
            if not call.future.done():
                _warn(f"{call.name}: {answer.ended}; trying again")
        elif answer.error is not None and call.failures + 1 < ATTEMPTS:
            call.failures += 1
        else:
            try:
                value = answer.value if call.finish is None or answer.error is not None else call.finish(answer.value)
                _settle(call, value, answer.error)
            except Exception as error:
                # Any error is passed on, as somebody is waiting.
                _settle(call, error=error)

    def _end(self, error: Exception | None = None) -> None:
        """Give up all calls, as the scheduler has ended, or with an unexpected error."""
        self._has_ended = True
        _give_up([*self._waiting, *(call for batch in self._batches.values() for call in batch.calls)], error)
        self._waiting.clear()


def _give_up(calls: Sequence[Call], error: BaseException | None = None) -> None:
    """End calls that are not done with an error, or cancel them."""
    for call in calls:
        if error is not None:
            _settle(call, error=error)
        elif not call.future.done() and call.future.cancel():
            # Needed to wake those who wait for the future.
            call.future.set_running_or_notify_cancel()


def _count_death(call: Call, reason: str) -> None:
    """Count that a call's process or worker ended while it was running; after `ATTEMPTS` times the call fails."""
    call.deaths += 1
    if call.deaths == ATTEMPTS:
        _settle(call, error=BrokenExecutor(f"its process or worker ended {ATTEMPTS} times, last: {reason}"))


def _settle(call: Call, value: Any = None, error: BaseException | None = None) -> None:
    # It may have been cancelled in the meantime.
    with suppress(InvalidStateError):
        if error is None:
            call.future.set_result(value)
        else:
            call.future.set_exception(error)


def _warn(message: str) -> None:
    print(f"warning: cluster: {message}", file=sys.stderr)
