"""Episodes and controls against closed forms and a plain loop."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.coding.mapping import Linear, Thresholds
from animat.environment import Animat, WithoutNeurons
from animat.errors import InvalidArgument, Mismatch
from animat.evaluation.optimal_returns import WellSampled
from animat.evaluation.optimum import Optimum, best_return
from animat.evaluation.rollouts import Constant, HeuristicPolicy, Uniform, heuristic_policy, networks_of, roll_out
from animat.evaluation.table import _context, evaluate
from animat.neurons.simulator import fit_histogram, silenced
from animat.neurons.synthetic import synthetic_simulator
from animat.neurons.timeline import SimulatorTimeline, fit_timeline
from animat.records import as_json
from animat.robots import Cartpole, Navigation
from animat.robots.base import Robot
from animat.stimulation.protocol import Presentation
from animat.training.policy import Policy
from animat.wrappers import EpisodeLimit
from test_optimal_returns import answers
from test_simulator import responses_of
from test_training import timeline_of

SHORT = Cartpole(episode_limit=40)

WITHOUT_NEURONS = Policy(
    weights=(np.zeros((4, 8), np.float32), np.zeros((8, 8), np.float32), np.zeros((8, 2), np.float32)),
    biases=(np.zeros(8, np.float32), np.zeros(8, np.float32), np.zeros(2, np.float32)),
    scales=np.ones(4, np.float32),
    robot=Cartpole(),
    mapping=None,
    commands=(-1.0, 1.0),
)


def policy_of(timeline: SimulatorTimeline, robot: Robot = Cartpole(), seed: int = 0) -> Policy:  # type: ignore[type-arg]  # noqa: B008
    """A policy with random weights."""
    rng = np.random.default_rng(seed)
    sizes = (len(robot.observation_spec), 16, 16, len(timeline.conditions))
    return Policy(
        weights=tuple(rng.normal(0, 1, size).astype(np.float32) for size in itertools.pairwise(sizes)),
        biases=tuple(rng.normal(0, 1, size).astype(np.float32) for size in sizes[1:]),
        scales=np.array([quantity.scale for quantity in robot.observation_spec], np.float32),
        robot=robot,
        mapping=Thresholds(1),
        conditions=timeline.conditions,
        window_ms=timeline.window_ms,
        presentation=timeline.presentation,
    )


def test_a_silent_culture_drives_the_cartpole_one_way_until_it_falls() -> None:
    simulator = silenced(synthetic_simulator())
    episodes = roll_out(Animat(Cartpole(force_noise=0.0), Thresholds(1), 5), simulator, Uniform(), episodes=5, seed=0)
    # By hand: u = -1 always. The same equations stepped in numpy until 12 degrees.
    x = np.zeros(4)
    n = 0
    while abs(x[2]) <= np.radians(12):
        m, mass, half = 0.055, 0.365, 0.2
        tmp = (-1.0 + m * half * x[3] ** 2 * np.sin(x[2])) / mass
        angular = (9.8 * np.sin(x[2]) - np.cos(x[2]) * tmp) / (half * (4 / 3 - m * np.cos(x[2]) ** 2 / mass))
        x = x + 0.02 * np.array([x[1], tmp - m * half * angular * np.cos(x[2]) / mass, x[3], angular])
        n += 1
    assert np.all(episodes.lengths == n)
    assert np.all(episodes.returns == n - 1 - 100)
    assert np.all(episodes.terminated)


def test_truncated_episodes_count_to_the_limit_and_are_not_terminated() -> None:
    environment = Animat(Navigation(episode_limit=20), Linear(), 5)
    episodes = roll_out(environment, synthetic_simulator(), Constant(jnp.arange(3)), episodes=7, seed=0)
    assert np.all(episodes.lengths == 20)
    assert not episodes.terminated.any()
    assert episodes.returns.shape == (3, 7)


@pytest.mark.oracle
def test_episodes_agree_with_a_plain_loop_of_single_steps() -> None:
    """In distribution: the mean return of a thousand episodes, stepped one by one with other random numbers."""
    timeline = timeline_of()
    policy = policy_of(timeline)
    simulator = timeline.at(0.0)
    environment = Animat(policy.robot, policy.mapping, 3)
    rolled = roll_out(environment, simulator, networks_of([policy]), episodes=2_000, seed=0)
    many = rolled.returns[0]

    step = jax.jit(environment.step)
    rng = np.random.default_rng(0)
    returns, presented, commanded, squared = [], np.zeros(3), np.zeros(3), np.zeros(3)
    for episode in range(100):
        state, total, key = environment.reset(jax.random.key(0)), 0.0, jax.random.key(1000 + episode)
        while True:
            key, use = jax.random.split(key)
            action = policy.act(np.asarray(environment.observe(state)), rng)
            state = step(use, state, jnp.int32(action), simulator)
            total += float(state.reward)
            presented[int(state.info["delivered"])] += 1
            commanded[int(state.info["delivered"])] += float(state.info["command"])
            squared[int(state.info["delivered"])] += float(state.info["command"]) ** 2
            if state.ended.terminated or state.ended.truncated:
                break
        returns.append(total)
    error = np.hypot(many.std() / np.sqrt(len(many)), np.std(returns, ddof=1) / np.sqrt(len(returns)))
    assert abs(many.mean() - np.mean(returns)) < 4 * error
    assert rolled.presented.sum() == rolled.lengths.sum()
    np.testing.assert_array_equal(rolled.delivered.sum(axis=2), rolled.lengths)
    often = presented > 30
    np.testing.assert_allclose(rolled.presented[0] / rolled.presented.sum(), presented / presented.sum(), atol=0.05)
    mean, n = commanded[often] / presented[often], presented[often]
    error_of_mean = np.sqrt((squared[often] / n - mean**2) / n + 1e-4)
    assert np.all(np.abs(rolled.commanded[0][often] / rolled.presented[0][often] - mean) < 4 * error_of_mean)


def test_actors_have_random_numbers_of_their_own_and_a_seed_decides_them() -> None:
    timeline = timeline_of()
    policy = policy_of(timeline)
    environment = Animat(policy.robot, policy.mapping, 3)

    def run(seed: int) -> np.ndarray:
        return roll_out(environment, timeline.at(0.0), networks_of([policy] * 2), episodes=50, seed=seed).returns

    assert np.array_equal(run(3), run(3))
    assert not np.array_equal(run(3), run(4))
    assert not np.array_equal(run(3)[0], run(3)[1])


@pytest.mark.oracle
def test_where_the_user_computes_in_64_bits_episodes_are_the_same() -> None:
    environment = EpisodeLimit(Animat(Cartpole(episode_limit=20), Thresholds(9), 5))

    def run() -> np.ndarray:
        return roll_out(environment, synthetic_simulator(), Uniform(), episodes=5, seed=1).returns

    usual = run()
    with jax.enable_x64(True):
        np.testing.assert_array_equal(run(), usual)


def test_jax_does_not_take_actors_without_numbers_for_each_other() -> None:
    """If it did, it could run the program of one for the other, depending on where classes lie in memory."""
    assert jax.tree.structure(Uniform()) != jax.tree.structure(HeuristicPolicy())
    assert jax.tree.structure(Uniform()) == jax.tree.structure(Uniform())


def test_a_constant_actor_is_the_condition_itself() -> None:
    # Condition 0 always gives low responses, condition 1 high ones: u = -1 or +1 throughout, mirror images.
    timeline = fit_timeline([responses_of([10.0] * 9, [50.0] * 9)], kind="empirical")
    environment = Animat(Cartpole(force_noise=0.0), Thresholds(1), 2)
    both = roll_out(environment, timeline.at(0.0), Constant(jnp.array([0, 1])), episodes=3, seed=0)
    assert np.array_equal(both.returns[0], both.returns[1])
    assert len(np.unique(both.returns)) == 1


def test_greedy_takes_the_most_probable_action() -> None:
    timeline = timeline_of()
    policy = policy_of(timeline)
    network = networks_of([policy], greedy=True)
    observations = np.random.default_rng(0).normal(0, 0.3, (64, 4)).astype(np.float32)
    environment = Animat(policy.robot, policy.mapping, 3)
    single = jax.tree.map(lambda leaf: leaf[0], network)
    actions = single.act(environment, jnp.asarray(observations / environment.scales), jnp.zeros((64, 1)))
    assert actions.tolist() == [policy.act_greedily(o) for o in observations]


def test_on_a_changed_robot_a_policy_sees_what_it_would_when_deployed() -> None:
    timeline = timeline_of()
    policy = policy_of(timeline)
    single = jax.tree.map(lambda leaf: leaf[0], networks_of([policy], greedy=True))
    # A longer track has a different scale of positions; the policy was trained with that of its own track.
    longer = Animat(Cartpole(track_length_m=4.0, angle_limit_rad=0.5), policy.mapping, 3)
    assert not np.array_equal(longer.scales, policy.scales)
    observations = np.random.default_rng(0).normal(0, 0.3, (64, 4)).astype(np.float32)
    actions = single.act(longer, jnp.asarray(observations / longer.scales), jnp.zeros((64, 1)))
    assert actions.tolist() == [policy.act_greedily(o) for o in observations]


def test_the_table_has_the_policies_and_every_control() -> None:
    timeline = timeline_of()
    policies = {"a": policy_of(timeline, seed=1), "b": policy_of(timeline, seed=2)}
    updates: list[tuple[float, float, str]] = []

    class Noting:
        def update(self, done: float, total: float, note: str = "") -> None:
            updates.append((done, total, note))

    evaluation = evaluate(policies, timeline, at_min=14.0, episodes=50, progress=Noting())
    assert updates == [(i + 1, 8, row.name) for i, row in enumerate(evaluation.rows)]
    assert [row.name for row in evaluation.rows] == [
        "policies",
        "random",
        "constant 5 Hz",
        "constant 10 Hz",
        "constant 20 Hz",
        "heuristic",
        "silent",
        "shuffled",
    ]
    assert evaluation.recorded_at_min == 10.0
    plain = evaluation.to_dict()
    assert plain["policies"] == {"a": plain["rows"][0]["mean_returns"][0], "b": plain["rows"][0]["mean_returns"][1]}
    for row in evaluation.rows:
        assert row.name in evaluation.to_text()
    known = replace(evaluation, optimum=Optimum(1e3, 0.0, 1e3, 1.0, 1e3, 1.0, 100, 1000))
    assert "score: (mean return - random) / (optimal return - random); none for silent and shuffled" in known.to_text()
    # Random actions may be among those that a caller leaves out.
    assert "no score, as there are no random actions" in replace(known, rows=known.rows[:1]).to_text()


@pytest.mark.oracle
def test_policies_are_evaluated_with_the_percentiles_they_were_trained_with() -> None:
    """Fixed ones are the first recording's on every simulator; the truth is a roll-out with them inserted by hand."""
    timeline = timeline_of()
    moving = policy_of(timeline, seed=1)
    held = replace(moving, provenance={"training": {"percentiles": "first"}, "simulators": {"recorded_at_min": [0.0]}})
    found = evaluate({"a": held}, timeline, at_min=14.0, episodes=50, seed=3)
    simulator = replace(timeline.at(14.0), percentiles=timeline.at(0.0).percentiles)
    environment = Animat(Cartpole(), Thresholds(1), 3)
    wanted = roll_out(environment, simulator, networks_of([held], greedy=True), episodes=50, seed=3).returns
    np.testing.assert_array_equal(found.rows[0].episodes.returns, wanted)
    assert np.any(
        wanted != evaluate({"a": moving}, timeline, at_min=14.0, episodes=50, seed=3).rows[0].episodes.returns
    )
    assert "recording at 10 min, percentiles fixed from 0 min: 1 policy," in found.to_text()
    assert found.to_dict()["percentiles_fixed_from_min"] == 0.0
    assert "other-percentiles" not in {finding.name for finding in found.findings}
    elsewhere = replace(held, provenance={**held.provenance, "simulators": {"recorded_at_min": [-10.0, 0.0]}})
    noticed = evaluate({"a": elsewhere}, timeline, episodes=50).findings
    (finding,) = (each for each in noticed if each.name == "other-percentiles")
    assert "fixed from the recording at -10 min, which is not the first of these" in finding.message
    with pytest.raises(Mismatch, match="b: expected the same percentiles as a"):
        evaluate({"a": moving, "b": held}, timeline)


