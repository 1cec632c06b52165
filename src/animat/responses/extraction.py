"""From recordings, or response tables without spike times, to their responses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, Mismatch, UnusableData, did_you_mean, in_min
from animat.recordings.columns import pattern_names
from animat.recordings.findings import Finding
from animat.recordings.quality import recording_findings
from animat.recordings.recording import Recording, ResponseTable
from animat.responses.bursts import separate_bursts
from animat.responses.conditions import NO_CONDITION, ByInterval, Conditions, conditions_named, default_conditions
from animat.responses.quality.one_culture import series_findings
from animat.responses.quality.responses import findings_on
from animat.responses.readouts import ALL, Readouts, readouts_on
from animat.responses.responses import Responses, Trials
from animat.responses.windows import DEFAULT_WINDOW_MS, Window, check_window, read_windows

SILENCE_S = 1.05
"""A longer time without a pulse is silence; not that between pulses at 1 Hz, which come a little early or late."""
REFUSING = (
    "no-stimuli",
    "no-spikes",
    "no-condition",
    "one-condition",
    "empty-condition",
    "dead-window",
    "times-not-in-seconds",
    "more-stimuli-than-spikes",
    "simultaneous-stimuli",
    "several-cultures",
)
"""Names of the findings that make training pointless; a user may allow them."""
_NOTHING_TO_FIT = ("no-stimuli", "no-condition", "empty-condition")
"""Those after which no simulator can be fitted, even if they are allowed."""


@checked_arguments
def extract_responses(
    source: Recording | ResponseTable,
    by: Conditions | str | None = None,
    window_ms: Window | None = None,
    burst_threshold: float | None = None,
    readouts: str | Readouts = ALL,
) -> Responses:
    """The response to the last pulse of every trial that has a condition.

        x = S / (T N)

    with S the spikes from window_ms[0] up to, not including, window_ms[1] after the pulse (see
    `animat.responses.windows.count_spikes` for the edges), T the length of the window and N the number of channels. For
    a table, x is the mean over channels of count / T, or of the rate; channels with a count or rate above 0 are active.

    Trials without a condition, and those whose window runs past the end of the recording, are left out and counted in
    `findings`, which also reports everything else that makes the responses doubtful.

    Args:
        source: spikes, or the response of each channel to each stimulus.
        by: the conditions, or their text form (`conditions_named`); None: by frequency, or places if there are any.
        window_ms: start and end of the window after the pulse; None: a table's own window, otherwise the paper's, 2 to
            10 ms. For a table that does not state its window, this is the one in which its spikes were counted.
        burst_threshold: a ratio of active channels to use in place of Otsu's threshold; 1 keeps every response.
        readouts: groups of channels whose x is read too, or `halves` or `quadrants`; bursts are those of all channels.

    Raises:
        InvalidArgument: for a window that does not follow the stimulus, or conditions that cannot be read.
        UnusableData: without channels, or for conditions by interval with a table without times.
        Mismatch: for channels that do not read all electrodes of the readouts, or a window unlike the table's.

    Source: the paper's methods (2-10 ms, x = S_total / (T N), Otsu's threshold, here only where it finds two groups).
    """
    given_ms = None if window_ms is None else check_window(window_ms)
    window_ms = given_ms or DEFAULT_WINDOW_MS
    stimuli, n_channels = source.stimuli, len(source.channels)
    if not n_channels:
        what = "recording" if isinstance(source, Recording) else "table"
        raise UnusableData(f"channels: expected at least one, got a {what} without any; x is a mean over channels")
    readouts = readouts_on(readouts, source.channels)
    by = conditions_named(by) if isinstance(by, str) else by or default_conditions(stimuli, source.protocol)
    assignment = by.assign(stimuli)
    # A rest has no condition that pulses have too: what is read after it is no response to a stimulus.
    shared = stimuli.is_rest & np.isin(assignment.condition, assignment.condition[~stimuli.is_rest])
    assignment = replace(assignment, condition=np.where(shared, NO_CONDITION, assignment.condition))
    begins, setup_s = _blocks(source)
    assumed: tuple[Finding, ...] = ()
    # Whether the window after each stimulus ends within the recording; of a table, all do.
    inside = np.ones(len(stimuli), np.bool_)
    if isinstance(source, ResponseTable):
        window_ms, assumed = _window_of(source, by, given_ms)
    else:
        # 1e-9: the end of the recording may be the rounded time of its last stimulus or spike.
        inside = stimuli.time_s + window_ms[1] * 1e-3 <= _observed_until_s(source, begins) + 1e-9
    # Trials without a condition are read too, as the history of others.
    presented = np.flatnonzero(stimuli.is_last_of_presentation & inside)
    rate_hz, active_ratio = _read(source, presented, window_ms)
    condition = assignment.condition[presented]
    chosen = condition != NO_CONDITION
    bursts = separate_bursts(active_ratio[chosen], burst_threshold, n_channels=n_channels)
    # Silence is measured between pulses: a trial of several, however long, has none. Rows without times are taken as
    # successive, and nothing is known about what came before the first.
    has_times = isinstance(source, Recording) or source.has_times
    waits_s = begins * setup_s
    since_s = np.diff(stimuli.time_s, prepend=-np.inf) + waits_s
    silences = np.cumsum(since_s > SILENCE_S)
    is_rested = (np.diff(silences[presented], prepend=0) > 0) & has_times
    time_s = stimuli.time_s[presented] if has_times else None
    set_up_s = np.cumsum(waits_s)[presented] if has_times and waits_s.any() else None
    responses = Responses(
        condition=condition[chosen],
        rate_hz=rate_hz[chosen],
        active_ratio=active_ratio[chosen],
        is_burst=bursts.is_burst,
        conditions=assignment.conditions,
        window_ms=window_ms,
        n_channels=n_channels,
        threshold=bursts.threshold,
        separability=bursts.separability,
        presentation=source.presentation,
        start_min=source.start_min,
        recorded_at=source.recorded_at,
        time_s=None if time_s is None else time_s[chosen],
        presented=Trials(condition, rate_hz, active_ratio > bursts.threshold, is_rested, time_s, set_up_s),
        place=np.flatnonzero(chosen),
        by=str(by),
        burst_threshold=burst_threshold,
        culture=source.culture,
        pattern_names=pattern_names(source.provenance),
        channels=source.channels,
        readouts=readouts,
        readout_hz=None if readouts.are_all else _read_groups(source, presented[chosen], window_ms, readouts),
        recording=source.without_spikes() if isinstance(source, Recording) else None,
    )
    return replace(responses, findings=(*assumed, *findings_on(responses, source, assignment, bursts, inside)))


def _read(
    source: Recording | ResponseTable, presented: Int64[np.ndarray, " trials"], window_ms: Window
) -> tuple[Float64[np.ndarray, " trials"], Float64[np.ndarray, " trials"]]:
    """x of all channels, and the ratio of active ones, after these stimuli."""
    if isinstance(source, Recording):
        return read_windows(source, source.stimuli.time_s[presented], window_ms)
    values = source.values[presented]
    return values.mean(axis=1) * _hz_per_unit(source, window_ms), np.mean(values > 0, axis=1)


def _read_groups(
    source: Recording | ResponseTable, presented: Int64[np.ndarray, " trials"], window_ms: Window, readouts: Readouts
) -> Float64[np.ndarray, "trials *readouts"]:
    """x of each readout after these stimuli."""
    members = readouts.members(source.channels)
    if isinstance(source, Recording):
        return readouts.read(source, members, source.stimuli.time_s[presented], window_ms)
    values = source.values[presented]
    of_each = np.stack([values[:, group].mean(axis=1) for group in members], axis=-1)
    return readouts.squeeze(of_each * _hz_per_unit(source, window_ms))


def _hz_per_unit(table: ResponseTable, window_ms: Window) -> float:
    """What a table's values are multiplied by to be in Hz."""
    return 1.0 if table.kind == "rate_hz" else 1 / ((window_ms[1] - window_ms[0]) * 1e-3)


