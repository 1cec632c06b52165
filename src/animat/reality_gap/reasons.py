"""Why the measured return differs from the predicted one: reasons in the session's own data, each with its number."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import stdtr, stdtrit

from animat.reality_gap.calibration import Calibration
from animat.reality_gap.predicting import AgentPrediction
from animat.reality_gap.session_responses import SessionResponses
from animat.recordings.findings import Finding
from animat.responses.quality.history import memory_findings, repetitions
from animat.responses.quality.responses import FEW_SAMPLES

LEVEL = 0.01
"""Highest rate of false reasons of each check that is a statistical test."""
FEWEST_EPISODES = 8
"""Fewest episodes of the policies from which a trend or a difference in commands is reported."""
_FEWEST_RESPONSES = 3
"""Fewest responses to a condition in an episode that counts for a trend."""
LEAST_LATE = 0.05
"""Least lateness, as a share of the interval between pulses, on average over a condition's trials."""
LEAST_BURSTS, _FEWEST_BURSTS = 0.05, 5
LEAST_TREND = 0.1
"""Least change over the session, as a share of a condition's mean response."""
LEAST_COMMAND, LEAST_OFFSET = 0.1, 0.03
"""Least difference in a condition's mean command, and least mean difference over all conditions."""
LEAST_REPETITION, _LEAST_SHARE = 0.05, 0.1
"""Least difference in mean rank, and least share of the responses, of a group with alike repetitions."""
_REPETITIONS = {"after another condition": (0, 0), "after 1 to 4 of the same": (1, 4), "after more": (5, np.inf)}


@dataclass(frozen=True, eq=False)
class Evidence:
    """Data on policies, all together, whose measured return differs from the predicted one; `gap`: -1 if it is less."""

    session: SessionResponses
    calibration: Calibration
    predicted: AgentPrediction
    gap: Literal[-1, 1]


def reasons(evidence: Evidence) -> tuple[Finding, ...]:
    """Possible reasons for the gap that the data show; empty if they show none."""
    return tuple(finding for check in CHECKS.values() if (finding := check(evidence)) is not None)


def presentation(evidence: Evidence) -> Finding | None:
    """The presentation in the loop differs from that in the predicting recording."""
    recorded, presented = evidence.calibration.presentation, evidence.session.responses.presentation
    if recorded == presented:
        return None
    message = f"the presentation in the recording was {recorded or 'unknown'}, in the loop {presented}"
    return Finding("presentation", "note", message)


def few_samples(evidence: Evidence) -> Finding | None:
    """A condition has too few responses in the recording for the bootstrap to be reliable."""
    n = [len(each) for each in evidence.calibration.responses_hz]
    if min(n) >= FEW_SAMPLES:
        return None
    conditions = zip(evidence.session.responses.conditions, n, strict=True)
    few = [f"{count} of {condition.label}" for condition, count in conditions if count < FEW_SAMPLES]
    return Finding("few-samples", "note", f"the recording has few responses: {', '.join(few)}", min(n))


def lateness(evidence: Evidence) -> Finding | None:
    """Pulses came so late that a condition's frequency was different."""
    session, late = evidence.session, dict[str, float]()
    for i, condition in enumerate(session.responses.conditions):
        late_s = session.late_s[session.responses.condition == i]
        if not len(late_s) or (part := float(late_s.mean()) / condition.interval_s) < LEAST_LATE:
            continue
        share, late_ms = float(np.mean(late_s > 0)), 1000 * float(late_s[late_s > 0].mean())
        by = f"by {late_ms:.2g} ms of its {1000 * condition.interval_s:.3g} on average"
        late[f"{condition.label} in {100 * share:.0f} % of its trials, {by}"] = part
    return _note("lateness", "pulses came late: {}", late)


def bursts(evidence: Evidence) -> Finding | None:
    """Many responses were bursts, which simulators do not produce."""
    is_burst = evidence.session.responses.is_burst
    count, n = int(is_burst.sum()), len(is_burst)
    if count < max(_FEWEST_BURSTS, LEAST_BURSTS * n):
        return None
    message = (
        f"{100 * count / n:.0f} % of {n:,} responses were bursts ({100 * evidence.calibration.burst_share:.0f} % in "
        "the recording), which the prediction leaves out"
    )
    return Finding("bursts", "note", message, count / n)


