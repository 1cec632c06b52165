"""How fast the closed loop decides, and whether it meets its deadlines, compared with an idle loop in the same run.

    python benchmarks/loop.py [--ticks 100000] [--minutes 10] [--json results.json]

Decision: from the end of the response window, when a culture of 1,024 channels has handed over its spikes, until the
next stimulus has passed the guard and is handed to the culture. In between are the extraction of the response, the
mapping, the robot's step, the log, the policy, the patterns and the safety limits. The reference is the jitter of the
machine: a loop that only waits for as long as a decision takes.

Closing: how long that session takes from its last tick until its recording is written, and its peak memory.

Deadlines: a session in real time at 80 Hz, where 2.4 ms are left from the window's end to the next pulse. At the same
time, on the same core, an idle loop in another process has the same deadlines: it sleeps until each window's end, and
then for as long as a decision takes. A miss of the loop alone is its own. A miss of both is the machine's (another
process, a hypervisor) if the loop's process had hardly run in between, which is measured too; a loop that computed for
that long would have kept the core from both.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import multiprocessing
import os
import resource
import tempfile
import time
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from animat.closed_loop.agents import Agent, Greedy
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.coding.mapping import mapping_named
from animat.cultures.base import Culture
from animat.cultures.observed import Observed, Spikes
from animat.cultures.safety import SIMULATED_LIMITS, Admitted, Limits
from animat.recordings.recording import Channels
from animat.responses.condition import Condition
from animat.robots import Cartpole
from animat.training.policy import Policy

CHANNELS = 1024
SPIKES = 300
"""Spikes in 10 ms: 1.5 times as many as 1,024 channels fire at 20 Hz each."""
PERIOD_S, WINDOW_S = 1 / 80, 0.0101
PAUSE_S = 0.1
DECISION_S = 0.001
"""Of the idle loop: longer than all but a few per cent of decisions after the core has slept."""
CONDITIONS = tuple(Condition(f"{hz} Hz", float(hz), "Hz") for hz in (5, 10, 20, 40, 80))


class Instant(Culture):
    """1,024 channels that answer instantly, from a store of spikes, and record when they are asked and answer."""

    name: ClassVar[str] = "instant"

    def __init__(self, deliveries: int) -> None:
        super().__init__()
        rng = np.random.default_rng(1)
        self._store = [Spikes(np.sort(rng.random(SPIKES) * 0.01), rng.integers(0, CHANNELS, SPIKES)) for _ in range(64)]
        self._now_ns = 0
        self.asked_ns, self.answered_ns = np.zeros(deliveries, np.int64), np.zeros(deliveries, np.int64)
        self.number = 0

    @property
    def channels(self) -> Channels:
        n = np.arange(CHANNELS)
        return Channels(label=n.astype(np.str_), electrode=n, x_um=17.5 * n, y_um=0.0 * n)

    @property
    def stimulation_electrodes(self) -> tuple[int, ...]:
        return tuple(range(32))

    @property
    def patterns(self) -> np.ndarray:
        rng = np.random.default_rng(2)
        return np.array([rng.choice(32, 5, replace=False) for _ in range(100)])

    @property
    def device_limits(self) -> Limits:
        return SIMULATED_LIMITS

    @property
    def now_s(self) -> float:
        return self._now_ns / 1e9

    @property
    def sampling_rate_hz(self) -> float:
        return 20_000.0

    @property
    def provenance(self) -> dict[str, str]:
        return {"source": "a store of random spikes"}

    def _open(self) -> None:
        pass

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        asked_ns = time.perf_counter_ns()
        number, self.number = self.number, self.number + 1
        start_s = self.now_s
        self._now_ns += round(duration_s * 1e9)
        first_s = admitted.stimuli[0].time_s if admitted.stimuli else 0.0
        stored = self._store[number % len(self._store)]
        spikes = Spikes(stored.time_s + first_s, stored.channel) if admitted.stimuli else Spikes(*_NOTHING)
        observed = Observed(start_s, duration_s, spikes, np.array([s.time_s for s in admitted.stimuli], np.float64))
        if number < len(self.asked_ns):
            self.asked_ns[number] = asked_ns
            self.answered_ns[number] = time.perf_counter_ns()
        return observed

    def _rest(self, duration_s: float) -> None:
        self._now_ns += round(duration_s * 1e9)

    def _halt(self) -> None:
        pass

    def _close(self) -> None:
        pass


_NOTHING = np.empty(0), np.empty(0, np.int64)


def policy() -> Policy:
    """Two hidden layers of 64 units, as in trained policies; weights are random, except the last condition's bias."""
    rng = np.random.default_rng(3)
    sizes = (4, 64, 64, 5)
    weights = tuple((rng.standard_normal((a, b)) / np.sqrt(a)).astype(np.float32) for a, b in itertools.pairwise(sizes))
    biases = (*(np.zeros(n, np.float32) for n in sizes[1:3]), np.array([0, 0, 0, 0, 1e6], np.float32))
    return Policy(
        weights,
        biases,
        np.ones(4, np.float32),
        Cartpole(),
        mapping_named("9-thresholds"),
        CONDITIONS,
        None,
        (2.0, 10.0),
    )


