"""The table of predicted and measured returns, and that of returns with something in place of the culture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from animat.closed_loop.loop import Loop
from animat.closed_loop.session import Session, describe_left_out, unanswered_message
from animat.cultures.budget import Account
from animat.errors import in_min
from animat.evaluation.controls import Control
from animat.evaluation.statistics import CONFIDENCE, Interval, Verdict
from animat.goals.robot import objectives_of
from animat.goals.tally import MEANS, cells_of, satisfaction_line
from animat.reality_gap.outlook import Outlook
from animat.reality_gap.reasons import CHECKS
from animat.reality_gap.row import Returns, Row, Turns, resampled_means
from animat.recordings.findings import Finding
from animat.records import as_json, write_json
from animat.tables import briefly
from animat.terminal_table import align_columns
from animat.writing import write_whole

TABLE_FILE = "returns"
"""Name of the files with the table in a session's folder."""
LARGE_SHARE = 0.1
"""Share of the range from random to optimal return: a gap this large is mentioned even if it may be chance."""


INTERVENTIONS = ("random spikes", "silent", "shuffled", "yoked", "turned round", "goal switched")
"""Interventions that are measured, in the order of the table."""


@dataclass(frozen=True)
class Intervention:
    """The same policies with something in place of the culture, in closed loop (`is_measured`) or on its simulator.

    `lost` is the loss against the policies' measured return, with its interval over episodes.
    """

    name: str
    meaning: str
    is_measured: bool
    mean_return: float
    lost: Interval

    def to_dict(self) -> dict[str, Any]:
        return vars(self) | {"lost": as_json(self.lost.to_dict())}


