"""Detects times that cannot be in seconds, from impossible frequencies, firing rates and durations; and long gaps.

A gap without any event, before the first one or between spikes, is too long to be chance if it stands out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from animat.recordings.findings import Finding
from animat.recordings.recording import Recording
from animat.stimulation.stimulus import Stimuli

TIME_UNITS = "times-not-in-seconds"
CONTRADICTED = "other-frequencies"
FAR = 30.0
"""Intervals must be this many times as long, or as short, as stated by the frequencies."""
AGREE = 0.05
"""Tolerance between the factors of the frequencies: a wrong unit gives all of them the same factor."""
REGULAR = 0.9
"""Share of the intervals of a frequency that must be alike, for the frequency to be what decides them."""
APART = 1.5
"""Smallest ratio of the highest to the lowest frequency: a constant interval fits all frequencies that are similar."""
LONG_S = 2 * 3600.0
FEW_HZ, MANY_HZ = 0.02, 200.0
"""No recording has a median rate of the channels that fired below or above these."""
SHORT_S, SHORT_SHARE = 0.5, 0.05
"""In any recording at least this share of the intervals within channels is shorter: neurons fire in bursts."""
LIKELY_HZ, LIKELY_SHORTEST_S = (FEW_HZ, 50.0), (0.00015, 0.05)
"""Median rate of the channels that fired, and first percentile of the intervals within channels, in the right unit."""
USUAL_HZ, USUAL_SHORTEST_S = 1.0, 0.002
USUAL_SAMPLING_HZ = 20_000.0
"""Assumed if a file does not state the rate; nearly all arrays are sampled at half to twice this rate."""
SOON_S = 0.1
ENOUGH_SPIKES, ENOUGH_STIMULI = 1000, 20
TIMES = 10.0
"""A gap must be so many times as long as the next shorter one: the first of n similar ones is in n^10 / 10! cases."""
LATE_SHARE, LATE_SPIKES = 0.1, 20
"""Smallest share of the recording, as less hardly changes rates; and fewest spikes, as fewer are not conclusive."""
SILENT_SHARES, SILENT_S, SILENT_SPIKES = (0.01, 0.5), 1.0, 1000
"""Likewise for silences, from the first spike on; a culture that is silent most of the time fires in bursts."""
LONGEST_BURST_S = 10.0
"""What lasts longer than this, before a silence to the end that is longer still, is not a burst."""
SILENCES = 5
"""Most silences that are reported together."""


def time_findings(recording: Recording) -> Iterator[Finding]:
    """A finding on times that cannot be in seconds (`times-not-in-seconds`), or contradict stated frequencies.

    Another unit is named in these cases, of which all but the first need 1,000 spikes:

    - the intervals between stimuli all differ from those of stated frequencies by the same factor, that of a unit:
      milli-, micro- and nanoseconds, minutes, hours, or samples at the recording's rate; the highest frequency must be
      at least 1.5 times the lowest;
    - the recording would last over two hours, the median channel fires below 0.02 Hz, and less than 5 % of the
      intervals within channels are under 0.5 s;
    - it would last over two hours, and no spike lies within 100 ms after any of 20 or more stimuli;
    - the median channel fires above 200 Hz;
    - nine in ten stimuli come after the last spike, or before the first.

    Any other common factor above 30 or below 1/30 is a warning only: trains of 100 pulses, one row each, have intervals
    100 times as long as stated. Stimuli that come later than stated may have pauses between them.
    """
    stated = common_factor(recording.stimuli, recording.sampling_rate_hz)
    if stated is not None and stated.severity == "refuse":
        yield stated
    elif (reason := _impossible_firing(recording) or _separate_clocks(recording)) is not None:
        yield Finding(TIME_UNITS, "refuse", reason)
    elif stated is not None:
        yield stated
    else:
        yield from frequency_findings(recording.stimuli)


def frequency_findings(stimuli: Stimuli, *, has_times: bool = True) -> Iterator[Finding]:
    """A finding on frequencies that contradict the stimuli's times, or, without times, that look like periods."""
    if has_times:
        yield from _sooner_than_stated(stimuli)
        return
    stated_hz = np.unique(stimuli.frequency_hz[~np.isnan(stimuli.frequency_hz)])
    if len(stated_hz) > 1 and stated_hz[-1] < 1:
        periods = f"write 1 divided by each, {1 / stated_hz[-1]:g} to {1 / stated_hz[0]:g}"
        stated = f"{stated_hz[0]:g} to {stated_hz[-1]:g}"
        message = f"all frequencies are below 1 Hz, {stated}: if they are periods in seconds, {periods}"
        yield Finding(CONTRADICTED, "warning", message)