def loop_of(iterations: int, **settings: Any) -> Loop:
    """A loop whose robot never falls: an episode lasts as long as the measurement."""
    robot = Cartpole(angle_limit_rad=1e8, force_n=0.0, episode_limit=iterations)
    percentiles = np.linspace(0, 40, 11)
    settings = {"pause_s": PAUSE_S, "warm_up": 0, **settings}
    return Loop(robot, mapping_named("9-thresholds"), CONDITIONS, percentiles, **settings)


def decisions_us(ticks: int) -> tuple[np.ndarray, dict[str, float]]:
    """How long each decision took; and how long the session took to close after its last tick, with its peak memory."""
    with tempfile.TemporaryDirectory() as folder, Instant(ticks + 1) as culture:
        agent = Agent("policy", "random weights", Greedy(policy()))
        session = run_session(culture, loop_of(ticks), [agent], folder, episodes=1)
        closing = {
            "seconds": (time.perf_counter_ns() - int(culture.answered_ns[-1])) / 1e9,
            "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
            "log_mb": (Path(folder) / "session.log").stat().st_size / 1e6,
        }
        assert session.ending.by == "plan", session.ending
        assert session.outline.ticks == ticks
        # Number 0 is the pause; the first decision is made at its end.
        return (culture.asked_ns[1:] - culture.answered_ns[:-1]) / 1e3, closing


def idle_us(waits: int, length_us: float) -> np.ndarray:
    """How long a busy wait of `length_us` took."""
    took = np.empty(waits)
    now = time.perf_counter_ns
    for i in range(waits):
        began = now()
        while now() - began < 1e3 * length_us:
            pass
        took[i] = (now() - began) / 1e3
    return took


class OnOneCore(Instant):
    """Keeps the loop's thread, which is the caller, on one core, and publishes when each window will end."""

    def __init__(self, window_ends_s: Synchronized[float]) -> None:
        super().__init__(deliveries=0)
        self._window_ends_s = window_ends_s
        self._zero_s = 0.0
        self.ends_s: list[float] = []
        self.used_ms: list[float] = []

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        if self.number == 0:
            self._zero_s = time.perf_counter()
            stay_on_one_core()
        self.used_ms.append(1e3 * time.process_time())
        observed = super()._deliver(admitted, duration_s)
        self.ends_s.append(self._zero_s + self.now_s)
        self._window_ends_s.value = self.ends_s[-1]
        return observed


def stay_on_one_core() -> None:
    """Pin the calling thread, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def idle_loop(parent: Connection, window_ends_s: Synchronized[float]) -> None:
    """Meet the deadlines of a session with nothing to do; send how late it was, in ms, after each window's end."""
    stay_on_one_core()
    gc.disable()
    late: dict[float, float] = {}
    parent.send("ready")
    before_s = 0.0
    while not parent.poll():
        end_s = window_ends_s.value
        if end_s == before_s:
            time.sleep(0.001)
            continue
        before_s = end_s
        for until_s in (end_s, end_s + DECISION_S):
            # No busy wait: the measured loop needs the core just then.
            time.sleep(max(0.0, until_s - time.perf_counter()))
        late[end_s] = 1e3 * max(0.0, time.perf_counter() - (end_s - WINDOW_S + PERIOD_S))
        time.sleep(0.004)
    parent.send(late)


