"""Removal of the artefacts that stimuli leave in raw traces, at the least cost to the responses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from animat.recordings.detection.settings import Detection

TAUS_MS = (0.3, 0.5, 0.8, 1.2, 2.0, 3.5, 5.0, 8.0)
GAUSS_NEWTON_STEPS = 8
FAR, UNSETTLED = 20.0, 2.0
"""Distances from rest, in standard deviations of the noise: beyond the first a still trace counts as saturated; beyond
the second, on average over the half millisecond after blanking, a recovery is fitted."""
FLAT_MS, FLAT_SHARE = 0.4, 0.005
"""A saturated trace stays still at least so long, and moves at most by this share of its distance from rest."""
SETTLE_MS = 0.25
"""Blanked after an amplifier recovers: its first samples do not lie on an exponential."""
PAUSE_MS = 1.0
"""How long the trace of an amplifier that has been saturated for more than `recovery_ms` may move in between."""

Rows = Float64[np.ndarray, "rows samples"]
Traces = Float32[np.ndarray, "channels samples"]
Flags = Bool[np.ndarray, "channels samples"]
Levels = Float32[np.ndarray, " channels"]
Counts = Int64[np.ndarray, " channels"]
Pulses = Int64[np.ndarray, " stimuli"]
"""Voltages, or something else of each sample; a voltage or a number of each channel; a number of each pulse."""


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A stretch of traces without artefacts, and the samples in which no spikes are searched for.

    After each stimulus in it, `saturated` channels are saturated, the last of which is blanked for `longest_ms`.
    """

    voltage_uv: Traces
    is_blank: Flags
    saturated: Pulses
    longest_ms: Float32[np.ndarray, " stimuli"]


def without_artefacts(
    voltage_uv: Traces,
    stimulus: Pulses,
    noise_uv: Levels,
    rate_hz: float,
    settings: Detection,
    rest_uv: Levels | None = None,
) -> Cleaned:
    """Remove artefacts from a stretch of traces, in place.

    A straight line replaces each channel's trace around a pulse, and then as long as its amplifier is saturated. It is
    followed to the next pulse if it still is so after `recovery_ms`. From the trace afterwards a exp(-t / tau) is
    subtracted, with tau from about 0.2 to 16 ms. What some amplifiers leave, as they recover in another way,
    `animat.responses.quality.timing` reports.

    `voltage_uv` is changed. `stimulus` is the sample of each pulse, ascending; pulses outside the stretch count if
    their artefacts reach into it. `rest_uv` is the voltage of each channel before earlier pulses; a channel that stays
    still far from it just before the first pulse is still saturated.
    """
    samples = voltage_uv.shape[1]
    saturated, longest_ms = np.zeros(len(stimulus), np.int64), np.zeros(len(stimulus), np.float32)
    is_blank = np.zeros(voltage_uv.shape, dtype=bool)
    if not len(stimulus):
        return Cleaned(voltage_uv, is_blank, saturated, longest_ms)
    per_ms = rate_hz * 1e-3
    before, after = (round(ms * per_ms) for ms in settings.blank_ms)
    follow = round(settings.recovery_ms * per_ms)
    following = np.append(stimulus[1:], samples + before)
    flat, pause = max(round(FLAT_MS * per_ms), 3), round(PAUSE_MS * per_ms)
    is_held = np.zeros(len(voltage_uv), dtype=bool)
    first = int(stimulus[0]) - before
    if rest_uv is None:
        rest_uv = np.zeros(len(voltage_uv), np.float32)
    elif first > pause:
        is_held = _saturated_until(voltage_uv[:, :first] - rest_uv[:, None], noise_uv, settings, flat) > first - pause
        voltage_uv[is_held, :first] = rest_uv[is_held, None]
    for i, (at, next_at) in enumerate(zip(stimulus.tolist(), following.tolist(), strict=True)):
        start, end = max(at - before, 0), min(at + after, samples)
        limit = min(next_at - before, samples)
        stop = min(at + follow, limit)
        if end <= 0 or start >= samples:
            continue
        if stop <= end:
            # The next pulse comes before this one is over: all we can do is blank.
            _blank(voltage_uv, is_blank, start, np.full(len(voltage_uv), end), is_held)
            continue
        before_uv = np.median(voltage_uv[:, max(start - round(2 * per_ms), 0) : max(start, 1)], axis=1)
        # A channel that is still saturated since the previous pulse is not at rest.
        rest_uv = np.where(is_held, rest_uv, before_uv)
        # From the pulse on, not the end of the blank: `flat` samples are needed to see that a channel is still.
        pulse = max(at, 0)
        saturated_until = _saturated_until(voltage_uv[:, pulse:stop] - rest_uv[:, None], noise_uv, settings, flat)
        until = np.maximum(pulse + saturated_until, end)
        longer = np.flatnonzero(pulse + saturated_until == stop) if stop < limit else np.empty(0, np.int64)
        if len(longer):
            trace = voltage_uv[longer, stop - flat : limit] - rest_uv[longer, None]
            more = _saturated_until(trace, noise_uv[longer], settings, flat, pause)
            until[longer] = np.maximum(stop - flat + more, stop)
        is_held = until == limit
        late = until > end
        until[late] = np.minimum(until[late] + round(SETTLE_MS * per_ms), limit)
        saturated[i] = np.count_nonzero(late)
        longest_ms[i] = (int(until.max()) - at) / per_ms if saturated[i] else 0.0
        stops = np.full(len(until), stop)
        stops[longer] = np.minimum(until[longer] + follow, limit)
        _subtract_recovery(voltage_uv, until, stops, rest_uv, noise_uv, per_ms)
        _blank(voltage_uv, is_blank, start, until, is_held)
    return Cleaned(voltage_uv, is_blank, saturated, longest_ms)