def _multiples(stimuli: Stimuli) -> Iterator[dict[float, Float64[np.ndarray, " intervals"]]]:
    """The intervals between stimuli as multiples of those of their stated frequency, for each frequency.

    First as if a pulse's frequency were that of the interval before it, then as if it were that of the one after it.
    """
    interval_s = np.diff(stimuli.time_s)
    for frequency_hz in (stimuli.frequency_hz[1:], stimuli.frequency_hz[:-1]):
        known = np.flatnonzero(~np.isnan(frequency_hz) & (interval_s > 0))
        known = known[np.argsort(frequency_hz[known], kind="stable")]
        stated_hz, first = np.unique(frequency_hz[known], return_index=True)
        of_each = np.split(interval_s[known] * frequency_hz[known], first[1:])
        yield dict(zip(stated_hz.tolist(), of_each[: len(stated_hz)], strict=True))


def common_factor(stimuli: Stimuli, sampling_rate_hz: float = math.nan) -> Finding | None:
    """A finding if all intervals are the same multiple of those of the stated frequencies."""
    for multiples_of in _multiples(stimuli):
        if not multiples_of or max(multiples_of) < APART * min(multiples_of):
            continue
        multiples = np.array([np.median(multiples) for multiples in multiples_of.values()])
        multiple, lowest_hz = float(np.median(multiples)), min(multiples_of)
        if np.all(np.abs(multiples / multiple - 1) < AGREE) and not 1 / FAR < multiple < FAR:
            unit = _unit_of_times(multiple, sampling_rate_hz)
            message = (
                f"stimulus times {'cannot' if unit else 'may not'} be in seconds: those at {lowest_hz:g} Hz would be "
                f"{multiples[0] / lowest_hz:g} s apart, not {1 / lowest_hz:g} s, and the others are off by the same "
                f"factor of {_plain(multiple)}: "
                + (f"times are in {unit}" if unit else "are they in another unit, or is each a train of pulses?")
            )
            return Finding(TIME_UNITS, "refuse" if unit else "warning", message)
    return None


def _sooner_than_stated(stimuli: Stimuli) -> Iterator[Finding]:
    """A finding on stimuli that come sooner than their stated frequency allows."""
    sooner, regular = [], []
    for multiples_of in _multiples(stimuli):
        enough = {hz: multiples for hz, multiples in multiples_of.items() if len(multiples) >= ENOUGH_STIMULI}
        sooner.append(min(((float(np.median(m)), hz) for hz, m in enough.items()), default=(1.0, np.inf)))
        if _is_regular(enough):
            regular.append(sooner[-1])
    # If intervals are regular in only one of the two ways of counting, frequencies are stated in that way.
    least, stated_hz = max(sooner) if len(regular) != 1 else regular[0]
    if least > 1 / APART:
        return
    units = {"seconds": 1.0, "milliseconds": 1e3}
    periods = [
        (each, unit) for each in sooner for unit, n in units.items() if abs(n * each[0] / each[1] ** 2 - 1) < AGREE
    ]
    remedy = "correct the frequencies, or group the stimuli by their times (--conditions interval:5,10)"
    if periods:
        (least, stated_hz), unit = periods[0]
        remedy = (
            f"these are periods in {unit}: write {units[unit]:,g} divided by each, here {units[unit] / stated_hz:g}"
        )
    interval_s = least / stated_hz
    apart = f"{interval_s:.3g} s apart (median), not {1 / stated_hz:.3g} s"
    message = f"stimuli with a stated frequency of {stated_hz:g} Hz are {apart}: {remedy}"
    yield Finding(CONTRADICTED, "warning", message, least)


