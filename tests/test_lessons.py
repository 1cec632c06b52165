"""Lessons and assessments: what is drawn, how it moves, when a policy goes on, and that a kill changes nothing."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from animat.cli import main
from animat.environment import Animat, WithoutNeurons
from animat.errors import AnimatError, InvalidArgument
from animat.goals.robot import with_goal
from animat.neurons.timeline import SimulatorTimeline
from animat.robots import ROBOTS, Cartpole, SwingUp, robot_named
from animat.robots.base import Quantity, Robot
from animat.training.course import Course, assess, programs_with_ranges, rows_of
from animat.training.folder import describe_training, expect_trainable
from animat.training.group import Group
from animat.training.lessons import Lesson, check_lessons, read_lessons
from animat.training.networks import Layer
from animat.training.policy import Policy, load_policies
from animat.training.specification import CHUNKS, Training
from animat.training.varied import Ranges, Varied, expect_varied, ranges_of, varying_in
from test_training import SHORT, SMALL, Kept, bits, timeline_of, train_group, trained

LONG_POLES = Lesson(parameters={"pole_length_m": (0.3, 0.6), "force_n": (0.5, 1.5)}, starts={"angle_rad": (-0.1, 0.05)})
TAUGHT = replace(
    SHORT,
    lessons=(replace(LONG_POLES, until_return=-89.0), Lesson(starts={"position_m": (0.0, 0.1)}, until_return=-80.0)),
)
"""Two lessons and the task itself, soon passed."""


def varied(lesson: Lesson, robot: Robot[Any], rows: tuple[int, int] = (0, 0), **more: Any) -> Varied[Any]:
    varying = varying_in([lesson], recordings=rows != (0, 0))
    environment = more.get("environment") or WithoutNeurons(robot, None)
    return Varied(environment, varying, ranges_of(lesson, varying, robot, rows))


@pytest.mark.oracle
def test_episodes_are_drawn_uniformly_from_their_ranges_each_on_its_own() -> None:
    environment = varied(LONG_POLES, Cartpole(), (2, 5))
    state = jax.vmap(environment.reset)(jax.random.split(jax.random.key(7), 4_000))
    length_m, force_n = np.asarray(state.info["parameters"]).T
    angle_rad = np.asarray(state.robot.angle_rad)
    for drawn, low, high in ((length_m, 0.3, 0.6), (force_n, 0.5, 1.5), (angle_rad, -0.1, 0.05)):
        assert stats.kstest(drawn, "uniform", (low, high - low)).pvalue > 0.01
        assert low <= drawn.min() <= drawn.max() <= np.float32(high)
    rows, counts = np.unique(np.asarray(state.info["recording"]), return_counts=True)
    assert rows.tolist() == [2, 3, 4, 5]
    assert stats.chisquare(counts).pvalue > 0.01
    assert np.abs(np.corrcoef([length_m, force_n, angle_rad, state.info["recording"]]) - np.eye(4)).max() < 0.06
    np.testing.assert_array_equal(state.robot.position_m, 0.0)


VARYING = [
    (name, field.name)
    for name, kind in ROBOTS.items()
    if name in ("cartpole", "navigation", "swing-up", "arm", "wheels")
    for field in dataclasses.fields(kind)
    if isinstance(field.default, float)
]
BY_SHAPE = {
    ("arm", "upper_length_m"),
    ("arm", "lower_length_m"),
    ("wheels", "body_radius_m"),
    ("wheels", "start_x_m"),
    ("wheels", "start_y_m"),
    ("wheels", "goal_radius_m"),
}
"""Parameters that more than arithmetic depends on."""


# By default all of two robots, and of the others what is refused.
@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        pytest.param(
            *each, marks=() if each[0] in ("cartpole", "navigation") or each in BY_SHAPE else pytest.mark.oracle
        )
        for each in VARYING
    ],
)
def test_an_episode_moves_as_the_robot_with_the_parameter_that_was_drawn(name: str, parameter: str) -> None:
    usual = robot_named(name)
    value = float(np.float32(getattr(usual, parameter) * 0.9))
    lesson = Lesson(parameters={parameter: (value, value)})
    if (name, parameter) in BY_SHAPE:
        with pytest.raises(InvalidArgument, match=rf"parameters\.{parameter}: .* must be known at compile time"):
            expect_varied(usual, varying_in([lesson], recordings=False))
        return
    plain, drawn = WithoutNeurons(replace(usual, **{parameter: value}), None), varied(lesson, usual)
    expect_varied(usual, drawn.varying)

    def episode(environment: Any) -> Any:
        state, steps = environment.reset(jax.random.key(3)), []
        for key in jax.random.split(jax.random.key(4), 6):
            uniforms = jax.random.uniform(key, (environment.noise_size + usual.n_commands,))
            command = jnp.squeeze(2 * uniforms[: usual.n_commands] - 1)
            state = environment.advance(uniforms[usual.n_commands :], state, command, None)
            steps.append((state.robot, state.reward, state.ended, environment.observe(state)))
        return steps

    for moved, wanted in zip(jax.tree.leaves(episode(drawn)), jax.tree.leaves(episode(plain)), strict=True):
        np.testing.assert_allclose(moved, wanted, rtol=2e-5, atol=2e-6)


@pytest.mark.oracle
def test_an_episode_is_answered_by_the_simulator_that_it_drew_with_its_percentiles() -> None:
    timeline = timeline_of(kind="memory")
    plain = Animat(Cartpole(), SHORT.mapping, 3)  # type: ignore[arg-type]
    environment = varied(Lesson(), Cartpole(), (0, 2), environment=plain)
    for key in jax.random.split(jax.random.key(0), 8):
        state = environment.reset(key)
        row = int(state.info["recording"])
        one = jax.tree.map(lambda stacked, row=row: stacked[row], timeline.simulators)
        after = environment.step(key, state, jnp.int32(1), timeline.simulators)
        wanted = plain.step(key, state, jnp.int32(1), one)
        for name in ("rate_hz", "command", "delivered"):
            np.testing.assert_allclose(after.info[name], wanted.info[name], rtol=1e-6)
        assert int(after.info["recording"]) == row


class CounterState(NamedTuple):
    at: Any
    goal: Any


@dataclass(frozen=True)
class Counter(Robot[CounterState]):
    """Goes on by `stride` an iteration; succeeds where it ends, after at most ten, beyond its goal."""

    stride: float = 1.0
    episode_limit: int = 10
    name: ClassVar[str] = "counter"

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("at", "1", 10.0),)

    def reset(self, key: Any) -> CounterState:
        return CounterState(jnp.float32(0.0), jnp.float32(5.0))

    def advance(self, uniforms: Any, state: CounterState, u: Any) -> Any:
        at = state.at + self.stride
        return state._replace(at=at), jnp.float32(1.0), at > 12.0

    def observe(self, state: CounterState) -> Any:
        return state.at[None]

    def succeeded(self, state: CounterState) -> Any:
        return state.at > state.goal


@pytest.mark.oracle
def test_an_assessment_counts_successes_at_the_end_of_each_episode() -> None:
    """Beyond 12 an episode ends, else after ten strides; its goal is drawn, and decides over success."""
    network = (Layer(jnp.zeros((1, 2)), jnp.zeros((1, 2))),)
    for stride, length in ((1.0, 10), (2.0, 7), (0.3, 10)):
        environment = varied(Lesson(starts={"goal": (0.0, 20.0)}), Counter(stride=stride))
        key = jax.random.key(5)
        returns, succeeded = assess(environment, 200, network, None, key)
        starts = jax.vmap(environment.reset)(jax.random.split(jax.random.split(key)[0], 200))
        np.testing.assert_array_equal(returns, length)
        np.testing.assert_array_equal(succeeded, stride * length > np.asarray(starts.robot.goal))
        assert 0 < int(succeeded.sum()) < 200
    again, _ = assess(environment, 200, network, None, key)
    np.testing.assert_array_equal(again, returns)


def course_of(
    *successes_and_returns: list[tuple[float, float]],
    lessons: tuple[Lesson, ...],
    robot: Any,
    timeline: SimulatorTimeline | None = None,
    n_chunks: int | None = None,
) -> Any:
    """A course through assessments that are made by hand, of two policies; and where they stood after each chunk."""
    mapping = None if timeline is None else SHORT.mapping
    training = Training(
        robot, mapping, lessons=lessons, iterations=6_000, algorithm=SMALL, assess=10, duration_min=60.0
    )
    course = Course(training, training.environment(3), timeline, 2)
    made = iter(successes_and_returns)
    networks = jnp.arange(2.0)[:, None]

    def assessment(*_: Any) -> Any:
        rows = next(made)
        succeeded = [np.arange(10) < round(10 * share) for share, _ in rows]
        return np.array([[mean] * 10 for _, mean in rows]), np.array(succeeded)

    course._programs = (*course._programs[:2], assessment)
    course.state = course.state._replace(best=np.zeros((2, 1)))
    lessons_at = []
    for index in range(n_chunks or len(successes_and_returns)):
        course.assess(index, networks + 100 * index, None)
        lessons_at.append(course.state.lesson.tolist())
    assert next(made, None) is None
    return course.state, lessons_at


def test_a_policy_goes_on_at_its_share_each_for_itself_and_the_best_is_that_of_the_table() -> None:
    lessons = (Lesson(success=0.8), Lesson(starts={"goal": (0.0, 9.0)}, until_return=5.0))
    standing, at = course_of(
        [(0.7, 9.0), (0.8, 1.0)],
        [(0.9, 1.0), (1.0, 4.9)],
        [(0.0, 5.0), (0.2, 5.0)],
        [(0.5, 1.0), (0.3, 7.0)],
        [(0.5, 2.0), (0.3, 7.0)],
        [(0.4, 9.0), (0.1, 9.0)],
        lessons=lessons,
        robot=Counter(),
    )
    assert at == [[0, 1], [1, 1], [2, 2], [2, 2], [2, 2], [2, 2]]
    table = standing.table[:6]
    assert np.isnan(standing.table[6:]).all()
    np.testing.assert_array_equal(
        table[:, 0, 2:], [[1, 0.7, 9], [1, 0.9, 1], [2, 0, 5], [3, 0.5, 1], [3, 0.5, 2], [3, 0.4, 9]]
    )
    # Of the last lesson the most successes, then the largest return; of equals the last.
    np.testing.assert_array_equal(standing.best, [[400.0], [401.0]])
    assert standing.best_at.tolist() == [4, 4]
    for policy in (0, 1):
        keys = [(*np.nan_to_num(row[2:]), at) for at, row in enumerate(table[:, policy])]
        assert max(keys)[-1] == 4


def test_with_another_simulator_the_best_so_far_is_assessed_anew() -> None:
    """Three recordings of 20 chunks each: the best is asked again at chunks 20 and 40, before the one that is new."""
    by_chunk = [[(0.0, 9.0)] * 2] + [[(0.0, 5.0)] * 2] * 19
    by_chunk += [[(0.0, 3.0), (0.0, 6.0)], [(0.0, 4.0), (0.0, 4.0)]] + [[(0.0, 2.0), (0.0, 5.0)]] * 19
    by_chunk += [[(0.0, 7.0)] * 2, [(0.0, 7.5), (0.0, 6.5)]]
    standing, _ = course_of(
        *by_chunk, lessons=(), robot=Cartpole(), timeline=timeline_of((0.0, 20.0, 40.0)), n_chunks=41
    )
    assert standing.best_at.tolist() == [40, 0]
    np.testing.assert_array_equal(standing.best, [[4000.0], [1.0]])
    np.testing.assert_array_equal(standing.score[:, 1], [7.5, 7.0])
    assert standing.table[[0, 20, 39, 40], 0, 4].tolist() == [9.0, 4.0, 2.0, 7.5]


def test_the_page_s_lessons_are_some(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "lessons.md").read_text()
    file = tmp_path / "lessons.toml"
    file.write_text(page.partition("```toml\n")[2].partition("```")[0])
    lessons = read_lessons(file)
    assert len(lessons) == 2
    expect_trainable(Training("swing-up", None, commands=(-1.0, 1.0), lessons=lessons), is_saved=True)


def test_a_robot_without_success_moves_on_by_its_return() -> None:
    standing, at = course_of(
        [(0.0, -5.0), (0.0, 0.0)], [(0.0, 1.0), (0.0, 3.0)], lessons=(Lesson(until_return=0.0),), robot=Cartpole()
    )
    assert at == [[0, 1], [1, 1]]
    assert np.isnan(standing.table[:2, :, 3]).all()


@pytest.mark.oracle
def test_the_best_policies_are_kept_next_to_the_averaged_ones_with_their_lessons(tmp_path: Path) -> None:
    policies = trained(TAUGHT, timeline_of(), tmp_path)
    best = load_policies(tmp_path / "best")
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "assessments.csv", "best", "p0.safetensors", "p1.safetensors", "training.json",
    ]  # fmt: skip
    lines = [line.split(",") for line in (tmp_path / "assessments.csv").read_text().splitlines()]
    assert lines[0] == ["policy", "iterations", "minute", "lesson", "success", "mean_return", "best"]
    assert len(lines) == 1 + 2 * CHUNKS
    for name, policy in policies.items():
        assert policy.provenance["training"]["lessons"][1]["starts"] == {"position_m": [0.0, 0.1]}
        table = policy.assessments
        assert table.shape == (CHUNKS, 5)
        np.testing.assert_array_equal(table[:, 0], policy.learning_curve[:, 0])
        assert np.all(np.diff(table[:, 2]) >= 0)
        assert table[-1, 2] > 1
        row = len(best[name].assessments) - 1
        assert [line[-1] for line in lines if line[0] == name].index("1") == row
        assert len(best[name].learning_curve) == row + 1
        # The best of all that were assessed with the simulator of its own ten minutes.
        alike = [i for i in range(CHUNKS) if min(i // 10, 2) == min(row // 10, 2)]
        assert row == max(alike, key=lambda row, table=table: (table[row, 2], table[row, 4], row))
        again = policy.best
        assert again is not None
        np.testing.assert_array_equal(again.weights[0], best[name].weights[0])
        # The averaged one is the last.
        is_last = np.array_equal(best[name].weights[0], policy.weights[0])
        assert is_last == (row == CHUNKS - 1)
    progress = Kept()
    assert list(trained(TAUGHT, timeline_of(), tmp_path, progress=progress)) == ["p0", "p1"]
    assert not progress.updates


class Stop(Exception):
    pass


class Stopping:
    """A progress that stops a training after some chunks."""

    def __init__(self, chunks: int) -> None:
        self.left, self.notes = chunks, []

    def update(self, done: float, total: float, note: str = "") -> None:
        self.left -= 1
        self.notes.append(note)
        if not self.left:
            raise Stop


@pytest.mark.oracle
def test_a_course_that_is_stopped_goes_on_to_the_same_bits_and_compiles_nothing_for_another_lesson(
    tmp_path: Path,
) -> None:
    drawn = replace(TAUGHT, shadowing="drawn", robot=Cartpole(step_s=0.021), assess=5)
    group, checkpoint = Group(drawn, (0, 1), timeline_of(), "any", {}), tmp_path / "c.npz"
    undisturbed = Stopping(10**9)
    wanted = train_group(group, None, undisturbed)
    assert undisturbed.notes[0].endswith(" of 3")
    assert max(policy.assessments[-1, 2] for policy in wanted) == 3
    for chunks in (7, 20):
        with pytest.raises(Stop):
            train_group(group, checkpoint, Stopping(chunks), checkpoint_s=0.0)
    for policy, again in zip(wanted, train_group(group, checkpoint, Stopping(10**9)), strict=True):
        assert policy.best is not None
        assert again.best is not None
        np.testing.assert_array_equal(again.assessments, policy.assessments)
        for one, other in zip(
            (*policy.weights, *policy.best.weights), (*again.weights, *again.best.weights), strict=True
        ):
            np.testing.assert_array_equal(one, other)
    varying = varying_in(drawn.lessons, recordings=True)
    made = programs_with_ranges(drawn.environment(3), varying, drawn.algorithm, 5)
    assert [program._cache_size() for program in made] == [1, 1, 1]  # type: ignore[attr-defined]


KILLED = """
import sys
from pathlib import Path
from animat.execution.training import train
from test_lessons import TAUGHT, timeline_of
train(TAUGHT, timeline_of(), Path(sys.argv[1]), checkpoint_s=0.0, workers=1)
"""


@pytest.mark.oracle
def test_assessments_alone_change_nothing_of_what_is_learned(tmp_path: Path) -> None:
    plain, assessed = (
        trained(each, timeline_of(), tmp_path / str(each.assess)) for each in (SHORT, replace(SHORT, assess=3))
    )
    for name, policy in plain.items():
        for one, other in zip(policy.weights, assessed[name].weights, strict=True):
            np.testing.assert_array_equal(one, other)
        assert policy.best is None
        assert not len(policy.assessments)
        assert Policy.load(tmp_path / "3" / f"{name}.safetensors").assessments.shape == (CHUNKS, 5)
    assert not (tmp_path / "None" / "best").exists()


def test_trainings_with_other_lessons_or_assessments_have_other_fingerprints() -> None:
    plain = describe_training(SHORT, timeline_of())
    others = [replace(SHORT, assess=4), TAUGHT, replace(SHORT, shadowing="drawn")]
    assert (
        len({plain["fingerprint"], *(describe_training(other, timeline_of())["fingerprint"] for other in others)}) == 4
    )


def test_recordings_are_drawn_of_those_that_shadowing_would_have_used(tmp_path: Path) -> None:
    timeline: SimulatorTimeline = timeline_of((0.0, 10.0, 20.0, 30.0))
    half = replace(SHORT, shadowing="drawn", duration_min=20.0)
    assert rows_of(half, timeline) == [(0, 1)]
    assert rows_of(replace(half, duration_min=None), timeline) == [(0, 3)]
    narrow = replace(half, duration_min=40.0, lessons=(Lesson(recordings_min=(5, 25), until_return=0.0),))
    assert rows_of(narrow, timeline) == [(1, 2), (0, 3)]
    late, out = replace(narrow, duration_min=20.0, lessons=(Lesson(recordings_min=(15, 99)),)), tmp_path / "out"
    for refusing in (lambda: rows_of(late, timeline), lambda: trained(late, timeline, out)):
        with pytest.raises(InvalidArgument, match=r"^lesson 1: recordings_min: expected .* recording \(0, 10\), got"):
            refusing()
    assert not out.exists()


@pytest.mark.parametrize(
    ("lesson", "said"),
    [
        ("parameters.pole_lenght_m = [0.3, 0.6]", "'pole_lenght_m'; did you mean pole_length_m?"),
        ("parameters.pole_length_m = [0.6, 0.3]", r"expected the low end first, got \[0.6, 0.3\]"),
        ("parameters.pole_length_m = [0, 0.3]", "cannot have pole_length_m = 0: .*expected at least 1e-09"),
        ("parameters.episode_limit = [100, 200]", "episode_limit: expected a parameter that is a real number, got one"),
        ("parameters.pole_length_m = 0.3", "pole_length_m: expected a list, got 0.3"),
        ("starts.angel_rad = [0, 1]", "'angel_rad'; did you mean angle_rad?"),
        ("starts.angle_rad = [1, 0]", "expected the low end first"),
        ("starts.angle_rad = [0, nan]", "expected a finite number"),
        ("success = 1.2", "success: expected at most 1, got 1.2"),
        ("success = 0.0", "success: expected more than 0, got 0"),
        ("success = 0.8", "got cartpole, which has no method `succeeded`; use until_return"),
        ("success = 0.8\nuntil_return = 4", "expected either success or until_return, got both"),
        ("[[lessons]]", "lesson 1: expected success or until_return, .*got neither"),
        ("recordings_min = [0, 10]", "recordings_min: expected only with shadowing 'drawn'"),
        ("until_return = 121", "until_return: expected at most 120, the highest return of cartpole, got 121"),
        ("sucess = 0.8", "sucess: no such setting"),
        ("starts.angle_rad = [", "expected TOML, got malformed text"),
    ],
)
def test_lessons_that_cannot_be_taught_are_refused_in_one_line(lesson: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "lessons.toml"
    file.write_text(f"[[lessons]]\n{lesson}\n")
    with pytest.raises(AnimatError, match=said) as refused:
        expect_trainable(replace(SHORT, lessons=read_lessons(file)), is_saved=False)
    assert "\n" not in str(refused.value)


def test_what_is_stepped_elsewhere_or_has_no_neurons_is_refused() -> None:
    host = robot_named("gymnasium:MountainCarContinuous-v0")
    with pytest.raises(InvalidArgument, match="lessons: expected a robot that is stepped by JAX, got gymnasium"):
        Training(host, "9-thresholds", lessons=(Lesson(),))
    for asked in ({"assess": 3}, {"shadowing": "drawn"}):
        with pytest.raises(InvalidArgument, match="robot: expected one stepped by JAX"):
            Training(host, "9-thresholds", **asked)  # type: ignore[arg-type]
    with pytest.raises(InvalidArgument, match="shadowing: expected a mapping with 'drawn', got none"):
        Training("cartpole", None, shadowing="drawn")
    with pytest.raises(InvalidArgument, match="assess: expected at least 1, got 0"):
        Training("cartpole", None, assess=0)


def test_a_lesson_that_does_not_name_what_another_varies_is_as_the_robot_has_it() -> None:
    easy, task = Lesson(parameters={"torque_n_m": (3.0, 4.0)}, starts={"angle_rad": (0.0, 0.1)}), Lesson()
    varying = varying_in([easy, task], recordings=False)
    ranges: Ranges = ranges_of(task, varying, SwingUp(), (0, 0))
    environment = Varied(WithoutNeurons(SwingUp(), None), varying, ranges)
    state = environment.reset(jax.random.key(0))
    assert float(state.info["parameters"][0]) == 2.0
    assert float(state.robot.angle_rad) == np.float32(np.pi)


@pytest.mark.oracle
def test_the_command_trains_by_lessons_and_reports_each_policy_s_lesson(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "lessons.toml", tmp_path / "policies"
    file.write_text("[[lessons]]\nstarts.angle_rad = [-0.3, 0.3]\nuntil_return = -1\n")
    few = ["--policies", "1", "--iterations", "2000", "--sac", "environments=8", "hidden=8", "replay=1024", "batch=16"]
    assert (
        main(["train", "swing-up", "--mapping", "none", "--lessons", str(file), *few, "--out", str(out), "--json"]) == 0
    )
    printed = capsys.readouterr().out.splitlines()
    assessed = json.loads(printed[-1])["assessed"]["p0"]
    assert assessed["lessons"][0] == {"lesson": 1, "after_iterations": 0}
    assert assessed["lessons"][1] == {"lesson": 2, "after_iterations": 32}
    assert assessed["best"]["lesson"] == 2
    assert printed[-2].startswith("p0: best after ")
    assert main(["evaluate", str(out / "best"), "--episodes", "3"]) == 0
    file.write_text('[[lessons]]\nname = "early"\nrecordings_min = [0, 10]\n')
    assert main(["train", "swing-up", "--mapping", "none", "--lessons", str(file), *few, "--out", str(out)]) == 1
    said = "lesson 1 (early): recordings_min: expected only with shadowing 'drawn' (--shadowing drawn), got it"
    assert f"{file}: {said}" in capsys.readouterr().err
    assert main(["train", "swing-up", "--mapping", "none", "--assess", "0", *few, "--out", str(out)]) == 1
    assert "assess: expected at least 1" in capsys.readouterr().err


@pytest.mark.oracle
def test_a_course_that_is_killed_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    trained(TAUGHT, timeline_of(), tmp_path / "undisturbed")
    folder, environment = tmp_path / "killed", os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    watched = subprocess.Popen([sys.executable, "-c", KILLED, str(folder)], env=environment, start_new_session=True)
    while not list(folder.glob(".unfinished/*.npz")) and watched.poll() is None:
        time.sleep(0.05)
    os.killpg(watched.pid, signal.SIGKILL)
    watched.wait()
    trained(TAUGHT, timeline_of(), folder)
    for part in (".", "best"):
        assert bits(folder / part) == bits(tmp_path / "undisturbed" / part)
    table = "assessments.csv"
    assert (folder / table).read_bytes() == (tmp_path / "undisturbed" / table).read_bytes()


@pytest.mark.oracle
def test_a_robot_with_a_goal_is_varied_as_its_body_is() -> None:
    goal = "avoid pole_angle outside -12..12 deg; drive cart_position in -0.1..0.1 m within 20"
    lesson = Lesson(parameters={"pole_length_m": (0.3, 0.5)}, starts={"position_m": (-0.4, 0.4)}, success=0.8)
    bare, aimed = (varied(lesson, robot) for robot in (Cartpole(), with_goal(Cartpole(), goal)))
    check_lessons([lesson], with_goal(Cartpole(), goal), draws_recordings=False)
    keys = jax.random.split(jax.random.key(3), 50)
    plain, with_it = (jax.vmap(each.reset)(keys) for each in (bare, aimed))
    for of_plain, of_body in zip(plain.robot, with_it.robot.robot, strict=True):
        np.testing.assert_array_equal(of_plain, of_body)
    # A start outside of what is driven to counts.
    far = np.abs(np.asarray(with_it.robot.robot.position_m)) > 0.1
    assert 0 < far.sum() < 50
    np.testing.assert_array_equal(with_it.robot.outside[0], far)
    noise = jax.random.uniform(jax.random.key(4), (50, bare.noise_size))
    action = jnp.linspace(-1.0, 1.0, 50)
    after, after_with = (
        jax.vmap(each.advance, (0, 0, 0, None))(noise, state, action, None)
        for each, state in ((bare, plain), (aimed, with_it))
    )
    for of_plain, of_body in zip(after.robot, after_with.robot.robot, strict=True):
        np.testing.assert_array_equal(of_plain, of_body)
    with pytest.raises(InvalidArgument, match="expected parameters of cartpole, got 'goal'"):
        check_lessons([Lesson(parameters={"goal": (0.0, 1.0)})], with_goal(Cartpole(), goal), draws_recordings=False)


@pytest.mark.oracle
def test_a_best_policy_that_is_lost_is_trained_again(tmp_path: Path) -> None:
    training = replace(SHORT, assess=2)
    trained(training, timeline_of(), tmp_path)
    lost = tmp_path / "best" / "p0.safetensors"
    before = lost.read_bytes()
    lost.unlink()
    again = trained(training, timeline_of(), tmp_path)
    assert lost.read_bytes() == before
    assert all(policy.best is not None for policy in again.values())
