"""The page on hardware: its example runs, its limits are the code's."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import stand_in_maxlab
from animat.cli import main
from animat.closed_loop.agents import Agent, OneCondition
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.coding.mapping import Thresholds
from animat.cultures.devices.cl1 import CL1_LIMITS, LEAD_US
from animat.cultures.devices.maxone import MAXONE_LIMITS, MaxOneCulture
from animat.cultures.safety import SIMULATED_LIMITS, Limits
from animat.recordings.reading import read_recording
from animat.responses.condition import Condition
from animat.robots import Navigation
from animat.stimulation.array import MAXONE
from animat.stimulation.patterns import draw_patterns
from animat.stimulation.pulse import BALANCED_PULSE
from animat.stimulation.selection import Selection
from stand_in_cl import install

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "hardware.md").read_text()


def test_the_example_of_the_cl1_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    monkeypatch.chdir(tmp_path)
    example = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0]
    exec(compile(example, "hardware.md", "exec"), {})
    recording = read_recording(tmp_path / "cl1.nwb")
    assert len(recording.stimuli) == 500
    assert recording.presentation is not None
    assert recording.presentation.pulses == 5


def test_the_first_commands_on_a_device_run_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    monkeypatch.chdir(tmp_path)
    steps = PAGE.split("## Before the first pulse")[1].split("## Limits")[0]
    commands = re.findall(r"`animat (record [^`]*cl1[^`]*)`", steps)
    for command, file in zip(commands, re.findall(r"`(\{.*?\})`", steps), strict=False):
        words = command.split()
        Path(words[words.index("--protocol") + 1]).write_text(file)
        assert main(words) == 0
    none, few = (read_recording(tmp_path / "first" / each / "recording_0000_min.nwb") for each in ("none", "few"))
    assert none.stimuli.is_rest.all()
    assert len(few.stimuli) == 80
    assert set(few.stimuli.frequency_hz.tolist()) == {5, 10, 20, 40}


def test_the_example_of_a_selection_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (example,) = (each for each in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "draw_patterns" in each)
    exec(compile(example, "hardware.md", "exec"), {})
    selection = Selection.load(tmp_path / "selection.json")
    assert (len(selection.recording), selection.patterns.shape) == (8, (20, 5))


@pytest.mark.parametrize(
    ("row", "of"),
    [
        ("amplitude of a phase", lambda limits: f"{limits.amplitude:g} {limits.units[0]}"),
        ("duration of a phase", lambda limits: f"{limits.phase_us[0]:g} us to {limits.phase_us[1] / 1000:g} ms"),
        ("duration of a phase", lambda limits: f"steps of {limits.phase_step_us:g} us" * bool(limits.phase_step_us)),
        ("charge of a phase", lambda limits: f"{limits.charge_per_phase:g} {limits.units[1]}"),
        ("balance", lambda limits: "0" if limits.net_charge < 1e-5 else f"{limits.net_charge:g} {limits.units[1]}"),
        (
            "left on an electrode",
            lambda limits: (
                f" {limits.net_charge_per_session:,.{0 if limits.net_charge_per_session > 1 else 3}f} "
                f"{limits.units[1]} "
            ),
        ),
        ("phases of a pulse", lambda limits: f" {limits.phases_per_pulse:,}"),
        ("phases of a pulse", lambda limits: "different signs" * limits.alternates),
        ("electrodes of a stimulus", lambda limits: f" {limits.electrodes_at_once} "),
        ("on one electrode", lambda limits: f" {limits.stimuli_per_electrode_s} in any second"),
        ("on one electrode", lambda limits: f"{limits.interval_us / 1000:g} ms apart" * bool(limits.interval_us)),
        ("in all", lambda limits: f" {limits.stimuli_per_s} in any second"),
        ("in all", lambda limits: "apart" * bool(limits.gap_us)),
        ("in a session", lambda limits: f" {limits.stimuli_per_session:,} "),
    ],
)
def test_the_limits_are_those_of_the_code(row: str, of: Callable[[Limits], str]) -> None:
    cells = next(line for line in PAGE.splitlines() if line.startswith(f"| {row}")).split("|")
    for cell, limits in zip(cells[3:6], (CL1_LIMITS, MAXONE_LIMITS, SIMULATED_LIMITS), strict=True):
        assert of(limits) in cell


def test_the_time_between_stimuli_is_that_of_the_code() -> None:
    cells = next(line for line in PAGE.splitlines() if line.startswith("| in all |")).split("|")
    assert f"{LEAD_US} us apart" in cells[3] and f"{MAXONE_LIMITS.gap_us / 1000:g} ms apart" in cells[4]


@pytest.mark.parametrize(("frequency_hz", "late_ms"), [(40.0, 0.0), (80.0, 2.6)])
def test_at_80_hz_the_first_pulse_of_an_action_is_late_on_a_maxone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frequency_hz: float, late_ms: float
) -> None:
    rig = stand_in_maxlab.install(monkeypatch)
    sites = np.array([(20 + 25 * (i // 8)) * 220 + 15 + 25 * (i % 8) for i in range(32)])
    selection = Selection(MAXONE, np.arange(13_000, 13_050), sites, draw_patterns(MAXONE, sites, seed=1))
    loop = Loop(
        robot=Navigation(episode_limit=10),
        mapping=Thresholds(1),
        conditions=(Condition("f", frequency_hz, "Hz"),),
        percentiles=np.linspace(0.0, 125.0, 11),
        pulses=5,
        pulse=BALANCED_PULSE,
        pause_s=0.1,
    )
    with MaxOneCulture(selection, stream=stand_in_maxlab.Stream(rig), settle=False) as culture:
        session = run_session(culture, loop, [Agent("f", "", OneCondition(0))], tmp_path, episodes=1)
    first, *others = session.ticks
    assert first.late_s == 0.0
    assert [1000 * tick.late_s for tick in others] == pytest.approx([late_ms] * 9)
    within_ms = 1000 * np.diff([tick.pulse_time_s for tick in session.ticks], axis=1)
    np.testing.assert_allclose(within_ms, 1000 / frequency_hz)
