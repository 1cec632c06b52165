"""What a culture could do before any training. Oracles: the limit itself, constants and random stimuli run apart."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import pytest

from animat.animat import Animat
from animat.cli import main
from animat.evaluation.optimum import best_return
from animat.evaluation.prospects import prospects
from animat.evaluation.rollouts import Constant, Uniform, roll_out
from animat.mapping import Thresholds
from animat.neurons.responses import extract_responses
from animat.neurons.simulator import fit_histogram
from animat.recordings.made_up import make_up_recording
from animat.recordings.reading import read_recording
from animat.robots import Cartpole

ROBOT = Cartpole(episode_limit=60)


def test_it_is_the_limit_of_the_default_simulator_above_random_and_constant_stimuli() -> None:
    responses = extract_responses(make_up_recording(1, patterns=40, channels=64))
    (found,) = prospects(responses, ROBOT, [Thresholds(9)], resolution=0.25)
    simulator = fit_histogram(responses)
    environment = Animat(ROBOT, Thresholds(9), 5)
    assert (found.robot, found.mapping) == ("cartpole", "9-thresholds")
    assert found.best == best_return(environment, simulator, resolution=0.25, episodes=1000)
    random = roll_out(environment, simulator, Uniform(), 1, episodes=4000, seed=9).returns
    assert abs(found.random - random.mean()) < 4 * found.random_standard_error * 1.2
    for i in (0, 4):
        constant = roll_out(environment, simulator, Constant(jnp.array([i])), 1, episodes=300, seed=2).returns
        assert constant.mean() < found.best.value
    assert "cartpole, 9-thresholds: random -" in found.to_text()
    json.dumps(found.to_dict())


def test_inspect_tells_the_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rough = partial(prospects, resolution=0.25, episodes=20)
    monkeypatch.setattr("animat.evaluation.prospects.prospects", rough)
    make_up_recording(1, patterns=40, channels=64).save(tmp_path / "a.nwb")
    assert main(["inspect", str(tmp_path / "a.nwb"), "--limit", "cartpole", "--json"]) == 0
    said = capsys.readouterr().out.splitlines()
    (inspected,) = json.loads(said[-1])["recordings"]
    assert [limit["mapping"] for limit in inspected["limits"]] == ["1-threshold", "9-thresholds"]
    one = inspected["limits"][0]
    simulator = fit_histogram(extract_responses(read_recording(tmp_path / "a.nwb")))
    direct = best_return(Animat(Cartpole(), Thresholds(1), 5), simulator, resolution=0.25, episodes=0)
    assert one["best"]["value"] == pytest.approx(direct.value, abs=0.5)
    told = next(line for line in said if "1-threshold: random" in line)
    assert f"best possible return {one['best']['value']:.1f}" in told


def test_where_there_is_no_limit_it_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_up_recording(1, patterns=5, channels=16).save(tmp_path / "a.nwb")
    command = ["inspect", str(tmp_path / "a.nwb"), "--conditions", "frequency:5,7", "--limit", "navigation", "--json"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "navigation: no best possible return: " in said
    assert json.loads(said.splitlines()[-1])["recordings"][0]["limits"] is None


def test_a_robot_that_is_not_known_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "a.nwb", "--limit", "submarine"]) != 0
    assert "submarine" in capsys.readouterr().err
