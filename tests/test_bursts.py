"""Burst separation against scikit-image's Otsu on real data, an exhaustive search, and distributions of known shape."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from skimage.filters import threshold_otsu

from animat.errors import InvalidArgument
from animat.responses.bursts import otsu_threshold, separability, separate_bursts


def criterion(values: np.ndarray, threshold: float) -> float:
    """Between-class variance of the cut at a threshold, from its definition."""
    upper, lower = values[values > threshold], values[values <= threshold]
    if not len(upper) or not len(lower):
        return 0.0
    share = len(upper) / len(values)
    return float(share * (1 - share) * (upper.mean() - lower.mean()) ** 2)


@pytest.mark.parametrize("culture", [0, 1, 3])
def test_agrees_with_scikit_image_on_a_real_culture(real_data: Path, culture: int) -> None:
    with np.load(real_data / "rat_cortical_64ch_responses.npz") as file:
        ratio = (file[f"culture{culture}_spikes_per_electrode"] > 0).mean(axis=1)
    centres, counts = np.unique(ratio, return_counts=True)
    theirs = threshold_otsu(hist=(counts, centres))
    ours = otsu_threshold(ratio)
    assert criterion(ratio, ours) == pytest.approx(criterion(ratio, theirs), rel=1e-9)
    assert ours == pytest.approx(theirs, rel=1e-9)
    # The two classes of these cultures are plain to see.
    separation = separate_bursts(ratio, n_channels=64)
    assert separation.separability == pytest.approx(criterion(ratio, theirs) / ratio.var(), rel=1e-9)
    assert separation.separability > 0.9
    assert separation.valley > 0.95
    assert separation.threshold == ours


@given(st.integers(1, 64), st.lists(st.integers(0, 64), min_size=1, max_size=60))
def test_no_cut_is_better(n_channels: int, active: list[int]) -> None:
    ratio = np.minimum(active, n_channels) / n_channels
    best = max(criterion(ratio, cut) for cut in np.unique(ratio))
    assert criterion(ratio, otsu_threshold(ratio)) == pytest.approx(best, rel=1e-9, abs=1e-12)


@given(st.integers(1, 12), st.lists(st.integers(0, 12), min_size=2, max_size=12))
@example(10, [2, 7, 7, 6, 6, 10, 5, 10, 8, 9])
def test_of_equally_good_cuts_the_first_is_taken(n_channels: int, active: list[int]) -> None:
    active = [min(each, n_channels) for each in active]

    def exact(cut: int) -> Fraction:
        upper, lower = [a for a in active if a > cut], [a for a in active if a <= cut]
        if not upper:
            return Fraction(0)
        return len(upper) * len(lower) * (Fraction(sum(upper), len(upper)) - Fraction(sum(lower), len(lower))) ** 2

    first = max(sorted(set(active)), key=exact)
    assert otsu_threshold(np.array(active) / n_channels) == first / n_channels


@given(st.lists(st.integers(0, 64), min_size=2, max_size=60), st.integers(1, 7), st.integers(-1000, 1000))
def test_the_cut_moves_with_the_values(values: list[int], scale: int, offset: int) -> None:
    plain = np.array(values, dtype=float)
    moved = plain * scale + offset
    assert criterion(moved, otsu_threshold(moved)) == pytest.approx(
        criterion(plain, otsu_threshold(plain)) * scale**2, rel=1e-9
    )


def test_by_hand() -> None:
    # Two groups, 0.1 0.1 0.2 and 0.8: share 1/4, means 0.4/3 and 0.8; five responses of the upper one.
    separation = separate_bursts(np.array([0.1, 0.8, 0.1, 0.2] * 5), n_channels=10)
    assert separation.threshold == 0.2
    assert separation.is_burst.tolist() == [False, True, False, False] * 5
    between = 3 / 16 * (0.8 - 0.4 / 3) ** 2
    assert separation.separability == pytest.approx(between / np.var([0.1, 0.8, 0.1, 0.2]))
    assert math.isnan(separation.rejected)


def test_equal_ratios_hold_no_burst() -> None:
    separation = separate_bursts(np.full(20, 0.3), n_channels=10)
    assert (separation.threshold, separation.separability, separation.valley) == (1.0, 0.0, 0.0)
    assert not separation.is_burst.any()


def test_two_values_are_perfectly_separable() -> None:
    assert separate_bursts(np.array([0.1] * 45 + [0.9] * 5), n_channels=10).separability == pytest.approx(1)


def test_fewer_than_five_are_no_group() -> None:
    for few, is_cut in ((4, False), (5, True)):
        for ratio in (np.array([0.1] * 45 + [0.9] * few), np.array([0.1] * few + [0.9] * 45)):
            separation = separate_bursts(ratio, n_channels=10)
            assert separation.is_burst.any() == is_cut
            assert (separation.threshold, separation.rejected) == pytest.approx(
                (0.1, math.nan) if is_cut else (1.0, 0.1), nan_ok=True
            )


def test_nothing_and_one_response() -> None:
    assert math.isnan(separate_bursts(np.empty(0), n_channels=10).threshold)
    assert separate_bursts(np.empty(0), n_channels=10).separability == 0
    assert separate_bursts(np.array([0.4]), n_channels=10).is_burst.tolist() == [False]


def test_a_given_threshold_is_used_and_one_keeps_everything() -> None:
    ratio = np.array([0.1, 0.5, 1.0])
    assert separate_bursts(ratio, 0.4, n_channels=10).is_burst.tolist() == [False, True, True]
    kept = separate_bursts(ratio, 1.0, n_channels=10)
    assert not kept.is_burst.any()
    # There are no two classes that could stand apart.
    assert math.isnan(kept.separability)


def of_one_peak(rng: np.random.Generator, n: int) -> Iterator[tuple[str, np.ndarray, int]]:
    """Ratios of active channels drawn from distributions of one peak, on arrays of all sizes."""

    def within(draw: Callable[[int], np.ndarray]) -> np.ndarray:
        """Drawn again where they are no shares; cut off at 1, they would have a second peak there."""
        x = np.concatenate([draw(4 * n) for _ in range(8)])
        return x[(x >= 0) & (x <= 1)][:n]

    for channels in (20, 64, 108, 256, 1024):
        for p in (0.02, 0.05, 0.2, 0.5, 0.8):
            yield f"binomial {p}", rng.binomial(channels, p, n) / channels, channels
        shares = {f"beta {a}, {b}": rng.beta(a, b, n) for a, b in BETAS}
        for median, width in LOGNORMALS:
            drawn = within(lambda m, median=median, width=width: median * np.exp(width * rng.normal(size=m)))
            shares[f"lognormal {median}, {width}"] = drawn
        shares["exponential"] = within(lambda m: rng.exponential(0.1, m))
        shares["gamma 0.7"] = within(lambda m: rng.gamma(0.7, 0.1, m))
        shares["gamma 3"] = within(lambda m: rng.gamma(3, 0.06, m))
        shares["t of 3"] = within(lambda m: 0.3 + 0.05 * rng.standard_t(3, m))
        for name, share in shares.items():
            yield name, rng.binomial(channels, share) / channels, channels


BETAS = ((1, 1), (2, 2), (2, 5), (1.2, 8), (5, 2), (0.9, 4), (1, 20), (3, 60), (2, 20))
LOGNORMALS = ((0.05, 0.5), (0.05, 1.0), (0.1, 0.8), (0.02, 1.2), (0.2, 0.6), (0.01, 1.5))


@pytest.mark.parametrize("n", [60, pytest.param(500, marks=pytest.mark.oracle)])
def test_what_has_one_peak_is_hardly_ever_cut(n: int) -> None:
    rng = np.random.default_rng(n)
    cut: dict[str, list[float]] = {}
    for _ in range(8):
        for name, ratio, channels in of_one_peak(rng, n):
            is_burst = separate_bursts(ratio, n_channels=channels).is_burst
            cut.setdefault(name, []).append(float(is_burst.mean()))
    shares = np.concatenate(list(cut.values()))
    assert np.mean(shares > 0) < 0.05
    # What was found: of the responses of one peak, half were dropped. Where any are now, it is a long tail.
    assert np.mean(shares > 0.1) < 0.01
    tails = [name for name, of in cut.items() if np.mean(np.array(of) > 0) > 0.03]
    assert all(name.startswith("lognormal") for name in tails), tails
    assert np.mean(shares) < 0.002


def test_bursts_that_stand_apart_are_found() -> None:
    rng = np.random.default_rng(3)
    for share in (0.02, 0.1, 0.5):
        for n in (300, 1500):
            for _ in range(10):
                burst = rng.random(n) < share
                active = np.where(burst, rng.normal(70, 8, n), rng.normal(20, 6, n)).clip(0, 100)
                found = separate_bursts(np.round(active) / 100, n_channels=100).is_burst
                assert found.any() == (burst.sum() >= 5)
                assert not found.any() or np.mean(found == burst) > 0.99


@pytest.mark.parametrize("threshold", [math.nan, -0.1, 1.5, math.inf])
def test_a_threshold_that_is_no_share_is_refused(threshold: float) -> None:
    with pytest.raises(InvalidArgument, match="burst_threshold: expected a share of channels from 0 to 1"):
        separate_bursts(np.array([0.1, 0.5]), threshold, n_channels=10)


@pytest.mark.oracle
def test_one_hump_has_the_separability_of_theory_and_no_valley() -> None:
    rng = np.random.default_rng(0)
    bell, flat = rng.normal(size=40_000), rng.random(40_000)
    assert separate_bursts(bell, n_channels=1000).separability == pytest.approx(2 / math.pi, abs=0.01)
    assert separate_bursts(flat, n_channels=1000).separability == pytest.approx(3 / 4, abs=0.01)
    # On 500 responses of 100 channels, as many as a recording has.
    for _ in range(20):
        ratio = np.round(rng.normal(50, 10, 500)) / 100
        assert separate_bursts(ratio, n_channels=100).valley < 0.5


def test_rare_bursts_show_by_the_valley_though_separability_is_that_of_a_bell() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        burst = rng.random(500) < 0.06
        ratio = np.round(np.where(burst, rng.normal(75, 8, 500), rng.normal(20, 8, 500)).clip(0, 100)) / 100
        separation = separate_bursts(ratio, n_channels=100)
        assert separation.separability < 0.85
        assert separation.valley > 0.5


@given(st.lists(st.integers(0, 30), min_size=1, max_size=50), st.integers(0, 30))
def test_separability_and_valley_lie_in_0_to_1(values: list[int], threshold: int) -> None:
    ratio = np.array(values) / 30
    separation = separate_bursts(ratio, threshold / 30, n_channels=30)
    one_class = separation.is_burst.all() or not separation.is_burst.any()
    assert math.isnan(separation.separability) if one_class else 0 <= separation.separability <= 1 + 1e-12
    assert 0 <= separation.valley <= 1
    assert separability(ratio, ratio > 2) == 0
