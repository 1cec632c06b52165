"""The page shows trainings, studies, tunings and recordings as they are in their folders."""

from __future__ import annotations

import base64
import json
import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.errors import InvalidFile
from animat.execution.jobs import PLANNED, Job
from animat.execution.receipts import Receipt
from animat.execution.task import NOTICES, UNFINISHED
from animat.recordings.reading import read_recording
from animat.responses.inspection import inspect_recording
from animat.studies.context import ContextStudy, plan_context_study
from animat.studies.run import plan_study
from animat.studies.toml import read_study
from animat.training.policy import CURVE
from animat.watch.discovery import is_locked, recordings_in
from animat.watch.recording import RecordingView
from animat.watch.study import CulturesView, StudyView
from animat.watch.training import TrainingView
from animat.watch.tuning import TuningView
from animat.writing import exclusive_lock
from synthetic_recordings import write_synthetic_series

TINY = Path(__file__).parent / "tiny_study.toml"


def block(view: dict[str, Any], title: str, kind: str = "") -> dict[str, Any]:
    (found,) = [each for each in view["blocks"] if each["title"] == title and kind in ("", each["kind"])]
    return found


def facts(view: dict[str, Any], title: str) -> dict[str, Any]:
    return dict(block(view, title, "facts")["rows"])


def test_a_training_is_shown_as_far_as_its_checkpoints_go(tmp_path: Path) -> None:
    training = {
        "policies": 3, "iterations": 6000, "duration_min": 20.0, "shadowing": True, "mapping": "9-thresholds",
        "robot": {"name": "cartpole"}, "algorithm": {"discount": 0.99},
    }  # fmt: skip
    manifest = {"training": training, "simulators": {"recorded_at_min": [0.0, 10.0, 15.0]}}
    (tmp_path / "training.json").write_text(json.dumps(manifest))
    notices = tmp_path / ".unfinished" / ".notices"
    notices.mkdir(parents=True)
    curve = np.zeros((30, 2, 6))
    curve[:, :, 0] = 100.0 * np.arange(1, 31)[:, None]
    curve[:, :, 2] = np.arange(30)[:, None] + [0.0, 10.0]
    curve[:3, :, 2] = np.nan
    curve[:, :, 3] = 1.0 + np.arange(30)[:, None] + [0.0, 1.0]
    curve[:, :, 4:] = [0.25, 0.5]
    np.savez(tmp_path / ".unfinished" / "from-p0.npz", curve=curve, members=np.arange(2), done=np.array(30))
    (notices / "p0 to p1.json").write_text(json.dumps([0.55, "return 31.0"]))
    with exclusive_lock(tmp_path):
        found = TrainingView(tmp_path).view(None, 8.0)
        assert found["state"] == "running"
    assert facts(found, "So far")["done"] == "37 % of all"
    # 55 % of 20 minutes are 11: the second recording.
    assert facts(found, "So far")["in use"] == "that of minute 10"
    chart = block(found, "Learning curves")
    assert chart["marks"] == [[3000.0, "minute 10"], [4500.0, "minute 15"]]
    *policies, mean = chart["series"]
    assert [each["y"] for each in policies] == [[None] * 3 + list(np.arange(3.0, 30) + more) for more in (0, 10)]
    assert mean["y"][3:] == list(np.arange(3.0, 30) + 5)
    assert (
        "Not known: random actions, best coupling, optimal return. To show them, run animat evaluate" in chart["words"]
    )
    evaluation = {
        "rows": [{"name": "random", "mean_return": -2.5}],
        "optimum": {"value": 50.0},
        "recorded_at_min": 15.0,
    }
    (tmp_path / "evaluation.json").write_text(json.dumps(evaluation))
    with_lines = block(TrainingView(tmp_path).view(None, 8.0), "Learning curves")
    assert [(each["name"], each["x"], each["y"]) for each in with_lines["series"] if each["style"] == "dashed"] == [
        ("random actions", [0.0, 6000.0], [-2.5, -2.5]),
        ("optimal return", [0.0, 6000.0], [50.0, 50.0]),
    ]
    assert "on the simulator of minute 15" in with_lines["words"]
    assert "Not known: best coupling." in with_lines["words"]
    # What is no evaluation is none.
    (tmp_path / "evaluation.json").write_text('[1, {"rows": 3}]')
    assert block(TrainingView(tmp_path).view(None, 8.0), "Learning curves") == chart
    (tmp_path / "evaluation.json").unlink()
    for title, last, shown in (("Entropy", 30.5, "30.5 on"), ("Alpha", 0.25, "0.25"), ("Critic loss", 0.5, "0.5 on")):
        chart = block(found, title)
        assert len(chart["series"]) == 3
        assert chart["series"][-1]["y"][-1] == last
        assert chart["words"].startswith(shown)
    assert block(found, "Policies")["rows"] == [
        ["p0", "55 %", 29.0],
        ["p1", "55 %", 39.0],
        ["p2", "0 %", "none yet"],
    ]
    # Of the first columns alone, as in policies of before.
    np.savez(tmp_path / ".unfinished" / "from-p0.npz", curve=curve[:, :, :3], members=np.arange(2), done=np.array(30))
    before = TrainingView(tmp_path).view(None, 8.0)
    assert block(before, "Learning curves")["series"] == [*policies, mean]
    assert block(before, "Entropy")["words"].startswith("Not in these files")
    stopped = TrainingView(tmp_path).view(None, 8.0)
    assert stopped["state"] == "silent"
    assert "run its command again to continue" in stopped["message"]
    # As all are trained at once: numbers in the file, and words of the first job alone.
    (tmp_path / ".unfinished" / "from-p0.npz").unlink()
    np.savez(tmp_path / ".unfinished" / "at-once-ab.npz", curve=curve, members=np.array([1, 2]), done=np.array(30))
    (tmp_path / ".unfinished" / ".notices" / "p2.json").write_text(json.dumps([0.55, None]))
    together = TrainingView(tmp_path).view(None, 8.0)
    assert block(together, "Learning curves")["series"] == [*policies, mean]
    assert [row[2] for row in block(together, "Policies")["rows"]] == ["none yet", 29.0, 39.0]
    assert block(together, "Policies")["words"] == "p0 to p1: 55 % return 31.0; p2: 55 %"
    # What came after the last checkpoint is lost.
    (tmp_path / ".unfinished" / ".notices" / "p2.json").write_text(json.dumps([0.95, None]))
    assert block(TrainingView(tmp_path).view(None, 8.0), "Policies")["rows"][2][1] == "50 %"


