"""Simulators of several readouts: one draw for all of them, each with its own law, together with their dependence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from animat.coding.decoder import Decoder, decode
from animat.coding.mapping import Linear, Mapping, Thresholds
from animat.environment import Animat
from animat.errors import InvalidArgument, Mismatch
from animat.evaluation.commands import mean_commands
from animat.evaluation.controls import interventions_of
from animat.neurons.fidelity import fidelity
from animat.neurons.memory import Memory, fit_memory
from animat.neurons.simulator import NeuronSimulator, fit_histogram, silenced
from animat.neurons.timeline import fit_simulator, fit_timeline
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses
from animat.robots import Cartpole
from animat.stimulation.protocol import Presentation
from test_interventions import linear_networks
from test_simulator import responses_of
from two_wheels import Wheels

HALVES = Readouts(("left", "right"), ((1, 2), (3, 4)))
KINDS = ("histogram", "empirical", "memory")
N = 150


def of_halves(
    seed: int = 0, dependence: tuple[float, ...] = (0.6, -0.6, 0.0), counts: bool = False, start_min: float = 0.0
) -> Responses:
    """Gamma responses of two halves whose ranks correlate so much, one condition each; or counts with many ties."""
    rng = np.random.default_rng(seed)
    read = []
    for condition, rho in enumerate(dependence):
        uniforms = stats.norm.cdf(rng.multivariate_normal((0, 0), ((1, rho), (rho, 1)), N))
        laws = (
            [stats.poisson(1.5), stats.poisson(2.5)] if counts else [stats.gamma(4, scale=5), stats.gamma(6, scale=9)]
        )
        read.append(np.stack([law.ppf(u) + condition for law, u in zip(laws, uniforms.T, strict=True)], axis=1))
    every = np.concatenate(read)
    responses = responses_of(*(x.mean(axis=1) for x in read), start_min=start_min, presentation=Presentation("mixed"))
    return replace(responses, readouts=HALVES, readout_hz=every)


def drawn(simulator: NeuronSimulator, n: int = 4000) -> np.ndarray:
    """Responses at evenly spaced uniforms, shape (conditions, n, readouts)."""
    return np.asarray(_quantiles(simulator, (np.arange(n, dtype=np.float32) + 0.5) / n))


@jax.jit
def _quantiles(simulator: NeuronSimulator, uniforms: jax.Array) -> jax.Array:
    of_condition = jax.vmap(simulator.quantile, (None, 0))
    return jax.vmap(of_condition, (0, None))(jnp.arange(simulator.n_conditions), uniforms)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("counts", [False, True])
def test_draws_depend_on_each_other_as_the_responses_do(kind: str, counts: bool) -> None:
    """Spearman's correlation of the readouts, in the data and in the draws, condition by condition."""
    responses = of_halves(counts=counts)
    draws = drawn(fit_simulator(responses, kind=kind))
    assert draws.shape == (3, 4000, 2)
    for condition in range(3):
        of_data = stats.spearmanr(responses.read_of(condition)).statistic
        of_draws = stats.spearmanr(draws[condition]).statistic
        # Ties that are ranked at random part a little where a histogram spreads them over its bins.
        assert of_draws == pytest.approx(of_data, abs=0.1 if counts and kind == "histogram" else 0.02)
    # Drawn apart, each by a uniform of its own, they would be another culture.
    apart = np.stack([draws[0, :, 0], np.random.default_rng(0).permutation(draws[0, :, 1])], axis=1)
    assert abs(stats.spearmanr(apart).statistic) < 0.05


@pytest.mark.parametrize("counts", [False, True])
@pytest.mark.parametrize("range_hz", [None, 120.0])
def test_each_readout_of_a_histogram_has_the_law_of_its_own_histogram(counts: bool, range_hz: float | None) -> None:
    responses = of_halves(counts=counts)
    simulator = fit_simulator(responses, kind="histogram", range_hz=range_hz)
    draws = drawn(simulator, 3000)
    for d in range(2):
        alone = fit_histogram(responses.of_readout(d), range_hz=range_hz)
        np.testing.assert_array_equal(simulator.percentiles[d], alone.percentiles)
        # As many draws as are a whole number of each trial's: sorted they are the quantiles of the one histogram.
        np.testing.assert_allclose(np.sort(draws[:, :, d], axis=1), drawn(alone, 3000), atol=2e-2)


def test_an_empty_last_bin_is_never_drawn() -> None:
    simulator = fit_simulator(of_halves(), kind="histogram", range_hz=1000.0)
    every = jax.vmap(simulator.quantile, (None, 0))(jnp.int32(0), jnp.float32([0.0, 0.5, 1 - 2**-24]))
    assert np.all(np.isfinite(every))


@pytest.mark.parametrize("kind", ["empirical", "memory"])
def test_every_draw_is_a_recorded_trial_with_all_its_readouts(kind: str) -> None:
    responses = of_halves()
    simulator = fit_simulator(responses, kind=kind)
    for condition, of in enumerate(drawn(simulator)):
        known = {tuple(x) for x in responses.read_of(condition).astype(np.float32).tolist()}
        assert {tuple(x) for x in of.tolist()} == known


