"""Predicted return against lived return: policies and controls on a simulator, then in closed loop on the culture."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from animat.animat import Animat
from animat.closed_loop.contenders import Contender, Greedy, controls
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session
from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.errors import InvalidArgument, Mismatch
from animat.evaluation.hand_made import hand_made
from animat.evaluation.rollouts import Actor, Constant, Uniform, networks_of, roll_out
from animat.evaluation.statistics import Interval, compare
from animat.neurons.conditions import Condition
from animat.neurons.responses import Responses
from animat.neurons.simulator import Kind, NeuronSimulator, silenced
from animat.neurons.timeline import fit_timeline
from animat.progress import Progress
from animat.recordings.findings import Finding
from animat.recordings.protocol import Presentation
from animat.training.policy import Policy

PREDICTED_EPISODES = 200
CONFIDENCE = 0.95
_RESAMPLES = 10_000


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a closed loop takes from a recording, and what its prediction is made with.

    Attributes:
        simulator: of the recording.
        burst_threshold: ratio of active channels above which its responses were bursts.
        start_min: of the recording on the culture's clock.
        conditions, window_ms, presentation: of the recording.
        findings: what was noticed.
    """

    simulator: NeuronSimulator
    burst_threshold: float
    start_min: float
    conditions: tuple[Condition, ...]
    window_ms: tuple[float, float]
    presentation: Presentation | None
    findings: tuple[Finding, ...]

    @property
    def percentiles(self) -> Float64[np.ndarray, " percentiles"]:
        """P0, P10, ..., P100 of the non-burst responses, Hz."""
        return np.asarray(self.simulator.percentiles, np.float64)

    @classmethod
    def of_series(
        cls,
        series: Sequence[Responses],
        policy: Policy | None = None,
        *,
        at_min: float | None = None,
        kind: Kind = "histogram",
        bins: int = 20,
        range_hz: float | None = None,
    ) -> Self:
        """From the responses of a culture's recordings.

        Args:
            series: in any order.
            policy: its last simulator in training is the one that is taken, its percentiles held if they were then.
            at_min: the minute whose newest recording is taken instead; None without a policy: the last.
            kind, bins, range_hz: of the simulator, see `fit_timeline`.

        Raises:
            InvalidArgument, Mismatch, UnusableData: as `fit_timeline` does.
        """
        timeline = fit_timeline(series, kind=kind, bins=bins, range_hz=range_hz)
        trained = {} if policy is None else policy.provenance.get("training", {})
        if trained.get("percentiles") == "first":
            timeline = timeline.with_first_percentiles()
        if at_min is None:
            at_min = float(timeline.start_min[-1] if policy is None else timeline.start_min[0])
            if trained.get("shadowing"):
                at_min += trained["duration_min"] * (trained["chunks"] - 1) / trained["chunks"]
        row = timeline.row_at(at_min)
        start_min = float(timeline.start_min[row])
        return cls(
            simulator=timeline.at(start_min),
            burst_threshold=next(r.threshold for r in series if r.start_min == start_min),
            start_min=start_min,
            conditions=timeline.conditions,
            window_ms=timeline.window_ms,
            presentation=timeline.presentation,
            findings=tuple(f for f in timeline.findings if f.sentence.startswith(f"at {start_min:g} min: ")),
        )