def _is_regular(multiples_of: dict[float, Float64[np.ndarray, " intervals"]]) -> bool:
    """Whether nearly all intervals of each frequency are alike, and those of different frequencies are not."""
    medians_s = [float(np.median(multiples)) / hz for hz, multiples in multiples_of.items()]
    if len(medians_s) < 2 or max(medians_s) < APART * min(medians_s):
        return False
    of_each = [np.mean(np.abs(m / np.median(m) - 1) < AGREE) for m in multiples_of.values()]
    return bool(min(of_each) > REGULAR)


def _unit_of_times(multiple: float, sampling_rate_hz: float) -> str | None:
    """The unit of the times and what to do; None if it is unknown."""
    named = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds", 1 / 60: "minutes", 1 / 3600: "hours"}
    for factor, unit in named.items():
        if abs(multiple / factor - 1) < AGREE:
            do = f"divide them by {_plain(factor)}" if factor > 1 else f"multiply them by {_plain(1 / factor)}"
            return f"{unit}; {do}"
    if abs(multiple / sampling_rate_hz - 1) < AGREE:
        return f"samples at {_plain(multiple)} Hz; divide them by that"
    return None


def _plain(number: float) -> str:
    return f"{number:,.0f}" if number >= FAR else f"{number:.3g}"


def _impossible_firing(recording: Recording) -> str | None:
    """Why spike times cannot be in seconds, from the duration and the rates; None if they can."""
    times_s, n_spikes = recording.spike_times_s, len(recording.spike_times_s)
    count = np.bincount(recording.spike_channels, minlength=len(recording.channels))
    if n_spikes < ENOUGH_SPIKES or recording.duration_s < 1:
        return None
    median_hz = float(np.median(count[count > 0])) / recording.duration_s
    if median_hz > MANY_HZ:
        what = f"the median channel fires at {median_hz:,.0f} Hz, which no neuron does"
        return f"spike times cannot be in seconds: {what}; are they in minutes or hours?"
    if recording.duration_s < LONG_S:
        return None
    hours = f"the recording would last {recording.duration_s / 3600:,.0f} h"
    by_channel = np.argsort(recording.spike_channels, kind="stable")
    same = np.diff(recording.spike_channels[by_channel]) == 0
    interval_s = np.diff(times_s[by_channel])[same]
    if len(interval_s) and median_hz < FEW_HZ and np.mean(interval_s < SHORT_S) < SHORT_SHARE:
        return (
            f"spike times cannot be in seconds: {hours}, with {median_hz:.2g} Hz on the median channel and hardly ever "
            f"two spikes of a channel within {SHORT_S:g} s; "
            + _unit_of_spikes(median_hz, float(np.quantile(interval_s, 0.01)), recording.sampling_rate_hz)
        )
    stimulus_s = recording.stimuli.time_s
    soon_after = np.searchsorted(times_s, stimulus_s + SOON_S) - np.searchsorted(times_s, stimulus_s)
    if len(stimulus_s) >= ENOUGH_STIMULI and not np.any(soon_after):
        without = f"without a spike within {1e3 * SOON_S:g} ms after any of {len(stimulus_s):,} stimuli"
        asked = "are they in milliseconds, or spikes and stimuli in different units?"
        return f"times cannot be in seconds: {hours} {without}; {asked}"
    return None


def _unit_of_spikes(median_hz: float, shortest_s: float, sampling_rate_hz: float) -> str:
    """The units with which rates and shortest intervals are typical of neurons, the likeliest first, and what to do."""
    is_known = bool(np.isfinite(sampling_rate_hz))
    rate_hz = sampling_rate_hz if is_known else USUAL_SAMPLING_HZ
    units = {
        1e3: "milliseconds; divide them by 1,000",
        1e6: "microseconds; divide them by 1,000,000",
        rate_hz: "samples; divide them by the sampling rate" + (f" of {_plain(rate_hz)} Hz" if is_known else ""),
    }
    fits = {}
    for factor, unit in units.items():
        hz, at_least_s = factor * median_hz, shortest_s / factor
        if all(low <= x <= high for x, (low, high) in ((hz, LIKELY_HZ), (at_least_s, LIKELY_SHORTEST_S))):
            fits[unit] = abs(np.log(hz / USUAL_HZ)) + abs(np.log(at_least_s / USUAL_SHORTEST_S))
    if not fits:
        return "are they in milliseconds, microseconds or samples?"
    likeliest = sorted(fits, key=lambda unit: fits[unit])
    return ("perhaps " if len(fits) > 1 else "") + "times are in " + ", or in ".join(likeliest)


