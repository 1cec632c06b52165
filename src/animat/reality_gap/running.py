"""Policies and the controls of the study, first on the simulator, then between each other on the culture."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from animat.animat import Animat
from animat.closed_loop.contenders import Contender, Greedy, controls, random_control
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session
from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.errors import InvalidArgument, Mismatch
from animat.evaluation.hand_made import hand_made
from animat.evaluation.optimum import best_return
from animat.evaluation.statistics import compare
from animat.progress import Progress
from animat.reality_gap.calibration import Calibration
from animat.reality_gap.predicting import Predicted, predict
from animat.reality_gap.table import RealityGap, Row
from animat.recordings.findings import Finding
from animat.robots.steering import STEERED
from animat.training.policy import Policy

OLD_MIN = 30.0
"""Age of a recording from which on a warning says that the culture may be another by now."""
LIMIT_RESOLUTION = 0.6
"""Of the grid of the best possible return: fast and rough, 0.5 of the cartpole's 200."""


def run_policies(
    policies: Mapping[str, Policy],
    culture: Culture,
    calibration: Calibration,
    folder: str | os.PathLike[str],
    *,
    episodes: int = 5,
    with_controls: bool = True,
    greedy: bool = True,
    follow: bool = True,
    seed: int = 1,
    pulses: int | None = None,
    account: Account | None = None,
    progress: Progress | None = None,
    noticed: Sequence[Finding] = (),
    **settings: Any,
) -> RealityGap:
    """Run policies, and the controls of the study between them, in closed loop, and compare with the prediction.

    Episodes of all of them are interleaved in random order on the one culture, so that drift hits all alike. Under the
    silent and the shuffled control the policies take turns, episode after episode.

    Args:
        policies: by name, of one robot, mapping and set of conditions.
        culture: open.
        calibration: percentiles, burst threshold and prediction.
        folder: for the session.
        episodes: of each policy and control.
        with_controls: all of them; if not, only the random one.
        greedy: whether policies take the most probable action, or draw as in training.
        follow: whether the mapping's percentiles follow the culture (`animat.closed_loop.following`) from where the
            calibration left them, or are held.
        seed: decides every random draw, but what the culture does.
        pulses: of a presentation; None: as in the policies' recordings.
        account: of a stimulation budget.
        progress: told after each episode.
        noticed: findings to be told beside those made here.
        settings: other attributes of `Loop`.

    Raises:
        InvalidArgument: for no policies.
        Mismatch: if they differ from each other, or from the calibration's conditions.
        UnusableData: for policies without neurons.
    """
    first = check_policies(policies)
    check_conditions(first, calibration)
    settings = {"burst_threshold": calibration.burst_threshold, **settings}
    if follow:
        settings["following"] = calibration.responses_hz
    loop, findings = Loop.of_policy(first, calibration.percentiles, pulses=pulses, **settings)
    if calibration.presentation is not None and calibration.presentation != first.presentation:
        sentence = (
            f"the prediction is from a recording presented {calibration.presentation}, the policies' recordings were "
            f"{first.presentation or 'unknown'}"
        )
        findings += (Finding("other-calibration", "warning", sentence),)
    if first.delivery == "shuffled":
        sentence = (
            "the policies were trained as a control, with conditions drawn at random whatever they chose; in this loop "
            "what they choose is delivered"
        )
        findings += (Finding("trained-as-control", "warning", sentence),)
    if calibration.simulator.has_memory and loop.pulses == 1 and not loop.lead_in:
        sentence = (
            "episodes begin after a rest (--lead-in 0), and those of the simulator as after stimuli of all conditions: "
            "what is lived will be less than predicted"
        )
        findings += (Finding("no-lead-in", "warning", sentence),)
    if follow and first.percentiles == "first":
        sentence = (
            "the policies were trained on held percentiles, and in this loop they follow the culture: with "
            "--thresholds held they are as in training"
        )
        findings += (Finding("moving-percentiles", "warning", sentence),)
    age_min = culture.now_s / 60 - calibration.start_min
    if age_min > OLD_MIN:
        sentence = (
            f"percentiles and prediction are of {calibration.start_min:.0f} min, and the culture is at "
            f"{culture.now_s / 60:.0f} min: cultures drift; take a later recording (--at-min), or train on later ones"
        )
        findings += (Finding("old-calibration", "warning", sentence, age_min),)
    remembers = next((finding for finding in calibration.findings if finding.name == "memory"), None)
    if remembers is not None and not calibration.simulator.has_memory:
        blocked = calibration.presentation is not None and calibration.presentation.order == "blocked"
        remedy = "record with --order mixed" if blocked else "--simulator memory"
        sentence = f"{remembers.sentence}: what is lived will be something else than predicted ({remedy})"
        findings += (Finding("no-memory", "warning", sentence, remembers.value),)
    if first.fitted and first.fitted != calibration.fitted:
        sentence = f"the policies were trained on simulators made otherwise ({first.fitted}) than the one that predicts"
        findings += (Finding("other-simulator", "warning", f"{sentence} ({calibration.fitted})"),)
    account = account or Account()

    environment = Animat(loop.robot, loop.mapping, len(loop.conditions))
    simulator = calibration.simulator
    acting = {name: Greedy(policy) if greedy else policy for name, policy in policies.items()}
    contenders = [Contender(name, "as trained", controller) for name, controller in acting.items()]
    rule = None
    if with_controls:
        rule = hand_made(environment, simulator) if isinstance(loop.robot, STEERED) else None
        contenders += controls(
            loop.robot,
            [condition.label for condition in loop.conditions],
            strongest=0 if rule is None else int(np.ravel(rule.right)[0]),
            weakest=0 if rule is None else int(np.ravel(rule.left)[0]),
            policies=acting,
        )
    else:
        contenders.append(random_control(len(loop.conditions)))

    predicted = predict(
        [contenders[: len(policies)], *([control] for control in contenders[len(policies) :])],
        environment,
        # Held percentiles are what they are; those that follow the culture would follow other responses too.
        calibration if follow else calibration.holding(calibration.simulator.percentiles),
        rule,
        greedy=greedy,
        seed=seed,
        progress=progress,
    )
    limit = best_return(environment, simulator, resolution=LIMIT_RESOLUTION, episodes=0).value
    session = run_session(
        culture, loop, contenders, folder, episodes=episodes, seed=seed, account=account, progress=progress
    )
    rows = _rows(contenders, tuple(policies), predicted, session)
    return RealityGap(
        loop.robot.name,
        loop.mapping.name,
        loop,
        calibration.start_min,
        limit,
        rows,
        session,
        account,
        (*noticed, *findings, *calibration.findings),
        calibration.simulator.has_memory,
    )


