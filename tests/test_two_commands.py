"""A robot with two commands, from an empty file to a closed loop: each command is that of its own readout."""

from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.cli import main
from animat.closed_loop.agents import ActorController, Agent, OneCondition, random_control
from animat.closed_loop.header import read_header
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.closed_loop.session import read_session
from animat.coding.mapping import Thresholds
from animat.environment import Animat, WithoutNeurons
from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.evaluation.rollouts import HeuristicPolicy
from animat.evaluation.table import evaluate
from animat.execution.training import train
from animat.neurons.history_tracker import AdjustedRanks
from animat.neurons.simulator import fit_empirical
from animat.neurons.timeline import SimulatorTimeline, fit_timeline
from animat.reality_gap import Calibration, run_policies
from animat.reality_gap.session_responses import read_responses
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.recording import Recording
from animat.responses.extraction import extract_responses, extract_series
from animat.responses.readouts import ALL, Readouts
from animat.robots import Cartpole, Robot
from animat.robots.checking import check_robot
from animat.robots.registry import REGISTRY
from animat.stimulation.protocol import Protocol
from animat.training.policy import Policy
from animat.training.specification import Training
from fake_culture import CHANNELS, FakeCulture
from synthetic_recordings import write_synthetic_series
from test_adaptive_thresholds import thresholds_after
from test_training import SMALL
from two_wheels import FILE, Wheels

PROTOCOL = Protocol(order="mixed", patterns=8, trials=40, setup_s=0.1)


@pytest.fixture(autouse=True)
def _registered_for_one_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(REGISTRY, "_registered", dict(REGISTRY._registered))


@pytest.fixture(scope="module")
def recording() -> Recording:
    with FakeCulture() as culture:
        return culture.record(PROTOCOL, 0)


@pytest.fixture(scope="module")
def timeline(recording: Recording) -> SimulatorTimeline:
    return fit_timeline(extract_series([recording], readouts="halves", burst_threshold=0.95))


@pytest.fixture(scope="module")
def policies(timeline: SimulatorTimeline) -> dict[str, Policy]:
    return train(
        Training(Wheels(episode_limit=8), "9-thresholds", policies=2, iterations=480, algorithm=SMALL), timeline, None
    )


def numbers(values: Sequence[str]) -> list[float]:
    return [float(value) for value in values]


