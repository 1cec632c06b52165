"""A cost of pulses: what is counted, what is learned, and what the tables say of it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.cli import main
from animat.coding.encoder import electrode_pulses
from animat.coding.mapping import Thresholds
from animat.cultures.observed import Observed
from animat.environment import Animat, Environment
from animat.errors import InvalidArgument, InvalidFile, Mismatch, UnusableData
from animat.evaluation.optimum import best_return
from animat.evaluation.rollouts import Constant, roll_out
from animat.evaluation.table import evaluate
from animat.live.plan import Timetable, check_plan
from animat.neurons.timeline import fit_timeline
from animat.reality_gap import Calibration, run_policies
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.recording import Recording
from animat.responses.condition import RESTING, Condition
from animat.responses.extraction import extract_responses
from animat.responses.responses import Responses
from animat.robots import Navigation
from animat.stimulation.places import NONE
from animat.stimulation.protocol import Protocol
from animat.training.group import programs
from animat.training.host import OnHost
from animat.training.networks import likeliest_action
from animat.training.policy import Policy
from animat.training.settings import SAC
from animat.training.specification import Training
from animat.wrappers import NeuralObservation, ShuffledDelivery, TrialCosts
from fake_culture import FakeCulture
from sac_toys import Payer
from test_bodies_of_others import named
from test_optimum import STEPS, Stairs, coins
from test_session_starts import Lasting
from test_training import SMALL, bits, timeline_of, trained

PLACES: tuple[tuple[int, ...] | str, ...] = (NONE, (101,), (100, 102, 104))
COUNTS = (0, 1, 3)


class Answering(FakeCulture):
    """Answers more, the more electrodes are pulsed: the fake culture answers by frequency alone."""

    def _deliver(self, admitted: Any, duration_s: float) -> Observed:
        seen = super()._deliver(admitted, duration_s)
        fewer = max((len(each.electrodes) for each in admitted.stimuli), default=0) < 2
        kept = np.ones(len(seen.spikes.time_s), bool)
        kept[::2] = not fewer
        return replace(seen, spikes=type(seen.spikes)(seen.spikes.time_s[kept], seen.spikes.channel[kept]))


def recorded(pulses: int = 1) -> Recording:
    protocol = {"trials": 40, "setup_s": 0.1, "pulses": pulses, "places": PLACES}
    with Answering() as culture:
        return culture.record(Protocol((20.0,), "mixed", **protocol))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def responses() -> Responses:
    return extract_responses(recorded(), burst_threshold=1.0)


# --- what is counted --------------------------------------------------------------------------------------------------


def on(*sets: tuple[int, ...], **more: Any) -> Condition:
    return Condition("some", 0.0, "", (20.0,), sets, **more)


def test_electrode_pulses_by_hand() -> None:
    rests = replace(on(), electrodes=RESTING)
    assert electrode_pulses([rests, on((7,)), on((1, 2, 3))], 1) == (0.0, 1.0, 3.0)
    assert electrode_pulses([rests, on((7,)), on((1, 2, 3))], 5) == (0.0, 5.0, 15.0)
    # Dealt equally often, on one or four electrodes.
    assert electrode_pulses([on((7,), (1, 2, 3, 4))], 2) == (5.0,)
    assert electrode_pulses([on((1, 2), only_last=True)], 1) == (2.0,)
    # Of the pulses before the last, of any pattern, and of stimuli without electrodes the number is not known.
    for unknown in (on((1, 2), only_last=True), Condition("5 Hz", 5.0, "Hz"), on()):
        assert electrode_pulses([rests, unknown], 2) is None


@pytest.mark.oracle
@settings(max_examples=20, deadline=None)
@given(
    actions=st.lists(st.integers(0, 2), min_size=1, max_size=12),
    costs=st.tuples(*[st.floats(0, 1e6, width=32)] * 3),
)
def test_costs_add_up_and_rewards_stay(actions: list[int], costs: tuple[float, ...]) -> None:
    plain = Animat(Stairs(20), Thresholds(1), 3)
    states = [each.reset(jax.random.key(1)) for each in (plain, TrialCosts(plain, costs))]
    total = np.float32(0)
    for i, action in enumerate(actions):
        key = jax.random.key(i)
        states = [
            each.step(key, state, jnp.int32(action), coins(3, 6, 9))
            for each, state in zip((plain, TrialCosts(plain, costs)), states, strict=True)
        ]
        total += np.float32(costs[action])
        assert float(states[1].info["cost"]) == total
        assert float(states[0].reward) == float(states[1].reward)
        assert "cost" in states[1].carried.info and "cost" not in states[0].info


def test_costs_of_a_shuffled_delivery_are_those_of_what_is_delivered() -> None:
    wrapped = TrialCosts(ShuffledDelivery(NeuralObservation(Animat(Stairs(), Thresholds(1), 2))), (0.0, 1.0))
    state = wrapped.reset(jax.random.key(0))
    paid = []
    for i in range(60):
        after = wrapped.step(jax.random.key(i), state, jnp.int32(1), coins(3, 6))
        assert float(after.info["cost"]) == int(after.info["delivered"])
        paid.append(float(after.info["cost"]))
    assert 0 < sum(paid) < 60
    with pytest.raises(InvalidArgument, match="costs: expected one for each of 2 conditions, got"):
        TrialCosts(Animat(Stairs(), Thresholds(1), 2), (1.0,))


def test_the_optimum_of_a_task_with_a_cost_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="got TrialCosts, whose optimal return is not known"):
        best_return(TrialCosts(Animat(Stairs(), Thresholds(1), 2), (0.0, 1.0)), coins(3, 6), grid=STEPS)


@dataclass(frozen=True)
class Flat(Stairs):
    """Pays the command, for 20 iterations, and stands where it is."""

    episode_limit: int = 20
    name: ClassVar[str] = "flat"

    def advance(self, uniforms: Any, state: Any, u: Any) -> tuple[Any, Any, Any]:
        return state, u, jnp.bool_(False)


# --- what is learned --------------------------------------------------------------------------------------------------

QUICK = SAC(environments=8, gradient_steps=4, batch=32, replay=4096, hidden=16, learning_rate=3e-3, discount=0.5)


def learned(environment: Environment[Any], rounds: int, **changed: Any) -> tuple[Any, Any]:
    beginning, chunk = programs(environment, replace(QUICK, **changed))
    keys = jax.random.split(jax.random.key(3), 2)
    return chunk(beginning(keys), coins(1, 9), jnp.int32(0), jnp.int32(rounds))  # type: ignore[no-any-return]


@pytest.mark.oracle
@pytest.mark.parametrize(("cost", "best"), [(1.2, 1), (2.0, 0)])
def test_a_policy_learns_the_action_that_is_best_with_the_cost(cost: float, best: int) -> None:
    environment = TrialCosts(Animat(Payer(episode_limit=5), Thresholds(1), 2), (0.0, cost))
    learners, finished = learned(environment, 300)
    for policy in range(2):
        actor = jax.tree.map(lambda leaf, of=policy: leaf[of], learners.deployed)
        assert int(likeliest_action(environment, actor, jnp.ones((1, 1)))[0]) == best
    # Returns are reported without the costs: they are from -5 to 5.
    assert np.all(np.abs(finished.returns / finished.episodes) <= 5)


@dataclass(frozen=True)
class PaidLess(Payer):
    """Pays a quarter less in each iteration."""

    episode_limit: int = 4
    name: ClassVar[str] = "paid less"

    def advance(self, uniforms: Any, state: Any, u: Any) -> tuple[Any, Any, Any]:
        after, reward, ended = super().advance(uniforms, state, u)
        return after, reward - 0.25, ended


@pytest.mark.oracle
def test_a_cost_is_learned_from_as_if_the_robot_were_paid_less() -> None:
    """Where all conditions cost the same the two are one task; in quarters nothing is rounded, and bits are equal."""
    costing = TrialCosts(Animat(Payer(episode_limit=4), Thresholds(1), 2), (0.25, 0.25))
    (one, finished), (other, finished_less) = learned(costing, 40), learned(Animat(PaidLess(), Thresholds(1), 2), 40)
    for a, b in zip(jax.tree.leaves(one.trained), jax.tree.leaves(other.trained), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one.replay, other.replay)
    np.testing.assert_array_equal(one.exploration.returns, other.exploration.returns)
    np.testing.assert_array_equal(finished.episodes, finished_less.episodes)
    np.testing.assert_array_equal(finished.returns, finished_less.returns + finished.episodes)


@pytest.mark.oracle
def test_a_body_that_is_stepped_on_the_host_pays_too() -> None:
    robot, simulator = named("Slider", episode_limit=6), coins(1, 9)
    plain = Animat(robot, Thresholds(1), 2)
    replays = []
    for environment in (plain, TrialCosts(plain, (0.0, 0.0)), TrialCosts(plain, (0.25, 0.25))):
        on_host = OnHost(environment, SMALL)
        learners, finished = on_host.train(on_host.begin(jax.random.split(jax.random.key(1), 1)), simulator, 0, 1)
        more, ended = on_host.train(learners, simulator, 1, 20)
        replays.append((np.asarray(more.replay)[0], float((finished.returns + ended.returns)[0])))
        if environment is not plain:
            each = environment.costs[0] * np.asarray(more.episodes.iteration)
            np.testing.assert_allclose(np.asarray(more.episodes.info["cost"]), each)
    (free, total), (as_free, same_total), (costing, _) = replays
    np.testing.assert_array_equal(free, as_free)
    assert total == same_total
    # The first round is acted alike, whatever is learned after it.
    n = SMALL.environments
    np.testing.assert_allclose(free[:n, -2] - costing[:n, -2], SMALL.reward_scale * 0.25, atol=1e-6)


def test_assessments_are_of_the_task_alone_and_not_with_a_cost() -> None:
    with pytest.raises(InvalidArgument, match="pulse_cost: expected 0 with assessments"):
        Training(Navigation(), Thresholds(1), pulse_cost=0.1, assess=3)
    Training(Navigation(), Thresholds(1), pulse_cost=0.0, assess=3)


# --- what is asked for, and what travels --------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [-0.1, math.nan, math.inf, 2e6, "0.1", True, None])
def test_costs_that_cannot_be_are_refused(wrong: Any) -> None:
    with pytest.raises(InvalidArgument, match=r"^pulse_cost: expected"):
        Training("cartpole", "1-threshold", pulse_cost=wrong)


def test_a_cost_is_of_neurons_whose_electrodes_are_known(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match=r"pulse_cost: expected 0 without neurons, got 0\.1"):
        Training("cartpole", None, pulse_cost=0.1)
    asked = Training("cartpole", "1-threshold", pulse_cost=0.1, iterations=500, algorithm=SMALL)
    with pytest.raises(
        UnusableData, match=r"pulse_cost: expected conditions that state the electrodes .*, got 5 Hz, 10 Hz"
    ):
        trained(asked, timeline_of(), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InvalidArgument, match="pulse_cost: expected 0, as all conditions of a live run cost the same"):
        check_plan(asked, Protocol(), tmp_path / "live", Timetable(), 1, {})


@pytest.mark.oracle
def test_a_cost_travels_with_policies(tmp_path: Path, responses: Responses) -> None:
    timeline = fit_timeline([responses])
    given: dict[str, Any] = {"policies": 2, "iterations": 1_000, "algorithm": SMALL, "duration_min": 1.0}
    free = Training(Navigation(episode_limit=8), Thresholds(1), **given)
    costly = trained(replace(free, pulse_cost=0.5), timeline, tmp_path / "costly")
    policies = trained(free, timeline, tmp_path / "free")
    trained(replace(free, pulse_cost=0.0), timeline, tmp_path / "free")
    for file in bits(tmp_path / "free").values():
        assert file.count(b'\\"pulse_cost\\": 0.0') == 2
    assert costly["p0"].pulse_cost == 0.5 and policies["p0"].pulse_cost == 0.0
    assert not np.array_equal(costly["p0"].weights[0], policies["p0"].weights[0])
    with pytest.raises(Mismatch, match=r"training\.pulse_cost"):
        trained(replace(free, pulse_cost=0.25), timeline, tmp_path / "costly")
    with pytest.raises(Mismatch, match="the same pulse_cost as"):
        evaluate({"p": costly["p0"], "q": policies["p0"]}, timeline, episodes=3)
    whole = (tmp_path / "costly" / "p0.safetensors").read_bytes()
    entry = b'\\"pulse_cost\\": 0.5'
    # Its provenance has it too.
    assert whole.count(entry) == 2
    for other in (b"-9 ", b"NaN", b"[1]"):
        (tmp_path / "other.safetensors").write_bytes(whole.replace(entry, entry.replace(b"0.5", other)))
        with pytest.raises(InvalidFile, match="this policy cannot be loaded: pulse_cost: expected"):
            Policy.load(tmp_path / "other.safetensors")


# --- what the tables say ----------------------------------------------------------------------------------------------


def policy_of(seed: int, responses: Responses, **changed: Any) -> Policy:
    rng, robot = np.random.default_rng(seed), Navigation(episode_limit=8)
    sizes = ((len(robot.observation_spec), 16), (16, 16), (16, len(responses.conditions)))
    given: dict[str, Any] = {
        "weights": tuple(rng.standard_normal(s).astype(np.float32) for s in sizes),
        "biases": tuple(np.zeros(s[1], np.float32) for s in sizes),
        "scales": np.ones(sizes[0][0], np.float32),
        "robot": robot,
        "mapping": Thresholds(1),
        "conditions": responses.conditions,
        "window_ms": (2.0, 10.0),
        "presentation": responses.presentation,
        "pulse_cost": 0.3,
    }
    return Policy(**(given | changed))


@pytest.mark.oracle
def test_an_evaluation_counts_what_each_agent_gives(responses: Responses) -> None:
    policies = {f"p{i}": policy_of(i, responses) for i in range(2)}
    table = evaluate(policies, fit_timeline([responses]), episodes=40, seed=3, optimum_resolution=0.3)
    rows = {row.name: row for row in table.rows}
    lengths = {name: float(row.episodes.lengths.mean()) for name, row in rows.items()}
    for count, condition in zip(COUNTS, responses.conditions, strict=True):
        row = rows[f"constant {condition.label}"].to_dict()
        assert row["electrode_pulses"] == pytest.approx(count * lengths[row["name"]], rel=1e-12)
    assert rows["silent"].to_dict()["electrode_pulses"] == 0.0
    assert rows["random"].electrode_pulses == pytest.approx(np.mean(COUNTS) * lengths["random"], rel=0.2)
    for row in rows.values():
        data = row.to_dict()
        presented = row.episodes.presented @ np.array(COUNTS)
        assert data["electrode_pulses"] * 40 * len(presented) == pytest.approx(presented.sum()) or row.name == "silent"
        assert data["net_return"] == data["mean_return"] - 0.3 * data["electrode_pulses"]
    assert table.optimum is not None
    text = table.to_text()
    assert "electrode pulses  net return" in text and "net return: mean return - 0.3 x electrode pulses" in text
    json.dumps(table.to_dict())
    # Without a cost the pulses are there, and no net return; where electrodes are not known, neither.
    free = evaluate({"p": policy_of(0, responses, pulse_cost=0.0)}, fit_timeline([responses]), episodes=5)
    assert "electrode pulses" in free.to_text() and "net return" not in free.to_text()
    unknown = tuple(replace(each, electrodes=()) for each in responses.conditions)
    of_before = evaluate({"p": policy_of(0, responses, conditions=unknown)}, fit_timeline([responses]), episodes=5)
    assert of_before.rows[0].electrode_pulses is None and of_before.rows[0].to_dict()["net_return"] is None


@pytest.mark.oracle
@pytest.mark.parametrize("pulses", [1, 2])
def test_in_a_loop_nothing_is_lost(pulses: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Return, pulses and net of each agent, recomputed from `ticks.csv`, to the last digit."""
    monkeypatch.setattr("animat.reality_gap.calibration.BOOTSTRAPS", 4)
    read = extract_responses(recorded(pulses), burst_threshold=1.0)
    policies = {f"p{i}": policy_of(i, read) for i in range(2)}
    with Answering(3) as culture:
        gap = run_policies(policies, culture, Calibration.of_series([read]), tmp_path, episodes=4)
        assert culture.pulses == gap.account.pulses
    assert gap.session.ending.by == "plan"
    ticks = pd.read_csv(gap.session.ticks_file, keep_default_na=False)
    by_label = dict(zip((each.label for each in read.conditions), COUNTS, strict=True))
    given = ticks["delivered"].map(by_label) * pulses * (ticks["agent"] != "silent")
    pd.testing.assert_series_equal(ticks["electrode_pulses"], given, check_names=False, check_dtype=False)
    moved = ticks[ticks["handled"] != "warm-up"]
    assert set(moved["handled"]) == {"used"}
    sums = moved.assign(reward=moved["reward"].astype(float)).groupby(["agent", "episode"], sort=False)
    episodes = sums.agg(total=("reward", "sum"), given=("electrode_pulses", "sum")).reset_index()
    for row in gap.rows:
        of = episodes[episodes["agent"].isin(policies if row.name == "policies" else [row.name])]
        data = row.to_dict()
        assert data["electrode_pulses"] == of["given"].sum() / len(of)
        assert sorted(data["measured_returns"]) == pytest.approx(sorted(of["total"]), rel=1e-15, abs=1e-13)
        assert data["net"] == data["measured"] - 0.3 * data["electrode_pulses"]
        assert data["net"] == pytest.approx((of["total"] - 0.3 * of["given"]).mean(), rel=1e-12)
        predicted = data["predicted"] - 0.3 * data["predicted_electrode_pulses"]
        assert data["predicted_net"] == predicted
    text = gap.to_text()
    assert "electrode pulses  predicted net" in text and "; the optimal return ignores the cost" in text
    silent = next(row for row in gap.rows if row.name == "silent")
    assert silent.electrode_pulses == silent.predicted_electrode_pulses == 0
    json.dumps(gap.to_dict())


