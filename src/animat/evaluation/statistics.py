"""Rank comparisons of policies with effect sizes, intervals and a verdict; the score between random and the optimum."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from animat.errors import InvalidArgument, counted, shown

CONFIDENCE = 0.95
OUTPERFORMED_P = 0.01
"""Policies count as better if p is below this, as in the paper's comparisons."""
MOST_PAIRS = 10_000
"""Pairs of samples up to which p is computed exactly: two groups of 100 take 0.1 s, and time and memory grow fast."""
_MOST_EPISODE_PAIRS = 1_000
"""Likewise for episodes, of which there are many comparisons; with more the approximation is as good."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval.

    Attributes:
        low, high: the interval's ends; infinite if the samples do not determine their spread.
        confidence: approximate share of such intervals that contain the true value.
    """

    value: float
    low: float
    high: float
    confidence: float = CONFIDENCE

    def to_dict(self) -> dict[str, float]:
        """Everything as plain data."""
        return asdict(self)

    @property
    def ends(self) -> str:
        """Both ends as text for a table."""
        return f"{self.low:.1f} to {self.high:.1f}" if math.isfinite(self.low) else "unknown"


@dataclass(frozen=True)
class Comparison:
    """Two groups compared by rank, two-sided.

    Attributes:
        u: Mann-Whitney's U as in the paper, the smaller of `u_first` and n1 n2 - `u_first`.
        u_first: number of pairs in which the first group's sample is larger, ties half.
        p_normal: by the normal approximation with corrections for continuity and ties, as in the paper.
        p_exact: over all ways to divide the samples, including ties; with more than 10,000 pairs `p_normal`.
        effect: rank-biserial correlation, share of pairs in which the second is larger less the share in which the
            first is, from -1 to 1, with its interval.
    """

    u: float
    u_first: float
    n_first: int
    n_second: int
    p_normal: float
    p_exact: float
    effect: Interval
    ties: bool


def compare(first: ArrayLike, second: ArrayLike) -> Comparison:
    """The two-sided Mann-Whitney U test of two groups, by the normal approximation and exactly, with effect size.

        U_1 = #(first > second) + #(first = second) / 2,    U = min(U_1, n_1 n_2 - U_1),    effect = 1 - 2 U_1 / n_1 n_2

    The normal approximation subtracts 1/2 from the distance of U from its mean (continuity) and uses the standard
    deviation for tied ranks. If all samples are equal, p = 1. The effect's interval is Newcombe's (method 5): all
    shares t of pairs won with (t' - t)^2 <= z^2 V(t), where t' is the observed share and

        V(t) = t (1 - t) (1 + k ((1 - t) / (2 - t) + t / (1 + t))) / n_1 n_2,    k = (n_1 + n_2) / 2 - 1

    As V is that of the assumed share, the interval has a width even if all pairs are won. A group has one number per
    policy, such as its mean return; InvalidArgument for an empty one, or numbers that are not finite.

    Source: Mann and Whitney 1947, doi:10.1214/aoms/1177730491; Newcombe 2006, doi:10.1002/sim.2324; the paper's table
        of comparisons.
    """
    a, b = _samples("first", first), _samples("second", second)
    u_first, p_normal = mann_whitney(a, b)
    ties = len(np.unique(np.concatenate([a, b]))) < len(a) + len(b)
    total = len(a) * len(b)
    p_exact = p_normal if total > MOST_PAIRS else _exact_p(a, b)
    high, low = (1 - 2 * share for share in _shares_within(u_first / total, len(a), len(b)))
    effect = Interval(1 - 2 * u_first / total, low, high)
    return Comparison(min(u_first, total - u_first), u_first, len(a), len(b), p_normal, p_exact, effect, ties)


def mann_whitney(first: Float64[np.ndarray, " n"], second: Float64[np.ndarray, " m"]) -> tuple[float, float]:
    """The U of the first group, and the two-sided p by the normal approximation as in `compare`; it is never 0."""
    from scipy.stats import mannwhitneyu

    if np.ptp(np.concatenate([first, second])) == 0:
        # From 1.18 on SciPy returns NaN.
        return len(first) * len(second) / 2, 1.0
    test = mannwhitneyu(first, second, alternative="two-sided", method="asymptotic")
    # Of groups of hundreds p can underflow to 0.
    return float(test.statistic), max(float(test.pvalue), sys.float_info.min)


