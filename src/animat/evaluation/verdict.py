"""Whether policies outperform the controls beside them: one rule and the same words wherever both are shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from animat.evaluation.statistics import p_of_u

OUTPERFORMED_P = 0.01
"""The p below which policies count as better, as in the paper's comparisons."""


class Beside(NamedTuple):
    """Episodes of policies beside those of a control.

    Attributes:
        p: of the two-sided Mann-Whitney test (normal approximation).
        wins: share of pairs of episodes in which the policies' return is larger, ties half.
        policies, control: episodes of each.
    """

    p: float
    wins: float
    policies: int
    control: int

    @property
    def is_outperformed(self) -> bool:
        """Whether the policies' returns are larger than the control's."""
        return self.p < OUTPERFORMED_P and self.wins > 0.5

    @property
    def is_worse(self) -> bool:
        """Whether they are smaller."""
        return is_worse(self.p, self.wins)

    @property
    def can_tell(self) -> bool:
        """Whether so many episodes could come to a small p at all: if each of the policies' were the larger one."""
        return p_of_u(0.0, self.policies, self.control) < OUTPERFORMED_P


def beside(policies: ArrayLike, control: ArrayLike) -> Beside:
    """Compare the returns of policies with those of a control, episode by episode, all policies together.

    Args:
        policies, control: returns, at least one of each, any shape.
    """
    from scipy.stats import mannwhitneyu

    ours, theirs = np.ravel(policies), np.ravel(control)
    if np.ptp(np.concatenate([ours, theirs])) == 0:
        return Beside(1.0, 0.5, len(ours), len(theirs))
    test = mannwhitneyu(ours, theirs, alternative="two-sided", method="asymptotic")
    # By its continuity correction p can exceed 1 where U is at its mean.
    return Beside(min(1.0, float(test.pvalue)), float(test.statistic) / ours.size / theirs.size, len(ours), len(theirs))


def is_worse(p: float, wins: float) -> bool:
    """Whether returns are smaller than a control's, by the test and the share of pairs of episodes that they win."""
    return p < OUTPERFORMED_P and wins < 0.5


@dataclass(frozen=True)
class Verdict:
    """Whether policies outperform each control.

    Attributes:
        controls: by name, at least one.
    """

    controls: Mapping[str, Beside]

    @classmethod
    def of(cls, policies: ArrayLike, controls: Mapping[str, ArrayLike]) -> Self:
        """From returns of episodes."""
        return cls({name: beside(policies, returns) for name, returns in controls.items()})

    @property
    def not_outperformed(self) -> tuple[str, ...]:
        """The controls than which the policies' returns are not shown to be larger (p < 0.01)."""
        return tuple(name for name, each in self.controls.items() if not each.is_outperformed)

    def __str__(self) -> str:
        few = {name: each for name, each in self.controls.items() if not each.can_tell}
        reported = [
            f"{name} (p = {each.p:.2g}; {'they are worse: ' if each.is_worse else ''}their return is larger in "
            f"{100 * each.wins:.0f} % of the pairs of episodes)"
            for name, each in self.controls.items()
            if not each.is_outperformed and each.can_tell
        ]
        said = [f"the policies do not outperform {', '.join(reported)}"] if reported else []
        if few:
            fewest = min(few.values(), key=lambda each: each.control)
            said.append(
                f"{fewest.policies} episode{'' if fewest.policies == 1 else 's'} of the policies beside "
                f"{fewest.control} of a control are too few to tell (p < {OUTPERFORMED_P:g}) whether the policies "
                f"outperform {', '.join(few)}"
            )
        if not said:
            least = min(each.wins for each in self.controls.values())
            said.append(
                f"the policies outperform every control (p < {OUTPERFORMED_P:g}; their return is larger in "
                f"{100 * least:.0f} % of the pairs of episodes or more)"
            )
        return "; ".join(said)