@pytest.mark.usefixtures("few_bootstraps")
def test_pulses_are_predicted_from_the_starts_that_an_agent_had(tmp_path: Path, responses: Responses) -> None:
    """How long an episode of this robot lasts, its start alone decides: predicted and measured pulses are the same."""
    rng, sizes = np.random.default_rng(1), ((1, 16), (16, 16), (16, 3))
    weights = tuple(rng.standard_normal(size).astype(np.float32) for size in sizes)
    policy = policy_of(0, responses, robot=Lasting(), weights=weights, scales=np.ones(1, np.float32))
    with Answering(3) as culture:
        gap = run_policies({"p0": policy}, culture, Calibration.of_series([responses]), tmp_path, episodes=9, seed=4)
    rows = {row.name: row for row in gap.rows}
    assert len(rows["p0"].measured) == 9
    for count, condition in zip(COUNTS, responses.conditions, strict=True):
        row = rows[f"constant {condition.label}"]
        assert len(row.measured) == 5 and row.measured.mean() != rows["p0"].measured.mean()
        assert row.predicted_electrode_pulses == pytest.approx(count * row.measured.mean())
    assert rows["p0"].predicted_electrode_pulses == pytest.approx(rows["p0"].electrode_pulses)


def test_constant_agents_cost_what_they_should_on_a_simulator() -> None:
    """Twenty iterations of each condition: independent of the table's own count."""
    episodes = roll_out(
        Animat(Flat(), Thresholds(1), 3), coins(1, 5, 9), Constant(jnp.array([0, 1, 2])), episodes=7, seed=1
    )
    np.testing.assert_array_equal(episodes.presented, np.eye(3, dtype=int) * 7 * 20)


