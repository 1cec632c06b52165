"""Policies and controls, first on the simulator, then interleaved on the culture."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any, TypeVar

from animat.arguments import checked_arguments
from animat.closed_loop.agents import Greedy
from animat.closed_loop.loop import Loop
from animat.closed_loop.runner import starts_of
from animat.closed_loop.running import check_session, run_session
from animat.closed_loop.session import expect_no_session
from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.cultures.failures import describe_error
from animat.cultures.same_culture import culture_differences
from animat.environment import Animat
from animat.errors import InvalidArgument, InvalidFile, UnusableData, did_you_mean, expect_at_least
from animat.evaluation import transfer
from animat.evaluation.controllers import Controller
from animat.evaluation.controls import RANDOM, coupling_of
from animat.evaluation.optimal_returns import too_few
from animat.evaluation.optimum import optimal_values
from animat.evaluation.own_agents import controls_of_own
from animat.evaluation.rollouts import Actor
from animat.progress import Progress, in_phase
from animat.reality_gap.calibration import Calibration
from animat.reality_gap.outlook import Outlook, outlook
from animat.reality_gap.predicting import EPISODES, MOST_ON_HOST, few_predicted, pool, predict_agents
from animat.reality_gap.reasons import Evidence, reasons
from animat.reality_gap.session_responses import read_responses
from animat.reality_gap.session_rows import ALL_POLICIES, session_rows
from animat.reality_gap.simulation import Simulation
from animat.reality_gap.table import INTERVENTIONS, RealityGap, intervention_table
from animat.recordings.findings import Finding, warnings_once
from animat.robots.base import Robot, lacking
from animat.robots.grid import grid_of_optimum, why_no_grid
from animat.robots.host import HostRobot
from animat.robots.starts import Starts
from animat.training.policy import Policy, first_of_alike
from animat.writing import expect_writable

T = TypeVar("T")

FEWEST_OF_A_CONTROL = 5
"""Fewest episodes of a control: enough to show (p < 0.01) that policies with ten or more outperform it."""
_RESOLUTION = 0.5
"""Of the optimum's grid: fast and coarse, with an error of 0.8 on the range of 200 of the cartpole."""

_DECIDED = {"robot", "mapping", "percentiles", "conditions", "adaptive_from", "remembering"}
"""Attributes of the loop that policies and calibration decide."""


