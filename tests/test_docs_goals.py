"""The page on goals: its commands are known, its example runs, and its goals fit the robots that it names."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from animat.cli import _parse
from animat.goals.goal import read_goal
from animat.goals.robot import FAILED, POTENTIAL, REACHED, with_goal

PAGE = (Path(__file__).parents[1] / "docs" / "goals.md").read_text()
COMMANDS = [line.partition(" #")[0] for line in re.findall(r"^animat (.*)$", PAGE, re.MULTILINE)]


@pytest.mark.parametrize("command", COMMANDS)
def test_its_commands_are_known(command: str) -> None:
    _parse(shlex.split(command))


def test_its_example_runs_and_ends_in_the_text_of_the_goal() -> None:
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, "goals.md", "exec"), names)
    assert str(names["robot"].goal) in example  # type: ignore[attr-defined]


def test_every_region_that_it_shows_is_read() -> None:
    table = PAGE.split("| region |")[1].split("\n\n")[0]
    regions = re.findall(r"`([^`]+)`", table)
    assert len(regions) == 6
    for region in regions:
        assert str(read_goal(f"drive {region}")) == f"drive {region}"


@pytest.mark.parametrize("name", ["cartpole", "navigation"])
def test_the_published_tasks_are_goals_of_their_robots(name: str) -> None:
    (goal,) = re.findall(rf"\| {name} \| `([^`]+)` \|", PAGE)
    assert with_goal(name, goal).caveats() == ()


def test_its_numbers_are_those_of_the_code() -> None:
    assert f"| -{FAILED:g} n w_i / Σw - c `episode_limit`" in PAGE
    assert f"| {REACHED:g} n w_i" in PAGE
    assert f"potential = {POTENTIAL:g} Σ" in PAGE
