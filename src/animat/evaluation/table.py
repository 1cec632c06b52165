"""Policies beside the controls that ask whether it is the culture that does the work, and the optimal return."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from animat.coding.electrode_pulses import electrode_pulses
from animat.columns import align_columns
from animat.environment import Animat, Environment, WithoutNeurons
from animat.errors import InvalidArgument, Mismatch, UnusableData, in_min
from animat.evaluation import transfer
from animat.evaluation.controls import Control, controls_of, coupling_of
from animat.evaluation.coupling import ContextGap, context_gap, least_context_gap
from animat.evaluation.optimum import Optimum, best_return
from animat.evaluation.resampling import Counted
from animat.evaluation.rollouts import Networks, networks_of, roll_out
from animat.evaluation.row import Row
from animat.evaluation.statistics import Interval, normalised_score
from animat.evaluation.verdict import Verdict
from animat.evaluation.whose_work import WhoseWork, whose_work
from animat.goals.robot import objectives_of
from animat.goals.tally import MEANS, cells_of, told_satisfaction
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Part, Progress, Silent, in_phase
from animat.recordings.findings import Finding
from animat.robots.base import Robot, lacking
from animat.robots.host import HostRobot
from animat.tables import briefly
from animat.training.policy import Policy, first_of_alike
from animat.wrappers import NeuralObservation, TrialCosts, unwrapped


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Trained policies and controls on one simulator.

    Attributes:
        robot: the robot.
        mapping: its name; None without neurons.
        recorded_at_min: the recording the simulator was made of; None without neurons.
        names: the policies, in the order of the first row's actors.
        rows: the policies first, then the controls.
        findings: where the policies' training and this simulator differ, and where the optimum is not well known.
        optimum: the optimal return of any controller; None where it was not asked for, or is not known.
        context: how much of that the best coupling leaves undone, or, where there is no optimum, the least that this
            can be; None where some conditions are left out of the optimum.
        no_optimum: why it is not known, though it was asked for.
        fixed_from_min: the recording whose percentiles the mapping keeps to, as in training; None where they move.
        objectives: of the robot's goal, as texts; none of a robot without one.
        whose_work: what the policies lose with each intervention; None where that was not asked for.
        net_optimum: the optimal return less the cost of pulses, of any controller, where these cost something.
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
    whose_work: WhoseWork | None = None
    net_optimum: Optimum | None = None

    @property
    def context_score(self) -> Interval | None:
        """The policies' context score (`ContextGap.score`)."""
        if self.context is None or self.rows[0].changed:
            return None
        return self.context.score(self.rows[0].mean_returns, self.optimum)

    @property
    def verdict(self) -> Verdict | None:
        """Whether the policies outperform the controls; None where none were run."""
        controls = {row.name: row.episodes.returns for row in self.rows[1:]}
        return Verdict.of(self.rows[0].episodes.returns, controls) if controls else None

    @property
    def not_met(self) -> tuple[str, ...]:
        """Names of the findings that say why a closed loop on the culture would not meet these returns."""
        return tuple(dict.fromkeys(f.name for f in self.findings if f.name in transfer.NAMES))

    def score(self, row: Row) -> float | None:
        """The normalised score of a row's mean return, (mean - random) / (optimum - random).

        None where random actions were not run, no optimum is known or it is not above them, where conditions are left
        out of it, which the rows act on too, and for controls that act in something else than what the optimum is of:
        under shuffled delivery nothing can be chosen, and a silent culture is another one.
        """
        random = next((each for each in self.rows if each.name == "random"), None)
        if random is None or self.optimum is None or self.optimum.left_out or row.changed:
            return None
        try:
            return normalised_score(
                float(row.mean_returns.mean()), float(random.mean_returns.mean()), self.optimum.value
            )
        except InvalidArgument:
            return None

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "robot": self.robot,
            "mapping": self.mapping,
            "recorded_at_min": self.recorded_at_min,
            "percentiles_fixed_from_min": self.fixed_from_min,
            "policies": dict(zip(self.names, self.rows[0].mean_returns.tolist(), strict=True)),
            "rows": [{**row.to_dict(), "normalised_score": self.score(row)} for row in self.rows],
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
        count = f"{first.shape[0]} {'policy' if first.shape[0] == 1 else 'policies'}"
        goal = MEANS if self.objectives else ()
        are_counted, cost = first_row.electrode_pulses is not None, first_row.pulse_cost
        paid = [*["electrode_pulses"] * are_counted, *["net_return"] * bool(cost)]
        names = [name.replace("_", " ") for name in paid]
        head = ["", "mean return", "s.e.", "iterations", "ended early", *names, *goal, "score", ""]
        cells = []
        for row in self.rows:
            told, score = row.to_dict(), self.score(row)
            error = "" if told["standard_error"] is None else f"{told['standard_error']:.1f}"
            numbers = [f"{told['mean_return']:.1f}", error, f"{told['mean_length']:.1f}"]
            numbers.append(f"{100 * told['terminated_share']:.0f} %")
            numbers += ["" if (given := told[name]) is None else f"{given:.1f}" for name in paid]
            numbers += cells_of(row.met) if goal else []
            cells.append([row.name, *numbers, "" if score is None else f"{score:.2f}", row.meaning])
        if self.optimum is None:
            for line in (head, *cells):
                del line[-2]
        episodes = f"{first.shape[1]} episode{'' if first.shape[1] == 1 else 's'}"
        lines = [f"{self.robot}, {on}: {count}, {episodes} each", *align_columns(head, cells)]
        each = ", ".join(f"{name} {x:.1f}" for name, x in zip(self.names, self.rows[0].mean_returns, strict=True))
        lines.append(f"  each policy: {each}")
        if cost:
            lines.append(f"  electrode pulses: in an episode; net return: mean return - {cost:g} x electrode pulses")
        if self.objectives:
            lines.append(f"  {told_satisfaction(self.objectives, self.rows[0].met)}")
        if self.verdict is not None:
            lines.append(f"  {self.verdict}")
        if self.not_met:
            known = "whether a closed loop on the culture would meet these returns is not known"
            if self.not_met != (transfer.UNKNOWN,):
                known = "a closed loop on the culture would not meet these returns"
            lines.append(f"  {known}: see the warnings ({', '.join(self.not_met)})")
        lines += [f"  {finding.message}" for finding in self.findings if finding.name == "no-heuristic"]
        lines += self._optimum_lines()
        return "\n".join([*lines, *([] if self.whose_work is None else [self.whose_work.to_text()])])

    def _optimum_lines(self) -> list[str]:
        if self.no_optimum is not None:
            told = [] if self.context is None else [f"  {self.context.to_text(self.context_score)}"]
            return [f"  no optimal return: {self.no_optimum}", *told]
        if self.optimum is None:
            return []
        if self.optimum.left_out:
            meaning = "no score, as the optimal return is without conditions that the rows act on too"
        elif not self.rows[0].changed and self.score(self.rows[0]) is None:
            meaning = "no score, as the optimal return is not above that of random actions"
        else:
            meaning = "score: (mean return - random) / (optimal return - random)"
            changed = [row.name for row in self.rows if row.changed]
            if changed:
                meaning += f"; none for {' and '.join(changed)}, whose optimum is another"
        lines = [f"  {self.optimum.to_text()}", f"  {meaning}"]
        if self.net_optimum is not None:
            lines.append(f"  with the cost of pulses: {self.net_optimum.to_text()}")
        if self.context is not None:
            lines.append(f"  {self.context.to_text(self.context_score)}")
        return lines


