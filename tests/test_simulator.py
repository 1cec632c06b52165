"""Neuron simulators against closed forms, numpy and scipy."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from animat.errors import InvalidArgument, Mismatch, UnusableData
from animat.neurons.fidelity import fidelity
from animat.neurons.simulator import fit_empirical, fit_histogram, silenced
from animat.neurons.synthetic import MEANS_HZ, synthetic_simulator
from animat.neurons.timeline import fit_timeline
from animat.responses.condition import Condition
from animat.responses.extraction import extract_series
from animat.responses.responses import Responses
from animat.stimulation.protocol import Presentation

FREQUENCIES = (5.0, 10.0, 20.0, 40.0, 80.0)


def responses_of(
    *values_hz: list[float] | np.ndarray, bursts_hz: tuple[float, ...] = (), start_min: float = 0.0, **changes: object
) -> Responses:
    """Responses with these values for each condition, and bursts of condition 0 beside them."""
    x = np.concatenate([np.asarray(v, float) for v in values_hz] + [np.asarray(bursts_hz, float)])
    condition = np.concatenate(
        [np.full(len(v), i) for i, v in enumerate(values_hz)] + [np.zeros(len(bursts_hz), int)]
    ).astype(int)
    is_burst = np.arange(len(x)) >= len(x) - len(bursts_hz)
    columns = {
        "condition": condition,
        "rate_hz": x,
        "active_ratio": np.where(is_burst, 0.9, 0.1),
        "is_burst": is_burst,
        "conditions": tuple(Condition(f"{f:g} Hz", f, "Hz") for f in FREQUENCIES[: len(values_hz)]),
        "window_ms": (2.0, 10.0),
        "n_channels": 100,
        "threshold": 0.5,
        "separability": 0.9,
        "presentation": Presentation("blocked"),
        "start_min": start_min,
    }
    return Responses(**(columns | changes))


def draw(simulator: object, condition: int, n: int = 20_000, seed: int = 0) -> np.ndarray:
    keys = jax.random.split(jax.random.key(seed), n)
    return np.asarray(jax.jit(jax.vmap(lambda key: simulator.sample(key, jnp.int32(condition))))(keys))  # type: ignore[attr-defined]


def test_a_histogram_draws_a_bin_then_uniformly_inside_it() -> None:
    rng = np.random.default_rng(0)
    values = rng.gamma(6.0, 5.0, (5, 200))
    responses = responses_of(*values)
    simulator = fit_histogram(responses, bins=20, range_hz=120.0)
    edges = np.linspace(0, 120, 21)
    for i, x in enumerate(values):
        # scipy's own histogram distribution is the independent implementation.
        known = stats.rv_histogram(np.histogram(x, edges), density=False)
        q = np.linspace(0.001, 0.999, 500)
        ours = jax.vmap(simulator.quantile, (None, 0))(jnp.int32(i), jnp.asarray(q))
        np.testing.assert_allclose(known.cdf(np.asarray(ours)), q, atol=2e-5)
        assert stats.kstest(draw(simulator, i), known.cdf).pvalue > 1e-4


@pytest.mark.oracle
@settings(max_examples=40, deadline=None)
@given(
    # In eighths of a Hz and few, so that many are equal and percentiles fall upon them.
    eighths=st.lists(st.lists(st.integers(0, 40), min_size=1, max_size=40), min_size=3, max_size=3),
    bins=st.sampled_from([10, 20, 40]),
)
def test_edges_at_percentiles_keep_every_share_that_a_threshold_asks_for(eighths: list[list[int]], bins: int) -> None:
    values = [np.array(x) / 8 for x in eighths]
    simulator = fit_histogram(responses_of(*values), bins=bins)
    q = (np.arange(2_000) + 0.5) / 2_000
    for i, x in enumerate(values):
        drawn = np.asarray(jax.vmap(simulator.quantile, (None, 0))(jnp.int32(i), jnp.asarray(q, jnp.float32)))
        for percentile in np.asarray(simulator.percentiles)[1:-1]:
            in_data = np.mean(x.astype(np.float32) >= percentile)
            assert np.mean(drawn >= percentile) == pytest.approx(in_data, abs=1 / 2_000)


def test_edges_follow_a_culture_whose_responses_fall() -> None:
    # Late responses, and one large outlier in them: seventy and ten Hz wide ranges would both be wrong.
    rng = np.random.default_rng(3)
    late = [0.2 * rng.gamma(6.0, mean / 6.0, 100) for mean in (30.0, 36.0, 42.0, 48.0, 54.0)]
    late[4][0] = 500.0
    simulator = fit_histogram(responses_of(*late))
    assert simulator.edges_hz.shape == (21,)
    np.testing.assert_allclose(simulator.edges_hz, np.percentile(np.concatenate(late), np.arange(0, 101, 5)), rtol=1e-6)


def test_percentiles_pool_the_non_burst_responses_of_all_conditions() -> None:
    a, b = np.arange(0.0, 50.0), np.arange(50.0, 101.0)
    simulator = fit_histogram(responses_of(a, b, bursts_hz=(500.0,)))
    np.testing.assert_allclose(simulator.percentiles, np.arange(0.0, 101.0, 10.0), atol=1e-5)


@pytest.mark.oracle
@settings(max_examples=50, deadline=None)
@given(
    # Without numbers below 1e-38, which no rate is and which JAX takes for 0.
    values=st.lists(
        st.lists(st.floats(0, 200, allow_subnormal=False, width=32), min_size=1, max_size=30), min_size=1, max_size=5
    ),
    uniform=st.floats(0, 1, exclude_max=True, width=32),
    bins=st.integers(1, 40),
)
def test_every_draw_lies_in_a_bin_that_holds_a_response(values: list[list[float]], uniform: float, bins: int) -> None:
    responses = responses_of(*values)
    simulator = fit_histogram(responses, bins=bins)
    edges = np.asarray(simulator.edges_hz, float)
    for i, x in enumerate(values):
        drawn = float(simulator.quantile(jnp.int32(i), jnp.float32(uniform)))
        slack = 1e-4 * edges[-1]
        filled = np.histogram(x, edges)[0] > 0
        assert any(edges[b] - slack <= drawn <= edges[b + 1] + slack for b in np.flatnonzero(filled))
        empirical = fit_empirical(responses)
        assert float(empirical.quantile(jnp.int32(i), jnp.float32(uniform))) in np.asarray(x, np.float32)


def test_the_empirical_simulator_draws_each_value_equally_often() -> None:
    values = [1.0, 2.0, 2.0, 7.0]
    simulator = fit_empirical(responses_of(values, [5.0]), room=9)
    drawn = draw(simulator, 0)
    counts = [np.count_nonzero(drawn == v) for v in (1.0, 2.0, 7.0)]
    assert stats.chisquare(counts, [5_000, 10_000, 5_000]).pvalue > 1e-4
    assert set(draw(simulator, 1, 100)) == {5.0}


def test_the_largest_uniform_draws_the_last_value() -> None:
    last = jnp.float32(np.nextafter(np.float32(1), np.float32(0)))
    values = np.arange(1.0, 4097.0)
    assert float(fit_empirical(responses_of(values)).quantile(jnp.int32(0), last)) == 4096.0
    assert float(fit_histogram(responses_of(values), bins=7).quantile(jnp.int32(0), last)) <= 4100.0


def test_responses_above_the_range_count_into_the_last_bin_and_are_reported() -> None:
    responses = responses_of([10.0] * 90 + [130.0] * 10)
    simulator = fit_histogram(responses, bins=20, range_hz=120.0)
    assert np.mean(draw(simulator, 0) >= 114.0) == pytest.approx(0.10, abs=0.01)
    kept = fidelity(responses, simulator)
    assert kept.n_above_range == 10
    found = {f.name: f for f in kept.findings()}
    assert found["above-range"].value == 10


def test_fidelity_is_what_binning_makes_of_the_share_above_the_median() -> None:
    # All responses share one 6 Hz bin; condition 1 always passes the pooled median, condition 0 never.
    responses = responses_of([30.5] * 50, [31.5] * 51)
    simulator = fit_histogram(responses, bins=20, range_hz=120.0)
    kept = fidelity(responses, simulator)
    np.testing.assert_allclose(kept.in_data, [0.0, 1.0])
    # Within the bin from 30 to 36, P(x >= 31.5) = 4.5 / 6 for both.
    np.testing.assert_allclose(kept.in_simulator, [0.75, 0.75], atol=1e-3)
    assert [f.name for f in kept.findings()] == ["binning"]
    assert "binning" in {f.name for f in fit_timeline([responses], kind="histogram", range_hz=120.0).findings}
    assert not fidelity(responses, fit_empirical(responses)).findings()


def test_silence_answers_zero_and_keeps_the_percentiles() -> None:
    simulator = fit_histogram(responses_of([10.0, 20.0], [30.0]))
    silent = silenced(simulator)
    assert silent.n_conditions == 2
    np.testing.assert_array_equal(draw(silent, 1, 100), np.zeros(100))
    np.testing.assert_array_equal(silent.percentiles, simulator.percentiles)


def test_a_timeline_answers_with_the_newest_recording() -> None:
    series = [responses_of([m + 1.0] * 9, [m + 2.0] * 9, start_min=m) for m in (20.0, 0.0, 10.0)]
    timeline = fit_timeline(series, kind="empirical")
    assert [timeline.row_at(m) for m in (-5.0, 0.0, 9.99, 10.0, 19.0, 20.0, 1000.0)] == [0, 0, 0, 1, 1, 2, 2]
    assert float(timeline.at(15.0).quantile(jnp.int32(1), jnp.float32(0.5))) == 12.0
    held = timeline.with_percentiles("first")
    np.testing.assert_array_equal(held.at(25.0).percentiles, timeline.at(0.0).percentiles)
    assert float(held.at(25.0).quantile(jnp.int32(0), jnp.float32(0.5))) == 21.0
    assert (timeline.with_percentiles("moving"), timeline.requested_row(0.0)) == (timeline, 0)
    for before in (-0.1, np.nan):
        with pytest.raises(InvalidArgument, match=r"at_min: expected .* started at 0 min"):
            timeline.requested_row(before)
    with pytest.raises(InvalidArgument, match="which: expected moving or first, got 'frist'"):
        timeline.with_percentiles("frist")


def test_a_timeline_lasts_one_usual_interval_longer_than_its_recordings() -> None:
    timeline = fit_timeline([responses_of([1.0])], kind="empirical")
    for minutes, span_min in (([5.0], 10.0), ([5.0, 12.0], 14.0), ([5.0, 6.0, 16.0, 50.0], 45.0 + 10.0)):
        assert replace(timeline, start_min=np.array(minutes)).span_min == span_min


def test_a_timelines_edges_are_each_recordings_own_unless_a_range_is_given() -> None:
    series = [responses_of([55.0] * 9, start_min=0.0), responses_of([155.0] * 9, start_min=10.0)]
    own, given = fit_timeline(series), fit_timeline(series, range_hz=120.0)
    assert [float(own.at(minute).edges_hz[-1]) for minute in (0.0, 10.0)] == [55.0, 155.0]
    assert [float(given.at(minute).edges_hz[-1]) for minute in (0.0, 10.0)] == [120.0, 120.0]
    assert [kept.n_above_range for kept in given.fidelities] == [0, 9]
    above = [f.message for f in given.findings if f.name == "above-range"]
    assert len(above) == 1
    assert above[0].startswith("at 10 min: ") and above[0].endswith(" last bin: 9")
    assert [[f.name for f in given.findings_at(minute)].count("above-range") for minute in (0.0, 10.0)] == [0, 1]


def test_a_refreshed_simulator_recompiles_nothing() -> None:
    timeline = fit_timeline([responses_of([m + 1.0] * 9, start_min=m) for m in (0.0, 10.0)])
    traced = []

    @jax.jit
    def answer(simulator: object) -> jax.Array:
        traced.append(1)
        return simulator.quantile(jnp.int32(0), jnp.float32(0.5))  # type: ignore[attr-defined, no-any-return]

    assert float(answer(timeline.at(0.0))) != float(answer(timeline.at(10.0)))
    assert len(traced) == 1


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: fit_histogram(responses_of([1.0], []), bins=3), UnusableData, "10 Hz"),
        (lambda: fit_histogram(responses_of([1.0]), bins=0), InvalidArgument, "bins"),
        (lambda: fit_histogram(responses_of([1.0]), bins=10**8), InvalidArgument, "bins: expected 1 to 10,000"),
        (lambda: fit_histogram(responses_of([1.0]), range_hz=-1.0), InvalidArgument, "range_hz"),
        (lambda: fit_histogram(responses_of([1.0]), range_hz=float("nan")), InvalidArgument, "range_hz"),
        (lambda: fit_empirical(responses_of([1.0, 2.0]), room=1), InvalidArgument, "room"),
        (lambda: fit_timeline([]), InvalidArgument, "series"),
        (
            lambda: fit_timeline("recordings"),  # type: ignore[arg-type]
            InvalidArgument,
            "series: expected a list of responses, as animat.extract_series returns, got 'recordings'",
        ),
        (lambda: fit_timeline(responses_of([1.0])), InvalidArgument, "series: expected a list of responses"),  # type: ignore[arg-type]
        (lambda: fit_timeline([3]), InvalidArgument, "series: expected a list of responses, .* got 3"),  # type: ignore[list-item]
        (
            lambda: extract_series("recordings"),  # type: ignore[arg-type]
            InvalidArgument,
            "recordings: expected a list of recordings, as animat.read_recordings returns, got 'recordings'",
        ),
        (lambda: extract_series(["recordings"]), InvalidArgument, "recordings: expected .* got 'recordings'"),  # type: ignore[list-item]
        (
            lambda: extract_series([], 5),
            InvalidArgument,
            "by: expected conditions, such as 'frequency:5,10', or None, got 5",
        ),  # type: ignore[arg-type]
        (lambda: fit_timeline([responses_of([1.0])], kind="gamma"), InvalidArgument, "kind"),  # type: ignore[arg-type]
        (lambda: fit_timeline([responses_of([1.0]), responses_of([1.0])]), Mismatch, "start_min"),
        (
            lambda: fit_timeline([responses_of([1.0]), responses_of([1.0], [2.0], start_min=10.0)]),
            Mismatch,
            "conditions",
        ),
        (
            lambda: fit_timeline(
                [responses_of([1.0]), responses_of([1.0], start_min=10.0, presentation=Presentation("mixed", 5))]
            ),
            Mismatch,
            "presentation",
        ),
    ],
)
def test_what_does_not_fit_is_refused_by_name(call: object, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call()  # type: ignore[operator]


def test_recordings_with_different_numbers_of_channels_are_reported() -> None:
    first, second = (responses_of([1.0, 2.0], start_min=minute) for minute in (0.0, 10.0))
    assert "other-channels" not in {finding.name for finding in fit_timeline([first, second]).findings}
    timeline = fit_timeline([first, replace(second, n_channels=1 + first.n_channels)])
    (found,) = (finding for finding in timeline.findings if finding.name == "other-channels")
    assert (found.severity, found.value) == ("warning", 1.0)
    assert f"have {first.n_channels} to {1 + first.n_channels} channels" in found.message


@pytest.mark.parametrize("bins", [4, 20, 100])
def test_tied_responses_are_drawn_as_they_are(bins: int) -> None:
    """Of few channels, of which many do not answer: as often 0, and of the same mean, as was recorded."""
    rng = np.random.default_rng(2)
    x_hz = [rng.poisson(rate, 1_000) / 0.48 for rate in (0.05, 0.5, 2.0)]
    simulator = fit_histogram(responses_of(*x_hz), bins=bins)
    edges_hz, evenly = np.asarray(simulator.edges_hz), jax.vmap(simulator.quantile, (None, 0))
    for condition, recorded_hz in enumerate(x_hz):
        drawn_hz = np.asarray(evenly(jnp.int32(condition), jnp.arange(10_000) / 10_000))
        for value_hz in np.unique(edges_hz[1:][np.diff(edges_hz) == 0]):
            share = np.mean(recorded_hz.astype(np.float32) == value_hz)
            assert np.mean(drawn_hz == value_hz) == pytest.approx(share, abs=2e-3)
    first = np.asarray(evenly(jnp.int32(0), jnp.arange(10_000) / 10_000))
    assert bins < 20 or first.mean() == pytest.approx(x_hz[0].mean(), abs=0.2)


@given(st.lists(st.integers(0, 6), min_size=40, max_size=60), st.integers(2, 20))
def test_without_equal_edges_responses_are_counted_as_numpy_counts_them(counts: list[int], bins: int) -> None:
    x_hz = np.array(counts, np.float64)
    simulator = fit_histogram(responses_of(x_hz, x_hz + 1), bins=bins, range_hz=8.0)
    expected = np.histogram(x_hz.astype(np.float32), np.linspace(0, 8, bins + 1).astype(np.float32))[0]
    np.testing.assert_allclose(np.diff(simulator.cumulative[0]), expected / len(x_hz), atol=1e-6)


@pytest.mark.parametrize("scale", [0.1, 1.0, 5.0])
def test_synthetic_responses_pass_thresholds_as_often_as_they_should_whatever_their_means(scale: float) -> None:
    means_hz = scale * np.array(MEANS_HZ)
    simulator = synthetic_simulator(means_hz.tolist())
    uniforms = (jnp.arange(4_000) + 0.5) / 4_000
    for condition, mean_hz in enumerate(means_hz):
        drawn_hz = np.asarray(jax.vmap(simulator.quantile, (None, 0))(jnp.int32(condition), uniforms))
        for threshold_hz in np.asarray(simulator.percentiles)[[1, 5, 9]]:
            share = stats.gamma.sf(threshold_hz, 6.0, scale=mean_hz / 6.0)
            assert np.mean(drawn_hz >= threshold_hz) == pytest.approx(share, abs=0.015)
