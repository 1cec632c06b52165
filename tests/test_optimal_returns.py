"""What a culture could achieve, before training. Oracles: the optimum, and separate runs of constants and random."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

from animat.cli import main
from animat.coding.mapping import Thresholds
from animat.environment import Animat
from animat.errors import InvalidArgument, UnusableData
from animat.evaluation.optimal_returns import WellSampled, _coarse, optimal_returns
from animat.evaluation.optimum import Optimum, best_return, optimal_values
from animat.evaluation.rollouts import Constant, Uniform, roll_out
from animat.neurons.simulator import fit_histogram
from animat.neurons.timeline import fit_timeline
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from animat.responses.condition import Condition
from animat.responses.conditions import NO_CONDITION
from animat.responses.extraction import extract_responses
from animat.responses.responses import Responses
from animat.robots import Cartpole
from animat.robots.grid import grid_for
from animat.wrappers import ShuffledDelivery
from synthetic_recordings import synthetic_recording

ROBOT = Cartpole(episode_limit=60)


@pytest.mark.oracle
def test_it_is_the_optimum_of_the_default_simulator_above_random_and_constant_stimuli() -> None:
    responses = extract_responses(synthetic_recording(1, patterns=40, channels=64))
    (found,) = optimal_returns(responses, ROBOT, [Thresholds(9)], resolution=0.25, resamples=0)
    simulator = fit_histogram(responses)
    environment = Animat(ROBOT, Thresholds(9), 5)
    assert (found.robot, found.mapping) == ("cartpole", "9-thresholds")
    assert found.best == best_return(environment, simulator, resolution=0.25, episodes=1000)
    random = roll_out(environment, simulator, Uniform(), episodes=4000, seed=9).returns
    assert abs(found.random - random.mean()) < 4 * found.random_standard_error * 1.2
    for i in (0, 4):
        constant = roll_out(environment, simulator, Constant(jnp.array([i])), episodes=300, seed=2).returns
        assert constant.mean() < found.best.value
    assert "cartpole, 9-thresholds: random -" in found.to_text()
    json.dumps(found.to_dict())


@pytest.mark.oracle
def test_inspect_reports_the_optimum(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    coarse = partial(optimal_returns, resolution=0.25, episodes=20, resamples=4)
    monkeypatch.setattr("animat.evaluation.optimal_returns.optimal_returns", coarse)
    write_nwb(synthetic_recording(1, patterns=40, channels=64), tmp_path / "a.nwb")
    assert main(["inspect", str(tmp_path / "a.nwb"), "--optimum", "cartpole", "--json"]) == 0
    said = capsys.readouterr().out.splitlines()
    (inspected,) = json.loads(said[-1])["recordings"]
    assert [optimum["mapping"] for optimum in inspected["optima"]] == ["1-threshold", "9-thresholds"]
    one = inspected["optima"][0]
    simulator = fit_histogram(extract_responses(read_recording(tmp_path / "a.nwb")))
    direct = best_return(Animat(Cartpole(), Thresholds(1), 5), simulator, resolution=0.25, episodes=0)
    assert one["best"]["value"] == pytest.approx(direct.value, abs=0.5)
    assert one["best"]["interval"]["low"] <= one["best"]["value"] <= one["best"]["interval"]["high"]
    line = next(line for line in said if "1-threshold: random" in line)
    assert f"optimal return {one['best']['value']:.1f}" in line
    assert any("on a histogram of these responses, without memory: " in line for line in said)


def test_a_missing_optimum_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_nwb(synthetic_recording(1, patterns=5, channels=16), tmp_path / "a.nwb")
    command = ["inspect", str(tmp_path / "a.nwb"), "--conditions", "frequency:5,7", "--optimum", "navigation", "--json"]
    assert main(command) == 1
    said = capsys.readouterr().out
    assert "navigation: no optimal return: " in said
    assert json.loads(said.splitlines()[-1])["recordings"][0]["optima"] is None


def test_an_unknown_robot_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "a.nwb", "--optimum", "submarine"]) != 0
    assert "submarine" in capsys.readouterr().err


# Returns of up to 24 iterations: many optima in a second.
SHORT = Cartpole(episode_limit=24)
SPREAD = (0.5, 0.8, 1.0, 1.25, 2.0)
"""Of the medians of five conditions."""


def answers(n: Sequence[int], seed: int, spread: Sequence[float] = SPREAD) -> Responses:
    """n responses to each condition, drawn from gamma distributions of different scales."""
    rng = np.random.default_rng(seed)
    condition = np.repeat(np.arange(len(n)), n)
    return Responses(
        condition=condition,
        rate_hz=rng.gamma(3.0, 5.0, len(condition)) * np.array(spread)[condition],
        active_ratio=np.full(len(condition), 0.1),
        is_burst=np.zeros(len(condition), bool),
        conditions=tuple(Condition(f"{f} Hz", f, "Hz") for f in (5, 10, 20, 40, 80)[: len(n)]),
        window_ms=(2.0, 10.0),
        n_channels=1024,
        threshold=1.0,
        separability=0.5,
    )


@pytest.mark.oracle
def test_a_surpassed_optimum_has_no_context_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    low = Optimum(-60.0, 1.0, 50.0, 2.0, 40.0, 2.0, 100, 10)
    for name, stand_in in {
        "best_returns": lambda *_, **__: [low, replace(low, value=70.0)],
        "best_coupling": lambda *_, **__: Uniform(),
    }.items():
        monkeypatch.setattr(f"animat.evaluation.optimal_returns.{name}", stand_in)
    monkeypatch.setattr(WellSampled, "with_interval", lambda self, best, **_: best)
    surpassed, sound = optimal_returns(answers([60] * 5, 1), Cartpole(), episodes=20)
    assert surpassed.context is None is surpassed.to_dict()["context"]
    assert surpassed.to_text().endswith("; no context gap, as its controller surpasses it")
    assert sound.context is not None and "context gap" in sound.to_text()


def test_three_responses_promise_nothing() -> None:
    with pytest.raises(UnusableData, match="expected at least 30 non-burst ones to some condition, got at most 3"):
        optimal_returns(answers([3] * 5, 1), SHORT)


@pytest.mark.oracle
def test_a_condition_of_few_responses_is_left_out_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.evaluation.coupling.GENERATIONS", 60)
    responses = answers([60, 60, 60, 60, 3], 2)
    # The three responses to 80 Hz are lucky: taken at face value, they would make the best condition.
    lucky = replace(responses, rate_hz=np.where(responses.condition == 4, 1000.0, responses.rate_hz))
    parts: list[float] = []
    progress = SimpleNamespace(update=lambda done, total, note="": parts.append(done / total))
    few = {"resolution": 0.25, "episodes": 2, "resamples": 3}
    (found,) = optimal_returns(lucky, SHORT, [Thresholds(1)], progress=progress, **few)  # type: ignore[arg-type]
    # Every iteration of each grid, and every generation of the search, which may end early.
    assert parts == sorted(parts) and len(parts) > 3 * 24 + 60 and 2 / 3 < parts[-1] <= 1
    # Of the four others, at the median of all responses, which is the threshold of commands.
    without = fit_histogram(lucky.only([0, 1, 2, 3]))
    held = replace(without, percentiles=jnp.asarray(np.percentile(lucky.rate_hz, np.arange(0, 101, 10)), jnp.float32))
    plain = best_return(Animat(SHORT, Thresholds(1), 4), held, resolution=0.25, episodes=2)
    assert found.best.left_out == ("80 Hz (3)",)
    assert "too few responses to count: 80 Hz (3)" in found.to_text()
    assert replace(found.best, left_out=(), interval=None) == plain
    assert best_return(Animat(SHORT, Thresholds(1), 4), without, resolution=0.25, episodes=0).value != plain.value
    assert best_return(Animat(SHORT, Thresholds(1), 5), fit_histogram(lucky), resolution=0.25, episodes=0).value > (
        found.best.value + 1
    )


def test_conditions_left_out_leave_the_others_and_their_history_alone() -> None:
    source = extract_responses(synthetic_recording(1, patterns=10, channels=16))
    kept = source.only([3, 1])
    assert [c.label for c in kept.conditions] == [source.conditions[3].label, source.conditions[1].label]
    assert kept.rates_of(0).tolist() == source.rates_of(3).tolist()
    assert kept.rates_of(1).tolist() == source.rates_of(1).tolist()
    rows = np.isin(source.condition, [3, 1])
    np.testing.assert_array_equal(kept.last_hz, source.last_hz[rows])
    assert set(kept.presentations[0].condition.tolist()) == {NO_CONDITION, 0, 1}


def test_fixed_thresholds_stay_as_they_are_in_bootstraps() -> None:
    first, last = answers([40] * 5, 1), replace(answers([40] * 5, 2, (1.0,) * 5), start_min=10.0)
    timeline, again = fit_timeline([first, last], kind="histogram"), last.bootstrapped(np.random.default_rng(3))
    for percentiles, of in (("first", first), ("moving", again)):
        sampled = WellSampled.of(Animat(SHORT, Thresholds(1), 5), timeline, 10.0, percentiles)
        expected = np.percentile(of.rate_hz, np.arange(0, 101, 10))
        np.testing.assert_allclose(sampled.fit(again).percentiles, expected, rtol=1e-6)


@pytest.mark.oracle
@pytest.mark.parametrize("mapping", [Thresholds(1), Thresholds(9)])
def test_the_interval_is_within_what_returns_can_be(mapping: Thresholds) -> None:
    environment = Animat(SHORT, mapping, 5)
    for spread in ((1.0,) * 5, (0.01, 1.0, 1.0, 1.0, 100.0)):
        responses = answers([30] * 5, 3, spread)
        best = best_return(environment, fit_histogram(responses), resolution=0.25, episodes=0)
        sampled = WellSampled(environment, fit_histogram(responses), responses, (), fit_histogram)
        known, once = (sampled.with_interval(best, resolution=0.25, resamples=n).interval for n in (8, 1))
        assert known is not None and once is not None
        # The pole falls in the first iteration, or never.
        assert -100 <= known.low <= best.value <= known.high <= SHORT.episode_limit
        # Where conditions do not differ significantly, chance alone may have made them differ.
        shuffled = best_return(ShuffledDelivery(environment), fit_histogram(responses), resolution=0.25, episodes=0)
        assert (once.low < shuffled.value + 0.1) == (len(set(spread)) == 1)


@pytest.mark.oracle
def test_the_ends_of_the_interval_are_the_least_and_the_most_of_what_was_bootstrapped() -> None:
    """The 95 % interval of 39: another draw falls outside of them once in twenty."""
    environment, responses = Animat(SHORT, Thresholds(1), 5), answers([40] * 5, 3)
    best = best_return(environment, fit_histogram(responses), resolution=0.25, episodes=0)
    sampled = WellSampled(environment, fit_histogram(responses), responses, (), fit_histogram)
    known = sampled.with_interval(best, resolution=0.25)
    rng = np.random.default_rng(1)
    simulators = [fit_histogram(each) for each in (responses, *(responses.bootstrapped(rng) for _ in range(39)))]
    grid = _coarse(grid_for(SHORT), 0.25)
    values, _ = optimal_values([(environment, each) for each in simulators], grid, 1)
    moved = values[1:] - values[0]
    low, high = min(moved.min(), -moved.max()), moved.max()
    assert known.interval is not None
    assert known.interval.low == pytest.approx(best.value + low - best.grid_error)
    assert known.interval.high == pytest.approx(best.value + high + best.grid_error)


@pytest.mark.long
@pytest.mark.parametrize("mapping", [Thresholds(1), Thresholds(9)])
@pytest.mark.parametrize("spread", [SPREAD, (1.0,) * 5, (0.7, 1.4)])
@pytest.mark.parametrize("n", [30, 100])
def test_the_interval_holds_the_optimum_of_the_true_distributions(
    mapping: Thresholds, spread: tuple[float, ...], n: int
) -> None:
    environment = Animat(SHORT, mapping, len(spread))

    def best(responses: Responses) -> Optimum:
        return best_return(environment, fit_histogram(responses), resolution=0.25, episodes=0)

    true = best(answers([20_000] * len(spread), 0, spread)).value
    trials, held = 40, 0
    for seed in range(1, trials + 1):
        responses = answers([n] * len(spread), seed, spread)
        sampled = WellSampled(environment, fit_histogram(responses), responses, (), fit_histogram)
        known = sampled.with_interval(best(responses), resolution=0.25)
        assert known.interval is not None
        held += known.interval.low <= true <= known.interval.high
    print(f"{mapping.name}, {len(spread)} conditions, n = {n}: {held} of {trials}")
    # If coverage were 85 %, fewer would be covered by chance once in a thousand.
    assert held >= binom.ppf(0.001, trials, 0.85)


def test_fewer_than_no_resamples_are_refused() -> None:
    with pytest.raises(InvalidArgument, match=r"^resamples: expected"):
        optimal_returns(answers([60] * 5, 1), SHORT, resamples=-1)
