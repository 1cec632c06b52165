"""Robots of a user's own package and script: registered, trained in workers, saved, loaded, evaluated, run, drawn."""

from __future__ import annotations

import json
import os
import pickle
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from animat.cli import main
from animat.errors import InvalidArgument, InvalidFile
from animat.evaluation.table import evaluate
from animat.execution.training import train
from animat.robots import (
    ROBOTS,
    Cartpole,
    Detour,
    Navigation,
    Robot,
    Shuttle,
    SwingUp,
    TwoLinkArm,
    Wheels,
    register_robot,
    registry,
    robot_from_dict,
    robot_named,
    robot_to_dict,
)
from animat.robots.base import WITHOUT, lacking
from animat.studies.optima import missing_capabilities
from animat.studies.run import run_study
from animat.studies.source import Source
from animat.studies.specification import RobotSpec, Study
from animat.studies.toml import read_study, study_to_toml
from animat.training.policy import load_policies
from animat.training.specification import Training
from synthetic_recordings import write_synthetic_series
from test_training import SMALL, timeline_of

DOCS = Path(__file__).parents[1] / "docs" / "own-robots.md"
ROVER = "my_package.robots:Rover"


@pytest.fixture(autouse=True)
def forgetting() -> Iterator[None]:
    """Forget what a test registers and imports."""
    known, loaded = dict(ROBOTS), set(sys.modules)
    forget()
    yield
    forget(known)
    for name in set(sys.modules) - loaded:
        if name.startswith("my_"):
            del sys.modules[name]


def forget(known: dict[str, type[Robot[Any]]] | None = None) -> None:
    """Restore the state of a process that has imported nothing of the user's."""
    ours = {kind.name: kind for kind in (TwoLinkArm, Cartpole, Detour, Navigation, Shuttle, SwingUp, Wheels)}
    registry.REGISTRY._registered.clear()
    registry.REGISTRY._registered.update(known or ours)
    for name in ("my_package", "my_package.robots"):
        sys.modules.pop(name, None)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's package with the robot of the page on robots, in the working folder."""
    (page,) = re.findall(r"```python\n(import .*?class Rover.*?)```", DOCS.read_text(), re.DOTALL)
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "__init__.py").touch()
    (tmp_path / "my_package" / "robots.py").write_text(page)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def written(folder: Path, *changes: tuple[str, str]) -> str:
    """Write another module with the rover changed; returns its import path."""
    text = (folder / "my_package" / "robots.py").read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    number = len(list(folder.glob("my_changed*.py")))
    (folder / f"my_changed{number}.py").write_text(text)
    return f"my_changed{number}:Rover"


@pytest.mark.oracle
def test_a_robot_is_trained_in_workers_saved_loaded_and_evaluated(package: Path) -> None:
    training = Training(ROVER, "1-threshold", policies=2, iterations=480, algorithm=SMALL)
    trained = train(training, timeline_of(), package / "policies", workers=1)
    rover = robot_named("rover", gain_m=0.1)
    assert len(trained) == 2 and all(policy.robot == rover for policy in trained.values())
    assert robot_to_dict(rover)["import"] == ROVER
    alone = train(training, timeline_of(), None)
    for name, policy in trained.items():
        np.testing.assert_array_equal(policy.weights[0], alone[name].weights[0])

    forget()
    with pytest.raises(InvalidFile, match=f"'rover': import my_package.robots first .*--robot {ROVER}"):
        load_policies(package / "policies")
    # No file makes anything be imported.
    assert "my_package" not in sys.modules
    robot_named(ROVER)
    loaded = load_policies(package / "policies")
    evaluation = evaluate(loaded, timeline_of(), episodes=5, optimum_resolution=1.0)
    assert evaluation.robot == "rover" and evaluation.names == tuple(trained)
    assert "rover has no method `value_grid`" in (evaluation.no_optimum or "")
    assert "no heuristic policy among the controls: rover has no method `heuristic`" in evaluation.to_text()