@dataclass(frozen=True, eq=False)
class RealityGap:
    """Policies and controls, predicted and measured.

    Attributes:
        calibrated_at_min: time of the predicting recording.
        optimum: the optimal return of any controller on that recording's simulator (`animat.evaluation.optimum`); None
            if it cannot be computed, for example with too few responses.
        rows: all policies together first, then each of them if there are several, then the controls.
        findings: differences between loop, recording and policies, and other warnings and notes.
        responses: number of the recording's responses, without bursts.
        reasons: why the policies' measured return differs from the predicted one, as far as the session's data show.
        whose_work: the policies' return with something in place of the culture; empty if it was not requested.
    """

    __repr__ = briefly

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
    whose_work: tuple[Intervention, ...] = ()

    @property
    def control_verdict(self) -> Verdict | None:
        """Whether the policies outperform each control with a complete episode; None if there is none."""
        controls = {row.name: row.comparison for row in self.rows if row.comparison is not None}
        return Verdict(controls) if controls else None

    @property
    def gap_share(self) -> float | None:
        """The policies' gap as a share of the range from predicted random return to the optimum."""
        if self.optimum is None:
            return None
        # Both from the starts of all rounds.
        range_ = self.optimum - next(row for row in self.rows if row.name == "random").from_all_starts
        return float(self.rows[0].gap.value / range_) if len(self.rows[0].measured) and range_ > 0 else None

    def verdict(self) -> str:
        """Whether the policies outperform the controls, and possible reasons for the gap."""
        verdict, row, share = self.control_verdict, self.rows[0], self.gap_share
        if verdict is None:
            agent = "no control" if len(row.measured) else "no policy"
            return f"{agent} completed an episode: the policies cannot be compared with the controls"
        if not row.gap_sign and (share is None or abs(share) < LARGE_SHARE or len(row.measured) < 2):
            return str(verdict)
        gap = row.gap.value
        text = f"{verdict}; their measured return is {abs(gap):.1f} {'more' if gap > 0 else 'less'} than predicted"
        if not row.gap_sign:
            return (
                f"{text}, within the uncertainty due to the number of responses in the recording ({self.responses}) "
                f"and of episodes ({len(row.measured)})"
            )
        if self.reasons:
            return f"{text}: {'; '.join(reason.message for reason in self.reasons)}"
        return f"{text}, and nothing in the session's data explains it (looked for: {', '.join(CHECKS)})"

    def to_dict(self) -> dict[str, Any]:
        return {
            "robot": self.loop.robot.name,
            "mapping": self.loop.mapping.name,
            "presentation": str(self.loop.presentation),
            "calibrated_at_min": self.calibrated_at_min,
            "optimum": self.optimum,
            "pulse_cost": self.rows[0].pulse_cost,
            "gap_share": self.gap_share,
            "rows": [row.to_dict() for row in self.rows],
            "not_outperformed": None if self.control_verdict is None else self.control_verdict.not_outperformed,
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

    def write(self) -> None:
        """Write the table into the session's folder, for people and as data; InvalidFile if it cannot be written."""
        write_whole(self.session.folder / f"{TABLE_FILE}.txt", f"{self.to_text()}\n")
        write_json(self.session.folder / f"{TABLE_FILE}.json", self.to_dict())

    def to_text(self) -> str:
        """A table for a terminal."""
        objectives, cost = objectives_of(self.loop.robot), self.rows[0].pulse_cost
        cells = [_cells(row, has_objectives=bool(objectives), has_cost=bool(cost)) for row in self.rows]
        interval = "its 95 % interval"
        head = ["", "predicted", interval, "measured", "gap", interval, *(MEANS if objectives else ()), "episodes"]
        head += ["pulses/action", "electrode pulses", *(("predicted net", "net") if cost else ()), "p value", "meaning"]
        lines = [
            f"{self.loop.robot.name}, {self.loop.mapping.name}, {self.loop.presentation}; predicted from the recording "
            f"at {in_min(self.calibrated_at_min)}",
            *align_columns(head, cells),
        ]
        if self.rows[0].met:
            lines.append(f"  {satisfaction_line(objectives, self.rows[0].met)}")
        if self.optimum is not None:
            share = ""
            if self.gap_share is not None:
                share = f"; the policies' gap is {100 * self.gap_share:+z.0f} % of the range from random to it"
            lines.append(f"  the optimal return on this simulator is at most about {self.optimum:.1f}{share}")
        if cost:
            ignores = "" if self.optimum is None else "; the optimal return ignores the cost"
            net = f"net: return - {cost:g} x electrode pulses, which comparisons with controls ignore{ignores}"
            lines.append(f"  electrode pulses: per episode; {net}")
        lines += [f"  {finding.message}" for finding in self.findings if finding.name in ("no-optimum", "no-heuristic")]
        outline = self.session.outline
        lines += [
            f"  {self.verdict()}",
            "  its 95 % interval: of the number on its left; p value: of the two-sided Mann-Whitney test of the "
            "policies' returns against this control's; electrode pulses: per whole episode, one for each electrode of "
            "each pulse",
            f"  stimulation: {self.account}",
            f"  ticks: {outline.ticks}, bursts: {outline.bursts}, late pulses: {outline.late}"
            f" (the latest {1000 * outline.latest_s:.1f} ms); ended: {self.session.ending.message}",
        ]
        if self.whose_work:
            lines += _intervention_lines(self.rows[0], self.whose_work)
        if outline.unanswered_pulses:
            lines.append(f"  {unanswered_message(self.session)}")
        if outline.left_out:
            lines.append(f"  left out: {describe_left_out(outline.left_out)}")
        return "\n".join(lines)


def _cells(row: Row, *, has_objectives: bool, has_cost: bool) -> list[str]:
    """A row of the table, with columns for objectives and cost where there are any."""
    fields, measured = row.to_dict(), ["-", "-", ""]
    if (gap := fields["gap"]) is not None:
        ends = "unknown" if gap["low"] is None else f"{gap['low']:+z.1f} to {gap['high']:+z.1f}"
        measured = [f"{fields['measured']:.1f}", f"{gap['value']:+z.1f}", ends]
    counts = [
        *(cells_of(row.met) if has_objectives else []),
        str(len(row.measured)),
        f"{row.pulses_per_action:.1f}",
        f"{row.electrode_pulses:.1f}" if len(row.measured) else "-",
        *(["-" if net is None else f"{net:.1f}" for net in (row.predicted_net, row.net)] if has_cost else []),
    ]
    p = "" if row.comparison is None else f"{row.comparison.p_best:.2g}"
    return [row.name, f"{fields['predicted']:.1f}", row.prediction.ends, *measured, *counts, p, row.meaning]


def intervention_table(rows: Sequence[Row], ideal: Control, with_ideal: Returns) -> tuple[Intervention, ...]:
    """The table: the simulator, an ideal actuator with its returns on it, then the measured interventions.

    The session's rows have the policies first; without a complete episode of theirs it is empty.
    """
    if not len(rows[0].measured):
        return ()
    measured = {row.name: row for row in rows if len(row.measured)}
    lost = _loss(rows[0], with_ideal, None)
    table = [
        Intervention("its simulator", "as predicted", False, float(rows[0].predicted.mean()), rows[0].gap),
        Intervention(ideal.name, ideal.meaning, False, float(with_ideal.mean()), lost),
    ]
    for row in (measured[name] for name in INTERVENTIONS if name in measured):
        lost = _loss(rows[0], row.from_mean_start, row.turn)
        table.append(Intervention(row.name, row.meaning, True, float(row.measured.mean()), lost))
    return tuple(table)


def _intervention_lines(policies: Row, table: Sequence[Intervention]) -> list[str]:
    cells = []
    for each in table:
        where = "measured" if each.is_measured else "simulator"
        lost = f"{each.lost.value:.1f}", each.lost.ends
        cells.append([each.name, f"{each.mean_return:.1f}", *lost, where, each.meaning])
    return [
        "whose work is it: return with the culture replaced, and the loss from the measured "
        f"{policies.measured.mean():.1f}",
        *align_columns(["", "return", "lost", "95 % interval", "", ""], cells),
    ]


def _loss(usual: Row, changed: Returns, turn: Turns | None) -> Interval:
    """Difference of means, with its interval over episodes (`resampled_means`); infinite where they are too few.

    Both are as if from the starts of all rounds (`Row.from_mean_start`), as some agents may have had fewer.
    """
    value, rng = float(usual.from_mean_start.mean() - changed.mean()), np.random.default_rng(0)
    one, other = resampled_means(usual.from_mean_start, rng, usual.turn), resampled_means(changed, rng, turn)
    if one is None or other is None:
        return Interval(value, -np.inf, np.inf, CONFIDENCE)
    low, high = np.quantile(one - other, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(value, float(low), float(high), CONFIDENCE)
