"""Imports follow the story and never run back or in circles; what is heavy is imported late."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from inspect import ismethod
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "animat"

GROUND = (
    "arguments",
    "compilation",
    "ctrl_c",
    "devices",
    "errors",
    "extras",
    "folders",
    "lazy",
    "plain_file",
    "process",
    "progress",
    "records",
    "registry",
    "tables",
    "terminal_table",
    "writing",
)
"""What stands under the story and may be used by all of it."""

STORY = (
    "stimulation",
    "recordings",
    "responses",
    "neurons",
    "coding",
    "robots",
    "goals",
    "environment",
    "wrappers",
    "training",
    "evaluation",
    "execution",
    "cultures",
    "closed_loop",
    "reality_gap",
    "live",
    "report",
    "studies",
    "tuning",
    "watch",
    "gym",
    "cli",
)
"""The rooms in the order of the story: each may look into those before it. A study records and draws: it comes late."""

FILES = {
    ".".join(("animat", *file.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): file
    for file in sorted(PACKAGE.rglob("*.py"))
}
"""Every module of the package by its name."""


@cache
def imports_of(name: str) -> set[str]:
    """The modules of animat that a module imports: at its top, late, or for types only."""
    found = set()
    for node in ast.walk(ast.parse(FILES[name].read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            # What is imported from a package may be a module of it, or a name that stands in the package itself.
            within = (f"{node.module}.{alias.name}" for alias in node.names)
            found |= {module if module in FILES else node.module for module in within}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & FILES.keys() - {name}


def room_of(name: str) -> str:
    return name.split(".")[1]


# The package itself holds the public names, of all rooms, and `__main__` is the command line.
@pytest.mark.parametrize("name", sorted(FILES.keys() - {"animat", "animat.__main__"}))
def test_no_import_runs_back_up_the_story(name: str) -> None:
    room = room_of(name)
    before = () if room in GROUND else STORY[: STORY.index(room)]
    assert {room_of(imported) for imported in imports_of(name)} <= {*GROUND, *before, room}


def test_no_two_files_import_each_other() -> None:
    try:
        TopologicalSorter({name: imports_of(name) for name in FILES}).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def modules_after(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(ran.stdout.splitlines()[-1].split())


BENCHMARKS = sorted((PACKAGE.parents[1] / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda file: file.stem)
def test_what_a_benchmark_imports_is_there(benchmark: Path) -> None:
    for node in ast.walk(ast.parse(benchmark.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("animat"):
            module = importlib.import_module(node.module)
            missing = [each.name for each in node.names if not hasattr(module, each.name)]
            assert missing == [], node.module


HEAVY = {"jax", "jaxlib", "scipy", "matplotlib", "pynwb", "hdmf", "h5py", "numba", "pandas", "optax", "optuna"}


def test_importing_animat_imports_nothing_heavy() -> None:
    assert not modules_after("import animat") & HEAVY


def test_reading_the_command_line_imports_nothing_heavy() -> None:
    help_ = "import contextlib, io, animat.cli as c\nwith contextlib.suppress(SystemExit), "
    help_ += "contextlib.redirect_stdout(io.StringIO()): c.main(['train', '--help'])\n"
    code = f"exec({help_!r})"
    assert not modules_after(code) & HEAVY


def test_loading_a_policy_needs_no_jax() -> None:
    assert "jax" not in modules_after("import animat.training.policy")
    # The page's server runs beside a closed loop.
    assert "jax" not in modules_after("import animat.watch.app")


def test_robots_and_goals_are_read_without_what_moves_and_draws_them() -> None:
    assert not modules_after("import animat.robots, animat.robots.grid, animat.goals.robot") & {"jax", "matplotlib"}


def test_every_public_name_is_there_and_stands_for_one_thing() -> None:
    import animat

    assert len(set(animat.__all__)) == len(animat.__all__)
    for name in animat.__all__:
        thing = getattr(animat, name)
        # A registry's `named` is called by what it names: robot_named, mapping_named.
        of = f"{thing.__self__.noun}_" if ismethod(thing) else ""
        assert of + getattr(thing, "__name__", name) == name
    # Completion in a notebook offers nothing else.
    assert {name for name in dir(animat) if not name.startswith("_")} == set(animat.__all__)
    # What is in the package under the same name would be there or not, by what was imported before.
    assert not set(animat.__all__) & {path.stem for path in PACKAGE.iterdir()}
    # The nouns of the story that a study is made of are not those of its specification.
    assert animat.Condition.__module__ == "animat.responses.condition"
    assert {"Study", "run_study", "read_study", "paper_study", "best_return"} <= set(animat.__all__)


def test_every_error_that_a_user_may_catch_is_public() -> None:
    import animat
    from animat import errors

    kinds = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)}
    assert {"UnsafeStimulus", "DeviceFailed", "BudgetSpent", "LoopEnded"} < kinds
    assert kinds <= set(animat.__all__)


def test_the_whole_story_is_public() -> None:
    import animat

    story = ["Recording", "Protocol", "Selection", "Culture", "Limits", "VirtualCulture", "ReplayCulture",
             "MaxOneCulture", "CL1Culture", "Responses", "NeuronSimulator", "Mapping", "Robot", "Animat", "train",
             "Policy", "evaluate", "Loop", "read_session", "run_policies", "Study"]  # fmt: skip
    assert [name for name in animat.__all__ if name in story] == story
    assert issubclass(animat.VirtualCulture, animat.Culture) and issubclass(animat.ReplayCulture, animat.Culture)