def evaluate(
    policies: Mapping[str, Policy],
    timeline: SimulatorTimeline | None,
    *,
    at_min: float | None = None,
    episodes: int = 100,
    seed: int = 1,
    greedy: bool = True,
    robot: Robot[Any] | None = None,
    controls: Collection[str] | None = None,
    optimum_resolution: float | None = None,
    interventions: bool = False,
    progress: Progress | None = None,
) -> Evaluation:
    """Run policies and the controls beside them on the simulator of one minute.

    The controls are those of `animat.evaluation.controls`.

    Args:
        policies: by name, all of one robot, mapping and set of conditions.
        timeline: the culture's simulators; None for policies without neurons.
        at_min: minute on the culture's clock whose newest simulator is used; None: the last recording.
        episodes: of each policy and control.
        seed: decides every random draw.
        greedy: whether the most probable action is taken, or one drawn from the policy as in training.
        robot: the robot to run them on, its parameters perhaps changed; None: the one they were trained on.
        controls: names of those that are run beside the policies (`animat.evaluation.controls`); None: all.
        optimum_resolution: of the grid for the optimal return in the same environment (`best_returns`; a study's is
            1), which takes seconds, as the best coupling does, which is then among the controls; None: neither is.
        interventions: whether to run the policies with all interventions too (`animat.evaluation.whose_work`).
        progress: told after the policies and each control, of the optimum how far it is, and before each intervention.

    Raises:
        InvalidArgument: for no policies, fewer episodes than one, interventions without neurons, or an `at_min`, a
            seed or a resolution that is none.
        Mismatch: if the policies differ from each other, from the robot or from the timeline's conditions.
    """
    alike = ("robot", "mapping", "readouts", "conditions", "commands", "percentiles", "delivery", "pulse_cost")
    first = first_of_alike(policies, alike, "evaluate it alone")
    if robot is not None and robot.name != first.robot.name:
        raise Mismatch(f"robot: expected {first.robot.name}, which the policies were trained on, got {robot.name}")
    if optimum_resolution is not None and not 0 < optimum_resolution < float("inf"):
        raise InvalidArgument(f"optimum_resolution: expected a positive number, got {optimum_resolution!r}")
    if interventions and first.mapping is None:
        raise InvalidArgument("interventions: expected policies that act through neurons, got ones without")
    body, progress = robot or first.robot, progress or Silent()
    world = _World.of(first, body, timeline, at_min)
    within = world.environment, world.simulator
    networks, n = networks_of(list(policies.values()), greedy=greedy), len(policies)
    trained = _as_trained(first, networks, n)
    every = controls_of(*within, _labels(first), networks, n)
    acting = [trained, *(control for control in every if controls is None or control.name in controls)]
    wants_coupling = optimum_resolution is not None and (controls is None or "coupling" in controls)
    searches = wants_coupling and not isinstance(body, HostRobot)
    steps = len(acting) + searches
    if searches:
        progress.update(0, steps, "best coupling")
        acting.append(coupling_of(*within, seed=seed))
    findings = world.findings
    if controls is None and (without := lacking(body).get("heuristic")):
        findings += (Finding("no-heuristic", "note", without),)
    rows: list[Row] = []
    for each in acting:
        rows.append(world.row_of(each, episodes=episodes, seed=seed))
        progress.update(len(rows), steps, each.name)
    optimum, no_optimum, net_optimum = None, None, None
    if optimum_resolution is not None:
        phase = in_phase(progress, "optimal return")
        try:
            optimum = world.optimum(optimum_resolution, seed, phase)
        except (InvalidArgument, UnusableData) as error:
            no_optimum = str(error)
        # Conditions of few responses would promise what is not there.
        if optimum is not None and not optimum.left_out:
            net_optimum = world.net_optimum(optimum_resolution, seed)
    work = None
    if interventions:
        phase = in_phase(progress, "whose work it is")
        work = whose_work(*trained.within(*within), networks, n, episodes=episodes, seed=seed, progress=phase)
    for best in (optimum, net_optimum):
        findings += () if best is None else tuple(best.findings())
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
    )


