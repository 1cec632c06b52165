"""The table of predicted and measured returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from animat.closed_loop.gathering import in_words
from animat.closed_loop.loop import Loop
from animat.closed_loop.session import Session, told_unanswered
from animat.columns import align_columns
from animat.cultures.budget import Account
from animat.errors import in_min
from animat.evaluation.verdict import Verdict
from animat.goals.robot import objectives_of
from animat.goals.tally import MEANS, cells_of, told_satisfaction
from animat.reality_gap.outlook import Outlook
from animat.reality_gap.reasons import CHECKS
from animat.reality_gap.row import Row
from animat.reality_gap.whose_work import Replaced, told_replaced
from animat.recordings.findings import Finding

LARGE_SHARE = 0.1
"""Of the range from random to the optimal return: a gap that is worth a word though it may be none."""


@dataclass(frozen=True, eq=False)
class RealityGap:
    """Policies and controls, predicted and measured.

    Attributes:
        calibrated_at_min: of the recording that predicted.
        optimum: the optimal return on that recording's simulator, of any controller (`animat.evaluation.optimum`);
            None where conditions have too few responses to tell.
        rows: all policies together first, then each of them where there are several, then the controls.
        findings: where loop, recording and policy differ, and what was noticed.
        responses: that the recording has, without bursts.
        outlook: how long the session would be and could be, as it was known beforehand.
        reasons: why the policies' measured return differs from the predicted one, as far as the session's data show it.
        whose_work: what the policies' return becomes with something in the culture's place; empty if it was not asked.
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
    whose_work: tuple[Replaced, ...] = ()

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
                f"recording's responses ({self.responses}) and the episodes ({len(row.measured)}) can tell"
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
            "pulse_cost": self.rows[0].pulse_cost,
            "gap_share": self.gap_share,
            "rows": [row.to_dict() for row in self.rows],
            "not_outperformed": None if self.beside_controls is None else self.beside_controls.not_outperformed,
            "verdict": self.verdict(),
            "reasons": [reason.to_dict() for reason in self.reasons],
            "whose_work": [each.to_dict() for each in self.whose_work],
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
        cells, objectives, cost = [], objectives_of(self.loop.robot), self.rows[0].pulse_cost
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
                f"{row.electrode_pulses:.1f}" if len(row.measured) else "-",
                *(["-" if net is None else f"{net:.1f}" for net in (row.predicted_net, row.net)] if cost else []),
            ]
            cells.append([row.name, f"{told['predicted']:.1f}", anew, *measured, *counts, p, row.meaning])
        interval = "its 95 % interval"
        head = ["", "predicted", interval, "measured", "gap", interval, *(MEANS if objectives else ()), "episodes"]
        head += ["pulses/action", "electrode pulses", *(("predicted net", "net") if cost else ()), "p value", "meaning"]
        lines = [
            f"{self.robot}, {self.mapping}, {self.loop.presentation}; predicted from the recording at "
            f"{in_min(self.calibrated_at_min)}",
            *align_columns(head, cells),
        ]
        if self.rows[0].met:
            lines.append(f"  {told_satisfaction(objectives, self.rows[0].met)}")
        if self.optimum is not None:
            share = ""
            if self.gap_share is not None:
                share = f"; the policies' gap is {100 * self.gap_share:+.0f} % of the range from random to it"
            lines.append(f"  the optimal return on this simulator is about {self.optimum:.1f}{share}")
        if cost:
            ignores = "" if self.optimum is None else "; the optimal return ignores the cost"
            lines.append(f"  electrode pulses: in an episode; net: return - {cost:g} x electrode pulses{ignores}")
        lines += [f"  {finding.message}" for finding in self.findings if finding.name in ("no-optimum", "no-heuristic")]
        outline = self.session.to_dict()
        lines.append(f"  {self.verdict()}")
        lines.append(
            "  p value: of the two-sided Mann-Whitney test of the policies' returns against this control's; electrode "
            "pulses: of a whole episode, one for each electrode of each pulse"
        )
        lines.append(f"  stimulation: {self.account}")
        lines.append(
            f"  ticks: {outline['ticks']}, bursts: {outline['bursts']}, late pulses: {outline['late_pulses']}"
            f" (the latest {outline['latest_ms']:.1f} ms); ended: {outline['ended']}"
        )
        if self.whose_work:
            lines += told_replaced(self.rows[0], self.whose_work)
        if outline["unanswered_pulses"]:
            lines.append(f"  {told_unanswered(self.session)}")
        if self.session.outline.left_out:
            lines.append(f"  left out: {in_words(self.session.outline.left_out)}")
        return "\n".join(lines)


def _more_or_less(gap: float) -> str:
    return f"{abs(gap):.1f} {'more' if gap > 0 else 'less'}"
