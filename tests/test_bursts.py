"""Burst separation against scikit-image's Otsu on real data, an exhaustive search, and distributions of known shape."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.filters import threshold_otsu

from animat.errors import InvalidArgument
from animat.neurons.bursts import otsu_threshold, separability, separate_bursts


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
    separation = separate_bursts(ratio)
    assert separation.separability == pytest.approx(criterion(ratio, theirs) / ratio.var(), rel=1e-9)
    assert separation.separability > 0.9
    assert separation.valley > 0.95


@given(st.integers(1, 64), st.lists(st.integers(0, 64), min_size=1, max_size=60))
def test_no_cut_is_better(n_channels: int, active: list[int]) -> None:
    ratio = np.minimum(active, n_channels) / n_channels
    best = max(criterion(ratio, cut) for cut in np.unique(ratio))
    assert criterion(ratio, otsu_threshold(ratio)) == pytest.approx(best, rel=1e-9, abs=1e-12)


@given(st.lists(st.integers(0, 64), min_size=2, max_size=60), st.integers(1, 7), st.integers(-1000, 1000))
def test_the_cut_moves_with_the_values(values: list[int], scale: int, offset: int) -> None:
    plain = np.array(values, dtype=float)
    moved = plain * scale + offset
    assert criterion(moved, otsu_threshold(moved)) == pytest.approx(
        criterion(plain, otsu_threshold(plain)) * scale**2, rel=1e-9
    )


def test_by_hand() -> None:
    # Two groups, 0.1 0.1 0.2 and 0.8: share 1/4, means 0.4/3 and 0.8.
    separation = separate_bursts(np.array([0.1, 0.8, 0.1, 0.2]))
    assert separation.threshold == 0.2
    assert separation.is_burst.tolist() == [False, True, False, False]
    between = 3 / 16 * (0.8 - 0.4 / 3) ** 2
    assert separation.separability == pytest.approx(between / np.var([0.1, 0.8, 0.1, 0.2]))


def test_equal_ratios_hold_no_burst() -> None:
    separation = separate_bursts(np.full(20, 0.3))
    assert (separation.threshold, separation.separability, separation.valley) == (0.3, 0.0, 0.0)
    assert not separation.is_burst.any()


def test_two_values_are_perfectly_separable() -> None:
    assert separate_bursts(np.array([0.1] * 9 + [0.9])).separability == pytest.approx(1)


def test_nothing_and_one_response() -> None:
    assert math.isnan(separate_bursts(np.empty(0)).threshold)
    assert separate_bursts(np.empty(0)).separability == 0
    assert separate_bursts(np.array([0.4])).is_burst.tolist() == [False]


def test_a_given_threshold_is_used_and_one_keeps_everything() -> None:
    ratio = np.array([0.1, 0.5, 1.0])
    assert separate_bursts(ratio, 0.4).is_burst.tolist() == [False, True, True]
    kept = separate_bursts(ratio, 1.0)
    assert not kept.is_burst.any()
    assert kept.separability == 0


@pytest.mark.parametrize("threshold", [math.nan, -0.1, 1.5, math.inf])
def test_a_threshold_that_is_no_share_is_refused(threshold: float) -> None:
    with pytest.raises(InvalidArgument, match="burst_threshold: expected a share of channels from 0 to 1"):
        separate_bursts(np.array([0.1, 0.5]), threshold)


def test_one_hump_has_the_separability_of_theory_and_no_valley() -> None:
    rng = np.random.default_rng(0)
    bell, flat = rng.normal(size=40_000), rng.random(40_000)
    assert separate_bursts(bell).separability == pytest.approx(2 / math.pi, abs=0.01)
    assert separate_bursts(flat).separability == pytest.approx(3 / 4, abs=0.01)
    # On 500 responses of 100 channels, as many as a recording has.
    for _ in range(20):
        ratio = np.round(rng.normal(50, 10, 500)) / 100
        assert separate_bursts(ratio).valley < 0.5


def test_rare_bursts_show_by_the_valley_though_separability_is_that_of_a_bell() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        burst = rng.random(500) < 0.06
        ratio = np.round(np.where(burst, rng.normal(75, 8, 500), rng.normal(20, 8, 500)).clip(0, 100)) / 100
        separation = separate_bursts(ratio)
        assert separation.separability < 0.85
        assert separation.valley > 0.5


@given(st.lists(st.integers(0, 30), min_size=1, max_size=50), st.integers(0, 30))
def test_separability_and_valley_lie_in_0_to_1(values: list[int], threshold: int) -> None:
    ratio = np.array(values) / 30
    separation = separate_bursts(ratio, threshold / 30)
    assert 0 <= separation.separability <= 1 + 1e-12
    assert 0 <= separation.valley <= 1
    assert separability(ratio, ratio > 2) == 0
