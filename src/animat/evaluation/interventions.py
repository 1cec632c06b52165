"""Whose work is it: what policies lose if the culture, its stimuli or the use of its responses is changed."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.environment import Animat, Environment, Neurons
from animat.errors import InvalidArgument
from animat.evaluation.controls import Control, interventions_of
from animat.evaluation.information import DRAWS, GoalInformation, goal_information
from animat.evaluation.rollouts import Networks, Trajectories, trajectories
from animat.evaluation.statistics import Interval, interval_of_mean
from animat.progress import Progress, Silent
from animat.records import as_json
from animat.tables import briefly
from animat.terminal_table import align_columns
from animat.wrappers import unwrapped

AS_THEY_ARE = "as they are"
WITH_INFORMATION = (AS_THEY_ARE, "silent", "shuffled")
"""Where goal information is computed: a policy that knows the goal but cannot act on it has bits but no return."""
SWITCH_EPISODES = 32
"""Episodes of each policy in which the first changed choice after a switch of the goal is sought."""


@dataclass(frozen=True, eq=False)
class InterventionRow:
    """Policies with one intervention.

    Attributes:
        lost: mean loss of return against the same policies as they are, with its interval; negative for a gain.
        information: goal information of their choices; None if it was not computed.
    """

    name: str
    meaning: str
    returns: Float64[np.ndarray, "policies episodes"]
    lost: Interval
    information: GoalInformation | None = None

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "name": self.name,
            "meaning": self.meaning,
            "mean_return": float(self.returns.mean()),
            "lost": as_json(self.lost.to_dict()),
            "goal_information": None if self.information is None else asdict(self.information),
        }


@dataclass(frozen=True)
class SwitchEffect:
    """The effect of a switch of the goal on choices, compared with the same episodes without a switch.

    Attributes:
        at: number of actions after which the goal was switched.
        episodes: number that lasted longer.
        turned: share of these in which a different stimulus was chosen at any time after the switch.
        after: median number of actions from the switch to that choice, 1 for the first action; None if there was none.
    """

    at: int
    episodes: int
    turned: float
    after: float | None

    def to_text(self) -> str:
        """One line."""
        if not self.episodes:
            return f"no episode lasted longer than the {self.at} actions after which the goal is switched"
        after = "" if self.after is None else f", first at action {self.after:g} after the switch (median)"
        share = f"{100 * self.turned:.0f} % of {self.episodes} episodes"
        return f"goal switched after {self.at} actions: a different stimulus is chosen in {share}{after}"


@dataclass(frozen=True, eq=False)
class InterventionTable:
    """The policies as they are and with each intervention, and the effect of a switch of the goal, if there is one."""

    __repr__ = briefly

    rows: tuple[InterventionRow, ...]
    turning: SwitchEffect | None = None

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        turning = None if self.turning is None else vars(self.turning)
        return {"rows": [row.to_dict() for row in self.rows], "turning": turning}

    def to_text(self) -> str:
        """A table for a terminal."""
        cells, has_goals = [], self.rows[0].information is not None
        for row in self.rows:
            lost = ["", ""] if row.name == AS_THEY_ARE else [f"{row.lost.value:.1f}", row.lost.ends]
            bits = "" if row.information is None else f"{row.information.bits.value:.2f}"
            cells.append([row.name, f"{row.returns.mean():.1f}", *lost, *([bits] if has_goals else []), row.meaning])
        head = ["", "return", "lost", "95 % interval", *(["bits"] if has_goals else []), ""]
        lines = ["whose work is it: the same policies with each intervention", *align_columns(head, cells)]
        information = self.rows[0].information
        one_goal = "no goal information: the robot has only one goal (no method `with_goal_of`)"
        lines.append(f"  {one_goal if information is None else information.to_text()}")
        return "\n".join(lines if self.turning is None else [*lines, f"  {self.turning.to_text()}"])


def run_interventions(
    environment: Environment[Any],
    simulator: Neurons,
    policies: Networks,
    *,
    episodes: int,
    seed: int,
    progress: Progress | None = None,
) -> InterventionTable:
    """Run policies as they are and with every intervention of `animat.evaluation.controls.interventions_of`.

    The goal is switched in the middle of the policies' median episode. Refuses an environment without neurons.
    """
    if simulator is None or not isinstance(unwrapped(environment), Animat):
        raise InvalidArgument("interventions: expected policies that act through neurons, got policies without neurons")
    progress, draws = progress or Silent(), 2 if policies.greedy else DRAWS
    plain = Control(AS_THEY_ARE, "through the culture's simulator", policies)
    usual = plain.run(environment, simulator, episodes=episodes, seed=seed)
    has_goals = hasattr(environment.robot, "with_goal_of")
    switch_at = usual.half_way if has_goals else None
    acting = [plain, *interventions_of(environment, simulator, policies, switch_at=switch_at)]
    rows = []
    for number, control in enumerate(acting):
        progress.update(number, len(acting), control.name)
        ran = usual if control is plain else control.run(environment, simulator, episodes=episodes, seed=seed)
        lost = usual.returns - ran.returns
        information = None
        if has_goals and control.name in WITH_INFORMATION:
            within = control.within(environment, simulator)
            information = goal_information(*within, policies, draws=draws, seed=seed)
        samples = lost.mean(axis=1) if len(lost) > 1 else lost[0]
        rows.append(InterventionRow(control.name, control.meaning, ran.returns, interval_of_mean(samples), information))
    turning = None
    if switch_at is not None:
        # The same episodes, with the same random numbers, with and without a switch.
        unswitched, switched = (
            trajectories(*each.within(environment, simulator), policies, episodes=SWITCH_EPISODES, seed=seed)
            for each in (plain, acting[-1])
        )
        turning = _switch_effect(unswitched, switched, switch_at)
    return InterventionTable(tuple(rows), turning)


def _switch_effect(usual: Trajectories, other: Trajectories, at: int) -> SwitchEffect:
    lasted = usual.lengths > at
    # Entries after the end of either episode are not choices.
    last = np.minimum(usual.lengths, other.lengths)[..., None]
    differs = (usual.actions != other.actions) & (np.arange(usual.actions.shape[2]) < last)
    turned = differs.any(axis=2) & lasted
    after = (differs.argmax(axis=2) + 1 - at)[turned]
    n = int(lasted.sum())
    share = float(turned.sum() / n) if n else 0.0
    return SwitchEffect(at, n, share, float(np.median(after)) if len(after) else None)