@pytest.mark.oracle
def test_the_command_line_trains_evaluates_and_runs_it(package: Path, capsys: Any) -> None:
    write_synthetic_series(0, "recordings", sessions=1)
    few = ["--recordings", "recordings", "--policies", "1", "--iterations", "256", "--workers", "1"]
    assert main(["train", ROVER, *few, "--parameters", "episode_limit=12"]) == 0
    forget()
    assert main(["evaluate", "--recordings", "recordings"]) == 1
    assert f"--robot {ROVER}" in capsys.readouterr().err
    asked = ["--recordings", "recordings", "--robot", ROVER, "--episodes", "2", "--json"]
    assert main(["evaluate", *asked, "--optimum"]) == 0
    said = capsys.readouterr().out
    data = json.loads(said.splitlines()[-1])
    assert data["robot"] == "rover" and data["optimum"] is None and "value_grid" in data["no_optimum"]
    assert "no heuristic policy among the controls: rover has no method `heuristic`" in said
    forget()
    assert main(["run", *asked, "--culture", "replay"]) == 0
    said = capsys.readouterr().out
    data = json.loads(said.splitlines()[-1])
    assert "heuristic" not in {row["name"] for row in data["rows"]}
    assert {"no-heuristic", "no-optimum"} <= {finding["name"] for finding in data["findings"]}
    assert "no optimal return: rover has no method `value_grid`" in said


@pytest.mark.oracle
@pytest.mark.usefixtures("in_this_process")
def test_a_study_leaves_out_what_it_cannot_do_and_says_so(package: Path) -> None:
    robot_named(ROVER)
    study = Study(
        culture=Source("files", files=("data/tiny/recording_0000_min.npz",)),
        robots=(RobotSpec("rover", iterations=240),),
        policies=1,
        episodes=2,
        episodes_over_time=2,
        algorithm={"environments": 8, "gradient_steps": 1, "batch": 16, "replay": 256, "hidden": 8},
    )
    (package / "study.toml").write_text(study_to_toml(study))
    assert read_study(package / "study.toml") == study and study.robots[0].kind == ROVER
    ran = run_study(study, package / "study", base=Path(__file__).parent, workers=1)
    page = ran.report.read_text()
    for message in lacking(robot_named("rover")).values():
        assert message in page
    assert not list((package / "study" / "figures").glob("rover-frames*"))


def test_what_robots_of_one_kind_lack_is_said_once(package: Path) -> None:
    robot_named(ROVER)
    near, far = (RobotSpec(f"{gain} m", kind="rover", parameters={"gain_m": gain}) for gain in (0.1, 0.2))
    assert missing_capabilities(Study(robots=(near, far))) == missing_capabilities(Study(robots=(near,)))


@pytest.mark.oracle
@pytest.mark.parametrize("executor", ["None", "ProcessPoolExecutor(1, get_context('spawn'))"])
def test_what_is_registered_in_a_script_is_found_by_its_workers(executor: str, package: Path) -> None:
    """A script's own robot, in `__main__`; its output is not mistaken for a worker's report."""
    script = """
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
import animat
from my_package.robots import Rover
from test_training import SMALL, timeline_of

if __name__ != "__mp_main__":
    print("imported")

@animat.register_robot
@dataclass(frozen=True)
class Mine(Rover):
    name = "mine"

if __name__ == "__main__":
    training = animat.Training(Mine(), "1-threshold", policies=1, iterations=240, algorithm=SMALL)
    print(animat.train(training, timeline_of(), "out", executor=EXECUTOR)["p0"].robot)
"""
    environment = {**os.environ, "PYTHONPATH": ":".join([str(Path(__file__).parent), *sys.path])}
    (package / "my_script.py").write_text(script.replace("EXECUTOR", executor))
    ran = subprocess.run([sys.executable, "my_script.py"], capture_output=True, text=True, env=environment)
    assert ran.stdout.splitlines() == ["imported", "Mine(gain_m=0.1, episode_limit=20)"], ran.stderr
    mine = {"name": "mine", "parameters": {"gain_m": 0.1, "episode_limit": 20}, "import": "my_script:Mine"}
    assert robot_to_dict(robot_named("my_script:Mine")) == mine


def test_parameters_that_are_tuples_come_back_from_json(package: Path) -> None:
    at = written(package, ("gain_m: float = 0.1", "gain_m: float = 0.1\n    walls: tuple = ((1, 2), (3, 4))"))
    robot = robot_named(at)
    again = robot_from_dict(json.loads(json.dumps(robot_to_dict(robot))))
    assert again == robot and hash(again) == hash(robot)


@pytest.mark.parametrize("place", ["x" * 100_000, "my_package:\x1b[2J", "no colon", 5])
def test_a_file_that_lies_about_where_a_robot_is_from_gets_a_short_line(place: Any) -> None:
    with pytest.raises(InvalidArgument) as raised:
        robot_from_dict({"name": "nobody", "parameters": {}, "import": place})
    assert len(str(raised.value)) < 300 and "\x1b" not in str(raised.value)


