"""Whose work is it: what policies lose where the culture, what it is given, or what is made of it is changed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.columns import align_columns
from animat.environment import Animat, Environment
from animat.errors import InvalidArgument
from animat.evaluation.controls import Control, interventions_of
from animat.evaluation.information import DRAWS, GoalInformation, goal_information, interval_of_mean
from animat.evaluation.rollouts import Episodes, Networks, roll_out
from animat.evaluation.statistics import Interval
from animat.evaluation.traces import Traces, trace
from animat.neurons.simulator import NeuronSimulator
from animat.progress import Progress, Silent
from animat.records import as_json
from animat.tables import briefly
from animat.wrappers import unwrapped

AS_THEY_ARE = "as they are"
TOLD_INFORMATION = (AS_THEY_ARE, "silent", "shuffled")
"""Where goal information is computed: who knows the goal and cannot act on it has bits and no return."""
TRACED = 32
"""Episodes of each policy in which the first choice after a switch of the goal is looked for."""


@dataclass(frozen=True, eq=False)
class Changed:
    """Policies in what is changed in one way.

    Attributes:
        name, meaning: the intervention.
        returns: shape (policies, episodes).
        lost: mean return less than that of the same policies as they are, with its interval; negative for a gain.
        information: of what they chose there; None where it was not computed.
    """

    name: str
    meaning: str
    returns: Float64[np.ndarray, "policies episodes"]
    lost: Interval
    information: GoalInformation | None = None

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        information = None if self.information is None else self.information.to_dict()
        mean = float(self.returns.mean())
        told = {"name": self.name, "meaning": self.meaning, "mean_return": mean, "lost": as_json(self.lost.to_dict())}
        return told | {"goal_information": information}


@dataclass(frozen=True)
class Turning:
    """What a switch of the goal does to what is chosen, beside the same episodes without one.

    Attributes:
        at: after how many actions the goal was switched.
        episodes: that went on for so long.
        turned: share of these in which another stimulus was chosen, sooner or later.
        after: median of how many actions after the switch that was, 1 for the first one; None where it never was.
    """

    at: int
    episodes: int
    turned: float
    after: float | None

    def to_text(self) -> str:
        """In a line."""
        if not self.episodes:
            return f"no episode went on for the {self.at} actions after which the goal is switched"
        after = "" if self.after is None else f", the first time with action {self.after:g} after it (median)"
        share = f"{100 * self.turned:.0f} % of {self.episodes} episodes"
        return f"the goal switched after {self.at} actions: another stimulus is chosen in {share}{after}"


@dataclass(frozen=True, eq=False)
class WhoseWork:
    """The table, on one simulator.

    Attributes:
        rows: the policies as they are, then changed.
        turning: what the switch of the goal does; None for a robot with only one goal.
    """

    __repr__ = briefly

    rows: tuple[Changed, ...]
    turning: Turning | None = None

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "rows": [row.to_dict() for row in self.rows],
            "turning": None if self.turning is None else vars(self.turning),
        }

    def to_text(self) -> str:
        """A table for a terminal."""
        cells = []
        for row in self.rows:
            lost = ["", ""] if row.name == AS_THEY_ARE else [f"{row.lost.value:.1f}", row.lost.ends]
            bits = "" if row.information is None else f"{row.information.bits.value:.2f}"
            cells.append([row.name, f"{row.returns.mean():.1f}", *lost, bits, row.meaning])
        lines = [
            "whose work is it: the same policies",
            *align_columns(["", "return", "lost", "95 % interval", "bits", ""], cells),
        ]
        information = self.rows[0].information
        if information is None:
            lines.append("  no goal information: the robot has only one goal (it has no method `with_goal_of`)")
        else:
            lines.append(f"  {information.to_text()}")
        if self.turning is not None:
            lines.append(f"  {self.turning.to_text()}")
        return "\n".join(lines)


def whose_work(
    environment: Environment[Any],
    simulator: NeuronSimulator | None,
    policies: Networks,
    n_policies: int,
    *,
    episodes: int,
    seed: int,
    progress: Progress | None = None,
) -> WhoseWork:
    """Run policies as they are and with every intervention of `animat.evaluation.controls.interventions_of`.

    The goal is switched in the middle of the median episode of the policies as they are.

    Args:
        episodes: of each policy and intervention.
        seed: decides every random draw.
        progress: told after each intervention.

    Raises:
        InvalidArgument: for an environment without neurons.
    """
    if simulator is None or not isinstance(unwrapped(environment), Animat):
        raise InvalidArgument("interventions: expected policies that act through neurons, got others")
    progress, draws = progress or Silent(), 2 if policies.greedy else DRAWS

    def ran(control: Control) -> Episodes:
        within = control.within(environment, simulator)
        return roll_out(*within, policies, n_policies, episodes=episodes, seed=seed)

    plain = Control(AS_THEY_ARE, "through the culture's simulator", policies, n_policies)
    usual = ran(plain)
    has_goals = hasattr(environment.robot, "with_goal_of")
    switch_at = max(1, int(np.median(usual.lengths)) // 2) if has_goals else None
    acting = [plain, *interventions_of(environment, simulator, policies, n_policies, switch_at=switch_at)]
    rows = []
    for number, control in enumerate(acting):
        progress.update(number, len(acting), control.name)
        returns = usual.returns if control is plain else ran(control).returns
        lost = usual.returns - returns
        information = None
        if has_goals and control.name in TOLD_INFORMATION:
            within = control.within(environment, simulator)
            information = goal_information(*within, policies, n_policies, draws=draws, seed=seed)
        of_each = lost.mean(axis=1) if n_policies > 1 else lost[0]
        rows.append(Changed(control.name, control.meaning, returns, interval_of_mean(of_each), information))
    turning = None
    if switch_at is not None:
        # The same episodes, with the same random numbers, with and without a switch.
        usual_trace, switched = (
            trace(*each.within(environment, simulator), policies, n_policies, episodes=TRACED, seed=seed)
            for each in (plain, acting[-1])
        )
        turning = _turning(usual_trace, switched, switch_at)
    return WhoseWork(tuple(rows), turning)


def _turning(usual: Traces, other: Traces, at: int) -> Turning:
    went_on = usual.lengths > at
    # What comes after the end of either episode is no choice.
    last = np.minimum(usual.lengths, other.lengths)[..., None]
    iterations = np.arange(usual.actions.shape[2])
    differs = (usual.actions != other.actions) & (iterations < last)
    turned = differs.any(axis=2) & went_on
    after = (differs.argmax(axis=2) + 1 - at)[turned]
    n = int(went_on.sum())
    share = float(turned.sum() / n) if n else 0.0
    return Turning(at, n, share, float(np.median(after)) if len(after) else None)
