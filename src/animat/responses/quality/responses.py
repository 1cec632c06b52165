"""Every finding on a recording's responses: what makes them doubtful, what it means and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Bool

from animat.errors import counted, some_of
from animat.recordings.findings import Finding
from animat.recordings.recording import Recording, ResponseTable
from animat.responses.bursts import LEAST_RESPONSES, BurstSeparation
from animat.responses.condition import RESTING
from animat.responses.conditions import NO_CONDITION, Assignment, conditions_named
from animat.responses.psth import ResponseTime, find_response, post_stimulus_histogram, spontaneous_rate
from animat.responses.quality.drift import drift_findings
from animat.responses.quality.history import memory_findings, repetition_findings
from animat.responses.quality.timing import artefact_findings, resolution_findings
from animat.responses.readouts import CUT_NAMES
from animat.responses.responses import Responses
from animat.stimulation.stimulus import Stimuli

FEW_SAMPLES = 30
"""With fewer non-burst responses of a condition, its distribution is little more than a guess."""
MANY_BURSTS = 0.25
SMALL_DIFFERENCE = 0.1
"""If P(x >= P50) of all conditions differ by less, a policy has nothing to choose between."""
LITTLE_DIFFERENCE = 0.2
"""If they differ by less, a robot can hardly be steered: an organoid's 0.16 is worth 7 of the cartpole's 200
(docs/evidence/optimal-return.md)."""

_WINDOW_PARTS = 8
_PLACES = {CUT_NAMES["halves"]: "corners", CUT_NAMES["quadrants"]: "quadrants"}
"""The places to record for such readouts."""
_MOST_LISTED = 16
"""Conditions with few responses that have a finding each."""
_NAMED_ALONE = ("frequency", "electrode", "pattern")
"""Kinds of conditions that may be named without values: all that occur in a recording."""


def findings_on(
    responses: Responses,
    source: Recording | ResponseTable,
    assignment: Assignment,
    bursts: BurstSeparation,
    inside: Bool[np.ndarray, " stimuli"],
) -> tuple[Finding, ...]:
    """All findings on how far responses can be trusted; those that need spike times are left out for a table.

    `inside` says whether each pulse's window ends within the recording.
    """
    if isinstance(source, ResponseTable):
        message = (
            "the table has no spike times, so it is not known whether its window holds the response, an artefact or a "
            "blank, nor how the culture fires without stimuli"
        )
        found = [Finding("spike-times-unknown", "warning", message)]
        if source.has_times:
            found += _overlapping(source.stimuli, responses.window_ms[1])
    elif not len(source.stimuli):
        message = (
            "the recording holds no stimuli, so there is no response to learn from: supply the stimulus times with "
            "the spikes"
        )
        return (Finding("no-stimuli", "refuse", message, 0.0),)
    else:
        response = find_response(source)
        found = [*_timing(responses, source, assignment, response)]
        # Only one window is recommended: if the response is elsewhere, that is the one around it.
        outside = any(finding.name in ("dead-window", "response-elsewhere") for finding in found)
        is_elsewhere = outside and response is not None
        found += artefact_findings(source, responses.window_ms, is_elsewhere=is_elsewhere)
        found += resolution_findings(source, responses.window_ms)
    return (
        *_left_out(source.stimuli, assignment, str(responses.by), inside),
        *found,
        *_conditions(responses),
        *_bursts(responses, bursts),
        *_difference(responses),
        *_readouts(responses),
        *drift_findings(responses),
        *memory_findings(responses),
        *repetition_findings(responses),
    )


def _left_out(
    stimuli: Stimuli, assignment: Assignment, by: str, inside: Bool[np.ndarray, " stimuli"]
) -> Iterator[Finding]:
    read = stimuli.is_last_of_presentation
    n_read = int(np.count_nonzero(read))
    has_condition = assignment.condition != NO_CONDITION
    without = int(np.count_nonzero(read & ~has_condition))
    if without == n_read:
        kind = by.partition(":")[0]
        occurring = conditions_named(kind).assign(stimuli).conditions if kind in _NAMED_ALONE else ()
        known = f"; the recording has {some_of([each.label for each in occurring])}" if occurring else ""
        others = " or ".join(each for each in ("frequency", "interval:5,10", "electrode", "pattern") if each != by)
        message = (
            f"none of {n_read:,} stimuli belongs to the conditions {by}{known}: choose others (--conditions {others})"
        )
        yield Finding("no-condition", "refuse", message, float(without))
    elif without:
        rests = int(np.count_nonzero(read & ~has_condition & stimuli.is_rest))
        of_these = f", {rests:,} of which deliver nothing (--conditions electrode)" if rests else ""
        message = f"left out, as they belong to no condition: {without:,} of {n_read:,} stimuli{of_these}"
        yield Finding("no-condition", "note", message, float(without))
    if late := int(np.count_nonzero(read & has_condition & ~inside)):
        where = "the end of the recording, or of its block"
        message = f"left out, as their window runs past {where}: {late:,} of {n_read:,} stimuli"
        yield Finding("window-past-end", "note" if late < 0.05 * n_read else "warning", message, float(late))


def _timing(
    responses: Responses, recording: Recording, assignment: Assignment, response: ResponseTime | None
) -> Iterator[Finding]:
    start_ms, end_ms = responses.window_ms
    window = f"window from {start_ms:g} to {end_ms:g} ms"
    stimuli = recording.stimuli
    if stimuli.is_rest.all():
        message = (
            f"nothing was delivered: all {len(stimuli)} stimuli are rests, so the {window} holds no response; record "
            "places with electrodes"
        )
        yield Finding("dead-window", "refuse", message)
        return
    yield from _overlapping(stimuli, end_ms)
    rate_hz, _ = spontaneous_rate(recording, after_ms=end_ms)
    n_stimuli, n_all, spikes = _spikes_in_window(responses, recording)
    if math.isnan(rate_hz) and n_all:
        message = (
            "stimuli follow each other too fast to see how the culture fires without them (less than a second in all "
            "lies 100 ms or more after a pulse and before the next), so it is not known whether the window holds a "
            "response"
        )
        yield Finding("window-not-tested", "note", message)
        return
    per_stimulus = 0.0 if math.isnan(rate_hz) else rate_hz * (end_ms - start_ms) * 1e-3 * (1 - 1 / _WINDOW_PARTS)
    expected = per_stimulus * n_stimuli
    if spikes <= expected:
        where = "no response was found elsewhere either: these stimuli do not make the culture fire"
        if response:
            where = f"the response is at {response}: use --window-ms {response.start_ms:g} {response.end_ms:g}"
        message = (
            f"the {window} is dead: {spikes / max(n_stimuli, 1):.2f} spikes per stimulus (without an eighth at "
            f"its start, where an artefact may be) against {per_stimulus:.2f} in as much time before the stimulus; "
            f"{where}"
        )
        yield Finding("dead-window", "refuse", message, spikes / expected if expected else 0.0)
        return
    yield from _dead_conditions(responses, recording, assignment, per_stimulus)
    if response is None:
        return
    if response.start_ms >= end_ms or response.end_ms <= start_ms:
        message = (
            f"the response is at {response} after a stimulus, outside the {window}: "
            f"use --window-ms {response.start_ms:g} {response.end_ms:g}"
        )
        yield Finding("response-elsewhere", "warning", message, response.start_ms)
    else:
        message = (
            f"the culture fires above its spontaneous rate from {response} after a stimulus; the window is "
            f"{start_ms:g} to {end_ms:g} ms"
        )
        yield Finding("response-time", "note", message, response.start_ms)


def _overlapping(stimuli: Stimuli, end_ms: float) -> Iterator[Finding]:
    """A finding on stimuli that are followed by a pulse before their window ends."""
    read = stimuli.is_last_of_presentation
    # Up to the next row that is a pulse, as nothing is delivered at a rest.
    pulses = np.flatnonzero(~stimuli.is_rest)
    following = np.searchsorted(pulses, np.arange(len(stimuli)), side="right")
    gap_ms = 1e3 * (np.append(stimuli.time_s[pulses], np.inf)[following] - stimuli.time_s)
    # 1e-6 ms: an interval equal to the window's end is not shorter for being rounded.
    if overlapping := int(np.count_nonzero(read & (gap_ms < end_ms - 1e-6))):
        message = (
            f"{overlapping:,} of {np.count_nonzero(read):,} stimuli are followed by another pulse before their window "
            f"ends at {end_ms:g} ms, so its artefact and response are counted in theirs: use a shorter window"
        )
        yield Finding("stimuli-too-close", "warning", message, float(overlapping))


def _spikes_in_window(
    responses: Responses, recording: Recording, stimuli: Bool[np.ndarray, " stimuli"] | None = None
) -> tuple[int, int, int]:
    """Stimuli, all spikes, and those without the busier of the first two parts, into which an artefact may reach."""
    start_ms, end_ms = responses.window_ms
    parts = post_stimulus_histogram(recording, start_ms, end_ms, (end_ms - start_ms) / _WINDOW_PARTS, stimuli)
    n_all = int(parts.count.sum())
    return parts.n_stimuli, n_all, n_all - int(parts.count[:2].max())


def _dead_conditions(
    responses: Responses, recording: Recording, assignment: Assignment, per_stimulus: float
) -> Iterator[Finding]:
    """A finding on conditions whose window is dead, though that of all together is not."""
    start_ms, end_ms = responses.window_ms
    dead, worst = [], math.inf
    for i, condition in enumerate(assignment.conditions if len(assignment.conditions) > 1 else ()):
        if condition.electrodes == RESTING:
            continue
        of = recording.stimuli.is_last_of_presentation & (assignment.condition == i)
        n_stimuli, _, spikes = _spikes_in_window(responses, recording, of)
        if n_stimuli and spikes <= per_stimulus * n_stimuli:
            later = find_response(recording, stimuli=of)
            at = f"; its response is at {later}" if later else ""
            dead.append(f"{condition.label} ({spikes / n_stimuli:.2f}{at})")
            worst = min(worst, spikes / n_stimuli)
    if dead:
        listed = ", ".join(dead[:8]) + (f" and {len(dead) - 8} more" if len(dead) > 8 else "")
        message = (
            f"after stimuli of some conditions the window from {start_ms:g} to {end_ms:g} ms holds no more spikes than "
            f"as much time before a stimulus, {per_stimulus:.2f} (without an eighth at its start), and so no response: "
            f"{listed}; leave them out, or use a window that suits all"
        )
        yield Finding("dead-condition", "warning", message, worst)


def _conditions(responses: Responses) -> Iterator[Finding]:
    few: list[tuple[str, int]] = []
    for i, condition in enumerate(responses.conditions):
        n_all = int(np.count_nonzero(responses.condition == i))
        n = len(responses.rates_of(i))
        if not n:
            what = "no stimulus whose response window lies in the recording"
            if n_all:
                what = f"only bursts, after {counted(n_all, 'stimulus', 'stimuli')} (--burst-threshold 1 keeps them)"
            message = f"condition {condition.label}: {what}; leave it out or choose other conditions (--conditions)"
            yield Finding("empty-condition", "refuse", message, 0.0)
        elif n < FEW_SAMPLES:
            few.append((condition.label, n))
    if len(few) > _MOST_LISTED:
        message = (
            f"{len(few):,} of {len(responses.conditions):,} conditions have fewer than {FEW_SAMPLES} non-burst "
            f"responses, as {some_of([f'{label} ({n})' for label, n in few])}; a distribution needs as many: "
            "group the stimuli, for instance with --conditions interval:5,10+-25%"
        )
        yield Finding("few-samples", "warning", message, float(min(n for _, n in few)))
        return
    for label, n in few:
        have = counted(n, "non-burst response")
        message = f"condition {label}: {have}; a distribution needs {FEW_SAMPLES} or more"
        yield Finding("few-samples", "warning", message, float(n))


def _bursts(responses: Responses, bursts: BurstSeparation) -> Iterator[Finding]:
    n, n_bursts = len(responses), int(np.count_nonzero(responses.is_burst))
    values = f"separability {bursts.separability:.2f}, valley {bursts.valley:.2f}"
    if not n_bursts and not math.isnan(bursts.rejected):
        above = int(np.count_nonzero(responses.active_ratio > bursts.rejected))
        why = "as the ratios of active channels do not form two groups"
        if 0 < min(above, n - above) < LEAST_RESPONSES:
            why = f"as one of two groups would have fewer than {LEAST_RESPONSES}"
        message = (
            f"no response is set apart as a burst, {why}: Otsu's threshold, {bursts.rejected:.3f}, would set apart "
            f"{above:,} of {n:,} responses ({values})"
        )
        yield Finding("bursts-not-separable", "note", message, bursts.separability)
    if not n_bursts:
        return
    share = n_bursts / n
    dropped = f"{n_bursts:,} of {n:,} responses ({100 * share:.1f} %) are set apart as bursts"
    if share > MANY_BURSTS:
        message = (
            f"{dropped}; bursts should be rare, so these may be the responses themselves, and the rest failed stimuli: "
            "look at the panels of burst separation, and use --burst-threshold 1 to keep all"
        )
        yield Finding("many-bursts", "warning", message, share)
    else:
        message = f"{dropped} (more than {100 * responses.threshold:.1f} % of the channels active; {values})"
        yield Finding("bursts", "note", message, share)


def _difference(responses: Responses) -> Iterator[Finding]:
    shares = responses.shares_above_median()
    # A share of three responses says nothing: conditions with few samples count only if there are no others.
    n = np.array([len(responses.rates_of(i)) for i in range(len(shares))])
    enough = n >= FEW_SAMPLES if np.count_nonzero(n >= FEW_SAMPLES) >= 2 else n > 0
    known = [(c.label, float(p)) for c, p, ok in zip(responses.conditions, shares, enough, strict=True) if ok]
    if len(responses.conditions) == 1:
        message = (
            "there is only one condition, so an agent has nothing to choose: to train, sort the stimuli by "
            "frequency, interval, electrode or pattern (--conditions)"
        )
        yield Finding("one-condition", "warning", message, 1.0)
    if len(known) < 2:
        return
    lowest, highest = min(p for _, p in known), max(p for _, p in known)
    spread = highest - lowest
    listed = some_of([f"{p:.2f} for {label}" for label, p in known])
    differ = "hardly differ" if spread < SMALL_DIFFERENCE else f"differ by {spread:.2f} at most"
    message = (
        f"the conditions {differ} in P(x >= P50): {listed}; with one threshold the choice of a condition moves the "
        f"mean command from {2 * lowest - 1:+z.2f} to {2 * highest - 1:+z.2f} on a scale from -1 to +1, and the rest "
        "is chance"
    )
    if lowest == 1.0:
        # P50 is tied with the smallest response.
        message = (
            f"more than half of the responses are the smallest, {responses.median_rate_hz:g} Hz, so all conditions "
            "pass P50 and one threshold always commands +1, without stimuli too: choose a longer window (--window-ms), "
            "or record more channels"
        )
        yield Finding("no-difference", "warning", message, spread)
    elif spread < SMALL_DIFFERENCE:
        message += ", so no policy can steer a robot much better than at random: stimulate in ways that differ more"
        yield Finding("no-difference", "warning", message, spread)
    elif spread < LITTLE_DIFFERENCE:
        message += (
            ", so a robot can hardly be steered: `animat inspect --optimum` computes how far; stimulate in ways that "
            "differ more"
        )
        yield Finding("little-difference", "warning", message, spread)
    else:
        yield Finding("difference", "note", message, spread)


def _readouts(responses: Responses) -> Iterator[Finding]:
    """A finding on the worst pair of readouts whose difference in P(x >= P50) hardly varies between conditions."""
    names, conditions = responses.readouts.names, responses.conditions
    enough = [i for i in range(len(conditions)) if len(responses.rates_of(i)) >= FEW_SAMPLES]
    if len(names) < 2 or len(enough) < 2:
        return
    median_hz = np.median(responses.read_hz[~responses.is_burst], axis=0)
    above = [(responses.read_of(i) >= median_hz).astype(np.float64) for i in enough]
    alike = []
    for a, b in combinations(range(len(names)), 2):
        apart = np.array([(each[:, a] - each[:, b]).mean() for each in above])
        errors = [(each[:, a] - each[:, b]).std() / math.sqrt(len(each)) for each in above]
        low, high = int(apart.argmin()), int(apart.argmax())
        spread = float(apart[high] - apart[low])
        if spread - 2 * math.hypot(errors[low], errors[high]) < LITTLE_DIFFERENCE:
            ends = (f"{apart[end]:+z.2f} ({conditions[enough[end]].label})" for end in (low, high))
            alike.append((spread, f"{names[a]} and {names[b]}", " to ".join(ends)))
    if alike:
        spread, pair, between = min(alike)
        does = "there are too few responses to know if the conditions separate"
        if spread < LITTLE_DIFFERENCE:
            does = "the conditions hardly separate"
        message = (
            f"{does} the readouts {pair}: P(x >= P50) of the first less that of the second is {between}, and a policy "
            "needs them separated to give one command without the other: record more, or at places that differ "
            f"(animat record --places {_PLACES.get(names, 'FILE')})"
        )
        yield Finding("readouts-alike", "warning", message, spread)