@checked_arguments
def run_policies(
    policies: Mapping[str, Policy],
    culture: Culture,
    calibration: Calibration,
    folder: str | os.PathLike[str],
    *,
    episodes: int = 5,
    with_controls: bool = True,
    with_coupling: bool = False,
    with_interventions: bool = False,
    agents: Mapping[str, Actor | Controller] | None = None,
    greedy: bool = True,
    seed: int = 1,
    pulses: int | None = None,
    account: Account | None = None,
    progress: Progress | None = None,
    report: Callable[[str], None] | None = None,
    noticed: Sequence[Finding] = (),
    **settings: Any,
) -> RealityGap:
    """Run policies and controls in closed loop, and compare with the prediction.

    The table is also written into the session's folder, as `returns.txt` and `returns.json`.

    All episodes are interleaved in random order on the one culture, so that drift affects all alike. The controls
    together have no more episodes than the policies, except that each has at least five, or `episodes` if these are
    fewer: stimulation for controls changes the culture for the policies. Under the silent and the shuffled controls the
    policies take turns, one episode each.

    Args:
        policies: by name, all with the same robot, mapping and conditions.
        culture: open.
        calibration: percentiles, whether they adapt, burst threshold and prediction.
        episodes: of each policy, and at most of each control.
        with_controls: whether to run all controls, or only the random one.
        with_coupling: whether to run the best coupling too, which is first searched on the calibration's simulator.
        with_interventions: whether to run the policies also with random spikes instead of responses, yoked stimuli, the
            mapping turned round and, for a robot with several goals, the goal switched; adds `whose_work`.
        agents: of your own, by name, with as many episodes each as a policy (docs/agents.md).
        greedy: whether policies take the most probable action, or draw as in training.
        seed: decides every random draw except those of the culture.
        pulses: per trial; None: as in the policies' recordings.
        account: counts the pulses against a budget, together with what it has counted before; None: without a budget.
        progress: updated in each phase; in the closed loop with the returns so far.
        report: called with lines before the session: the warnings, and how long it will and can be.
        noticed: findings to report in addition to those made here.
        settings: other attributes of `Loop`; by default pulse and patterns are those of the calibrating recording.

    Raises:
        InvalidArgument: for no policies, a folder with a session in it, or one of the `settings` that is none.
        Mismatch: if they differ from each other, or from the calibration's conditions.
        UnusableData: for policies without neurons.
    """
    representative = check_policies(policies)
    expect_at_least("seed", seed, 0)
    _expect_open(settings)
    # Before minutes of prediction.
    expect_no_session(folder)
    transfer.expect_same_conditions(representative, calibration.conditions, calibration.readouts)
    loop, findings = _loop_of(representative, culture, calibration, pulses, settings)
    age_min, starts = calibration.age_min(culture), _starts(loop.robot, seed, episodes)
    called = [name for name, agent in (agents or {}).items() if not isinstance(agent, Actor)]
    findings += tuple(_warnings(representative, loop, calibration, age_min, starts, called))
    account = account or Account()
    simulation = Simulation.of(policies, loop, calibration, greedy=greedy, seed=seed, starts=starts)
    controls = [RANDOM]
    if with_controls:
        if "heuristic" in (lacks := lacking(loop.robot)):
            findings += (Finding("no-heuristic", "note", lacks["heuristic"]),)
        controls = simulation.controls([condition.label for condition in loop.conditions])
    if with_coupling:
        in_phase(progress, "best coupling").update(0, 1, "searching on the simulator")
        controls.append(coupling_of(*simulation.within, seed=seed))
    ideal = None
    if with_interventions:
        interventions, ideal = simulation.interventions()
        controls += interventions
    taken = [ALL_POLICIES, "coupling", "ideal actuator", *INTERVENTIONS, *policies]
    taken += [control.name for control in controls]
    own = controls_of_own(agents or {}, *simulation.within, taken)
    acting = {name: Greedy(policy) if greedy else policy for name, policy in policies.items()}
    taking_turns = simulation.agents(acting, (*controls, *own), calibration)

    of_each = planned_episodes(len(policies), len(controls), episodes) + [episodes] * len(own)
    check_session(culture, loop, taking_turns, of_each, seed)

    # On another core: a session must not wait for the optimal return.
    with _meanwhile(lambda: _optimal_return(simulation.animat, calibration, starts)) as computed:
        predicted = predict_agents(
            simulation.trained,
            tuple(policies),
            (*controls, *own),
            simulation.environment,
            # Fixed thresholds stay the same in bootstraps; adaptive ones would adapt to their responses.
            calibration if calibration.adaptive else calibration.with_percentiles(simulation.simulator.percentiles),
            seed=seed,
            starts=starts,
            progress=in_phase(progress, "predicting"),
        )
    optimum, why_none = computed.result()
    plan = [
        (n, predicted[each.name].presented, each.delivery != "silent")
        for n, each in zip(of_each, taking_turns, strict=True)
    ]
    expected = outlook(loop, calibration, plan, account, age_min)
    findings = (*noticed, *findings, *why_none, *calibration.findings)
    if report is not None:
        # Before the first pulse, so that the operator can still stop.
        _report(report, findings, loop, expected)
    expect_writable(folder, room_bytes=expected.room_bytes)
    session = run_session(
        culture,
        loop,
        taking_turns,
        folder,
        episodes=of_each,
        seed=seed,
        account=account,
        progress=in_phase(progress, "closed loop", sum(of_each), "episodes"),
        predicted={name: of.interval for name, of in predicted.items()},
    )
    rows = session_rows(session, taking_turns, tuple(policies), predicted, loop, representative.pulse_cost, starts)
    gap_reasons: tuple[Finding, ...] = ()
    if sign := rows[0].gap_sign:
        responses = read_responses(session, loop, tuple(policies))
        gap_reasons = reasons(Evidence(responses, calibration, pool([predicted[p] for p in policies]), sign))
    gap = RealityGap(
        loop=loop,
        calibrated_at_min=calibration.start_min,
        optimum=optimum,
        rows=rows,
        session=session,
        account=account,
        findings=findings,
        responses=sum(map(len, calibration.responses_hz)),
        outlook=expected,
        reasons=gap_reasons,
        whose_work=() if ideal is None else intervention_table(rows, *ideal),
    )
    return _written(gap)


