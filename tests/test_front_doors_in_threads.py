"""Requests from several threads at once, of values that change under way, through every backend's front door.

Oracle: as in `test_front_doors`, what came out of the electrodes, looked at by a model that shares nothing with the
guard. Threads share a culture, limits, pulses, arrays and lists, and change them while others deliver them; they rest,
stop, close and open it, and change how often the interpreter switches between them.
"""

from __future__ import annotations

import sys
import threading
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from animat.errors import DeviceFailed, InvalidArgument, UnsafeStimulus
from animat.stimulation.pulse import Phase, Pulse
from animat.stimulation.stimulus import Stimulus
from test_front_doors import BACKENDS, Door, Out, Requests, breaches, end_of, left_over


class Lying(float):
    """A number that compares as if it were small."""

    def __abs__(self) -> float:
        return 0.0

    def __gt__(self, other: object) -> bool:
        return False

    def __le__(self, other: object) -> bool:
        return True


class ShowsAnother(Phase):
    """A phase that shows a small amplitude to whoever asks for `amplitude`."""

    @property
    def amplitude(self) -> float:
        return 0.01


class Changes(Stimulus):
    """A stimulus with other electrodes each time that they are asked for."""

    def __getattribute__(self, name: str) -> Any:
        if name == "electrodes":
            shown = object.__getattribute__(self, "__dict__").setdefault("shown", [0])
            shown[0] += 1
            return tuple(range(shown[0] % 7))
        return super().__getattribute__(name)


class Careless:
    """What a program with threads does by accident: shares what it asks for, and changes it meanwhile."""

    def __init__(self, requests: Requests, shared: list[Stimulus], seed: int) -> None:
        self.requests, self.shared, self.rng = requests, shared, np.random.default_rng([seed, 1])

    def next(self) -> tuple[Any, float]:
        """A request, and how long it takes."""
        rng = self.rng
        request: Any = self.requests.next()
        end_s = end_of(request)
        what = int(rng.integers(12))
        if what == 0:
            # Others put theirs into the same list, in any order, while it is delivered.
            self.shared[int(rng.integers(4))] = request[0]
            return self.shared, 0.02
        if what == 1:
            return iter(request), end_s
        if what == 2:
            request[0] = self.of_arrays(request[0])
        if what == 3:
            request[0] = Changes(**{name: getattr(request[0], name) for name in ("time_s", "electrodes", "pulse")})
        if what == 4:
            request[0] = self.of_lies(request[0])
        if what == 5:
            request[0] = replace(request[0], time_s=Lying(request[0].time_s))
        return request, end_s

    def of_arrays(self, stimulus: Stimulus) -> Stimulus:
        """The same of arrays and lists that become something else."""
        electrodes = np.array(stimulus.electrodes, dtype=np.int32)
        numbers = [np.array([p.duration_us, p.amplitude]) for p in stimulus.pulse.phases]
        unit = "amplitude_mv" if stimulus.pulse.kind == "voltage" else "amplitude_ua"
        phases = [Phase(n[0:1].reshape(()), **{unit: n[1:2].reshape(())}) for n in numbers]
        made = Stimulus(stimulus.time_s, electrodes, Pulse(phases))  # type: ignore[arg-type]
        electrodes += 1000
        for n in numbers:
            n *= 1000
        phases *= 3
        return made

    def of_lies(self, stimulus: Stimulus) -> Stimulus:
        """The same with amplitudes that look smaller than they are."""
        unit = "amplitude_mv" if stimulus.pulse.kind == "voltage" else "amplitude_ua"
        phases = tuple(ShowsAnother(p.duration_us, **{unit: Lying(p.amplitude)}) for p in stimulus.pulse.phases)
        return Stimulus(stimulus.time_s, stimulus.electrodes, Pulse(phases))