def _saturated_until(
    trace_uv: Traces, noise_uv: Levels, settings: Detection, flat: int, pause: int | None = None
) -> Counts:
    """The number of samples until each channel's amplifier has recovered from saturation.

    If its rail is not known, it is saturated where `flat` samples in a row are far from rest and hardly differ: the
    negative peak of a spike in coarse steps stays still for less. Saturation after a `pause` without it is ignored.
    """
    until = np.zeros(len(trace_uv), np.int64)
    size_uv, rail_uv = np.abs(trace_uv), settings.saturation_uv
    far_uv = FAR * np.maximum(noise_uv, 1e-6)
    limit_uv = far_uv if rail_uv is None else np.full_like(far_uv, rail_uv)
    rows = np.flatnonzero(size_uv.max(axis=1) >= limit_uv)
    if not len(rows):
        return until
    is_saturated = size_uv[rows] >= limit_uv[rows, None]
    if rail_uv is None:
        if trace_uv.shape[1] < flat:
            return until
        stretches = np.lib.stride_tricks.sliding_window_view(trace_uv[rows], flat, axis=1)
        moves_uv = stretches.max(axis=2) - stretches.min(axis=2)
        is_saturated[:, : flat - 1] = False
        is_saturated[:, flat - 1 :] &= moves_uv <= FLAT_SHARE * size_uv[rows, flat - 1 :]
    for row, flags in zip(rows.tolist(), is_saturated, strict=True):
        at = np.flatnonzero(flags)
        if pause is not None and np.any(is_over := np.diff(at, prepend=0) > pause + flat):
            at = at[: int(np.argmax(is_over))]
        until[row] = at[-1] + 1 if len(at) else 0
    return until


def _blank(
    voltage_uv: Traces, is_blank: Flags, start: int, until: Counts, is_held: Bool[np.ndarray, " channels"]
) -> None:
    """Draw a straight line over the blanked stretch of each channel, between the means of ten samples on either side.

    For a channel that stays saturated beyond it (`is_held`), the line stays at the mean before.
    """
    for stop in np.unique(until).tolist():
        chosen = np.flatnonzero(until == stop)
        sides = voltage_uv[chosen, max(start - 10, 0) : start], voltage_uv[chosen, stop : stop + 10]
        ends_uv = [side.mean(axis=1) for side in sides if side.shape[1]] or [np.zeros(len(chosen), np.float32)]
        from_uv, to_uv = ends_uv[0], np.where(is_held[chosen], ends_uv[0], ends_uv[-1])
        share = ((np.arange(stop - start) + 1) / (stop - start + 1)).astype(np.float32)
        voltage_uv[chosen, start:stop] = from_uv[:, None] * (1 - share) + to_uv[:, None] * share
        is_blank[chosen, start:stop] = True


