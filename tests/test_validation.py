"""Validation against closed forms, and against plain loops and scipy over the same recordings."""

from __future__ import annotations

import itertools
import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from animat.cli import main
from animat.cultures.virtual import VirtualCulture
from animat.errors import InvalidArgument, UnusableData
from animat.neurons.history import NO_MEMORY, Memory, Ranked
from animat.neurons.memory import MemorySimulator, fit_memory
from animat.neurons.prediction import (
    LAGS,
    autocorrelation,
    free_runs,
    halved,
    predict,
    run_lengths,
    share_below,
    shares_lasting,
)
from animat.neurons.timeline import fit_simulator
from animat.neurons.validation import MARGINAL, Validation, correlations, validate
from animat.recordings.reading import read_recording
from animat.report.validation import draw_validation, validation_text
from animat.responses.conditions import conditions_named
from animat.responses.extraction import extract_responses
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses, Trials
from animat.stimulation.protocol import Presentation, Protocol
from synthetic_recordings import write_synthetic_series
from test_simulator import responses_of


def series(x: Any, condition: Any, n_conditions: int, **changes: Any) -> Responses:
    """Responses in the order of time, mixed."""
    columns = {
        "condition": np.asarray(condition),
        # In steps, as whole spikes make them.
        "rate_hz": np.round(np.asarray(x, np.float64), 1),
        "active_ratio": np.full(len(x), 0.1),
        "is_burst": np.zeros(len(x), bool),
        "presentation": Presentation("mixed"),
    }
    return replace(responses_of(*[[1.0]] * n_conditions), **(columns | changes))