# --- the commands -----------------------------------------------------------------------------------------------------


@pytest.mark.oracle
def test_train_and_evaluate_report_the_cost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = tmp_path / "recordings", tmp_path / "policies"
    folder.mkdir()
    write_nwb(recorded(), folder / "one.nwb")
    asked = ["train", "cartpole", "--recordings", str(folder), "--conditions", "electrode", "--out", str(out)]
    short = ["--iterations", "600", "--policies", "2", "--sac", "hidden=8", "--burst-threshold", "1"]
    assert main([*asked, *short, "--pulse-cost", "0.05", "--json"]) == 0
    printed = capsys.readouterr().out
    assert "less 0.05 for each electrode pulse (" in printed
    results = json.loads(printed.splitlines()[-1])
    assert results["net_return"] == pytest.approx(
        np.mean(list(results["returns"].values())) - 0.05 * results["electrode_pulses"]
    )
    assert main(["evaluate", str(out), "--recordings", str(folder), "--episodes", "5", "--json"]) == 0
    evaluated = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert evaluated["pulse_cost"] == 0.05 and evaluated["rows"][0]["net_return"] is not None


@pytest.mark.parametrize("wrong", ["-1", "nan", "inf", "1e9", "much"])
def test_an_invalid_cost_is_refused_in_a_line(wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "cartpole", "--pulse-cost", wrong]) != 0
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and "pulse" in said[0] and "cost" in said[0]


def test_a_cost_of_frequencies_is_refused_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeCulture() as culture:
        recording = culture.record(Protocol(order="mixed", patterns=8, trials=40, setup_s=0.1))
    write_nwb(recording, tmp_path / "one.nwb")
    asked = ["train", "cartpole", "--recordings", str(tmp_path / "one.nwb"), "--out", str(tmp_path / "out")]
    assert main([*asked, "--pulse-cost", "0.1", "--burst-threshold", "1"]) == 1
    assert (
        "--pulse-cost: expected conditions that state the electrodes of all their pulses, got 5 Hz"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "out").exists()
