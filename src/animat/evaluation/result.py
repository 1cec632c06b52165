"""The result of an evaluation: policies and controls with their returns, as data and as a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from animat.errors import counted, in_min
from animat.evaluation import transfer
from animat.evaluation.controls import EvaluationRow
from animat.evaluation.coupling import ContextGap
from animat.evaluation.interventions import InterventionTable
from animat.evaluation.optimum import Optimum
from animat.evaluation.statistics import Interval, Verdict, normalised_score
from animat.goals.tally import MEANS, cells_of, satisfaction_line
from animat.recordings.findings import Finding
from animat.tables import briefly
from animat.terminal_table import align_columns


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Trained policies and controls on one simulator.

    Attributes:
        mapping: its name; None without neurons.
        recorded_at_min: time of the simulator's recording; None without neurons.
        names: the policies, in the order of the first row's actors.
        rows: the policies first, then the controls.
        findings: differences between the policies' training and this simulator, and doubts about the optimum.
        optimum: the optimal return of any controller; None if it was not requested, or is not known.
        context: how much of the optimum the best coupling leaves unused or, without an optimum, a lower bound of it;
            None if some conditions are left out of the optimum.
        no_optimum: why the optimum is not known, if it was requested.
        fixed_from_min: time of the recording whose percentiles the mapping keeps; None if it uses the simulator's.
        objectives: of the robot's goal, as texts; empty for a robot without one.
        whose_work: what the policies lose with each intervention; None if it was not requested.
        seed: of all random draws.
        greedy: whether policies took their most probable actions, or drew them as in training.
        versions: of what may round or draw differently.
    """

    __repr__ = briefly

    robot: str
    mapping: str | None
    recorded_at_min: float | None
    names: tuple[str, ...]
    rows: tuple[EvaluationRow, ...]
    findings: tuple[Finding, ...]
    optimum: Optimum | None = None
    no_optimum: str | None = None
    fixed_from_min: float | None = None
    context: ContextGap | None = None
    objectives: tuple[str, ...] = ()
    whose_work: InterventionTable | None = None
    seed: int = 1
    greedy: bool = True
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def context_score(self) -> Interval | None:
        """The policies' context score (`ContextGap.score`)."""
        if self.context is None or self.rows[0].changed:
            return None
        return self.context.score(self.rows[0].mean_returns, self.optimum)

    @property
    def verdict(self) -> Verdict | None:
        """Whether the policies outperform the controls; None if none were run."""
        controls = {row.name: row.episodes.returns for row in self.rows[1:]}
        return Verdict.of(self.rows[0].episodes.returns, controls) if controls else None

    @property
    def not_met(self) -> tuple[str, ...]:
        """Names of the findings because of which these returns cannot be expected of a closed loop on the culture."""
        return tuple(dict.fromkeys(f.name for f in self.findings if f.name in transfer.NAMES))

    def score(self, row: EvaluationRow) -> float | None:
        """The normalised score of a row's mean return, (mean - random) / (optimum - random).

        None if random actions were not run, if no optimum is known or it is not above them, or if the optimum leaves
        out conditions that the rows use. None also for controls in a changed environment, whose optimum is different:
        with shuffled delivery the choice has no effect, and a silent culture is not the same culture. It is too high if
        the optimum is less than its own controller returns.
        """
        random = next((each for each in self.rows if each.name == "random"), None)
        if random is None or self.optimum is None or self.optimum.left_out or row.changed:
            return None
        mean, at_random, best = float(row.mean_returns.mean()), float(random.mean_returns.mean()), self.optimum.value
        return normalised_score(mean, at_random, best) if best > at_random else None

    @property
    def _actions(self) -> str:
        return "most probable" if self.greedy else "drawn"

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data, with the return of each episode."""
        return {
            "robot": self.robot,
            "mapping": self.mapping,
            "recorded_at_min": self.recorded_at_min,
            "percentiles_fixed_from_min": self.fixed_from_min,
            "seed": self.seed,
            "actions": self._actions,
            "versions": self.versions,
            "policies": dict(zip(self.names, self.rows[0].mean_returns.tolist(), strict=True)),
            "rows": [
                {**row.to_dict(), "normalised_score": self.score(row), "returns": row.episodes.returns.tolist()}
                for row in self.rows
            ],
            "optimum": None if self.optimum is None else self.optimum.to_dict(),
            "no_optimum": self.no_optimum,
            "pulse_cost": self.rows[0].pulse_cost,
            "context": None if self.context is None else self.context.to_dict(),
            "context_score": None if self.context_score is None else self.context_score.to_dict(),
            "whose_work": None if self.whose_work is None else self.whose_work.to_dict(),
            "not_outperformed": None if self.verdict is None else self.verdict.not_outperformed,
            "verdict": None if self.verdict is None else str(self.verdict),
            "not_met_in_a_closed_loop": self.not_met,
            "findings": [finding.to_dict() for finding in self.findings],
            **({"objectives": list(self.objectives)} if self.objectives else {}),
        }

    def to_text(self) -> str:
        """A table for a terminal: mean return and its standard error, over policies or over a control's episodes."""
        first_row, first = self.rows[0], self.rows[0].episodes.returns
        at_min = self.recorded_at_min
        on = "without neurons" if at_min is None else f"{self.mapping}, recording at {in_min(at_min)}"
        if self.fixed_from_min is not None:
            on += f", percentiles fixed from {in_min(self.fixed_from_min)}"
        goal = MEANS if self.objectives else ()
        are_counted, cost = first_row.electrode_pulses is not None, first_row.pulse_cost
        pulse_keys = [*["electrode_pulses"] * are_counted, *["net_return"] * bool(cost)]
        names = [name.replace("_", " ") for name in pulse_keys]
        score_head = ["score"] * (self.optimum is not None)
        head = ["", "mean return", "s.e.", "iterations", "ended early", *names, *goal, *score_head, ""]
        cells = []
        for row in self.rows:
            fields, score = row.to_dict(), self.score(row)
            error = "" if fields["standard_error"] is None else f"{fields['standard_error']:.1f}"
            numbers = [f"{fields['mean_return']:.1f}", error, f"{fields['mean_length']:.1f}"]
            numbers.append(f"{100 * fields['terminated_share']:.0f} %")
            numbers += ["" if (value := fields[key]) is None else f"{value:.1f}" for key in pulse_keys]
            numbers += cells_of(row.met) if goal else []
            numbers += ["" if score is None else f"{score:.2f}" for _ in score_head]
            cells.append([row.name, *numbers, row.meaning])
        policies, episodes = counted(len(first), "policy", "policies"), counted(first.shape[1], "episode")
        how = f"{episodes} each, {self._actions} actions, seed {self.seed}"
        lines = [f"{self.robot}, {on}: {policies}, {how}", *align_columns(head, cells)]
        each = ", ".join(f"{name} {x:.1f}" for name, x in zip(self.names, self.rows[0].mean_returns, strict=True))
        lines.append(f"  each policy: {each}")
        if cost:
            lines.append(f"  electrode pulses: per episode; net return: mean return - {cost:g} x electrode pulses")
        if self.objectives:
            lines.append(f"  {satisfaction_line(self.objectives, self.rows[0].met)}")
        if self.verdict is not None:
            lines.append(f"  {'by return, without the cost: ' if cost else ''}{self.verdict}")
        if self.not_met:
            outlook = "it is not known whether a closed loop on the culture would reach these returns"
            if self.not_met != (transfer.UNKNOWN,):
                outlook = "these returns cannot be expected of a closed loop on the culture"
            lines.append(f"  {outlook}: see the warnings ({', '.join(self.not_met)})")
        lines += [f"  {finding.message}" for finding in self.findings if finding.name == "no-heuristic"]
        lines += self._optimum_lines()
        return "\n".join([*lines, *([] if self.whose_work is None else [self.whose_work.to_text()])])

    def _optimum_lines(self) -> list[str]:
        context = [] if self.context is None else [f"  {self.context.to_text(self.context_score)}"]
        if self.no_optimum is not None:
            return [f"  no optimal return: {self.no_optimum}", *context]
        if self.optimum is None:
            return []
        if self.optimum.left_out:
            meaning = "no score, as the optimal return leaves out conditions that the rows use"
        elif not self.rows[0].changed and self.score(self.rows[0]) is None:
            has_random = any(row.name == "random" for row in self.rows)
            reason = "the optimal return is not above that of" if has_random else "there are no"
            meaning = f"no score, as {reason} random actions"
        else:
            meaning = "score: (mean return - random) / (optimal return - random)"
            if changed := [row.name for row in self.rows if row.changed]:
                meaning += f"; none for {' and '.join(changed)}, whose optimum is different"
            if self.optimum.is_surpassed:
                meaning += "; too high, as the optimal return is less than its controller's"
        lines = [f"  {self.optimum.to_text()}", f"  {meaning}"]
        return [*lines, *context]
