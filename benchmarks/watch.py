"""How soon the page shows a pulse, how it affects the loop's deadlines, and how much memory the browser takes.

    python benchmarks/watch.py [--minutes 10] [--turns 3] [--browser chromium] [--json results.json]

A session of `loop.py` in real time at 80 Hz, 1,024 channels, in its own process; the page's server as `--watch` starts
it; and headless Chromium with the page open. First `--turns` turns of a minute without and a minute with the page:
deadlines missed, and how late pulses were. Then a session of `--minutes` minutes with the page: the delay from each
pulse to the frame that first shows its tick, and every minute the page's memory.

It needs Chromium, chromedriver and selenium. `--browser "chrt --idle 0 chromium"` gives the browser only idle processor
time.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from animat.closed_loop.agents import Agent, Greedy
from animat.closed_loop.running import run_session
from animat.cultures.observed import Observed
from animat.cultures.safety import Admitted
from loop import PERIOD_S, Instant, loop_of, policy

PULSES, REPORT = "pulses.npy", "late_ms.npy"
_NOTE_FRAMES = """
window.shown = [];
const now = document.getElementById("main");
new MutationObserver(() => {
  const tick = Number(document.querySelector("#now dd")?.textContent.replaceAll(",", ""));
  const before = window.shown.at(-1)?.[1] ?? -1;
  if (tick > before) requestAnimationFrame(() => window.shown.push([Date.now() / 1000, tick]));
}).observe(now, { childList: true, subtree: true });
"""


class Timed(Instant):
    """Records the wall-clock time of each pulse."""

    def __init__(self) -> None:
        super().__init__(deliveries=0)
        self.given_s: list[float] = []

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        if admitted.stimuli:
            self.given_s.append(time.time())
        return super()._deliver(admitted, duration_s)


def run(folder: Path, ticks: int) -> None:
    """Run a session in real time; save in its folder when its pulses were given, and how late."""
    with Timed() as culture:
        agent = Agent("policy", "random weights", Greedy(policy()))
        session = run_session(culture, loop_of(ticks, real_time=True), [agent], folder, episodes=1)
    assert session.ending.by == "plan", session.ending
    np.save(folder / REPORT, [1e3 * (tick.late_s or 0.0) for tick in list(session.ticks)[1:]])
    np.save(folder / PULSES, [(tick.number, at) for tick, at in zip(session.ticks, culture.given_s, strict=True)])


@contextmanager
def browser_with(command: str, address: str) -> Iterator[webdriver.Chrome]:
    """A browser that shows an address."""
    with tempfile.TemporaryDirectory() as folder:
        # The driver starts a single program and cannot put our arguments before its own.
        program = Path(folder) / "browser"
        program.write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        program.chmod(0o755)
        options = webdriver.ChromeOptions()
        options.binary_location = str(program)
        for each in ("--headless=new", "--no-sandbox", "--window-size=1400,1000", "--enable-precise-memory-info"):
            options.add_argument(each)
        driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        try:
            driver.get(address)
            driver.execute_script(_NOTE_FRAMES)
            yield driver
        finally:
            driver.quit()


@contextmanager
def page_of(folder: Path, command: str) -> Iterator[webdriver.Chrome]:
    """The page's server, started as by a command, and a browser that shows the page."""
    command_line = [sys.executable, "-m", "animat.watch", str(folder), str(os.getpid())]
    with subprocess.Popen(command_line, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            with browser_with(command, server.stdout.readline().strip()) as driver:
                yield driver
        finally:
            server.kill()


def memory(driver: webdriver.Chrome) -> dict[str, float]:
    """Memory in MB after a garbage collection, of the page's scripts and of its renderer process; and its nodes."""
    driver.execute_cdp_cmd("HeapProfiler.collectGarbage", {})
    nodes = driver.execute_cdp_cmd("Memory.getDOMCounters", {})["nodes"]
    heap = driver.execute_script("return performance.memory.usedJSHeapSize")
    drawing = 0
    for each in Path("/proc").glob("[0-9]*"):
        try:
            if b"--type=renderer" in (each / "cmdline").read_bytes():
                kb = (line.split()[1] for line in (each / "status").read_text().splitlines() if "VmRSS" in line)
                drawing = max(drawing, *map(int, kb))
        except (OSError, TypeError):
            continue
    return {"scripts_mb": heap / 1e6, "drawing_mb": drawing / 1e3, "nodes": nodes}


def watched(minutes: float, command: str | None) -> dict[str, Any]:
    """Run one session, with the page in a browser or without."""
    with tempfile.TemporaryDirectory() as folder:
        ticks = round(60 * minutes / PERIOD_S)
        with nullcontext() if command is None else page_of(Path(folder), command) as driver:
            loop = subprocess.Popen([sys.executable, __file__, "--session", folder, "--ticks", str(ticks)])
            held = []
            while driver is not None and loop.poll() is None:
                try:
                    loop.wait(60)
                except subprocess.TimeoutExpired:
                    held.append(memory(driver))
            if loop.wait():
                raise SystemExit("the session failed")
            shown = [] if driver is None else np.array(driver.execute_script("return window.shown"))
        late = np.load(Path(folder) / REPORT)
        found: dict[str, Any] = {
            "missed": int(np.sum(late > 0)), "of": len(late), "late_p99.9_ms": float(np.percentile(late, 99.9)),
        }  # fmt: skip
        if driver is not None:
            number, given_s = np.load(Path(folder) / PULSES).T
            # The first frame that shows a tick or a later one. The page did not show what came before it opened.
            at = np.searchsorted(shown[:, 1], number)
            seen = (at < len(shown)) & (number > shown[0, 1])
            took = shown[at[seen], 0] - given_s[seen]
            percentiles = dict(zip(("median", "p95", "p99.9"), np.percentile(took, (50, 95, 99.9)), strict=True))
            found |= {"shown_after_s": {**percentiles, "largest": took.max()}, "n_shown": len(took), "memory": held}
            found["over_half_a_second"] = int(np.sum(took > 0.5))
        return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the long session; 0 skips it")
    parser.add_argument("--turns", type=int, default=3, help="turns of a minute without and a minute with the page")
    parser.add_argument("--browser", default="chromium", help="its command")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--session", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--ticks", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.session is not None:
        run(options.session, options.ticks)
        return
    if missing := [each for each in (shlex.split(options.browser)[-1], "chromedriver") if shutil.which(each) is None]:
        raise SystemExit(f"not found: {', '.join(missing)}")

    turns = []
    for turn in range(options.turns):
        for page, command in (("without", None), ("with", options.browser)):
            found = watched(1.0, command)
            turns.append({"page": page, **found})
            missed = f"{found['missed']} of {found['of']:,} deadlines missed"
            print(f"turn {turn + 1}, {page} the page: {missed}, p99.9 {found['late_p99.9_ms']:.1f} ms late", flush=True)
    measured: dict[str, Any] = {"turns": turns}
    if options.minutes > 0:
        found = measured["long"] = watched(options.minutes, options.browser)
        took = found["shown_after_s"]
        delays = ", ".join(f"{name} {value:.3f}" for name, value in took.items())
        print(f"{options.minutes:g} min, from a pulse to the page (s): {delays}; {found['n_shown']:,} pulses")
        print(f"  {found['over_half_a_second']} after more than 0.5 s; {found['missed']} of {found['of']:,} missed")
        for minute, each in enumerate(found["memory"], 1):
            memory_mb = f"scripts {each['scripts_mb']:.1f} MB, drawing {each['drawing_mb']:.0f} MB"
            print(f"  {minute:3} min: {memory_mb}, {each['nodes']:.0f} nodes")
    if options.json:
        options.json.write_text(json.dumps(measured, indent=1) + "\n")


if __name__ == "__main__":
    main()
