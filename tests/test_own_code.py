"""The code of robots and mappings of one's own: work begun with other code is refused, not continued."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from animat.coding.mapping import Thresholds
from animat.errors import Mismatch
from animat.execution.training import train
from animat.robots import Cartpole
from animat.robots.registry import REGISTRY, robot_named
from animat.training.own_code import code_of
from animat.training.specification import Training
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
        x_m = state.x_m + 0.1 * u
        return At(x_m), reward(x_m), far(x_m)

    def observe(self, state):
        return jnp.stack([state.x_m])


def unused():
    return 1


Rover.friction = 0.5
if __name__ == "__main__":
    SIGN = 7
'''


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
        ("return 1", "return 2", True),
        ("    def observe(self, state):", '    def observe(self, state):\n        """New."""', True),
        ("SIGN = 7", "SIGN = 8", True),
        ("Rover.friction = 0.5", "Rover.friction = 0.6", False),
        ("OTHER = 2.0", "OTHER = 3.0", True),
        ("SIGN = 1.0", "SIGN = -1.0", False),
        ("return SIGN * jnp.abs(x_m)", "return SIGN * x_m", False),
        ("0.1 * u", "0.2 * u", False),
        ("jnp.abs(x_m) > 1", "jnp.abs(x_m) > 2", False),
        ("import jax.numpy as jnp", "import numpy as jnp", False),
    ],
)
def test_what_a_robot_uses_counts_and_nothing_else(rover: Any, old: str, new: str, is_same: bool) -> None:
    before = code_of(rover())
    assert list(before) == ["code of rover-in-a-file"]
    assert (code_of(rover(old, new)) == before) == is_same


def test_animats_own_need_no_code() -> None:
    assert code_of(Cartpole()) == code_of(Thresholds(9)) == {}


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
