"""The context study: its page for synthetic numbers, and a small study from a culture to the page."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from animat.closed_loop.session import read_session
from animat.cultures.series import Series
from animat.errors import InvalidArgument, Mismatch
from animat.execution.receipts import Receipt, digest_of
from animat.progress import Silent
from animat.report.results import ContextRow, LostRow
from animat.stimulation.protocol import CLOSED_LOOP, TWO_COMMANDS
from animat.studies.context import (
    ContextRun,
    ContextStudy,
    RecordCulture,
    plan_context_study,
    protocol_for,
    run_context_study,
)
from animat.studies.context_page import summarise_cultures, summarise_robot, write_context_page
from synthetic_recordings import write_synthetic_series


def row(culture: int, robot: str, **known: Any) -> ContextRow:
    """A row with nothing else known; returns are 0."""
    optional = {field.name: None for field in fields(ContextRow)}
    returns = {"random": 0.0, "policies": 80.0, "predicted_policies": 80.0}
    return ContextRow(**(optional | returns | {"culture": culture, "robot": robot} | known))


def rows() -> tuple[ContextRow, ...]:
    """One robot that needs context on one of two cultures, where policies have some, and one that needs none."""
    interval = {"score_low_95": 0.7, "score_high_95": 1.1, "gap_low_95": 0.5, "gap_high_95": 0.9}
    return (
        row(1, "shuttle", gap=0.7, score=0.9, **interval),
        row(2, "shuttle", gap=0.4, score=0.1, **(interval | {"score_low_95": -0.1})),
        row(1, "cartpole", gap=0.0),
        row(2, "cartpole", gap=0.01),
    )


def test_what_holds_is_counted_over_cultures() -> None:
    needs, cartpole = summarise_robot(rows()[:2]), summarise_robot(rows()[2:])
    assert needs == (
        "A reflex leaves half of the task or more undone on 1 of 2 cultures (context gap 0.40 to 0.70). The policies "
        "do significantly more than the best reflex on 1 of 2 cultures with a context score (0.10 to 0.90)."
    )
    assert cartpole == (
        "A reflex leaves half of the task or more undone on 0 of 2 cultures (context gap 0.00 to 0.01). No culture has "
        "a context score."
    )
    # A third of a task is more than a reflex does, but not half of the task.
    third = tuple(row(c, "arm", gap=0.33, gap_low_95=0.3, gap_high_95=0.36) for c in (1, 2))
    assert summarise_cultures({"shuttle": rows()[:1], "arm": third}).startswith(
        "A reflex leaves half of the task or more undone on every culture for shuttle. The policies do "
    )
    some = summarise_robot((*rows()[:2], replace(rows()[0], gap=None, score=None, score_low_95=None)))
    assert some == needs.replace("0.70).", "0.70); on 1 more this is not known.")


@pytest.mark.oracle
def test_the_page_has_every_number_and_shares_of_what_is_over_random(tmp_path: Path) -> None:
    study = ContextStudy(cultures=(1, 2), robots=("shuttle", "cartpole"))
    lost = tuple(LostRow(c, r, "silent", 20.0, 60.0, 50.0, 70.0) for c in (1, 2) for r in study.robots)
    page = write_context_page(study, ContextRun(tmp_path, rows(), lost, {}))
    text = page.read_text()
    assert "0.900 (0.700 to 1.10)" in text and summarise_robot(rows()[:2]) in text
    # 60 of the 80 that the policies have over random stimuli.
    assert re.search(r"silent</t[dh]>\s*<td[^>]*>0.750</td>\s*<td[^>]*>0.750</td>", text)
    for name in ("context", "whose-work"):
        assert all((tmp_path / f"{name}.{ending}").stat().st_size > 1000 for ending in ("png", "svg", "pdf"))


@pytest.mark.oracle
def test_without_an_optimal_return_values_are_marked_as_lower_bounds(tmp_path: Path) -> None:
    interval = {"score_low_95": 0.5, "score_high_95": 0.7, "gap_low_95": 0.7, "gap_high_95": 0.9}
    known = {"random": -80.0, "policies": 10.0, "best_known": 20.0, "gap": 0.8, "score": 0.6}
    of_robot = (row(1, "detour", **interval, **known), row(2, "detour", **interval, **known | {"gap": 0.75}))
    assert summarise_robot(of_robot) == (
        "A reflex leaves half of the task or more undone on 2 of 2 cultures (context gap at least 0.75 to 0.80). The "
        "policies do significantly more than the best reflex on 2 of 2 cultures with a context score (at least 0.60)."
    )
    study = ContextStudy(cultures=(1, 2), robots=("detour",))
    text = write_context_page(study, ContextRun(tmp_path, of_robot, (), {})).read_text()
    assert "≥ 20<" in text and "≥ 0.80" in text and "≥ 0.600 (0.500 to 0.700)" in text


def test_robots_with_more_commands_than_two_are_refused() -> None:
    assert ContextStudy(robots=("wheels", "detour", "arm"))
    with pytest.raises(InvalidArgument, match="robots: expected JAX robots with one or two commands, got 'gymnasium:"):
        ContextStudy(robots=("gymnasium:Pendulum-v1",))


@pytest.mark.parametrize("size", ["policies", "episodes", "episodes_measured"])
def test_sizes_are_refused_before_a_culture_is_recorded(size: str) -> None:
    with pytest.raises(InvalidArgument, match=f"{size}: expected at least 1, got 0"):
        ContextStudy(**{size: 0})


@pytest.mark.parametrize("n_commands", [1, 2])
def test_a_recording_is_over_when_the_next_one_is_due(
    n_commands: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def looked_for(*_: object) -> None:
        raise NotImplementedError("earlier recordings")

    monkeypatch.setattr("animat.cultures.series._check_recordings", looked_for)
    # Recordings that take too long are refused before earlier ones are looked for.
    with pytest.raises(NotImplementedError, match="earlier recordings"):
        RecordCulture(ContextStudy(), 1, n_commands).run(tmp_path, Silent())


@pytest.mark.parametrize("n_commands", [1, 2])
def test_a_recording_that_changed_is_recorded_again(
    n_commands: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = ContextStudy(cultures=(1,), robots=("shuttle", "detour"))
    job = next(each for each in plan_context_study(study) if each.task == RecordCulture(study, 1, n_commands))
    folder = RecordCulture(study, 1, n_commands).recordings(tmp_path, n_commands)
    changed, same = write_synthetic_series(1, folder, sessions=2, channels=32, patterns=20)
    outputs = {file.relative_to(tmp_path).as_posix(): digest_of(file) for file in (changed, same)}
    Receipt(job.name, "x", {}, outputs).save(tmp_path / "jobs")
    # It can still be read.
    shutil.copy(same, changed)
    found: list[Path] = []

    def record_again(*_: object, **__: object) -> Series:
        found.extend(folder.iterdir())
        return Series([], [])

    monkeypatch.setattr("animat.studies.context.record_series", record_again)
    RecordCulture(study, 1, n_commands).run(tmp_path, Silent())
    assert found == [same]


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(Mismatch, match="expected an empty folder or one of this study, got one with other files"):
        run_context_study(ContextStudy(), tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.oracle
@pytest.mark.usefixtures("in_this_process", "few_bootstraps")
def test_a_small_study_from_a_culture_to_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.stimulation.protocol.CLOSED_LOOP", replace(CLOSED_LOOP, trials=40))
    study = ContextStudy(
        cultures=(1,),
        robots=("shuttle",),
        policies=2,
        iterations_share=0.01,
        episodes=20,
        episodes_measured=1,
        optimum_resolution=0.2,
    )
    ran = run_context_study(study, tmp_path)
    (only,) = ran.rows
    session = read_session(tmp_path / "culture-1" / "shuttle" / "session")
    measured = {
        name: sum(tick.reward or 0.0 for tick in session.ticks if tick.agent == name)
        for name in ("p0", "p1", "random", "coupling")
    }
    assert only.measured_policies == pytest.approx((measured["p0"] + measured["p1"]) / 2)
    assert only.measured_random == pytest.approx(measured["random"])
    assert only.measured_coupling == pytest.approx(measured["coupling"])
    # (optimum - coupling) / (optimum - random), and bits of a choice between five stimuli.
    assert only.gap == pytest.approx((only.optimum - only.coupling) / (only.optimum - only.random))
    assert only.bits is not None and -0.5 < only.bits < 2.4
    assert {each.intervention for each in ran.lost} >= {"silent", "shuffled", "yoked", "goal switched"}
    assert pd.read_csv(tmp_path / "context.csv").measured_policies[0] == only.measured_policies

    assert run_context_study(study, tmp_path).done_now == {}
    before = (tmp_path / "culture-1" / "shuttle" / "measured.json").read_bytes()
    (tmp_path / "culture-1" / "shuttle" / "measured.json").unlink()
    again = run_context_study(study, tmp_path)
    assert list(again.done_now) == ["measure/1/shuttle"] and again.rows == ran.rows
    assert (tmp_path / "culture-1" / "shuttle" / "measured.json").read_bytes() == before
    assert json.loads(before)["robot"] == "shuttle"
    with pytest.raises(Mismatch, match=r"context study.policies: 2 there, 3 now"):
        run_context_study(replace(study, policies=3), tmp_path)


def test_robots_with_two_commands_have_recordings_of_their_own(tmp_path: Path) -> None:
    jobs = {job.name: job for job in plan_context_study(ContextStudy(cultures=(1,), robots=("shuttle", "detour")))}
    assert jobs["train/1/shuttle"].needs == ("record/1",) and jobs["train/1/detour"].needs == ("record/1/2-commands",)
    one, two = (jobs[name].task for name in ("record/1", "record/1/2-commands"))
    assert isinstance(one, RecordCulture) and isinstance(two, RecordCulture)
    assert (one.n_commands, two.n_commands) == (1, 2)
    assert one.recordings(tmp_path, 1) != two.recordings(tmp_path, 2)
    assert protocol_for(1) == CLOSED_LOOP and protocol_for(2) == TWO_COMMANDS
