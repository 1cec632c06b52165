"""The page on hardware: its example runs, its limits are the code's."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from animat.cultures.cl1 import CL1_LIMITS, LEAD_US
from animat.cultures.maxone import MAXONE_LIMITS
from animat.recordings.recording import Recording
from stand_in_cl import install

PAGE = (Path(__file__).parents[1] / "docs" / "hardware.md").read_text()


def test_the_example_of_the_cl1_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    monkeypatch.chdir(tmp_path)
    example = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0]
    exec(compile(example, "hardware.md", "exec"), {})
    recording = Recording.load(tmp_path / "cl1.nwb")
    assert len(recording.stimuli) == 500
    assert recording.presentation is not None
    assert recording.presentation.pulses == 5


@pytest.mark.parametrize(
    ("row", "cl1", "maxone"),
    [
        ("amplitude", f"{CL1_LIMITS.amplitude:g} uA", f"{MAXONE_LIMITS.amplitude:g} mV"),
        ("charge of a phase", f"{CL1_LIMITS.charge_per_phase:g} nC", f"{MAXONE_LIMITS.charge_per_phase:g} mV ms"),
        ("phases", f"steps of {CL1_LIMITS.phase_step_us:g} us", f"steps of {MAXONE_LIMITS.phase_step_us:g} us"),
        ("phases", f"at most {CL1_LIMITS.phases_per_pulse}", f"at most {MAXONE_LIMITS.phases_per_pulse}"),
        ("one electrode", f"{CL1_LIMITS.interval_us / 1000:g} ms", f"{MAXONE_LIMITS.interval_us / 1000:g} ms"),
        ("one electrode", f"{CL1_LIMITS.stimuli_per_electrode_s} a s", f"{MAXONE_LIMITS.stimuli_per_electrode_s} a s"),
        ("all together", f"{LEAD_US} us apart", f"{MAXONE_LIMITS.gap_us / 1000:g} ms apart"),
        ("all together", f"{CL1_LIMITS.stimuli_per_s} stimuli", f"{MAXONE_LIMITS.stimuli_per_s} a second"),
    ],
)
def test_the_limits_are_those_of_the_code(row: str, cl1: str, maxone: str) -> None:
    cells = next(line for line in PAGE.splitlines() if line.startswith(f"| {row} |")).split("|")
    assert cl1 in cells[2]
    assert maxone in cells[3]
