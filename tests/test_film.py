"""Films of sessions and of policies: they show what is in the log, in real time."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont

from animat.cli import main
from animat.closed_loop.agents import Agent, AnyCondition, OneCondition
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.closed_loop.session import LOG_FILE, read_session
from animat.coding.mapping import Thresholds
from animat.errors import InvalidArgument
from animat.neurons.timeline import fit_timeline
from animat.recordings.reading import read_sources
from animat.report.film.frame import HEIGHT_PX, WIDTH_PX, Frames
from animat.report.film.scene import Moment, Scene
from animat.report.film.session import scene_of_session
from animat.report.film.simulated import scene_of_policies
from animat.report.film.writing import FRAMES_PER_S
from animat.responses.condition import Condition
from animat.responses.extraction import extract_series
from animat.robots import Navigation
from animat.training.policy import Policy, load_policies
from fake_culture import CHANNELS, FakeCulture
from synthetic_recordings import write_synthetic_series

HZ = (5.0, 10.0, 20.0, 40.0, 80.0)
AGENTS = [Agent("random", "any", AnyCondition(5)), Agent("silent", "", OneCondition(0), "silent")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of four episodes of six iterations, some 8 s."""
    loop = Loop(
        robot=Navigation(episode_limit=6),
        mapping=Thresholds(9),
        conditions=tuple(Condition(f"{f:g} Hz", f, "Hz") for f in HZ),
        percentiles=np.linspace(0.0, 125.0, 11),
        pause_s=0.1,
        warm_up=1,
    )
    path = tmp_path_factory.mktemp("a session")
    with FakeCulture(1) as culture:
        assert run_session(culture, loop, AGENTS, path, episodes=2, seed=1).ending.by == "plan"
    return path


def film(*arguments: Any) -> int:
    return main(["replay", *map(str, arguments)])


def test_the_scene_of_a_session_is_its_log(folder: Path) -> None:
    session, scene = read_session(folder), scene_of_session(folder)
    moved = [moment for moment in scene.moments if moment.command is not None]
    ticks = [tick for tick in session.ticks if tick.command is not None]
    assert [m.observation for m in moved] == [t.observation for t in ticks]
    assert [m.command for m in moved] == [t.command for t in ticks]
    np.testing.assert_allclose([m.time_s for m in moved], [t.read_after_s + 0.01 for t in ticks])
    last = {m.episode: m.total for m in scene.moments}
    assert last == pytest.approx({e.number: e.total for e in session.episodes})
    starts = [m.observation for m in scene.moments if m.turn == 0 and m.iteration == -1]
    assert set(starts) == {session.episodes[0].start}
    recording = session.recording()
    np.testing.assert_array_equal(scene.spike_times_s, recording.spike_times_s)
    np.testing.assert_array_equal(scene.pulse_times_s, recording.stimuli.time_s)
    assert scene.n_channels == CHANNELS


@pytest.mark.parametrize(("pause_s", "settling"), [(2.0, 5), (70.0, 0)])
def test_a_film_begins_just_before_the_robot_first_moves(tmp_path: Path, pause_s: float, settling: int) -> None:
    loop = Loop(
        robot=Navigation(episode_limit=6),
        mapping=Thresholds(9),
        conditions=(Condition("20 Hz", 20.0, "Hz"),),
        percentiles=np.linspace(0.0, 125.0, 11),
        pause_s=pause_s,
        settling=settling,
    )
    with FakeCulture(1) as culture:
        run_session(culture, loop, [Agent("constant", "", OneCondition(0))], tmp_path, episodes=1)
    moved_s = next(tick.read_after_s for tick in read_session(tmp_path).ticks if tick.iteration == 0)
    scene = scene_of_session(tmp_path)
    assert scene.start_s == pytest.approx(moved_s + 0.01 - 5) and scene.start_s > 5
    assert scene.moments[0].iteration == -1 and scene.moments[-1].iteration == 5
    assert scene_of_session(tmp_path, (0.0, 58.0 + pause_s)).start_s == 0.0
    # Also where nothing moves yet, and of a session that was killed in its settling.
    records = read_session(tmp_path).log
    first = next(number for number, record in enumerate(records) if record.fields.get("tick"))
    log = (tmp_path / LOG_FILE).read_bytes()
    (tmp_path / LOG_FILE).write_bytes(log[: records.places[first + 1]])
    for span_s in ((0.5, 1.5), (1.0, pause_s)):
        scene = scene_of_session(tmp_path, span_s)
        assert (scene.start_s, scene.stop_s) == span_s
        assert scene.moments[0].iteration == -1
        assert film(tmp_path, "--out", tmp_path / "a.gif", "--span-s", 0.5, 1) == 0


