"""Policies: numpy against JAX, files that come back equal, bad files refused in one line, no JAX to load or act."""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save
from scipy import stats

from animat.errors import InvalidArgument, InvalidFile
from animat.mapping import mapping_named
from animat.neurons.conditions import Condition
from animat.recordings.protocol import Presentation
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation
from animat.training.policy import Policy, load_policies
from animat.training.sac import Layer, forward

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
        learning_curve=np.array([[100.0, 0.0, np.nan], [200.0, 3.0, -80.25]]),
    )


def two_forces() -> Policy:
    return Policy(
        **layers(1, 4, 8, 8, 2), scales=np.ones(4, np.float32), robot=Cartpole(), mapping=None, commands=(-1, 1)
    )


def continuous(mean: float | None = None, log_std: float = 0.0) -> Policy:
    n = len(Navigation().quantities)
    parts = layers(2, n, 8, 8, 2)
    if mean is not None:
        parts["weights"] = (*parts["weights"][:-1], np.zeros((8, 2), np.float32))
        parts["biases"] = (*parts["biases"][:-1], np.array([mean, log_std], np.float32))
    return Policy(**parts, scales=np.ones(n, np.float32), robot=Navigation(), mapping=None)


# --- acting ---------------------------------------------------------------------------------------------------------


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
        {"window_ms": 3},
        {"window_ms": [2.0]},
        {"presentation": {"order": "sideways", "pulses": 5}},
        {"presentation": [1, 2]},
        {"provenance": None},
        {"provenance": [1]},
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


def test_weights_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InvalidArgument, match=r"^weights: expected layers from 4 observations of cartpole to 5 output"):
        replace(through_neurons(), **layers(0, 4, 8, 8, 4))
    with pytest.raises(InvalidArgument, match=r"^weights: expected finite numbers"):
        replace(two_forces(), biases=(*two_forces().biases[:-1], np.array([np.nan, 0], np.float32)))