def check_policies(policies: Mapping[str, Policy]) -> Policy:
    """Raise unless policies can take turns in one closed loop; returns the first, which stands for all.

    Raises:
        InvalidArgument: for none.
        Mismatch: if they differ in robot, mapping, conditions, presentation, response window, or in how the simulators
            were made that they were trained on.
    """
    if not policies:
        raise InvalidArgument("policies: expected at least one, got none")
    first_name, first = next(iter(policies.items()))
    for name, policy in policies.items():
        for attribute in ("robot", "mapping", "conditions", "presentation", "window_ms", "fitted"):
            if getattr(policy, attribute) != getattr(first, attribute):
                raise Mismatch(f"{name}: expected the same {attribute} as {first_name}, got another; run it alone")
    return first


def check_conditions(first: Policy, calibration: Calibration) -> None:
    """Raise unless a calibration is for the conditions that policies pick from.

    Raises:
        Mismatch: if it is not.
    """
    if first.mapping is not None and first.conditions != calibration.conditions:
        raise Mismatch(
            f"conditions: expected {', '.join(c.label for c in first.conditions)}, which the policies pick from, got "
            f"recordings with {', '.join(c.label for c in calibration.conditions)}"
        )


def _rows(
    contenders: Sequence[Contender], names: tuple[str, ...], predicted: Mapping[str, Predicted], session: Session
) -> tuple[Row, ...]:
    def row(name: str, meaning: str, of: Sequence[str]) -> Row:
        whole = [episode for episode in session.episodes if episode.contender in of and episode.is_whole]
        ticks = [tick for tick in session.ticks if tick.contender in of and tick.handled != "lead-in"]
        actions = max(1, sum(tick.command is not None for tick in ticks))
        return Row(
            name=name,
            meaning=meaning,
            predicted=np.concatenate([predicted[each].returns for each in of]),
            predicted_anew=np.mean([predicted[each].anew for each in of], axis=0),
            lived=np.array([episode.total for episode in whole], np.float64),
            pulses_per_action=sum(len(tick.pulse_time_s) for tick in ticks) / actions,
            seconds_per_action=sum(session.log.header["loop"]["pulses"] / tick.frequency_hz for tick in ticks)
            / actions,
            bursts=sum(tick.is_burst for tick in ticks) / max(1, len(ticks)),
            late=sum(tick.late_s > 0 for tick in ticks) / max(1, len(ticks)),
        )

    policies = row("policies" if len(names) > 1 else names[0], "as trained", names)
    rows = [policies]
    for contender in contenders:
        if contender.name in names:
            if len(names) > 1:
                rows.append(row(contender.name, contender.meaning, [contender.name]))
            continue
        control = row(contender.name, contender.meaning, [contender.name])
        if len(control.lived) and len(policies.lived):
            comparison = compare(control.lived, policies.lived)
            control = replace(control, p=comparison.p_normal, wins=(comparison.effect.value + 1) / 2)
        rows.append(control)
    return tuple(rows)
