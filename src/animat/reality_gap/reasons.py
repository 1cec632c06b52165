"""Why policies live another return than was predicted: what the session's own data show, each with its number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from animat.reality_gap.calibration import Calibration
from animat.reality_gap.predicting import Prediction
from animat.reality_gap.session_responses import SessionResponses
from animat.recordings.findings import Finding
from animat.responses.condition import Condition
from animat.responses.quality.memory import memory_findings
from animat.responses.quality.responses import FEW_SAMPLES

LEVEL = 0.01
"""How often each check that tests something names a reason that is none, at most."""
FEWEST_EPISODES = 8
"""Of the policies, that a trend or a share is told from; of a condition in a trend's episode, `_FEWEST`."""
_FEWEST = 3
LEAST_LATE = 0.05
"""Of the interval between pulses, on average over a condition's trials."""
LEAST_BURSTS, _FEWEST_BURSTS = 0.05, 5
LEAST_TREND = 0.1
"""Change over the session, of a condition's mean response."""
LEAST_COMMAND = 0.1
"""Difference in a condition's mean command."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of policies whose measured return differs from the predicted one.

    Attributes:
        calibration: the recording that predicted.
        predicted: of all policies together.
        gap: the sign of their gap: -1 where less was measured.
    """

    session: SessionResponses
    calibration: Calibration
    predicted: Prediction
    gap: Literal[-1, 1]


def reasons(evidence: Evidence) -> tuple[Finding, ...]:
    """What may have made the gap, as far as the data show it; none where they show nothing."""
    return tuple(found for check in CHECKS.values() if (found := check(evidence)) is not None)


def presentation(evidence: Evidence) -> Finding | None:
    """The loop presented otherwise than the recording that predicted."""
    recorded, presented = evidence.calibration.presentation, evidence.session.responses.presentation
    if recorded == presented:
        return None
    message = f"the recording was presented {recorded or 'as is not known'}, the loop {presented}"
    return Finding("presentation", "note", message)


def few_samples(evidence: Evidence) -> Finding | None:
    """A condition has fewer responses in the recording than bootstrapping them tells the truth of."""
    n = [len(each) for each in evidence.calibration.responses_hz]
    if min(n) >= FEW_SAMPLES:
        return None
    few = [f"{n[i]} of {condition.label}" for i, condition in enumerate(_conditions(evidence)) if n[i] < FEW_SAMPLES]
    return Finding("few-samples", "note", f"the recording has few responses: {', '.join(few)}", min(n))


def lateness(evidence: Evidence) -> Finding | None:
    """Pulses came so late that a condition was at another frequency."""
    answers, told, most = evidence.session, [], 0.0
    for i, condition in enumerate(_conditions(evidence)):
        late_s = answers.late_s[answers.responses.condition == i]
        if not len(late_s) or (part := float(late_s.mean()) / condition.interval_s) < LEAST_LATE:
            continue
        most = max(most, part)
        share, late_ms = float(np.mean(late_s > 0)), 1000 * float(late_s[late_s > 0].mean())
        told.append(
            f"{condition.label} in {100 * share:.0f} % of its trials, by {late_ms:.2g} ms of its "
            f"{1000 * condition.interval_s:.3g} on average"
        )
    return Finding("lateness", "note", f"pulses came late: {', '.join(told)}", most) if told else None


def bursts(evidence: Evidence) -> Finding | None:
    """Many responses were bursts, which no simulator has."""
    is_burst = evidence.session.responses.is_burst
    count, n = int(is_burst.sum()), len(is_burst)
    if count < max(_FEWEST_BURSTS, LEAST_BURSTS * n):
        return None
    message = (
        f"{100 * count / n:.0f} % of {n} responses were bursts ({100 * evidence.calibration.burst_share:.0f} % in the "
        "recording), which the prediction leaves out"
    )
    return Finding("bursts", "note", message, count / n)