def _expect_open(settings: Mapping[str, Any]) -> None:
    """Refuse a setting of the loop that there is not, or that policies and calibration decide."""
    names = {field.name for field in fields(Loop)} - _DECIDED
    for name in sorted(settings.keys() - names):
        arguments = inspect.signature(run_policies).parameters.keys() - {"settings"}
        expected = "an argument of run_policies, or an attribute of Loop that policies and calibration leave open"
        raise InvalidArgument(f"{name}: expected {expected}, got neither{did_you_mean(name, names | arguments)}")


def _loop_of(
    policy: Policy, culture: Culture, calibration: Calibration, pulses: int | None, settings: dict[str, Any]
) -> tuple[Loop, tuple[Finding, ...]]:
    """The loop for a policy, and its differences from the recording and from the policy.

    `settings` replace those that the calibration gives.
    """
    delivered, unknown = calibration.delivered(culture)
    if "pulse" in settings:
        unknown = ()
    settings = {"burst_threshold": calibration.burst_threshold} | delivered | settings
    # The recording's conditions have their stimuli: older policies do not know those of patterns.
    settings["conditions"] = calibration.conditions
    if calibration.adaptive:
        settings["adaptive_from"] = calibration.adjusted
    if policy.neural_observation:
        settings["remembering"] = calibration.remembering
    loop, unlike_policy = Loop.of_policy(policy, calibration.percentiles, pulses=pulses, **settings)
    if calibration.recording is not None:
        unknown += culture_differences(calibration.recording, culture, patterns_too=loop.encoder.takes_patterns)
    return loop, unknown + unlike_policy


@contextmanager
def _meanwhile(compute: Callable[[], T]) -> Iterator[Future[T]]:
    """Compute in another thread while the block runs."""
    thread = ThreadPoolExecutor(1)
    computed = thread.submit(compute)
    try:
        yield computed
    except Exception:
        # A program that exits while JAX computes is killed by a signal. A user who interrupts does not wait.
        thread.shutdown()
        raise


def _report(report: Callable[[str], None], findings: Sequence[Finding], loop: Loop, expected: Outlook) -> None:
    for message in warnings_once(findings):
        report(f"warning: {message}")
    report(f"each pulse: {loop.pulse}")
    report(f"{'warning: ' if expected.budget_min < expected.settling_min else ''}{expected}")


def _written(gap: RealityGap) -> RealityGap:
    """Write the table; if that fails, the session's ending says so, and the table can still be printed."""
    try:
        gap.write()
    except InvalidFile as error:
        session, ending = gap.session, gap.session.ending
        ending = replace(ending, message=f"{ending.message}; {error}")
        return replace(gap, session=replace(session, ending=ending))
    return gap


