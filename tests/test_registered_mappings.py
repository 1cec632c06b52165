"""Mappings of a user's own package: registered, trained in workers, saved, loaded, evaluated, run in closed loop."""

from __future__ import annotations

import pickle
import re
import sys
import warnings
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from animat.cli import main
from animat.coding.mapping import REGISTRY, mapping_from_data, mapping_named, mapping_to_data
from animat.errors import InvalidArgument, InvalidFile
from animat.evaluation.table import evaluate
from animat.execution.training import train
from animat.studies.run import run_study
from animat.studies.source import Source
from animat.studies.specification import Arm, RobotSpec, Study
from animat.studies.toml import read_study, study_to_toml
from animat.training.policy import load_policies
from animat.training.specification import Training
from synthetic_recordings import write_synthetic_series
from test_training import SMALL, timeline_of

DOCS = Path(__file__).parents[1] / "docs" / "own-robots.md"
STEEP = "my_package.mappings:Steep"


def forget() -> None:
    """As in a process that has imported nothing of the user's."""
    REGISTRY._registered.clear()
    for name in [name for name in sys.modules if name.startswith("my_")]:
        del sys.modules[name]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A user's package with the mapping of the page on robots, in the folder that is worked in."""
    (page,) = re.findall(r"```python\n(import (?:(?!```).)*class Steep.*?)```", DOCS.read_text(), re.DOTALL)
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "__init__.py").touch()
    (tmp_path / "my_package" / "mappings.py").write_text(page)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    forget()
    yield tmp_path
    forget()


def written(folder: Path, before: str, after: str) -> str:
    """Another module with the mapping changed; returns where it is imported from."""
    text = (folder / "my_package" / "mappings.py").read_text()
    assert before in text
    (folder / "my_changed.py").write_text(text.replace(before, after))
    return "my_changed:Steep"


@pytest.mark.oracle
def test_a_mapping_is_trained_in_workers_saved_loaded_and_evaluated(package: Path) -> None:
    steep = mapping_named(STEEP, slope=3.0)
    training = Training("cartpole", steep, policies=6, iterations=480, algorithm=SMALL)
    trained = train(training, timeline_of(), package / "policies", workers=2)
    assert len(trained) == 6 and all(policy.mapping == steep for policy in trained.values())
    alone = train(training, timeline_of(), None)
    for name, policy in trained.items():
        np.testing.assert_array_equal(policy.weights[0], alone[name].weights[0])
    assert mapping_to_data(steep) == {"name": "steep", "parameters": {"slope": 3.0}, "import": STEEP}
    assert pickle.loads(pickle.dumps(REGISTRY)) is REGISTRY
    assert pickle.loads(pickle.dumps(steep)) == steep and mapping_named("steep", slope=3.0) == steep

    forget()
    with pytest.raises(InvalidFile, match=f"'steep': import my_package.mappings first .*--mapping {STEEP}"):
        load_policies(package / "policies")
    # No file makes anything be imported.
    assert "my_package" not in sys.modules
    again = mapping_named(STEEP, slope=3.0)
    loaded = load_policies(package / "policies")
    assert loaded["p0"].mapping == again
    evaluation = evaluate(loaded, timeline_of(), episodes=5)
    assert evaluation.mapping == "steep" and evaluation.names == tuple(trained)


def test_its_commands_are_those_that_the_robot_gets(package: Path) -> None:
    """With the percentiles P0, ..., P100 = 10, ..., 110 Hz: u = tanh(2 (x - 60) / 100)."""
    percentiles = np.linspace(10.0, 110.0, 11)
    np.testing.assert_allclose(mapping_named(STEEP).command(85.0, percentiles), np.tanh(0.5))
    env = gymnasium.make("animat:Animat/Cartpole-v0", mapping=STEEP)
    env.reset(seed=1)
    p = np.asarray(env.unwrapped.setup.simulator.percentiles)
    for _ in range(3):
        *_, info = env.step(4)
        wanted = np.tanh(2 * (info["rate_hz"] - p[5]) / (p[10] - p[0]))
        np.testing.assert_allclose(info["command"], wanted, atol=1e-5)


@pytest.mark.oracle
def test_the_command_line_trains_evaluates_and_runs_it(package: Path, capsys: Any) -> None:
    write_synthetic_series(0, "recordings", sessions=1)
    few = ["--recordings", "recordings", "--policies", "1", "--iterations", "256", "--workers", "1"]
    assert main(["train", "cartpole", *few, "--mapping", STEEP]) == 0
    forget()
    assert main(["evaluate", "--recordings", "recordings"]) == 1
    assert f"--mapping {STEEP}" in capsys.readouterr().err
    asked = ["--recordings", "recordings", "--mapping", STEEP, "--episodes", "2"]
    assert main(["evaluate", *asked]) == 0
    assert main(["evaluate", *asked, "--mapping", "linear"]) == 1
    assert "expected a policy with the mapping linear, got one with steep" in capsys.readouterr().err
    assert main(["run", *asked, "--culture", "replay"]) == 0
    assert "cartpole, steep" in capsys.readouterr().out
    forget()
    film = ["replay", "policies", "--recordings", "recordings", "--span-s", "0", "1"]
    assert main([*film, "--mapping", STEEP]) == 0
    assert main(["replay", "session", "--mapping", STEEP]) == 1
    assert "--mapping: expected none with a session" in capsys.readouterr().err