def trend(evidence: Evidence) -> Finding | None:
    """Responses change over the session, and the returns with them.

    For each condition, linear regression of the episodes' mean responses on their times; for the returns, Kendall's
    rank correlation with time, in the direction of the gap.
    """
    from scipy.stats import kendalltau, linregress

    session = evidence.session
    responses, time_s, episodes = session.responses, session.responses.time_s, len(session.returns)
    if time_s is None:
        return None
    with_time = kendalltau(np.arange(episodes), session.returns, alternative="less" if evidence.gap < 0 else "greater")
    if not with_time.pvalue < LEVEL:
        return None
    tested = []
    for i, condition in enumerate(responses.conditions):
        chosen = (responses.condition == i) & ~responses.is_burst
        n = np.bincount(session.episode[chosen], minlength=episodes)
        kept = n >= _FEWEST_RESPONSES
        if np.count_nonzero(kept) >= FEWEST_EPISODES:
            x, t = (
                np.bincount(session.episode[chosen], each[chosen], episodes)[kept] / n[kept]
                for each in (responses.rate_hz, time_s / 60)
            )
            tested.append((condition.label, linregress(t, x), float(np.ptp(t)) / max(float(x.mean()), 1e-9)))
    changes = dict[str, float]()
    for label, fit, scale in tested:
        change, error = fit.slope * scale, fit.stderr * scale
        if fit.pvalue < LEVEL / len(tested) and abs(change) >= LEAST_TREND:
            by = f"{100 * abs(change):.0f} % +- {100 * error:.0f}"
            changes[f"to {label} {'rise' if change > 0 else 'fall'} by {by}"] = change
    message = (
        f"the culture changed over the session's {np.ptp(time_s) / 60:.0f} min: responses {{}} (of their mean, "
        f"standard error), and the returns with them (Kendall's tau with time {with_time.statistic:+.2f})"
    )
    return _note("trend", message, changes)


def memory(evidence: Evidence) -> Finding | None:
    """Responses depend on previous responses, but the predicting simulator has no memory."""
    if evidence.calibration.simulator.has_memory:
        return None
    finding = next(memory_findings(evidence.session.responses), None)
    return None if finding is None else Finding("memory", "note", finding.message, finding.value)


def answers(evidence: Evidence) -> Finding | None:
    """Conditions lead to different commands than on the simulator with the same policies.

    t = (u - v) / sqrt(s^2 + r^2), with episodes - 1 degrees of freedom; u: the mean command in the session, s its error
    from differences between episodes; v: that on the simulator, r its error from bootstrap simulators. Neither error is
    smaller than that of equally many independent responses, if each were -1 or +1 (Agresti and Coull 1998).

    If no condition differs by itself, all commands are tested together, each less v of its condition, with the error of
    equally many independent ones as they vary in the session: a task that is hard to control can be lost by thresholds
    that are too low or too high by little.
    """
    measured, predicted = evidence.session.commanded, evidence.predicted
    episodes, recorded_hz = len(measured.presented), evidence.calibration.responses_hz
    if episodes < FEWEST_EPISODES:
        return None
    conditions = np.flatnonzero((measured.presented.sum(axis=0) >= 20) & (predicted.commanded.presented > 0))
    responses, names = evidence.session.responses, evidence.session.responses.readouts.names
    tested = [(i, d) for i in conditions.tolist() for d in range(len(names))]
    level = LEVEL / (len(tested) + len(names))
    differences = dict[str, float]()
    for i, d in tested:
        n, expected = measured.presented[:, i], float(predicted.commanded.mean[i, d])
        mean, between = _mean_over(measured.total[:, i, d], n)
        error = max(between, _variance(mean, int(n.sum())) ** 0.5)
        bootstrapped = float(np.nanvar(predicted.commanded_bootstraps.mean[:, i, d]))
        expected_error = max(bootstrapped, _variance(expected, len(recorded_hz[i]))) ** 0.5
        difference = mean - expected
        p = 2 * stdtr(episodes - 1, -abs(difference) / np.hypot(error, expected_error))
        if p < level and abs(difference) >= LEAST_COMMAND:
            each_hz = responses.read_hz[(responses.condition == i) & evidence.session.moved], recorded_hz[i]
            measured_hz, usual_hz = (x_hz.reshape(len(x_hz), -1)[:, d].mean() for x_hz in each_hz)
            on = f" on {names[d]}" if len(names) > 1 else ""
            text = (
                f"{responses.conditions[i].label}{on} to {mean:+.2f} +- {error:.2f} ({expected:+.2f} +- "
                f"{expected_error:.2f}; mean {measured_hz:.3g} Hz, {usual_hz:.3g} in the recording)"
            )
            differences[text] = difference
    if not differences and len(conditions):
        return _command_offset(evidence, conditions, level)
    return _note("answers", "conditions lead to different mean commands than predicted: {}", differences)


