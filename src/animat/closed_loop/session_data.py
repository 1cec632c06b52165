"""A session's data without the spikes, collected from its records, and the names of its files."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from animat.closed_loop.header import Header
from animat.closed_loop.log import Record
from animat.closed_loop.outline import Outline
from animat.closed_loop.tick import Ending
from animat.errors import AnimatError, InvalidFile
from animat.recordings.formats.nwb_spikes import SpikeCounts
from animat.recordings.metadata import from_metadata
from animat.recordings.recording import Recording
from animat.stimulation.stimulus import Stimuli
from animat.tables import UNKNOWN

LOG_FILE = "session.log"
RECORDING_FILE = "session.nwb"
TICKS_FILE = "ticks.csv"


class SessionData:
    """What a session's files need from its records, except the spikes, which stay in the log."""

    def __init__(self, header: Header) -> None:
        self.outline = Outline()
        self.spike_counts = SpikeCounts(len(header.channels))
        self._header = header
        # One entry per pulse, in columns: half a million take 50 MB instead of a gigabyte.
        self._time_s, self._frequency_hz = array("d"), array("d")
        self._pattern, self._presentation = array("q"), array("q")
        self._electrodes, self._widths = array("q"), array("q")
        self._watched_s = self._end_s = 0.0

    def add(self, record: Record) -> None:
        fields = record.fields
        self.outline.add(fields)
        self.spike_counts.add(record.spike_times_s, record.spike_channels)
        if fields["kind"] != "seen":
            return
        for frequency_hz, pattern, presentation, electrodes in fields["stimuli"]:
            self._frequency_hz.append(frequency_hz)
            self._pattern.append(pattern)
            self._presentation.append(presentation)
            self._electrodes.extend(electrodes)
            self._widths.append(len(electrodes))
        if fields["tick"]:
            self._time_s.extend(fields["tick"]["pulse_time_s"])
        self._watched_s += fields["duration_s"]
        self._end_s = max(self._end_s, fields["start_s"] + fields["duration_s"])

    def recording_without_spikes(self, ending: Ending) -> Recording:
        """The session as a recording, without its spikes; raises UnusableData for inconsistent records."""
        header, outline = self._header, self.outline
        metadata = {
            **header.provenance,
            "session_description": "A closed loop of a neuronal culture on a multi-electrode array with a robot. The "
            f"agent that chooses the stimuli changes between episodes ({', '.join(header.agents)}): {TICKS_FILE} next "
            "to this file states the agent of each stimulus, and the result.",
            "recorded_at": header.recorded_at,
            "closed_loop": header.loop,
            "closed_loop_ended": f"{ending.by}: {ending.message}",
            "closed_loop_unanswered_pulses": str(outline.unanswered_pulses),
        }
        if outline.left_out:
            metadata["left_out"] = describe_left_out(outline.left_out)
        duration_s = max(self._end_s, self.spike_counts.span_s[1], *self._time_s[-1:])
        metadata["closed_loop_unwatched_s"] = f"{max(0.0, duration_s - self._watched_s):.6f}"
        return Recording(
            spike_times_s=[],  # type: ignore[arg-type]
            spike_channels=[],  # type: ignore[arg-type]
            channels=header.channels,
            stimuli=self._stimuli(),
            sampling_rate_hz=header.sampling_rate_hz,
            start_s=0.0,
            duration_s=duration_s,
            start_min=header.start_min,
            presentation=header.presentation,
            **from_metadata(metadata),
        )

    def _stimuli(self) -> Stimuli:
        widths = np.array(self._widths, np.int64)
        electrodes = np.full((len(widths), int(np.max(widths)) if len(widths) else 1), UNKNOWN)
        electrodes[np.arange(electrodes.shape[1])[None, :] < widths[:, None]] = self._electrodes
        return Stimuli(
            time_s=np.array(self._time_s, np.float64),
            frequency_hz=np.array(self._frequency_hz, np.float64),
            pattern=np.array(self._pattern, np.int64),
            electrodes=electrodes,
            presentation=np.array(self._presentation, np.int64),
        )


@contextmanager
def expect_session_log(file: Path) -> Iterator[None]:
    """Raise InvalidFile where the records of an intact log are not those of a session."""
    try:
        yield
    except InvalidFile:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError, AnimatError) as error:
        raise InvalidFile(f"{file}: expected a session's log, got {error!r}") from error


def describe_left_out(left_out: Mapping[str, int]) -> str:
    """What is missing from a session, as text."""
    return ", ".join(f"{count} {what}" for what, count in left_out.items())