def test_it_runs_in_closed_loop_each_command_by_its_own_half(timeline: SimulatorTimeline, tmp_path: Path) -> None:
    responses = timeline.responses[0]
    loop = Loop(
        Wheels(episode_limit=8),
        Thresholds(9),
        timeline.conditions,
        np.asarray(timeline.at(0.0).percentiles),
        adaptive_from=AdjustedRanks.of(responses, fit_empirical(responses)),
        burst_threshold=0.95,
        on_burst="skip",
        warm_up=1,
        readouts=timeline.readouts,
    )
    means = jnp.array([[(0.2 * i - 0.4, 0.4 - 0.2 * i) for i in range(5)]])
    rule = ActorController(HeuristicPolicy(jnp.arange(5)[None], means), Animat(loop.robot, loop.mapping, 5))
    agents = [
        random_control(5),
        Agent("constant", "", OneCondition(3), calibrates=False),
        Agent("heuristic", "", rule),
        Agent("silent", "", OneCondition(0), "silent"),
    ]
    with FakeCulture(3) as culture:
        ended = run_session(culture, loop, agents, tmp_path, episodes=2).ending
    assert ended.by == "plan", ended

    with FakeCulture(3) as culture:
        run_session(culture, replace(loop, burst_threshold=0.0), agents[:1], tmp_path / "bursts", episodes=1)
    # Until a response is used, the robot stands still.
    skipped = [tick for tick in read_session(tmp_path / "bursts").ticks if tick.handled != "warm-up"]
    assert skipped and all((tick.handled, tick.command) == ("skipped", (0.0, 0.0)) for tick in skipped)

    # The session's own recording, read like any other, says what was read of each half.
    session = read_session(tmp_path)
    whole = extract_responses(session.recording(), burst_threshold=0.95, readouts=loop.readouts)
    stimulated = [tick for tick in session.ticks if tick.patterns]
    np.testing.assert_array_equal(whole.read_hz, [tick.readout_hz for tick in stimulated])
    np.testing.assert_array_equal(whole.rate_hz, [tick.rate_hz for tick in stimulated])

    # The thresholds adapt to each half on its own, computed again here from the responses before.
    adapted = iter([w["percentiles_hz"] for w in session.log.fields() if "percentiles_hz" in w])
    now, moved = np.asarray(loop.percentiles, np.float32), 0
    answered_hz: list[list[tuple[int, float, float]]] = [[], []]
    for tick in session.ticks:
        if tick.handled == "used":
            each = zip(tick.readout_hz, now, strict=True)
            wanted = [Thresholds(9).command(np.float32(x), p) for x, p in each]
            assert tick.command == tuple(wanted)
            moved += len(set(tick.command)) > 1
        if (tick.agent != "constant" or tick.handled == "warm-up") and tick.patterns and not tick.is_burst:
            now = np.asarray(next(adapted), np.float32)
            for d, of_half in enumerate(answered_hz):
                of_half.append((tick.delivered, tick.readout_hz[d], 0.0))
    assert next(adapted, None) is None
    for d, of_half in enumerate(answered_hz):
        recorded_hz = [responses.read_of(i)[:, d] for i in range(5)]
        np.testing.assert_allclose(now[d], thresholds_after(recorded_hz, of_half), rtol=1e-5)
    assert moved > 10

    with (tmp_path / "ticks.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    for row, tick in zip(table, session.ticks, strict=True):
        assert numbers([row["rate_hz_left"], row["rate_hz_right"]]) == list(tick.readout_hz)
        if tick.command is not None:
            assert numbers([row["command_left"], row["command_right"]]) == list(tick.command)
    assert "command" not in table[0]

    # Each condition's commands, as the reasons of a gap ask.
    names = "random", "constant", "heuristic"
    read = read_responses(session, loop, names)
    acted = [tick for tick in session.ticks if tick.handled != "warm-up" and tick.agent in names]
    used, delivered = np.array([(tick.handled == "used", tick.delivered) for tick in acted]).T
    assert 0 < used.sum() < len(acted)
    np.testing.assert_array_equal(read.moved, used)
    of_each = [tick.command if tick.handled == "used" else (np.nan, np.nan) for tick in acted]
    np.testing.assert_array_equal(read.command, of_each)
    np.testing.assert_array_equal(read.responses.read_hz, [tick.readout_hz for tick in acted])
    commanded = read.commanded.summed(0)
    for i in range(5):
        of_condition = (delivered == i) & (used == 1)
        assert commanded.presented[i] == of_condition.sum()
        np.testing.assert_allclose(commanded.total[i], read.command[of_condition].sum(axis=0))


@pytest.mark.oracle
def test_policies_run_and_are_predicted(
    timeline: SimulatorTimeline, policies: dict[str, Policy], tmp_path: Path
) -> None:
    calibration = Calibration.of_series(timeline.responses)
    with FakeCulture(3) as culture:
        gap = run_policies(policies, culture, calibration, tmp_path, episodes=4)
    assert gap.session.ending.by == "plan" and np.all(np.isfinite(gap.rows[0].measured))
    assert "no-optimum" in {finding.name for finding in gap.findings}
    assert {"silent", "shuffled", "heuristic", "constant 5 Hz"} <= {row.name for row in gap.rows}


@pytest.mark.oracle
def test_a_policy_carries_its_readouts_through_its_file(
    policies: dict[str, Policy], timeline: SimulatorTimeline
) -> None:
    assert policies["p0"].readouts == timeline.readouts
    evaluation = evaluate(policies, timeline, episodes=5)
    assert np.all(np.isfinite(evaluation.rows[0].episodes.returns))
    assert evaluation.rows[0].episodes.commanded.shape[1:] == (5, 2)
    with pytest.raises(InvalidArgument, match="readouts: expected 2, one for each command of two-wheels, got 1"):
        replace(policies["p0"], readouts=ALL)
    other = replace(timeline, readouts=replace(timeline.readouts, names=("a", "b")))
    with pytest.raises(Mismatch, match=r"readouts: expected left, right, .*, got a, b"):
        evaluate(policies, other, episodes=5)


def test_what_does_not_fit_is_refused_in_a_line(recording: Recording, timeline: SimulatorTimeline) -> None:
    training = Training(Wheels(), "1-threshold", policies=1, algorithm=SMALL)
    whole = fit_timeline(extract_series([recording], burst_threshold=0.95))
    with pytest.raises(
        InvalidArgument, match="readouts: expected 2, one for each command of two-wheels, got 1; halves"
    ):
        train(training, whole, None)
    with pytest.raises(InvalidArgument, match="readouts: expected 1, one for each command of cartpole, got 2"):
        train(replace(training, robot=Cartpole()), timeline, None)
    with pytest.raises(
        InvalidArgument, match="commands: expected none to pick from for two-wheels, which takes 2 at once"
    ):
        replace(training, mapping=None, commands=(-1.0, 1.0))
    with pytest.raises(InvalidArgument, match="commands: expected none to pick from for two-wheels"):
        WithoutNeurons(Wheels(), (-1.0, 1.0))


@pytest.fixture(scope="module")
def baseline() -> dict[str, Policy]:
    """Trained for no time at all."""
    return train(Training(Wheels(episode_limit=8), None, policies=2, iterations=480, algorithm=SMALL), None, None)


@pytest.mark.oracle
def test_without_neurons_both_commands_are_continuous(baseline: dict[str, Policy], tmp_path: Path) -> None:
    REGISTRY._registered["two-wheels"] = Wheels
    baseline["p0"].save(tmp_path / "p0.safetensors")
    policy = Policy.load(tmp_path / "p0.safetensors")
    assert policy.n_actions is None and policy.commands is None
    # What is drawn is the squashed normal of each command; what is most probable, its middle.
    seen = np.array([0.3, -0.4, 1.0])
    means, log_deviations = np.split(policy.outputs(seen), 2)
    np.testing.assert_allclose(policy.act_greedily(seen), np.tanh(means), rtol=1e-6)
    rng = np.random.default_rng(0)
    z = np.arctanh(np.array([policy.act(seen, rng) for _ in range(4000)]))
    np.testing.assert_allclose(z.mean(axis=0), means, atol=4 * np.exp(log_deviations).max() / np.sqrt(4000))
    np.testing.assert_allclose(z.std(axis=0), np.exp(log_deviations), rtol=0.06)


@pytest.mark.oracle
def test_the_baselines_table_has_what_there_is_without_neurons(baseline: dict[str, Policy]) -> None:
    table = evaluate(baseline, None, episodes=40, optimum_resolution=0.5)
    assert [row.name for row in table.rows] == ["policies", "random", "heuristic", "coupling"]
    assert table.no_optimum is not None and "expected one command for an optimal return, got 2" in table.no_optimum
    # The heuristic policy is the robot's own, for any commands can be given.
    wheels = Wheels(episode_limit=8)
    state = wheels.reset(jax.random.key(4))
    seen = wheels.observe(state)
    environment = WithoutNeurons(wheels, None)
    rule = HeuristicPolicy().act(environment, (seen / environment.scales)[None], jnp.zeros((1, 2)))
    np.testing.assert_allclose(rule[0], wheels.heuristic(seen), rtol=1e-6)


@pytest.mark.oracle
def test_the_baseline_of_two_commands_learns_to_drive() -> None:
    trained = train(Training(Wheels(), None, policies=1, iterations=60_000), None, None)
    returns = {row.name: float(row.episodes.returns.mean()) for row in evaluate(trained, None, episodes=40).rows}
    # At random it stays where it is, a field away from the middle; the heuristic drives it there.
    assert returns["random"] < -40
    assert returns["heuristic"] > -12
    assert returns["policies"] > -15


@pytest.mark.oracle
def test_the_command_line_trains_it_without_neurons(tmp_path: Path) -> None:
    (tmp_path / "two_wheels.py").write_text(FILE)
    given = ["train", "two_wheels:Wheels", "--mapping", "none", "--policies", "1", "--iterations", "200"]
    ran = subprocess.run(
        [sys.executable, "-m", "animat", *given, "--out", "policies"], cwd=tmp_path, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    # The mean of each wheel, then its log deviation.
    (described,) = re.findall(
        rb"layer2.bias[^}]*?shape\":\[(\d+)\]", (tmp_path / "policies/p0.safetensors").read_bytes()
    )
    assert int(described) == 4


def changed(**methods: Any) -> Robot[Any]:
    return type("Changed", (Wheels,), methods)()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        (changed(n_commands=0), "n_commands: expected a whole number from 1 to 64, got 0"),
        (changed(n_commands=3), "advance: expected it to run under jax.jit"),
        (changed(heuristic=lambda self, seen: seen[0]), r"heuristic: expected a command, shape \(2,\), got shape \(\)"),
        (changed(heuristic=lambda self, seen: 0 * seen[:2] + 2), "heuristic: expected commands from -1 to 1, got 2"),
    ],
)
def test_a_robot_of_two_commands_is_checked(robot: Robot[Any], words: str) -> None:
    check_robot(Wheels())
    with pytest.raises(InvalidArgument, match=words):
        check_robot(robot)