def _command_offset(evidence: Evidence, conditions: Int64[np.ndarray, " conditions"], level: float) -> Finding | None:
    """The mean difference of all commands from the mean that is predicted for their conditions, on each readout."""
    measured, predicted = evidence.session.commanded, evidence.predicted
    responses, names = evidence.session.responses, evidence.session.responses.readouts.names
    commands = evidence.session.command.reshape(len(responses), -1)
    n, episodes = measured.presented[:, conditions], len(measured.presented)
    shares, recorded = n.sum(axis=0) / n.sum(), [len(evidence.calibration.responses_hz[i]) for i in conditions]
    of_each = [np.flatnonzero((responses.condition == i) & evidence.session.moved) for i in conditions]
    message, most = "", 0.0
    for d, name in enumerate(names):
        v, bootstrapped = (of.mean[..., conditions, d] for of in (predicted.commanded, predicted.commanded_bootstraps))
        offset, between = _mean_over((measured.total[:, conditions, d] - n * v).sum(axis=1), n.sum(axis=1))
        # Bootstrap simulators have percentiles of their own, which keep the mean of all commands in place.
        independent = np.array([commands[rows, d].var() for rows in of_each]) / recorded
        error = math.sqrt(between**2 + max(float(np.nanvar(bootstrapped @ shares)), float(shares**2 @ independent)))
        # Without a quotient, as the error is 0 where each condition always leads to the same command.
        if abs(offset) >= max(LEAST_OFFSET, abs(most)) and abs(offset) > -stdtrit(episodes - 1, level / 2) * error:
            most = offset
            message = (
                f"commands{f' on {name}' if len(names) > 1 else ''} are {'higher' if offset > 0 else 'lower'} than "
                f"predicted for the same conditions, by {abs(offset):.3f} +- {error:.3f} on average"
            )
    return Finding("answers", "note", message, most) if message else None


def repetition(evidence: Evidence) -> Finding | None:
    """Responses depend on how often their condition was presented directly before, which simulators do not model.

    For three groups of responses by the number of repetitions, the mean of y less its mean over the session's responses
    to the same condition; y: a response's rank less the effect of its history (`animat.neurons.history_tracker`), each
    readout separately. As in `answers`, its error is from differences between episodes.
    """
    session, names = evidence.session, evidence.session.responses.readouts.names
    responses, episodes = session.responses, len(session.returns)
    usable = ~responses.is_burst
    y = evidence.calibration.adjusted.of_responses(responses)
    for condition in range(len(responses.conditions)):
        of = responses.condition == condition
        if (of & usable).any():
            y[of] -= y[of & usable].mean(axis=0)
    repeats, groups = repetitions(responses), dict[str, float]()
    tested = [(label, d, *ends) for label, ends in _REPETITIONS.items() for d in range(len(names))]
    for label, d, low, high in tested:
        of = usable & (repeats >= low) & (repeats <= high)
        n = np.bincount(session.episode[of], minlength=episodes)
        total = np.bincount(session.episode[of], y[of, d], episodes)
        if np.count_nonzero(n) < FEWEST_EPISODES or n.sum() < _LEAST_SHARE * usable.sum():
            continue
        mean, error = _mean_over(total, n)
        if abs(mean) > max(LEAST_REPETITION, -stdtrit(episodes - 1, LEVEL / len(tested) / 2) * error):
            on = f" on {names[d]}" if len(names) > 1 else ""
            groups[f"{mean:+.2f} +- {error:.2f}{on} {label}"] = mean
    what = "responses depend on repetition, which simulators do not model: their mean rank differs by {}"
    return _note("repetition", what, groups)


CHECKS: dict[str, Callable[[Evidence], Finding | None]] = {
    "a different presentation": presentation,
    "few responses": few_samples,
    "late pulses": lateness,
    "bursts": bursts,
    "a trend over the session": trend,
    "memory": memory,
    "repetition": repetition,
    "mean commands": answers,
}
"""All checks, by their descriptions in messages."""


def _note(name: str, message: str, found: Mapping[str, float]) -> Finding | None:
    """A note on what was found, with the largest of its numbers; None if nothing was."""
    return Finding(name, "note", message.format(", ".join(found)), max(found.values(), key=abs)) if found else None


def _mean_over(total: Float64[np.ndarray, " episodes"], n: Int64[np.ndarray, " episodes"]) -> tuple[float, float]:
    """The mean of n values in each episode with their total, and its error from differences between episodes."""
    mean = float(total.sum() / n.sum())
    return mean, math.sqrt(len(n) / (len(n) - 1) * np.sum((total - mean * n) ** 2)) / float(n.sum())


def _variance(command: float, n: int) -> float:
    """The variance of the mean of n commands that are -1 or +1."""
    near = ((command + 1) / 2 * n + 2) / (n + 4)
    return 4 * near * (1 - near) / (n + 4)
