"""Whether policies outperform controls: one rule and one wording wherever both are shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from animat.errors import counted
from animat.evaluation.statistics import mann_whitney, p_of_u

OUTPERFORMED_P = 0.01
"""Policies count as better if p is below this, as in the paper's comparisons."""


class EpisodeComparison(NamedTuple):
    """Episodes of policies compared with those of a control.

    Attributes:
        p: of the two-sided Mann-Whitney test (normal approximation).
        wins: share of pairs of episodes in which the policies' return is larger, ties half.
        policies, control: number of episodes.
    """

    p: float
    wins: float
    policies: int
    control: int

    @property
    def is_outperformed(self) -> bool:
        """Whether the policies' returns are larger than the control's, in enough episodes to show it."""
        return self.p < OUTPERFORMED_P and self.wins > 0.5 and self.has_enough_episodes

    @property
    def has_enough_episodes(self) -> bool:
        """Whether this number of episodes could give a small p at all: if all of the policies' were larger."""
        return p_of_u(0.0, self.policies, self.control) < OUTPERFORMED_P


def compare_episodes(policies: ArrayLike, control: ArrayLike) -> EpisodeComparison:
    """Compare the returns (at least one, any shape) of all policies together with those of a control, by episodes."""
    ours, theirs = np.ravel(policies), np.ravel(control)
    u, p = mann_whitney(ours, theirs)
    return EpisodeComparison(p, u / len(ours) / len(theirs), len(ours), len(theirs))


def is_worse(p: float, wins: float) -> bool:
    """Whether returns are smaller than a control's, by the test's p and the share of pairs of episodes won."""
    return p < OUTPERFORMED_P and wins < 0.5


@dataclass(frozen=True)
class Verdict:
    """Whether policies outperform each control; there is at least one."""

    controls: Mapping[str, EpisodeComparison]

    @classmethod
    def of(cls, policies: ArrayLike, controls: Mapping[str, ArrayLike]) -> Self:
        """From returns of episodes."""
        return cls({name: compare_episodes(policies, returns) for name, returns in controls.items()})

    @property
    def not_outperformed(self) -> tuple[str, ...]:
        """The controls whose returns the policies' are not shown to exceed (p < 0.01)."""
        return tuple(name for name, each in self.controls.items() if not each.is_outperformed)

    def __str__(self) -> str:
        few = {name: each for name, each in self.controls.items() if not each.has_enough_episodes}
        not_outperformed = [
            f"{name} (p = {each.p:.2g}; {'they are worse: ' if is_worse(each.p, each.wins) else ''}their return is "
            f"larger in {100 * each.wins:.0f} % of the pairs of episodes, ties counting half)"
            for name, each in self.controls.items()
            if not each.is_outperformed and each.has_enough_episodes
        ]
        parts = []
        if not_outperformed:
            parts.append(f"the policies do not outperform these controls: {', '.join(not_outperformed)}")
        if few:
            fewest = min(few.values(), key=lambda each: each.control)
            parts.append(
                f"{counted(fewest.policies, 'episode')} of the policies and "
                f"{fewest.control} of a control are too few to show (p < {OUTPERFORMED_P:g}) whether the policies "
                f"outperform {', '.join(few)}"
            )
        if not parts:
            least = min(each.wins for each in self.controls.values())
            parts.append(
                f"the policies outperform every control (p < {OUTPERFORMED_P:g}; their return is larger in at least "
                f"{100 * least:.0f} % of the pairs of episodes, ties counting half)"
            )
        return "; ".join(parts)
