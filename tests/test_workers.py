"""Workers of a study: one a core, kept while they are small, and what becomes of jobs that fail or die."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from animat.errors import AnimatError
from animat.studies.executor import Event, Processes
from animat.studies.jobs import Job, Task
from animat.studies.specification import Study
from animat.studies.toml import read_study
from worker_tasks import Die, Fail, Starve, Stumble, TellProcess

STUDY = Study()


@pytest.fixture
def tasks_importable(monkeypatch: pytest.MonkeyPatch) -> None:
    found = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(Path(__file__).parent), *found])))


def run(at: Processes, task: Task, folder: Path) -> list[Event]:
    """Everything that is told of a job, up to its end."""
    at.start(Job("job", task), STUDY, folder)
    told: list[Event] = []
    while not told or told[-1].kind == "progress":
        told += at.wait()
    return told


@pytest.mark.usefixtures("tasks_importable")
def test_a_worker_stays_until_it_has_grown_large(tmp_path: Path) -> None:
    at = Processes(workers=1)
    try:
        assert at.free == 1
        ran = [run(at, TellProcess(mib), tmp_path)[-1] for mib in (0, 900, 0)]
    finally:
        at.close()
    assert [event.kind for event in ran] == ["done"] * 3
    (first,), (second,), (third,) = (event.files for event in ran)
    assert first == second != third
    assert re.fullmatch(r"\[\d+\]", Path(third).read_text()), "pinned to one core"


@pytest.mark.usefixtures("tasks_importable")
def test_an_error_that_nobody_foresaw_is_told_in_one_line_and_the_worker_goes_on(tmp_path: Path) -> None:
    at = Processes(workers=1)
    try:
        failed = run(at, Stumble(), tmp_path)[-1]
        assert failed.kind == "failed"
        place = r"\(in run, worker_tasks\.py, line \d+\)"
        assert re.fullmatch(rf"TypeError: expected an int, got a float {place}", failed.words)
        assert run(at, TellProcess(), tmp_path)[-1].kind == "done"
    finally:
        at.close()


@pytest.mark.usefixtures("tasks_importable")
def test_where_memory_is_too_little_the_settings_that_ask_for_it_are_named(tmp_path: Path) -> None:
    at = Processes(workers=1)
    try:
        failed = run(at, Starve(), tmp_path)[-1]
    finally:
        at.close()
    expected = "out of memory (256. PiB more were asked for): it grows with policies (10), culture.channels (256): ask"
    assert failed.kind == "failed" and failed.words.startswith(expected)


@pytest.mark.usefixtures("tasks_importable")
def test_ctrl_c_of_the_terminal_does_not_reach_a_worker(tmp_path: Path) -> None:
    at = Processes(workers=1)
    try:
        (told,) = run(at, TellProcess(), tmp_path)[-1].files
        assert os.getpgid(int(Path(told).name)) != os.getpgid(0)
    finally:
        at.close()


@pytest.mark.usefixtures("tasks_importable")
def test_a_job_that_fails_says_why_and_one_that_dies_is_named(tmp_path: Path) -> None:
    at = Processes(workers=1)
    try:
        failed = run(at, Fail(), tmp_path)[-1]
        assert (failed.kind, failed.words) == ("failed", "a.nwb: expected a recording, got none")
        with pytest.raises(AnimatError, match=r"job: its process ended with status 7 .* start again to go on"):
            run(at, Die(), tmp_path)
    finally:
        at.close()


def test_the_specifications_on_the_page_are_read(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "studies.md").read_text()
    blocks = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        (tmp_path / "study.toml").write_text(block)
        assert read_study(tmp_path / "study.toml").conditions
