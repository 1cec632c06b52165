"""What is wrong with spike times: artefacts around a stimulus, blanked stretches, and steps too coarse for a window."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64

from animat.recordings.findings import Finding
from animat.recordings.recording import Recording
from animat.responses.psth import PostStimulusHistogram, post_stimulus_histogram, spontaneous_rate
from animat.responses.windows import Window

Bins = Bool[np.ndarray, " bins"]
Times = Float64[np.ndarray, " times"]

BIN_MS = 0.5
SPAN_MS = (-10.0, 20.0)
LOOKED_AT_MS = (-2.0, 10.0)
"""Where artefacts are sought; a response can be as sharp, but comes later."""
ARTEFACT_UNTIL_MS = 2.0
"""An artefact begins before this."""
TIMES = 5.0
"""This many times more spikes than elsewhere are an artefact; this many times fewer were blanked."""
AFTERWARDS = 6
"""Bins after an artefact that show whether a response follows."""
TIMES_RESPONSE = 2.0
LEFT_OUT, LEFT_OUT_SHARE = 2, 0.02
"""Number and share of the stimuli with most spikes in the artefact's largest bin, without which it must still be an
artefact: a burst may happen to fall there."""
ENOUGH = 10.0
"""Spikes expected in a stretch for their absence to count as a blank."""
COARSE = 0.25
"""Share of the window above which a step of the times is too coarse."""
ENOUGH_SPIKES, ENOUGH_STEPS = 1000, 20
WHOLE, NEARLY_ALL = 0.01, 0.99
"""How close intervals must be to a whole number of steps, and the share of intervals that must be."""
AGREE = 0.05
"""How well the mean of rounded intervals must agree with the stated one."""


def artefact_findings(recording: Recording, window_ms: Window, *, is_elsewhere: bool = False) -> Iterator[Finding]:
    """Findings on spikes that are artefacts (`artefact-spikes`) and on blanked stretches (`blanked-window`).

    Both use the spikes b(t) in half-millisecond bins from the stimulus. The artefact is the run of bins around the
    largest one before 2 ms in which b is above

    - five times both the spontaneous rate and the median of b from 3 to 20 ms,
    - twice the upper quartile of b from 3 to 20 ms, which is the response if there is one, and
    - a third of the largest bin, if the culture goes on firing afterwards or rises again.

    There is no artefact if the bins rise from there to twice as much without a valley (the response begins early), or
    if the largest bin is not above these bounds without the two stimuli, or the fiftieth of them, that have most spikes
    in it. The blank is the run of bins around 0, artefact aside, in which b is below a fifth of the spontaneous rate;
    it is sought if 10 spikes or more would be in it.

    Where responses lie outside the window (`is_elsewhere`), another finding gives the window to use.
    """
    stimuli = recording.stimuli
    read = stimuli.is_last_of_presentation & ~stimuli.is_rest
    if not read.any():
        return
    gap_ms = 1e3 * np.diff(stimuli.time_s, prepend=-np.inf, append=np.inf)
    # Bins must not hold spikes that belong to a neighbouring pulse.
    apart = read & (gap_ms[1:] >= SPAN_MS[1]) & (gap_ms[:-1] >= -SPAN_MS[0] + SPAN_MS[1])
    chosen = apart if int(apart.sum()) >= min(20, int(read.sum())) else read
    histogram = post_stimulus_histogram(recording, *SPAN_MS, BIN_MS, chosen)
    edges_ms, count, n_stimuli = histogram.edges_ms, histogram.count, histogram.n_stimuli
    rate_hz, quiet_s = spontaneous_rate(recording)
    spontaneous = 0.0 if math.isnan(rate_hz) else rate_hz * BIN_MS * 1e-3 * n_stimuli
    later = count[edges_ms[:-1] >= 3.0]
    usual = max(spontaneous, float(np.median(later)), 1.0)
    # Responses can begin before 2 ms: spikes no sharper than the later response belong to it.
    usual = max(usual, TIMES_RESPONSE / TIMES * float(np.quantile(later, 0.75)))
    artefact = _artefact(histogram, usual, max(spontaneous, 1.0), recording.spike_times_s, stimuli.time_s[chosen])
    if artefact.any():
        from_ms, to_ms = edges_ms[:-1][artefact][0], edges_ms[1:][artefact][-1]
        spikes, reaches = float(count[artefact].sum()), to_ms > window_ms[0] + 1e-9
        every_pulse = post_stimulus_histogram(recording, *SPAN_MS, BIN_MS, ~stimuli.is_rest).count[artefact].sum()
        remedy = f"the window from {window_ms[0]:g} ms on does not contain them"
        if reaches:
            begin = "" if is_elsewhere else f": begin it at {to_ms:g} ms or later (--window-ms)"
            remedy = f"the window begins at {window_ms[0]:g} ms, inside it{begin}"
        message = (
            f"from {from_ms:g} to {to_ms:g} ms there are {spikes / n_stimuli:.1f} spikes per stimulus"
            f"{' (of those well apart)' if chosen is apart and n_stimuli < read.sum() else ''}, "
            f"{spikes / (usual * artefact.sum()):.3g} times as many as is usual in as much time: an artefact counted "
            f"as spikes{'' if from_ms < 0 else ', or neurons fired directly by the pulse'} "
            f"({100 * every_pulse / len(recording.spike_times_s):.1f} % of all); {remedy}"
        )
        yield Finding("artefact-spikes", "warning" if reaches else "note", message, spikes / n_stimuli)
    if quiet_s > 0 and spontaneous > 0:
        yield from _blank(histogram, artefact, spontaneous, window_ms, is_elsewhere)


def _artefact(
    histogram: PostStimulusHistogram, usual: float, spontaneous: float, spike_times_s: Times, stimulus_s: Times
) -> Bins:
    edges_ms, count = histogram.edges_ms, histogram.count
    from_ms = edges_ms[:-1]
    above = (count > TIMES * usual) & (from_ms >= LOOKED_AT_MS[0]) & (from_ms < LOOKED_AT_MS[1])
    early = np.flatnonzero(above & (from_ms < ARTEFACT_UNTIL_MS))
    for largest in early[np.argsort(-count[early], kind="stable")].tolist():
        run = _run(above, largest)
        last = int(np.flatnonzero(run)[-1])
        height, after = count[largest], count[largest : last + 1]
        top, low = int(np.argmax(after)), np.flatnonzero(after < height / 3)
        if after[top] >= TIMES_RESPONSE * height and after[: top + 1].min() >= height / 2:
            # A response, not an artefact: artefacts are largest at first.
            continue
        rises_again = len(low) > 0 and after[low[0] :].max() >= height / 2
        of_each = np.diff(np.searchsorted(spike_times_s, stimulus_s[:, None] + 1e-3 * edges_ms[largest : largest + 2]))
        left_out = max(LEFT_OUT, round(LEFT_OUT_SHARE * len(of_each)))
        if np.sort(of_each[:, 0])[: max(len(of_each) - left_out, 0)].sum() <= TIMES * usual:
            continue
        if rises_again or np.mean(count[last + 1 : last + 1 + AFTERWARDS]) > spontaneous:
            # A response may follow immediately: the artefact ends where its spikes fall to a third of its height.
            return _run(above & (count >= height / 3), largest)
        return run
    return np.zeros(len(count), np.bool_)


def _run(flags: Bins, start: int, gap: int = 1) -> Bins:
    """The bins from the first to the last of the set flags around `start`, across gaps of up to `gap` flags."""
    first = last = start
    while first > 0 and flags[max(first - 1 - gap, 0) : first].any():
        first -= 1
    while last + 1 < len(flags) and flags[last + 1 : last + 2 + gap].any():
        last += 1
    return (np.arange(len(flags)) >= first) & (np.arange(len(flags)) <= last)


def _blank(
    histogram: PostStimulusHistogram, artefact: Bins, spontaneous: float, window_ms: Window, is_elsewhere: bool
) -> Iterator[Finding]:
    is_blank = (histogram.count < spontaneous / TIMES) | artefact
    zero = int(np.searchsorted(histogram.edges_ms, 0.0))
    if not is_blank[zero]:
        return
    run = _run(is_blank, zero, gap=0)
    from_ms, to_ms = histogram.edges_ms[:-1][run][0], histogram.edges_ms[1:][run][-1]
    if (run.sum() - artefact.sum()) * spontaneous < ENOUGH or run[-1]:
        return
    start_ms, end_ms = window_ms
    found = f"from {from_ms:g} to {to_ms:g} ms around a stimulus next to nothing was recorded (blanked, or saturated)"
    lost = (min(to_ms, end_ms) - start_ms) / (end_ms - start_ms)
    if lost <= 1e-9:
        yield Finding("blanked-window", "note", f"{found}; the window from {start_ms:g} ms on is after it", 0.0)
        return
    remedy = f": use --window-ms {to_ms:g} {end_ms:g}" if lost < 1 else ": use a window after it"
    message = (
        f"{found}: {100 * min(lost, 1):.0f} % of the window from {start_ms:g} to {end_ms:g} ms is lost, and rates are "
        f"too low by as much{'' if is_elsewhere else remedy}"
    )
    yield Finding("blanked-window", "note" if lost <= 0.15 else "warning", message, min(lost, 1.0))


def resolution_findings(recording: Recording, window_ms: Window) -> Iterator[Finding]:
    """Findings on times that come in steps of more than a quarter of the window (`coarse-times`).

    Of spikes, the step is the shortest interval between different times, if nearly all intervals are whole multiples of
    it. Only the later half is examined, as times in single precision grow coarser. Stimuli may come in equal steps
    anyway: theirs are coarse if they are 1/f apart for their stated frequency f, but rounded.
    """
    yield from _rounded_stimuli(recording, window_ms)
    time_s = np.unique(recording.spike_times_s[len(recording.spike_times_s) // 2 :])
    if len(recording.spike_times_s) < ENOUGH_SPIKES or len(time_s) <= ENOUGH_STEPS:
        return
    interval_s = np.diff(time_s)
    step_s = float(interval_s.min())
    multiple = interval_s / step_s
    width_ms = window_ms[1] - window_ms[0]
    is_grid = np.mean(np.abs(multiple - np.rint(multiple)) < WHOLE) > NEARLY_ALL
    if not is_grid or 1e3 * step_s <= COARSE * width_ms:
        return
    message = (
        f"spike times come in steps of {1e3 * step_s:.3g} ms, too coarse for a window of {width_ms:g} ms: which spikes "
        "it holds is chance; supply times in double precision (float64, more decimals), or use a longer window"
    )
    yield Finding("coarse-times", "warning", message, 1e3 * step_s)


def _rounded_stimuli(recording: Recording, window_ms: Window) -> Iterator[Finding]:
    time_s, frequency_hz = recording.stimuli.time_s, recording.stimuli.frequency_hz
    width_ms = window_ms[1] - window_ms[0]
    for step_s in (1.0, 0.1, 0.01, 0.001):
        steps = time_s / step_s
        if 1e3 * step_s <= COARSE * width_ms or np.any(np.abs(steps - np.rint(steps)) > 1e-6):
            continue
        for stated_hz in np.unique(frequency_hz[frequency_hz > 0]).tolist():
            interval = np.diff(steps)[frequency_hz[1:] == stated_hz]
            stated = 1 / stated_hz / step_s
            if len(interval) < ENOUGH_STEPS or abs(stated - round(stated)) <= WHOLE:
                continue
            is_near = np.mean(np.abs(interval - stated) < 1) > NEARLY_ALL
            if is_near and abs(np.mean(interval) / stated - 1) < AGREE:
                message = (
                    f"stimulus times come in steps of {1e3 * step_s:g} ms, although those at {stated_hz:g} Hz are "
                    f"{1e3 / stated_hz:.3g} ms apart: they are rounded, too coarse for a window of {width_ms:g} ms; "
                    "supply them with more decimals"
                )
                yield Finding("coarse-times", "warning", message, 1e3 * step_s)
                return
