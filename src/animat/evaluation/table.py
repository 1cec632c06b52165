"""Evaluation of policies on a simulator: the table of policies, controls and the optimal return."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Self

import numpy as np

from animat.arguments import checked_arguments
from animat.coding.encoder import electrode_pulses
from animat.columns import align_columns
from animat.environment import Animat, Environment, Neurons, WithoutNeurons
from animat.errors import InvalidArgument, Mismatch, UnusableData, counted, in_min
from animat.evaluation import transfer
from animat.evaluation.controllers import Controller
from animat.evaluation.controls import Control, Row, controls_of, coupling_of
from animat.evaluation.coupling import ContextGap, context_gap, least_context_gap
from animat.evaluation.interventions import InterventionTable, run_interventions
from animat.evaluation.optimal_returns import WellSampled
from animat.evaluation.optimum import Optimum, best_return
from animat.evaluation.own_agents import controls_of_own
from animat.evaluation.rollouts import Actor, networks_of
from animat.evaluation.statistics import Interval, Verdict, normalised_score
from animat.goals.robot import objectives_of
from animat.goals.tally import MEANS, cells_of, satisfaction_line
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Part, Progress, Silent, in_phase
from animat.recordings.findings import Finding
from animat.robots.base import Robot, lacking
from animat.robots.host import HostRobot
from animat.tables import briefly
from animat.training.folder import versions_of
from animat.training.policy import Policy, first_of_alike
from animat.wrappers import NeuralObservation, TrialCosts, unwrapped


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
        net_optimum: the optimal return of any controller less the cost of pulses, if they have a cost.
        seed: of all random draws.
        greedy: whether policies took their most probable actions, or drew them as in training.
        versions: of what may round or draw differently.
    """

    __repr__ = briefly

    robot: str
    mapping: str | None
    recorded_at_min: float | None
    names: tuple[str, ...]
    rows: tuple[Row, ...]
    findings: tuple[Finding, ...]
    optimum: Optimum | None = None
    no_optimum: str | None = None
    fixed_from_min: float | None = None
    context: ContextGap | None = None
    objectives: tuple[str, ...] = ()
    whose_work: InterventionTable | None = None
    net_optimum: Optimum | None = None
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

    def score(self, row: Row) -> float | None:
        """The normalised score of a row's mean return, (mean - random) / (optimum - random).

        None if random actions were not run, if no optimum is known or it is not above them, or if the optimum leaves
        out conditions that the rows use. None also for controls in a changed environment, whose optimum is different:
        with shuffled delivery the choice has no effect, and a silent culture is not the same culture.
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
            "net_optimum": None if self.net_optimum is None else self.net_optimum.to_dict(),
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
        lines = [f"  {self.optimum.to_text()}", f"  {meaning}"]
        if self.net_optimum is not None:
            lines.append(f"  with the cost of pulses: {self.net_optimum.to_text()}")
        return [*lines, *context]


@checked_arguments
def evaluate(
    policies: Mapping[str, Policy],
    timeline: SimulatorTimeline | None,
    *,
    at_min: float | None = None,
    episodes: int = 100,
    seed: int = 1,
    greedy: bool = True,
    robot: Robot[Any] | None = None,
    controls: str | Collection[str] | None = None,
    agents: Mapping[str, Actor | Controller] | None = None,
    optimum_resolution: float | None = None,
    interventions: bool = False,
    progress: Progress | None = None,
) -> Evaluation:
    """Run policies and controls (`animat.evaluation.controls`) on the simulator of one minute.

    Args:
        policies: by name, all with the same robot, mapping and conditions.
        timeline: the culture's simulators; None for policies without neurons.
        at_min: minute on the culture's clock whose newest simulator is used; None: the last recording.
        episodes: of each policy and control.
        greedy: whether to take the most probable action, or to draw from the policy as in training.
        robot: the robot to run them on, possibly with changed parameters; None: the one they were trained on.
        controls: names of the controls to run; None: all.
        agents: of your own, by name: rows like those of the controls (docs/agents.md).
        optimum_resolution: of the grid for the optimal return in the same environment (`best_returns`; 1 in a study),
            which takes seconds, or minutes with memory. The best coupling is then among the controls. None: neither.
        interventions: whether to run the policies with all interventions too (`animat.evaluation.interventions`).
        progress: updated after the policies and each control, during the optimum, and before each intervention.

    Raises:
        InvalidArgument: for no policies, unknown controls, interventions without neurons, a number out of range, or an
            agent that cannot act.
        Mismatch: if the policies differ from each other, from the robot or from the timeline's conditions.
    """
    alike = ("robot", "mapping", "readouts", "conditions", "commands", "percentiles", "delivery", "pulse_cost")
    first = first_of_alike(policies, alike, "evaluate it alone")
    if robot is not None and robot.name != first.robot.name:
        raise Mismatch(f"robot: expected {first.robot.name}, on which the policies were trained, got {robot.name}")
    if optimum_resolution is not None and not 0 < optimum_resolution < float("inf"):
        raise InvalidArgument(f"optimum_resolution: expected a positive number, got {optimum_resolution!r}")
    if interventions and first.mapping is None:
        raise InvalidArgument("interventions: expected policies that act through neurons, got policies without neurons")
    body, progress = robot or first.robot, progress or Silent()
    world = _World.of(tuple(policies.values()), body, timeline, at_min)
    within = world.environment, world.simulator
    networks = networks_of(list(policies.values()), greedy=greedy)
    # Those trained as a control run as one here too: their choices have no effect.
    is_control = first.mapping is not None and first.delivery == "shuffled"
    meaning = "as trained: the delivered condition is drawn at random" if is_control else "as trained"
    trained = Control("policies", meaning, networks, delivery="shuffled" if is_control else "chosen")
    labels = [condition.label for condition in first.conditions]
    if first.mapping is None:
        labels = [f"{command:+g}" for command in first.commands or ()]
    all_controls = controls_of(*within, labels, networks)
    if controls is not None:
        controls, known = (controls,) if isinstance(controls, str) else controls, [each.name for each in all_controls]
        # A robot may lack a heuristic, and the coupling is searched with the optimum only.
        if unknown := sorted({*controls} - {*known, "heuristic", "coupling"}):
            raise InvalidArgument(f"controls: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    acting = [trained, *(control for control in all_controls if controls is None or control.name in controls)]
    acting += controls_of_own(
        agents or {}, *within, ["policies", "coupling", *policies, *(each.name for each in all_controls)]
    )
    wants_coupling = optimum_resolution is not None and (controls is None or "coupling" in controls)
    searches = wants_coupling and not isinstance(body, HostRobot)
    steps = len(acting) + searches
    if searches:
        progress.update(0, steps, "best coupling")
        acting.append(coupling_of(*within, seed=seed))
    findings = world.findings
    if controls is None and (message := lacking(body).get("heuristic")):
        findings += (Finding("no-heuristic", "note", message),)
    rows: list[Row] = []
    for control in acting:
        rows.append(world.row_of(control, episodes=episodes, seed=seed))
        progress.update(len(rows), steps, control.name)
    optimum, no_optimum, net_optimum = None, None, None
    if optimum_resolution is not None:
        phase = in_phase(progress, "optimal return")
        try:
            optimum = world.optimum(optimum_resolution, seed, phase)
        except (InvalidArgument, UnusableData) as error:
            no_optimum = str(error)
        # Conditions with few responses would promise too much.
        if optimum is not None and not optimum.left_out:
            net_optimum = world.net_optimum(optimum_resolution, seed)
    work = None
    if interventions:
        phase = in_phase(progress, "whose work it is")
        work = run_interventions(*trained.within(*within), networks, episodes=episodes, seed=seed, progress=phase)
    if optimum is not None:
        # Less their chance; conditions that the optimum leaves out would not count.
        reached = [row for row in rows if not row.changed and not optimum.left_out]
        best = max(reached, key=lambda row: row.mean_returns.mean(), default=None)
        findings += optimum.findings(None if best is None else best.at_least)
    findings += () if net_optimum is None else net_optimum.findings()
    return Evaluation(
        robot=body.name,
        mapping=None if first.mapping is None else first.mapping.name,
        recorded_at_min=world.minute,
        names=tuple(policies),
        rows=tuple(rows),
        findings=findings,
        optimum=optimum,
        no_optimum=no_optimum,
        fixed_from_min=world.fixed_from_min,
        context=_context(rows, optimum, body.return_range[1]),
        objectives=objectives_of(body),
        whose_work=work,
        net_optimum=net_optimum,
        seed=seed,
        greedy=greedy,
        versions=versions_of(("animat", "jax", "jaxlib", "numpy"), [body]),
    )


@dataclass(frozen=True, eq=False)
class _World:
    """What policies, represented by the first, are evaluated in; simulator, timeline and minute are of its neurons."""

    first: Policy
    environment: Environment[Any]
    simulator: Neurons = None
    timeline: SimulatorTimeline | None = None
    minute: float | None = None
    fixed_from_min: float | None = None
    findings: tuple[Finding, ...] = ()
    pulses_of_trials: tuple[float, ...] | None = None
    """Electrode pulses per trial of each condition, if the electrodes are known."""

    @classmethod
    def of(
        cls, policies: Sequence[Policy], body: Robot[Any], timeline: SimulatorTimeline | None, at_min: float | None
    ) -> Self:
        """Arguments and errors as in `evaluate`."""
        first = policies[0]
        if first.mapping is None:
            return cls(first, WithoutNeurons(body, first.commands))
        if timeline is None:
            raise InvalidArgument("timeline: expected the culture's simulators, as the policies act through neurons")
        minute = float(timeline.start_min[timeline.requested_row(timeline.start_min[-1] if at_min is None else at_min)])
        differences = (transfer.loop_differences(each, timeline, minute) for each in policies)
        findings = tuple(dict.fromkeys(chain.from_iterable(differences)))
        fixed_from_min = float(timeline.start_min[0]) if first.percentiles == "first" else None
        simulator = timeline.with_percentiles(first.percentiles).at(minute)
        animat = Animat(body, first.mapping, len(timeline.conditions))
        environment: Environment[Any] = NeuralObservation(animat) if first.neural_observation else animat
        n_pulses = 1 if first.presentation is None else first.presentation.pulses
        of_trials = electrode_pulses(first.conditions, n_pulses)
        return cls(first, environment, simulator, timeline, minute, fixed_from_min, findings, of_trials)

    def row_of(self, control: Control, *, episodes: int, seed: int) -> Row:
        ran = control.run(self.environment, self.simulator, episodes=episodes, seed=seed)
        of_trials = self.pulses_of_trials
        pulses = None if of_trials is None else ran.presented @ of_trials * (control.delivery != "silent") / episodes
        return Row(control.name, control.meaning, ran, control.delivery != "chosen", pulses, self.first.pulse_cost)

    def optimum(self, resolution: float, seed: int, progress: Progress) -> Optimum:
        """The optimal return; if responses are known, with its interval and without conditions with few responses."""
        environment = unwrapped(self.environment)
        timeline, minute = self.timeline, self.minute
        if not isinstance(environment, Animat) or minute is None or timeline is None or not timeline.responses:
            whole = Part(progress, 0, 1, 1, "optimal return")
            return best_return(environment, self.simulator, resolution=resolution, seed=seed, progress=whole)
        case = WellSampled.of(environment, timeline, minute, self.first.percentiles)
        alone, resampled = (Part(progress, i, 1, 2, note) for i, note in enumerate(("optimal return", "its interval")))
        best = best_return(case.environment, case.simulator, resolution=resolution, seed=seed, progress=alone)
        return case.with_interval(best, resolution=resolution, seed=seed, progress=resampled)

    def net_optimum(self, resolution: float, seed: int) -> Optimum | None:
        """The optimal return less the cost of pulses; None if they have no cost."""
        cost, of_trials = self.first.pulse_cost, self.pulses_of_trials
        if not cost or of_trials is None:
            return None
        costing = TrialCosts(unwrapped(self.environment), tuple(cost * count for count in of_trials))
        return best_return(costing, self.simulator, resolution=resolution, seed=seed)


def _context(rows: Sequence[Row], optimum: Optimum | None, largest_return: float) -> ContextGap | None:
    """How much the best coupling leaves unused; None if it, or random actions, were not run."""
    by_name = {each.name: each.episodes.returns[0] for each in rows}
    if not {"coupling", "random"} <= set(by_name):
        return None
    returns = by_name["coupling"], by_name["random"]
    if optimum is not None:
        return None if optimum.left_out else context_gap(*returns, optimum)
    agents = [row.episodes.returns for row in rows if row.name in ("policies", "heuristic") and not row.changed]
    return least_context_gap(*returns, np.concatenate(agents), largest_return) if agents else None