@pytest.mark.oracle
def test_a_policy_trained_as_a_control_is_one_when_it_is_evaluated() -> None:
    """Whatever it chooses, the delivered condition is random: as good as random actions, and without an optimum."""
    timeline = timeline_of()
    chosen = policy_of(timeline, SHORT, seed=1)
    control = replace(chosen, provenance={"training": {"delivery": "shuffled"}})
    found = evaluate({"a": control}, timeline, episodes=500, seed=3, optimum_resolution=0.25)
    rows = {row.name: row for row in found.rows}
    np.testing.assert_array_equal(rows["policies"].episodes.returns, rows["shuffled"].episodes.returns)
    assert np.any(rows["policies"].episodes.returns != evaluate({"a": chosen}, timeline, episodes=500, seed=3).rows[0]
                  .episodes.returns)  # fmt: skip
    assert "as trained: the delivered condition is drawn at random" in found.to_text()
    assert found.score(rows["policies"]) is None and found.score(rows["random"]) == 0.0
    assert "none for policies and silent and shuffled, whose optimum is different" in found.to_text()


def test_simulators_fitted_differently_from_training_are_reported() -> None:
    timeline = timeline_of()
    trained = {"kind": "histogram", "bins": 40, "range_hz": None, "recorded_at_min": [0.0]}
    policy = replace(policy_of(timeline), provenance={"simulators": trained})
    noticed = evaluate({"a": policy}, timeline, episodes=50, controls=()).findings
    (finding,) = (each for each in noticed if each.name == "other-simulator")
    assert finding.message.endswith("fitted differently: bins 40, here 20")
    of_memory = replace(policy, provenance={"simulators": trained | {"kind": "memory", "bins": None}})
    noticed = evaluate({"a": of_memory}, timeline, episodes=50, controls=()).findings
    (finding,) = (each for each in noticed if each.name == "other-simulator")
    assert finding.message.endswith("fitted differently: kind memory, here histogram"), "a memory has no bins"
    alike = replace(policy, provenance={"simulators": trained | {"bins": 20}})
    noticed = evaluate({"a": alike}, timeline, episodes=50, controls=()).findings
    assert "other-simulator" not in {each.name for each in noticed}


