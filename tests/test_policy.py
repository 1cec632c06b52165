"""Policies: numpy against JAX, files that come back equal, bad files refused in one line, no JAX to load or act."""

from __future__ import annotations

import itertools
import json
import math
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load, save
from scipy import stats

from animat.cli.command import simulator_settings
from animat.closed_loop.loop import Loop
from animat.coding.mapping import mapping_named
from animat.errors import InvalidArgument, InvalidFile, UnusableData
from animat.neurons.timeline import SimulatorKind
from animat.responses.condition import Condition
from animat.responses.conditions import conditions_named
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation
from animat.stimulation.protocol import Presentation
from animat.training.networks import Layer, forward
from animat.training.policy import Policy, load_policies
from animat.training.settings import SimulatorProvenance, TrainingProvenance
from animat.training.specification import Percentiles
from animat.wrappers import Delivery

CONDITIONS = tuple(Condition(f"{f} Hz", float(f), "Hz") for f in (5, 10, 20, 40, 80))


def layers(seed: int, *sizes: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    pairs = list(itertools.pairwise(sizes))
    return {
        "weights": tuple(rng.normal(0, 0.7, pair).astype(np.float32) for pair in pairs),
        "biases": tuple(rng.normal(0, 0.7, pair[1]).astype(np.float32) for pair in pairs),
    }


def through_neurons(seed: int = 0, hidden: int = 64) -> Policy:
    return Policy(
        **layers(seed, 4, hidden, hidden, 5),
        scales=np.array([0.5, 1.0, 0.2, 2.0], np.float32),
        robot=Cartpole(pole_mass_kg=0.06, episode_limit=77),
        mapping=mapping_named("9-thresholds"),
        conditions=CONDITIONS,
        window_ms=(2.0, 10.0),
        presentation=Presentation("mixed", 5),
        provenance={"fingerprint": "abc", "training": {"seed": 3, "µ": [1.5, None]}},
        learning_curve=np.array([[100.0, 0.0, np.nan, 1.6, 0.1, 2.5], [200.0, 3.0, -80.25, 1.5, 0.09, 1.25]]),
    )


def two_forces() -> Policy:
    return Policy(
        **layers(1, 4, 8, 8, 2), scales=np.ones(4, np.float32), robot=Cartpole(), mapping=None, commands=(-1, 1)
    )


def continuous(mean: float | None = None, log_std: float = 0.0) -> Policy:
    n = len(Navigation().observation_spec)
    parts = layers(2, n, 8, 8, 2)
    if mean is not None:
        parts["weights"] = (*parts["weights"][:-1], np.zeros((8, 2), np.float32))
        parts["biases"] = (*parts["biases"][:-1], np.array([mean, log_std], np.float32))
    return Policy(**parts, scales=np.ones(n, np.float32), robot=Navigation(), mapping=None)


# --- acting ---------------------------------------------------------------------------------------------------------


def test_a_flag_of_numpy_can_be_saved(tmp_path: Path) -> None:
    seeing = {**layers(0, 6, 8, 8, 5), "scales": np.ones(6, np.float32), "neural_observation": np.True_}
    replace(through_neurons(), **seeing).save(tmp_path / "p0.safetensors")
    assert Policy.load(tmp_path / "p0.safetensors").neural_observation is True


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_numpy_answers_as_jax_does(seed: int) -> None:
    policy = through_neurons(seed % 5)
    observation = np.random.default_rng(seed).normal(0, 1, 4).astype(np.float32) * policy.scales
    network = tuple(
        Layer(jnp.asarray(w), jnp.asarray(b)[None]) for w, b in zip(policy.weights, policy.biases, strict=True)
    )
    expected = np.asarray(forward(network, jnp.asarray(observation / policy.scales)[None])[0])
    # a sum of 64 float32 products, in another order
    np.testing.assert_allclose(
        policy.outputs(observation), expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max() + 2e-5
    )
    exact = observation.astype(np.float64) / policy.scales
    for w, b in zip(policy.weights[:-1], policy.biases[:-1], strict=True):
        exact = np.maximum(exact @ w.astype(np.float64) + b, 0)
    exact = exact @ policy.weights[-1].astype(np.float64) + policy.biases[-1]
    np.testing.assert_allclose(policy.outputs(observation.astype(np.float64)), exact, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(policy.outputs(jnp.asarray(observation)), policy.outputs(observation))


@pytest.mark.oracle
def test_actions_are_drawn_as_often_as_their_probabilities_say() -> None:
    policy, rng = through_neurons(), np.random.default_rng(4)
    policy = replace(policy, weights=tuple(0.3 * w for w in policy.weights))
    observation = np.array([0.1, -0.3, 0.02, 0.5])
    drawn = [policy.act(observation, rng) for _ in range(20_000)]
    assert all(isinstance(action, int) for action in drawn)
    logits = policy.outputs(observation).astype(np.float64)
    expected = len(drawn) * np.exp(logits) / np.exp(logits).sum()
    np.testing.assert_allclose(policy.probabilities(observation), expected / len(drawn), rtol=1e-5)
    assert stats.chisquare(np.bincount(drawn, minlength=5), expected).pvalue > 1e-3
    assert policy.act_greedily(observation) == int(np.argmax(expected))


@pytest.mark.parametrize("make", [through_neurons, two_forces, continuous])
@pytest.mark.parametrize("shape", [(), (1,), (1, -1), (6, -1), (9,)])
def test_an_observation_of_another_shape_is_refused(make: Callable[[], Policy], shape: tuple[int, ...]) -> None:
    policy = make()
    n = len(policy.scales)
    shape = tuple(n if size == -1 else size for size in shape)
    for act in (policy.act_greedily, lambda seen: policy.act(seen, np.random.default_rng(0)), policy.outputs):
        with pytest.raises(InvalidArgument) as raised:
            act(np.zeros(shape))
        message = f"observation: expected one of {policy.robot.name}, shape ({n},), got shape {shape}"
        assert str(raised.value) == message
        # A list is as good as an array.
        np.testing.assert_array_equal(act([0.0] * n), act(np.zeros(n)))  # type: ignore[arg-type]


def test_a_decided_policy_always_acts_the_same() -> None:
    policy = through_neurons()
    biases = (*policy.biases[:-1], np.array([-1e4, -1e4, 1e4, -1e4, -1e4], np.float32))
    policy = replace(policy, biases=biases)
    rng = np.random.default_rng(0)
    assert {policy.act(np.zeros(4), rng) for _ in range(100)} == {2}
    assert np.all(np.isfinite(policy.probabilities(np.zeros(4))))


@pytest.mark.parametrize(("mean", "log_std"), [(0.4, -0.7), (-1.0, -9.0), (0.0, 5.0)])
def test_continuous_commands_follow_the_squashed_normal(mean: float, log_std: float) -> None:
    policy, rng = continuous(mean, log_std), np.random.default_rng(5)
    observation = np.zeros(len(policy.scales))
    drawn = np.array([policy.act(observation, rng) for _ in range(4000)])
    assert np.all(np.abs(drawn) <= 1)
    expected = stats.norm(mean, math.exp(min(max(log_std, -5.0), 2.0)))
    assert stats.kstest(drawn, lambda a: expected.cdf(np.arctanh(np.clip(a, -1 + 1e-12, 1 - 1e-12)))).pvalue > 1e-3
    assert policy.act_greedily(observation) == pytest.approx(math.tanh(mean), abs=1e-6)


# --- files ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [through_neurons, two_forces, continuous])
def test_a_policy_comes_back_equal(make: Callable[[], Policy], tmp_path: Path) -> None:
    policy = make()
    policy.save(tmp_path / "p0.safetensors")
    back = Policy.load(tmp_path / "p0.safetensors")
    for name in ("scales", "learning_curve"):
        np.testing.assert_array_equal(getattr(back, name), getattr(policy, name))
    for name in ("weights", "biases"):
        for got, expected in zip(getattr(back, name), getattr(policy, name), strict=True):
            np.testing.assert_array_equal(got, expected)
            assert got.dtype == np.float32
    for name in ("robot", "mapping", "conditions", "commands", "window_ms", "presentation", "provenance", "n_actions"):
        assert getattr(back, name) == getattr(policy, name), name
    observation = np.linspace(-0.1, 0.2, len(policy.scales))
    assert back.act(observation, np.random.default_rng(1)) == policy.act(observation, np.random.default_rng(1))


def test_the_file_and_the_docs_are_enough_to_run_the_network_without_this_package(tmp_path: Path) -> None:
    # As a stranger would: only what the file says, in double precision.
    policy = through_neurons()
    policy.save(tmp_path / "p0.safetensors")
    with safe_open(tmp_path / "p0.safetensors", framework="numpy") as file:
        assert json.loads(file.metadata()["animat"])["hidden_activation"] == "relu"
        layers = [(file.get_tensor(f"layer{i}.weight"), file.get_tensor(f"layer{i}.bias")) for i in range(3)]
        observation = np.linspace(-0.1, 0.2, 4)
        x = observation / file.get_tensor("scales").astype(np.float64)
    for i, (weight, bias) in enumerate(layers):
        x = x @ weight.astype(np.float64) + bias
        x = np.where(x > 0, x, 0) if i < 2 else x
    np.testing.assert_allclose(policy.outputs(observation), x, rtol=1e-4, atol=1e-5)


def test_a_file_from_before_the_activation_was_said_is_read_and_another_activation_refused(tmp_path: Path) -> None:
    with safe_open(resaved(tmp_path), framework="numpy") as file:
        described = json.loads(file.metadata()["animat"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    refused(resaved(tmp_path, hidden_activation="tanh"), "expected hidden layers of 'relu', got 'tanh'")
    del described["hidden_activation"]
    (tmp_path / "old.safetensors").write_bytes(save(arrays, {"animat": json.dumps(described)}))
    assert Policy.load(tmp_path / "old.safetensors").robot.name == "cartpole"


def test_saving_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        through_neurons().save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_loading_and_acting_needs_no_jax(tmp_path: Path) -> None:
    through_neurons().save(tmp_path / "p0.safetensors")
    continuous().save(tmp_path / "p1.safetensors")
    program = """
import sys
sys.modules["jax"] = sys.modules["jaxlib"] = None  # an import of either raises ImportError
import numpy as np
from animat.training.policy import load_policies
for policy in load_policies(sys.argv[1]).values():
    rng = np.random.default_rng(0)
    print(policy.act(np.zeros(len(policy.scales)), rng), policy.act_greedily(np.zeros(len(policy.scales))))
"""
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 2


def test_policies_of_a_folder_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for i in (10, 2, 0, 1):
        two_forces().save(tmp_path / f"p{i}.safetensors")
    (tmp_path / "training.json").write_text("{}")
    assert list(load_policies(tmp_path)) == ["p0", "p1", "p2", "p10"]
    assert list(load_policies(tmp_path / "p2.safetensors")) == ["p2"]


def test_what_a_killed_process_left_half_written_is_no_policy(tmp_path: Path) -> None:
    two_forces().save(tmp_path / "p0.safetensors")
    whole = (tmp_path / "p0.safetensors").read_bytes()
    (tmp_path / ".p1.safetensors.abcd.partial.safetensors").write_bytes(whole[: len(whole) // 2])
    assert list(load_policies(tmp_path)) == ["p0"]


# --- bad ones -------------------------------------------------------------------------------------------------------


def refused(path: Path, *words: str) -> None:
    """Loading says in one line which file it is, and what is wrong with it."""
    with pytest.raises(InvalidFile) as raised:
        load_policies(path)
    message = str(raised.value)
    assert "\n" not in message and str(path) in message
    for word in words:
        assert word in message


def resaved(tmp_path: Path, arrays: dict[str, Any] | None = None, **described: Any) -> Path:
    """A whole policy's file with some of its arrays, or of what its metadata describes, replaced."""
    through_neurons().save(tmp_path / "good.safetensors")
    data = (tmp_path / "good.safetensors").read_bytes()
    length = int.from_bytes(data[:8], "little")
    metadata = json.loads(data[8 : 8 + length])["__metadata__"]
    metadata["animat"] = json.dumps(json.loads(metadata["animat"]) | described)
    path = tmp_path / "bad.safetensors"
    kept = {name: array for name, array in (load(data) | (arrays or {})).items() if array is not None}
    path.write_bytes(save(kept, metadata))
    return path


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    refused(tmp_path / "none.safetensors", "no such file")
    refused(tmp_path, "*.safetensors", "got none")


def test_what_may_not_be_read_is_refused_for_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # safetensors calls it missing. Root may read everything, so the answer of the system is given here.
    path = resaved(tmp_path)
    monkeypatch.setattr("os.access", lambda asked, mode: asked != path)
    refused(path, "cannot be read: Permission denied")


@pytest.mark.parametrize("kept", [0, 7, 8, 100, -1])
def test_a_truncated_file_is_refused(kept: int, tmp_path: Path) -> None:
    path = tmp_path / "p0.safetensors"
    through_neurons().save(path)
    path.write_bytes(path.read_bytes()[:kept])
    refused(path, "cannot be read")


@pytest.mark.parametrize("content", [b"\x00" * 64, b"not safetensors at all, but long enough to be read"])
def test_a_file_of_something_else_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "p0.safetensors"
    path.write_bytes(content)
    refused(path, "cannot be read")


@pytest.mark.parametrize("metadata", [None, {"format": "pt"}])
def test_others_safetensors_are_refused(metadata: dict[str, str] | None, tmp_path: Path) -> None:
    path = tmp_path / "p0.safetensors"
    path.write_bytes(save({"layer0.weight": np.zeros((2, 2), np.float32)}, metadata))
    refused(path, "expected a policy")


@pytest.mark.parametrize(
    "described",
    [
        {"robot": None},
        {"robot": 5},
        {"robot": {}},
        {"robot": {"name": "unicycle"}},
        {"robot": {"name": "cartpole", "pole_mass_kg": "heavy"}},
        {"robot": {"name": "navigation"}},
        {"mapping": "3-thresholds"},
        {"mapping": 4},
        {"conditions": None},
        {"conditions": [{"label": "5 Hz"}]},
        {"conditions": [{"label": "5 Hz", "value": 5.0, "unit": "Hz"}]},
        {"conditions": 3},
        {"commands": 7, "mapping": None},
        {"commands": [-1.0, -0.5, 0.0, 0.5, 2.0], "mapping": None},
        {"window_ms": 3},
        {"window_ms": [2.0]},
        {"presentation": {"order": "sideways", "pulses": 5}},
        {"presentation": [1, 2]},
        {"provenance": None},
        {"provenance": [1]},
        {"provenance": {"simulators": {"range_hz": 10**400}}},
        {"window_ms": [2, 10**400]},
    ],
    ids=str,
)
def test_metadata_that_does_not_fit_is_refused(described: dict[str, Any], tmp_path: Path) -> None:
    refused(resaved(tmp_path, **described))


@pytest.mark.parametrize(
    "arrays",
    [
        {"layer1.weight": np.full((64, 64), np.nan, np.float32)},
        {"layer1.bias": np.full(64, np.inf, np.float32)},
        {"scales": np.zeros(4, np.float32)},
        {"scales": np.ones(3, np.float32)},
        {"layer0.weight": np.zeros((3, 64), np.float32)},
        {"layer2.weight": np.zeros((64, 4), np.float32)},
        {"layer1.weight": np.zeros(64, np.float32)},
        {"layer1.bias": np.zeros((1, 1), np.float32)},
        {"layer1.bias": None},
        {"layer1.weight": None},
        {"scales": None},
        {"learning_curve": None},
        {"learning_curve": np.zeros((2, 2))},
    ],
    ids=lambda arrays: ",".join(f"{name}:{getattr(array, 'shape', None)}" for name, array in arrays.items()),
)
def test_arrays_that_do_not_fit_are_refused(arrays: dict[str, Any], tmp_path: Path) -> None:
    refused(resaved(tmp_path, arrays))


@pytest.mark.parametrize("described", ["{", "[]", "null", '"a"', json.dumps({"format": "animat-policy-99"})])
def test_metadata_that_is_of_another_form_is_refused(described: str, tmp_path: Path) -> None:
    path = tmp_path / "p0.safetensors"
    path.write_bytes(save({"scales": np.ones(4, np.float32)}, {"animat": described}))
    refused(path)


def test_an_unwritable_place_is_one_line_and_the_old_file_stays(tmp_path: Path) -> None:
    path = tmp_path / "p0.safetensors"
    two_forces().save(path)
    before = path.read_bytes()
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidFile, match="cannot be written"):
        two_forces().save(tmp_path / "file" / "p1.safetensors")
    assert path.read_bytes() == before


@pytest.mark.parametrize("sizes", [(4, 8, 8, 4), (4, 8, 5), (4, 8, 8, 8, 5)])
def test_weights_that_do_not_fit_are_refused(sizes: tuple[int, ...]) -> None:
    with pytest.raises(
        InvalidArgument, match=r"^weights: expected three layers from 4 observations of cartpole to 5 output"
    ):
        replace(through_neurons(), **layers(0, *sizes))
    with pytest.raises(InvalidArgument, match=r"^biases: expected finite numbers"):
        replace(two_forces(), biases=(*two_forces().biases[:-1], np.array([np.nan, 0], np.float32)))


# --- policies made by hand ------------------------------------------------------------------------------------------

STRANGE = (
    None,
    True,
    0,
    -1,
    1.5,
    10**9,
    10**400,
    float("nan"),
    float("inf"),
    "",
    "1",
    "first",
    "a\nb",
    [],
    [0],
    {},
    [[]],
)


def places(node: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where every value of a policy's metadata stands."""
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [place for key, value in inner for place in ((*at, key), *places(value, (*at, key)))]


def taken_apart(policy: Policy, tmp_path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays of a policy's file, and its metadata."""
    policy.save(tmp_path / "whole.safetensors")
    data = (tmp_path / "whole.safetensors").read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return load(data), json.loads(header["__metadata__"]["animat"])


TRAINED: dict[str, Any] = {
    "fingerprint": "abc",
    "training": {"shadowing": True, "duration_min": 60.0, "chunks": 60, "percentiles": "first", "delivery": "chosen"},
    "simulators": {
        "kind": "histogram",
        "bins": 20,
        "range_hz": None,
        "by": "frequency:5,10",
        "burst_threshold": 0.4,
        "recorded_at_min": [0.0, 10.0],
    },
}


def test_what_was_checked_stays_as_it_is(tmp_path: Path) -> None:
    given = two_forces()
    weight = given.weights[2].copy()
    policy = replace(given, weights=(*given.weights[:2], weight))
    weight[:] = np.nan
    assert np.isfinite(policy.weights[2]).all()
    for array in (*policy.weights, *policy.biases, policy.scales, policy.learning_curve, policy.assessments):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
    policy.save(tmp_path / "p0.safetensors")
    for other in (Policy.load(tmp_path / "p0.safetensors"), pickle.loads(pickle.dumps(policy))):
        with pytest.raises(ValueError, match="read-only"):
            other.weights[0][0] = 1.0


SWAPS = [{"chunk": 0, "recorded_at_min": 100.0}, {"chunk": 7, "recorded_at_min": 107.5}]


@pytest.mark.parametrize(
    ("changed", "until_min"),
    [
        ({}, 159.0),
        ({"shadowing": "drawn", "duration_min": 30.0}, 129.5),
        ({"shadowing": False}, 100.0),
        ({"duration_min": None}, 100.0),
    ],
)
def test_training_ends_with_the_simulator_of_its_last_part(changed: dict[str, Any], until_min: float) -> None:
    provenance = {"training": TRAINED["training"] | changed}
    assert replace(two_forces(), provenance=provenance).trained_until_min(100.0) == until_min
    assert replace(two_forces(), provenance={}).trained_until_min(100.0) is None


@pytest.mark.parametrize(("first_min", "until_min"), [(0.0, 107.5), (120.0, 120.0)])
def test_live_training_ends_with_the_simulator_that_it_last_took(first_min: float, until_min: float) -> None:
    """However long it was to take: it may have been interrupted."""
    assert replace(two_forces(), provenance={**TRAINED, "swaps": SWAPS}).trained_until_min(first_min) == until_min


def used(policy: Policy) -> None:
    """What a closed loop and an evaluation read of a policy, before a culture is opened."""
    assert math.isfinite(policy.act(np.zeros(len(policy.scales), np.float32), np.random.default_rng(0)))
    assert math.isfinite(policy.act_greedily(np.full(len(policy.scales), 10.0, np.float32)))
    simulator_settings(policy.fitted, None, None, None)
    if policy.fitted.get("by") is not None:
        with suppress(InvalidArgument):
            conditions_named(policy.fitted["by"])
    until_min = policy.trained_until_min(0.0)
    assert until_min is None or math.isfinite(until_min)
    assert policy.percentiles in ("moving", "first") and policy.delivery in ("chosen", "shuffled")
    with suppress(UnusableData):
        loop, _ = Loop.of_policy(policy, np.zeros(11))
        json.dumps(loop.to_dict())


def change_everything(make: Callable[[], Policy], tmp_path: Path, every: int) -> int:
    """Give values of the metadata, one in so many, another type; returns how many files were refused."""
    arrays, whole = taken_apart(replace(make(), provenance={**TRAINED, "swaps": SWAPS}), tmp_path)
    path, refusals = tmp_path / "p0.safetensors", 0
    for place, strange in list(itertools.product(places(whole), ("left out", *STRANGE)))[::every]:
        changed = json.loads(json.dumps(whole))
        node = changed
        for key in place[:-1]:
            node = node[key]
        if strange == "left out":
            del node[place[-1]]
        else:
            node[place[-1]] = strange
        path.write_bytes(save(arrays, {"animat": json.dumps(changed)}))
        try:
            loaded = Policy.load(path)
        except InvalidFile as error:
            message = str(error)
            assert str(path) in message and "\n" not in message and len(message) < 1000, (place, strange)
            refusals += 1
        else:
            used(loaded)
    return refusals


MAKES = [through_neurons, two_forces, continuous]


@pytest.mark.parametrize("make", [MAKES[0], *(pytest.param(make, marks=pytest.mark.oracle) for make in MAKES[1:])])
def test_metadata_of_another_type_are_refused_or_mean_something(make: Callable[[], Policy], tmp_path: Path) -> None:
    assert change_everything(make, tmp_path, 5) > 50


@pytest.mark.oracle
@pytest.mark.parametrize("make", MAKES)
def test_metadata_of_every_other_type_are_refused_or_mean_something(make: Callable[[], Policy], tmp_path: Path) -> None:
    assert change_everything(make, tmp_path, 1) > 300


@pytest.mark.parametrize(
    "metadata", ['{"format": ' + "9" * 5000 + "}", "[" * 100_000, '{"format": "animat-policy-1", "a": ' + "[" * 100_000]
)
def test_metadata_without_end_are_refused(metadata: str, tmp_path: Path) -> None:
    arrays, _ = taken_apart(through_neurons(), tmp_path)
    (tmp_path / "p0.safetensors").write_bytes(save(arrays, {"animat": metadata}))
    refused(tmp_path / "p0.safetensors", "metadata")


@pytest.mark.parametrize("value", [3e38, -3e38, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["layer0.weight", "layer1.bias", "layer2.weight", "scales"])
def test_weights_of_which_no_action_can_be_made_are_refused(name: str, value: float, tmp_path: Path) -> None:
    part = {"weight": "weights", "bias": "biases", "scales": "scales"}[name.rpartition(".")[2]]
    array = np.ones({"layer0.weight": (4, 64), "layer1.bias": (64,), "layer2.weight": (64, 5), "scales": (4,)}[name])
    array.flat[-1] = value
    with np.errstate(over="ignore"):
        refused(resaved(tmp_path, {name: array.astype(np.float32)}), part)


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int32, np.uint8, np.bool_])
def test_weights_of_another_type_are_refused(dtype: Any, tmp_path: Path) -> None:
    refused(resaved(tmp_path, {"layer1.weight": np.ones((64, 64), dtype)}), "float32" if dtype == np.float64 else "F32")


def test_networks_of_another_build_are_refused(tmp_path: Path) -> None:
    empty = {"layer0.weight": np.zeros((4, 0)), "layer0.bias": np.zeros(0), "layer1.weight": np.zeros((0, 64))}
    refused(resaved(tmp_path, {name: array.astype(np.float32) for name, array in empty.items()}), "three layers")
    refused(resaved(tmp_path, {"more": np.zeros(3, np.float32)}), "expected a policy's arrays", "more")
    refused(resaved(tmp_path, {"scales": np.full(4, 1e-40, np.float32)}), "scales")
    for shape in ((5,), (2, 4), (1, 2, 5)):
        refused(resaved(tmp_path, {"assessments": np.zeros(shape)}), "assessments: expected rows of five")


def test_only_policies_with_neurons_see_their_history_state_which_numpy_may_say(tmp_path: Path) -> None:
    seeing = {**layers(0, 6, 8, 8, 5), "scales": np.ones(6, np.float32), "neural_observation": np.True_}
    replace(through_neurons(), **seeing).save(tmp_path / "p0.safetensors")
    assert Policy.load(tmp_path / "p0.safetensors").neural_observation is True
    with pytest.raises(InvalidArgument, match="neural_observation: expected only with a mapping, got no mapping"):
        replace(two_forces(), **(seeing | layers(0, 6, 8, 8, 2)))


def test_what_is_read_of_a_provenance_is_what_training_writes() -> None:
    hints = get_type_hints(TrainingProvenance) | get_type_hints(SimulatorProvenance)
    for name, choices in (("kind", SimulatorKind), ("percentiles", Percentiles), ("delivery", Delivery)):
        assert get_args(hints[name]) == get_args(choices)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_an_observation_that_is_not_finite_is_no_action(wrong: float) -> None:
    policy = through_neurons()
    observation = np.zeros(len(policy.scales))
    observation[-1] = wrong
    for act in (policy.act_greedily, policy.probabilities, lambda seen: policy.act(seen, np.random.default_rng(1))):
        with pytest.raises(InvalidArgument, match="observation: expected finite numbers, got"):
            act(observation)


def test_an_action_is_drawn_from_a_generator_only() -> None:
    with pytest.raises(InvalidArgument, match=r"rng: expected a generator, such as .*, got 0"):
        through_neurons().act(np.zeros(4), 0)  # type: ignore[arg-type]


def test_a_folder_that_cannot_be_read_is_not_taken_for_one_without_policies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(InvalidFile, match=r"cannot be read: Permission denied$"):
        load_policies(tmp_path)
