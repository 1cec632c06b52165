"""Imports follow the story and never run back; what is heavy is imported late."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "animat"

EVERYWHERE = {"brief", "differences", "errors", "plain_file", "writing", "progress", "compilation", "ctrl_c"}
"""What stands under the story and may be used by all of it."""

MAY_IMPORT = {
    "differences": set(),
    "brief": set(),
    "errors": set(),
    "plain_file": {"errors"},
    "writing": {"errors"},
    "progress": set(),
    "compilation": set(),
    "ctrl_c": set(),
    "recordings": set(),
    "neurons": {"recordings"},
    "robots": set(),
    "mapping": set(),
    "animat": {"neurons", "mapping", "robots"},
    "training": {"animat", "neurons", "mapping", "robots", "recordings"},
    "evaluation": {"training", "animat", "neurons", "mapping", "robots", "recordings"},
    "cultures": {"recordings"},
    "closed_loop": {"cultures", "evaluation", "neurons", "mapping", "robots", "recordings"},
    "reality_gap": {
        "closed_loop",
        "cultures",
        "evaluation",
        "training",
        "animat",
        "mapping",
        "neurons",
        "robots",
        "recordings",
    },
    "live": {"reality_gap", "closed_loop", "cultures", "training", "neurons", "mapping", "robots", "recordings"},
    "report": {"recordings", "neurons", "robots", "mapping", "training", "evaluation", "cultures"},
    "studies": {
        "recordings",
        "cultures",
        "neurons",
        "robots",
        "mapping",
        "animat",
        "training",
        "evaluation",
        "report",
    },
    "gym": {"animat", "neurons", "mapping", "robots", "recordings"},
}
"""Each room, and the rooms before it in the story that it may look into; `cli` and the public names look into all."""


def imports_of(file: Path) -> set[str]:
    """Rooms of animat that a file imports, at its top or late."""
    rooms = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            parts = [node.module]
        elif isinstance(node, ast.Import):
            parts = [alias.name for alias in node.names]
        else:
            continue
        rooms |= {name.split(".")[1] for name in parts if name.startswith("animat.")}
    return rooms


@pytest.mark.parametrize("file", sorted(PACKAGE.rglob("*.py")), ids=lambda file: str(file.relative_to(PACKAGE)))
def test_no_import_runs_back_up_the_story(file: Path) -> None:
    room = file.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if room in ("__init__", "__main__") or room.split("_")[0] == "cli":
        return
    assert imports_of(file) <= MAY_IMPORT[room] | EVERYWHERE | {room}


def modules_after(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(ran.stdout.splitlines()[-1].split())


HEAVY = {"jax", "jaxlib", "scipy", "matplotlib", "pynwb", "hdmf", "h5py", "numba", "pandas", "optax"}


def test_importing_animat_imports_nothing_heavy() -> None:
    assert not modules_after("import animat") & HEAVY


def test_reading_the_command_line_imports_nothing_heavy() -> None:
    help_ = "import contextlib, io, animat.cli as c\nwith contextlib.suppress(SystemExit), "
    help_ += "contextlib.redirect_stdout(io.StringIO()): c.main(['train', '--help'])\n"
    code = f"exec({help_!r})"
    assert not modules_after(code) & HEAVY


def test_loading_a_policy_needs_no_jax() -> None:
    assert "jax" not in modules_after("import animat.training.policy")


def test_every_public_name_is_there_and_stands_for_one_thing() -> None:
    import animat

    assert len(set(animat.__all__)) == len(animat.__all__)
    for name in animat.__all__:
        thing = getattr(animat, name)
        assert getattr(thing, "__name__", name) == name
    # What is in the package under the same name would be there or not, by what was imported before.
    assert not set(animat.__all__) & {path.stem for path in PACKAGE.iterdir()}
    # The nouns of the story that a study is made of are not those of its specification.
    assert animat.Condition.__module__ == "animat.neurons.conditions"
    assert {"Study", "run_study", "read_study", "paper_study", "best_return"} <= set(animat.__all__)


def test_every_error_that_a_user_may_catch_is_public() -> None:
    import animat
    from animat import errors

    kinds = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)}
    assert {"UnsafeStimulus", "DeviceFailed", "BudgetSpent", "LoopEnded"} < kinds
    assert kinds <= set(animat.__all__)


def test_the_whole_story_is_public() -> None:
    import animat

    story = ["Recording", "Protocol", "Selection", "Culture", "Limits", "VirtualCulture", "ReplayCulture", "Responses",
             "NeuronSimulator", "Mapping", "Robot", "Animat", "train", "Policy", "evaluate", "Loop", "run_policies",
             "Study"]  # fmt: skip
    assert [name for name in animat.__all__ if name in story] == story
    assert issubclass(animat.VirtualCulture, animat.Culture) and issubclass(animat.ReplayCulture, animat.Culture)
