"""Arguments of the wrong kind are refused in one line by everything public."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import animat
from animat.closed_loop.loop import Loop
from animat.coding.encoder import Encoder
from synthetic_recordings import synthetic_recording
from test_closed_loop import loop_of

FUNCTIONS = [name for name in animat.__all__ if inspect.isfunction(getattr(animat, name)) and name != "paper_study"]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_function_names_an_argument_of_the_wrong_kind(name: str) -> None:
    function, stranger = getattr(animat, name), object()
    parameters = inspect.signature(function).parameters.values()
    required = [each.name for each in parameters if each.default is each.empty and each.kind != each.VAR_KEYWORD]
    assert required
    with pytest.raises(animat.InvalidArgument) as raised:
        function(**dict.fromkeys(required, stranger))
    first = {"conditions_named": "conditions", "register_robot": "robot", "register_mapping": "mapping"}
    assert str(raised.value).startswith((f"{first.get(name, required[0])}: expected ", "recordings: expected "))
    assert "\n" not in str(raised.value)


def test_numbers_from_numpy_are_saved_as_python_s() -> None:
    """JSON does not know them, and a training would fail only when its policies are saved."""
    responses = animat.extract_responses(synthetic_recording(1, patterns=3, channels=16), burst_threshold=np.float32(1))
    timeline = animat.fit_timeline([responses], kind="histogram", bins=np.int64(20), range_hz=np.float32(120))
    fitted = json.loads(json.dumps(timeline.fitted))
    assert (fitted["bins"], fitted["range_hz"], fitted["burst_threshold"]) == (20, 120, 1)
    loop = loop_of(pulses=np.int64(2), pause_s=np.float32(0.5), window_ms=(np.float32(2), np.float32(8)))
    assert json.loads(json.dumps(loop.to_dict()))["pause_s"] == 0.5


def test_lists_and_dictionaries_are_checked_inside_and_unions_said_in_full(tmp_path: Path) -> None:
    responses = animat.extract_responses(synthetic_recording(1, patterns=3, channels=16))
    timeline = animat.fit_timeline([responses])
    with pytest.raises(ValueError, match="read-only"):
        timeline.start_min[0] = 5.0
    refused = {
        "robot: expected a robot, such as animat.Cartpole(), got 'cartpole'": lambda: animat.optimal_returns(
            responses,
            "cartpole",  # type: ignore[arg-type]
            [animat.Thresholds(9)],
        ),
        "mappings: expected a list of mappings, such as [animat.Thresholds(9)], got 'linear'": lambda: (
            animat.optimal_returns(responses, animat.Cartpole(), ["linear"])  # type: ignore[list-item]
        ),
        "policies: expected policies by name, as animat.load_policies returns, got 3": lambda: animat.evaluate(
            {"p0": 3}, timeline
        ),  # type: ignore[dict-item]
        "recordings: expected a list of recordings, as animat.read_recordings returns, got 'folder'": lambda: (
            animat.ReplayCulture("folder")  # type: ignore[arg-type]
        ),
        "bins: expected a whole number, got 20.5": lambda: animat.fit_histogram(
            responses,
            bins=20.5,  # type: ignore[arg-type]
        ),
        "start_min: expected a number, or None, got '5'": lambda: animat.read_recording(
            tmp_path,
            start_min="5",  # type: ignore[arg-type]
        ),
        "bins: expected 1 to 10,000, got -3; only histogram simulators have bins": lambda: animat.fit_timeline(
            [responses], bins=-3
        ),
        "pulses: expected at least 1, got 0": lambda: Encoder(timeline.conditions, 0),
        "patterns: expected a whole number, or None, got 1.5": lambda: Loop(
            animat.Cartpole(),
            animat.Thresholds(9),
            timeline.conditions,
            np.arange(11.0),
            patterns=1.5,  # type: ignore[arg-type]
        ),
        "executor: expected an executor, such as a concurrent.futures.ProcessPoolExecutor, or None, got 3": lambda: (
            animat.run_study(
                animat.paper_study(),
                tmp_path,
                executor=3,  # type: ignore[arg-type]
            )
        ),
        "path: expected a path, got None": lambda: animat.read_study(None),  # type: ignore[arg-type]
        "path: expected a name ending in .nwb, got r.txt": lambda: animat.write_nwb(
            synthetic_recording(1, patterns=3, channels=16), "r.txt"
        ),
        "make_culture: expected a function that returns a culture, such as lambda: animat.VirtualCulture(seed=1), got "
        "VirtualCulture(seed=1)": lambda: animat.record_series(
            animat.VirtualCulture(1),  # type: ignore[arg-type]
            animat.Protocol(),
            tmp_path,
        ),
        "protocol: expected a protocol, such as animat.Protocol(trials=5), or a function that returns a protocol, such "
        "as lambda: animat.Protocol(trials=5), got 'slow.json'": lambda: animat.record_series(
            lambda: animat.VirtualCulture(1),
            "slow.json",  # type: ignore[arg-type]
            tmp_path,
        ),
        "allow: expected a list of names, got 'few-responses'": lambda: animat.extract_series(
            [],
            allow="few-responses",  # type: ignore[arg-type]
        ),
        "progress: expected a progress, such as animat.Bar('training'), or None, got True": lambda: animat.train(
            animat.Training("cartpole", "9-thresholds"),
            timeline,
            tmp_path / "none",
            progress=True,  # type: ignore[arg-type]
        ),
        "agents: expected agents by name, such as {'mine': Rule()}, or None, got [1]": lambda: animat.evaluate(
            {},
            timeline,
            agents=[1],  # type: ignore[arg-type]
        ),
        "first: expected numbers, got 'a'": lambda: animat.compare("a", [1.0]),
        "count: expected 1 or 9 thresholds, got 9.0": lambda: animat.Thresholds(9.0),  # type: ignore[arg-type]
    }
    for message, call in refused.items():
        with pytest.raises(animat.InvalidArgument) as raised:
            call()
        assert str(raised.value) == message


def test_numbers_of_numpy_and_what_can_be_read_once_are_taken() -> None:
    responses = animat.extract_responses(synthetic_recording(1, patterns=3, channels=16), burst_threshold=np.float32(1))
    assert len(animat.fit_timeline(each for each in (responses,))) == 1  # type: ignore[arg-type]
    assert animat.paper_study(seed=np.int64(3)) == animat.paper_study(seed=3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"spike_times_s": "a"}, "spike_times_s: expected an array of numbers, got 'a'"),
        ({"spike_channels": None}, "spike_channels: expected an array of numbers, got None"),
        ({"channels": [1, 2]}, "channels: expected a channel table, animat.Channels, got [1, 2]"),
        ({"stimuli": None}, "stimuli: expected a table of stimuli, animat.Stimuli, got None"),
        ({"sampling_rate_hz": "20 kHz"}, "sampling_rate_hz: expected a number, got '20 kHz'"),
        ({"provenance": {"chip": 7}}, "provenance: expected text by name, got 7"),
        ({"findings": None}, "findings: expected a list of findings, got None"),
        (
            {"protocol": "paper"},
            "protocol: expected a protocol, such as animat.Protocol(trials=5), or None, got 'paper'",
        ),
    ],
)
def test_a_recording_made_by_hand_names_what_is_of_the_wrong_kind(changed: Any, message: str) -> None:
    recording = synthetic_recording(1, patterns=3, channels=16)
    given = {field.name: getattr(recording, field.name) for field in fields(recording)}
    assert animat.Recording(**given).equals(recording)
    with pytest.raises(animat.AnimatError) as raised:
        animat.Recording(**{**given, **changed})
    assert str(raised.value) == message


@pytest.mark.oracle
def test_names_in_place_of_a_robot_and_a_mapping_are_refused() -> None:
    # In a process of its own: here the type checks of the tests come first.
    for arguments, message in (
        ("'cartpole', '9-thresholds', 5", "robot: expected a robot, such as animat.Cartpole(), got 'cartpole'"),
        ("animat.Cartpole(), 'linear', 5", "mapping: expected a mapping, such as animat.Thresholds(9), got 'linear'"),
    ):
        ran = subprocess.run(
            [sys.executable, "-c", f"import animat; animat.Animat({arguments})"], capture_output=True, text=True
        )
        assert ran.returncode and ran.stderr.rstrip().endswith(f"InvalidArgument: {message}")


@pytest.mark.parametrize("wrong", [3, [3]])
def test_a_list_of_pairs_is_described_as_such(wrong: Any) -> None:
    with pytest.raises(
        animat.InvalidArgument, match=r"^cases: expected several of: a tuple of an env.* and a sim.*, got 3$"
    ):
        animat.best_returns(wrong)
