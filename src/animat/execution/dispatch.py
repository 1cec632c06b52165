"""Handing calls to the workers of a Dask cluster: which worker gets which, small ones in batches, and who is to blame.

Dask carries calls and answers. It neither chooses workers nor tries again: it would blame the death of a worker on all
that the worker had been given.
"""

from __future__ import annotations

import asyncio
import contextlib
import pickle
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future, InvalidStateError
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from animat.errors import AnimatError
from animat.execution.dask_worker import PLACE, Answer, topic_of, work

ATTEMPTS = 3
"""How often a call may fail, or its process end, before that is reported."""
LONGEST_S = 30.0
"""Of a batch."""
_SMALL_S = 3.0
"""What is expected to take less is batched: to hand over takes some hundredths of a second."""
_LOOK_EVERY_S = 1.0
_SILENT_S = 60.0
"""After which a worker, or the scheduler, is taken for frozen."""


@dataclass(eq=False)
class Call:
    """A call that waits or runs.

    Attributes:
        name: what it is called in messages.
        pickled: function, arguments and named ones, for a worker with this folder of its own.
        cost_s: about how long it takes; None if nobody knows.
        reads: files that are sent along, by what they are stored under.
        finish: what is done here with what it returns.
        future: what becomes of it.
        failures, deaths: how often it failed, and how often its process or its worker ended.
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
    """Calls that are done one after the other: so many are done, and of so many of these the answer is here.

    `has_begun`, when its place is lost: one that is to be alone has not, while others run.
    """

    calls: list[Call]
    is_alone: bool
    place: _Place
    done: int = 0
    answered: int = 0
    has_begun: bool = True


@dataclass(eq=False)
class _Place:
    """A worker from its start to its end: another one that is started in its place is another place."""

    address: str
    resource: str
    threads: int
    folder: Path
    lost: asyncio.Future[str]
    batches: list[_Batch] = field(default_factory=list)
    stored: set[str] = field(default_factory=set)
    last_seen: float = 0.0
    heard_s: float = field(default_factory=time.monotonic)

    @property
    def free(self) -> int:
        return 0 if any(batch.is_alone for batch in self.batches) else self.threads - len(self.batches)


@final
class Dispatch:
    """What a client has handed in, and where it runs; all in the client's own thread, but for `submit`.

    A call whose process or worker ended runs alone on a worker from then on, so that no other is blamed for its death,
    nor it for another's.

    Args:
        client: Dask's.
        are_ours: is given the workers, as the scheduler knows them, and returns those that may have work.
        longest_s: of a batch; 0 for no batches.
    """

    def __init__(
        self, client: Any, are_ours: Callable[[dict[str, Any]], dict[str, Any]], longest_s: float = LONGEST_S
    ) -> None:
        self._client, self._are_ours, self._longest_s = client, are_ours, longest_s
        self._waiting: deque[Call] = deque()
        self._places: dict[str, _Place] = {}
        self._batches: dict[str, _Batch] = {}
        self._carried: set[asyncio.Task[None]] = set()
        self._expected_s = self._took_s = 1.0
        self._has_ended, self._is_silent, self._waits_for_workers = False, False, True
        client.loop.add_callback(self._begin)

    def submit(self, call: Call) -> None:
        """Take a call, from any thread."""
        self._client.loop.add_callback(self._take, call)

    def close(self) -> None:
        """Ask nothing more of anybody."""
        self._has_ended = True

    async def _begin(self) -> None:
        self._client.subscribe_topic(topic_of(self._client.id), self._hear)
        while not self._has_ended:
            try:
                await self._look()
            except Exception as error:
                return self._end(error)
            await asyncio.sleep(_LOOK_EVERY_S)
        return None

    def _take(self, call: Call) -> None:
        if self._has_ended:
            _cancel(call)
        else:
            self._waiting.append(call)
            self._hand_out()

    async def _look(self) -> None:
        """See which workers there are."""
        if self._client.status != "running":
            return self._end()
        try:
            info = await asyncio.wait_for(self._client.scheduler.identity(n_workers=-1), _SILENT_S)
        except (TimeoutError, OSError):
            if self._client.status != "running":
                return self._end()
            if not self._is_silent:
                _warn(f"the scheduler has not answered for {_SILENT_S:.0f} s; waiting for it")
            self._is_silent = True
            return None
        self._is_silent = False
        found = {}
        for address, worker in self._are_ours(info["workers"]).items():
            resource = next(name for name in worker["resources"] if name.startswith(PLACE))
            found[resource] = address, worker
        for resource in self._places.keys() - found.keys():
            self._lose(self._places.pop(resource), "ended")
        for resource, (address, worker) in found.items():
            self._see(resource, address, worker)
        if self._waiting and not self._places and not self._waits_for_workers:
            print("cluster: waiting for workers", file=sys.stderr)
        self._waits_for_workers = not self._places
        self._hand_out()
        return None

    def _see(self, resource: str, address: str, worker: dict[str, Any]) -> None:
        place = self._places.get(resource)
        if place is None:
            lost = asyncio.get_running_loop().create_future()
            place = self._places[resource] = _Place(
                address, resource, worker["nthreads"], Path(worker["local_directory"]), lost
            )
        if worker["last_seen"] != place.last_seen:
            place.last_seen, place.heard_s = worker["last_seen"], time.monotonic()
            if place.lost.done():
                # It was frozen, and goes on.
                place.lost = asyncio.get_running_loop().create_future()
        elif time.monotonic() - place.heard_s > _SILENT_S and not place.lost.done():
            self._lose(place, f"has been silent for {_SILENT_S:.0f} s (frozen, or cut off)")

    def _lose(self, place: _Place, words: str) -> None:
        if not place.lost.done():
            for batch in place.batches:
                batch.has_begun = not batch.is_alone or all(other.is_alone for other in place.batches)
            place.lost.set_result(words)
            n = sum(len(batch.calls) - batch.answered for batch in place.batches)
            _warn(f"worker {place.address} {words}; its tasks ({n}) go to others")

    def _hand_out(self) -> None:
        while self._waiting and not self._has_ended:
            ready = [place for place in self._places.values() if place.free > 0 and not place.lost.done()]
            if not ready:
                return
            calls = self._next_calls()
            if calls:
                place = max(ready, key=lambda place: place.free)
                place.batches.append(_Batch(calls, calls[0].deaths > 0, place))
                task = asyncio.create_task(self._carry(place.batches[-1]))
                self._carried.add(task)
                task.add_done_callback(self._carried.discard)

    def _next_calls(self) -> list[Call]:
        """The first call that waits; if it is small, with others, of which enough are left for all."""
        most_s = self._share_s()
        calls: list[Call] = []
        together_s = 0.0
        while self._waiting:
            call = self._waiting[0]
            small = self._expect_s(call) < _SMALL_S and not call.deaths
            if calls and not (small and together_s + self._expect_s(call) <= most_s):
                break
            self._waiting.popleft()
            if call.future.cancelled():
                continue
            calls.append(call)
            together_s += self._expect_s(call)
            if not small:
                break
        return calls

    def _share_s(self) -> float:
        """How long a batch is to take: less where little waits, that all cores end at about the same time."""
        threads = sum(place.threads for place in self._places.values())
        waiting_s = 0.0
        for call in self._waiting:
            waiting_s += self._expect_s(call)
            if waiting_s > 2 * threads * self._longest_s:
                break
        return min(self._longest_s, waiting_s / (2 * threads))

    def _expect_s(self, call: Call) -> float:
        """How long a call takes, by what others took of what was expected of them."""
        return _SMALL_S if call.cost_s is None else call.cost_s * self._took_s / self._expected_s

    async def _carry(self, batch: _Batch) -> None:
        """Have a batch done at its place, and see what came of it."""
        try:
            await self._have_done(batch)
        except Exception as error:
            # Whatever it is, somebody waits.
            for call in batch.calls:
                _settle(call, error=error)
        batch.place.batches.remove(batch)
        self._hand_out()

    async def _have_done(self, batch: _Batch) -> None:
        place = batch.place
        needed = {stored: path for call in batch.calls for stored, path in call.reads.items()}
        with warnings.catch_warnings():
            # Of much that is sent.
            warnings.simplefilter("ignore", UserWarning)
            future = self._client.submit(
                work,
                [call.pickled(place.folder) for call in batch.calls],
                self._client.id,
                self._longest_s,
                {stored: path.read_bytes() for stored, path in needed.items() if stored not in place.stored},
                resources={place.resource: place.threads if batch.is_alone else 1},
                pure=False,
            )
        self._batches[future.key] = batch

        def let_go(_: object) -> None:
            if all(call.future.cancelled() for call in batch.calls[batch.answered :]):
                self._client.loop.add_callback(future.cancel)

        for call in batch.calls:
            call.future.add_done_callback(let_go)
        answers = asyncio.ensure_future(future)
        await asyncio.wait({answers, place.lost}, return_when=asyncio.FIRST_COMPLETED)
        del self._batches[future.key]
        left = deque(batch.calls[batch.answered :])
        if not answers.done():
            await future.cancel()
            answers.cancel()
            if batch.has_begun:
                self._blame(left, f"worker {place.address} {place.lost.result()}", batch.done - batch.answered)
        elif answers.cancelled() or answers.exception() is not None:
            self._see_why(left, answers)
        else:
            place.stored |= needed.keys()
            for answer in answers.result()[batch.answered :]:
                self._answer(left.popleft(), pickle.loads(answer))
        self._waiting.extendleft(reversed(left))

    def _see_why(self, left: deque[Call], answers: asyncio.Future[Any]) -> None:
        """Why a batch was not done: the scheduler ended, the worker did, or it could not be sent."""
        error = None if answers.cancelled() else answers.exception()
        if type(error).__name__ == "KilledWorker":
            self._blame(left, "its worker ended")
        elif error is None or "Cancelled" in type(error).__name__:
            if self._client.status != "running":
                self._end()
            while left and (self._has_ended or left[0].future.cancelled()):
                _cancel(left.popleft())
        else:
            while left:
                _settle(left.popleft(), error=error)

    def _blame(self, left: deque[Call], words: str, running: int = 0) -> None:
        """The one that ran when its process or worker ended is tried again, or reported."""
        call = left[running]
        call.deaths += 1
        if call.deaths == ATTEMPTS:
            _settle(call, error=BrokenExecutor(f"what it ran on ended {ATTEMPTS} times, at last: {words}"))
            del left[running]

    async def _hear(self, event: tuple[float, dict[str, Any]]) -> None:
        """A call of a batch was done."""
        _, words = event
        batch = self._batches.get(words["batch"])
        if batch is None:
            return
        batch.done = words["number"] + 1
        batch.place.stored.update(*(call.reads for call in batch.calls))
        # Of a large one the answer comes with the batch's.
        if words["number"] == batch.answered and words["answer"] is not None:
            batch.answered += 1
            self._answer(batch.calls[words["number"]], pickle.loads(words["answer"]))

    def _answer(self, call: Call, answer: Answer) -> None:
        if call.cost_s is not None:
            self._expected_s += call.cost_s
            self._took_s += answer.took_s
        left = deque([call])
        if answer.ended is not None:
            self._blame(left, answer.ended)
            if left:
                _warn(f"{call.name}: {answer.ended}; it is tried again")
        elif answer.error is not None and call.failures + 1 < ATTEMPTS:
            call.failures += 1
        else:
            left.clear()
            try:
                value = answer.value if call.finish is None or answer.error is not None else call.finish(answer.value)
                _settle(call, value, answer.error)
            except AnimatError as error:
                _settle(call, error=error)
        self._waiting.extendleft(left)

    def _end(self, error: Exception | None = None) -> None:
        """Nothing more comes of anything: the scheduler has ended, or something that nobody foresaw."""
        self._has_ended = True
        for call in (*self._waiting, *(call for batch in self._batches.values() for call in batch.calls)):
            if error is None:
                _cancel(call)
            else:
                _settle(call, error=error)
        self._waiting.clear()


def _cancel(call: Call) -> None:
    if not call.future.done() and call.future.cancel():
        # Only then does whoever waits for it hear of it.
        call.future.set_running_or_notify_cancel()


def _settle(call: Call, value: Any = None, error: BaseException | None = None) -> None:
    # It may have been cancelled meanwhile.
    with contextlib.suppress(InvalidStateError):
        if error is None:
            call.future.set_result(value)
        else:
            call.future.set_exception(error)


def _warn(words: str) -> None:
    print(f"warning: cluster: {words}", file=sys.stderr)