def planned_in(folder: Path, jobs: Sequence[Job]) -> None:
    """Write the plan of the jobs, as a running study does."""
    (folder / ".unfinished").mkdir(exist_ok=True)
    (folder / ".unfinished" / PLANNED).write_text(json.dumps({job.name: job.cost_s for job in jobs}))


def test_a_study_shows_jobs_done_running_and_waiting(tmp_path: Path) -> None:
    (tmp_path / "study.json").write_text(json.dumps({"study": {"robots": [{"name": "navigation"}]}}))
    planned = plan_study(read_study(TINY), tmp_path)
    jobs = [job.name for job in planned]
    for job in jobs[:2]:
        Receipt(job, "x", {}, {"a": "b", "c": "d"}).save(tmp_path / "jobs")
    notices = tmp_path / ".unfinished" / ".notices"
    notices.mkdir(parents=True)
    # As a version before this one left it.
    before = StudyView(tmp_path).view(None, 8.0)
    assert (before["state"], facts(before, "Jobs")["waiting"]) == ("silent", "not known")
    planned_in(tmp_path, planned)
    (notices / f"{jobs[2].replace('/', '+')}.json").write_text('[0.25, "a remark"]')
    # Of a job that is done by now.
    (notices / f"{jobs[0].replace('/', '+')}.json").write_text('[1.0, ""]')
    with exclusive_lock(tmp_path):
        found = StudyView(tmp_path).view(None, 8.0)
    rows = facts(found, "Jobs")
    assert (rows["jobs done"], rows["running"], rows["waiting"]) == (2, 1, len(jobs) - 3)
    assert block(found, "Running")["rows"] == [[jobs[2], "25 %", "a remark"]]
    assert sorted(block(found, "Done")["rows"]) == sorted([job, 2] for job in jobs[:2])
    assert [job for (job,) in block(found, "Waiting")["rows"]] == jobs[3:]
    # Killed: what ran then waits.
    killed = StudyView(tmp_path).view(None, 8.0)
    rows = facts(killed, "Jobs")
    assert (rows["jobs done"], rows["running"], rows["waiting"]) == (2, 0, len(jobs) - 2)
    assert [job for (job,) in block(killed, "Waiting")["rows"]] == jobs[2:]
    assert "was killed or failed" in killed["message"]
    for job in jobs:
        Receipt(job, "x", {}, {"a": "b"}).save(tmp_path / "jobs")
    assert StudyView(tmp_path).view(None, 8.0)["state"] == "silent"
    shutil.rmtree(tmp_path / ".unfinished")
    ended = StudyView(tmp_path).view(None, 8.0)
    assert (ended["state"], facts(ended, "Jobs")["waiting"]) == ("ended", 0)