@pytest.mark.parametrize("name", [["cartpole"], {"cartpole": 1}, None, 5])
def test_a_name_in_a_file_that_is_no_text_is_refused(name: Any) -> None:
    with pytest.raises(InvalidArgument, match=r'robot: expected \{"name": \.\.\., "parameters": \{\.\.\.\}\}, got'):
        robot_from_dict({"name": name, "parameters": {}})


def test_the_robot_of_a_prompt_cannot_be_trained_in_workers(package: Path) -> None:
    @register_robot
    @dataclass(frozen=True)
    class Here(type(robot_named(ROVER))):  # type: ignore[misc]
        name = "here"

    with pytest.raises(InvalidArgument, match=r"at the top level of a file.*<locals>\.Here.*in memory"):
        train(Training(Here(), None, algorithm=SMALL), None, package / "out")


def test_a_robot_that_cannot_be_sent_to_workers_is_refused_before_training(
    package: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keeping = """
    def __post_init__(self): object.__setattr__(self, "gain", lambda x: x)

    @property
    def observation_spec"""
    at = written(package, ("\n    @property\n    def observation_spec", keeping))
    assert main(["train", at, "--mapping", "none", "--out", "policies"]) == 1
    (said,) = capsys.readouterr().err.splitlines()
    words = rf"animat: robot: expected one that can be sent to worker processes \(pickled\), got {at}, .*lambda"
    assert re.match(words, said) and "keep only plain parameters in it" in said
    assert not (package / "policies").exists()


def test_ours_are_listed_first(package: Path) -> None:
    robot_named(ROVER)
    assert registry.REGISTRY.names() == (
        "arm",
        "cartpole",
        "detour",
        "navigation",
        "shuttle",
        "swing-up",
        "wheels",
        "rover",
    )


def test_an_installed_package_announces_its_robots(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = [EntryPoint("rover", ROVER, "animat.robots"), EntryPoint("tank", ROVER, "animat.robots")]

    def found(*, group: str, name: str | None = None) -> list[EntryPoint]:
        return [point for point in points if group == point.group and name in (None, point.name)]

    monkeypatch.setattr("importlib.metadata.entry_points", found)
    with pytest.raises(
        InvalidArgument,
        match="expected one of arm, cartpole, detour, navigation, shuttle, swing-up, wheels, rover, tank, got 'plane'",
    ):
        robot_named("plane")
    assert robot_named("rover", gain_m=0.2) == robot_named(ROVER, gain_m=0.2)
    forget()
    with pytest.raises(InvalidArgument, match="to have the name 'tank', got 'rover'"):
        robot_named("tank")


def test_robots_are_listed_with_what_each_can_do(
    package: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points = [EntryPoint("rover", ROVER, "animat.robots"), EntryPoint("tank", "my_nowhere:Tank", "animat.robots")]
    monkeypatch.setattr(
        "importlib.metadata.entry_points",
        lambda *, group, name=None: [each for each in points if name in (None, each.name)],
    )
    # A package that is broken hides no robot, and ends with status 1.
    assert main(["robots", "--json"]) == 1
    said, _, line = capsys.readouterr().out.strip().rpartition("\n")
    data = json.loads(line)
    assert list(data["robots"]) == ["arm", "cartpole", "detour", "navigation", "shuttle", "swing-up", "wheels", "rover"]
    assert data["robots"]["cartpole"]["can"] == ["heuristic", "value_grid", "draw", "draw_paths"]
    assert data["robots"]["rover"]["can"] == [] and data["robots"]["rover"]["observes"] == [{"name": "x", "unit": "m"}]
    assert "  no heuristic policy among the controls: rover has no method `heuristic`" in said
    assert "ModuleNotFoundError" in data["unusable"]["tank"] and "tank cannot be used: " in said
    observation_spec = property(lambda self: ("x",))
    monkeypatch.setattr(type(robot_named("rover")), "observation_spec", observation_spec)
    assert main(["robots"]) == 1
    assert "rover cannot be used: Rover.observation_spec: expected a tuple of Quantity" in capsys.readouterr().out
    assert main(["robots", "my_nowhere:Tank"]) == 1
    assert capsys.readouterr().err.startswith("animat: robot: expected my_nowhere:Tank to be importable")


def test_a_return_beyond_what_a_robot_states_is_reported_before_training(
    package: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Cartpole, "return_range", property(lambda self: (0.0, 120.0)))
    assert main(["train", "cartpole", "--mapping", "none", "--out", "policies"]) == 1
    words = r"animat: cartpole.return_range: expected the lowest .*, got 0 to 120, and an episode .* returned -\d"
    assert re.search(words, capsys.readouterr().err)
    assert not (package / "policies").exists()


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("my_nowhere:Rover", "expected my_nowhere:Rover to be importable, got ModuleNotFoundError"),
        ("my_package.robots:Tank", "Tank to be importable, got AttributeError"),
        ("my_package.robots:Tank-v0", "a Gymnasium environment is gymnasium:my_package.robots:Tank-v0$"),
        ("my_package.robots:At", "expected a subclass of animat.Robot, got <class"),
        ("my_package.robots:", "to be importable, got "),
        (":Rover", "to be importable, got ValueError"),
        ("./my_package/robots.py:Rover", "such as robots:Rover, got a file, './my_package/robots.py:Rover'"),
        ((("import animat", "import animat; 1 / 0"),), "to be importable, got ZeroDivisionError: division by zero"),
        ((("import animat", "raise SystemExit('no')"),), "to be importable, got SystemExit: no"),
        ((("def observe", "def see"),), "expected the methods of a robot, got a class without observe"),
        ((("@dataclass(frozen=True)", ""),), "expected a frozen dataclass"),
        ((('name = "rover"', 'name = "a/b"'),), "name: expected letters, digits"),
        ((('name = "rover"', 'name = "cartpole"'),), "no other robot has, got 'cartpole', which is animat.robots"),
        ((('name = "rover"', 'name = "gymnasium"'),), "no other robot has, got 'gymnasium', which is part of animat"),
    ],
)
def test_what_cannot_be_imported_or_registered_is_named_in_a_line(place: Any, words: str, package: Path) -> None:
    at = place if isinstance(place, str) else written(package, *place)
    with pytest.raises(InvalidArgument, match=words) as raised:
        robot_named(at)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("jnp.stack([state.x_m])", "state.x_m"), r"Rover.observe: .*shape \(1,\), got shape \(\)"),
        (("-jnp.abs(x_m)", "jnp.log(x_m - 9)"), "Rover: expected finite numbers, got NaN"),
    ],
)
def test_a_bad_robot_ends_in_a_line_before_anything_is_read_or_recorded(
    change: tuple[str, str], words: str, package: Path, capsys: Any
) -> None:
    at = written(package, change)
    for command in (["robots", at], ["train", at, "--recordings", "no-such-folder"]):
        assert main(command) == 1
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1 and re.search(words, said[0])
    with pytest.raises(InvalidArgument, match=words):
        run_study(Study(robots=(RobotSpec("rover", kind=at),)), package / "study")
    assert not (package / "study").exists()


