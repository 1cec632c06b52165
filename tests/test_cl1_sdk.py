"""The CL1's driver against the vendor's own simulator, in accelerated time. Skipped without cl-sdk (Python 3.12).

The SDK keeps one device a process and reads its settings when that is made, so each case runs in a process of its own.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "cl.sim", reason="the CL1's SDK (cl-sdk, Python 3.12 or later) is not installed: pip install 'animat[cl1]'"
)

SETTINGS = {"CL_SDK_ACCELERATED_TIME": "1", "CL_SDK_VISUALISATION": "0"}
HEAD = """
import json, sys
import numpy as np
from animat.cultures.devices.cl1 import CL1_PULSE, SITES, CL1Culture
from animat.cultures.devices.cl1_source import use_simulated_culture
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import Phase, Pulse
from animat.stimulation.stimulus import Stimulus
def report(**what): print("REPORT " + json.dumps(what))
"""


def reported(script: str, folder: Path) -> dict[str, Any]:
    """What a script reports in its last line, run in a process of its own.

    In accelerated time the SDK gives up on a tick after 100 ms, which a busy machine can take: then it is run again.
    """
    for _ in range(4):
        shutil.rmtree(folder)
        folder.mkdir()
        ran = subprocess.run(
            [sys.executable, "-c", HEAD + script],
            env={**os.environ, **SETTINGS},
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=300,
        )
        if ran.returncode == 0 or "Timeout waiting for timestamp" not in ran.stderr:
            break
    assert ran.returncode == 0, ran.stderr[-3000:]
    line = [line for line in ran.stdout.splitlines() if line.startswith("REPORT ")][-1]
    return dict(json.loads(line.removeprefix("REPORT ")))


def test_it_passes_the_contract_on_the_sdks_simulator(tmp_path: Path) -> None:
    script = """
from animat.cultures.contract import CultureContract
class TestOnSimulator(CultureContract):
    pulse = CL1_PULSE
    is_repeatable = False
    def make_culture(self): return CL1Culture()
done = [name for name in dir(TestOnSimulator) if name.startswith("test_")]
for name in done: getattr(TestOnSimulator(), name)()
report(done=len(done))
"""
    assert reported(script, tmp_path)["done"] >= 10


def test_the_five_frequencies_come_as_asked_and_as_the_sdks_own_file_says(tmp_path: Path) -> None:
    script = """
protocol = Protocol(pulse=CL1_PULSE, patterns=10, trials=10, setup_s=0.1, pause_s=0.2)
with CL1Culture(record_to="rec") as culture:
    recording = culture.record(protocol, seed=1)
    asked = np.concatenate([b.stimuli.time_s for b in culture.schedule(protocol, 1).blocks])
    report(asked=asked.tolist(), got=recording.stimuli.time_s.tolist(), hz=recording.stimuli.frequency_hz.tolist(),
         electrodes=recording.stimuli.electrodes.tolist(), spikes=len(recording.spike_times_s), said=culture.provenance)
"""
    found = reported(script, tmp_path)
    asked, got = np.array(found["asked"]).reshape(5, 10), np.array(found["got"]).reshape(5, 10)
    # Halves of a frame are rounded up.
    frames = np.floor(np.round(asked * 25_000, 6) + 0.5)
    np.testing.assert_array_equal(np.rint(np.diff(got) * 25_000), np.diff(frames))
    assert "SDK's simulator" in found["said"]["source"]
    (file,) = (tmp_path / "rec").glob("*.h5")
    from animat.recordings.formats.hdf5_formats import read_hdf5

    own = read_hdf5(file)
    assert own.stimuli.electrodes.tolist() == [sorted(row) for row in found["electrodes"]]
    assert own.stimuli.frequency_hz.tolist() == found["hz"]
    np.testing.assert_array_equal(
        np.rint(np.diff(own.stimuli.time_s.reshape(5, 10)) * 25_000), np.rint(np.diff(got) * 25_000)
    )


def test_every_pulse_that_the_guard_admits_is_one_that_the_sdk_takes(tmp_path: Path) -> None:
    """Designs at random about the edges of the limits: what passes our guard raises nothing in the SDK."""
    script = """
import cl
from animat.cultures.devices.cl1 import CL1_LIMITS
from animat.cultures.safety import Guard
from animat.errors import UnsafeStimulus
rng, taken, refused, wrongly = np.random.default_rng(0), 0, 0, 0
for _ in range(20_000):
    n = int(rng.integers(1, 5))
    us = rng.choice([10, 20, 160, 170, 500, 1000, 1500, 3000], n).astype(float)
    ua = rng.choice([0.0, 0.5, 1.0, 2.0, 3.0, 3.1], n) * rng.choice([-1.0, 1.0]) * (-1.0) ** np.arange(n)
    if rng.random() < 0.6 and n == 2:
        us[1], ua[1] = us[0], -ua[0]
    pulse = Pulse(tuple(Phase(a, amplitude_ua=b) for a, b in zip(us.tolist(), ua.tolist())))
    try:
        Guard(CL1_LIMITS, SITES).admit([Stimulus(0.0, (1,), pulse)], 0.0)
    except UnsafeStimulus:
        refused += 1
        continue
    taken += 1
    numbers = [x for phase in pulse.phases for x in (round(phase.duration_us), phase.amplitude_ua)]
    try:
        cl.StimDesign(*numbers)
    except ValueError:
        wrongly += 1
report(taken=taken, refused=refused, wrongly=wrongly)
"""
    found = reported(script, tmp_path)
    assert found["wrongly"] == 0
    assert min(found["taken"], found["refused"]) > 500


def test_the_sdk_says_nothing_of_ground_and_we_do(tmp_path: Path) -> None:
    script = """