def test_a_study_over_cultures_shows_progress_and_comparisons_so_far(tmp_path: Path) -> None:
    names = [f"culture-{seed}" for seed in range(1, 6)]
    (tmp_path / "cultures.json").write_text(json.dumps({"cultures": [*names, "../elsewhere", 3]}))
    for name, means in zip(names[:3], ((1.0, 4.0), (2.0, 3.0), (6.0, 5.0)), strict=True):
        (tmp_path / name / "tables").mkdir(parents=True)
        table = ["comparison,robot,mean_first,mean_second", f"a and b,arm,{means[0]},{means[1]}"]
        (tmp_path / name / "tables" / "comparisons.csv").write_text("\n".join(table))
        Receipt("report", "x", {}, {"a": "b"}).save(tmp_path / name / "jobs")
    planned = plan_study(read_study(TINY), tmp_path)
    for name in names[3:]:
        (tmp_path / name / "jobs").mkdir(parents=True)
        planned_in(tmp_path / name, planned)
    Receipt(planned[0].name, "x", {}, {"a": "b"}).save(tmp_path / names[3] / "jobs")
    view = CulturesView(tmp_path)
    assert view.about()["title"] == "study over 5 cultures"
    with exclusive_lock(tmp_path), exclusive_lock(tmp_path / names[3]):
        found = view.view(None, 8.0)
    rows = facts(found, "Cultures")
    assert (rows["cultures done"], rows["running"], rows["begun, not running"]) == ("3 of 5", 1, 1)
    share = planned[0].cost_s / sum(job.cost_s for job in planned)
    assert block(found, "Running")["rows"] == [[names[3], f"{100 * share:.0f} %"]]
    assert block(found, "Comparisons")["rows"] == [["a and b", "arm", 3.0, 4.0, "2 of 3"]]
    assert view.view(None, 8.0)["state"] == "silent"
    # A culture that was studied anew has other means.
    compared = tmp_path / names[2] / "tables" / "comparisons.csv"
    before = compared.read_text()
    compared.write_text(before.replace("6.0,5.0", "9.0,11.0"))
    os.utime(compared, (0, 0))
    assert block(view.view(None, 8.0), "Comparisons")["rows"] == [["a and b", "arm", 4.0, 6.0, "3 of 3"]]
    compared.write_text(before)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "culture-9").symlink_to(elsewhere)
    manifest = {"cultures": [*names, "culture-9"], "failed": {names[4]: "no responses", "../x": "y"}}
    (tmp_path / "cultures.json").write_text(json.dumps(manifest))
    assert view.about()["title"] == "study over 5 cultures"
    failed = view.view(None, 8.0)
    assert (failed["state"], facts(failed, "Cultures")["failed"]) == ("ended", 1)
    assert failed["message"] == "1 of the cultures failed; run the study again to continue"
    assert block(failed, "Failed")["rows"] == [[names[4], "no responses"]]
    for damage in (b"comparison,robot,mean_first,mean_second\na and b,arm,nan,4", b"\xff\x00", b"comparison\nx"):
        (tmp_path / names[0] / "tables" / "comparisons.csv").write_bytes(damage)
        compared = block(CulturesView(tmp_path).view(None, 8.0), "Comparisons")
        assert compared["rows"] == [["a and b", "arm", 4.0, 4.0, "1 of 2"]]
        assert "cannot be read: 1 of the cultures that are done" in compared["words"]
    (tmp_path / "cultures.json").write_text("[]")
    with pytest.raises(InvalidFile, match="expected the names of cultures"):
        view.view(None, 8.0)