def _blocks(source: Recording | ResponseTable) -> tuple[Bool[np.ndarray, " stimuli"], float]:
    """Whether a block begins with each stimulus, and the set-up before it, which the recording's clock leaves out."""
    protocol, stimuli = source.protocol, source.stimuli
    if protocol is None or protocol.order != "blocked":
        return np.zeros(len(stimuli), bool), 0.0
    trial = np.cumsum(np.diff(stimuli.presentation, prepend=-2) != 0) - 1
    return np.diff(trial // protocol.trials, prepend=-1) != 0, protocol.setup_s


def _observed_until_s(recording: Recording, begins: Bool[np.ndarray, " stimuli"]) -> Float64[np.ndarray, " stimuli"]:
    """How long what follows each stimulus was observed: to the end of the recording, or of its block."""
    until_s = np.full(len(begins), recording.stop_s)
    last = np.flatnonzero(begins)[1:] - 1
    if recording.protocol is not None:
        until_s[last] = recording.stimuli.time_s[last] + recording.protocol.tail_s
    return until_s


def _window_of(table: ResponseTable, by: Conditions, given_ms: Window | None) -> tuple[Window, tuple[Finding, ...]]:
    """The window in which a table's spikes were counted, and a finding if the table does not state it."""
    if isinstance(by, ByInterval) and not table.has_times:
        raise UnusableData("conditions: expected no intervals, as the table has no stimulus times")
    window_ms = given_ms or DEFAULT_WINDOW_MS
    if table.window_ms is not None and given_ms not in (None, table.window_ms):
        raise Mismatch(
            f"window_ms: expected {table.window_ms[0]:g} to {table.window_ms[1]:g}, in which the table's spikes were "
            f"counted, got {window_ms[0]:g} to {window_ms[1]:g}; leave the window out"
        )
    if table.window_ms is not None:
        return table.window_ms, ()
    unstated = "the table does not state the window in which its spikes were counted"
    after = f"{window_ms[0]:g} to {window_ms[1]:g} ms after the stimulus"
    if given_ms is not None:
        return window_ms, (Finding("window-assumed", "note", f"{unstated}: {after} were given"),)
    in_a_loop = f"{after} is assumed, in which a closed loop would count them; give it with --window-ms, or in the file"
    return window_ms, (Finding("window-assumed", "warning", f"{unstated}: {in_a_loop}"),)


@checked_arguments
def extract_series(
    recordings: Sequence[Recording | ResponseTable],
    by: Conditions | str | None = None,
    window_ms: Window | None = None,
    *,
    burst_threshold: float | None = None,
    allow: Sequence[str] = (),
    readouts: str | Readouts = ALL,
) -> list[Responses]:
    """Extract the responses of recordings, to fit simulators to them.

    Args:
        recordings: of one culture; or response tables.
        by, window_ms, burst_threshold: as in `extract_responses`.
        allow: names of findings (`"dead-window"`) to ignore.
        readouts: groups of channels, the same electrodes in all; `halves` and `quadrants` are those of the first.

    Raises:
        UnusableData: if a finding refuses a recording, or all of them together, unless `allow` names it.
        InvalidArgument: for conditions that cannot be read, another name in `allow`, or channels that form no readouts.
        Mismatch: for a recording whose channels do not read all electrodes of the readouts.
    """
    check_allowed(allow)
    by = conditions_named(by) if isinstance(by, str) else by
    series = []
    for recording in recordings:
        try:
            readouts = readouts_on(readouts, recording.channels)
            responses = extract_responses(recording, by, window_ms, burst_threshold, readouts)
        except (UnusableData, Mismatch) as error:
            # Appended, as the message begins with the argument.
            raise type(error)(f"{error} (the recording at {in_min(recording.start_min)})") from error
        responses = replace(responses, findings=(*_on_recording(recording, responses), *responses.findings))
        for finding in responses.findings:
            if finding.severity == "refuse" and finding.name not in allow:
                can_fit = finding.name not in _NOTHING_TO_FIT
                remedy = f" (to allow it: {_allowing(finding)}, or in a study simulators.allow)" if can_fit else ""
                raise UnusableData(f"the recording at {in_min(recording.start_min)}: {finding.message}{remedy}")
        series.append(responses)
    for finding in series_findings(series):
        if finding.severity == "refuse" and finding.name not in allow:
            raise UnusableData(f"recordings: {finding.message} (to allow it: {_allowing(finding)})")
    return series


def _on_recording(recording: Recording | ResponseTable, responses: Responses) -> Iterator[Finding]:
    """What refuses the recording, and its warnings but those that the responses have, too: theirs say more."""
    known = {finding.name for finding in responses.findings}
    for finding in recording_findings(recording):
        if finding.severity == "refuse" or (finding.severity == "warning" and finding.name not in known):
            yield finding


def _allowing(finding: Finding) -> str:
    return f"--allow {finding.name}, in Python allow=['{finding.name}']"


def check_allowed(names: Sequence[str]) -> None:
    """Raise InvalidArgument unless all are names of refusing findings: a misspelt one would have no effect."""
    for name in names:
        if name not in REFUSING:
            raise InvalidArgument(
                f"allow: expected findings among {', '.join(REFUSING)}, got {name!r}{did_you_mean(name, REFUSING)}"
            )