@pytest.fixture(scope="module", autouse=True)
def few_free_runs() -> Iterator[None]:
    """Enough for a mean, and a fifth of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("animat.neurons.validation.FREE_RUNS", 40)
        yield


# --- closed forms ---------------------------------------------------------------------------------------------------

MEANS, SD = (20.0, 30.0, 40.0), 8.0


@pytest.fixture(scope="module")
def known() -> Validation:
    """Of responses that are normally distributed, independent, with three means."""
    rng = np.random.default_rng(3)
    condition = rng.integers(0, 3, 4_000)
    return validate(series(rng.normal(np.array(MEANS)[condition], SD), condition, 3))


def test_known_distributions_have_their_entropy_and_are_calibrated(known: Validation) -> None:
    def pooled(x: float) -> float:
        return float(np.mean(stats.norm.cdf(x, MEANS, SD)))

    grid = np.linspace(-20, 90, 200_001)
    deciles = np.interp(np.arange(1, 10) / 10, np.mean(stats.norm.cdf(grid[:, None], MEANS, SD), axis=1), grid)
    assert pooled(deciles[4]) == pytest.approx(0.5, abs=1e-4)
    edges = np.concatenate([[-np.inf], deciles, [np.inf]])
    shares = np.diff(stats.norm.cdf(edges[:, None], MEANS, SD), axis=0)
    entropy_bits = float(np.mean(stats.entropy(shares, base=2, axis=0)))
    # 2,000 held-out trials: two standard errors are 0.04 bits and 0.2 Hz.
    for kind in ("histogram", "empirical", "memory"):
        scores = known.of(kind)
        assert scores.bits.mean() == pytest.approx(-entropy_bits, abs=0.05)
        assert scores.crps_hz.mean() == pytest.approx(SD / np.sqrt(np.pi), abs=0.2)
        assert scores.distance < 0.04
        assert scores.p_value is None if kind == "memory" else scores.p_value is not None and scores.p_value > 0.05
        assert scores.autocorrelation.low[0] < 0 < scores.autocorrelation.high[0]
    assert known.of(MARGINAL).bits.mean() == pytest.approx(-np.log2(10), abs=0.01)
    # The information that the condition has about the command.
    gain = known.gain("empirical", MARGINAL)
    assert gain.value == pytest.approx(np.log2(10) - entropy_bits, abs=0.05)
    assert gain.is_certain
    assert not known.gain("memory", "empirical").is_certain
    assert known.run_length == pytest.approx(2.0, abs=0.15)
    assert known.verdict.startswith("Can be trusted: ")
    assert known.drift == pytest.approx(0.0, abs=0.02)


def autoregressive(rho: float, n: int, seed: int = 1) -> Responses:
    rng = np.random.default_rng(seed)
    z = np.zeros(n)
    for i in range(1, n):
        z[i] = rho * z[i - 1] + np.sqrt(1 - rho**2) * rng.normal()
    return series(50 + 10 * z, rng.integers(0, 2, n), 2)


@pytest.mark.oracle
def test_a_chain_with_memory_is_distinguished_from_one_without() -> None:
    rho = 0.7
    remembering = validate(autoregressive(rho, 3_000))
    # Of a command, from the response before it: deciles of a normal distribution, over 2,000 places of the last one.
    last = stats.norm.ppf((np.arange(2_000) + 0.5) / 2_000)
    edges = stats.norm.ppf(np.arange(11) / 10)[:, None]
    after = np.diff(stats.norm.cdf((edges - rho * last) / np.sqrt(1 - rho**2)), axis=0)
    information_bits = np.log2(10) - float(np.mean(stats.entropy(after, base=2, axis=0)))
    gain = remembering.gain("memory", "empirical")
    assert gain.is_certain
    assert 0.75 * information_bits < gain.value < information_bits + 2 * gain.error
    assert remembering.autocorrelation[:3] == pytest.approx(rho ** np.arange(1, 4), abs=0.07)
    memory, empirical = remembering.of("memory"), remembering.of("empirical")
    # Drawing among the nearest histories, not the very same one, loses some of it.
    assert 0.8 * rho < memory.autocorrelation.mean[0] < rho
    assert empirical.autocorrelation.mean[0] == pytest.approx(0.0, abs=0.03)
    # An orthant of the bivariate normal: how often a response passes the median after one that did.
    stays = 0.5 + np.arcsin(rho) / np.pi
    assert remembering.run_length == pytest.approx(1 / (1 - stays), rel=0.1)
    assert 2.6 < memory.run_length.mean < 1 / (1 - stays)
    assert empirical.run_length.mean == pytest.approx(2.0, rel=0.05)

    forgetting = validate(autoregressive(0.0, 2_000))
    assert not forgetting.gain("memory", "empirical").is_certain
    assert forgetting.of("memory").autocorrelation.mean[0] == pytest.approx(0.0, abs=0.03)
    assert forgetting.verdict.startswith("Cannot be trusted: knowing the condition is worth")


@pytest.mark.oracle
def test_chance_alone_makes_distances_of_ranks_within_conditions() -> None:
    def transforms(rng: np.random.Generator) -> Any:
        return [stats.percentileofscore(rng.normal(size=100), rng.normal(size=100)) / 100 for _ in range(2)]

    rng = np.random.default_rng(0)
    by_chance = [stats.kstest(np.concatenate(transforms(rng)), "uniform").statistic for _ in range(400)]
    p_values = []
    for seed in range(6):
        x = np.random.default_rng(seed).normal(50, 10, 400)
        empirical = validate(series(x, np.arange(400) % 2, 2)).of("empirical")
        p_values.append((empirical.p_value, np.mean(np.array(by_chance) >= empirical.distance)))
    ours, theirs = np.array(p_values).T
    assert np.abs(ours - theirs).max() < 0.1
    assert ours.min() > 0


@pytest.mark.oracle
def test_where_nothing_changed_p_values_are_as_often_small_as_they_should_be_with_ties_too() -> None:
    small = []
    for seed in range(60):
        x = np.random.default_rng(seed).poisson(2, 400).astype(float)
        p_value = validate(series(x, np.arange(400) % 2, 2)).of("empirical").p_value
        assert p_value is not None
        small.append(p_value <= 0.3)
    # Of 60, 18 with a standard deviation of 3.5; as if responses were never tied, 3.
    assert 8 <= sum(small) <= 28


def test_shares_below_are_those_of_the_formula() -> None:
    rng = np.random.default_rng(0)
    low = rng.integers(0, 20, 300) / 20
    transforms = np.stack([low, low + rng.integers(0, 3, 300) / 20], axis=1)
    at = np.linspace(0, 1, 101) + 1e-4
    width = np.maximum(transforms[:, 1] - low, 1e-12)
    expected = np.clip((at[:, None] - low) / width, 0, 1).mean(axis=1)
    np.testing.assert_allclose(share_below(transforms, at), expected, atol=1e-9)


# --- what decides ---------------------------------------------------------------------------------------------------


@pytest.mark.oracle
def test_what_the_verdict_says(known: Validation) -> None:
    rng = np.random.default_rng(5)
    condition = rng.integers(0, 2, 2_000)
    x = rng.normal(np.array([30.0, 60.0])[condition], 10)
    later = np.arange(2_000) >= 1_000
    little = validate(series(x - 3 * later, condition, 2))
    assert little.verdict.startswith("With care: the held-out distribution is off by up to 0.1")
    assert "as responses fell by 7 % meanwhile" in little.verdict
    # Of the simulators that predict better, the best is recommended.
    better_hz = {"empirical": 0.2, "memory": 0.1}
    scores = [replace(s, crps_hz=known.of("histogram").crps_hz - better_hz.get(s.kind, 0.0)) for s in known.scores[1:]]
    advised = replace(known, kind="histogram", scores=(known.scores[0], *scores))
    assert advised.verdict == "With care: the empirical simulator predicts better; train with --simulator empirical"
    large = validate(series(x - 12 * later, condition, 2))
    assert large.verdict.startswith("Cannot be trusted: the held-out distribution is off by up to 0.")
    assert large.drift == pytest.approx(np.sqrt(18 / 30 * 48 / 60) - 1, abs=0.03)
    blocked = validate(series(np.sort(x), np.sort(condition), 2, presentation=Presentation("blocked")))
    assert blocked.kind == "histogram"
    assert blocked.verdict.startswith("Cannot be trusted: conditions were presented in blocks")

    z = np.zeros(1_500)
    for i in range(1, len(z)):
        z[i] = 0.6 * z[i - 1] + 8 * rng.normal()
    condition = rng.integers(0, 2, len(z))
    chain = series(np.array([40.0, 60.0])[condition] + z, condition, 2)
    # The better kind is what a training takes; the other has no memory.
    assert validate(chain).verdict.startswith("Can be trusted")
    paper = validate(chain, kind="histogram")
    assert paper.kind == "histogram"
    assert paper.verdict.startswith("With care: successive responses correlate by 0.")
    with pytest.raises(InvalidArgument, match="kind: expected one of histogram, empirical, memory, got 'none'"):
        validate(chain, kind="none")


@pytest.mark.parametrize("share", [0.0, pytest.param(0.05, marks=pytest.mark.oracle)])
def test_a_culture_that_hardly_answers_is_not_trusted(share: float) -> None:
    rng = np.random.default_rng(6)
    v = validate(series(1.0 * (rng.random(1_000) < share), np.arange(1_000) % 2, 2))
    assert v.verdict.startswith("Cannot be trusted: knowing the condition is worth ")
    assert np.isnan(v.drift)
    assert "nan %" not in validation_text("still.npz", v)
    draw_validation("still.npz", v)


def test_blocks_are_parted_each() -> None:
    condition = np.repeat([0, 1], 60)
    halves = halved(series(np.arange(120), condition, 2, presentation=Presentation("blocked")))
    assert halves.rows.tolist() == [*range(30, 60), *range(90, 120)]
    mixed = halved(series(np.arange(120), np.arange(120) % 2, 2))
    assert mixed.rows.tolist() == list(range(60, 120))


def test_what_is_held_out_is_not_fitted_to() -> None:
    """Other responses in the second half, also to trials without a condition, leave every simulator as it is."""
    rng = np.random.default_rng(0)
    n = 400
    every = rng.integers(-1, 2, n)
    place = np.flatnonzero(every >= 0)
    x = rng.gamma(5.0, 10.0, n)
    time_s = np.cumsum(rng.uniform(0.05, 0.3, n))
    cut = place[len(place) // 2]
    others = np.where(np.arange(n) >= cut, rng.gamma(5.0, 30.0, n), x)

    def responses(x: np.ndarray) -> Responses:
        burst = np.zeros(n, bool)
        presented = Trials(every, x, burst, burst, time_s)
        return series(x[place], every[place], 2, presented=presented, place=place, time_s=time_s[place])

    for kind in ("histogram", "empirical", "memory"):
        one, other = (fit_simulator(halved(responses(each)).first, kind=kind) for each in (x, others))
        assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


@pytest.mark.parametrize(
    ("responses", "message"),
    [
        (series(np.arange(100), np.zeros(100, int), 1), "conditions: expected two or more, .* got 5 Hz; choose others"),
        (series([], np.zeros(0, int), 0), "conditions: expected two or more, .* got none"),
        (series(np.arange(60), np.arange(60) % 2, 2), "condition 5 Hz: expected 20 .* got 15 and 15; leave it out"),
    ],
)
def test_what_cannot_be_validated(responses: Responses, message: str) -> None:
    with pytest.raises(UnusableData, match=message):
        validate(responses)


# --- series ---------------------------------------------------------------------------------------------------------


@given(st.lists(st.none() | st.integers(0, 3), min_size=1, max_size=40))
def test_runs_and_correlations_are_those_of_plain_loops(x: list[int | None]) -> None:
    given = np.array([np.nan if each is None else each for each in x], np.float64)
    groups = itertools.groupby(x, lambda each: each is not None and each >= 2)
    lengths = [len(list(group)) for passes, group in groups if passes]
    assert run_lengths(given, 2).tolist() == lengths
    expected = [sum(n >= k for n in lengths) / len(lengths) if lengths else np.nan for k in range(1, LAGS + 1)]
    assert shares_lasting(np.array(lengths, int)) == pytest.approx(expected, nan_ok=True)
    there = [each for each in x if each is not None]
    if len(set(there)) < 2:
        return
    mean, variance = np.mean(there), np.var(there)
    found = autocorrelation(np.stack([given, given]))
    assert np.array_equal(found[0], found[1], equal_nan=True)
    for lag in range(1, LAGS + 1):
        pairs = [(a - mean) * (b - mean) for a, b in zip(x, x[lag:], strict=False) if a is not None and b is not None]
        assert found[0, lag - 1] == pytest.approx(np.mean(pairs) / variance if pairs else np.nan, nan_ok=True)


def test_where_no_memory_is_found_it_brings_nothing() -> None:
    """Both simulators draw from the same responses."""
    rng = np.random.default_rng(1)
    condition = rng.integers(0, 3, 300)
    responses = series(rng.gamma(6, 1 + 0.4 * condition), condition, 3)
    simulator = fit_simulator(halved(responses).first, kind="memory")
    assert isinstance(simulator, MemorySimulator) and simulator.memory == NO_MEMORY
    found = validate(responses)
    assert np.array_equal(found.of("memory").bits, found.of("empirical").bits)
    assert found.gain("memory", "empirical") == (0.0, 0.0)


@pytest.mark.parametrize(("weight", "silence"), [(0.5, 0.0), (-1.0, 0.5)])
def test_a_free_run_remembers_its_own_answers(weight: float, silence: float) -> None:
    """Trial by trial: what the simulator does not answer it is given, and a rest is forgotten over."""
    rng = np.random.default_rng(2)
    n = 300
    every = np.where(rng.random(n) < 0.1, -1, rng.integers(0, 2, n))
    x = np.zeros(n)
    for i in range(n):
        x[i] = np.round(40 + 0.6 * (x[i - 1] - 40) * (i > 0) + 5 * rng.normal(), 1)
    burst, rested = rng.random(n) < 0.05, rng.random(n) < 0.05
    time_s, place = np.cumsum(rng.uniform(0.05, 0.4, n)), np.flatnonzero(every >= 0)
    responses = series(
        x[place],
        every[place],
        2,
        is_burst=burst[place],
        presented=Trials(every, x, burst, rested, time_s),
        place=place,
        time_s=time_s[place],
    )
    halves = halved(responses)
    simulator = fit_memory(halves.first, memory=Memory(0.3, weight, 0.6, 1.0))
    ranked = Ranked(halves.first)
    (traces, left), loads = ranked.recorded(simulator.memory), ranked.loads(simulator.memory.load_s).every
    assert simulator.load_s > 0
    prediction, places = predict(simulator, halves), place[halves.rows]
    runs = free_runs(simulator, prediction, 3, np.random.default_rng(7))
    since = places[0]
    uniforms = np.random.default_rng(7).random((n - since, 3), np.float32)
    answer_at = jax.jit(simulator.answer_at)
    # What is predicted is what many draws after the recorded history come to.
    draws = jax.vmap(jax.vmap(simulator.answer_at, (None, 0, None, None)), (0, None, 0, 0))
    evenly = (np.arange(2000, dtype=np.float32) + 0.5) / 2000
    drawn_hz = np.asarray(draws(every[places], evenly, *(x[places].astype(np.float32) for x in (traces, loads)))[0])
    shares = np.stack([(drawn_hz == value).mean(axis=1) for value in halves.values_hz], axis=1)
    np.testing.assert_allclose(prediction.probability, shares, atol=2e-3)
    for k in range(3):
        trace, expected = traces[since], np.full(n, np.nan)
        for p in range(since, n):
            trace = silence if rested[p] else trace
            if p in places:
                expected[p], trace = answer_at(every[p], uniforms[p - since, k], jnp.float32(trace), loads[p])
            else:
                trace = 0.3 * trace + left[p]
            trace = 0.5 if burst[p] else trace
        assert np.array_equal(runs[k], expected, equal_nan=True)


# --- an independent computation ---------------------------------------------------------------------------------------


def by_hand(responses: Responses, kind: str, readout: int | None = None) -> dict[str, float]:
    """Log-likelihood, CRPS and calibration of one kind by plain loops over trials, lists of draws, and scipy."""
    n = len(responses)
    read_hz = responses.read_hz if readout is None else responses.read_hz[:, readout]
    rows = [(i, int(c), np.float32(x)) for i, (c, x) in enumerate(zip(responses.condition, read_hz, strict=True))]
    kept = [row for row in rows if not responses.is_burst[row[0]]]
    first = [row for row in kept if row[0] < n // 2]
    held = [row for row in kept if row[0] >= n // 2]
    every = sorted({float(x) for _, _, x in rows})
    cuts = [
        np.float32(np.percentile([float(r) for r in read_hz[[i for i, _, _ in first]]], q)) for q in range(10, 100, 10)
    ]

    command = {x: sum(x >= cut for cut in cuts) for x in every}

    def commands(weights: dict[float, float]) -> list[float]:
        shares = [0.0] * 10
        for x, weight in weights.items():
            shares[command[x]] += weight
        return shares

    def equally(drawn: list[float]) -> dict[float, float]:
        weights: dict[float, float] = {}
        for x in drawn:
            weights[x] = weights.get(x, 0.0) + 1 / len(drawn)
        return weights

    def binned(drawn: list[float], edges: np.ndarray) -> dict[float, float]:
        """Of every measured value the part of each bin that lies from it up to the next one."""
        counts = np.histogram(np.array(drawn, np.float32), edges)[0]
        weights = {}
        for x, following in zip(every, [*every[1:], np.inf], strict=True):
            parts = (
                count
                / len(drawn)
                * (max(0.0, min(following, b) - max(x, a)) / (b - a) if b > a else float(x <= a < following))
                for count, a, b in zip(counts.tolist(), edges.tolist(), edges[1:].tolist(), strict=False)
            )
            weights[x] = sum(parts)
        return weights

    everything = [float(x) for _, _, x in first]
    of_condition = {c: [float(x) for _, of, x in first if of == c] for c in range(len(responses.conditions))}
    edges = np.percentile(read_hz[[i for i, _, _ in first]], np.linspace(0, 100, 21)).astype(np.float32)
    coarse = [(len(everything) * p + 1) / (len(everything) + 10) for p in commands(equally(everything))]
    alike = {c: commands(equally(x)) for c, x in of_condition.items()}
    nearest = neighbours(responses, [i for i, _, _ in first], read_hz) if kind == "memory" else None
    remembers = fit_memory(halved(responses, readout).first).memory != NO_MEMORY
    known = {c: (len(x), binned(x, edges) if kind == "histogram" else equally(x)) for c, x in of_condition.items()}
    if kind == MARGINAL:
        known = dict.fromkeys(of_condition, (len(everything), equally(everything)))
    bits, scores, transforms = [], [], []
    for i, c, x in held:
        size, weights = known[c]
        if nearest is not None:
            drawn = nearest(i, c)
            size, weights = len(drawn), equally(drawn)
        prior = [0.1] * 10 if kind == MARGINAL else coarse
        if nearest is not None and remembers:
            m = len(of_condition[c])
            prior = [(m * p + 10 * q) / (m + 10) for p, q in zip(alike[c], coarse, strict=True)]
        k = command[float(x)]
        bits.append(np.log2((size * commands(weights)[k] + 10 * prior[k]) / (size + 10)))
        values, p = np.array(list(weights)), np.array(list(weights.values()))
        # The other form of the score: E|X - x| - E|X - X'| / 2.
        scores.append(p @ np.abs(values - x) - p @ np.abs(values[:, None] - values) @ p / 2)
        transforms.append((p[values < x].sum(), p[values <= x].sum()))
    at = np.linspace(0, 1, 1001)
    low, high = np.array(transforms).T
    below = np.mean([stats.uniform.cdf(at, a, max(b - a, 1e-12)) for a, b in zip(low, high, strict=True)], axis=0)
    return {"bits": np.mean(bits), "crps_hz": np.mean(scores), "distance": np.abs(below - at).max()}


def neighbours(responses: Responses, first: list[int], read_hz: np.ndarray) -> Callable[[int, int], list[float]]:
    """Which responses of the first half a simulator with memory draws from, its parameters given."""
    several = responses.read_hz.ndim == 2
    simulator = fit_simulator(halved(responses, 0 if several else None).first, kind="memory")
    assert isinstance(simulator, MemorySimulator)
    decay, weight, exponent, load_s = simulator.memory
    presented, place = responses.presentations
    among = responses.rate_hz[first]
    ranks = [stats.percentileofscore(among, x, kind="mean") / 100 for x in presented.rate_hz]
    of_first = [place[i] for i in first]
    means = [
        np.mean([ranks[p] for p in of_first if presented.condition[p] == c]) for c in range(len(responses.conditions))
    ]
    trace, load, traces, loads = 0.0, 0.0, [], []
    for p, c in enumerate(presented.condition):
        trace = 0.0 if presented.is_rested[p] else trace
        if load_s and presented.time_s is not None and p:
            load *= np.exp(-(presented.time_s[p] - presented.time_s[p - 1]) / load_s)
        traces.append(trace)
        loads.append(load)
        trace = (
            0.5
            if presented.is_burst[p]
            else decay * trace + (1 - decay) * (ranks[p] + weight * (means[c] if c >= 0 else 0.5)) / (1 + weight)
        )
        load += 1
    scale = 0.5 / np.mean(loads) if load_s else 0.0
    a, b = np.asarray(simulator.toward, np.float64).T
    expected = [[a[c] * traces[p] + b[c] * scale * loads[p] for p in range(len(ranks))] for c in range(len(means))]

    @cache
    def ordered(c: int) -> tuple[list[int], np.ndarray, np.ndarray]:
        rows = [k for k in first if responses.condition[k] == c and not np.isnan(responses.last_hz[k])]
        at = np.array([np.float32(expected[c][place[k]]) for k in rows])
        return rows, at, np.argsort(at, kind="stable")

    def drawn(i: int, c: int) -> list[float]:
        rows, at, order = ordered(c)
        here = np.float32(expected[c][place[i]])
        k = int(np.rint(len(rows) ** exponent))
        smaller, no_larger = int(np.sum(at < here)), int(np.sum(at <= here))
        start = min(max((smaller + no_larger - k) // 2, 0), len(rows) - k)
        start, end = min(start, smaller), max(start + k, no_larger)
        return [float(np.float32(read_hz[rows[row]])) for row in order[start:end]]

    return drawn


def check_by_hand(responses: Responses, readout: int | None = None) -> Validation:
    found = validate(responses, readout=readout)
    for kind in (MARGINAL, "histogram", "empirical", "memory"):
        scores, expected = found.of(kind), by_hand(responses, kind, readout)
        # Single precision may put one response on the other side of a history.
        loose = 1e-3 if kind == "memory" else 1e-5
        assert scores.bits.mean() == pytest.approx(expected["bits"], abs=loose)
        assert scores.crps_hz.mean() == pytest.approx(expected["crps_hz"], rel=loose)
        assert scores.distance == pytest.approx(expected["distance"], abs=loose)
    return found


@pytest.mark.oracle
@pytest.mark.parametrize(("window_ms", "drift"), [((2.0, 10.0), 0.0), ((3.0, 18.0), -0.1)])
def test_the_organoid_by_hand(real_data: Path, window_ms: tuple[float, float], drift: float) -> None:
    recording = read_recording(real_data / "organoid_cartpole_maxone.npz")
    found = check_by_hand(extract_responses(recording, conditions_named("interval:5,10+-25%"), window_ms))
    assert (found.n_fitted, found.n_held) == ((472, 106), (502, 77))
    assert found.verdict.startswith("Cannot be trusted: knowing the condition is worth 0.0")
    assert found.drift == pytest.approx(drift, abs=0.01)
    gain = found.gain("memory", "empirical")
    if drift:
        # What drifts in the first half looks like memory.
        assert gain.value < -2 * gain.error
    else:
        assert abs(gain.value) < 0.01


def test_readouts_are_correlated_over_the_conditions_in_which_both_vary() -> None:
    condition, read_hz = np.tile([0, 1], 100), np.random.default_rng(5).normal(50, 9, (200, 2))
    # One condition never reaches the left half.
    read_hz[condition == 0, 0] = 0.0
    readouts = Readouts(("left", "right"), ((1,), (2,)))
    responses = series(read_hz.mean(axis=1), condition, 2, readouts=readouts, readout_hz=read_hz)
    for found, rows in zip(correlations(responses), (slice(1, 100, 2), slice(101, 200, 2)), strict=True):
        assert found[0] == pytest.approx(stats.spearmanr(*read_hz[rows].T).statistic)
    still = replace(responses, readout_hz=np.ones_like(read_hz))
    assert np.isnan(correlations(still)).all()


@pytest.mark.oracle
def test_several_readouts_by_hand() -> None:
    """Each on its own, of simulators that answer for both; what they remember is of all channels."""
    rng = np.random.default_rng(4)
    condition = rng.integers(0, 2, 400)
    total = np.zeros(400)
    for i in range(400):
        total[i] = 0.5 * (total[i - 1] - 40) * (i > 0) + 40 + 15 * condition[i] + 6 * rng.normal()
    left = total / 2 + 4 * rng.normal(size=400)
    read_hz = np.round(np.stack([left, total - left], axis=1), 1)
    readouts = Readouts(("left", "right"), ((1,), (2,)))
    responses = series(total, condition, 2, readouts=readouts, readout_hz=read_hz)
    for readout in (0, 1):
        check_by_hand(responses, readout)
        # Of one readout alone there is a histogram of its own: the law that the joint one keeps.
        alone, among = validate(responses.of_readout(readout)), validate(responses, readout=readout)
        for kind in (MARGINAL, "histogram", "empirical"):
            assert np.array_equal(alone.of(kind).bits, among.of(kind).bits)
            assert np.array_equal(alone.of(kind).crps_hz, among.of(kind).crps_hz)
    for found, rows in zip(correlations(responses), (slice(0, 200), slice(200, 400)), strict=True):
        parts = [read_hz[rows][condition[rows] == c] for c in (0, 1)]
        each = [stats.spearmanr(part[:, 0], part[:, 1]).statistic for part in parts]
        assert found[0] == pytest.approx(np.average(each, weights=[len(part) for part in parts]))
    for asked in (None, 2):
        with pytest.raises(
            InvalidArgument, match=f"readout: expected one of 2 readouts, or None if there is only one, got {asked}"
        ):
            validate(responses, readout=asked)


@pytest.mark.oracle
@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5])
def test_virtual_cultures_by_hand(seed: int) -> None:
    with VirtualCulture(seed) as culture:
        recording = culture.record(Protocol(order="mixed", trials=120 if seed == 1 else 500), 0)
    found = check_by_hand(extract_responses(recording))
    assert found.gain("empirical", MARGINAL).is_certain
    if seed > 1:
        assert found.verdict.startswith("Can be trusted: ")
        assert found.gain("memory", "empirical", "crps_hz").is_certain


# --- the command ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Blocks, whose conditions differ."""
    folder = tmp_path_factory.mktemp("validated")
    write_synthetic_series(1, folder / "recordings", sessions=2, patterns=60, channels=64)
    return folder / "recordings"