def test_the_context_study_shows_progress_and_results(tmp_path: Path) -> None:
    study = ContextStudy(cultures=(1, 2), robots=("shuttle", "cartpole"))
    words = {"context study": asdict(study), "versions": {}, "fingerprint": "x"}
    (tmp_path / "study.json").write_text(json.dumps(words))
    Receipt("record/2", "x", {}, {"a": "b"}).save(tmp_path / "jobs")
    row = {"name": "policies", "mean_return": 61.5, "actors": 4, "episodes": 400}
    found_out = tmp_path / "culture-2" / "shuttle" / "simulated.json"
    found_out.parent.mkdir(parents=True)
    found_out.write_text(json.dumps({"rows": [row, row | {"name": "random", "mean_return": 1.0}]}))
    planned_in(tmp_path, plan_context_study(study))
    view = StudyView(tmp_path)
    assert view.about()["title"] == "context study of shuttle, cartpole"
    found = view.view(None, 8.0)
    # Of each culture a recording, and of each robot on it a training, a judgement and a measurement.
    assert (facts(found, "Jobs")["jobs done"], facts(found, "Jobs")["waiting"]) == (1, 2 * (1 + 2 * 3) - 1)
    assert ["measure/1/cartpole"] in block(found, "Waiting")["rows"]
    assert block(found, "Results")["rows"] == [["shuttle", "policies, culture-2", 61.5, 4, 400]]


def test_a_tuning_shows_its_journal(tmp_path: Path) -> None:
    tune = {"trials": 5, "together": 3, "rungs": 3}
    (tmp_path / "tune.json").write_text(json.dumps({"tune": tune, "study": {"robots": [{"name": "arm"}]}}))
    trials = [
        {"trial": 0, "settings": {"discount": 0.98765}, "state": "complete", "returns": [[1.0, 2.0], [3.0, 5.0]]},
        {"trial": 1, "settings": {"discount": 0.9}, "state": "stopped", "returns": [[50.0, 60.0]]},
        {"trial": 2, "settings": {"discount": 0.8}, "state": "diverged", "returns": []},
    ]
    (tmp_path / "journal.jsonl").write_text("".join(json.dumps(each) + "\n" for each in trials))
    found = TuningView(tmp_path).view(None, 8.0)
    rows = facts(found, "Trials")
    assert rows["trials done"] == "3 of 5"
    assert [rows[name] for name in ("complete", "stopped early", "diverged")] == [1, 1, 1]
    # One that came further counts before one that did well at the first rung.
    assert rows["best so far"] == "trial 0, 4" and rows["running"] == 0
    journal = block(found, "Journal")["rows"]
    assert journal[-1] == [0, "complete", 4.0, "discount 0.9877"]
    assert [row[1:3] for row in journal[:2]] == [["diverged", None], ["stopped early", 55.0]]
    drawn = {each["name"]: (each["x"], each["y"]) for each in block(found, "Return of each trial")["series"]}
    assert drawn == {"best so far": ([0, 1], [4, 4]), "complete": ([0], [4]), "stopped early": ([1], [55])}
    notices = tmp_path / ".unfinished" / ".notices"
    notices.mkdir(parents=True)
    (notices / "rung-2+trials-3,4.json").write_text("[0.5, null]")
    with exclusive_lock(tmp_path):
        found = TuningView(tmp_path).view(None, 8.0)
    assert facts(found, "Trials")["running"] == 1
    # No job says more than how far it is.
    assert block(found, "Running")["head"] == ["job", "done"]
    assert block(found, "Running")["rows"] == [["rung-2/trials-3,4", "50 %"]]
    assert block(found, "Return of each trial")["until"] == 4
    finals = [
        {"trial": 0, "mean_return": None},
        {"trial": 2, "mean_return": -10.0},
        {"trial": 1, "mean_return": 6.25, "standard_error": 0.5, "settings": {"batch": 64}},
    ]
    (tmp_path / "results.json").write_text(json.dumps({"best": {"trial": 1}, "finals": finals}))
    found = TuningView(tmp_path).view(None, 8.0)
    # Another than that of best.toml.
    assert facts(found, "Trials")["best of the search"] == "trial 0, 4"
    assert block(found, "Retrained")["rows"] == [
        [1, 6.25, 0.5, "batch 64"],
        [2, -10.0, None, ""],
        [0, None, None, ""],
    ]
    assert "Running" not in [each["title"] for each in found["blocks"]]