def _warnings(
    policy: Policy, loop: Loop, calibration: Calibration, age_min: float, starts: Starts | None, called: Sequence[str]
) -> Iterator[Finding]:
    """Known reasons why the measured return may differ from the prediction."""
    yield from transfer.other_calibration(policy.presentation, calibration.presentation)
    if policy.delivery == "shuffled":
        message = (
            "the policies were trained as a control, with conditions drawn at random whatever they chose; this loop "
            "delivers what they choose"
        )
        yield Finding("trained-as-control", "warning", message)
    has_memory = calibration.simulator.has_memory
    if has_memory and loop.pulses == 1 and not loop.warm_up:
        message = (
            "episodes begin after a rest (--warm-up 0), but on the simulator as after stimuli of all conditions: the "
            "measured return may differ from the prediction"
        )
        yield Finding("no-warm-up", "warning", message)
    if calibration.adaptive and policy.percentiles == "first":
        message = (
            "the policies were trained with fixed thresholds, but in this loop thresholds adapt to the culture: use "
            "--thresholds fixed to have them as in training"
        )
        yield Finding("moving-percentiles", "warning", message)
    yield from transfer.other_simulator(policy.fitted, calibration.fitted)
    yield from transfer.other_culture(policy.culture, calibration.culture)
    yield from transfer.faster_than_recorded(calibration.recording, loop.conditions)
    yield from transfer.old_calibration(age_min, "this session")
    yield from transfer.no_memory(calibration.findings, calibration.presentation, has_memory=has_memory)
    yield from few_predicted(loop.robot, starts, called)


def _starts(robot: Robot[Any], seed: int, episodes: int) -> Starts | None:
    """The starts of a session's rounds; None if all are alike, or too many to predict from each of them."""
    most = MOST_ON_HOST if isinstance(robot, HostRobot) else EPISODES
    return starts_of(robot, seed, episodes) if 1 <= episodes <= most else None


def planned_episodes(policies: int, controls: int, episodes: int) -> list[int]:
    """Episodes of each policy, then of each control, which has at most as many."""
    of_a_control = max(FEWEST_OF_A_CONTROL, math.ceil(policies * episodes / controls))
    return [episodes] * policies + [min(episodes, of_a_control)] * controls


def _optimal_return(
    environment: Animat[Any], calibration: Calibration, starts: Starts | None
) -> tuple[float | None, tuple[Finding, ...]]:
    """The optimal return on the recording's simulator, or a finding that says why there is none."""
    robot, reason = environment.robot, why_no_grid(environment.robot)
    if few := too_few(calibration.conditions, [len(responses) for responses in calibration.responses_hz]):
        reason = f"these conditions have too few responses: {', '.join(few)}"
    if reason is None:
        try:
            # Only the value, which is reported as "about": its uncertainty would take a third longer.
            case = environment, calibration.simulator
            (value,), _ = optimal_values([case], grid_of_optimum(robot).scaled(_RESOLUTION), 1, starts=starts)
            return float(value), ()
        except Exception as error:
            reason = describe_error(error)
    message = lacking(robot).get("value_grid", f"no optimal return: {reason}")
    return None, (Finding("no-optimum", "note", message),)


def check_policies(policies: Mapping[str, Policy]) -> Policy:
    """One of policies that can take turns in a closed loop, which represents all: the first whose training ended last.

    Those of an interrupted live training need not have met the same recordings.

    Raises InvalidArgument for no policies, or if one of several is called `policies`, Mismatch if they differ in more
    than in their networks, and UnusableData for policies without neurons.
    """
    if len(policies) > 1 and ALL_POLICIES in policies:
        all_of_them = "which is the name of all of them together"
        raise InvalidArgument(f"policies: expected none called {ALL_POLICIES!r}, {all_of_them}: rename its file")
    alike = ("robot", "mapping", "readouts", "conditions", "commands", "presentation", "window_ms", "fitted")
    first = first_of_alike(policies, (*alike, "percentiles", "delivery", "pulse_cost"), "run it alone")
    if first.mapping is None:
        raise UnusableData("policies: expected some that act through neurons, got some that were trained without")
    return max(policies.values(), key=lambda policy: policy.trained_until_min(0.0) or 0.0)