class Crowd:
    """Threads that ask one culture for stimuli, and what came of it."""

    def __init__(self, door: Door, number: int, seed: int) -> None:
        self.door, self.number, self.seed = door, number, seed
        self.counted: Counter[str] = Counter()
        self.sessions: list[list[Out]] = []
        self.wrong: list[str] = []
        self.shared: list[Stimulus] = []

    @property
    def refused_as_too_soon(self) -> int:
        """Requests that came too soon after others."""
        return sum(self.counted[limit] for limit in ("overlap", "gap_us", "interval_us", "stimuli_per_electrode_s"))

    def run(self, threads: int) -> None:
        """Let that many threads ask, each for its part."""
        culture = self.door.culture
        with culture:
            self.door.out()
            first = Requests(self.seed, culture.limits, culture.stimulation_electrodes)
            self.shared[:] = [first.next()[0] for _ in range(4)]
            crowd = []
            for which in range(threads):
                requests = Requests(self.seed, culture.limits, culture.stimulation_electrodes)
                requests.rng = np.random.default_rng([self.seed, which])
                careless = Careless(requests, self.shared, self.seed + which)
                part = self.number // threads + (which < self.number % threads)
                crowd.append(threading.Thread(target=self.ask, args=(careless, part, which == 0), daemon=True))
            for thread in crowd:
                thread.start()
            for thread in crowd:
                thread.join(3600)
                assert not thread.is_alive(), "a thread hangs"
        self.sessions.append(self.door.out())

    def ask(self, careless: Careless, number: int, opens: bool) -> None:
        culture, rng = self.door.culture, careless.rng
        counted: Counter[str] = Counter()
        for count in range(number):
            try:
                if count % 16 == 0:
                    sys.setswitchinterval(10 ** rng.uniform(-6, -2.3))
                if opens and count % 200 == 199:
                    self.open_anew(count % 400 == 399)
                if rng.random() < 0.5:
                    culture.rest(float(rng.choice([0.001, 0.004, 0.01, 0.05])))
                request, end_s = careless.next()
                since_s = culture.now_s if rng.random() < 0.2 else None
                culture.deliver(request, end_s, since_s=since_s)
                counted["done"] += 1
            except UnsafeStimulus as error:
                counted[error.limit] += 1
            except (InvalidArgument, DeviceFailed) as error:
                counted[type(error).__name__] += 1
            except BaseException as error:
                self.wrong.append(repr(error))
                return
        self.counted.update(counted)

    def open_anew(self, is_stopped: bool) -> None:
        """Close it while others deliver, and go on with another session."""
        culture = self.door.culture
        if is_stopped:
            culture.stop("in between")
        culture.close()
        # Nobody else opens it: what came out until now is one session's.
        self.sessions.append(self.door.out())
        culture.open()

    def breaches(self) -> list[str]:
        """Limits that what came out does not keep, in pace altogether, in charge and number session by session."""
        limits, sites = self.door.culture.limits, self.door.culture.stimulation_electrodes
        found = breaches([pulse for session in self.sessions for pulse in session], limits, sites)
        for session in self.sessions:
            found += left_over(session, limits, defaultdict(float))
            found += ["stimuli_per_session"] * (len({p.time_s for p in session}) > limits.stimuli_per_session)
        return found


@pytest.fixture
def patch() -> Iterator[pytest.MonkeyPatch]:
    before_s = sys.getswitchinterval()
    with pytest.MonkeyPatch.context() as context:
        yield context
    sys.setswitchinterval(before_s)


def crowd_at(
    kind: str, number: int, threads: int, seed: int, delivered: int, patch: pytest.MonkeyPatch, *, too_soon: int = 0
) -> None:
    """A crowd that asks again until more than `delivered` requests were delivered and `too_soon` refused as too soon.

    How many are depends on whose turn it is when the culture is stopped and opened anew.
    """
    crowd = Crowd(Door(kind, patch), number, seed)
    rounds = 0
    while (crowd.counted["done"] <= delivered or crowd.refused_as_too_soon <= too_soon) and rounds < 4:
        crowd.run(threads)
        crowd.seed, rounds = crowd.seed + 1000, rounds + 1
    assert crowd.wrong == []
    assert crowd.breaches() == []
    assert crowd.counted.total() == rounds * number
    assert crowd.counted["done"] > delivered
    assert crowd.refused_as_too_soon > too_soon


@pytest.mark.oracle
@pytest.mark.parametrize("kind", ["virtual", "maxone", "replay", "cl1"])
def test_from_several_threads_nothing_outside_the_limits_is_delivered(kind: str, patch: pytest.MonkeyPatch) -> None:
    crowd_at(kind, 2_500, 5, 1, 300, patch, too_soon=50)


@pytest.mark.parametrize(
    "threads",
    [
        *(pytest.param(n, marks=pytest.mark.oracle) for n in (2, 8)),
        *(pytest.param(n, marks=pytest.mark.long) for n in range(3, 8)),
    ],
)
@pytest.mark.parametrize("kind", BACKENDS)
def test_of_100000_requests_from_threads_none_outside_the_limits_is_delivered(
    kind: str, threads: int, patch: pytest.MonkeyPatch
) -> None:
    # Seven times as many on every backend, under both marks.
    crowd_at(kind, 14_300, threads, 10 + threads, 1_500, patch)