import cl
from animat.errors import UnsafeStimulus
silent, words = [], []
with cl.open() as neurons:
    for channel in (0, 7, 56, 63):
        neurons.stim(cl.ChannelSet(channel), cl.StimDesign(160, -1.0, 160, 1.0))
        silent += [s.channel for t in neurons.loop(100, stop_after_ticks=10) for s in t.analysis.stims]
with CL1Culture() as culture:
    for channel in (0, 4, 7, 56, 63):
        try:
            culture.deliver([Stimulus(0.0, (channel,), CL1_PULSE)], 0.1)
        except UnsafeStimulus as error:
            words.append(f"got electrode {channel}" in str(error))
report(silent=silent, words=words)
"""
    assert reported(script, tmp_path) == {"silent": [], "words": [True] * 5}


def test_a_simulated_culture_answers_through_the_sdk_and_ticks_do_not_change_it(tmp_path: Path) -> None:
    script = """
use_simulated_culture(seed=3, neurons=300)
import cl
frames, spikes, stims = 0, [], []
with cl.open() as neurons:
    start = neurons.timestamp()
    for at in (5000, 12500, 20000):
        plan = neurons.create_stim_plan()
        plan.stim(cl.ChannelSet(9, 10, 18), cl.StimDesign(160, -2.0, 160, 2.0))
        plan.run(at_timestamp=start + at)
    for tick in neurons.loop(TICKS, stop_after_ticks=TICKS):
        spikes += [(s.timestamp - start, s.channel) for s in tick.analysis.spikes]
        stims += [(s.timestamp - start, s.channel) for s in tick.analysis.stims]
        frames += int(np.abs(tick.frames.astype(int)).sum())
report(spikes=sorted(spikes), stims=sorted(stims), frames=frames)
"""
    found = [reported(script.replace("TICKS", str(ticks)), tmp_path) for ticks in (100, 1000)]
    assert found[0] == found[1]
    spikes = np.array(found[0]["spikes"])
    times = sorted({time for time, _ in found[0]["stims"]})
    assert len(times) == 3
    after = sum(np.count_nonzero((spikes[:, 0] >= t) & (spikes[:, 0] < t + 250)) for t in times)
    before = sum(np.count_nonzero((spikes[:, 0] >= t - 250) & (spikes[:, 0] < t)) for t in times)
    assert after > 2 * before


def test_the_driver_records_responses_of_the_simulated_culture(tmp_path: Path) -> None:
    script = """
use_simulated_culture(seed=3, neurons=300)
from animat.recordings.formats.nwb import write_nwb
from animat.stimulation.protocol import Protocol
with CL1Culture() as culture:
    pulse = Pulse((Phase(160, amplitude_ua=-2.0), Phase(160, amplitude_ua=2.0)))
    protocol = Protocol(pulse=pulse, frequencies_hz=(10.0, 40.0), trials=20, patterns=20)
    recording = culture.record(protocol, seed=1)
    write_nwb(recording, "cl1.nwb")
    window = [np.count_nonzero((recording.spike_times_s >= t + 0.002) & (recording.spike_times_s < t + 0.010))
              for t in recording.stimuli.time_s]
    rest = len(recording.spike_times_s) / recording.duration_s * 0.008
report(window=float(np.mean(window)), rest=rest, stimuli=len(window))
"""
    found = reported(script, tmp_path)
    assert found["stimuli"] == 40
    assert found["window"] > 1.5 * found["rest"]


def test_a_closed_loop_runs_on_it_and_the_sdks_own_file_has_the_same_pulses(tmp_path: Path) -> None:
    script = """
from animat.closed_loop.agents import random_control
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.coding.mapping import mapping_named
from animat.responses.condition import Condition
from animat.robots.registry import robot_named
use_simulated_culture(seed=1, neurons=300)
pulse = Pulse((Phase(160, amplitude_ua=-2.0), Phase(160, amplitude_ua=2.0)))
frequencies = tuple(Condition(f"{f} Hz", float(f), "Hz") for f in (20, 40, 80))
percentiles = np.linspace(0, 100, 11)
loop = Loop(robot_named("cartpole"), mapping_named("1-threshold"), frequencies, percentiles, pulses=5, pulse=pulse)
agents = [random_control(len(frequencies))]
with CL1Culture(record_to="rig") as culture:
    session = run_session(culture, loop, agents, "session", episodes=2)
if session.ending.by != "plan":
    sys.exit(session.ending.message)
recording = session.recording()
report(episodes=len(session.episodes), times=recording.stimuli.time_s.tolist(),
     hz=recording.stimuli.frequency_hz.tolist(), pattern=recording.stimuli.pattern.tolist())
"""
    found = reported(script, tmp_path)
    assert found["episodes"] == 2
    (file,) = (tmp_path / "rig").glob("*.h5")
    from animat.recordings.formats.hdf5_formats import read_hdf5

    own = read_hdf5(file).stimuli
    # The SDK's index repeats itself after a hundred entries (1.0.0): the rest is unknown, and nothing is wrong.
    known = ~np.isnan(own.frequency_hz)
    assert len(known) == len(found["hz"]) and np.all(known[:100])
    assert own.frequency_hz[known].tolist() == np.array(found["hz"])[known].tolist()
    assert own.pattern[known].tolist() == np.array(found["pattern"])[known].tolist()
    np.testing.assert_allclose(np.diff(own.time_s), np.diff(found["times"]), atol=1e-6)