@pytest.mark.oracle
def test_memory_chooses_the_trial_that_it_would_with_one_readout() -> None:
    """The history is of all channels; a trial that is drawn only adds the responses of its readouts."""
    responses, memory = of_halves(), Memory(0.3, 0.5, 0.7)
    both = fit_memory(responses, memory=memory)
    one = fit_memory(replace(responses, readouts=Readouts(), readout_hz=None), memory=memory)
    for u, history in np.random.default_rng(0).random((50, 2), np.float32):
        here, there = (each.answer(jnp.int32(1), jnp.float32(u), jnp.float32([history, 0.5])) for each in (both, one))
        assert here.history.tolist() == there.history.tolist()
        # x of all channels is the mean of the halves.
        np.testing.assert_allclose(np.mean(here.rate_hz), there.rate_hz, rtol=1e-6)


def test_percentiles_and_shares_are_of_each_readout() -> None:
    responses = of_halves()
    for kind in KINDS:
        simulator = fit_simulator(responses, kind=kind)
        expected = [np.percentile(responses.read_hz[:, d], range(0, 101, 10)) for d in range(2)]
        np.testing.assert_allclose(simulator.percentiles, expected, rtol=1e-6)
        assert simulator.n_readouts == 2 and silenced(simulator).n_readouts == 2
        kept = fidelity(responses, simulator)
        for c in range(3):
            share = (responses.read_of(c) >= np.median(responses.read_hz, axis=0)).mean(axis=0)
            np.testing.assert_allclose(kept.in_data[c], share)
            # With memory, those whose histories are at the ends are neighbours less often.
            np.testing.assert_allclose(kept.in_simulator[c], share, atol=0.05 if kind == "memory" else 0.01)
        np.testing.assert_array_equal(drawn(silenced(simulator), 10), np.zeros((3, 10, 2)))


def test_what_a_range_loses_is_reported_with_its_readout() -> None:
    kept = fidelity(of_halves(), fit_simulator(of_halves(), kind="histogram", bins=2, range_hz=200.0))
    (finding,) = [each for each in kept.findings() if each.name == "binning"]
    assert " Hz on left from " in finding.message or " Hz on right from " in finding.message


def test_timelines_stack_them_and_refuse_others() -> None:
    series = [of_halves(seed, start_min=10.0 * seed) for seed in range(2)]
    for kind in KINDS:
        timeline = fit_timeline(series, kind=kind)  # type: ignore[arg-type]
        assert timeline.readouts == HALVES
        here, there = timeline.at(10.0), fit_simulator(series[1], kind=kind)
        np.testing.assert_array_equal(drawn(here, 100), drawn(there, 100))
        held = timeline.with_percentiles("first").at(10.0)
        np.testing.assert_array_equal(held.percentiles, timeline.at(0.0).percentiles)
    other = replace(series[1], readouts=replace(HALVES, names=("a", "b")))
    with pytest.raises(Mismatch, match="readouts: expected the same in all recordings, got left, right at 0 min and a"):
        fit_timeline([series[0], other])


@pytest.mark.parametrize("mapping", [Thresholds(1), Thresholds(9), Linear()])
def test_each_command_is_the_mapping_s_of_its_readout(mapping: Mapping) -> None:
    rng = np.random.default_rng(0)
    x = rng.gamma(4, 5, (7, 2)).astype(np.float32)
    percentiles = np.sort(rng.gamma(4, 5, (2, 11)), axis=1).astype(np.float32)
    commands = Decoder(mapping, HALVES).command(x, percentiles)
    of_jax = jax.jit(lambda x, p: decode(mapping, x, p))(x, percentiles)
    for d in range(2):
        np.testing.assert_array_equal(commands[:, d], mapping.command(x[:, d], percentiles[d]))
    np.testing.assert_allclose(of_jax, commands, atol=1e-6)
    assert Decoder(mapping, HALVES).percentiles_shape == (2, 11) and Decoder(mapping).percentiles_shape == (11,)
    assert decode(mapping, x[0, 0], percentiles[0]) == mapping.command(x[0, 0], percentiles[0])


@pytest.mark.oracle
def test_mean_commands_are_those_of_many_draws() -> None:
    simulator = fit_simulator(of_halves(), kind="histogram")
    environment = Animat(Wheels(), Thresholds(9), 3)
    actions, means = mean_commands(environment, simulator)
    keys = jax.random.split(jax.random.key(0), 4000)
    sample = jax.jit(jax.vmap(simulator.sample, (0, None)))
    for c in actions:
        x = sample(keys, jnp.int32(c))
        u: Any = decode(Thresholds(9), x, simulator.percentiles)
        np.testing.assert_allclose(means[c], u.mean(axis=0), atol=0.05)
    ideal = interventions_of(environment, simulator, linear_networks(np.zeros((1, 3))))[0].commands
    wanted = [np.interp(x, [x.min(), x.max()], [-1, 1]) for x in means.T]
    np.testing.assert_allclose(np.transpose(ideal), wanted, atol=1e-12)  # type: ignore[arg-type]
    assert isinstance(hash(ideal), int)


def test_an_animat_refuses_readouts_that_are_not_the_robot_s_commands() -> None:
    environment, simulator = Animat(Cartpole(), Thresholds(1), 3), fit_simulator(of_halves(), kind="empirical")
    with pytest.raises(InvalidArgument, match="readouts: expected 1, one for each command of cartpole, got 2"):
        environment.step(jax.random.key(0), environment.reset(jax.random.key(0)), jnp.int32(0), simulator)
