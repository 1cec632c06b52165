"""`animat run` on recordings: it says where the culture is not theirs, and takes the conditions of the policies."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cli import main
from animat.closed_loop.session import read_session
from animat.coding.mapping import Thresholds
from animat.cultures.devices.cl1 import CL1_PULSE
from animat.cultures.series import STATE_FILE, record_series
from animat.cultures.virtual import VirtualCulture
from animat.errors import InvalidArgument, in_min
from animat.neurons.memory import MemorySimulator
from animat.neurons.simulator import EmpiricalSimulator, HistogramSimulator, NeuronSimulator, pooled_percentiles
from animat.reality_gap import Calibration, check_policies
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording, read_recordings
from animat.responses.condition import Condition
from animat.responses.conditions import ByElectrode, conditions_named
from animat.responses.extraction import extract_series
from animat.robots import Navigation
from animat.stimulation.protocol import Presentation, Protocol
from animat.stimulation.pulse import BALANCED_PULSE, PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.selection import SelectionRule
from animat.training.policy import Policy
from cultures import small_culture
from synthetic_recordings import synthetic_recording

pytestmark = pytest.mark.usefixtures("few_bootstraps")

RULE = SelectionRule(recording_sites=150, stimulation_sites=16, patterns=8)
PROTOCOL = Protocol(order="mixed", pulses=2, patterns=8, trials=20, setup_s=0.1)
FIVE_HZ = (5.0, 10.0, 20.0, 40.0, 80.0)


def policy_of(seed: int, frequencies_hz: tuple[float, ...] = FIVE_HZ) -> Policy:
    rng, robot, n = np.random.default_rng(seed), Navigation(episode_limit=8), len(frequencies_hz)
    sizes = ((len(robot.observation_spec), 16), (16, 16), (16, n))
    return Policy(
        weights=tuple(rng.standard_normal(size).astype(np.float32) for size in sizes),
        biases=tuple(np.zeros(size[1], np.float32) for size in sizes),
        scales=np.ones(len(robot.observation_spec), np.float32),
        robot=robot,
        mapping=Thresholds(1),
        conditions=tuple(Condition(f"{hz:g} Hz", hz, "Hz") for hz in frequencies_hz),
        window_ms=(2.0, 10.0),
        presentation=Presentation("mixed", 2),
    )


@pytest.fixture(scope="module")
def series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "recordings"
    record_series(partial(small_culture, rule=RULE), PROTOCOL, folder, sessions=2, interval_min=1.0)
    return folder


@pytest.fixture
def small_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Virtual cultures by the name of their kind are small."""

    def small(kind: str, *, seed: int, state: Path | None, **_: Any) -> VirtualCulture:
        culture = small_culture(seed, rule=RULE)
        if state is not None:
            culture.restore_state(state)
        return culture

    monkeypatch.setattr("animat.cultures.kinds.culture_named", small)


