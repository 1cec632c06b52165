"""Gaps without events. Oracles: independent spikes, which have none by chance, cut, shifted and doubled."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.cli import main
from animat.errors import AnimatError
from animat.recordings.columns import PlainColumns
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.quality import recording_findings
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.responses.inspection import inspect_recording
from test_responses import recording as of_spikes


def spikes_csv(folder: Path, from_s: float, n: int = 20_000, length_s: float = 600.0) -> Path:
    rng = np.random.default_rng(0)
    times, channels = np.sort(rng.uniform(from_s, from_s + length_s, n)), rng.integers(30, size=n)
    lines = [f"{t!r},{c}" for t, c in zip(times.tolist(), channels.tolist(), strict=True)]
    path = folder / "cut_spikes.csv"
    path.write_text("time_s,channel\n" + "\n".join(lines) + "\n")
    return path


def said(source: Recording) -> dict[str, str]:
    return {finding.name: finding.message for finding in recording_findings(source)}


@pytest.mark.parametrize("from_s", [pytest.param(3600.0, marks=pytest.mark.oracle), 1.7e9])
def test_a_clock_that_does_not_start_at_0_causes_a_warning_and_its_start_can_be_given(
    from_s: float, tmp_path: Path
) -> None:
    path = spikes_csv(tmp_path, from_s)
    source = read_recording(path)
    finding = next(f for f in recording_findings(source) if f.name == "start-unknown")
    assert finding.severity == "warning" and "animat convert --start-s" in finding.message
    assert f"the first event is at {source.spike_times_s[0]:.12g} s" in finding.message
    with_start = read_recording(path, start_s=from_s)
    assert not {"start-unknown", "silence", "times-not-in-seconds"} & set(said(with_start))
    assert (with_start.start_s, with_start.stop_s) == (from_s, source.stop_s)
    assert said(with_start)["start-given"] == f"the recording starts at {from_s:.12g} s, as given, instead of 0 s"
    assert "start-given" not in said(read_recording(path, start_s=0.0))
    write_nwb(with_start, tmp_path / "given.nwb")
    again = read_recording(tmp_path / "given.nwb", start_s=from_s - 1)
    assert [finding.name for finding in again.findings].count("start-given") == 1
    assert (
        said(read_recording(tmp_path / "given.nwb", start_s=from_s))["start-given"] == said(with_start)["start-given"]
    )
    inspection = inspect_recording(with_start)
    # 20,000 spikes on 30 channels in 600 s, independent of each other.
    assert inspection.spontaneous_rate_hz == pytest.approx(20_000 / 30 / 600, rel=1e-3)
    assert inspection.network_bursts is not None and len(inspection.network_bursts) == 0


def test_the_start_is_kept_by_a_conversion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = spikes_csv(tmp_path, 3600.0), tmp_path / "out.nwb"
    assert main(["convert", str(path), "--out", str(out), "--start-s", "3600"]) == 0
    assert read_recording(out).start_s == 3600.0 and "start-unknown" not in said(read_recording(out))
    with pytest.raises(AnimatError, match=r"expected times within the recording \(3700 to"):
        read_recording(path, start_s=3700.0)
    with pytest.raises(AnimatError, match="start_s: expected finite seconds"):
        read_recording(path, start_s=float("nan"))
    capsys.readouterr()
    arguments = ["convert", str(path), "--out", str(tmp_path / "b.nwb"), "--raw", "--start-s", "0"]
    assert main(arguments) == 1 and "--start-s: expected none" in capsys.readouterr().err


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(20, 200), bursts=st.booleans())
def test_independent_events_and_bursts_have_no_late_start_by_chance(seed: int, n: int, bursts: bool) -> None:
    rng = np.random.default_rng(seed)
    times_s = np.cumsum(rng.exponential(1.0, n))
    if bursts:
        times_s = np.repeat(times_s, 10) + rng.uniform(0, 0.1, 10 * n)
    columns = PlainColumns(times_s, np.zeros(len(times_s), int), np.empty(0))
    assert "start-unknown" not in said(columns.to_recording({}))


def test_a_late_first_event_causes_no_warning_if_the_start_is_stated() -> None:
    times_s = 3600 + np.arange(100.0)
    for start_s, asked in [(None, True), (0.0, False), (3000.0, False)]:
        columns = PlainColumns(times_s, np.zeros(100, int), np.empty(0), start_s=start_s)
        assert ("start-unknown" in said(columns.to_recording({}))) == asked


def poisson(silent_s: list[tuple[float, float]], duration_s: float = 1000.0) -> Recording:
    """300 spikes per second on 20 channels, but none in these gaps."""
    rng = np.random.default_rng(1)
    times = rng.uniform(0, duration_s, int(300 * duration_s))
    for start, stop in silent_s:
        times = times[(times < start) | (times > stop)]
    return of_spikes(np.column_stack([times, rng.integers(20, size=len(times))]), [], 20, duration_s)


def test_silences_are_reported_with_their_times() -> None:
    assert "silence" not in said(poisson([]))
    finding = next(f for f in recording_findings(poisson([(400, 600)])) if f.name == "silence")
    assert finding.severity == "warning" and finding.value == pytest.approx(200, abs=0.1)
    assert finding.message.startswith("no spike on any channel from 399.9") and "to 600.0" in finding.message
    two = next(f for f in recording_findings(poisson([(100, 130), (900, 1000)])) if f.name == "silence")
    assert two.value == pytest.approx(130, abs=0.1) and ", from 899.9" in two.message
    # Less than a hundredth of the recording changes no rate by much.
    assert "silence" not in said(poisson([(400, 405)]))


@pytest.mark.parametrize("duration_s", [200.0, 1000.0, 40_000.0])
def test_a_recording_that_is_empty_from_some_time_on_causes_a_warning(duration_s: float) -> None:
    recorded = replace(poisson([], 100.0), duration_s=duration_s)
    message = said(recorded)["silence"]
    assert f"to {duration_s:g} s" in message and "or did it end earlier than stated?" in message
    assert "end earlier" not in said(poisson([(400, 600)]))["silence"]


def test_pauses_between_stretches_of_stimulation_are_no_silences() -> None:
    """A culture that fires only when it is stimulated: five times 20 s, and pauses of 130 s."""
    assert "silence" not in said(poisson([(20.0 + 150 * i, 150.0 * (i + 1)) for i in range(5)], 750.0))


@pytest.mark.parametrize("n_bursts", [1, 2, 3, 5, 20])
def test_a_culture_that_fires_only_in_bursts_is_not_silent(n_bursts: int) -> None:
    rng = np.random.default_rng(n_bursts)
    times = [t for at in rng.uniform(0, 600, n_bursts) for t in at + rng.uniform(0, 0.3, 2000)]
    assert "silence" not in said(of_spikes([(t, 0) for t in times], [], 4, 601.0))


def test_duplicate_spikes_cause_a_warning() -> None:
    rng = np.random.default_rng(0)
    spikes = np.column_stack([rng.uniform(0, 10, 1000), rng.integers(4, size=1000)])
    assert "duplicate-spikes" not in said(of_spikes(spikes, [], 4))
    message = said(of_spikes(np.concatenate([spikes, spikes[:100]]), [], 4))["duplicate-spikes"]
    assert message.startswith("100 of 1,100 spikes (9 %)")
    # Two channels may fire at one time.
    both = np.concatenate([np.column_stack([spikes[:, 0], np.full(1000, channel)]) for channel in (0, 1)])
    assert "duplicate-spikes" not in said(of_spikes(both, [], 4))


def test_unnumbered_pulses_are_trials_and_several_frequencies_in_one_cause_a_warning() -> None:
    def trials(**columns: object) -> Recording:
        times_s = np.arange(1.0, 51.0)
        return PlainColumns(np.array([1.005]), np.zeros(1, int), times_s, **columns).to_recording({})  # type: ignore[arg-type]

    unknown = trials(stimulus_presentation=np.full(50, -1))
    assert np.count_nonzero(unknown.stimuli.is_last_of_presentation) == 50
    assert said(unknown)["trials-unknown"].startswith("50 of 50 stimuli have no trial number (-1)")
    some = trials(stimulus_presentation=np.r_[np.full(20, -1), np.repeat(np.arange(15), 2)])
    assert np.count_nonzero(some.stimuli.is_last_of_presentation) == 35
    with pytest.raises(AnimatError, match="expected numbers that never fall over time"):
        trials(stimulus_presentation=np.r_[np.full(20, -1), np.arange(30)[::-1]])
    frequency_hz = np.tile([5.0, 10.0], 25)
    mixed = trials(stimulus_presentation=np.repeat([0, 1], 25), stimulus_frequency_hz=frequency_hz)
    assert said(mixed)["trials-of-several-frequencies"].startswith("2 of 2 trials have pulses of several frequencies")
    alike = trials(stimulus_presentation=np.repeat([0, 1], 25), stimulus_frequency_hz=np.repeat([5.0, 10.0], 25))
    assert "trials-of-several-frequencies" not in said(alike)
    # Computed from times, they differ by rounding.
    computed_hz = np.nextafter(np.full(50, 20.0), np.tile([0.0, 40.0], 25))
    rounded = trials(stimulus_presentation=np.repeat([0, 1], 25), stimulus_frequency_hz=computed_hz)
    assert "trials-of-several-frequencies" not in said(rounded)