def test_recordings_are_inspected_one_after_another(tmp_path: Path) -> None:
    view = RecordingView(tmp_path)
    with pytest.raises(InvalidFile, match="expected recordings"):
        view.view(None, 8.0)
    files = write_synthetic_series(1, tmp_path, sessions=2, channels=32, patterns=20)
    view.view(None, 8.0)
    found = view.view(5.0, 2.0)
    recording = read_recording(files[1])
    inspected = [inspect_recording(read_recording(file)) for file in files]
    rows = block(found, "P(x >= P50) of each condition")["rows"]
    assert rows == [
        [first.label, f"{first.share_above_median:.2f}", f"{second.share_above_median:.2f}"]
        for first, second in zip(*(each.conditions for each in inspected), strict=True)
    ]
    raster = block(found, "Spikes by channel")
    within = (recording.spike_times_s >= 3.0) & (recording.spike_times_s <= 5.0)
    assert raster["spikes"]["n"] == within.sum() > 10
    channels = np.frombuffer(base64.b64decode(raster["spikes"]["channels"]), "<u2")
    np.testing.assert_array_equal(channels, recording.spike_channels[within])
    assert (found["from_s"], found["to_s"]) == (3.0, 5.0)
    assert [row[1] for row in block(found, "Findings")["rows"]] == [each.message for each in inspected[1].findings]
    # An older one that was replaced is inspected again.
    os.utime(shutil.copy(files[1], files[0]), (0, 0))
    replaced = block(view.view(5.0, 2.0), "P(x >= P50) of each condition")["rows"]
    assert [row[1:] for row in replaced] == [[row[2], row[2]] for row in rows]


def test_of_very_many_recordings_the_newest_are_watched(tmp_path: Path) -> None:
    for n in range(600):
        (tmp_path / f"recording_{n:04d}_min.nwb").touch()
        # The last by name is the oldest.
        os.utime(tmp_path / f"recording_{n:04d}_min.nwb", (1000 - n, 1000 - n))
    assert [file.name for file in recordings_in(tmp_path)] == [f"recording_{n:04d}_min.nwb" for n in range(500)]
    complete = facts(RecordingView(tmp_path).view(None, 8.0), "Recordings")["complete"]
    assert complete == "500 or more: only the newest are watched"
    for n in range(499, 600):
        (tmp_path / f"recording_{n:04d}_min.nwb").unlink()
    assert facts(RecordingView(tmp_path).view(None, 8.0), "Recordings")["complete"] == 499


def test_a_folder_is_locked_during_a_run(tmp_path: Path) -> None:
    assert not is_locked(tmp_path)
    with exclusive_lock(tmp_path):
        assert is_locked(tmp_path)
    assert not is_locked(tmp_path)