def p_of_u(u: float, n_first: int, n_second: int) -> float:
    """The two-sided p that a U implies without ties, by the normal approximation with continuity correction.

        z = (|U - m| - 1/2) / s,    m = n_1 n_2 / 2,    s^2 = n_1 n_2 (n_1 + n_2 + 1) / 12,
        p = min(1, 2 (1 - Phi(z)))

    Refuses an empty group, and a U that is impossible for groups of these sizes (InvalidArgument).
    """
    from scipy.special import ndtr

    if n_first < 1 or n_second < 1:
        raise InvalidArgument(f"n: expected at least 1 sample in each group, got {n_first} and {n_second}")
    total = n_first * n_second
    if not 0 <= u <= total:
        raise InvalidArgument(f"u: expected 0 to {total} for {n_first} and {n_second} samples, got {u:g}")
    z = (abs(u - total / 2) - 0.5) / np.sqrt(total * (n_first + n_second + 1) / 12)
    return float(min(1.0, 2 * ndtr(-z)))


def interquartile_mean(samples: ArrayLike, *, within: tuple[float, float] = (-math.inf, math.inf)) -> Interval:
    """The mean of the middle half of samples, with its interval by Student's t.

    A quarter of the samples, rounded down, is left out at each end. With g samples left out at each end, h = n - 2 g,
    and s the standard deviation of all samples with those g set to the nearest one kept, the interval's half width is

        t_(h-1) s sqrt((n - 1) / (h (h - 1)))

    With fewer than two samples in the middle it is infinite. `within` are the lowest and the highest possible number,
    which limit it. Raises InvalidArgument for no samples, or numbers that are not finite.

    Source: Agarwal et al. 2021, arXiv:2108.13264 (rliable); the interval: Tukey and McLaughlin 1963, Sankhya A 25, 331.
    """
    from scipy.special import stdtrit

    x = np.sort(_samples("samples", samples))
    n, cut = len(x), len(x) // 4
    kept = n - 2 * cut
    mean = float(x[cut : n - cut].mean())
    if kept < 2:
        return Interval(mean, *within)
    spread = float(np.clip(x, x[cut], x[n - cut - 1]).std(ddof=1))
    half = float(stdtrit(kept - 1, (1 + CONFIDENCE) / 2)) * spread * math.sqrt((n - 1) / (kept * (kept - 1)))
    return Interval(mean, max(mean - half, within[0]), min(mean + half, within[1]))


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """Values of p corrected for the number of comparisons.

        p'_(i) = min(1, max_(j <= i) (m - j + 1) p_(j)),    p_(1) <= ... <= p_(m)

    `p` is that of each comparison, by name; one outside 0 to 1 raises InvalidArgument.

    Source: Holm 1979, Scandinavian Journal of Statistics 6, 65-70.
    """
    for name, value in p.items():
        if not 0 <= value <= 1:
            raise InvalidArgument(f"p: expected 0 to 1, got {value:g} for {name}")
    rising = sorted(p, key=lambda name: p[name])
    highest = np.maximum.accumulate([(len(p) - i) * p[name] for i, name in enumerate(rising)])
    corrected = dict(zip(rising, np.minimum(1.0, highest).tolist(), strict=True))
    return {name: corrected[name] for name in p}


def normalised_score(policy: float, random: float, optimum: float) -> float:
    """A policy's return on the scale from random to optimal: (policy - random) / (optimum - random).

    0 is as good as random and 1 the optimum (`animat.evaluation.optimum`), which a measured mean can exceed by chance.
    Raises InvalidArgument if the optimum is not above the random policy: nothing can be learned.
    """
    if not optimum > random:
        raise InvalidArgument(f"optimum: expected more than the random policy's {random:g}, got {optimum:g}")
    return (policy - random) / (optimum - random)


def standard_error(samples: Float64[np.ndarray, " samples"]) -> float:
    """The standard error of the mean; NaN for one sample."""
    return float(samples.std(ddof=1) / math.sqrt(len(samples))) if len(samples) > 1 else math.nan


def interval_of_mean(samples: Float64[np.ndarray, " samples"]) -> Interval:
    """The mean with its 95 % interval by Student's t; infinite for one sample."""
    from scipy.special import stdtrit

    mean, n = float(samples.mean()), len(samples)
    half = float(stdtrit(n - 1, (1 + CONFIDENCE) / 2) * samples.std(ddof=1) / math.sqrt(n)) if n > 1 else math.inf
    return Interval(mean, mean - half, mean + half)


def _samples(name: str, values: ArrayLike) -> Float64[np.ndarray, " samples"]:
    try:
        samples: Float64[np.ndarray, " samples"] = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise InvalidArgument(f"{name}: expected numbers, got {shown(values)}") from None
    if samples.ndim != 1 or not len(samples):
        raise InvalidArgument(f"{name}: expected one number per sample, at least one, got shape {samples.shape}")
    if not np.all(np.isfinite(samples)):
        raise InvalidArgument(f"{name}: expected finite numbers, got NaN or infinite ones")
    return samples