@dataclass(frozen=True, eq=False)
class _World:
    """What policies are evaluated in.

    Attributes:
        first: of the policies; it stands for all.
        environment: a robot, and neurons where policies act through them.
        simulator, timeline, minute: of these neurons, and the recording that the simulator is of; None without.
        fixed_from_min, findings: as in `Evaluation`.
    """

    first: Policy
    environment: Environment[Any]
    simulator: NeuronSimulator | None = None
    timeline: SimulatorTimeline | None = None
    minute: float | None = None
    fixed_from_min: float | None = None
    findings: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, first: Policy, body: Robot[Any], timeline: SimulatorTimeline | None, at_min: float | None) -> Self:
        """That of policies like the first one; arguments and errors as in `evaluate`."""
        if first.mapping is None:
            return cls(first, WithoutNeurons(body, first.commands))
        if timeline is None:
            raise InvalidArgument("timeline: expected the culture's simulators for policies that act through neurons")
        minute = float(timeline.start_min[timeline.requested_row(timeline.start_min[-1] if at_min is None else at_min)])
        findings = (*transfer.other_timeline(first, timeline), *transfer.not_of_a_loop(first, timeline, minute))
        fixed_from_min = float(timeline.start_min[0]) if first.percentiles == "first" else None
        simulator = (timeline if fixed_from_min is None else timeline.with_first_percentiles()).at(minute)
        animat = Animat(body, first.mapping, len(timeline.conditions))
        environment: Environment[Any] = NeuralObservation(animat) if first.neural_observation else animat
        return cls(first, environment, simulator, timeline, minute, fixed_from_min, findings)

    def row_of(self, control: Control, *, episodes: int, seed: int) -> Row:
        """Run a control, or the policies, and tell what came of it."""
        environment, simulator = control.within(self.environment, self.simulator)
        ran = roll_out(environment, simulator, control.actor, control.n_actors, episodes=episodes, seed=seed)
        changed = environment is not self.environment or simulator is not self.simulator
        of_trials = self._electrode_pulses()
        given = None if of_trials is None else ran.presented @ of_trials * (control.delivery != "silent") / episodes
        return Row(control.name, control.meaning, ran, changed, given, self.first.pulse_cost)

    def optimum(self, resolution: float, seed: int, progress: Progress) -> Optimum:
        """The optimal return; with its interval, without conditions of few responses, where responses are known."""
        environment = unwrapped(self.environment)
        timeline, minute = self.timeline, self.minute
        if not isinstance(environment, Animat) or minute is None or timeline is None or not timeline.responses:
            whole = Part(progress, 0, 1, 1, "optimal return")
            return best_return(environment, self.simulator, resolution=resolution, seed=seed, progress=whole)
        case = Counted.of(environment, timeline, minute, are_fixed=self.fixed_from_min is not None)
        alone, resampled = (Part(progress, i, 1, 2, note) for i, note in enumerate(("optimal return", "its interval")))
        best = best_return(case.environment, case.simulator, resolution=resolution, seed=seed, progress=alone)
        return case.known(best, resolution=resolution, seed=seed, progress=resampled)

    def net_optimum(self, resolution: float, seed: int) -> Optimum | None:
        """The same less what the pulses cost; None where they cost nothing."""
        cost, of_trials = self.first.pulse_cost, self._electrode_pulses()
        if not cost or of_trials is None:
            return None
        costing = TrialCosts(unwrapped(self.environment), tuple(cost * count for count in of_trials))
        return best_return(costing, self.simulator, resolution=resolution, seed=seed)

    def _electrode_pulses(self) -> tuple[float, ...] | None:
        """Of a trial of each condition, where neurons are stimulated and it is known."""
        pulses = 1 if self.first.presentation is None else self.first.presentation.pulses
        return electrode_pulses(self.first.conditions, pulses) if self.simulator is not None else None


def _as_trained(first: Policy, networks: Networks, n: int) -> Control:
    """The policies themselves; one that was trained as a control is one here too: what it chooses decides nothing."""
    if first.mapping is None or first.delivery != "shuffled":
        return Control("policies", "as trained", networks, n)
    return Control("policies", "as trained: what is delivered is drawn anew", networks, n, delivery="shuffled")


def _labels(first: Policy) -> list[str]:
    """Of the actions."""
    if first.mapping is None:
        return [f"{command:+g}" for command in first.commands or ()]
    return [condition.label for condition in first.conditions]


def _context(rows: Sequence[Row], optimum: Optimum | None, largest_return: float) -> ContextGap | None:
    """How much the best coupling leaves undone; None where it, or random actions, were not run."""
    by_name = {each.name: each.episodes.returns[0] for each in rows}
    if not {"coupling", "random"} <= set(by_name):
        return None
    beside = by_name["coupling"], by_name["random"]
    if optimum is not None:
        return None if optimum.left_out else context_gap(*beside, optimum)
    agents = [row.episodes.returns for row in rows if row.name in ("policies", "heuristic") and not row.changed]
    return least_context_gap(*beside, np.concatenate(agents), largest_return) if agents else None