def late_ms(ticks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each pulse of a session in real time at 80 Hz: how late it came, how late an idle loop was at the same time,
    and for how long the session's process had run since the previous pulse, all in ms."""
    spawning = multiprocessing.get_context("spawn")
    here, there = spawning.Pipe()
    window_ends_s = spawning.Value("d", 0.0)
    idle = spawning.Process(target=idle_loop, args=(there, window_ends_s), daemon=True)
    idle.start()
    here.recv()
    with tempfile.TemporaryDirectory() as folder, OnOneCore(window_ends_s) as culture:
        agent = Agent("policy", "random weights", Greedy(policy()))
        session = run_session(culture, loop_of(ticks, real_time=True), [agent], folder, episodes=1)
        assert session.ending.by == "plan", session.ending
        # Ticks are read from the log, which is deleted with the folder.
        late = np.array([1e3 * tick.late_s for tick in session.ticks])
        assert len(late) == ticks
    here.send("over")
    idle_late = here.recv()
    # A window's end that the idle loop never saw, it overslept. The first pulse is an interval after the pause.
    ends_s = culture.ends_s[1:-1]
    return late[1:], np.array([idle_late.get(end_s, 1e3 * PERIOD_S) for end_s in ends_s]), np.diff(culture.used_ms)[1:]


def outline(us: np.ndarray) -> dict[str, float]:
    """Percentiles."""
    return {
        "median": float(np.median(us)),
        "p99": float(np.percentile(us, 99)),
        "p99.9": float(np.percentile(us, 99.9)),
        "largest": float(us.max()),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else None)
    parser.add_argument("--ticks", type=int, default=100_000)
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the session in real time; 0 skips it")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()

    decisions, closing = decisions_us(options.ticks)
    decided = outline(decisions)
    idle = outline(idle_us(options.ticks, decided["median"]))
    print(f"from the window's end to the next stimulus, {CHANNELS} channels, {options.ticks:,} ticks (us)")
    print(f"  {'':24} {'median':>8} {'p99':>8} {'p99.9':>8} {'largest':>9}")
    for name, us in (("closed loop", decided), ("idle, the same median", idle)):
        print(f"  {name:24} {us['median']:8.1f} {us['p99']:8.1f} {us['p99.9']:8.1f} {us['largest']:9.1f}", flush=True)
    print(
        f"from the last tick until log, recording and table are closed: {closing['seconds']:.2f} s for "
        f"{closing['log_mb']:.0f} MB of log; peak memory of the process {closing['peak_mb']:.0f} MB",
        flush=True,
    )
    measured: dict[str, Any] = {"decision_us": decided, "idle_us": idle, "closing": closing, "ticks": options.ticks}

    if options.minutes > 0:
        late, idle_late, used = late_ms(round(60 * options.minutes / PERIOD_S))
        alone = (late > 0) & ~(idle_late > 0)
        print(f"deadlines at 80 Hz in {options.minutes:g} min of real time, an idle loop on the same core meanwhile")
        for name, each in (("closed loop", late), ("idle loop", idle_late)):
            measured[f"deadlines, {name}"] = {"missed": int(np.sum(each > 0)), "of": len(each), "latest_ms": each.max()}
            print(f"  {name:24} {np.sum(each > 0):6} missed of {len(each):,}; the latest by {each.max():.2f} ms")
        measured["deadlines, closed loop alone"] = {"missed": int(np.sum(alone)), "late_ms": late[alone].tolist()}
        print(f"  {'closed loop alone':24} {np.sum(alone):6} missed that the idle loop did not miss")
        for name, each in (("missed", used[late > 0]), ("in time", used[late == 0])):
            if len(each):
                measured[f"process time, {name}"] = {"median_ms": np.median(each), "largest_ms": each.max()}
                print(
                    f"  before a pulse that was {name} the process had run {np.median(each):.2f} ms (median), at most "
                    f"{each.max():.2f} ms, of {1e3 * PERIOD_S:g}"
                )
    if options.json:
        options.json.write_text(json.dumps(measured, indent=1) + "\n")


if __name__ == "__main__":
    main()
