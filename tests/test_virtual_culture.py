"""The figures that the virtual culture must hold, over seeds 1 to 5: behaviour that must emerge from the model.

The measuring is in `culture_figures.py`; about half an hour on one core, so it is marked.
"""

from __future__ import annotations

import numpy as np
import pytest

from culture_figures import Figures, measure, missed
from culture_hours import FIRST_MIN, over_hours

pytestmark = pytest.mark.long

SEEDS = (1, 2, 3, 4, 5)
SHARE, RIGHT = "burst share falls", "80 Hz right of 5 Hz at every bin edge"
MISSED = {
    1: ["non-burst share 0.9 or more at every frequency", "NMDA off: ratio under 1.1"],
    2: ["2-15 network bursts a minute of 100-800 ms", SHARE],
    3: [RIGHT, SHARE],
    4: [RIGHT, SHARE],
    5: ["80/5 ratio 1.6-3", SHARE],
}
"""Shown, and explained as far as it is, in docs/virtual-culture.md."""
_measured: dict[int, Figures] = {}


def figures(seed: int) -> Figures:
    if seed not in _measured:
        _measured[seed] = measure(seed)
    return _measured[seed]


@pytest.mark.parametrize("seed", SEEDS)
def test_every_figure_of_a_seed_is_within_its_bounds_but_those_said_to_be_missed(seed: int) -> None:
    assert missed(figures(seed)) == MISSED[seed]


@pytest.mark.parametrize("seed", SEEDS)
def test_spontaneous_activity_holds_its_bounds_over_three_hours(seed: int) -> None:
    assert [row.missed() for row in over_hours(seed)] == [[]] * len(FIRST_MIN)


@pytest.mark.xfail(strict=True, reason="seed means fall from 40 to 80 Hz: docs/virtual-culture.md")
def test_medians_rise_with_frequency_in_blocks() -> None:
    means_hz = np.mean([figures(seed).medians_hz for seed in SEEDS], axis=0)
    assert np.all(np.diff(means_hz) > 0), means_hz


def test_medians_rise_with_frequency_when_frequencies_are_mixed() -> None:
    means_hz = np.mean([figures(seed).mixed_hz for seed in SEEDS], axis=0)
    assert np.all(np.diff(means_hz) > 0), means_hz