def test_a_strange_file_beside_a_run_is_left_out_and_the_rest_is_shown(tmp_path: Path) -> None:
    training = {"robot": {"name": "cartpole"}, "policies": 2, "iterations": 6000}
    folder = tmp_path / "training"
    (folder / UNFINISHED / NOTICES).mkdir(parents=True)
    (folder / "training.json").write_text(json.dumps({"training": training, "random_return": 9.0}))
    (folder / "evaluation.json").write_text('{"rows": [{"of": "mine"}, 3], "optimum": 7}')
    (folder / UNFINISHED / NOTICES / "p0.json").write_text('{"mine": 1}')
    for members in (np.arange(5), np.array(["mine"]), np.array([math.nan])):
        np.savez(folder / UNFINISHED / "from-p0.npz", curve=np.zeros((3, 1, len(CURVE))), members=members)
        titles = [block["title"] for block in TrainingView(folder).view(None, 8.0)["blocks"]]
        assert titles[:2] == ["So far", "Learning curves"] and "Policies" in titles

    tuning = tmp_path / "tuning"
    tuning.mkdir()
    (tuning / "tune.json").write_text('{"study": {"robots": [{"name": "cartpole"}]}, "tune": {"trials": 3}}')
    whole = {"trial": 0, "settings": {"tau": 0.1}, "state": "complete", "chunks": [60], "returns": [[1.0, 2.0]]}
    strange = [whole | {"trial": 10**400}, whole | {"trial": math.inf}, whole | {"returns": [[10**400]]}]
    lines = "\n".join(map(json.dumps, [whole, *strange]))
    (tuning / "journal.jsonl").write_text(lines + '\n\n{"trial": 1, "sett')
    *_, journal = TuningView(tuning).view(None, 8.0)["blocks"]
    assert journal["rows"] == [[0, "complete", 1.5, "tau 0.1"]]
    (tuning / "results.json").write_text('{"finals": 7}')
    *_, retrained, journal = TuningView(tuning).view(None, 8.0)["blocks"]
    assert (retrained["rows"], retrained["words"]) == ([], "none is known")
    assert journal["rows"] == [[0, "complete", 1.5, "tau 0.1"]]

    study = tmp_path / "study"
    (study / "jobs").mkdir(parents=True)
    (study / "study.json").write_text('{"study": {"robots": [{"name": "cartpole"}]}}')
    (study / "jobs" / "mine.json").write_text('{"of": "mine"}')
    (study / "jobs" / "fit.json").write_text('{"job": "fit", "outputs": {"a": "1"}}')
    *_, done = StudyView(study).view(None, 8.0)["blocks"]
    assert done["rows"] == [["fit", 1]]
    row = {"mean_return": 61.5, "actors": 4, "episodes": 400}
    for culture, content in (("1", {"rows": [row]}), ("2", {"rows": 7}), ("3", {"rows": [{"of": "mine"}]})):
        (study / f"culture-{culture}" / "shuttle").mkdir(parents=True)
        (study / f"culture-{culture}" / "shuttle" / "simulated.json").write_text(json.dumps(content))
    (study / "episodes" / "arm" / "paper").mkdir(parents=True)
    np.savez(study / "episodes" / "arm" / "paper" / "episodes.npz", **{"return": np.zeros(3), "actor": np.zeros(2)})
    (study / UNFINISHED).mkdir()
    (study / UNFINISHED / PLANNED).write_text('{"fit": 1.0, "train": "mine"}')
    found = StudyView(study).view(None, 8.0)
    results = block(found, "Results")
    assert results["rows"] == [["shuttle", "policies, culture-1", 61.5, 4, 400]]
    strange = "episodes/arm/paper/episodes.npz, culture-2/shuttle/simulated.json, culture-3/shuttle/simulated.json"
    assert results["words"].endswith(f" Left out, as they cannot be read: {strange}.")
    assert block(found, "Waiting")["rows"] == [["train"]]
