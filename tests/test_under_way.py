"""A recording as far as it is: stretches of a block are the block, and what is beside a series while it is made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from animat.cultures.observed import Observed
from animat.cultures.series import record_series
from animat.cultures.under_way import UNDER_WAY, PartialRecording
from animat.cultures.virtual import VirtualCulture
from animat.errors import DeviceFailed
from animat.recordings.reading import read_recording, read_recordings
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Protocol
from animat.stimulation.schedule import make_schedule
from animat.watch.recording import RecordingView
from animat.writing import exclusive_lock
from fake_culture import FakeCulture
from test_watch_work import block, facts

SHORT = Protocol((20.0, 80.0), patterns=2, trials=30, setup_s=0.5, pause_s=0.2)
PATTERNS = np.arange(12).reshape(6, 2)


@pytest.mark.parametrize("pulses", [1, 5])
def test_stretches_are_the_block_and_cut_no_trial(pulses: int) -> None:
    protocol = Protocol(order="mixed", patterns=6, trials=40, pulses=pulses)
    (whole,) = make_schedule(protocol, PATTERNS, 3).blocks
    parts = whole.stretches(2.0)
    assert len(parts) > 5
    starts_s = np.cumsum([0.0, *(part.duration_s for part in parts)])
    assert starts_s[-1] == pytest.approx(whole.duration_s, abs=1e-9)
    times_s = np.concatenate([start + part.stimuli.time_s for start, part in zip(starts_s, parts, strict=False)])
    np.testing.assert_allclose(times_s, whole.stimuli.time_s, rtol=0, atol=1e-9)
    for name in ("frequency_hz", "pattern", "electrodes", "presentation"):
        together = np.concatenate([getattr(part.stimuli, name) for part in parts])
        np.testing.assert_array_equal(together, getattr(whole.stimuli, name))
    assert len({n for part in parts for n in set(part.stimuli.presentation.tolist())}) == sum(
        len(set(part.stimuli.presentation.tolist())) for part in parts
    )
    for part in parts:
        assert part.setup_s == 0
        # Room before the first pulse and after the last: none lies where it is cut.
        assert part.stimuli.time_s[0] > 0.002 and part.stimuli.time_s[-1] < part.duration_s - 0.002
    assert min(part.duration_s for part in parts[:-1]) >= 2.0


def test_it_is_followed_block_by_block_and_takes_no_time_from_stimulation() -> None:
    with FakeCulture() as culture:
        expected, ended_s = culture.record(SHORT, 1), culture.now_s
    seen: list[Recording] = []
    with FakeCulture() as culture:

        def follow(so_far: Callable[[], Recording]) -> None:
            seen.append(so_far())
            # As long as it takes to write it.
            culture.rest(0.3)

        recording = culture.record(SHORT, 1, None, follow)
        assert culture.now_s == pytest.approx(ended_s, abs=1e-9)
    assert recording.equals(expected)
    # After the first of its two blocks: when the second is done, the recording is whole.
    (first,) = seen
    assert 0 < len(first.stimuli) < len(recording.stimuli)
    np.testing.assert_array_equal(first.stimuli.time_s, recording.stimuli.time_s[: len(first.stimuli)])
    np.testing.assert_array_equal(first.spike_times_s, recording.spike_times_s[: len(first.spike_times_s)])
    assert first.duration_s == pytest.approx(0.2 + 29 / recording.stimuli.frequency_hz[0] + 0.1, abs=1e-4)


class Looking:
    """A progress that looks at the page while a series is recorded."""

    def __init__(self, folder: Path) -> None:
        self.view = RecordingView(folder)
        self.seen: list[dict[str, object]] = []

    def update(self, done: float, total: float, note: str = "") -> None:
        if (self.view.folder / UNDER_WAY).exists():
            self.view.view(None, 1.0)
            # The second look is at others, too.
            self.seen.append(self.view.view(None, 1.0))


def test_the_page_shows_a_recording_as_far_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.cultures.under_way.EVERY_S", 0.0)
    looking = Looking(tmp_path)
    with FakeCulture() as culture:
        record_series(lambda: culture, SHORT, tmp_path, sessions=2, interval_min=1.0, progress=looking)
    series = read_recordings([tmp_path])
    # After the second block of each, when there is a file of the first.
    begun, of_the_next = looking.seen
    assert begun["state"] == "running"
    assert facts(begun, "Recordings")["shown"] == "the one in progress, as far as it has come"
    assert facts(begun, "Recordings")["stimuli"] == 30
    assert str(begun["message"]).endswith("s of the one in progress are shown")
    assert 0 < begun["end_s"] < series[0].duration_s
    assert facts(of_the_next, "Recordings")["complete"] == 1
    # Beside what is known of the next is the one before.
    assert len(block(of_the_next, "P(x >= P50) of each condition")["head"]) == 3
    assert not (tmp_path / UNDER_WAY).exists()
    ended = looking.view.view(None, 1.0)
    assert (ended["state"], ended["message"]) == ("ended", "2 recordings")


def test_a_failed_recording_leaves_nothing_and_a_killed_one_is_shown_as_interrupted(tmp_path: Path) -> None:
    def fail(culture: FakeCulture, observed: Observed) -> Observed:
        raise DeviceFailed("out of order")

    with FakeCulture(fault=fail, at=1) as culture, pytest.raises(DeviceFailed, match="out of order"):
        record_series(lambda: culture, SHORT, tmp_path, sessions=1, interval_min=1.0)
    assert list(tmp_path.iterdir()) == []
    with FakeCulture() as culture:
        recording = culture.record(SHORT, 1)
    PartialRecording(tmp_path)(lambda: recording)
    shown = read_recording(tmp_path / UNDER_WAY)
    assert shown.spike_times_s.tolist() == recording.spike_times_s.tolist()
    for name in ("label", "electrode", "x_um", "y_um"):
        assert getattr(shown.channels, name).tolist() == getattr(recording.channels, name).tolist()
    found = RecordingView(tmp_path).view(None, 1.0)
    assert found["state"] == "silent"
    assert "was interrupted" in found["message"]
    # The next run is rid of it.
    (tmp_path / f".{UNDER_WAY}.ab12.partial.npz").write_bytes(b"half")
    with exclusive_lock(tmp_path), PartialRecording(tmp_path):
        assert [file.name for file in tmp_path.iterdir() if file.suffix == ".npz"] == []


@pytest.mark.oracle
def test_a_virtual_culture_is_recorded_in_stretches_as_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    protocol = Protocol(order="mixed", patterns=20, trials=30, pulses=2)
    recordings = []
    with VirtualCulture(1, scan_s=0.5) as culture:
        selection = culture.selection
    for stretch_s in (None, 3.0):
        monkeypatch.setattr(VirtualCulture, "stretch_s", stretch_s)
        with VirtualCulture(1, selection=selection) as culture:
            recordings.append(culture.record(protocol, 1))
    assert recordings[0].equals(recordings[1])
