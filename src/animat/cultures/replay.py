"""A culture that answers from recordings: each stimulus with the spikes that followed a similar one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Int64

from animat.arguments import checked_arguments
from animat.cultures.base import ComputedCulture
from animat.cultures.observed import Observed, Spikes
from animat.cultures.safety import Admitted, Limits
from animat.errors import InvalidArgument, Mismatch, UnusableData, expect_at_least, in_min
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Channels, Recording
from animat.stimulation.frequency import distinct, is_same
from animat.stimulation.patterns import Patterns
from animat.stimulation.schedule import RESPONSE_S
from animat.stimulation.stimulus import Stimulus, is_last_of
from animat.tables import UNKNOWN

NS = 1_000_000_000
REACH_S = 1.0
"""Length of a response, unless another stimulus came sooner: longer than any response window."""


class ReplayCulture(ComputedCulture):
    """A culture made of recordings: a stimulus at f is answered by the spikes that followed a recorded one at f.

    The last pulse of a trial is answered by a recorded last pulse, the others by other pulses, if there are any; among
    these by one on the same electrodes, if there are any; a stimulus without a frequency by one of any frequency. The
    newest recording at the culture's clock answers; the clock starts where the first recording did. There is no other
    memory and no activity between responses.

    Args:
        recordings: of one culture, at least one, with stimuli of known frequencies and electrodes.
        seed: decides which response is drawn; 0 or more.
        limits: tighter limits than `SIMULATED_LIMITS`.

    Raises:
        InvalidArgument: for no recordings, or a seed below 0.
        Mismatch: for recordings with different channels.
        UnusableData: for a recording without stimuli of known frequency and electrodes.
    """

    name: ClassVar[str] = "replay"
    recorded_as = RecordedCulture("replay")

    @checked_arguments
    def __init__(self, recordings: Sequence[Recording], *, seed: int = 0, limits: Limits | None = None) -> None:
        super().__init__(limits)
        if not recordings:
            raise InvalidArgument("recordings: expected at least one to answer from, got none")
        expect_at_least("seed", seed, 0)
        self._recordings = sorted(recordings, key=lambda recording: recording.start_min)
        first = self._recordings[0]
        for recording in self._recordings:
            if recording.channels.label.tolist() != first.channels.label.tolist():
                minutes = f"{in_min(recording.start_min)} differ from those at {in_min(first.start_min)}"
                raise Mismatch(f"recordings: expected the same channels in all, but those at {minutes}")
            stimuli = recording.stimuli
            for what, is_known in (
                ("frequency", np.isfinite(stimuli.frequency_hz)),
                ("electrodes", stimuli.electrodes != UNKNOWN),
            ):
                if not np.any(is_known):
                    expected = f"stimuli of known frequency and electrodes, got none of known {what}"
                    why = "a replay answers by frequency, and is stimulated on electrodes"
                    where = f"the recording at {in_min(recording.start_min)}"
                    raise UnusableData(f"{where}: expected {expected}: {why}; add the {what} to the table of stimuli")
        self._seed = seed
        self._patterns = _patterns(first)
        self._zero_s = 60.0 * first.start_min
        self._now_ns = 0
        self._answered = 0
        self._sets = [_numbered_sets(recording.stimuli.electrodes) for recording in self._recordings]
        self._pending_ns, self._pending_channel = np.empty(0, np.int64), np.empty(0, np.int64)

    @property
    def channels(self) -> Channels:
        return self._recordings[0].channels

    @property
    def stimulation_electrodes(self) -> tuple[int, ...]:
        """The electrodes stimulated in the recordings, also on places, which need not be patterns."""
        stimulated = np.unique(np.concatenate([each.stimuli.electrodes.ravel() for each in self._recordings]))
        return tuple(stimulated[stimulated != UNKNOWN].tolist())

    @property
    def patterns(self) -> Patterns:
        return self._patterns

    @property
    def now_s(self) -> float:
        """The culture's clock, which begins at the start of the first recording."""
        return self._zero_s + self._now_ns / NS

    @property
    def sampling_rate_hz(self) -> float:
        """The rate of the recordings; 20 kHz if it is not known."""
        rate_hz = self._recordings[0].sampling_rate_hz
        return rate_hz if np.isfinite(rate_hz) else 20_000.0

    @property
    def provenance(self) -> dict[str, str]:
        return {
            "source": "replay of recordings by animat.cultures.replay",
            "replayed minutes": ", ".join(f"{recording.start_min:g}" for recording in self._recordings),
            "how": "draw",
            "seed": str(self._seed),
            **{f"replayed {name}": text for name, text in self._recordings[0].provenance.items()},
        }

    def _open(self) -> None:
        pass

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        start_ns, end_ns = self._now_ns, self._now_ns + round(duration_s * NS)
        numbers = np.array([stimulus.presentation for stimulus in admitted.stimuli])
        # All answers are found before anything changes: a request with an unrecorded condition must leave no trace.
        answers = [
            (start_ns + round(stimulus.time_s * NS), self._candidates(stimulus, is_last))
            for stimulus, is_last in zip(admitted.stimuli, is_last_of(numbers), strict=True)
        ]
        for time_ns, (recording, pool) in answers:
            chosen = np.random.default_rng([self._seed, 13, self._answered]).integers(len(pool))
            self._answered += 1
            self._insert_response(time_ns, recording, int(pool[chosen]))
        known = int(np.searchsorted(self._pending_ns, end_ns))
        spikes = Spikes((self._pending_ns[:known] - start_ns) / NS, self._pending_channel[:known])
        self._pending_ns, self._pending_channel = self._pending_ns[known:], self._pending_channel[known:]
        self._now_ns = end_ns
        stimulus_s = np.array([time_ns - start_ns for time_ns, _ in answers], dtype=np.float64) / NS
        return Observed(self._zero_s + start_ns / NS, (end_ns - start_ns) / NS, spikes, stimulus_s)

    def _candidates(self, stimulus: Stimulus, is_last: bool) -> tuple[Recording, Int64[np.ndarray, " pulses"]]:
        """The recorded pulses that may answer, and their recording."""
        minute = (self.now_s + stimulus.time_s) / 60
        row = max(0, sum(recording.start_min <= minute for recording in self._recordings) - 1)
        recording = self._recordings[row]
        stimuli, frequency_hz = recording.stimuli, recording.stimuli.frequency_hz
        same = is_same(frequency_hz, stimulus.frequency_hz) | np.isnan(stimulus.frequency_hz)
        number_of, set_of_pulse = self._sets[row]
        electrodes = number_of.get(frozenset(stimulus.electrodes), UNKNOWN)
        # A response that goes beyond the end of the recording is not known: it answers only if no other can.
        is_whole = stimuli.time_s + RESPONSE_S <= recording.stop_s
        for narrower in (
            ~stimuli.is_rest,
            is_whole,
            stimuli.is_last_of_presentation == is_last,
            set_of_pulse == electrodes,
        ):
            same = same & narrower if np.any(same & narrower) else same
        pool = np.flatnonzero(same)
        if not len(pool):
            known = ", ".join(f"{f:g}" for f in distinct(frequency_hz))
            expected = f"frequency_hz: expected one that was recorded ({known} Hz)"
            raise InvalidArgument(f"{expected}, got {stimulus.frequency_hz:g}: a replay cannot answer others")
        return recording, pool

    def _insert_response(self, time_ns: int, recording: Recording, pulse: int) -> None:
        """Insert the spikes that followed a recorded pulse after this one, replacing those still pending."""
        since_s, *next_s = recording.stimuli.time_s[pulse : pulse + 2].tolist()
        first, last = np.searchsorted(recording.spike_times_s, [since_s, min([since_s + REACH_S, *next_s])])
        since_ns = np.rint((recording.spike_times_s[first:last] - since_s) * NS).astype(np.int64)
        kept = int(np.searchsorted(self._pending_ns, time_ns))
        self._pending_ns = np.concatenate([self._pending_ns[:kept], time_ns + since_ns])
        self._pending_channel = np.concatenate([self._pending_channel[:kept], recording.spike_channels[first:last]])

    def _rest(self, duration_s: float) -> None:
        self._now_ns += round(duration_s * NS)
        kept = self._pending_ns >= self._now_ns
        self._pending_ns, self._pending_channel = self._pending_ns[kept], self._pending_channel[kept]


def _patterns(recording: Recording) -> Patterns:
    """Electrodes of each pattern, by number; if patterns have no numbers, each distinct set is a pattern."""
    stimuli = recording.stimuli
    has_electrodes = np.any(stimuli.electrodes != UNKNOWN, axis=1)
    numbered = has_electrodes & (stimuli.pattern != UNKNOWN)
    if np.any(numbered):
        _, first = np.unique(stimuli.pattern[numbered], return_index=True)
        return np.asarray(stimuli.electrodes[numbered][first])
    return np.asarray(np.unique(stimuli.electrodes[has_electrodes], axis=0))


def _numbered_sets(electrodes: Patterns) -> tuple[dict[frozenset[int], int], Int64[np.ndarray, " pulses"]]:
    """A number for each set of electrodes, and the number of each pulse's set."""
    rows, number = np.unique(np.sort(electrodes, axis=1), axis=0, return_inverse=True)
    return {frozenset(row) - {UNKNOWN}: i for i, row in enumerate(rows.tolist())}, number.reshape(-1)
