"""The table of predicted and measured returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from animat.closed_loop.gathering import in_words
from animat.closed_loop.loop import Loop
from animat.closed_loop.session import Session, told_unanswered
from animat.cultures.budget import Account
from animat.evaluation.statistics import CONFIDENCE, Interval
from animat.evaluation.verdict import Beside, Verdict
from animat.goals.robot import objectives_of
from animat.goals.tally import MEANS, cells_of, told_satisfaction
from animat.lined_up import lined_up
from animat.reality_gap.outlook import Outlook
from animat.reality_gap.reasons import CHECKS
from animat.recordings.findings import Finding
from animat.records import as_json

LARGE_SHARE = 0.1
"""Of the range from random to the optimal return: a gap that is worth a word though it may be none."""
_RESAMPLES = 10_000


@dataclass(frozen=True, eq=False)
class Row:
    """One line of the table.

    Attributes:
        name, meaning: who acted.
        predicted: returns on the simulator, shape (episodes,).
        predicted_anew: mean return on each simulator of the recording's responses drawn anew, shape (bootstraps,).
        measured: returns of whole episodes on the culture, shape (episodes,).
        pulses_per_action: that the culture was given, without the warm-up; so are the next three.
        seconds_per_action: of the culture's time.
        bursts: share of responses that were.
        late: share of trials that came late.
        beside: the policies' measured returns beside these; None for the policies, and where either has none.
        met: how the goal was met on the culture (`animat.goals.tally.Outcome.means`); empty for a robot without one,
            and where no episode came to its end.
    """

    name: str
    meaning: str
    predicted: Float64[np.ndarray, " predicted"]
    predicted_anew: Float64[np.ndarray, " bootstraps"]
    measured: Float64[np.ndarray, " measured"]
    pulses_per_action: float
    seconds_per_action: float
    bursts: float
    late: float
    beside: Beside | None = None
    met: dict[str, Any] = field(default_factory=dict)

    @property
    def prediction(self) -> Interval:
        """Mean predicted return, and between which it lies as the recording's responses are drawn anew."""
        return _between(self.predicted.mean(), self.predicted_anew)

    @property
    def gap(self) -> Interval:
        """Mean measured less mean predicted return; its interval is over recordings and measured episodes drawn anew.

        Its ends are infinite with fewer than two measured episodes. Responses are drawn as if they were independent:
        a drift between the recording and the loop is not in the interval, and shows as a gap.
        """
        value = self.measured.mean() - self.predicted.mean()
        if len(self.measured) < 2:
            return Interval(float(value), -np.inf, np.inf, CONFIDENCE)
        rng = np.random.default_rng(0)
        measured = _resampled_means(self.measured, rng)
        return _between(value, measured - rng.choice(self.predicted_anew, len(measured)))

    @property
    def gap_sign(self) -> Literal[-1, 0, 1]:
        """-1 where less was measured than predicted, 1 where more, 0 where that cannot be told."""
        if not len(self.measured):
            return 0
        gap = self.gap
        return -1 if gap.high < 0 else 1 if gap.low > 0 else 0

    def to_dict(self) -> dict[str, Any]:
        """The line as plain data."""
        measured = bool(len(self.measured))
        return {
            "name": self.name,
            "meaning": self.meaning,
            "predicted": float(self.predicted.mean()),
            "prediction": as_json(self.prediction.to_dict()),
            "measured": float(self.measured.mean()) if measured else None,
            "gap": as_json(self.gap.to_dict()) if measured else None,
            "episodes": len(self.measured),
            "measured_returns": self.measured.tolist(),
            "pulses_per_action": self.pulses_per_action,
            "seconds_per_action": self.seconds_per_action,
            "bursts": self.bursts,
            "late": self.late,
            "p": None if self.beside is None else self.beside.p,
            "wins": None if self.beside is None else self.beside.wins,
            **self.met,
        }