@dataclass(frozen=True, eq=False)
class Row:
    """One line of the table.

    Attributes:
        name, meaning: who acted.
        predicted: returns on the simulator, shape (episodes,).
        lived: returns of whole episodes on the culture, shape (episodes,).
        pulses_per_action: that the culture was given.
        seconds_per_action: of the culture's time.
        bursts: share of responses that were.
        late: share of presentations that came late.
        p: that the policies' lived returns are no other than these (two-sided, by rank); None for the policies.
        wins: share of pairs in which the policies' lived return is larger, ties half; None for the policies.
    """

    name: str
    meaning: str
    predicted: Float64[np.ndarray, " predicted"]
    lived: Float64[np.ndarray, " lived"]
    pulses_per_action: float
    seconds_per_action: float
    bursts: float
    late: float
    p: float | None = None
    wins: float | None = None

    @property
    def gap(self) -> Interval:
        """Mean lived less mean predicted return, with its bootstrap interval: both are drawn anew."""
        rng = np.random.default_rng(0)
        means = [_resampled_means(returns, rng) for returns in (self.predicted, self.lived)]
        low, high = np.quantile(means[1] - means[0], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
        return Interval(float(self.lived.mean() - self.predicted.mean()), float(low), float(high), CONFIDENCE)

    def to_dict(self) -> dict[str, Any]:
        """The line as plain data."""
        lived = bool(len(self.lived))
        return {
            "name": self.name,
            "meaning": self.meaning,
            "predicted": float(self.predicted.mean()),
            "lived": float(self.lived.mean()) if lived else None,
            "gap": self.gap.to_dict() if lived else None,
            "episodes": len(self.lived),
            "lived_returns": self.lived.tolist(),
            "pulses_per_action": self.pulses_per_action,
            "seconds_per_action": self.seconds_per_action,
            "bursts": self.bursts,
            "late": self.late,
            "p": self.p,
            "wins": self.wins,
        }


@dataclass(frozen=True, eq=False)
class RealityGap:
    """Policies and controls, predicted and lived.

    Attributes:
        robot, mapping: names.
        loop: the settings of the closed loop.
        calibrated_at_min: of the recording that predicted.
        rows: all policies together first, then each of them where there are several, then the controls.
        session: as it was lived.
        account: of the stimulation.
        findings: where loop, recording and policy differ, and what was noticed.
    """

    robot: str
    mapping: str
    loop: Loop
    calibrated_at_min: float
    rows: tuple[Row, ...]
    session: Session
    account: Account
    findings: tuple[Finding, ...]

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "robot": self.robot,
            "mapping": self.mapping,
            "presentation": str(self.loop.presentation),
            "calibrated_at_min": self.calibrated_at_min,
            "rows": [row.to_dict() for row in self.rows],
            "session": self.session.to_dict(),
            "folder": str(self.session.folder),
            "budget": self.account.to_dict(),
            "findings": [{"name": f.name, "severity": f.severity, "sentence": f.sentence} for f in self.findings],
        }

    def to_text(self) -> str:
        """A table for a terminal."""
        lines = [
            f"{self.robot}, {self.mapping}, {self.loop.presentation}; predicted from the recording at "
            f"{self.calibrated_at_min:g} min",
            f"  {'':16} {'predicted':>9} {'lived':>8} {'gap':>7}  {'95 % interval':>16} {'episodes':>8} "
            f"{'pulses/action':>13} {'p':>8}",
        ]
        for row in self.rows:
            told = row.to_dict()
            lived = "         -        -                  "
            if told["gap"] is not None:
                gap = told["gap"]
                between = f"{gap['low']:+.1f} to {gap['high']:+.1f}"
                lived = f"{told['lived']:8.1f} {gap['value']:+7.1f}  {between:>16}"
            p = "" if row.p is None else f"{row.p:.2g}"
            lines.append(
                f"  {row.name:16} {told['predicted']:9.1f} {lived} {len(row.lived):8} {row.pulses_per_action:13.1f} "
                f"{p:>8}  {row.meaning}"
            )
        outline = self.session.to_dict()
        lines.append(f"  p: that the policies live no other returns than this control; stimulation: {self.account}")
        lines.append(
            f"  {outline['ticks']} ticks, {outline['bursts']} bursts, {outline['late_pulses']} late pulses"
            f" (the latest {outline['latest_ms']:.1f} ms); ended: {outline['ended']}"
        )
        return "\n".join(lines)