def test_an_observation_spec_that_raises_ends_in_a_line(package: Path, capsys: Any) -> None:
    at = written(package, ("return (animat.Quantity", "return 1 / 0, (animat.Quantity"))
    script = package / f"{at.partition(':')[0]}.py"
    line = next(i for i, line in enumerate(script.read_text().splitlines(), 1) if "1 / 0" in line)
    for command in (["robots", at], ["train", at, "--recordings", "no-such-folder"]):
        assert main(command) == 1
        said = "animat: Rover.observation_spec: expected a tuple of Quantity, got ZeroDivisionError: division by zero"
        assert capsys.readouterr().err.splitlines() == [f"{said} ({script.name}, line {line})"]
    with pytest.raises(InvalidArgument, match="observation_spec: expected a tuple of Quantity"):
        run_study(Study(robots=(RobotSpec("rover", kind=at),)), package / "study")
    assert not (package / "study").exists()


@pytest.mark.parametrize(
    ("attribute", "words"),
    [
        # A method in place of a property.
        ("def return_range(self): return 0.0, 20.0", "return_range: expected two numbers, .* got TypeError"),
        ("return_range = (20.0, 0.0)", r"return_range: expected two numbers, .* got \(20.0, 0.0\)"),
        ("return_range = (0.0, float('nan'))", "return_range: expected two numbers, .* got .*nan"),
        ("return_range = property(lambda self: 1 / 0)", "return_range: expected two numbers, .* ZeroDivisionError"),
        ("def caveats(self): return 'slippery'", "caveats: expected a tuple of strings, got 'slippery'"),
        ("def caveats(self): return (1,)", r"caveats: expected a tuple of strings, got \(1,\)"),
        ("def caveats(self): return 1 / 0", "caveats: expected a tuple of strings, got ZeroDivisionError"),
        ("paper_iterations = None", "paper_iterations: expected a whole number from 1 to .*, got None"),
        ("paper_iterations = 1e5", "paper_iterations: expected a whole number from 1 to .*, got 100000.0"),
        ("n_commands = []", r"n_commands: expected a whole number from 1 to 64, got \[\]"),
    ],
)
def test_what_a_robot_may_leave_out_is_checked_too(attribute: str, words: str, package: Path, capsys: Any) -> None:
    at = written(package, ("    def observe(self, state):", f"    {attribute}\n\n    def observe(self, state):"))
    training = ["train", at, "--recordings", "no-such-folder"]
    goal = ["--goal", "drive x in -1..1 m"]
    live = ["live", at, "--culture", "virtual", "--out", "live"]
    for command in (["robots", at], training, [*training, *goal], live, [*live, *goal]):
        assert main(command) == 1
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1 and re.match(f"animat: Rover.{words}", said[0]), command
    with pytest.raises(InvalidArgument, match=words):
        gymnasium.make("animat:Animat/Robot-v0", robot=at)