def _exact_p(a: Float64[np.ndarray, " n"], b: Float64[np.ndarray, " m"]) -> float:
    """The share of all ways to divide the pooled samples in which U is at least as far from its mean."""
    from scipy.stats import rankdata

    # scipy's exact test does not support ties, and its permutations take a second.
    # Counted by the sum of the smaller group's ranks; ranks are doubled, as those of ties may be halves.
    a, b = sorted((a, b), key=len)
    ranks = np.rint(2 * rankdata(np.concatenate([a, b]))).astype(np.int64)
    n = len(a)
    ways = np.zeros((n + 1, int(np.sort(ranks)[-n:].sum()) + 1))
    ways[0, 0] = 1.0
    for seen, rank in enumerate(ranks, start=1):
        for size in range(min(n, seen), 0, -1):
            ways[size, rank:] += ways[size - 1, :-rank]
    distance = np.abs(np.arange(ways.shape[1]) - n * (len(ranks) + 1))
    return float(ways[n, distance >= distance[ranks[:n].sum()]].sum() / ways[n].sum())


def _shares_within(share: float, n_first: int, n_second: int) -> tuple[float, float]:
    """The smallest and the largest true share of pairs won that are compatible with the observed share."""
    from scipy.optimize import brentq
    from scipy.special import ndtri

    z = float(ndtri((1 + CONFIDENCE) / 2))
    k = (n_first + n_second) / 2 - 1

    def against(true: float) -> float:
        spread = 1 + k * ((1 - true) / (2 - true) + true / (1 + true))
        return (share - true) ** 2 - z**2 * true * (1 - true) * spread / (n_first * n_second)

    # The variance is 0 at 0 and 1: the root there is not an end of the interval if 0 or 1 was observed.
    close = 1e-9
    low = 0.0 if share <= close else float(brentq(against, 0.0, share - close))
    high = 1.0 if share >= 1 - close else float(brentq(against, share + close, 1.0))
    return low, high


class EpisodeComparison(NamedTuple):
    """Episodes of policies compared with those of a control.

    Attributes:
        p: of the two-sided Mann-Whitney test (normal approximation).
        wins: share of pairs of episodes in which the policies' return is larger, ties half.
        policies, control: number of episodes.
        p_exact: of the same test, over all ways to divide the episodes; None if there are too many of them to count.
    """

    p: float
    wins: float
    policies: int
    control: int
    p_exact: float | None = None

    @property
    def p_best(self) -> float:
        """The exact p, or else the approximate one."""
        return self.p if self.p_exact is None else self.p_exact

    @property
    def is_outperformed(self) -> bool:
        """Whether the policies' returns are larger than the control's, in enough episodes to show it."""
        return self.p_best < OUTPERFORMED_P and self.wins > 0.5 and self.has_enough_episodes

    @property
    def has_enough_episodes(self) -> bool:
        """Whether this number of episodes could give a small p at all: if all of the policies' were larger."""
        return 2 / math.comb(self.policies + self.control, self.control) < OUTPERFORMED_P


def compare_episodes(policies: ArrayLike, control: ArrayLike) -> EpisodeComparison:
    """Compare the returns (at least one, any shape) of all policies together with those of a control, by episodes."""
    ours, theirs = _samples("policies", np.ravel(policies)), _samples("control", np.ravel(control))
    u, p = mann_whitney(ours, theirs)
    p_exact = _exact_p(ours, theirs) if len(ours) * len(theirs) <= _MOST_EPISODE_PAIRS else None
    return EpisodeComparison(p, u / len(ours) / len(theirs), len(ours), len(theirs), p_exact)


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
            f"{name} (p = {each.p_best:.2g}; {'they are worse: ' if is_worse(each.p_best, each.wins) else ''}their "
            f"return is larger in {100 * each.wins:.0f} % of the pairs of episodes, ties counting half)"
            for name, each in self.controls.items()
            if not each.is_outperformed and each.has_enough_episodes
        ]
        parts = []
        if not_outperformed:
            parts.append(f"these policies do not outperform {', '.join(not_outperformed)}")
        if few:
            fewest = min(few.values(), key=lambda each: each.control)
            episodes = f"{counted(fewest.policies, 'episode')} of the policies and {fewest.control} of a control"
            whether = f"(p < {OUTPERFORMED_P:g}) whether these policies outperform {', '.join(few)}"
            parts.append(f"{episodes} are too few to show {whether}")
        if not parts:
            least = min(each.wins for each in self.controls.values())
            parts.append(
                f"these policies outperform every control (p < {OUTPERFORMED_P:g}; their return is larger in at least "
                f"{math.floor(100 * least + 1e-9)} % of the pairs of episodes, ties counting half)"
            )
        return "; ".join(parts)