def trend(evidence: Evidence) -> Finding | None:
    """Responses change over the session, and the returns with them.

    For each condition least squares of the episodes' mean responses against their times; for the returns Kendall's
    rank correlation with time, in the direction of the gap.
    """
    from scipy.stats import kendalltau, linregress

    answers = evidence.session
    responses, time_s, episodes = answers.responses, answers.responses.time_s, len(answers.returns)
    if time_s is None or episodes < FEWEST_EPISODES:
        return None
    with_time = kendalltau(np.arange(episodes), answers.returns, alternative="less" if evidence.gap < 0 else "greater")
    if not with_time.pvalue < LEVEL:
        return None
    tested = []
    for i, condition in enumerate(_conditions(evidence)):
        chosen = (responses.condition == i) & ~responses.is_burst
        n = np.bincount(answers.episode[chosen], minlength=episodes)
        kept = n >= _FEWEST
        if np.count_nonzero(kept) >= FEWEST_EPISODES:
            x, t = (
                np.bincount(answers.episode[chosen], each[chosen], episodes)[kept] / n[kept]
                for each in (responses.rate_hz, time_s / 60)
            )
            tested.append((condition.label, linregress(t, x), float(np.ptp(t)) / max(float(x.mean()), 1e-9)))
    told, most = [], 0.0
    for label, fit, scale in tested:
        change, error = fit.slope * scale, fit.stderr * scale
        if fit.pvalue < LEVEL / len(tested) and abs(change) >= LEAST_TREND:
            most = max(most, change, key=abs)
            told.append(
                f"to {label} {'rise' if change > 0 else 'fall'} by {100 * abs(change):.0f} % +- {100 * error:.0f}"
            )
    if not told:
        return None
    message = (
        f"the culture changed over the session's {answers.span_min:.0f} min: responses {', '.join(told)} (of their "
        f"mean, standard error), and the returns with them (Kendall's tau with time {with_time.statistic:+.2f})"
    )
    return Finding("trend", "note", message, most)


def memory(evidence: Evidence) -> Finding | None:
    """What the culture answered depends on its answer before, and the simulator that predicted does not know it."""
    if evidence.calibration.simulator.has_memory:
        return None
    found = next(memory_findings(evidence.session.responses), None)
    return None if found is None else Finding("memory", "note", found.message, found.value)


def answers(evidence: Evidence) -> Finding | None:
    """Conditions lead to other commands than they did on the simulator under the same policies.

    t = (u - v) / sqrt(s^2 + r^2), with episodes - 1 degrees of freedom; u: the mean command of the session, s its error
    from what differs between episodes; v: on the simulator, r its error from simulators of responses drawn anew.
    Neither error is taken to be smaller than that of as many independent responses, if each were -1 or +1 (Agresti and
    Coull 1998).
    """
    from scipy.stats import t as student

    measured, predicted = evidence.session.commanded, evidence.predicted
    episodes, recorded_hz = len(measured.presented), evidence.calibration.responses_hz
    if episodes < FEWEST_EPISODES:
        return None
    conditions = np.flatnonzero((measured.presented.sum(axis=0) >= 20) & (predicted.commanded.presented > 0))
    names, read_hz = evidence.session.responses.readouts.names, evidence.session.responses.read_hz
    # Of one readout there is no axis.
    of_readouts: list[Any] = [()] if read_hz.ndim == 1 else [(d,) for d in range(len(names))]
    tested = [(i, of) for i in conditions.tolist() for of in of_readouts]
    told, most = [], 0.0
    for i, of in tested:
        at: Any = (i, *of)
        n, total = measured.presented[:, i], measured.total[:, *at]
        mean, expected = float(total.sum() / n.sum()), float(predicted.commanded.mean[at])
        between = episodes / (episodes - 1) * float(np.sum((total - mean * n) ** 2)) / float(n.sum()) ** 2
        error = max(between, _variance(mean, int(n.sum()))) ** 0.5
        anew = float(np.nanvar(predicted.commanded_bootstraps.mean[:, *at]))
        expected_error = max(anew, _variance(expected, len(recorded_hz[i]))) ** 0.5
        difference = mean - expected
        p = 2 * student.sf(abs(difference) / np.hypot(error, expected_error), episodes - 1)
        if p < LEVEL / len(tested) and abs(difference) >= LEAST_COMMAND:
            most = max(most, difference, key=abs)
            measured_hz = read_hz[evidence.session.responses.condition == i, *of].mean()
            on = f" on {names[of[0]]}" if of else ""
            told.append(
                f"{_conditions(evidence)[i].label}{on} to {mean:+.2f} +- {error:.2f} ({expected:+.2f} +- "
                f"{expected_error:.2f}; mean {measured_hz:.3g} Hz, "
                f"{recorded_hz[i][:, *of].mean():.3g} in the recording)"
            )
    if not told:
        return None
    message = f"conditions lead to other mean commands than predicted: {', '.join(told)}"
    return Finding("answers", "note", message, most)


CHECKS: dict[str, Callable[[Evidence], Finding | None]] = {
    "another presentation": presentation,
    "few responses": few_samples,
    "late pulses": lateness,
    "bursts": bursts,
    "a trend over the session": trend,
    "memory": memory,
    "mean commands": answers,
}
"""What is looked for, in words."""


def _variance(command: float, n: int) -> float:
    """Of the mean of n commands that are -1 or +1."""
    near = ((command + 1) / 2 * n + 2) / (n + 4)
    return 4 * near * (1 - near) / (n + 4)


def _conditions(evidence: Evidence) -> tuple[Condition, ...]:
    return evidence.session.responses.conditions
