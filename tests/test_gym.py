"""The Gymnasium environments: Gymnasium's own checker, and a direct rollout of the Animat inside."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import animat
from animat.coding.mapping import Linear, mapping_named
from animat.environment import Animat
from animat.errors import InvalidArgument
from animat.gym import IDS, register_environments
from animat.neurons.memory import Memory, fit_memory
from animat.neurons.simulator import silenced
from animat.neurons.synthetic import LABELS, synthetic_simulator
from animat.recordings.formats.nwb import write_nwb
from animat.responses.extraction import extract_responses
from animat.robots import Cartpole, robot_named
from animat.robots.registry import REGISTRY
from animat.wrappers import EpisodeLimit, NeuralObservation
from synthetic_recordings import synthetic_recording, write_synthetic_series

assert animat.__doc__  # importing animat registers the environments


def rollout(env, actions, seed=0):
    """(observations, rewards, terminated, truncated, infos) of the actions, resetting where an episode ends."""
    observation, _ = env.reset(seed=seed)
    steps = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        steps.append((observation, reward, terminated, truncated, info))
        if terminated or truncated:
            env.reset()
    return [np.array(part) if i < 4 else part for i, part in enumerate(zip(*steps, strict=True))]


@pytest.mark.parametrize(
    ("id_", "options"),
    [
        pytest.param(id_, options, marks=pytest.mark.oracle if options and id_ != "Animat/Cartpole-v0" else ())
        for id_ in IDS
        for options in ({}, {"mapping": "9-thresholds"}, {"delivery": "shuffled"})
    ],
)
def test_gymnasiums_checker_passes_without_a_warning(id_: str, options: dict) -> None:
    check_env(gymnasium.make(id_, render_mode="rgb_array", **options).unwrapped)


@pytest.mark.oracle
def test_stable_baselines3_trains_on_it() -> None:
    library = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    from stable_baselines3.common.env_checker import check_env as check

    environment = gymnasium.make("Animat/Cartpole-v0", mapping="9-thresholds")
    check(environment)
    agent = library.DQN("MlpPolicy", environment, learning_starts=50, seed=1, device="cpu").learn(300)
    assert agent.num_timesteps == 300
    episodes = agent.ep_info_buffer
    assert len(episodes) > 1 and all(0 < each["l"] <= 120 and -100 <= each["r"] <= 120 for each in episodes)
    action, _ = agent.predict(environment.reset(seed=1)[0], deterministic=True)
    assert environment.action_space.contains(int(action))


@pytest.mark.oracle
@pytest.mark.parametrize(
    "imports",
    [
        "import animat, gymnasium; make = gymnasium.make('Animat/Cartpole-v0')",
        "import gymnasium, animat; make = gymnasium.make('Animat/Cartpole-v0')",
        "import gymnasium; make = gymnasium.make('animat:Animat/Cartpole-v0')",
    ],
)
def test_they_are_known_in_whichever_order_imports_come(imports: str) -> None:
    code = imports + "; make.reset(seed=0); make.step(0)"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_registering_loads_nothing_heavy_and_twice_does_no_harm() -> None:
    register_environments()
    heavy = "{'jax', 'scipy', 'matplotlib', 'h5py', 'pynwb'}"
    subprocess.run(
        [sys.executable, "-c", f"import animat, sys; left = {heavy} & set(sys.modules); assert not left, left"],
        check=True,
    )


@pytest.mark.parametrize(
    ("id_", "mapping"),
    [
        pytest.param(id_, mapping, marks=pytest.mark.oracle if "9" not in mapping and "Cartpole" not in id_ else ())
        for id_ in IDS
        for mapping in ("1-threshold", "9-thresholds", "linear")
    ],
)
def test_an_episode_is_a_rollout_of_the_animat(id_: str, mapping: str) -> None:
    """The same random numbers, handed to the Animat directly, give the same episode."""
    env = gymnasium.make(id_, mapping=mapping)
    actions = np.random.default_rng(1).integers(0, 5, 60)
    env.reset(seed=11)
    rng = np.random.Generator(type(env.unwrapped.np_random.bit_generator)())
    rng.bit_generator.state = env.unwrapped.np_random.bit_generator.state

    body, simulator = robot_named(IDS[id_]), synthetic_simulator()
    direct = EpisodeLimit(Animat(body, mapping_named(mapping), 5))
    state, advance = direct.reset(jax.random.key(0)), jax.jit(direct.advance)
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        uniforms = jnp.asarray(rng.random(direct.noise_size, np.float32))
        state = advance(uniforms, state, jnp.int32(action), simulator)
        np.testing.assert_allclose(observation, direct.observe(state), rtol=1e-5, atol=1e-6)
        assert reward == pytest.approx(float(state.reward), rel=1e-5)
        assert (terminated, truncated) == (bool(state.ended.terminated), bool(state.ended.truncated))
        assert info == {
            "delivered": action,
            "rate_hz": pytest.approx(float(state.info["rate_hz"]), rel=1e-5),
            "command": pytest.approx(float(state.info["command"]), abs=1e-5),
        }
        if terminated or truncated:
            break


@pytest.mark.parametrize("id_", IDS)
def test_a_seed_decides_everything(id_: str) -> None:
    actions = np.random.default_rng(0).integers(0, 5, 300)
    one, same, other = (rollout(gymnasium.make(id_), actions, seed) for seed in (3, 3, 4))
    for a, b in zip(one[:4], same[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    assert one[4] == same[4]
    assert [info["rate_hz"] for info in one[4]] != [info["rate_hz"] for info in other[4]]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_in_the_middle_of_an_episode_goes_on_in_the_same_way(copied) -> None:
    env = gymnasium.make("Animat/Cartpole-v0").unwrapped
    env.reset(seed=0)
    env.step(1)
    other = copied(env)
    for action in (0, 4, 2):
        one, another = env.step(action), other.step(action)
        np.testing.assert_array_equal(one[0], another[0])
        assert one[1:] == another[1:]


def test_truncation_is_not_termination() -> None:
    env = gymnasium.make("Animat/Navigation-v0")
    _, rewards, terminated, truncated, _ = rollout(env, [0] * 250)
    ends = np.flatnonzero(truncated)
    assert len(ends) and not terminated[ends].any()
    # Episodes end either way; none is longer than the limit.
    assert np.diff(np.flatnonzero(terminated | truncated), prepend=-1).max() == 100
    np.testing.assert_array_equal(terminated, rewards == 50)

    env = gymnasium.make("Animat/Cartpole-v0", episode_limit=5, angle_limit_rad=1.5)
    _, rewards, terminated, truncated, _ = rollout(env, [4] * 20)
    assert np.flatnonzero(truncated).tolist() == [4, 9, 14, 19] and not terminated.any()
    assert np.all(rewards == 1)

    env = gymnasium.make("Animat/Cartpole-v0")
    _, rewards, terminated, truncated, _ = rollout(env, [4] * 200)
    assert terminated.any() and not truncated.any()
    np.testing.assert_array_equal(terminated, rewards == -100)


def test_an_episode_that_ends_by_itself_at_the_limit_is_terminated_only() -> None:
    """A silent culture always pushes left, and without noise the pole falls in the same iteration every time."""
    options = {"simulator": silenced(synthetic_simulator()), "force_noise": 0.0}
    falls = int(np.argmax(rollout(gymnasium.make("Animat/Cartpole-v0", **options), [0] * 60)[2])) + 1
    _, rewards, terminated, truncated, _ = rollout(
        gymnasium.make("Animat/Cartpole-v0", episode_limit=falls, **options), [0] * falls
    )
    assert terminated[-1] and not truncated[-1] and rewards[-1] == -100
    _, rewards, terminated, truncated, _ = rollout(
        gymnasium.make("Animat/Cartpole-v0", episode_limit=falls - 1, **options), [0] * (falls - 1)
    )
    assert truncated[-1] and not terminated[-1] and rewards[-1] == 1


def test_robot_parameters_and_mappings_are_options() -> None:
    env = gymnasium.make("Animat/Cartpole-v0", pole_mass_kg=0.55, force_noise=0.0, mapping=Linear()).unwrapped
    assert env.setup.environment == EpisodeLimit(Animat(Cartpole(pole_mass_kg=0.55, force_noise=0.0), Linear(), 5))
    assert env.setup.condition_labels == LABELS
    with pytest.warns(UserWarning, match="the goal cannot be reached: 20 iterations"):
        gymnasium.make("Animat/Navigation-v0", episode_limit=20)


def test_a_goal_replaces_the_task() -> None:
    actions = np.random.default_rng(0).integers(0, 5, 300)
    published = "avoid pole_angle outside -12..12 deg; avoid cart_position outside -0.5..0.5 m"
    own, same = (
        rollout(gymnasium.make("Animat/Cartpole-v0", **options), actions) for options in ({}, {"goal": published})
    )
    for one, another in zip(own[:4], same[:4], strict=True):
        np.testing.assert_array_equal(one, another)
    held = gymnasium.make("Animat/Navigation-v0", goal="drive x in 0..0.4 m")
    observations, rewards, terminated, _, _ = rollout(held, actions)
    assert 0 < rewards.sum() < 300 and not terminated.any()
    x = [quantity.name for quantity in held.unwrapped.setup.environment.observation_spec].index("x")
    np.testing.assert_array_equal(rewards, observations[:, x] <= np.float32(0.4))


def test_a_simulator_decides_how_the_neurons_answer() -> None:
    env = gymnasium.make("Animat/Cartpole-v0", simulator=silenced(synthetic_simulator()), mapping="linear")
    infos = rollout(env, [0, 1, 2, 3, 4])[4]
    assert all(info["rate_hz"] == 0 and info["command"] == -1 for info in infos)


@pytest.mark.oracle
def test_shuffled_delivery_says_what_was_delivered() -> None:
    infos = rollout(gymnasium.make("Animat/Navigation-v0", delivery="shuffled"), [2] * 2000)[4]
    counts = np.bincount([info["delivered"] for info in infos], minlength=5)
    # Binomial(2000, 1/5): a standard deviation of 18.
    assert np.all(np.abs(counts - 400) < 90)


def test_recordings_on_disk_are_the_neurons(tmp_path) -> None:
    write_synthetic_series(0, tmp_path, sessions=2, interval_min=60.0, fatigue_per_h=1.0)
    first, second = (gymnasium.make("Animat/Cartpole-v0", recordings=tmp_path, at_min=m).unwrapped for m in (0, 60))
    assert first.setup.condition_labels == LABELS
    assert first.action_space.n == 5
    medians = [float(env.setup.simulator.percentiles[5]) for env in (first, second)]
    assert medians[0] == pytest.approx(38.7, abs=4)
    assert medians[1] == pytest.approx(38.7 * np.exp(-1), abs=2)
    unsaid = gymnasium.make("Animat/Cartpole-v0", recordings=tmp_path).unwrapped
    assert float(unsaid.setup.simulator.percentiles[5]) == medians[0]
    with pytest.raises(InvalidArgument, match="from the first recording on"):
        gymnasium.make("Animat/Cartpole-v0", recordings=tmp_path, at_min=-1)
    some = gymnasium.make("Animat/Cartpole-v0", recordings=tmp_path, conditions="frequency:5,80")
    assert some.action_space.n == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mapping": "3-thresholds"}, "mapping: expected one of 1-threshold"),
        ({"pole_mass": 1.0}, "cartpole: expected parameters among .*, got 'pole_mass'"),
        ({"recordings": "r", "simulator": synthetic_simulator()}, "recordings, simulator: expected one of them"),
        ({"conditions": "frequency:5,80"}, "conditions: expected only with recordings"),
        ({"at_min": "x", "recordings": "recordings/"}, "at_min: expected a number of minutes, got 'x'"),
        ({"at_min": 140, "simulator": synthetic_simulator()}, "at_min: expected only with recordings"),
        ({"window_ms": (2.0, 8.0)}, "window_ms: expected only with recordings"),
        ({"kind": "empirical"}, "kind: expected only with recordings"),
        ({"maping": "linear"}, "got 'maping'; did you mean mapping\\?$"),
        ({"goals": "reach"}, "got 'goals'; did you mean goal\\?$"),
        ({"name": 3.0}, "cartpole: expected parameters among .*, got 'name'"),
        ({"simulator": "memory"}, "simulator: expected a simulator; `kind` takes the name of one, got 'memory'"),
        ({"recordings": 3}, "recordings: expected a path or several, got 3"),
        ({"recordings": ["r", None]}, "recordings: expected a path or several, got None"),
        ({"delivery": "late"}, "delivery: expected 'chosen' or 'shuffled', got 'late'"),
        ({"window_ms": -4}, "window_ms: expected two numbers of milliseconds, start and end, got -4"),
        ({"window_ms": "28"}, "window_ms: expected two numbers of milliseconds, start and end, got '28'"),
        (
            {"recordings": "r", "window_ms": -4},
            "window_ms: expected two numbers of milliseconds, start and end, got -4",
        ),
        ({"recordings": "missing", "conditions": "frequncy"}, "conditions: expected one of .*; got 'frequncy'"),
        ({"recordings": "r", "window_ms": (2, 4, 8)}, r"window_ms: expected two numbers .*, got \(2, 4, 8\)"),
        ({"goal": "drive speed above 1"}, "goal: .*speed"),
        ({"neural_observation": 1}, "neural_observation: expected True or False, got 1"),
        # All of them before recordings are looked for.
        ({"neural_observation": 1, "recordings": "missing"}, "neural_observation: expected True or False, got 1"),
        ({"delivery": "late", "recordings": "missing"}, "delivery: expected 'chosen' or 'shuffled', got 'late'"),
        ({"mapping": "3-thresholds", "recordings": "missing"}, "mapping: expected one of 1-threshold"),
        ({"readouts": "halfs", "recordings": "missing"}, "readouts: expected all, halves, quadrants, .*, got 'halfs'"),
        ({"readouts": "halves", "recordings": "missing"}, "readouts: .*cartpole"),
        ({"readouts": 3, "recordings": "missing"}, "readouts: expected readouts, such as 'halves', got 3$"),
        ({"kind": "bins", "recordings": "missing"}, "kind: expected one of histogram, empirical, memory, got 'bins'"),
    ],
)
def test_bad_options_are_refused_in_one_line(options: dict, message: str) -> None:
    with pytest.raises(InvalidArgument, match=message):
        gymnasium.make("Animat/Cartpole-v0", **options)
    with pytest.raises(InvalidArgument, match=message):
        gymnasium.make_vec("Animat/Cartpole-v0", num_envs=2, **options)


@pytest.mark.parametrize("action", [-1, 5, 1.5, "2", np.array([1])])
def test_actions_that_are_no_condition_are_refused(action: object) -> None:
    env = gymnasium.make("Animat/Cartpole-v0").unwrapped
    env.reset(seed=0)
    with pytest.raises(InvalidArgument, match="action: expected a condition, a whole number from 0 to 4, got"):
        env.step(action)
    envs = gymnasium.make_vec("Animat/Cartpole-v0", num_envs=2)
    envs.reset(seed=0)
    with pytest.raises(InvalidArgument, match="actions: expected 2 conditions"):
        envs.step(np.array([action, 0]) if np.ndim(action) == 0 else action)


@pytest.mark.parametrize(
    ("actions", "got"),
    [
        (np.full(64, 5), "got 5 for environment 0"),
        (np.array([0] * 63 + [-1]), "got -1 for environment 63"),
        (np.zeros((64, 2), int), r"got an array of int64, shape \(64, 2\)"),
        (np.zeros(64), r"got an array of float64, shape \(64,\)"),
    ],
)
def test_of_many_bad_actions_the_first_is_named_in_one_line(actions: np.ndarray, got: str) -> None:
    envs = gymnasium.make_vec("Animat/Cartpole-v0", num_envs=64)
    envs.reset(seed=0)
    with pytest.raises(InvalidArgument, match=f"^actions: expected 64 conditions, whole numbers from 0 to 4, {got}$"):
        envs.step(actions)
    env = gymnasium.make("Animat/Cartpole-v0").unwrapped
    env.reset(seed=0)
    with pytest.raises(InvalidArgument, match=r"^action: .*$"):
        env.step(np.zeros((64, 2), int))


def test_a_vector_is_of_a_whole_number_and_starts_as_one() -> None:
    with pytest.raises(InvalidArgument, match=r"num_envs: expected a whole number, got 1\.5"):
        gymnasium.make_vec("Animat/Cartpole-v0", num_envs=1.5)
    envs = gymnasium.make_vec("Animat/Cartpole-v0", num_envs=np.int64(2))
    with pytest.raises(InvalidArgument, match="options: expected no 'reset_mask': all episodes are started together"):
        envs.reset(options={"reset_mask": np.array([True, False])})


class Drawn(NamedTuple):
    """Where a drifter is, and the data of the random key of its episode."""

    x_m: Any
    key: Any


@dataclass(frozen=True)
class Drifter(animat.Robot[Drawn]):
    """Is moved by a wind that its episode draws."""

    episode_limit: int = 20
    name: ClassVar[str] = "drifter"

    @property
    def observation_spec(self) -> tuple[animat.Quantity, ...]:
        return (animat.Quantity("x", "m", 1.0),)

    def reset(self, key: Any) -> Drawn:
        return Drawn(jnp.float32(0.0), jax.random.key_data(key))

    def advance(self, uniforms: Any, state: Drawn, u: Any) -> tuple[Drawn, Any, Any]:
        x_m = state.x_m + jax.random.normal(jax.random.wrap_key_data(state.key))
        return state._replace(x_m=x_m), -jnp.abs(x_m), jnp.bool_(False)

    def observe(self, state: Drawn) -> Any:
        return jnp.stack([state.x_m])


@dataclass(frozen=True)
class Listing(Drifter):
    """Observes a list, where the contract is an array."""

    name: ClassVar[str] = "listing"

    def observe(self, state: Drawn) -> Any:
        return [state.x_m]


@dataclass(frozen=True)
class Counter(Drifter):
    """Observes a whole number."""

    name: ClassVar[str] = "counter"

    def observe(self, state: Drawn) -> Any:
        return jnp.round(jnp.stack([state.x_m])).astype(jnp.int32)


def test_whole_numbers_are_observed_as_the_space_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(REGISTRY, "_registered", {**REGISTRY.kinds, "counter": Counter})
    env = gymnasium.make("Animat/Robot-v0", robot="counter").unwrapped
    envs = gymnasium.make_vec("Animat/Robot-v0", num_envs=3, robot="counter")
    for of, action in ((env, np.int64(0)), (envs, np.zeros(3, np.int64))):
        assert of.reset(seed=0)[0] in of.observation_space  # type: ignore[attr-defined]
        observations = of.step(action)[0]  # type: ignore[attr-defined]
        assert observations in of.observation_space  # type: ignore[attr-defined]
        assert (observations == np.round(observations)).all()


def test_a_robot_of_your_own_keeps_every_bit_of_its_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(REGISTRY, "_registered", {**REGISTRY.kinds, "drifter": Drifter})
    env = gymnasium.make("Animat/Robot-v0", robot="drifter")
    env.reset(seed=0)
    # The generator of the environment draws the seed of the episode's key.
    seed = gymnasium.utils.seeding.np_random(0)[0].integers(0, 2**32, 1, dtype=np.uint32)[0]
    wind = float(jax.random.normal(jax.random.key(seed)))
    assert [float(env.step(0)[0][0]) for _ in range(3)] == pytest.approx([wind, 2 * wind, 3 * wind])


def test_a_robot_of_your_own_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(REGISTRY, "_registered", {**REGISTRY.kinds, "listing": Listing})
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(InvalidArgument, match=r"Listing.observe: expected an array, as from jnp.stack, got a list"):
            make("Animat/Robot-v0", robot="listing")


def test_what_the_neurons_remember_is_observed_too() -> None:
    """As the wrapper has it, around the same Animat with the same random numbers; pictures show the robot alone."""
    recorded = extract_responses(synthetic_recording(1, patterns=20, channels=32))
    simulator = fit_memory(recorded, memory=Memory(0.5, 0.5, 0.5, 1.0))
    options = {"simulator": simulator, "neural_observation": True, "render_mode": "rgb_array"}
    env = gymnasium.make("Animat/Cartpole-v0", **options).unwrapped
    envs = gymnasium.make_vec("Animat/Cartpole-v0", num_envs=1, **options)
    direct = NeuralObservation(Animat(Cartpole(), mapping_named("1-threshold"), 5))
    assert [q.name for q in env.setup.environment.observation_spec[-2:]] == ["trace", "load"]
    np.testing.assert_array_equal(env.observation_space.low[-2:], [0, 0])
    np.testing.assert_array_equal(env.observation_space.high[-2:], [1, np.inf])
    assert envs.single_observation_space == env.observation_space and envs.observation_space.shape == (1, 6)
    with pytest.warns(UserWarning, match="maximum value is infinity"):  # of the load, which has no bound
        check_env(gymnasium.make("Animat/Cartpole-v0", **options).unwrapped)

    state, advance = direct.reset(jax.random.key(0)), jax.jit(direct.advance)
    observation, _ = env.reset(seed=3)
    np.testing.assert_array_equal(envs.reset(seed=3)[0][0], observation)
    np.testing.assert_allclose(observation, direct.observe(state))
    rng = np.random.Generator(type(env.np_random.bit_generator)())
    rng.bit_generator.state = env.np_random.bit_generator.state
    remembered = []
    for action in (4, 4, 0, 3, 1):
        observation = env.step(action)[0]
        np.testing.assert_array_equal(envs.step(np.array([action]))[0][0], observation)
        state = advance(jnp.asarray(rng.random(direct.noise_size, np.float32)), state, jnp.int32(action), simulator)
        np.testing.assert_allclose(observation, direct.observe(state), rtol=1e-5, atol=1e-6)
        assert observation in env.observation_space
        remembered.append(tuple(observation[-2:]))
    assert len(set(remembered)) == 5
    assert env.render().shape == envs.render()[0].shape


def test_stepping_or_rendering_before_a_reset_is_refused() -> None:
    env = gymnasium.make("Animat/Cartpole-v0", render_mode="rgb_array").unwrapped
    envs = gymnasium.make_vec("Animat/Cartpole-v0", num_envs=2, render_mode="rgb_array")
    for call in (lambda: env.step(0), env.render, lambda: envs.step(np.zeros(2, int)), envs.render):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"expected .* that reset\(\) started"):
            call()
    with pytest.raises(InvalidArgument, match="render_mode: expected 'rgb_array' or None, got 'human'"):
        type(env)("cartpole", render_mode="human")
    with pytest.raises(InvalidArgument, match="num_envs: expected at least 1, got 0"):
        type(envs)("cartpole", 0)


@pytest.mark.parametrize("id_", IDS)
def test_a_vector_has_gymnasiums_form(id_: str) -> None:
    envs = gymnasium.make_vec(id_, num_envs=7)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    observations, info = envs.reset(seed=0)
    assert observations in envs.observation_space and info == {}
    for _ in range(150):
        observations, rewards, terminated, truncated, info = envs.step(envs.action_space.sample())
        assert observations in envs.observation_space
        assert (rewards.shape, rewards.dtype) == ((7,), np.float32)
        assert terminated.dtype == truncated.dtype == np.bool_
        assert not np.any(terminated & truncated)
        assert set(info) == {"delivered", "rate_hz", "command", "_delivered", "_rate_hz", "_command"}


def test_an_ended_episode_is_followed_by_a_new_one_in_the_next_step() -> None:
    envs = gymnasium.make_vec("Animat/Cartpole-v0", num_envs=16)
    envs.reset(seed=1)
    ended = np.zeros(16, bool)
    n_begun = 0
    for _ in range(200):
        observations, rewards, terminated, truncated, info = envs.step(np.full(16, 4))
        np.testing.assert_array_equal(observations[ended], 0)
        np.testing.assert_array_equal(rewards[ended], 0)
        np.testing.assert_array_equal(info["_command"], ~ended)
        assert not (terminated | truncated)[ended].any()
        np.testing.assert_array_equal(rewards[~ended], np.where(terminated[~ended], -100, 1))
        n_begun += int(ended.sum())
        ended = terminated | truncated
    assert n_begun > 50


def test_a_vector_of_one_is_the_single_environment() -> None:
    """Until the first episode ends, both take the same numbers from generators of the same seed."""
    actions = np.random.default_rng(0).integers(0, 5, 100)
    env, envs = gymnasium.make("Animat/Navigation-v0"), gymnasium.make_vec("Animat/Navigation-v0", num_envs=1)
    start, _ = env.reset(seed=5)
    np.testing.assert_array_equal(envs.reset(seed=5)[0][0], start)
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        many = envs.step(np.array([action]))
        np.testing.assert_array_equal(many[0][0], observation)
        assert (many[1][0], many[2][0], many[3][0]) == (np.float32(reward), terminated, truncated)
        assert {name: many[4][name][0] for name in info} == info
        if terminated or truncated:
            return
    pytest.fail("expected the episode to end within its limit of 100")


def test_a_seed_decides_a_whole_vector() -> None:
    def play(seed: int) -> np.ndarray:
        envs = gymnasium.make_vec("Animat/Cartpole-v0", num_envs=4)
        envs.reset(seed=seed)
        return np.array([envs.step(np.full(4, i % 5))[0] for i in range(80)])

    np.testing.assert_array_equal(play(2), play(2))
    assert np.any(play(2) != play(3))
    assert np.all(np.std(play(2)[10], axis=0) > 0)  # the environments differ from one another


@pytest.mark.oracle
def test_vector_and_single_have_the_same_returns() -> None:
    """Mean return of random play over whole episodes, by both; the standard error of the difference decides."""

    def returns_of_single() -> np.ndarray:
        env, rng, returns = gymnasium.make("Animat/Cartpole-v0").unwrapped, np.random.default_rng(0), []
        env.reset(seed=0)
        while len(returns) < 400:
            total, ended = 0.0, False
            while not ended:
                _, reward, terminated, truncated, _ = env.step(rng.integers(5))
                total, ended = total + reward, terminated or truncated
            returns.append(total)
            env.reset()
        return np.array(returns)

    def returns_of_vector() -> np.ndarray:
        envs, rng = gymnasium.make_vec("Animat/Cartpole-v0", num_envs=400), np.random.default_rng(1)
        envs.reset(seed=0)
        totals, going = np.zeros(400), np.ones(400, bool)
        while going.any():
            _, rewards, terminated, truncated, _ = envs.step(rng.integers(0, 5, 400))
            totals += rewards * going
            going &= ~(terminated | truncated)
        return totals

    single, vector = returns_of_single(), returns_of_vector()
    error = np.sqrt(single.var() / 400 + vector.var() / 400)
    assert abs(single.mean() - vector.mean()) < 4 * error
    assert -90 < vector.mean() < -70


@pytest.mark.oracle
@pytest.mark.parametrize("id_", IDS)
def test_pictures_show_the_robot_as_it_moves(id_: str) -> None:
    env = gymnasium.make(id_, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for _ in range(5):
        env.step(4)
    later = env.render()
    assert first.dtype == np.uint8 and first.ndim == 3 and first.shape == later.shape
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 10
    assert np.any(first != later)
    envs = gymnasium.make_vec(id_, num_envs=3, render_mode="rgb_array")
    envs.reset(seed=0)
    envs.step(np.zeros(3, int))
    assert [picture.shape for picture in envs.render()] == [first.shape] * 3


@pytest.mark.oracle
def test_what_is_found_in_several_recordings_is_warned_of_once(tmp_path: Path) -> None:
    for number in range(3):
        synthetic = synthetic_recording(1, start_min=30.0 * number, patterns=4, channels=16)
        write_nwb(synthetic, tmp_path / f"{number}.nwb")
    with pytest.warns(UserWarning) as warned:
        gymnasium.make("Animat/Cartpole-v0", recordings=tmp_path)
    few = [str(each.message) for each in warned if "a distribution needs 30 or more" in str(each.message)]
    assert len(few) == 1
    assert few[0].endswith("more like it)")


def test_a_window_is_refused_with_what_to_do_instead() -> None:
    with pytest.raises(InvalidArgument, match="make shows these pictures in a window, with pygame"):
        gymnasium.make_vec("Animat/Cartpole-v0", num_envs=2, render_mode="human")


def test_without_a_render_mode_a_picture_is_refused_with_a_warning() -> None:
    env = gymnasium.make("Animat/Cartpole-v0").unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_pictures_come_as_fast_as_the_robot_moves() -> None:
    assert gymnasium.make("Animat/SwingUp-v0").metadata["render_fps"] == 20
    assert gymnasium.make("Animat/SwingUp-v0", step_s=0.1).metadata["render_fps"] == 10
    assert gymnasium.make("Animat/Cartpole-v0").metadata["render_fps"] == 50
    assert gymnasium.make_vec("Animat/SwingUp-v0", 2).metadata["render_fps"] == 20
    assert gymnasium.make("Animat/Cartpole-v0").metadata["render_fps"] == 50


def test_a_limit_by_another_name_is_refused_with_ours() -> None:
    with pytest.raises(InvalidArgument, match="'max_episode_steps': the robot's own is episode_limit"):
        gymnasium.make_vec("Animat/Cartpole-v0", 2, max_episode_steps=4)


def test_an_id_with_a_robot_takes_no_other() -> None:
    for make in (gymnasium.make, partial(gymnasium.make_vec, num_envs=2)):
        with pytest.raises(InvalidArgument, match="the id names the cartpole, got 'shuttle': use Animat/Robot-v0"):
            make("Animat/Cartpole-v0", robot="shuttle")
    assert gymnasium.make("Animat/Cartpole-v0", robot="cartpole").unwrapped.setup.environment.robot == Cartpole()


GOAL = "drive cart_position in -0.5..0.5 m; avoid pole_angle outside -12..12 deg"


def test_the_outcome_of_a_goal_is_told_at_the_end_of_an_episode() -> None:
    """Against the same goal, judged by the observations of the whole episode."""
    env = gymnasium.make("Animat/Cartpole-v0", goal=GOAL, episode_limit=15)
    robot, found = env.unwrapped.setup.environment.robot, []
    for seed in range(8):
        seen, ended = [env.reset(seed=seed)[0]], False
        while not ended:
            observation, _, terminated, truncated, info = env.step(4 if seen[-1][2] > 0 else 0)
            seen.append(observation)
            ended = terminated or truncated
            assert ("is_success" in info) == ended
        expected = robot.outcome_of(np.array(seen))
        assert info["is_success"] is bool(expected.succeeded)
        np.testing.assert_allclose(info["satisfaction"], expected.satisfaction, rtol=1e-6)
        assert info["margin"] == pytest.approx(float(expected.margin), rel=1e-6)
        found.append(info["is_success"])
    assert len({*found}) == 2


def test_outcomes_in_a_vector_are_those_of_the_episodes_that_ended() -> None:
    envs = gymnasium.make_vec("Animat/Cartpole-v0", 6, goal=GOAL, episode_limit=15)
    envs.reset(seed=1)
    told = 0
    for _ in range(40):
        *_, terminated, truncated, info = envs.step(np.full(6, 4))
        ended = terminated | truncated
        assert ("is_success" in info) == ended.any()
        if ended.any():
            np.testing.assert_array_equal(info["_is_success"], ended)
            # A fall is no success.
            assert not info["is_success"][terminated].any()
            told += int(ended.sum())
    assert told > 6


def test_a_step_after_the_end_is_warned_of_once_an_episode() -> None:
    env = gymnasium.make("Animat/Cartpole-v0", episode_limit=3).unwrapped
    for _ in range(2):
        env.reset(seed=1)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for _ in range(3):
                env.step(0)
        with pytest.warns(UserWarning, match=r"the episode has ended: call reset\(\)") as said:
            env.step(0)
            env.step(0)
        assert len(said) == 1