def test_the_heuristic_policy_takes_the_nearest_in_the_plane() -> None:
    means = ((-1.0, -1.0), (0.9, -0.2), (1.0, 1.0))
    for wanted, nearest in (((0.2, -0.9), 1), ((0.3, 0.9), 2), ((-1.0, -0.1), 0)):
        robot = changed(heuristic=lambda self, seen, wanted=wanted: np.array(wanted))
        rule = HeuristicPolicy(jnp.arange(3)[None], jnp.asarray(means, jnp.float32)[None])
        acts = ActorController(rule, Animat(robot, Thresholds(1), 3))
        assert acts.act(np.zeros(3), np.random.default_rng()) == nearest


def test_it_is_a_gymnasium_environment(recording: Recording, timeline: SimulatorTimeline) -> None:
    place = f"{Wheels.__module__}:Wheels"
    with pytest.raises(InvalidArgument, match="recordings: expected some for two-wheels, which takes 2 commands"):
        gymnasium.make("animat:Animat/Robot-v0", robot=place)
    env = gymnasium.make("animat:Animat/Robot-v0", robot=place, simulator=timeline.at(0.0), mapping="linear")
    env.reset(seed=1)
    *_, info = env.step(2)
    envs = gymnasium.make_vec("animat:Animat/Robot-v0", num_envs=3, robot=place, simulator=timeline.at(0.0))
    envs.reset(seed=1)
    *_, infos = envs.step(np.array([0, 1, 2]))
    assert info["command"].shape == (2,) and infos["command"].shape == (3, 2) and infos["rate_hz"].shape == (3, 2)
    p = np.asarray(timeline.at(0.0).percentiles)
    np.testing.assert_array_equal(infos["command"], np.where(infos["rate_hz"] >= p[:, 5], 1.0, -1.0))