def run_policies(
    policies: Mapping[str, Policy],
    culture: Culture,
    calibration: Calibration,
    folder: str | os.PathLike[str],
    *,
    episodes: int = 5,
    with_controls: bool = True,
    greedy: bool = True,
    seed: int = 1,
    pulses: int | None = None,
    account: Account | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> RealityGap:
    """Run policies, and the controls of the study between them, in closed loop, and compare with the prediction.

    Episodes of all of them are interleaved in random order on the one culture, so that drift hits all alike. The silent
    and the shuffled control are the first policy's.

    Args:
        policies: by name, of one robot, mapping and set of conditions.
        culture: open.
        calibration: percentiles, burst threshold and prediction.
        folder: for the session.
        episodes: of each policy and control.
        with_controls: all of them; if not, only the random one.
        greedy: whether policies take the most probable action, or draw as in training.
        seed: decides every random draw, but what the culture does.
        pulses: of a presentation; None: as in the policies' recordings.
        account: of a stimulation budget.
        progress: told after each episode.
        settings: other attributes of `Loop`.

    Raises:
        InvalidArgument: for no policies.
        Mismatch: if they differ from each other, or from the calibration's conditions.
        UnusableData: for policies without neurons.
    """
    first = _check(policies, calibration)
    settings = {"burst_threshold": calibration.burst_threshold, **settings}
    loop, findings = Loop.of_policy(first, calibration.percentiles, pulses=pulses, **settings)
    if calibration.presentation is not None and calibration.presentation != first.presentation:
        sentence = (
            f"the prediction is from a recording presented {calibration.presentation}, the policies' recordings were "
            f"{first.presentation or 'unknown'}"
        )
        findings += (Finding("other-calibration", "warning", sentence),)
    account = account or Account()

    environment = Animat(loop.robot, loop.mapping, len(loop.conditions))
    simulator = calibration.simulator
    acting = {name: Greedy(policy) if greedy else policy for name, policy in policies.items()}
    contenders = [Contender(name, "as trained", controller) for name, controller in acting.items()]
    rule = None
    if with_controls:
        rule = hand_made(environment, simulator)
        contenders += controls(
            loop.robot,
            [condition.label for condition in loop.conditions],
            strongest=int(np.ravel(rule.right)[0]),
            weakest=int(np.ravel(rule.left)[0]),
            policy=acting[next(iter(policies))],
        )
    else:
        contenders += controls(loop.robot, [c.label for c in loop.conditions], strongest=0, weakest=0)[:1]

    def predict(contender: Contender) -> Float64[np.ndarray, " episodes"]:
        """The same contender on the simulator."""
        in_, on = environment, simulator
        actor: Actor = networks_of([policies.get(contender.name, first)], greedy=greedy)
        if contender.name == "random":
            actor = Uniform()
        elif contender.name.startswith("constant "):
            actor = Constant(jnp.array([contender.controller.act(np.empty(0), np.random.default_rng())]))
        elif contender.name == "hand-made" and rule is not None:
            actor = rule
        elif contender.name == "silent":
            on = silenced(simulator)
        elif contender.name == "shuffled":
            in_ = replace(environment, delivery="shuffled")
        returns: Float64[np.ndarray, " episodes"] = roll_out(
            in_, on, actor, 1, episodes=PREDICTED_EPISODES, seed=seed
        ).returns[0]
        return returns

    predicted = {contender.name: predict(contender) for contender in contenders}
    session = run_session(
        culture, loop, contenders, folder, episodes=episodes, seed=seed, account=account, progress=progress
    )
    rows = _rows(contenders, tuple(policies), predicted, session)
    return RealityGap(
        loop.robot.name,
        loop.mapping.name,
        loop,
        calibration.start_min,
        rows,
        session,
        account,
        (*findings, *calibration.findings),
    )


def _check(policies: Mapping[str, Policy], calibration: Calibration) -> Policy:
    if not policies:
        raise InvalidArgument("policies: expected at least one, got none")
    first_name, first = next(iter(policies.items()))
    for name, policy in policies.items():
        for attribute in ("robot", "mapping", "conditions", "presentation", "window_ms"):
            if getattr(policy, attribute) != getattr(first, attribute):
                raise Mismatch(f"{name}: expected the same {attribute} as {first_name}, got another; run it alone")
    if first.mapping is not None and first.conditions != calibration.conditions:
        raise Mismatch(
            f"conditions: expected {', '.join(c.label for c in first.conditions)}, which the policies pick from, got "
            f"recordings with {', '.join(c.label for c in calibration.conditions)}"
        )
    return first


def _rows(
    contenders: Sequence[Contender], names: tuple[str, ...], predicted: Mapping[str, Any], session: Session
) -> tuple[Row, ...]:
    def row(name: str, meaning: str, of: Sequence[str]) -> Row:
        whole = [episode for episode in session.episodes if episode.contender in of and episode.is_whole]
        ticks = [tick for tick in session.ticks if tick.contender in of]
        actions = max(1, sum(tick.command is not None for tick in ticks))
        return Row(
            name=name,
            meaning=meaning,
            predicted=np.concatenate([predicted[each] for each in of]),
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


def _resampled_means(
    returns: Float64[np.ndarray, " episodes"], rng: np.random.Generator
) -> Float64[np.ndarray, " resamples"]:
    n = len(returns)
    often = rng.multinomial(n, np.full(n, 1 / n), _RESAMPLES)
    means: Float64[np.ndarray, " resamples"] = often @ returns / n
    return means
