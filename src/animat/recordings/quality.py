"""Findings about a recording: those from reading its file, and those seen in its data."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from animat.errors import counted, some_of
from animat.recordings.findings import Finding
from animat.recordings.recording import Recording, ResponseTable
from animat.recordings.time_quality import common_factor, frequency_findings, silence_findings, time_findings
from animat.stimulation.frequency import is_same
from animat.tables import UNKNOWN

MANY_STIMULI = 100
STIMULI_PER_SPIKE = 10.0
"""From this ratio on spikes and stimuli must be swapped: nothing can be learned from such rare responses."""
DUPLICATES = 0.03, 20
"""Share of the spikes above which duplicates are reported, and the fewest that are."""
MOSTLY_SILENT = 0.5
FAST_HZ = 100.0
"""On average over a recording: the few neurons near one electrode cannot fire so fast for minutes."""
HOLDS_MOST, SEVERAL, NAMED = 1 / 3, 8, 6
PARTS, STEADY, STOPPED_PARTS, STOPPED_S = 20, 0.9, 5, 60.0
"""A channel has stopped if it fired in this share of a recording's parts, or more, up to its last spike, and is then
silent for so many parts and seconds; by chance hardly one of 10,000 does."""
STOPPED_SHARE = 0.05
SLOWEST_HZ = 1000.0
"""A spike lasts a millisecond: no array is sampled more slowly."""
PITCH_UM = 2.0, 20_000.0
"""Between these is the distance of neighbouring electrodes of all arrays, with a wide margin."""


def recording_findings(recording: Recording | ResponseTable) -> tuple[Finding, ...]:
    """All findings about a recording (docs/recordings.md lists them): those from its file, then those in its data.

    For a response table, which has no spikes, only the former and those on its stimuli.
    """
    found = _in_table(recording) if isinstance(recording, ResponseTable) else _in_data(recording)
    known = {finding.name for finding in recording.findings}
    return (*recording.findings, *(finding for finding in found if finding.name not in known))


def _in_table(table: ResponseTable) -> Iterable[Finding]:
    if table.has_times and (stated := common_factor(table.stimuli)) is not None:
        yield stated
    else:
        yield from frequency_findings(table.stimuli, has_times=table.has_times)
    yield from _stimulus_rows(table)


def _in_data(recording: Recording) -> Iterable[Finding]:
    channels, stimuli = recording.channels, recording.stimuli
    if not len(stimuli):
        n = len(recording.spike_times_s)
        message = f"{counted(n, 'spike')} but no stimuli: no responses to learn from; provide the stimulus times too"
        yield Finding("no-stimuli", "refuse", message)
    if not len(recording.spike_times_s):
        yield Finding("no-spikes", "refuse", f"no spike on any of {len(channels):,} channels: nothing can be learned")
    else:
        yield from _on_channels(recording)
    yield from time_findings(recording)
    yield from silence_findings(recording)
    if recording.sampling_rate_hz < SLOWEST_HZ:
        message = f"no spikes can be detected at a sampling rate of {recording.sampling_rate_hz:g} Hz: is it in kHz?"
        yield Finding("sampling-rate", "warning", message, recording.sampling_rate_hz)
    yield from _duplicates(recording)
    n_spikes = len(recording.spike_times_s)
    if len(stimuli) >= MANY_STIMULI and 0 < n_spikes < len(stimuli):
        ratio = len(stimuli) / n_spikes
        message = f"{len(stimuli):,} stimuli for {n_spikes:,} spikes: are spikes and stimuli swapped?"
        yield Finding("more-stimuli-than-spikes", "refuse" if ratio >= STIMULI_PER_SPIKE else "note", message, ratio)
    yield from _stimulus_rows(recording)
    if unknown := int(np.count_nonzero(np.all(stimuli.electrodes == UNKNOWN, axis=1) & ~stimuli.is_rest)):
        message = f"the electrodes of {unknown:,} of {len(stimuli):,} stimuli are not known; a replay needs them"
        yield Finding("stimulus-electrodes-unknown", "note", message, float(unknown))
    if len(stimuli) and recording.presentation is None:
        how = "how the stimuli were presented (blocked or mixed, pulses per trial)"
        message = f"{how} is not known, so a closed loop cannot check that it presents them in the same way"
        yield Finding("presentation-unknown", "note", message)


def _stimulus_rows(recording: Recording | ResponseTable) -> Iterable[Finding]:
    """Findings on rows of the stimulus table that are not single stimuli."""
    times_s = recording.stimuli.time_s
    yield from _unlike_stated_order(recording)
    last = recording.stimuli.is_last_of_presentation
    if same := int(np.count_nonzero((np.diff(times_s) == 0) & last[:-1])):
        found = f"{same:,} of {len(times_s):,} stimuli come at exactly the same time as the previous one"
        remedy = "if they are electrodes of one stimulus, put them into one row"
        message = f"{found}, and the response is counted for each: {remedy}"
        yield Finding("simultaneous-stimuli", "refuse", message, float(same))

    frequency_hz, trial = recording.stimuli.frequency_hz, recording.stimuli.presentation
    # Unknown frequencies (NaN) differ from each other too, and do not count.
    differs = ~is_same(frequency_hz[1:], frequency_hz[:-1]) & ~np.isnan(frequency_hz[1:]) & ~np.isnan(frequency_hz[:-1])
    if several := len(np.unique(trial[1:][differs & (np.diff(trial) == 0)])):
        found = f"{several:,} of {np.count_nonzero(last):,} trials have pulses of several frequencies"
        counts = "the response counts for that of the last pulse: correct the frequencies or stimulus_presentation"
        message = f"{found}, and {counts}"
        yield Finding("trials-of-several-frequencies", "warning", message, float(several))


def _unlike_stated_order(recording: Recording | ResponseTable) -> Iterator[Finding]:
    """A finding on trials whose frequencies are not in the stated order; those of a protocol are."""
    frequency_hz = recording.stimuli.frequency_hz[recording.stimuli.is_last_of_presentation]
    frequency_hz = frequency_hz[~np.isnan(frequency_hz)]
    if recording.presentation is None or recording.protocol is not None or len(frequency_hz) < MANY_STIMULI:
        return
    shares = np.unique(frequency_hz, return_counts=True)[1] / len(frequency_hz)
    # In random order, the share of trials with another frequency than the one before.
    mixed, order = 1 - float(np.sum(shares**2)), recording.presentation.order
    changes = float(np.mean(~is_same(frequency_hz[1:], frequency_hz[:-1])))
    if len(shares) > 1 and (changes > mixed / 2) != (order == "mixed"):
        found = f"the frequency changes {'from trial to trial' if changes > mixed / 2 else 'hardly ever'}"
        message = f"stimuli are stated to be {order}, but {found} ({100 * changes:.0f} % of the trials): correct it"
        yield Finding("other-order", "warning", message, changes)


def _duplicates(recording: Recording) -> Iterable[Finding]:
    """A finding on spikes with the same channel and time, which is impossible."""
    same = (np.diff(recording.spike_times_s) == 0) & (np.diff(recording.spike_channels) == 0)
    n, share = int(np.count_nonzero(same)), float(np.mean(same)) if len(same) else 0.0
    if share > DUPLICATES[0] and n >= DUPLICATES[1]:
        same_as = f"({100 * share:.0f} %) come at exactly the same time as another on their channel"
        asked = "are they in the file twice, or are times coarse? Each counts; provide them once"
        message = f"{n:,} of {len(recording.spike_times_s):,} spikes {same_as}: {asked}"
        yield Finding("duplicate-spikes", "warning", message, share)


def _on_channels(recording: Recording) -> Iterator[Finding]:
    """Findings on silent channels, and on noisy ones, which fire too fast or have too many of all spikes."""
    channels = recording.channels
    n, n_spikes = len(channels), len(recording.spike_times_s)
    count = np.bincount(recording.spike_channels, minlength=n)
    if silent := int(np.count_nonzero(count == 0)):
        mostly = silent > MOSTLY_SILENT * n
        message = f"channels without a spike: {silent:,} of {n:,}; they count in rates per channel"
        message += ": route electrodes where the culture fires" if mostly else ""
        yield Finding("silent-channels", "warning" if mostly else "note", message, float(silent))
    fast = count > FAST_HZ * recording.duration_s if recording.duration_s > 0 else np.zeros(n, dtype=bool)
    most = (count > HOLDS_MOST * n_spikes) if n >= SEVERAL and n_spikes >= 10 * n else np.zeros(n, dtype=bool)
    noisy = np.flatnonzero(fast | most)
    if len(noisy):
        share, names = float(count[noisy].sum() / n_spikes), channels.label[noisy].tolist()
        which = f"{len(noisy):,} of {n:,} ({some_of(names, NAMED)}), with {100 * share:.0f} % of all spikes"
        remedy = "raise their threshold or leave them out of the routing"
        message = f"channels that fire as no neuron does: {which}; {remedy}"
        yield Finding("noisy-channels", "warning" if share > 0.1 else "note", message, float(len(noisy)))
    yield from _stopped_channels(recording)
    yield from _impossible_positions(recording)


def _impossible_positions(recording: Recording) -> Iterator[Finding]:
    """A finding on positions between which no array has its electrodes."""
    channels = recording.channels
    # Several channels may be units of one electrode.
    _, first = np.unique(channels.electrode, return_index=True)
    kept = np.union1d(first[channels.electrode[first] >= 0], np.flatnonzero(channels.electrode < 0))
    x_um, y_um = (axis[kept][~np.isnan(axis[kept])] for axis in (channels.x_um, channels.y_um))
    if len(x_um) < SEVERAL or len(x_um) != len(y_um):
        return
    width_um, height_um = float(np.ptp(x_um)), float(np.ptp(y_um))
    # In a rectangle, or in a line.
    apart_um = max((width_um * height_um / len(x_um)) ** 0.5, max(width_um, height_um) / len(x_um))
    if not PITCH_UM[0] < apart_um < PITCH_UM[1]:
        message = (
            f"{len(x_um):,} electrodes in {width_um:.3g} um x {height_um:.3g} um would be {apart_um:.2g} um "
            "apart: provide their positions in micrometres"
        )
        yield Finding("positions-not-in-um", "warning", message, apart_um)


def _stopped_channels(recording: Recording) -> Iterator[Finding]:
    """A finding on channels that fire steadily and from some time on not at all: a lost contact, a dead site."""
    part_s, n = recording.duration_s / PARTS, len(recording.channels)
    if part_s * STOPPED_PARTS < STOPPED_S:
        return
    part = np.clip((recording.spike_times_s - recording.start_s) // part_s, 0, PARTS - 1).astype(np.int64)
    fired = np.bincount(recording.spike_channels * PARTS + part, minlength=n * PARTS).reshape(n, PARTS) > 0
    until = np.where(fired.any(axis=1), PARTS - np.argmax(fired[:, ::-1], axis=1), 0)
    stopped = (fired.sum(axis=1) >= STEADY * until) & (until >= STOPPED_PARTS) & (until <= PARTS - STOPPED_PARTS)
    if not (several := int(np.count_nonzero(stopped))):
        return
    last_s = recording.start_s + part_s * until[stopped]
    first, last = f"{last_s.min():.0f} s", f"{last_s.max():.0f} s"
    when = f"at about {last}" if first == last else f"between {first} and {last}"
    which = f"{several:,} of {n:,} ({some_of(recording.channels.label[stopped].tolist(), NAMED)})"
    remedy = "they count in rates per channel: check their contact, or leave them out of the routing"
    message = f"channels that fire steadily and then stop, {when}: {which}; {remedy}"
    is_many = several > STOPPED_SHARE * np.count_nonzero(until)
    yield Finding("stopped-channels", "warning" if is_many else "note", message, float(several))
