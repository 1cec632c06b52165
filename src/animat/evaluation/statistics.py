"""Comparisons of policies by rank, their sizes and their intervals; and the score between random and the optimum."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from animat.errors import InvalidArgument

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """A number that samples gave, with an interval for what it stands for.

    Attributes:
        value: of the samples themselves.
        low, high: the interval's ends; infinite where the samples tell nothing of their spread.
        confidence: how often such intervals hold the true number, nearly.
    """

    value: float
    low: float
    high: float
    confidence: float

    def to_dict(self) -> dict[str, float]:
        """Everything as plain data."""
        return asdict(self)

    @property
    def ends(self) -> str:
        """From where to where it goes, for a table."""
        return f"{self.low:.1f} to {self.high:.1f}" if math.isfinite(self.low) else "unknown"


@dataclass(frozen=True)
class Comparison:
    """Two groups compared by rank, two-sided.

    Attributes:
        u: Mann-Whitney's U as the paper gives it, the smaller of `u_first` and n1 n2 - `u_first`.
        u_first: pairs in which the first group's is larger, ties half.
        n_first, n_second: samples of each.
        p_normal: by the normal approximation with continuity correction (and correction for ties): the paper's.
        p_exact: over all ways to part the samples as they are, ties among them.
        effect: rank-biserial correlation, share of pairs in which the second is larger less the share in which the
            first is, from -1 to 1, with its interval.
        ties: whether any two samples are equal.
    """

    u: float
    u_first: float
    n_first: int
    n_second: int
    p_normal: float
    p_exact: float
    effect: Interval
    ties: bool

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return asdict(self)


def compare(first: ArrayLike, second: ArrayLike) -> Comparison:
    """The two-sided Mann-Whitney U test of two groups, by the normal approximation and exactly, and its effect size.

        U_1 = #(first > second) + #(first = second) / 2,    U = min(U_1, n_1 n_2 - U_1),    effect = 1 - 2 U_1 / n_1 n_2

    The normal approximation takes 1/2 off the distance of U from its mean (continuity) and uses the standard deviation
    for tied ranks. If all samples are equal, p = 1. The effect's interval is Newcombe's (method 5): of all shares t of
    pairs won, those with (t' - t)^2 <= z^2 V(t), t' the share seen and

        V(t) = t (1 - t) (1 + k ((1 - t) / (2 - t) + t / (1 + t))) / n_1 n_2,    k = (n_1 + n_2) / 2 - 1

    As V is that of the share assumed, not of the one seen, the interval has a width where all pairs are won too: a
    bootstrap, which can only repeat what was seen, has none there.

    Args:
        first, second: one number a policy, such as its mean return.

    Raises:
        InvalidArgument: for an empty group, or numbers that are not finite.

    Source: Mann and Whitney 1947, doi:10.1214/aoms/1177730491; Newcombe 2006, doi:10.1002/sim.2324; the paper's table
        of comparisons.
    """
    a, b = _samples("first", first), _samples("second", second)
    from scipy.stats import mannwhitneyu

    u_first = float(np.sum(a[:, None] > b) + np.sum(a[:, None] == b) / 2)
    pooled = np.concatenate([a, b])
    ties = len(np.unique(pooled)) < len(pooled)
    if np.ptp(pooled) == 0:
        p_normal = p_exact = 1.0
    else:
        # scipy's can exceed 1 by its continuity correction where U is at its mean.
        p_normal = min(1.0, float(mannwhitneyu(a, b, alternative="two-sided", method="asymptotic").pvalue))
        p_exact = _exact_with_ties(a, b) if ties else float(mannwhitneyu(a, b, method="exact").pvalue)

    total = len(a) * len(b)
    low, high = (1 - 2 * share for share in _shares_within(u_first / total, len(a), len(b)))
    return Comparison(
        u=min(u_first, total - u_first),
        u_first=u_first,
        n_first=len(a),
        n_second=len(b),
        p_normal=p_normal,
        p_exact=p_exact,
        effect=Interval(1 - 2 * u_first / total, high, low, CONFIDENCE),
        ties=ties,
    )


def p_of_u(u: float, n_first: int, n_second: int) -> float:
    """The two-sided p that a U implies without ties, by the normal approximation with continuity correction.

        z = (|U - m| - 1/2) / s,    m = n_1 n_2 / 2,    s^2 = n_1 n_2 (n_1 + n_2 + 1) / 12,
        p = min(1, 2 (1 - Phi(z)))

    Raises:
        InvalidArgument: for a group of none, or a U that no groups of these sizes have.
    """
    if n_first < 1 or n_second < 1:
        raise InvalidArgument(f"n: expected at least 1 sample in each group, got {n_first} and {n_second}")
    total = n_first * n_second
    if not 0 <= u <= total:
        raise InvalidArgument(f"u: expected 0 to {total} for {n_first} and {n_second} samples, got {u:g}")
    from scipy.stats import norm

    z = (abs(u - total / 2) - 0.5) / np.sqrt(total * (n_first + n_second + 1) / 12)
    return float(min(1.0, 2 * norm.sf(z)))


def interquartile_mean(
    samples: ArrayLike, *, confidence: float = CONFIDENCE, within: tuple[float, float] = (-math.inf, math.inf)
) -> Interval:
    """The mean of the middle half of samples, with its interval by Student's t.

    A quarter of the samples, rounded down, is left out at each end. With g the samples left out at an end, h = n - 2 g,
    and s the standard deviation of all samples with those g set to the nearest one kept, the interval's half width is

        t_(h-1) s sqrt((n - 1) / (h (h - 1)))

    It holds what it should also for few samples, where a bootstrap of the middle ones is too narrow. With less than
    two samples in the middle it is infinite.

    Args:
        samples: numbers, shape (samples,).
        within: what the numbers can be at least and at most; the interval ends there.

    Raises:
        InvalidArgument: for no samples, numbers that are not finite, or a confidence outside 0 to 1.

    Source: Agarwal et al. 2021, arXiv:2108.13264 (rliable); the interval: Tukey and McLaughlin 1963, Sankhya A 25, 331.
    """
    x = np.sort(_samples("samples", samples))
    if not 0 < confidence < 1:
        raise InvalidArgument(f"confidence: expected between 0 and 1, got {confidence:g}")
    n = len(x)
    cut = n // 4
    kept = n - 2 * cut
    mean = float(x[cut : n - cut].mean())
    if kept < 2:
        return Interval(mean, *within, confidence)
    from scipy.stats import t

    spread = float(np.clip(x, x[cut], x[n - cut - 1]).std(ddof=1))
    half = float(t.ppf((1 + confidence) / 2, kept - 1)) * spread * math.sqrt((n - 1) / (kept * (kept - 1)))
    return Interval(mean, max(mean - half, within[0]), min(mean + half, within[1]), confidence)


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """Values of p corrected for how many comparisons were made: none is found by having asked often.

        p'_(i) = min(1, max_(j <= i) (m - j + 1) p_(j)),    p_(1) <= ... <= p_(m)

    Args:
        p: of each comparison, by name.

    Raises:
        InvalidArgument: for a p outside 0 to 1.

    Source: Holm 1979, Scandinavian Journal of Statistics 6, 65-70.
    """
    for name, value in p.items():
        if not 0 <= value <= 1:
            raise InvalidArgument(f"p: expected 0 to 1, got {value:g} for {name}")
    highest = 0.0
    corrected = {}
    for i, name in enumerate(sorted(p, key=lambda name: p[name])):
        highest = max(highest, min(1.0, (len(p) - i) * p[name]))
        corrected[name] = highest
    return {name: corrected[name] for name in p}


def normalised_score(policy: float, random: float, optimum: float) -> float:
    """How far a policy has come from a random one to the optimal return: (policy - random) / (optimum - random).

    0 is as good as random and 1 the optimum (`animat.evaluation.optimum`), which a measured mean can pass by chance.

    Raises:
        InvalidArgument: if the optimum is not above the random policy: nothing can be learned there.
    """
    if not optimum > random:
        raise InvalidArgument(
            f"optimum: expected more than the random policy's {random:g}, got {optimum:g}: every controller is as good"
        )
    return (policy - random) / (optimum - random)


def standard_error(samples: Float64[np.ndarray, " samples"]) -> float:
    """Of their mean; NaN of one."""
    return float(samples.std(ddof=1) / math.sqrt(len(samples))) if len(samples) > 1 else math.nan


def _samples(name: str, values: ArrayLike) -> Float64[np.ndarray, " samples"]:
    samples: Float64[np.ndarray, " samples"] = np.asarray(values, np.float64)
    if samples.ndim != 1 or not len(samples):
        raise InvalidArgument(f"{name}: expected one number a sample, at least one, got shape {samples.shape}")
    if not np.all(np.isfinite(samples)):
        raise InvalidArgument(f"{name}: expected finite numbers, got NaN or infinite ones")
    return samples


def _exact_with_ties(a: Float64[np.ndarray, " n"], b: Float64[np.ndarray, " m"]) -> float:
    """The share of all ways to part the pooled samples in which U lies at least as far from its mean.

    Ways are counted by the sum of the first group's ranks, sample by sample; ties share a rank, which may be a half,
    so ranks are doubled. (scipy's own exact test does not know ties, and its permutations take a second.)
    """
    from scipy.stats import rankdata

    ranks = np.rint(2 * rankdata(np.concatenate([a, b]))).astype(np.int64)
    n = len(a)
    ways = np.zeros((n + 1, int(ranks.sum()) + 1))
    ways[0, 0] = 1.0
    for seen, rank in enumerate(ranks, start=1):
        for size in range(min(n, seen), 0, -1):
            ways[size, rank:] += ways[size - 1, :-rank]
        ways /= 2.0  # Keeps the counts of large groups from overflowing; only their shares are used.
    distance = np.abs(np.arange(ways.shape[1]) - n * (len(ranks) + 1))
    return float(ways[n, distance >= distance[ranks[:n].sum()]].sum() / ways[n].sum())


def _shares_within(share: float, n_first: int, n_second: int) -> tuple[float, float]:
    """The smallest and the largest true share of pairs won that the share seen does not speak against."""
    from scipy.optimize import brentq
    from scipy.stats import norm

    z = float(norm.ppf((1 + CONFIDENCE) / 2))
    more = (n_first + n_second) / 2 - 1

    def against(true: float) -> float:
        spread = 1 + more * ((1 - true) / (2 - true) + true / (1 + true))
        return (share - true) ** 2 - z**2 * true * (1 - true) * spread / (n_first * n_second)

    # At 0 and 1 nothing varies: beside a share seen of 0 or 1 that is no end of the interval, but one of its zeros.
    close = 1e-9
    low = 0.0 if share <= close else float(brentq(against, 0.0, share - close))
    high = 1.0 if share >= 1 - close else float(brentq(against, share + close, 1.0))
    return low, high
