"""The synthetic simulator, against sampling from the gamma distributions it is made of."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.errors import InvalidArgument
from animat.neurons.synthetic import LABELS, MEANS_HZ, synthetic_simulator
from synthetic_recordings import SyntheticCulture


def test_percentiles_are_those_of_pooled_samples() -> None:
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.gamma(6, mean / 6, 200_000) for mean in MEANS_HZ])
    percentiles = np.asarray(synthetic_simulator().percentiles)
    np.testing.assert_allclose(percentiles[1:-1], np.percentile(x, range(10, 100, 10)), rtol=0.005)
    ends = np.percentile(x, [100 / 501, 100 * 500 / 501])
    np.testing.assert_allclose(percentiles[[0, -1]], ends, rtol=0.03)


@pytest.mark.parametrize("condition", range(5))
def test_responses_are_distributed_as_a_histogram_of_samples(condition: int) -> None:
    x = np.random.default_rng(condition).gamma(6, MEANS_HZ[condition] / 6, 200_000)
    expected = np.histogram(np.minimum(x, 120), 20, (0, 120))[0] / len(x)
    simulator = synthetic_simulator()
    np.testing.assert_allclose(np.diff(simulator.cumulative[condition]), expected, atol=0.004)
    draw = jax.vmap(simulator.sample, (0, None))
    drawn = draw(jax.random.split(jax.random.key(0), 50_000), jnp.int32(condition))
    np.testing.assert_allclose(np.histogram(drawn, 20, (0, 120))[0] / 50_000, expected, atol=0.01)
    passed = float(jnp.mean(drawn >= simulator.percentiles[5]))
    assert passed == pytest.approx([0.22, 0.38, 0.53, 0.64, 0.74][condition], abs=0.012)


def test_it_is_the_synthetic_culture_without_fatigue() -> None:
    """Both generators of the project mean the same conditions."""
    culture = SyntheticCulture(0)
    assert culture.means_hz == MEANS_HZ
    assert [f"{frequency_hz:g} Hz" for frequency_hz in culture.frequencies_hz] == list(LABELS)


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"means_hz": ()}, "means_hz"),
        ({"means_hz": (30.0, -1.0)}, "means_hz"),
        ({"means_hz": (30.0, float("nan"))}, "means_hz"),
        ({"shape": 0.0}, "shape"),
        ({"shape": 0.05}, "shape"),
    ],
)
def test_settings_without_meaning_are_refused(settings: dict, name: str) -> None:
    with pytest.raises(InvalidArgument, match=f"{name}: expected"):
        synthetic_simulator(**settings)