def run(out: Path, policy: Policy, recordings: Path, *more: str) -> int:
    policy.save(out.parent / "p0.safetensors")
    given = ["--recordings", str(recordings), "--controls", "random", "--episodes", "1", "--json"]
    return main(["run", str(out.parent / "p0.safetensors"), "--out", str(out), *given, *more])


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("more", "has_state", "words"),
    [
        (["--at-min", "1"], True, ""),
        (["--at-min", "1", "--state", "{state}"], False, ""),
        (["--at-min", "0"], False, ""),
        (["--at-min", "1"], False, "starts afresh at 0 min, but its percentiles are of the recording at 1 min"),
        (["--at-min", "1", "--culture-seed", "1"], True, "starts afresh at 0 min"),
        (["--culture-seed", "2"], True, "of virtual culture 1, but this is virtual culture 2"),
    ],
)
def test_a_virtual_culture_that_is_not_as_it_was_recorded_is_reported(
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
    found = {f["name"]: f["message"] for f in json.loads(printed.out.splitlines()[-1])["findings"]}
    assert ("other-culture" in found) == bool(words)
    assert words in found.get("other-culture", "")
    before_the_first_pulse = printed.err.split("the session is planned for")[0]
    assert words in before_the_first_pulse
    assert ("percentiles" in before_the_first_pulse) == bool(words)


@pytest.mark.oracle
def test_recordings_of_no_virtual_culture_are_reported(
    tmp_path: Path, small_ones: None, capsys: pytest.CaptureFixture[str]
) -> None:
    write_nwb(synthetic_recording(1, patterns=40, channels=32), tmp_path / "synthetic.nwb")
    assert run(tmp_path / "session", policy_of(0), tmp_path / "synthetic.nwb") == 0
    assert "the recordings are not of a virtual culture, but this is virtual culture 1" in capsys.readouterr().err


def recorded_by(series: Path, folder: Path, *pulses: Pulse | None) -> Path:
    """The recordings as if they had been made with these pulses; None: as in converted ones, which state none."""
    for file, pulse in zip(sorted(series.glob("*.nwb")), pulses, strict=True):
        protocol = None if pulse is None else replace(PROTOCOL, pulse=pulse)
        write_nwb(replace(read_recording(file), protocol=protocol), folder / file.name)
    return folder


OTHERS, WEAK = " as in the other recordings", Pulse((Phase(200, amplitude_mv=-100), Phase(200, amplitude_mv=100)))
USUAL = " the usual one with --culture virtual"


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("pulses", "file", "delivered", "warned"),
    [
        ((WEAK, WEAK), None, WEAK, ""),
        ((BALANCED_PULSE, None), None, BALANCED_PULSE, OTHERS),
        ((None, None), None, PUBLISHED_PULSE, USUAL),
        ((None, None), WEAK, WEAK, ""),
    ],
)
def test_a_loop_delivers_the_pulse_of_its_recordings_and_names_it_first(
    pulses: tuple[Pulse | None, ...],
    file: Pulse | None,
    delivered: Pulse,
    warned: str,
    series: Path,
    tmp_path: Path,
    small_ones: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    recordings = recorded_by(series, tmp_path / "recordings", *pulses)
    mine = tmp_path / "mine.json"
    mine.write_text(json.dumps({"pulse": (file or WEAK).to_list()}))
    given = [] if file is None else ["--protocol", str(mine)]
    assert run(tmp_path / "session", policy_of(0), recordings, "--at-min", "1", *given) == 0
    pulse = read_session(tmp_path / "session").log.header["loop"]["pulse"]
    assert Pulse.from_list(pulse) == delivered
    printed = capsys.readouterr()
    assert f"each pulse: {delivered}" in printed.err.split("the session is planned for")[0].splitlines()
    found = {f["name"]: f["message"] for f in json.loads(printed.out.splitlines()[-1])["findings"]}
    assert ("unknown-pulse" in found) == bool(warned)
    assert f"the loop delivers {delivered},{warned}" in found.get("unknown-pulse", f"the loop delivers {delivered},")


@pytest.mark.parametrize(
    ("minutes", "text"),
    [(0.0, "0 min"), (1 / 60, "0.02 min"), (14400.25, "14400.25 min"), (1_500_004.0, "1500004 min")],
)
def test_minutes_have_two_decimals_at_most(minutes: float, text: str) -> None:
    assert in_min(minutes) == text


@pytest.mark.oracle
def test_a_rehearsal_of_currents_is_given_voltages(
    series: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recordings = recorded_by(series, tmp_path / "recordings", CL1_PULSE, CL1_PULSE)
    assert run(tmp_path / "session", policy_of(0), recordings, "--culture", "replay") == 0
    assert f"each pulse: {PUBLISHED_PULSE}" in capsys.readouterr().err.splitlines()


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("pulses", "file", "words"),
    [
        ((WEAK, BALANCED_PULSE), None, f"got {WEAK} (at 0 min) and {BALANCED_PULSE} (at 1 min): give those"),
        ((WEAK, None), BALANCED_PULSE, f"got {WEAK} (at 0 min) and {BALANCED_PULSE} ("),
    ],
)
def test_recordings_of_several_pulses_are_refused_before_a_culture_is_made(
    pulses: tuple[Pulse | None, ...],
    file: Pulse | None,
    words: str,
    series: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delattr("animat.cultures.kinds.culture_named")
    (tmp_path / "mine.json").write_text(json.dumps({"pulse": (file or WEAK).to_list()}))
    given = [] if file is None else ["--protocol", str(tmp_path / "mine.json")]
    recordings = recorded_by(series, tmp_path / "recordings", *pulses)
    assert run(tmp_path / "session", policy_of(0), recordings, *given) == 1
    assert words in capsys.readouterr().err.splitlines()[-1]
    # Also where messages round both minutes to the same one.
    for minute, recording in zip((0.001, 0.002), read_recordings([recordings]), strict=True):
        write_nwb(replace(recording, start_min=minute), tmp_path / "near" / f"{minute}.nwb")
    assert run(tmp_path / "session", policy_of(0), tmp_path / "near", *given) == 1
    assert words.split(" (at")[0] in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "session").exists()


def test_a_pulse_that_the_culture_may_not_be_given_is_refused_before_it_is_opened(
    series: Path, tmp_path: Path, small_ones: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def opened(*_: Any) -> None:
        raise AssertionError("opened")

    monkeypatch.setattr(VirtualCulture, "_open", opened)
    strong = Pulse((Phase(200, amplitude_mv=-2000), Phase(200, amplitude_mv=2000)))
    recordings = recorded_by(series, tmp_path / "recordings", strong, strong)
    assert run(tmp_path / "session", policy_of(0), recordings) == 1
    assert "amplitude: expected -400 to 400 mV, got -2000" in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "session").exists()


@pytest.mark.oracle
@pytest.mark.parametrize(
    "frequencies_hz",
    [
        (5.0, 80.0),
        (80.0, 5.0),
        (80.0, 40.0, 20.0, 10.0, 5.0),
    ],
)
def test_policies_on_some_of_the_frequencies_are_calibrated_by_those(
    frequencies_hz: tuple[float, ...],
    series: Path,
    tmp_path: Path,
    small_ones: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = []

    class Noted(Calibration):
        @classmethod
        def of_series(cls, *given: Any, **more: Any) -> Any:
            taken.append(Calibration.of_series(*given, **more))
            return taken[-1]

    monkeypatch.setattr("animat.reality_gap.Calibration", Noted)
    policy = policy_of(0, frequencies_hz)
    assert run(tmp_path / "session", policy, series, "--at-min", "1") == 0
    recording = read_recording(series / "recording_0001_min.nwb")
    (calibration,) = taken
    assert calibration.conditions == policy.conditions
    # As animat train --conditions has it, whose percentiles are those of the responses to these frequencies.
    (trained_on,) = extract_series([recording], f"frequency:{','.join(map(str, frequencies_hz))}")
    np.testing.assert_allclose(calibration.percentiles, pooled_percentiles(trained_on), rtol=1e-6)
    for own, read in enumerate(calibration.responses_hz):
        np.testing.assert_array_equal(read, trained_on.rates_of(own))
    ticks = read_session(tmp_path / "session").ticks
    assert {tick.frequency_hz for tick in ticks} <= set(frequencies_hz)


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("trained", "asked", "kind", "numbers"),
    [
        ({}, (), MemorySimulator, None),
        ({"kind": "histogram"}, (), HistogramSimulator, 21),
        ({"kind": "histogram", "bins": 10, "range_hz": 60.0}, (), HistogramSimulator, 11),
        ({"kind": "histogram", "bins": 10, "range_hz": 60.0}, ("--bins", "5"), HistogramSimulator, 6),
        ({"kind": "empirical", "bins": None, "range_hz": None}, (), EmpiricalSimulator, None),
        ({"kind": "memory", "bins": None, "range_hz": None}, (), MemorySimulator, None),
        ({"kind": "memory"}, ("--simulator", "histogram"), HistogramSimulator, 21),
        ({"kind": "histogram", "bins": 20}, ("--simulator", "memory"), MemorySimulator, None),
    ],
)
def test_the_simulator_that_predicts_is_made_as_the_policies_unless_asked_otherwise(
    trained: dict[str, Any],
    asked: tuple[str, ...],
    kind: type[NeuronSimulator],
    numbers: int | None,
    series: Path,
    tmp_path: Path,
    small_ones: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Taken(Exception):
        pass

    def take(policies: Any, culture: Any, calibration: Calibration, *_: Any, **__: Any) -> None:
        assert type(calibration.simulator) is kind
        assert all(type(each) is kind for each in calibration.bootstraps)
        if numbers is not None:
            assert calibration.simulator.edges_hz.shape == (numbers,)  # type: ignore[attr-defined]
        raise Taken

    monkeypatch.setattr("animat.reality_gap.run_policies", take)
    policy = replace(policy_of(0), provenance={"simulators": trained})
    with pytest.raises(Taken):
        run(tmp_path / "session", policy, series, *asked)


def over(recordings: Path, by: str) -> Policy:
    """A policy over what recordings have, as training leaves it."""
    conditions = conditions_named(by).assign(read_recording(recordings / "recording_0000_min.nwb").stimuli).conditions
    rng, policy = np.random.default_rng(1), policy_of(0)
    return replace(
        policy,
        weights=(*policy.weights[:-1], rng.standard_normal((16, len(conditions))).astype(np.float32)),
        biases=(*policy.biases[:-1], np.zeros(len(conditions), np.float32)),
        conditions=conditions,
        provenance={"simulators": {"kind": "memory", "by": by}},
    )


@pytest.mark.parametrize(
    "by",
    [
        "pattern:1,6,4",
        *(
            pytest.param(by, marks=pytest.mark.oracle)
            for by in ("frequency:20,80 x pattern:0,5", "interval:10,40", "all")
        ),
        pytest.param("electrode", marks=pytest.mark.oracle),
    ],
)
def test_whatever_was_recorded_is_run(by: str, series: Path, tmp_path: Path, small_ones: None) -> None:
    policy = over(series, by)
    policy.save(tmp_path / "p0.safetensors")
    assert Policy.load(tmp_path / "p0.safetensors").conditions == policy.conditions
    assert run(tmp_path / "session", policy, series, "--at-min", "1") == 0
    session = read_session(tmp_path / "session")
    stimuli = session.recording().stimuli
    # What was delivered is sorted, by the rule that the policy was trained by, into what was chosen to be delivered.
    condition = conditions_named(by).assign(stimuli).condition[stimuli.is_last_of_presentation]
    if by == "electrode":
        sets = [c.electrodes[0] for c in policy.conditions if c.electrodes]
        condition = ByElectrode(tuple(sets)).assign(stimuli).condition[stimuli.is_last_of_presentation]
    assert condition.tolist() == [tick.delivered for tick in session.ticks if tick.patterns]
    recorded = read_recording(series / "recording_0001_min.nwb").stimuli
    assert set(stimuli.frequency_hz.tolist()) <= set(recorded.frequency_hz.tolist())
    assert set(stimuli.pattern.tolist()) <= set(recorded.pattern.tolist())


@pytest.mark.oracle
def test_policies_of_before_are_run_as_their_recordings_tell(series: Path, tmp_path: Path, small_ones: None) -> None:
    """Files of 0.1.0 have the name of a pattern, and not its electrodes."""
    policy = over(series, "pattern:1,6,4")
    before = tuple(Condition(each.label, each.value, each.unit) for each in policy.conditions)
    assert run(tmp_path / "session", replace(policy, conditions=before), series, "--at-min", "1") == 0
    patterns = [tick.patterns[-1] for tick in read_session(tmp_path / "session").ticks if tick.patterns]
    assert set(patterns) == {1, 6, 4}


@pytest.mark.parametrize("lacks", ["electrodes", "frequency_hz"])
def test_what_recordings_do_not_tell_is_refused_before_a_culture_is_opened(
    lacks: str, series: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = read_recording(series / "recording_0001_min.nwb")
    column = getattr(recording.stimuli, lacks)
    unknown = np.full_like(column, -1) if lacks == "electrodes" else np.full_like(column, np.nan)
    (tmp_path / "from elsewhere").mkdir()
    there = replace(recording, stimuli=replace(recording.stimuli, **{lacks: unknown}))
    write_nwb(there, tmp_path / "from elsewhere" / "recording_0000_min.nwb")
    monkeypatch.delattr("animat.cultures.kinds.culture_named")
    policy = over(tmp_path / "from elsewhere", "pattern")
    assert run(tmp_path / "session", policy, tmp_path / "from elsewhere") == 1
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "condition pattern 0" in line]
    assert f"expected recordings that state the {lacks.removesuffix('_hz')} of its pulses" in said
    assert not (tmp_path / "session").exists()


def test_patterns_on_other_electrodes_are_refused(
    series: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = over(series, "pattern:1,6")
    one, other = policy.conditions
    swapped = (replace(one, electrodes=other.electrodes), replace(other, electrodes=one.electrodes))
    assert run(tmp_path / "session", replace(policy, conditions=swapped), series) == 1
    assert "conditions: expected pattern 1, its last pulse alone, at 5, 10, 20, 40, 80 Hz on" in capsys.readouterr().err


def test_recordings_that_lack_a_frequency_are_refused_with_what_they_have(
    series: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path / "session", policy_of(0, (5.0, 30.0)), series) == 1
    said = capsys.readouterr().err
    assert (
        "conditions: expected 5 Hz, 30 Hz, from which the policies choose, got recordings with 5 Hz, 10 Hz, 20" in said
    )
    assert not (tmp_path / "session").exists()


def test_no_policy_of_several_is_named_like_all_together() -> None:
    policy = policy_of(1)
    with pytest.raises(InvalidArgument, match=r"^policies: expected none called 'policies', .*: rename its file"):
        check_policies({"policies": policy, "p1": policy})