def test_a_span_equals_that_part_of_the_whole(folder: Path) -> None:
    whole = scene_of_session(folder)
    start_s, stop_s = 0.5 * whole.stop_s, 0.7 * whole.stop_s
    scene = scene_of_session(folder, (start_s, stop_s))
    assert (scene.start_s, scene.stop_s) == (start_s, stop_s)
    # As text: from Python 3.13 on no record equals another where both have NaN.
    shown, there = ([str(m) for m in of.moments if start_s <= m.time_s < stop_s] for of in (scene, whole))
    assert shown and shown == there
    # The body of the first episode can be moved again from its start.
    assert scene.moments[0].iteration == -1 and scene.moments[0].time_s <= start_s


def test_a_gif_lasts_as_long_as_its_span_and_moves(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "film.gif"
    assert film(folder, "--out", out, "--span-s", 1, 3, "--json") == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert summary == {"film": str(out), "span_s": [1.0, 3.0], "robot": "navigation", "lost_bytes": 0}
    durations_ms, pictures = [], []
    with Image.open(out) as gif:
        assert gif.size == (WIDTH_PX, HEIGHT_PX)
        for number in range(gif.n_frames):
            gif.seek(number)
            durations_ms.append(gif.info["duration"])
            pictures.append(np.array(gif.convert("RGB")))
    assert sum(durations_ms) == 2000
    left, right = np.s_[:, : WIDTH_PX // 2], np.s_[:, WIDTH_PX // 2 :]
    for side in (left, right):
        assert not np.array_equal(pictures[0][side], pictures[-1][side])


# What counts the pictures forks.
@pytest.mark.oracle
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
def test_an_mp4_has_as_many_pictures_as_it_should(folder: Path, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    out = tmp_path / "film.mp4"
    assert film(folder, "--out", out, "--span-s", 1, 2) == 0
    assert ffmpeg.count_frames_and_secs(str(out)) == (FRAMES_PER_S[".mp4"], 1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_a_killed_session_is_shown_as_far_as_it_got(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = (folder / LOG_FILE).read_bytes()
    (tmp_path / LOG_FILE).write_bytes(log[: len(log) // 2])
    scene, whole = scene_of_session(tmp_path), scene_of_session(folder)
    assert 0 < len(scene.moments) < len(whole.moments)
    assert [*map(str, scene.moments)] == [*map(str, whole.moments[: len(scene.moments)])]
    assert film(tmp_path, "--out", tmp_path / "a.gif", "--span-s", 0, 0.5) == 0
    (lost,) = [int(line.split()[0]) for line in capsys.readouterr().out.splitlines() if line.endswith("are lost")]
    whole_records = len(log) // 2 - lost
    assert whole_records > 0
    (tmp_path / LOG_FILE).write_bytes(log[:whole_records])
    assert film(tmp_path, "--out", tmp_path / "a.gif", "--span-s", 0, 0.5) == 0
    assert "lost" not in capsys.readouterr().out


def scene_of(rates_hz: list[float]) -> Scene:
    """Ten responses of one policy a second, the last iteration number 9."""
    moments = tuple(
        Moment(0.1 * i, "p0", 0, i, 0, (), 0.0, float(i), "5 Hz", rate_hz) for i, rate_hz in enumerate(rates_hz)
    )
    return Scene("navigation", Navigation(), ("5 Hz",), moments, 0.0, 1.0)


def written_by(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    texts: list[str] = []
    write = ImageDraw.ImageDraw.text

    def kept(draw: ImageDraw.ImageDraw, at: Any, text: str, *more: Any, **named: Any) -> None:
        texts.append(text)
        write(draw, at, text, *more, **named)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", kept)
    Frames(scene, lambda _: None).at(1.0)
    monkeypatch.undo()
    return texts


def test_a_film_says_which_responses_are_above_its_axis_and_counts_as_ticks_do(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = scene_of([5.0] * 40)
    texts = written_by(usual, monkeypatch)
    assert "response (Hz per channel)" in texts
    assert "p0, episode 0, iteration 10 (counted from 0)" in texts
    beyond = scene_of([5.0] * 5 + [90.0] + [5.0] * 40)
    assert "response (Hz per channel; triangles: larger)" in written_by(beyond, monkeypatch)
    triangles: list[Any] = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "polygon", lambda _, corners, __: triangles.append(corners))
    for scene in (usual, beyond):
        Frames(scene, lambda _: None).at(1.0)
    assert len(triangles) == 1


def test_before_its_first_moment_a_film_draws_nothing_of_it() -> None:
    later = scene_of([5.0] * 10)
    moments = tuple(replace(moment, time_s=moment.time_s + 2.0) for moment in later.moments)
    empty, frame = (
        np.asarray(Frames(replace(later, moments=shown), lambda _: None).at(1.0))
        for shown in ((replace(later.moments[0], time_s=9.0),), moments)
    )
    # Right of the panels, up to the edge of the picture.
    assert np.unique(frame[30:400, -12:].reshape(-1, 3), axis=0).tolist() == [[250, 250, 248]]
    np.testing.assert_array_equal(frame[200:, 480:-16][:60], empty[200:, 480:-16][:60])


def test_long_names_do_not_reach_into_the_panels() -> None:
    usual = scene_of([5.0] * 40)
    labels = [f"electrodes {'+'.join(map(str, range(n, n + 30)))}" for n in (1, 2)]
    delivered = [replace(moment, delivered=labels[0]) for moment in usual.moments]
    long = replace(usual, title=20 * "a robot of my own ", conditions=tuple(labels), moments=tuple(delivered))
    silent = replace(long, moments=tuple(replace(moment, delivered="") for moment in delivered))
    scenes = (long, replace(long, title="a robot"), silent)
    shown, short, without = (np.asarray(Frames(scene, lambda _: None).at(1.0)) for scene in scenes)
    np.testing.assert_array_equal(shown[:, 470:], short[:, 470:])
    assert (shown[:30, :440] != short[:30, :440]).any()
    np.testing.assert_array_equal(shown[-20:, 470:], without[-20:, 470:])
    assert (shown[-20:, :440] != without[-20:, :440]).any()


def test_the_room_for_a_long_name_is_found_in_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dropping character after character, a frame with a set of 400 electrodes took eleven seconds."""
    measured: list[str] = []
    length = ImageFont.FreeTypeFont.getlength

    def measure(font: ImageFont.FreeTypeFont, text: str) -> float:
        measured.append(text)
        return length(font, text)

    monkeypatch.setattr(ImageFont.FreeTypeFont, "getlength", measure)
    usual = scene_of([5.0] * 40)
    labels = tuple(f"electrodes {'+'.join(map(str, range(n, n + 2000, 5)))}" for n in (1, 2))
    delivered = tuple(replace(moment, delivered=labels[0]) for moment in usual.moments)
    Frames(replace(usual, conditions=labels, moments=delivered), lambda _: None).at(1.0)
    *_, kept = (text for text in measured if text.endswith("…"))
    assert len(measured) < 30 and 40 < len(kept) < 120


def test_a_film_without_neurons_has_no_panel_of_responses(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = written_by(scene_of([math.nan] * 10), monkeypatch)
    assert [text for text in texts if text.startswith(("response", "command", "return"))] == [
        "command",
        "return so far",
    ]


def test_what_cannot_be_filmed_is_an_error_in_one_line_and_leaves_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (none := tmp_path / "none").mkdir()
    (begun := tmp_path / "begun").mkdir()
    log = read_session(folder).log
    (begun / LOG_FILE).write_bytes((folder / LOG_FILE).read_bytes()[: log.places[0]])
    out = tmp_path / "film.gif"
    for said, *arguments in (
        ("expected a session (session.log) or policies", none, "--out", out),
        ("got no such file", tmp_path / "nowhere", "--out", out),
        ("expected at least one episode, got none", begun, "--out", out),
        ("expected a film's name to end in .mp4 or .gif, got '.avi'", folder, "--out", tmp_path / "film.avi"),
        (
            f"{LOG_FILE}: expected a folder, got a file; choose another --out",
            folder,
            "--out",
            folder / LOG_FILE / "film.gif",
        ),
        ("begins within the session's", folder, "--out", out, "--span-s", 1000, 1001),
        ("expected a start from 0 s and a later end", folder, "--out", out, "--span-s", 2, 1),
        ("--recordings: expected none with a session", folder, "--out", out, "--recordings", folder),
        ("--at-min: expected none with a session", folder, "--out", out, "--at-min", 0),
        ("--simulator: expected none with a session", folder, "--out", out, "--simulator", "histogram"),
        ("--window-ms: expected none with a session", folder, "--out", out, "--window-ms", 2, 9),
        ("--seed: expected none with a session", folder, "--out", out, "--seed", 2),
        ("expected a session of cartpole, got one of navigation", folder, "--out", out, "--robot", "cartpole"),
    ):
        assert film(*arguments) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
    assert {path.name for path in tmp_path.iterdir()} == {"none", "begun"}


@pytest.mark.oracle
def test_policies_on_the_simulator_move_as_their_robot_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_synthetic_series(1, tmp_path / "recordings", sessions=1, patterns=30, channels=32)
    untrained(Navigation(episode_limit=8)).save(tmp_path / "p0.safetensors")
    timeline = fit_timeline(extract_series(read_sources([tmp_path / "recordings"])))
    policies = load_policies(tmp_path / "p0.safetensors")
    scene = scene_of_policies(policies, timeline, seed=3)
    assert scene.moments == scene_of_policies(policies, timeline, seed=3).moments
    start, *moved = scene.moments
    assert len(moved) == 8 and start.time_s == 0.0
    for before, after in zip(scene.moments, moved, strict=False):
        assert after.time_s - before.time_s == pytest.approx(1 / float(after.delivered.split()[0]))
        assert -1 <= after.command <= 1
    # Navigation drives on at one speed: the same way in each iteration.
    places = np.array([moment.observation[:2] for moment in scene.moments])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert (steps > 0).all()
    out = tmp_path / "film.gif"
    assert film(tmp_path / "p0.safetensors", "--recordings", tmp_path / "recordings", "--out", out) == 0
    assert "navigation on the simulator" in capsys.readouterr().out
    for seed in (-1, 2**32):
        with pytest.raises(InvalidArgument, match="seed: expected a whole number from 0 to 4294967295"):
            scene_of_policies(policies, timeline, seed=seed)
    with Image.open(out) as gif:
        assert gif.n_frames > 1


def untrained(robot: Navigation) -> Policy:
    """One of zeros, but for a preference among conditions."""
    shapes = [(len(robot.observation_spec), 4), (4, 4), (4, 5)]
    return Policy(
        weights=tuple(np.zeros(shape, np.float32) for shape in shapes),
        biases=(np.zeros(4, np.float32), np.zeros(4, np.float32), np.arange(5, dtype=np.float32)),
        scales=np.ones(len(robot.observation_spec), np.float32),
        robot=robot,
        mapping=Thresholds(9),
        conditions=tuple(Condition(f"{f:g} Hz", f, "Hz") for f in HZ),
    )