def _separate_clocks(recording: Recording) -> str | None:
    """Why spikes and stimuli must have different clocks; None if they need not."""
    spike_s, stimulus_s = recording.spike_times_s, recording.stimuli.time_s
    if len(spike_s) < ENOUGH_SPIKES or len(stimulus_s) < ENOUGH_STIMULI:
        return None
    after = float(np.mean(stimulus_s > spike_s[-1]))
    before = float(np.mean(stimulus_s < spike_s[0]))
    if max(after, before) < 0.9:
        return None
    where = f"after the last spike, {spike_s[-1]:g} s" if after > before else f"before the first, {spike_s[0]:g} s"
    share = f"{100 * max(after, before):.0f} % of the stimuli come {where}"
    remedy = "stimuli and spikes have different units or clocks; provide both in seconds on the same clock"
    return f"times cannot all be in seconds: {share}: {remedy}"


def start_unknown(spike_time_s: np.ndarray, stimulus_time_s: np.ndarray) -> Iterator[Finding]:
    """A finding if a recording with an unknown start, assumed to be 0, has its first event much later."""
    event_s = np.sort(np.concatenate([spike_time_s, stimulus_time_s]))
    if len(spike_time_s) < LATE_SPIKES:
        return
    first_s, last_s, longest_s = float(event_s[0]), float(event_s[-1]), float(np.diff(event_s).max())
    if first_s > max(TIMES * longest_s, LATE_SHARE * last_s):
        message = (
            f"the start is not stated and assumed to be 0 s, but the first event is at {first_s:.12g} s and later ones "
            f"are at most {longest_s:.3g} s apart: if it starts near the first, rates are too low and bursts are found "
            "where there are none; state the start (animat convert --start-s, start_s in NPZ)"
        )
        yield Finding("start-unknown", "warning", message, first_s)


def silence_findings(recording: Recording) -> Iterator[Finding]:
    """A finding if all channels are silent for far longer than at any other time."""
    if len(recording.spike_times_s) < SILENT_SPIKES:
        return
    times_s = np.append(recording.spike_times_s, recording.stop_s)
    length_s = np.diff(times_s)
    longest = np.argsort(-length_s, kind="stable")[: SILENCES + 1]
    of_longest_s = length_s[longest]
    least_s, most_s = (share * float(times_s[-1] - times_s[0]) for share in SILENT_SHARES)
    stands_out = (of_longest_s[:-1] > TIMES * of_longest_s[1:]) & (of_longest_s[:-1] > max(least_s, SILENT_S))
    n = int(np.max(np.flatnonzero(stands_out), initial=-1)) + 1
    total_s = float(of_longest_s[:n].sum())
    active_s = float(length_s.sum()) - total_s
    is_at_end = n == 1 and longest[0] == len(length_s) - 1
    if total_s == 0 or (total_s >= most_s and not (is_at_end and active_s >= LONGEST_BURST_S)):
        return
    ended = ", or did it end earlier than stated" if longest[:n].max() == len(length_s) - 1 else ""
    where = ", ".join(f"from {times_s[i]:.12g} to {times_s[i + 1]:.12g} s" for i in sorted(longest[:n].tolist()))
    message = (
        f"no spike on any channel {where} ({_plain(total_s)} s), while no other silence is longer than "
        f"{of_longest_s[n]:.2g} s: was recording interrupted{ended}? If so, cut the recording there, as it counts in "
        "rates"
    )
    yield Finding("silence", "warning", message, total_s)