@pytest.mark.oracle
def test_the_command(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["validate", str(recorded), "--out", str(tmp_path / "figures"), "--json"]
    assert main(given) == 0
    printed = capsys.readouterr().out
    recordings = json.loads(printed.splitlines()[-1], parse_constant=pytest.fail)["recordings"]
    assert [each["name"] for each in recordings] == ["recording_0000_min.nwb", "recording_0010_min.nwb"]
    for each in recordings:
        assert f"{each['name']}: {each['verdict']}" in printed
        assert each["verdict"].startswith("Cannot be trusted: conditions were presented in blocks")
        assert sum(each["simulators"]["histogram"]["pit"]) == pytest.approx(1)
        assert sum(each["n_fitted"]) + sum(each["n_held"]) > 250
        assert Path(each["figure"]).read_bytes().startswith(b"\x89PNG")
    explained = "".join(printed.splitlines()[-6:-1])
    for column in ("marginal", "recorded", "bits/trial", "CRPS", "off by", "p", "lag 1", "run length"):
        assert f"{column}: " in explained
    assert main(given) == 0
    assert capsys.readouterr().out == printed


def test_the_verdict_has_the_numbers_of_the_table(known: Validation) -> None:
    verdict, *table = validation_text("known.npz", known).splitlines()
    off, bits = re.findall(r"off by (0\.\d+) at most, .* worth (\S+ \+- \S+) bits", verdict)[0]
    assert any(line.split()[0] == "memory" and line.split()[3] == off for line in table if line.strip())
    assert any(f"conditions bring {bits} bits" in line for line in table)


def test_the_figure_names_its_axes(known: Validation) -> None:
    figure = draw_validation("known.npz", known)
    assert [axes.get_xlabel() for axes in figure.axes] == [
        "probability integral transform (-)",
        "lag (trials)",
        "run length (trials)",
    ]
    recorded = next(line for line in figure.axes[1].lines if line.get_label() == "recorded")
    assert np.array_equal(recorded.get_ydata(), known.autocorrelation)
    assert figure.axes[0].patches
    text = validation_text("known.npz", known)
    assert text.splitlines()[0] == f"known.npz: {known.verdict}"
    assert all(len(line) <= 120 for line in text.splitlines()[1:])


@pytest.mark.oracle
@pytest.mark.parametrize(
    "name",
    [
        "known.npz",
        "cost$_{a$.npz",
        "culture 12, day 42 in vitro, mixed, by the second operator, again.nwb",
    ],
)
def test_the_figure_has_the_whole_name_of_its_file(known: Validation, name: str) -> None:
    """Two dollar signs were a formula, which ended in a traceback, and long names were cut off at both ends."""
    figure = draw_validation(name, known)
    figure.canvas.draw()
    title = figure._suptitle  # type: ignore[attr-defined]
    within = title.get_window_extent()
    assert 0 <= within.x0 < within.x1 <= figure.bbox.width
    assert title.get_text().replace("\n", " ").startswith(f"{name}: ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--conditions", "all"], "conditions: expected two or more, so that there is something to predict from"),
        (
            ["--conditions", "frequency:5,7"],
            "condition 7 Hz: no stimulus whose response window lies in the recording; leave it out or choose other "
            "conditions (--conditions)",
        ),
        (["--seed", "-1"], "--seed: expected 0 or more, got -1"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_line(
    recorded: Path, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["validate", str(recorded / "recording_0000_min.nwb"), *options]) == 1
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert message in error[0]


def test_figures_of_one_name_are_refused(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "recording_0000_min.nwb"
    shutil.copy(recorded / other.name, other)
    assert main(["validate", str(recorded), str(other), "--out", str(tmp_path / "figures")]) == 1
    assert "--out: expected recordings with different names" in capsys.readouterr().err
    assert not list((tmp_path / "figures").glob("*"))


@pytest.mark.oracle
def test_readouts_are_scored_each(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, figures = recorded / "recording_0000_min.nwb", tmp_path / "figures"
    assert main(["validate", str(file), "--readouts", "halves", "--out", str(figures), "--json"]) == 0
    printed = capsys.readouterr().out
    recordings = json.loads(printed.splitlines()[-1])["recordings"]
    assert [each["name"] for each in recordings] == [f"{file.name}, left", f"{file.name}, right"]
    assert len(list(figures.glob("*.png"))) == 2
    assert "left, right: " in printed


@pytest.mark.oracle
def test_figures_are_in_the_folder_whatever_readouts_are_called(recorded: Path, tmp_path: Path) -> None:
    file, figures = recorded / "recording_0000_min.nwb", tmp_path / "figures"
    electrodes = read_recording(file).channels.electrode.tolist()
    groups = json.dumps({"../front/left": electrodes[:32], "right": electrodes[32:]})
    assert main(["validate", str(file), "--readouts", groups, "--out", str(figures)]) == 0
    stem = "recording_0000_min-validation"
    assert {each.name for each in tmp_path.rglob("*")} == {
        "figures",
        f"{stem}-..%2Ffront%2Fleft.png",
        f"{stem}-right.png",
    }


def test_a_recording_without_stimuli(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(
        tmp_path / "quiet.npz",
        spike_time_s=np.linspace(0, 60, 500),
        spike_channel=np.arange(500) % 8,
        stimulus_time_s=np.empty(0),
    )
    assert main(["validate", str(tmp_path / "quiet.npz")]) == 1
    (error,) = capsys.readouterr().err.strip().splitlines()
    assert "quiet.npz" in error
    assert "provide the stimulus times too" in error


def test_a_seed_below_0_is_refused() -> None:
    with pytest.raises(InvalidArgument, match=r"^seed: expected"):
        validate(autoregressive(0.0, 200), seed=-1)