def _subtract_recovery(
    voltage_uv: Traces, until: Counts, stops: Counts, rest_uv: Levels, noise_uv: Levels, per_ms: float
) -> None:
    """Fit a exp(-t / tau) + b to the trace of each unsettled channel after blanking, and subtract the exponential."""
    for start, stop in np.unique(np.column_stack([until, stops]), axis=0).tolist():
        length = stop - start
        if length < round(2 * per_ms):
            continue
        rows = np.flatnonzero((until == start) & (stops == stop))
        early = voltage_uv[rows, start : start + max(round(0.5 * per_ms), 1)].mean(axis=1) - rest_uv[rows]
        rows = rows[np.abs(early) > UNSETTLED * noise_uv[rows]]
        if not len(rows):
            continue
        trace = voltage_uv[rows, start:stop].astype(np.float64)
        exponential = _fitted(trace, np.arange(length) / per_ms, np.maximum(noise_uv[rows], 1e-6))
        voltage_uv[rows, start:stop] -= exponential.astype(np.float32)


def _fitted(trace_uv: Rows, t_ms: Float64[np.ndarray, " samples"], noise_uv: Float32[np.ndarray, " rows"]) -> Rows:
    """The exponential a exp(-k t) of the robust least-squares fit a exp(-k t) + b to each row.

    Gauss-Newton steps on a, k and b start from the best of a few k. Residuals are clipped at four standard deviations
    of the noise, or at three times their own median if that is more, so that spikes do not distort the fit.
    """
    best = np.full(len(trace_uv), np.inf)
    a, b, k = (np.zeros(len(trace_uv)) for _ in range(3))
    for rate, basis, inverse in _starts(len(t_ms), float(t_ms[:2].max())):
        of_rate = inverse @ trace_uv.T
        error = np.median(np.abs(trace_uv - (basis @ of_rate).T), axis=1)
        better = error < best
        best[better], a[better], b[better], k[better] = error[better], of_rate[0, better], of_rate[1, better], rate
    slowest, fastest = 0.5 / max(TAUS_MS), 2 / min(TAUS_MS)
    for _ in range(GAUSS_NEWTON_STEPS):
        shape = np.exp(-k[:, None] * t_ms)
        residual = trace_uv - a[:, None] * shape - b[:, None]
        limit = np.maximum(4 * noise_uv, 3 * np.median(np.abs(residual), axis=1))[:, None]
        residual = np.clip(residual, -limit, limit)
        jacobian = np.stack([shape, -a[:, None] * t_ms * shape, np.ones_like(shape)], axis=1)
        normal = jacobian @ jacobian.transpose(0, 2, 1)
        # A little on the diagonal keeps it solvable for a row without any exponential.
        normal += 1e-9 * np.einsum("rii->ri", normal)[:, :, None] * np.eye(3) + 1e-12 * np.eye(3)
        step = np.linalg.solve(normal, jacobian @ residual[:, :, None])[:, :, 0]
        a, b = a + step[:, 0], b + step[:, 2]
        k = np.clip(k + np.clip(step[:, 1], -0.5 * k, 0.5 * k), slowest, fastest)
    return np.asarray(a[:, None] * np.exp(-k[:, None] * t_ms))


@lru_cache(maxsize=32)
def _starts(samples: int, step_ms: float) -> list[tuple[float, Float64[np.ndarray, "samples 2"], np.ndarray]]:
    """For each k that the fit starts from: k, exp(-k t) and 1 at every sample, and the pseudoinverse of these."""
    t_ms = np.arange(samples) * step_ms
    bases = [(1 / tau, np.column_stack([np.exp(-t_ms / tau), np.ones(samples)])) for tau in TAUS_MS]
    return [(rate, basis, np.linalg.pinv(basis)) for rate, basis in bases]
