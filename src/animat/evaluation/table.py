"""Evaluation of policies on a simulator, beside controls and the optimal return."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, Self

import numpy as np

from animat.arguments import checked_arguments
from animat.coding.encoder import electrode_pulses
from animat.environment import Animat, Environment, Neurons, WithoutNeurons
from animat.errors import InvalidArgument, Mismatch, UnusableData
from animat.evaluation import transfer
from animat.evaluation.controllers import Controller
from animat.evaluation.controls import Control, EvaluationRow, controls_of, coupling_of
from animat.evaluation.coupling import ContextGap, context_gap, least_context_gap
from animat.evaluation.interventions import run_interventions
from animat.evaluation.optimal_returns import WellSampled
from animat.evaluation.optimum import Optimum, best_return
from animat.evaluation.own_agents import controls_of_own
from animat.evaluation.result import Evaluation
from animat.evaluation.rollouts import Actor, networks_of
from animat.goals.robot import objectives_of
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Part, Progress, Silent, in_phase
from animat.recordings.findings import Finding
from animat.robots.base import Robot, lacking
from animat.robots.host import HostRobot
from animat.training.folder import versions_of
from animat.training.policy import Policy, first_of_alike
from animat.wrappers import NeuralObservation, unwrapped


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
        seed: decides every random draw.
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
    all_controls = controls_of(*within, _labels(first), networks)
    controls = _names_of_controls(controls, [each.name for each in all_controls])
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
    rows: list[EvaluationRow] = []
    for control in acting:
        rows.append(world.row_of(control, episodes=episodes, seed=seed))
        progress.update(len(rows), steps, control.name)
    optimum, no_optimum = None, None
    if optimum_resolution is not None:
        phase = in_phase(progress, "optimal return")
        try:
            optimum = world.optimum(optimum_resolution, seed, phase)
        except (InvalidArgument, UnusableData) as error:
            no_optimum = str(error)
    work = None
    if interventions:
        phase = in_phase(progress, "whose work it is")
        work = run_interventions(*trained.within(*within), networks, episodes=episodes, seed=seed, progress=phase)
    findings += () if optimum is None else optimum.findings()
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
        seed=seed,
        greedy=greedy,
        versions=versions_of(("animat", "jax", "jaxlib", "numpy"), [body]),
    )


def _labels(policy: Policy) -> list[str]:
    """What the actions are called: the conditions or, without neurons, the commands."""
    if policy.mapping is None:
        return [f"{command:+g}" for command in policy.commands or ()]
    return [condition.label for condition in policy.conditions]


def _names_of_controls(wanted: str | Collection[str] | None, known: Sequence[str]) -> Collection[str] | None:
    """The names of the controls to run, None for all; raises InvalidArgument for an unknown one."""
    if wanted is None:
        return None
    names = (wanted,) if isinstance(wanted, str) else wanted
    # A robot may lack a heuristic, and the coupling is searched with the optimum only.
    if unknown := sorted({*names} - {*known, "heuristic", "coupling"}):
        raise InvalidArgument(f"controls: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    return names


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

    def row_of(self, control: Control, *, episodes: int, seed: int) -> EvaluationRow:
        ran = control.run(self.environment, self.simulator, episodes=episodes, seed=seed)
        of_trials, changed = self.pulses_of_trials, control.delivery != "chosen"
        pulses = None if of_trials is None else ran.presented @ of_trials * (control.delivery != "silent") / episodes
        return EvaluationRow(control.name, control.meaning, ran, changed, pulses, self.first.pulse_cost)

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


def _context(rows: Sequence[EvaluationRow], optimum: Optimum | None, largest_return: float) -> ContextGap | None:
    """How much the best coupling leaves unused; None if it, or random actions, were not run."""
    by_name = {each.name: each.episodes.returns[0] for each in rows}
    if not {"coupling", "random"} <= set(by_name):
        return None
    returns = by_name["coupling"], by_name["random"]
    if optimum is not None:
        return None if optimum.left_out or optimum.is_surpassed else context_gap(*returns, optimum)
    agents = [row.episodes.returns for row in rows if row.name in ("policies", "heuristic") and not row.changed]
    return least_context_gap(*returns, np.concatenate(agents), largest_return) if agents else None
