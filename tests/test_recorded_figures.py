"""The virtual culture's figures through animat's own scan, electrodes, protocol and responses, over seeds 1 to 5.

The measuring is in `recorded_figures.py`. What takes hours of culture is held by the bare tissue, in
`test_virtual_culture.py`: one recording shows the rest.
"""

from __future__ import annotations

import numpy as np
import pytest

from recorded_figures import Recorded, measure

pytestmark = pytest.mark.long

SEEDS = (1, 2, 3, 4, 5)
OVER_HOURS = {"P(x > 18 Hz) left at most 0.4", "burst share falls"}
_measured: dict[int, Recorded] = {}


def figures(seed: int) -> Recorded:
    if seed not in _measured:
        _measured[seed] = measure(seed, recordings=1)
    return _measured[seed]


@pytest.mark.parametrize("seed", SEEDS)
def test_every_figure_of_a_seed_is_within_its_bounds(seed: int) -> None:
    assert set(figures(seed).missed()) <= OVER_HOURS


def test_medians_rise_with_frequency() -> None:
    assert np.all(np.diff(np.mean([figures(seed).medians_hz for seed in SEEDS], axis=0)) > 0)


def test_five_pulses_distinguish_frequencies_better_than_one() -> None:
    """Method, section 9: what pulses buy when frequencies are mixed."""
    apart = {
        name: np.mean([figures(seed).over_median[name][4] - figures(seed).over_median[name][0] for seed in SEEDS])
        for name in ("mixed, 1 pulse", "mixed, 5 pulses")
    }
    assert apart["mixed, 5 pulses"] > apart["mixed, 1 pulse"]