def test_the_heuristic_policy_goes_through_the_same_mapping_and_neurons() -> None:
    timeline = timeline_of()
    evaluation = evaluate({"a": policy_of(timeline)}, timeline, at_min=14.0, episodes=50, seed=3)
    (row,) = [row for row in evaluation.rows if row.name == "heuristic"]
    environment, simulator = Animat(Cartpole(), Thresholds(1), 3), timeline.at(14.0)
    rule = heuristic_policy(environment, simulator)
    np.testing.assert_array_equal(
        row.episodes.returns, roll_out(environment, simulator, rule, episodes=50, seed=3).returns
    )


@pytest.mark.oracle
def test_the_optimum_scores_what_acts_in_the_same_environment() -> None:
    """The optimum is `best_return` on the same simulator; scores are computed again from the means."""
    timeline = timeline_of()
    policies = {"a": policy_of(timeline, SHORT, seed=1), "b": policy_of(timeline, SHORT, seed=2)}
    totals: dict[str, set[float]] = {}

    class Noting:
        def update(self, done: float, total: float, note: str = "") -> None:
            assert done <= total
            totals.setdefault(note, set()).add(total)

    plainly = evaluate(policies, timeline, at_min=14.0, episodes=50, seed=3)
    found = evaluate(policies, timeline, at_min=14.0, episodes=50, seed=3, optimum_resolution=0.25, progress=Noting())
    environment = Animat(SHORT, Thresholds(1), 3)
    assert found.optimum is not None
    assert replace(found.optimum, interval=None) == best_return(environment, timeline.at(14.0), resolution=0.25, seed=3)
    # Nine rows, then the phase of the optimum: its own half, and that of its interval.
    names = [row.name for row in found.rows]
    assert len(names) == 9 and all(totals[name] == {9} for name in names)
    *_, last_row, own, value, interval = totals
    assert (last_row, own, interval) == ("coupling", "optimal return", "its interval")
    assert value.startswith("optimum ") and totals[own] == totals[value] == totals[interval] == {2}
    assert set(found.optimum.findings()) <= set(found.findings)

    data = json.loads(json.dumps(found.to_dict()))
    assert data["optimum"] == json.loads(json.dumps(found.optimum.to_dict())) and data["no_optimum"] is None
    rows = {row["name"]: row for row in data["rows"]}
    random, best = rows["random"]["mean_return"], data["optimum"]["value"]
    for name, row in rows.items():
        if name in ("silent", "shuffled"):
            assert row["normalised_score"] is None
        else:
            assert row["normalised_score"] == pytest.approx((row["mean_return"] - random) / (best - random))
    assert rows["random"]["normalised_score"] == 0
    text = found.to_text()
    assert found.optimum.to_text() in text and "none for silent and shuffled, whose optimum is different" in text
    assert f"{rows['policies']['normalised_score']:.2f}  as trained" in text

    # Without random actions there is nothing to score against.
    unscored = replace(found, rows=tuple(row for row in found.rows if row.name != "random"))
    assert {row["normalised_score"] for row in unscored.to_dict()["rows"]} == {None}

    # With an optimum that its own controller surpasses scores are too high, and there is no context gap.
    low = replace(found.optimum, value=found.optimum.achieved[0] - 20.0)
    surpassed = replace(found, optimum=low)
    assert found.context is not None and _context(surpassed.rows, low, 120.0) is None
    assert "too high" not in text and "; too high, as the optimal return is less than" in surpassed.to_text()

    # Nothing else changes, and the optimum is not reported if it was not requested.
    assert plainly.optimum is None and plainly.no_optimum is None
    # The best coupling is the last row; it is only there with the optimum.
    shared, (reflex,) = data["rows"][:-1], data["rows"][-1:]
    assert reflex["name"] == "coupling" and reflex["mean_return"] == data["context"]["coupling"]
    assert [row["mean_returns"] for row in plainly.to_dict()["rows"]] == [row["mean_returns"] for row in shared]
    assert "score" not in plainly.to_text() and "optimal return" not in plainly.to_text()
    assert {row["normalised_score"] for row in plainly.to_dict()["rows"]} == {None}


