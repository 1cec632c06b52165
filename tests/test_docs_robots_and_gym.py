"""The examples in the pages on robots and on Gymnasium run, and their numbers hold."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from animat.coding.mapping import REGISTRY as MAPPINGS
from animat.neurons.synthetic import synthetic_simulator
from animat.robots.registry import REGISTRY
from synthetic_recordings import write_synthetic_series

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(autouse=True)
def as_in_a_new_process() -> Iterator[None]:
    """Other tests of this process have robots and mappings of the pages' names, and expect none of the pages' own."""
    known = [(registry, dict(registry._registered)) for registry in (REGISTRY, MAPPINGS)]
    for registry, kinds in known:
        for name in [name for name, kind in kinds.items() if not kind.__module__.startswith("animat.")]:
            del registry._registered[name]
    yield
    for registry, kinds in known:
        registry._registered.clear()
        registry._registered.update(kinds)


@pytest.mark.parametrize("page", ["robots.md", "own-robots.md", "gymnasium.md"])
def test_the_examples_run(page: str, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    write_synthetic_series(0, "recordings", sessions=2, interval_min=140)
    names = {"gymnasium": gymnasium, "simulator": synthetic_simulator()}
    examples = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)
    assert examples
    for example in examples:
        if "RecordVideo" in example and not importlib.util.find_spec("moviepy"):
            continue
        exec(compile(example, page, "exec"), names)
    assert page != "gymnasium.md" or "delivered" in capsys.readouterr().out


def actions_of_cartpole(o: np.ndarray) -> np.ndarray:
    return np.where(30 * o[:, 2] + 4 * o[:, 3] + o[:, 0] + 2 * o[:, 1] > 0, 4, 0)


def actions_of_navigation(o: np.ndarray) -> np.ndarray:
    wanted = np.arctan2(0.7 - o[:, 1], 0.7 - o[:, 0]) - o[:, 2]
    return np.where(np.sin(wanted) > 0, 4, 0)


@pytest.mark.parametrize(
    ("id_", "mapping", "rule", "of_random", "of_rule"),
    [
        pytest.param("Animat/Cartpole-v0", "1-threshold", actions_of_cartpole, -80, 12, marks=pytest.mark.oracle),
        ("Animat/Cartpole-v0", "9-thresholds", actions_of_cartpole, -77, 61),
        ("Animat/Navigation-v0", "1-threshold", actions_of_navigation, -73, 19),
    ],
)
def test_the_returns_in_the_table_are_had(id_, mapping, rule, of_random, of_rule) -> None:
    n = 1000
    envs = gymnasium.make_vec(id_, num_envs=n, mapping=mapping)
    rng = np.random.default_rng(1)
    for act, expected in ((lambda o: rng.integers(0, 5, len(o)), of_random), (rule, of_rule)):
        observations, _ = envs.reset(seed=1)
        totals, going = np.zeros(n), np.ones(n, bool)
        while going.any():
            observations, rewards, terminated, truncated, _ = envs.step(act(observations))
            totals += rewards * going
            going &= ~(terminated | truncated)
        assert totals.mean() == pytest.approx(expected, abs=1 + 4 * totals.std() / np.sqrt(n))
