"""Responses of a table of counts or rates, without times of spikes; and of whatever responses can be had from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from animat.errors import Mismatch, UnusableData
from animat.neurons.bursts import separate_bursts
from animat.neurons.conditions import NO_CONDITION, ByInterval, Conditions, default_conditions
from animat.neurons.quality import findings_without_times
from animat.neurons.responses import SILENCE_S, Presented, Responses, extract_responses
from animat.neurons.windows import DEFAULT_WINDOW_MS, check_window
from animat.recordings.findings import Finding
from animat.recordings.recording import Recording
from animat.recordings.response_table import ResponseTable


def responses_of(
    source: Recording | ResponseTable,
    by: Conditions | None = None,
    window_ms: tuple[float, float] = DEFAULT_WINDOW_MS,
    burst_threshold: float | None = None,
) -> Responses:
    """The responses of a recording (`extract_responses`) or of a table (`responses_of_table`)."""
    if isinstance(source, Recording):
        return extract_responses(source, by, window_ms, burst_threshold)
    return responses_of_table(source, by, window_ms, burst_threshold)


def responses_of_table(
    table: ResponseTable,
    by: Conditions | None = None,
    window_ms: tuple[float, float] = DEFAULT_WINDOW_MS,
    burst_threshold: float | None = None,
) -> Responses:
    """The response to the last pulse of every presentation that has a condition, of a table of counts or rates.

        x = mean over channels of count / T, or of the rate;  active: channels with a count or rate above 0

    Args:
        table: what each channel did after each stimulus.
        by: what makes a condition; by frequency where it is known, else all in one.
        window_ms: the window that was counted in, where the table does not say; one that it says goes before the
            default one.
        burst_threshold: a ratio of active channels to use in place of Otsu's threshold; 1 keeps every response.

    Raises:
        InvalidArgument: for a window that is not a stretch of time after the stimulus.
        Mismatch: for another window than the table's.
        UnusableData: for a table without channels, or conditions by interval where it has no times.
    """
    check_window(window_ms)
    if table.window_ms is not None and window_ms not in (DEFAULT_WINDOW_MS, table.window_ms):
        raise Mismatch(
            f"window_ms: expected {table.window_ms[0]:g} to {table.window_ms[1]:g}, in which the table's spikes were "
            f"counted, got {window_ms[0]:g} to {window_ms[1]:g}; leave the window out"
        )
    if not len(table.channels):
        raise UnusableData("channels: expected at least one, got a table without any; x is a mean over channels")
    if isinstance(by, ByInterval) and not table.has_times:
        raise UnusableData("conditions: expected others than intervals, as the table has no times of stimuli")
    start_ms, end_ms = table.window_ms or window_ms
    stimuli = table.stimuli
    by = by or default_conditions(stimuli)
    assignment = by.assign(stimuli)
    scale = 1.0 if table.kind == "rate_hz" else 1 / ((end_ms - start_ms) * 1e-3)
    presented = np.flatnonzero(stimuli.is_last_of_presentation)
    rate_hz = table.values[presented].mean(axis=1) * scale
    active_ratio = np.mean(table.values[presented] > 0, axis=1)
    chosen = assignment.condition[presented] != NO_CONDITION
    bursts = separate_bursts(active_ratio[chosen], burst_threshold, n_channels=len(table.channels))
    silences = np.cumsum(np.diff(stimuli.time_s, prepend=-np.inf) > SILENCE_S)
    # Rows without times follow each other; nothing is known of what was before the first.
    is_rested = np.diff(silences[presented], prepend=0) > 0 if table.has_times else np.zeros(len(presented), np.bool_)
    responses = Responses(
        condition=assignment.condition[presented][chosen],
        rate_hz=rate_hz[chosen],
        active_ratio=active_ratio[chosen],
        is_burst=bursts.is_burst,
        conditions=assignment.conditions,
        window_ms=(start_ms, end_ms),
        n_channels=len(table.channels),
        threshold=bursts.threshold,
        separability=bursts.separability,
        presentation=table.presentation,
        start_min=table.start_min,
        time_s=stimuli.time_s[presented][chosen] if table.has_times else None,
        presented=Presented(assignment.condition[presented], rate_hz, active_ratio > bursts.threshold, is_rested),
        place=np.flatnonzero(chosen),
        by=str(by),
        burst_threshold=burst_threshold,
    )
    found = findings_without_times(responses, stimuli, assignment, bursts)
    return replace(responses, findings=(*_assumed(table, (start_ms, end_ms)), *found))


def _assumed(table: ResponseTable, window_ms: tuple[float, float]) -> tuple[Finding, ...]:
    if table.window_ms is not None:
        return ()
    return (
        Finding(
            "window-assumed",
            "warning",
            f"the table does not say in which window its spikes were counted: {window_ms[0]:g} to {window_ms[1]:g} ms "
            "after the stimulus are assumed, in which a closed loop would count them; say it with --window-ms, or in "
            "the file",
        ),
    )
