"""Mappings, against tables written by hand, numpy against JAX, and their properties."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.coding.mapping import (
    REGISTRY,
    Linear,
    Thresholds,
    mapping_from_data,
    mapping_named,
    mapping_to_data,
    namespace_of,
)
from animat.errors import InvalidArgument

NAMES = REGISTRY.names()
PERCENTILES_HZ = np.array([2.0, 10, 14, 20, 27, 33, 38, 44, 51, 60, 95])

rates_hz = st.floats(0, 1000, allow_nan=False, width=32, allow_subnormal=False)
percentiles_hz = st.lists(rates_hz, min_size=11, max_size=11).map(lambda values: np.sort(np.array(values)))
mappings = st.sampled_from([mapping_named(name) for name in NAMES])

TEN_LEVELS = [
    # (response, command): below P10, inside each tenth, and on every threshold
    (0.0, -1.0),
    (2.0, -1.0),
    (9.999, -1.0),
    (10.0, -0.8),
    (13.0, -0.8),
    (14.0, -0.6),
    (19.0, -0.6),
    (20.0, -0.4),
    (26.0, -0.4),
    (27.0, -0.2),
    (32.999, -0.2),
    (33.0, 0.2),
    (37.0, 0.2),
    (38.0, 0.4),
    (43.0, 0.4),
    (44.0, 0.6),
    (50.0, 0.6),
    (51.0, 0.8),
    (59.0, 0.8),
    (60.0, 1.0),
    (95.0, 1.0),
    (500.0, 1.0),
]


def test_nine_thresholds_follow_the_table_written_by_hand() -> None:
    x, expected = (np.array(column) for column in zip(*TEN_LEVELS, strict=True))
    np.testing.assert_array_equal(Thresholds(9).command(x, PERCENTILES_HZ), expected)
    np.testing.assert_array_equal(
        jax.jit(Thresholds(9).command)(jnp.asarray(x), jnp.asarray(PERCENTILES_HZ)), expected.astype(np.float32)
    )


def test_nine_thresholds_give_ten_levels_without_zero() -> None:
    assert Thresholds(9).levels == (-1.0, -0.8, -0.6, -0.4, -0.2, 0.2, 0.4, 0.6, 0.8, 1.0)
    assert Thresholds(1).levels == (-1.0, 1.0)
    given_levels = Thresholds(9).command(np.linspace(0, 120, 1000), PERCENTILES_HZ)
    assert set(given_levels) == set(Thresholds(9).levels)


@pytest.mark.parametrize(("x", "u"), [(0.0, -1.0), (np.nextafter(33.0, 0), -1.0), (33.0, 1.0), (33.1, 1.0)])
def test_one_threshold_counts_the_median_as_above(x: float, u: float) -> None:
    assert Thresholds(1).command(x, PERCENTILES_HZ) == u
    assert Thresholds(1).command(np.float64(x), PERCENTILES_HZ) == u


@pytest.mark.parametrize(
    ("x", "u"), [(0.0, -1.0), (2.0, -1.0), (48.5, 0.0), (25.25, -0.5), (71.75, 0.5), (95.0, 1.0), (300.0, 1.0)]
)
def test_linear_follows_the_line_between_the_ends_and_is_clipped(x: float, u: float) -> None:
    assert Linear().command(x, PERCENTILES_HZ) == u
    assert jax.jit(Linear().command)(jnp.float32(x), jnp.asarray(PERCENTILES_HZ)) == u


@pytest.mark.parametrize("x", [0.0, 7.0, 40.0])
def test_linear_gives_zero_where_all_responses_are_equal(x: float) -> None:
    assert Linear().command(x, np.full(11, 7.0)) == 0.0
    assert Linear().command(jnp.float32(x), jnp.full(11, 7.0)) == 0.0


def test_tied_percentiles_are_passed_together() -> None:
    """A silent half: P0 to P50 all 0, as in a culture that mostly does not answer."""
    tied = np.array([0.0, 0, 0, 0, 0, 0, 5, 10, 15, 20, 30])
    assert Thresholds(1).command(0.0, tied) == 1.0
    assert Thresholds(9).command(0.0, tied) == 0.2
    assert Thresholds(9).command(4.0, tied) == 0.2
    assert Thresholds(9).command(5.0, tied) == 0.4
    assert Thresholds(9).command(-1.0, tied) == -1.0


@settings(deadline=None)  # the first example compiles
@given(mappings, percentiles_hz, st.lists(rates_hz, min_size=1, max_size=30))
def test_commands_never_fall_as_the_response_rises_and_stay_in_range(mapping, percentiles, values) -> None:
    u = mapping.command(np.sort(np.array(values)), percentiles)
    assert np.all(np.diff(u) >= 0)
    assert np.all(np.abs(u) <= 1)


@settings(deadline=None)  # the first example compiles
@given(mappings, percentiles_hz, st.lists(rates_hz, min_size=4, max_size=4))
def test_numpy_and_jax_agree(mapping, percentiles, values) -> None:
    x, percentiles = np.array(values, np.float32), percentiles.astype(np.float32)
    of_jax = mapping.command(jnp.asarray(x), jnp.asarray(percentiles))
    assert isinstance(of_jax, jax.Array)
    of_numpy = mapping.command(x, percentiles)
    assert isinstance(of_numpy, np.ndarray)
    assert of_numpy.shape == of_jax.shape == x.shape
    assert namespace_of(x, percentiles) is np and namespace_of(x, jnp.asarray(percentiles)) is jnp
    # Half a unit in the last place for the division; thresholds agree to the bit once both are float32.
    np.testing.assert_allclose(of_jax, of_numpy.astype(np.float32), atol=0 if mapping != Linear() else 1e-6)


@pytest.mark.oracle
@settings(deadline=None)  # the first example compiles
@given(percentiles_hz.filter(lambda p: len(set(p)) == 11), mappings)
def test_a_vmapped_mapping_is_the_mapping_of_each(percentiles, mapping) -> None:
    stacked = jnp.stack([jnp.asarray(percentiles, jnp.float32), jnp.asarray(percentiles * 2, jnp.float32)])
    x = jnp.asarray([percentiles[3], percentiles[8]], jnp.float32)
    together = jax.vmap(mapping.command)(x, stacked)
    np.testing.assert_array_equal(together, [mapping.command(x[i], stacked[i]) for i in range(2)])


def test_every_tenth_of_the_responses_gets_its_own_level() -> None:
    """On the data that the percentiles came from, each of ten levels is given equally often."""
    x = np.random.default_rng(0).gamma(6, 7, 10_000)
    levels, counts = np.unique(Thresholds(9).command(x, np.percentile(x, range(0, 101, 10))), return_counts=True)
    np.testing.assert_allclose(levels, Thresholds(9).levels)
    np.testing.assert_allclose(counts, 1000, atol=1)


@pytest.mark.parametrize("name", NAMES)
def test_names_give_the_mapping_back(name: str) -> None:
    assert mapping_named(name).name == name
    assert mapping_named(name) == mapping_named(name)
    # As the files of all commits have it.
    assert mapping_to_data(mapping_named(name)) == name and mapping_from_data(name) == mapping_named(name)
    assert len({mapping_named(other) for other in NAMES}) == len(NAMES)


@pytest.mark.parametrize("name", ["2-thresholds", "", None, ["linear"]])
def test_an_unknown_name_is_refused_with_the_known_ones(name: object) -> None:
    with pytest.raises(InvalidArgument, match=r"mapping: expected one of 1-threshold, 9-thresholds, linear, got"):
        mapping_named(name)  # type: ignore[arg-type]


@pytest.mark.parametrize("count", [0, 2, 10, -1, True])
def test_other_numbers_of_thresholds_are_refused(count: int) -> None:
    with pytest.raises(InvalidArgument, match="count: expected 1 or 9 thresholds, got"):
        Thresholds(count)


@pytest.mark.oracle
def test_robots_and_mappings_are_named_and_stored_without_jax() -> None:
    """A policy's file carries both as data; whoever runs a policy need not have JAX."""
    code = """
import sys
sys.modules["jax"] = None  # any import of it now fails
from animat.coding.mapping import mapping_named
from animat.robots import ROBOTS, robot_from_dict, robot_named, robot_to_dict
import numpy as np
for name in ROBOTS:
    robot = robot_named(name, episode_limit=7)
    assert robot_from_dict(robot_to_dict(robot)) == robot and robot.observation_spec and robot.caveats() is not None
assert mapping_named("9-thresholds").command(5.0, np.arange(11.0)) == 0.2
"""
    subprocess.run([sys.executable, "-c", code], check=True)