def test_it_is_a_gymnasium_environment_and_is_drawn_where_it_can_be(package: Path) -> None:
    env = gymnasium.make("animat:Animat/Robot-v0", robot=ROVER, gain_m=0.2)
    observation, _ = env.reset(seed=1)
    after, *_ = env.step(4)
    assert abs(after[0] - observation[0]) == pytest.approx(0.2, abs=1e-6)
    assert env.unwrapped.metadata["render_modes"] == []
    with warnings.catch_warnings():
        # It has no bounds.
        warnings.filterwarnings("ignore", message=".*Box observation space")
        check_env(env.unwrapped)
    with pytest.raises(InvalidArgument, match="rover has no method `draw`"):
        gymnasium.make("animat:Animat/Robot-v0", robot=ROVER, render_mode="rgb_array")
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(InvalidArgument, match=r"robot: expected a name, as in .* robot='shuttle'\), got none"):
            make("animat:Animat/Robot-v0")

    def drawing(returned: str) -> Callable[[], Any]:
        draw = f"\n    def draw(self, observation, command, earlier, height_px):\n        return {returned}\n"
        forget()
        needed = ("import jax.numpy as jnp\n", "import jax.numpy as jnp\nimport numpy as np\n")
        at = written(package, needed, ('    name = "rover"\n', f'    name = "rover"\n{draw}'))
        env = gymnasium.make("animat:Animat/Robot-v0", robot=at, render_mode="rgb_array")
        env.reset(seed=1)
        return env.render  # type: ignore[return-value]

    assert drawing("np.full((height_px, 9, 3), len(earlier), np.uint8)")().shape == (360, 9, 3)
    with pytest.raises(InvalidArgument, match=r"rover.draw: expected uint8 of shape .*got float64 of shape \(9, 9\)"):
        drawing("np.zeros((9, 9))")()


def test_ours_lack_nothing_but_the_optimum_of_two_commands_and_are_pickled_as_ever() -> None:
    for robot in (Cartpole(), Navigation(), Shuttle(), SwingUp(), TwoLinkArm(), Wheels()):
        # There is no optimal return of two commands.
        assert set(lacking(robot)) == ({"value_grid"} if robot.n_commands > 1 else set())
        assert "import" not in robot_to_dict(robot)
        assert pickle.loads(pickle.dumps(robot)) == robot
    assert set(WITHOUT) == {"heuristic", "value_grid", "draw", "draw_paths"}


def test_what_a_robot_has_wrong_is_named_where_it_is_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    (tmp_path / "my_wrong.py").write_text(
        "from dataclasses import dataclass\nfrom animat.robots import Cartpole\n\n"
        "@dataclass(frozen=True)\nclass Wrong(Cartpole):\n    name = 'wrong'\n    n_commands = 'two'\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["robots", "my_wrong:Wrong"]) == 1
    assert "Wrong.n_commands: expected a whole number from 1 to 64, got 'two'" in capsys.readouterr().err


def test_a_script_that_workers_cannot_import_is_told_what_to_do_first(package: Path) -> None:
    recreate, how = registry.REGISTRY._reduce(robot_named(ROVER))
    forget()
    script = package / "my_package" / "robots.py"
    script.write_text(f"{script.read_text()}\nraise animat.Mismatch('another run is at work')\n")
    line = len(script.read_text().splitlines())
    need = "robot: expected what the script runs under `if __name__ == '__main__':`, as worker processes import it; "
    with pytest.raises(
        InvalidArgument, match=f"^{re.escape(need)}.*another run is at work \\(robots\\.py, line {line}\\)$"
    ):
        recreate(*how)