def test_logs_of_before_have_no_readouts(tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match="readouts"):
        read_header(tmp_path, {**HEADER, "loop": {**HEADER["loop"], "readouts": 5}})
    assert read_header(tmp_path, HEADER).readouts == ()
    loop = {**HEADER["loop"], "readouts": Readouts(("a", "b"), ((1,), (2,))).to_dict()}
    assert read_header(tmp_path, {**HEADER, "loop": loop}).readouts == ("a", "b")


HEADER: dict[str, Any] = {
    "format": "animat closed-loop session 1",
    "channels": {"label": ["0"], "electrode": [1], "x_um": [0.0], "y_um": [0.0]},
    "loop": {"pulses": 1, "conditions": ["5 Hz"]},
    "recorded_at": "2026-01-01T00:00:00+00:00",
    "sampling_rate_hz": 20000.0,
    "start_min": 0.0,
    "agents": [{"name": "p0"}],
    "provenance": {},
    "observed": ["x_m"],
}


def test_the_file_of_the_page_is_short() -> None:
    assert len(FILE.splitlines()) < 120 and CHANNELS == 16


@pytest.mark.oracle
def test_the_file_of_the_page_runs_as_it_stands(tmp_path: Path) -> None:
    write_synthetic_series(0, tmp_path / "corners", sessions=1)
    text, n = re.subn(r"iterations=\d[\d_]*", "iterations=1_000", FILE)
    assert n == 1 and "episode_limit: int = 60" in text
    (tmp_path / "two_wheels.py").write_text(text.replace("episode_limit: int = 60", "episode_limit: int = 8"))
    environment = {**os.environ, "PYTHONPATH": ":".join(sys.path)}
    ran = subprocess.run(
        [sys.executable, "two_wheels.py"], capture_output=True, text=True, env=environment, cwd=tmp_path
    )
    assert ran.returncode == 0, ran.stderr
    assert "two-wheels, 9-thresholds" in ran.stdout and (tmp_path / "replayed" / "session.nwb").exists()


@pytest.mark.oracle
def test_electrodes_of_readouts_that_no_channel_reads_are_refused_with_their_file(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, there, out = tmp_path / "groups.json", str(tmp_path / "one.nwb"), str(tmp_path / "out")
    write_nwb(recording, there)
    file.write_text('{"left": [1], "right": [99999]}')
    assert main(["train", "wheels", "--readouts", str(file), "--recordings", there, "--out", out]) == 1
    assert f"animat: --readouts {file}: expected channels that read all electrodes of" in capsys.readouterr().err


@pytest.mark.oracle
def test_the_command_line_reads_halves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    write_synthetic_series(0, tmp_path / "recordings", sessions=1)
    (tmp_path / "my_wheels.py").write_text(FILE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    few = [
        "--recordings",
        "recordings",
        "--policies",
        "1",
        "--iterations",
        "256",
        "--workers",
        "1",
        "--parameters",
        "episode_limit=8",
    ]
    assert main(["train", "my_wheels:Wheels", *few, "--readouts", "all"]) == 1
    assert "expected 2, one for each command of two-wheels, got 1; halves are two" in capsys.readouterr().err
    # Two commands read halves, unless asked otherwise.
    assert main(["train", "my_wheels:Wheels", *few]) == 0
    assert "5 Hz: left 0." in capsys.readouterr().out
    asked = ["--recordings", "recordings", "--episodes", "2"]
    assert main(["evaluate", *asked, "--optimum"]) == 0
    assert "expected one command for an optimal return" in capsys.readouterr().out
    assert main(["inspect", "recordings", "--optimum", "arm"]) == 1
    assert "animat: --optimum: arm: expected one command for an optimal return, got 2" in capsys.readouterr().err
    assert main(["run", *asked, "--culture", "replay"]) == 0
    assert main(["live", "my_wheels:Wheels"]) == 1
    assert "a live run reads all channels as one" in capsys.readouterr().err