@dataclass(frozen=True, eq=False)
class RealityGap:
    """Policies and controls, predicted and measured.

    Attributes:
        robot, mapping: names.
        loop: the settings of the closed loop.
        calibrated_at_min: of the recording that predicted.
        optimum: the optimal return on that recording's simulator, of any controller (`animat.evaluation.optimum`);
            None where conditions have too few responses to tell.
        rows: all policies together first, then each of them where there are several, then the controls.
        session: as it ran.
        account: of the stimulation.
        findings: where loop, recording and policy differ, and what was noticed.
        responses: that the recording has, without bursts.
        outlook: how long the session would be and could be, as it was known beforehand.
        reasons: why the policies' measured return differs from the predicted one, as far as the session's data show it.
    """

    robot: str
    mapping: str
    loop: Loop
    calibrated_at_min: float
    optimum: float | None
    rows: tuple[Row, ...]
    session: Session
    account: Account
    findings: tuple[Finding, ...]
    responses: int
    outlook: Outlook
    reasons: tuple[Finding, ...]

    @property
    def beside_controls(self) -> Verdict | None:
        """Whether the policies outperform each control that was run to the end of an episode; None if none was."""
        controls = {row.name: row.beside for row in self.rows if row.beside is not None}
        return Verdict(controls) if controls else None

    @property
    def gap_share(self) -> float | None:
        """The policies' gap as a share of what there is to win: of the range from predicted random to the optimum."""
        if self.optimum is None:
            return None
        range_ = self.optimum - next(row for row in self.rows if row.name == "random").predicted.mean()
        return float(self.rows[0].gap.value / range_) if len(self.rows[0].measured) and range_ > 0 else None

    def verdict(self) -> str:
        """Whether the policies outperform the controls, and what the gap may come from."""
        beside, policies = self.beside_controls, self.rows[0]
        if beside is None:
            who = "no control" if len(policies.measured) else "no episode of a policy"
            return f"{who} ran to its end: nothing can be said of the policies beside the controls"
        return str(beside) + self._on_the_gap()

    def _on_the_gap(self) -> str:
        """What may have made the policies' gap."""
        row, share = self.rows[0], self.gap_share
        if not row.gap_sign:
            if share is None or abs(share) < LARGE_SHARE or len(row.measured) < 2:
                return ""
            return (
                f"; their measured return is {_more_or_less(row.gap.value)} than predicted, within what the "
                f"recording's {self.responses} responses and {len(row.measured)} episodes can tell"
            )
        said = f"; their measured return is {_more_or_less(row.gap.value)} than predicted"
        if self.reasons:
            return f"{said}: {'; '.join(reason.message for reason in self.reasons)}"
        return f"{said}, and nothing in the session's data explains it (looked for: {', '.join(CHECKS)})"

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "robot": self.robot,
            "mapping": self.mapping,
            "presentation": str(self.loop.presentation),
            "calibrated_at_min": self.calibrated_at_min,
            "optimum": self.optimum,
            "gap_share": self.gap_share,
            "rows": [row.to_dict() for row in self.rows],
            "not_outperformed": None if self.beside_controls is None else self.beside_controls.not_outperformed,
            "verdict": self.verdict(),
            "reasons": [reason.to_dict() for reason in self.reasons],
            "planned_min": self.outlook.planned_min,
            "outlook": str(self.outlook),
            "session": self.session.to_dict(),
            "folder": str(self.session.folder),
            "budget": self.account.to_dict(),
            "findings": [finding.to_dict() for finding in self.findings],
            **({"objectives": list(objectives)} if (objectives := objectives_of(self.loop.robot)) else {}),
        }

    def to_text(self) -> str:
        """A table for a terminal."""
        cells, objectives = [], objectives_of(self.loop.robot)
        for row in self.rows:
            told, prediction = row.to_dict(), row.prediction
            anew = f"{prediction.low:.1f} to {prediction.high:.1f}"
            measured = ["-", "-", ""]
            if (gap := told["gap"]) is not None:
                between = "unknown" if gap["low"] is None else f"{gap['low']:+.1f} to {gap['high']:+.1f}"
                measured = [f"{told['measured']:.1f}", f"{gap['value']:+.1f}", between]
            p = "" if row.beside is None else f"{row.beside.p:.2g}"
            counts = [
                *(cells_of(row.met) if objectives else []),
                str(len(row.measured)),
                f"{row.pulses_per_action:.1f}",
            ]
            cells.append([row.name, f"{told['predicted']:.1f}", anew, *measured, *counts, p, row.meaning])
        interval = "95 % interval"
        head = [
            "",
            "predicted",
            interval,
            "measured",
            "gap",
            interval,
            *(MEANS if objectives else ()),
            "episodes",
            "pulses/action",
            "p",
            "",
        ]
        lines = [
            f"{self.robot}, {self.mapping}, {self.loop.presentation}; predicted from the recording at "
            f"{self.calibrated_at_min:g} min",
            *lined_up(head, cells),
        ]
        if self.rows[0].met:
            lines.append(f"  {told_satisfaction(objectives, self.rows[0].met)}")
        if self.optimum is not None:
            share = ""
            if self.gap_share is not None:
                share = f"; the policies' gap is {100 * self.gap_share:+.0f} % of the range from random to it"
            lines.append(f"  the optimal return on this simulator is about {self.optimum:.1f}{share}")
        lines += [f"  {finding.message}" for finding in self.findings if finding.name in ("no-optimum", "no-heuristic")]
        outline = self.session.to_dict()
        lines.append(f"  {self.verdict()}")
        lines.append(f"  p: that the policies' returns are no other than this control's; stimulation: {self.account}")
        lines.append(
            f"  {outline['ticks']} ticks, {outline['bursts']} bursts, {outline['late_pulses']} late pulses"
            f" (the latest {outline['latest_ms']:.1f} ms); ended: {outline['ended']}"
        )
        if outline["unanswered_pulses"]:
            lines.append(f"  {told_unanswered(self.session)}")
        if self.session.left_out:
            lines.append(f"  left out: {in_words(self.session.left_out)}")
        return "\n".join(lines)


def _more_or_less(gap: float) -> str:
    return f"{abs(gap):.1f} {'more' if gap > 0 else 'less'}"


def _between(value: float, drawn: Float64[np.ndarray, " draws"]) -> Interval:
    """A value with the interval that holds 95 % of what was drawn anew."""
    # Of a hundred draws the usual interpolation would hold 93 %.
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="weibull")
    return Interval(float(value), float(low), float(high), CONFIDENCE)


def _resampled_means(
    returns: Float64[np.ndarray, " episodes"], rng: np.random.Generator
) -> Float64[np.ndarray, " resamples"]:
    n = len(returns)
    often = rng.multinomial(n, np.full(n, 1 / n), _RESAMPLES)
    means: Float64[np.ndarray, " resamples"] = often @ returns / n
    return means