@pytest.mark.oracle
def test_an_optimum_without_conditions_of_few_responses_gives_no_score(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows use these conditions too; the optimum has the thresholds of all responses, as the rows have."""
    monkeypatch.setattr(WellSampled, "with_interval", lambda self, best, **_: replace(best, left_out=self.left_out))
    monkeypatch.setattr("animat.evaluation.table.best_return", partial(best_return, episodes=0))
    responses = answers([60, 60, 60, 60, 3], 2)
    lucky = replace(responses, rate_hz=np.where(responses.condition == 4, 1000.0, responses.rate_hz))
    timeline = fit_timeline([lucky], kind="histogram")
    found = evaluate({"a": policy_of(timeline, SHORT)}, timeline, episodes=50, optimum_resolution=0.25)
    assert found.optimum is not None and found.optimum.left_out == ("80 Hz (3)",)
    held = replace(fit_histogram(lucky.only([0, 1, 2, 3])), percentiles=timeline.at(0.0).percentiles)
    assert found.optimum.value == best_return(Animat(SHORT, Thresholds(1), 4), held, resolution=0.25, episodes=0).value
    assert {row["normalised_score"] for row in found.to_dict()["rows"]} == {None}
    assert "no score, as the optimal return leaves out conditions" in found.to_text()


@pytest.mark.oracle
def test_without_neurons_the_optimum_is_a_pole_kept_up_to_the_end() -> None:
    """In closed form: a reward of 1 per iteration, and no fall, as two forces are enough to hold the pole."""
    evaluation = evaluate({"p0": WITHOUT_NEURONS}, None, episodes=50, optimum_resolution=0.6)
    assert evaluation.optimum is not None
    assert evaluation.optimum.value == pytest.approx(120, abs=0.01)
    rows = {row.name: row for row in evaluation.rows}
    heuristic, random = (float(rows[name].mean_returns.mean()) for name in ("heuristic", "random"))
    assert evaluation.score(rows["heuristic"]) == pytest.approx((heuristic - random) / (120 - random), abs=0.001)
    assert evaluation.score(rows["constant -1"]) == pytest.approx(
        (float(rows["constant -1"].mean_returns.mean()) - random) / (120 - random), abs=0.001
    )
    assert "none for" not in evaluation.to_text()


@pytest.mark.oracle
def test_where_there_is_no_optimum_or_no_score_a_line_says_so() -> None:
    wide = replace(WITHOUT_NEURONS, robot=Cartpole(angle_limit_rad=1.0, episode_limit=10))
    unknown = evaluate({"a": wide}, None, episodes=3, optimum_resolution=0.25)
    (line,) = [line for line in unknown.to_text().splitlines() if "no optimal return: " in line]
    assert "angle_limit_rad" in line
    data = unknown.to_dict()
    assert data["optimum"] is None and data["no_optimum"] in line
    assert {row["normalised_score"] for row in data["rows"]} == {None}

    nothing_to_learn = replace(
        unknown, optimum=Optimum(-200.0, 0.0, -200.0, 1.0, -200.0, 1.0, 100, 1000), no_optimum=None
    )
    assert {row["normalised_score"] for row in nothing_to_learn.to_dict()["rows"]} == {None}
    assert "no score, as the optimal return is not above" in nothing_to_learn.to_text()


@pytest.mark.oracle
def test_shuffling_makes_every_policy_a_random_one() -> None:
    timeline = timeline_of()
    evaluation = evaluate({"a": policy_of(timeline)}, timeline, episodes=3_000)
    rows = {row.name: row.episodes.returns[0] for row in evaluation.rows}
    error = np.hypot(*(rows[name].std() / np.sqrt(3_000) for name in ("random", "shuffled")))
    assert abs(rows["random"].mean() - rows["shuffled"].mean()) < 4 * error


@pytest.mark.oracle
def test_without_neurons_there_is_nothing_to_silence() -> None:
    evaluation = evaluate({"p0": WITHOUT_NEURONS}, None, episodes=4)
    assert [row.name for row in evaluation.rows] == ["policies", "random", "constant -1", "constant +1", "heuristic"]
    assert isinstance(WithoutNeurons(Cartpole(), (-1.0, 1.0)).n_actions, int)


def test_mismatches_are_refused() -> None:
    timeline = timeline_of()
    policy = policy_of(timeline)
    with pytest.raises(InvalidArgument, match="policies"):
        evaluate({}, timeline)
    for wrong in ("policies", [policy], {"a": 3}):
        with pytest.raises(InvalidArgument, match="policies: expected policies by name, as"):
            evaluate(wrong, timeline)  # type: ignore[arg-type]
    with pytest.raises(
        InvalidArgument, match=r"timeline: expected simulators, as animat\.fit_timeline returns, or None, got"
    ):
        evaluate({"a": policy}, [timeline])  # type: ignore[arg-type]
    with pytest.raises(InvalidArgument, match=r"controls: expected some of random, constant .*, got randm"):
        evaluate({"a": policy}, timeline, controls=("random", "randm"))
    with pytest.raises(InvalidArgument, match="episodes"):
        evaluate({"a": policy}, timeline, episodes=0)
    with pytest.raises(InvalidArgument, match="timeline"):
        evaluate({"a": policy}, None)
    with pytest.raises(InvalidArgument, match="at_min: expected a minute"):
        evaluate({"a": policy}, timeline, at_min=float("nan"))
    with pytest.raises(InvalidArgument, match=r"from the first recording on, which started at 0 min, got -0\.1"):
        evaluate({"a": policy}, timeline, at_min=-0.1)
    for seed in (-1, 2**32):
        with pytest.raises(InvalidArgument, match="seed: expected a whole number"):
            evaluate({"a": policy}, timeline, seed=seed)
    for resolution in (0.0, float("nan")):
        with pytest.raises(InvalidArgument, match="optimum_resolution: expected a positive number"):
            evaluate({"a": policy}, timeline, optimum_resolution=resolution)
    with pytest.raises(Mismatch, match="robot: expected cartpole"):
        evaluate({"a": policy}, timeline, robot=Navigation())
    with pytest.raises(Mismatch, match="b: expected the same robot as a"):
        evaluate({"a": policy, "b": policy_of(timeline, Cartpole(pole_mass_kg=0.55))}, timeline)
    with pytest.raises(Mismatch, match="conditions: expected 5 Hz, 10 Hz, 20 Hz"):
        evaluate({"a": policy}, fit_timeline([responses_of([1.0, 2.0], [3.0, 4.0])]))
    there, elsewhere = (
        replace(policy, conditions=tuple(replace(c, electrodes=((first, 7),)) for c in policy.conditions))
        for first in (5, 6)
    )
    with pytest.raises(Mismatch, match=r"b: conditions: expected 5 Hz at 5 Hz on the electrodes 5\+7, got .* 6\+7, un"):
        evaluate({"a": there, "b": elsewhere}, timeline)


def test_differences_of_any_policy_are_reported_once() -> None:
    timeline = timeline_of()
    alike, other = policy_of(timeline), replace(policy_of(timeline), presentation=Presentation("mixed", 5))
    run = partial(evaluate, timeline=timeline, episodes=50, controls=())
    expected = [*run({"a": alike}).findings, *run({"b": other}).findings]
    assert {finding.name for finding in expected} == {"other-presentation", "other-calibration"}
    assert list(run({"a": alike, "b": other, "c": other}).findings) == expected


@pytest.mark.oracle
def test_a_different_presentation_or_window_is_reported() -> None:
    timeline = timeline_of()
    other = fit_timeline(
        [
            responses_of(
                *([m, m + 1.0, m + 2.0] for m in (10.0, 20.0, 30.0)), presentation=None, window_ms=(2.0, 20.0)
            ),
        ]
    )
    evaluation = evaluate({"a": policy_of(timeline)}, other, episodes=50)
    assert [finding.name for finding in evaluation.findings] == ["other-window", "other-presentation"]


@pytest.mark.parametrize("greedy", [True, False])
def test_an_evaluation_says_how_it_was_made(greedy: bool) -> None:
    timeline = timeline_of()
    policy = policy_of(timeline, SHORT)
    found = evaluate({"p0": policy}, timeline, episodes=7, seed=5, greedy=greedy, controls=["random"])
    data = json.loads(json.dumps(as_json(found.to_dict())))
    assert (data["seed"], data["actions"]) == (5, "most probable" if greedy else "drawn")
    assert f"7 episodes each, {data['actions']} actions, seed 5" in found.to_text()
    assert data["versions"]["numpy"] == np.__version__
    for row, own in zip(data["rows"], found.rows, strict=True):
        assert np.array(row["returns"]).shape == (1, 7)
        assert np.mean(row["returns"]) == pytest.approx(row["mean_return"])
        np.testing.assert_array_equal(row["returns"], own.episodes.returns)
