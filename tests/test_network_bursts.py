"""A culture that nobody stimulates: bursts of known place and number, none where spikes are independent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from animat.cli import main
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.recording import Recording
from animat.report.inspection import inspection_text
from animat.report.spikes import draw_spontaneous
from animat.responses.bursts import find_network_bursts
from animat.responses.inspection import inspect_recording
from test_responses import recording


def spontaneous(bursts_at_s: list[float], duration_s: float = 300.0, n_channels: int = 40, seed: int = 0) -> Recording:
    """Half a spike a second and channel at random, and bursts of 0.3 s with 10 spikes a channel."""
    rng = np.random.default_rng(seed)
    times = rng.uniform(0, duration_s, int(0.5 * duration_s * n_channels)).tolist()
    times += [at + t for at in bursts_at_s for t in rng.uniform(0, 0.3, 10 * n_channels)]
    return recording([(t, int(c)) for t, c in zip(times, rng.integers(n_channels, size=len(times)), strict=True)], [],
                     n_channels, duration_s)  # fmt: skip


def test_bursts_are_found_where_they_are() -> None:
    at_s = [20.0, 100.1, 250.0]
    source = spontaneous(at_s)
    found = find_network_bursts(source)
    np.testing.assert_allclose(found.start_s, at_s, atol=0.051)
    np.testing.assert_allclose(found.end_s, np.array(at_s) + 0.3, atol=0.051)
    assert found.share == pytest.approx(3 * 400 / len(source.spike_times_s), abs=0.01)
    assert 0.25 <= found.median_s <= 0.4


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("n_channels", [1, 4, 200])
def test_independent_spikes_have_no_bursts(n_channels: int, seed: int) -> None:
    assert len(find_network_bursts(spontaneous([], 600.0, n_channels, seed))) == 0


def test_a_recording_without_stimuli_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = spontaneous([20.0, 100.1, 250.0])
    inspection = inspect_recording(source)
    assert inspection.spontaneous_rate_hz == pytest.approx(len(source.spike_times_s) / 300 / 40)
    text = inspection_text(inspection)
    assert "0.6 Hz per channel" in text and "3 network bursts (0.6 per minute)" in text
    figure = draw_spontaneous(source, find_network_bursts(source))
    assert figure.axes[0].get_xlim() == (0.0, 300.0)
    assert figure.axes[0].collections[0].get_offsets().shape[0] == len(source.spike_times_s)
    write_nwb(source, tmp_path / "a.nwb")
    assert main(["inspect", str(tmp_path / "a.nwb"), "--out", str(tmp_path / "figures"), "--json"]) == 1
    printed = capsys.readouterr().out
    assert "figures of the series" not in printed
    assert '"network_bursts": {"bursts": 3' in printed
    assert [file.name for file in (tmp_path / "figures").iterdir()] == ["a-raster.png"]


@pytest.mark.oracle
def test_one_burst_is_reported_in_the_singular_and_wide_bins_are_stated() -> None:
    text = inspection_text(inspect_recording(spontaneous([100.1])))
    assert "  1 network burst (" in text and "(median) contains " in text and "in bins of" not in text
    # Of 50 ms there would be more than ten million.
    long = recording([(t, 0) for t in np.arange(0.0, 1e6, 100.0)], [], 4, 1e6)
    assert "detected in bins of 0.1 s" in inspection_text(inspect_recording(long))
