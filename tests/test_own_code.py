"""The code of robots and mappings of one's own: work begun with other code is refused, not continued."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from gymnasium.envs.classic_control import PendulumEnv

from animat.coding.mapping import Thresholds
from animat.errors import Mismatch
from animat.execution.training import train
from animat.robots import Cartpole
from animat.robots.own_code import code_of
from animat.robots.registry import REGISTRY, robot_named
from animat.training.folder import versions_of
from animat.training.specification import Training
from animat.watch.view import curve
from test_training import SMALL

ROVER = '''"""A rover."""
import jax
import jax.numpy as jnp
from dataclasses import dataclass
from typing import NamedTuple
import animat

if len(animat.__name__) > 1:
    SIGN = 1.0

    def far(x_m):
        return jnp.abs(x_m) > 1

OTHER = 2.0
GAINS = [1.0]


class At(NamedTuple):
    x_m: jax.Array


def reward(x_m):
    return SIGN * jnp.abs(x_m)


@dataclass(frozen=True)
class Rover(animat.Robot[At]):
    """Moves by the command."""

    episode_limit: int = 20
    name = "rover-in-a-file"

    @property
    def observation_spec(self):
        return (animat.Quantity("x", "m", 1.0),)

    def reset(self, key):
        return At(0.2 * jax.random.normal(key))

    def advance(self, uniforms, state, u):
        # Ends far away.
        x_m = state.x_m + 0.1 * u * GAINS[0]
        return At(x_m), reward(x_m), far(x_m)

    def observe(self, state):
        return jnp.stack([state.x_m])


def unused():
    return 1


Rover.friction = 0.5
GAINS.append(2.0)
if __name__ == "__main__":
    SIGN = 7
'''


ENVIRONMENT = """import gymnasium
import numpy as np


class Point(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.zeros(1, np.float32)
        return self.x, {}

    def step(self, action):
        self.x = np.clip(self.x + 0.1 * np.float32(action), -1, 1)
        return self.x, 1.0, False, False, {}


gymnasium.register("InAFile-v0", entry_point=Point, max_episode_steps=20)
"""


@pytest.fixture
def rover(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A function that writes the module of a robot, changed, and returns the robot."""
    (tmp_path / "modules").mkdir()
    monkeypatch.syspath_prepend(tmp_path / "modules")

    def made(old: str = "", new: str = "") -> Any:
        assert old in ROVER
        (tmp_path / "modules" / "rover_in_a_file.py").write_text(ROVER.replace(old, new) if old else ROVER)
        for registered in (sys.modules, REGISTRY._registered):
            registered.pop("rover_in_a_file" if registered is sys.modules else "rover-in-a-file", None)
        importlib.invalidate_caches()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "dont_write_bytecode", True)
            return robot_named("rover_in_a_file:Rover")

    yield made
    sys.modules.pop("rover_in_a_file", None)
    REGISTRY._registered.pop("rover-in-a-file", None)


@pytest.mark.parametrize(
    ("old", "new", "is_same"),
    [
        ("# Ends far away.", "# Ends.", True),
        ('"""Moves by the command."""', '"""Moves."""', True),
        ("return 1", "return 2", False),
        ("    def observe(self, state):", '    def observe(self, state):\n        """New."""', True),
        ("SIGN = 7", "SIGN = 8", True),
        ("    SIGN = 7", "    SIGN = 7\nelse:\n    SIGN = 1.5", False),
        ("Rover.friction = 0.5", "Rover.friction = 0.6", False),
        ("GAINS.append(2.0)", "GAINS.append(3.0)", False),
        ("OTHER = 2.0", "OTHER = 3.0", False),
        ("OTHER = 2.0\n", "OTHER  =  2.00  # Twice.\n\n\n", True),
        ("SIGN = 1.0", "SIGN = -1.0", False),
        ("return SIGN * jnp.abs(x_m)", "return SIGN * x_m", False),
        ("0.1 * u", "0.2 * u", False),
        ("jnp.abs(x_m) > 1", "jnp.abs(x_m) > 2", False),
        ("import jax.numpy as jnp", "import numpy as jnp", False),
    ],
)
def test_all_code_of_its_module_counts_and_no_text(rover: Any, old: str, new: str, is_same: bool) -> None:
    before = code_of(rover())
    assert list(before) == ["code of rover-in-a-file"]
    assert (code_of(rover(old, new)) == before) == is_same


def test_animats_own_need_no_code() -> None:
    assert code_of(Cartpole()) == code_of(Thresholds(9)) == {}


@pytest.mark.oracle
def test_a_training_with_other_code_is_refused(rover: Any, tmp_path: Path) -> None:
    def trained() -> Any:
        training = Training(robot_named("rover-in-a-file"), None, policies=1, iterations=480, algorithm=SMALL)
        return train(training, None, tmp_path / "out")

    rover()
    trained()
    rover("# Ends far away.", "# Ends.")
    trained()
    rover("SIGN = 1.0", "SIGN = -1.0")
    with pytest.raises(Mismatch, match=r"code of rover-in-a-file: 'sha256 .*' there, 'sha256 .*' now"):
        trained()


def test_the_code_of_a_gymnasium_environment_of_one_s_own_counts_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    source = ENVIRONMENT
    (tmp_path / "environment_in_a_file.py").write_text(source)
    try:
        robot = robot_named("gymnasium:environment_in_a_file:InAFile-v0")
        before = versions_of((), [robot])["code of gymnasium:environment_in_a_file:InAFile-v0"]
        (tmp_path / "environment_in_a_file.py").write_text(source.replace("0.1 *", "0.2 *"))
        assert versions_of((), [robot])["code of gymnasium:environment_in_a_file:InAFile-v0"] != before
    finally:
        gymnasium.registry.pop("InAFile-v0")
        sys.modules.pop("environment_in_a_file", None)
    assert not [name for name in versions_of((), [robot_named("gymnasium:Pendulum-v1")]) if "code" in name]


def test_an_environment_made_by_a_partial_function_has_versions() -> None:
    gymnasium.register("Partial-v0", entry_point=partial(PendulumEnv, g=9.0), max_episode_steps=20)
    try:
        found = versions_of((), [robot_named("gymnasium:Partial-v0")])
        assert "gymnasium" in found and not [name for name in found if "code" in name]
    finally:
        gymnasium.registry.pop("Partial-v0")


def test_a_thinned_curve_has_its_last_point() -> None:
    for n in (0, 1, 2_000, 2_001, 4_999):
        shown = curve("", [*range(n)], [*range(n)], "line", "blue")["x"]
        assert len(shown) <= 2_001 and shown[:1] == [0.0] * bool(n) and shown[-1:] == [n - 1.0] * bool(n)
