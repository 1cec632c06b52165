"""The figures that the virtual culture must hold, over seeds 1 to 5: behaviour that must emerge from the model.

The measuring is in `culture_figures.py`; about two minutes on one core, so it is marked.
"""

from __future__ import annotations

import numpy as np
import pytest

from culture_figures import Figures, measure, missed

pytestmark = pytest.mark.long

SEEDS = (1, 2, 3, 4, 5)
MISSED = {2: ["80 Hz right of 5 Hz at every bin edge"]}
"""By one response of a hundred: shown and explained in docs/virtual-culture.md."""
_measured: dict[int, Figures] = {}


def figures(seed: int) -> Figures:
    if seed not in _measured:
        _measured[seed] = measure(seed)
    return _measured[seed]


@pytest.mark.parametrize("seed", SEEDS)
def test_every_figure_of_a_seed_is_within_its_bounds_but_those_said_to_be_missed(seed: int) -> None:
    assert missed(figures(seed)) == MISSED.get(seed, [])


def test_medians_rise_with_frequency_in_blocks() -> None:
    means_hz = np.mean([figures(seed).medians_hz for seed in SEEDS], axis=0)
    assert np.all(np.diff(means_hz) > 0), means_hz


def test_medians_rise_with_frequency_when_frequencies_are_mixed() -> None:
    means_hz = np.mean([figures(seed).mixed_hz for seed in SEEDS], axis=0)
    assert np.all(np.diff(means_hz) > 0), means_hz