@pytest.mark.oracle
@pytest.mark.usefixtures("in_this_process")
def test_a_study_has_conditions_with_it(package: Path) -> None:
    study = Study(
        culture=Source("files", files=("data/tiny/recording_0000_min.npz",)),
        robots=(RobotSpec("cartpole", iterations=240),),
        arms=(Arm("steep", mapping=STEEP), Arm("one threshold")),
        policies=1,
        episodes=2,
        episodes_over_time=2,
        optimum_resolution=0.25,
        algorithm={"environments": 8, "gradient_steps": 1, "batch": 16, "replay": 256, "hidden": 8},
    )
    (package / "study.toml").write_text(study_to_toml(study))
    assert read_study(package / "study.toml") == study
    ran = run_study(study, package / "study", base=Path(__file__).parent, workers=1)
    assert STEEP in ran.report.read_text()


def test_an_installed_package_announces_its_mappings(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = [EntryPoint("steep", STEEP, "animat.mappings"), EntryPoint("flat", STEEP, "animat.mappings")]

    def found(*, group: str, name: str | None = None) -> list[EntryPoint]:
        return [point for point in points if group == point.group and name in (None, point.name)]

    monkeypatch.setattr("importlib.metadata.entry_points", found)
    with pytest.raises(InvalidArgument, match="expected one of 1-threshold, 9-thresholds, linear, steep, flat, got 'x"):
        mapping_named("x")
    assert Arm("a", mapping="steep").mapping == STEEP
    assert mapping_from_data("steep") == mapping_named(STEEP)
    with pytest.raises(InvalidArgument, match="to have the name 'flat', got 'steep'"):
        mapping_named("flat")


@pytest.mark.parametrize("data", [STEEP, {"name": STEEP, "parameters": {}}, 5, {"name": "steep"}])
def test_a_file_makes_nothing_be_imported(data: Any, package: Path) -> None:
    with pytest.raises(InvalidArgument, match=r"^mapping: expected "):
        mapping_from_data(data)
    assert "my_package" not in sys.modules


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("import animat", "import animat; 1 / 0", "my_changed:Steep to be importable, got ZeroDivisionError"),
        ("def command", "def order", "expected the methods of a mapping, got a class without command"),
        ("@dataclass(frozen=True)", "", "expected a frozen dataclass"),
        ('name = "steep"', 'name = "none"', "no other mapping has, got 'none', which is part of animat"),
        ('name = "steep"', 'name = "linear"', "no other mapping has, got 'linear', which is part of animat"),
        ("return ", "return 1 / 0 * ", "^Steep.command: expected commands, got ZeroDivisionError: "),
        ("return ", "return -", "^Steep.command: expected commands that never fall as the response rises, got "),
        ("return ", "return 2 * ", "^Steep.command: expected commands from -1 to 1, got "),
        ("return ", "return 0 * x[..., None] + ", r"^Steep.command: expected (25 )?commands"),
        ("/ (span + (span == 0))", "/ span", "from -1 to 1 where all percentiles are equal, got "),
        ("slope: float = 2.0", "slope: object = field(default_factory=list)", "^Steep: expected a frozen dataclass of"),
    ],
)
def test_what_is_no_mapping_is_named_in_a_line_before_anything_is_read(
    before: str, after: str, words: str, package: Path, capsys: Any
) -> None:
    at = written(package, before, after)
    (package / "my_changed.py").write_text("from dataclasses import field\n" + (package / "my_changed.py").read_text())
    with warnings.catch_warnings():
        # No words of NumPy's before our line.
        warnings.simplefilter("error", RuntimeWarning)
        assert main(["train", "cartpole", "--recordings", "no-such-folder", "--mapping", at]) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and re.search(words, said[0].removeprefix("animat: ")), said


def test_what_is_not_registered_is_not_named_by_a_file(package: Path) -> None:
    at = written(package, "@animat.register_mapping\n", "")
    kind = type(mapping_named(at))
    forget()
    with pytest.raises(InvalidArgument, match=r"expected a registered one.* got Steep, .*register_mapping"):
        train(Training("cartpole", kind(), algorithm=SMALL), timeline_of(), package / "out")
    assert not (package / "out").exists()


def test_it_may_be_one_of_a_list_in_a_specification(package: Path) -> None:
    listed = f'[[arms]]\nname = "{{mapping}}"\nmapping = ["1-threshold", "{STEEP}"]\n'
    (package / "study.toml").write_text(listed)
    study = read_study(package / "study.toml")
    assert [arm.name for arm in study.arms] == ["1-threshold", "my_package.mappings.Steep"]
