"""`animat run` beside recordings: it says where the culture is not theirs, and takes the conditions of the policies."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cli import main
from animat.cultures.series import STATE_FILE, record_virtual_series
from animat.cultures.virtual import VirtualCulture
from animat.mapping import Thresholds
from animat.neurons.conditions import Condition
from animat.recordings.made_up import make_up_recording
from animat.recordings.protocol import Presentation, Protocol
from animat.recordings.selection import SelectionRule
from animat.robots import Navigation
from animat.training.policy import Policy
from cultures import small_culture

RULE = SelectionRule(recording_sites=150, stimulation_sites=16, patterns=8)
PROTOCOL = Protocol(order="mixed", pulses=2, patterns=8, presentations=20, setup_s=0.1)
FIVE_HZ = (5.0, 10.0, 20.0, 40.0, 80.0)


def policy_of(seed: int, frequencies_hz: tuple[float, ...] = FIVE_HZ) -> Policy:
    rng, robot, n = np.random.default_rng(seed), Navigation(episode_limit=8), len(frequencies_hz)
    sizes = ((len(robot.quantities), 16), (16, 16), (16, n))
    return Policy(
        weights=tuple(rng.standard_normal(size).astype(np.float32) for size in sizes),
        biases=tuple(np.zeros(size[1], np.float32) for size in sizes),
        scales=np.ones(len(robot.quantities), np.float32),
        robot=robot,
        mapping=Thresholds(1),
        conditions=tuple(Condition(f"{hz:g} Hz", hz, "Hz") for hz in frequencies_hz),
        window_ms=(2.0, 10.0),
        presentation=Presentation("mixed", 2),
    )


@pytest.fixture(scope="module")
def series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "recordings"
    record_virtual_series(partial(small_culture, rule=RULE), PROTOCOL, folder, sessions=2, interval_min=2.0)
    return folder


@pytest.fixture
def small_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Virtual cultures by the name of their kind are small."""

    def small(kind: str, *, seed: int, state: Path | None, **_: Any) -> VirtualCulture:
        culture = small_culture(seed, rule=RULE)
        if state is not None:
            culture.restore_state(state)
        return culture

    monkeypatch.setattr("animat.cultures.kinds.culture_of", small)


def run(out: Path, policy: Policy, recordings: Path, *more: str) -> int:
    policy.save(out.parent / "p0.safetensors")
    given = ["--recordings", str(recordings), "--controls", "random", "--episodes", "1", "--json"]
    return main(["run", str(out.parent / "p0.safetensors"), "--out", str(out), *given, *more])


@pytest.mark.parametrize(
    ("more", "has_state", "words"),
    [
        (["--at-min", "2"], True, ""),
        (["--at-min", "2", "--state", "{state}"], False, ""),
        (["--at-min", "0"], False, ""),
        (["--at-min", "2"], False, "begins anew at 0 min, and its percentiles are of the recording at 2 min"),
        (["--at-min", "2", "--culture-seed", "1"], True, "begins anew at 0 min"),
        (["--culture-seed", "2"], True, "of virtual culture 1, and this is virtual culture 2"),
    ],
)
def test_a_virtual_culture_that_is_not_as_it_was_recorded_is_told(
    more: list[str],
    has_state: bool,
    words: str,
    series: Path,
    tmp_path: Path,
    small_ones: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    for file in series.glob("*.nwb"):
        (recordings / file.name).symlink_to(file)
    if has_state:
        (recordings / STATE_FILE).symlink_to(series / STATE_FILE)
    options = [word.replace("{state}", str(series / STATE_FILE)) for word in more]
    assert run(tmp_path / "session", policy_of(0), recordings, *options) == 0
    printed = capsys.readouterr()
    found = {f["name"]: f["sentence"] for f in json.loads(printed.out.splitlines()[-1])["findings"]}
    assert ("other-culture" in found) == bool(words)
    assert words in found.get("other-culture", "")
    assert ("other percentiles" in printed.err) == bool(words)


def test_recordings_of_no_virtual_culture_are_told(
    tmp_path: Path, small_ones: None, capsys: pytest.CaptureFixture[str]
) -> None:
    make_up_recording(1, channels=32).save(tmp_path / "made-up.nwb")
    assert run(tmp_path / "session", policy_of(0), tmp_path / "made-up.nwb") == 0
    assert "the recordings are of no virtual culture, and this is virtual culture 1" in capsys.readouterr().err
