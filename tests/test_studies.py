"""Studies: the same files whatever happens, folders that are not mixed up, results that other code agrees with."""

from __future__ import annotations

import csv
import html
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import mannwhitneyu, ttest_1samp

from animat.cli import main
from animat.coding.mapping import mapping_named
from animat.cultures.kinds import culture_arguments
from animat.cultures.virtual import VirtualCulture
from animat.environment import Animat
from animat.errors import AnimatError, InvalidArgument, InvalidFile, Mismatch, UnusableData
from animat.evaluation.rollouts import heuristic_policy
from animat.execution.jobs import in_order
from animat.execution.receipts import Receipt, digest_of
from animat.execution.task import carry_out
from animat.neurons.synthetic import synthetic_simulator
from animat.neurons.timeline import fit_timeline, load_timeline
from animat.progress import Progress, Silent
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.reading import read_recording, read_recordings
from animat.report.html import cell, with_error
from animat.responses.extraction import extract_series
from animat.robots import Cartpole, Navigation
from animat.stimulation.protocol import Protocol, read_protocol
from animat.stimulation.selection import SelectionRule
from animat.studies.captions import CULTURE, ROBOT
from animat.studies.folder import claim_folder, controls_file, describe_study, episodes_file, hash_files
from animat.studies.paper import PRINTED, paper_study
from animat.studies.pictures import CulturePictures
from animat.studies.recording import FitSimulators, MakeRecordings
from animat.studies.run import StudyRun, plan_study, run_study
from animat.studies.source import Source
from animat.studies.specification import Arm, Compared, RobotSpec, Simulators, Study
from animat.studies.toml import read_study, study_to_toml
from animat.studies.training import training_of
from animat.training.lessons import read_lessons
from animat.training.policy import Policy
from animat.tuning.tasks import FitVariant
from animat.writing import LOCK, exclusive_lock
from cultures import small_culture
from synthetic_recordings import synthetic_recording, write_synthetic_series

TINY = Path(__file__).parent / "tiny_study.toml"
CONTROLS = [arm.name for arm in read_study(TINY).arms if arm.delivery == "shuffled"]


NAMES = "arm, cartpole, detour, navigation, shuttle, swing-up, wheels"
"""Of the robots."""


def files(folder: Path) -> dict[str, str]:
    """Every file of a folder, hidden ones too, with a digest."""
    return {
        path.relative_to(folder).as_posix(): digest_of(path) for path in sorted(folder.rglob("*")) if path.is_file()
    }


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# --- the folder -----------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_killed_again_and_again_with_one_worker_it_ends_in_the_same_files(tiny_study: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    # Between the recordings, after the simulators, with a policy that has no receipt yet, among the figures.
    moments = ("recordings/recording_0000_min.nwb", "jobs/fit.json", "policies/navigation/1-threshold/p0.safetensors",
               "figures/navigation-learning.png")  # fmt: skip
    for moment in moments:
        process = subprocess.Popen(command_of_tiny(folder), stdout=subprocess.DEVNULL)
        while process.poll() is None and not (folder / moment).exists():
            time.sleep(0.002)
        assert process.poll() is None, f"it was over before {moment}"
        kill(process)
    assert subprocess.run(command_of_tiny(folder), stdout=subprocess.DEVNULL, check=False).returncode == 0
    assert files(folder) == files(tiny_study)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_killed_at_any_moment_it_ends_in_the_same_files(tiny_study: Path, tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    kill_and_go_on(tmp_path / "killed", [rng.uniform(3.0, 12.0) for _ in range(12)])
    assert files(tmp_path / "killed") == files(tiny_study)


def kill_and_go_on(folder: Path, after_s: list[float]) -> None:
    """Run the tiny study with one worker, killed after each of these times, then to its end."""
    for seconds in [*after_s, None]:
        process = subprocess.Popen(command_of_tiny(folder), stdout=subprocess.DEVNULL)
        try:
            assert process.wait(seconds) == 0
            break
        except subprocess.TimeoutExpired:
            kill(process)


def command_of_tiny(folder: Path) -> list[str]:
    return [sys.executable, "-m", "animat", "study", str(TINY), "--out", str(folder), "--workers", "1"]


def kill(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()
    # The kernel takes the workers along, which takes it a moment.
    time.sleep(0.3)


@pytest.mark.oracle
def test_a_finished_folder_is_left_alone_and_said_to_be_so(
    tiny_study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in tiny_study.rglob("*") if path.is_file()}
    assert main(["study", str(TINY), "--out", str(tiny_study), "--json"]) == 0
    said = capsys.readouterr().out
    assert "nothing to do" in said
    assert json.loads(said.splitlines()[-1])["done_now_cpu_s"] == {}
    assert {path: path.stat().st_mtime_ns for path in tiny_study.rglob("*") if path.is_file()} == before


@pytest.mark.oracle
def test_what_is_lost_or_damaged_is_made_again_by_workers(
    tiny_study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "damaged"
    shutil.copytree(tiny_study, folder)
    (folder / "policies/navigation/1-threshold/p1.safetensors").write_bytes(b"damaged")
    (folder / "tables/scores.csv").unlink()
    assert main(["study", str(TINY), "--out", str(folder), "--workers", "2", "--json"]) == 0
    done_now = json.loads(capsys.readouterr().out.splitlines()[-1])["done_now_cpu_s"]
    assert set(done_now) == {"train/navigation/1-threshold/p0", "tables"}
    assert files(folder) == files(tiny_study)


@pytest.mark.oracle
def test_a_folder_of_another_study_is_refused(tiny_study: Path, tmp_path: Path) -> None:
    before = files(tiny_study)
    with pytest.raises(Mismatch, match=r"another \(study\.policies: 2 there, 3 now\)"):
        run_study(replace(read_study(TINY), policies=3), tiny_study, base=TINY.parent)
    with pytest.raises(Mismatch, match=r"another \(study\.seed: \d+ there, 99 now\)"):
        run_study(replace(read_study(TINY), seed=99), tiny_study, base=TINY.parent)
    assert files(tiny_study) == before
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    with pytest.raises(Mismatch, match="other files in it"):
        run_study(read_study(TINY), tmp_path / "full", base=TINY.parent)
    (tmp_path / "a-file").write_text("mine")
    with pytest.raises(InvalidFile, match="got a file"):
        run_study(read_study(TINY), tmp_path / "a-file", base=TINY.parent)


def test_what_is_not_a_study_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        InvalidArgument, match=r"study: expected a Study, as animat\.read_study returns, got 'my-study\.toml"
    ):
        run_study("my-study.toml", tmp_path)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_folder_of_before_results_were_typed_is_refused_with_what_to_do(tmp_path: Path) -> None:
    """Its fingerprint knew neither pandas nor pillow; what its jobs handed each other was CSV."""
    study = replace(read_study(TINY), culture=Source())
    manifest = describe_study(study, {})
    for name in ("pandas", "pillow"):
        del manifest["versions"][name]
    (tmp_path / "study.json").write_text(json.dumps(manifest | {"fingerprint": "of before"}))
    (tmp_path / "episodes").mkdir()
    (tmp_path / "episodes" / "episodes.csv").write_text("at_min,actor\n")
    with pytest.raises(Mismatch, match=r"versions\.pandas: nothing there, .* now\); give another folder"):
        run_study(study, tmp_path)


def test_a_folder_in_which_other_programs_hid_a_file_is_empty(tmp_path: Path) -> None:
    for name in (".DS_Store", ".gitignore"):
        (tmp_path / name).write_text("theirs")
    with claim_folder(tmp_path, "study", {"fingerprint": "00"}, "study.json", {}):
        assert json.loads((tmp_path / "study.json").read_text()) == {"fingerprint": "00"}
    assert (tmp_path / ".gitignore").read_text() == "theirs"


def test_nothing_of_another_s_folder_is_touched(tmp_path: Path) -> None:
    home = tmp_path / "home"
    (home / "sub").mkdir(parents=True)
    for name in ("thesis.txt", "sub/.draft.partial.odt", ".notes.txt.abcd1234.partial.txt"):
        (home / name).write_text("mine")
    before = files(home)
    with pytest.raises(Mismatch, match="other files in it"):
        run_study(read_study(TINY), home, base=TINY.parent)
    assert files(home) == before


@pytest.mark.oracle
def test_what_a_killed_run_was_writing_is_cleared_away_and_nothing_else(tiny_study: Path, tmp_path: Path) -> None:
    folder = tmp_path / "study"
    shutil.copytree(tiny_study, folder)
    unfinished = [".study.toml.abcd1234.partial.toml", "figures/.culture-psth.png.x_y_z_12.partial.png"]
    kept = ["figures/.my.partial.odt", "mine/.report.html.abcd1234.partial.html"]
    for name in (*unfinished, *kept):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("half")
    assert run_study(read_study(TINY), folder, base=TINY.parent).done_now == {}
    assert not any((folder / name).exists() for name in unfinished)
    assert all((folder / name).exists() for name in kept)


@pytest.mark.oracle
def test_a_second_run_in_a_folder_at_work_is_refused(tiny_study: Path, tmp_path: Path) -> None:
    folder = tmp_path / "study"
    shutil.copytree(tiny_study, folder)
    with exclusive_lock(folder), pytest.raises(Mismatch, match="another run is at work in this folder"):
        run_study(read_study(TINY), folder, base=TINY.parent)
    assert run_study(read_study(TINY), folder, base=TINY.parent).done_now == {}


@pytest.mark.oracle
def test_a_finished_folder_that_cannot_be_written_to_is_still_finished(
    tiny_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = Path.open

    def open_(self: Path, mode: str = "r", *args: Any, **options: Any) -> Any:
        if mode[0] in "wax":
            raise PermissionError(13, "Permission denied")
        return opened(self, mode, *args, **options)

    def unlink(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "Permission denied")

    folder = tmp_path / "archive"
    shutil.copytree(tiny_study, folder)
    leftover = folder / ".study.toml.abcd1234.partial.toml"
    leftover.write_text("half")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink)
        assert run_study(read_study(TINY), folder, base=TINY.parent).done_now == {}
    assert leftover.exists()
    monkeypatch.setattr(Path, "open", open_)
    monkeypatch.setattr(os, "access", lambda path, mode: mode == os.R_OK)
    assert run_study(read_study(TINY), folder, base=TINY.parent).done_now == {}
    (folder / "tables/scores.csv").unlink()
    with pytest.raises(InvalidFile, match=r"archive: .* left, but it cannot be written"):
        run_study(read_study(TINY), folder, base=TINY.parent)
    with pytest.raises(InvalidFile, match="cannot be written"):
        run_study(read_study(TINY), tmp_path / "new", base=TINY.parent)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
@pytest.mark.oracle
def test_a_finished_read_only_folder_keeps_what_a_killed_run_left(tiny_study: Path, tmp_path: Path) -> None:
    folder = tmp_path / "archive"
    shutil.copytree(tiny_study, folder)
    leftovers = [folder / ".study.toml.abcd1234.partial.toml", folder / "figures/.a.png.abcd1234.partial.png"]
    for leftover in leftovers:
        leftover.write_text("half")
    folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    for each in folders:
        each.chmod(0o555)
    try:
        assert run_study(read_study(TINY), folder, base=TINY.parent).done_now == {}
        assert all(leftover.exists() for leftover in leftovers)
    finally:
        for each in folders:
            each.chmod(0o755)


def test_a_file_that_is_there_to_be_locked_is_nobody_s(tmp_path: Path) -> None:
    (tmp_path / LOCK).write_text("")
    study = replace(read_study(TINY), seed=1)
    for seed in (1, 2):
        with pytest.raises(AnimatError, match="halted"):
            run_study(replace(study, seed=seed), tmp_path, base=TINY.parent, executor=Halts())
    assert read_study(tmp_path / "study.toml").seed == 2


def test_a_specification_can_be_corrected_before_anything_is_made(tmp_path: Path) -> None:
    study = replace(read_study(TINY), seed=1)
    for seed in (1, 2):
        with pytest.raises(AnimatError, match="halted"):
            run_study(replace(study, seed=seed), tmp_path / "study", base=TINY.parent, executor=Halts())
    assert read_study(tmp_path / "study" / "study.toml").seed == 2
    assert json.loads((tmp_path / "study" / "study.json").read_text())["study"]["seed"] == 2


def test_a_specification_can_be_corrected_after_its_first_job_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(self: MakeRecordings, folder: Path, progress: Progress) -> list[Path]:
        progress.update(0.5, 1)
        raise AnimatError("stopped")

    monkeypatch.setattr(MakeRecordings, "make", stop)
    # Every other job needs the recordings.
    study = replace(read_study(TINY), arms=(Arm("1 threshold"),), comparisons=())
    for seed in (1, 2):
        with ThreadPoolExecutor(1) as executor, pytest.raises(AnimatError, match="stopped"):
            run_study(replace(study, seed=seed), tmp_path, base=TINY.parent, executor=executor)
    assert read_study(tmp_path / "study.toml").seed == 2


@pytest.mark.parametrize("damage", ["fewer spikes", "garbage", "gone"])
@pytest.mark.oracle
def test_a_recording_that_changed_is_recorded_again(tiny_study: Path, tmp_path: Path, damage: str) -> None:
    folder = tmp_path / "study"
    shutil.copytree(tiny_study, folder)
    file = folder / "recordings" / "recording_0000_min.nwb"
    if damage == "fewer spikes":
        recording = read_recording(file)
        kept = np.arange(len(recording.spike_times_s)) % 3 > 0
        write_nwb(
            replace(
                recording,
                spike_times_s=recording.spike_times_s[kept],
                spike_channels=recording.spike_channels[kept],
            ),
            file,
        )
    elif damage == "garbage":
        file.write_bytes(b"garbage")
    else:
        file.unlink()
    with ThreadPoolExecutor(1) as executor:
        ran = run_study(read_study(TINY), folder, base=TINY.parent, executor=executor)
    assert set(ran.done_now) == {"record"}
    assert files(folder) == files(tiny_study)


@pytest.mark.oracle
def test_a_virtual_culture_s_recordings_are_the_same_files_wherever_it_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rule = SelectionRule(recording_sites=150, stimulation_sites=16, patterns=100)
    monkeypatch.setattr("animat.studies.recording.VirtualCulture", partial(small_culture, rule=rule))
    study = Study(culture=Source(sessions=2, interval_min=2.0, trials=2))

    def record(name: str) -> Receipt:
        done = carry_out(MakeRecordings(study, tmp_path), tmp_path / name, tmp_path / "receipts")
        return Receipt("record", "study", {}, done.files)

    undisturbed = record("undisturbed")
    assert sorted(undisturbed.outputs) == [
        "recordings/culture.state", "recordings/recording_0000_min.nwb", "recordings/recording_0002_min.nwb",
        "recordings/selection.json",
    ]  # fmt: skip
    # From there `animat run` goes on: from after the last recording.
    recordings = tmp_path / "undisturbed" / "recordings"
    known = culture_arguments("virtual", read_recordings(recordings), [recordings])
    assert known == {"seed": 1, "state": recordings / "culture.state"}
    later = small_culture(1, rule=rule)
    assert later.restore_state(known["state"]) == {"sessions": 2}
    assert later.now_s > 120 + read_recording(recordings / "recording_0002_min.nwb").duration_s
    save_state = VirtualCulture.save_state

    def killed(self: VirtualCulture, path: Path, *, sessions: int) -> None:
        if sessions == 2:
            raise KeyboardInterrupt
        save_state(self, path, sessions=sessions)

    with monkeypatch.context() as patched:
        patched.setattr(VirtualCulture, "save_state", killed)
        with pytest.raises(KeyboardInterrupt):
            record("killed")
    assert record("killed") == undisturbed
    assert files(tmp_path / "killed") == files(tmp_path / "undisturbed")

    state = tmp_path / "killed" / "recordings" / "culture.state"
    for damage in (state.unlink, lambda: state.write_bytes(b"damaged")):
        undisturbed.save(tmp_path / "killed" / "jobs")
        damage()
        assert record("killed") == undisturbed


@pytest.mark.parametrize("kind", ["virtual", "files"])
def test_a_study_of_a_virtual_culture_is_one_of_its_tissue_s_revision(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = read_study(TINY)
    if kind == "virtual":
        study = replace(study, culture=Source())
    now = describe_study(study, {})
    monkeypatch.setattr("animat.cultures.tissue.parameters.REVISION", 1)
    before = describe_study(study, {})
    assert (before["fingerprint"] != now["fingerprint"]) == (kind == "virtual")
    assert ("virtual tissue" in now["versions"]) == (kind == "virtual")


def test_sources_of_the_same_name_are_distinguished(tmp_path: Path) -> None:
    for day in ("day1", "day2"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "rec[1]_spikes.csv").write_text(day)
        (tmp_path / day / "rec[1]_stimuli.csv").write_text(day)
    both = [tmp_path / day / "rec[1]_spikes.csv" for day in ("day1", "day2")]
    sums = hash_files(both, tmp_path)
    assert list(sums) == [f"{day}/rec[1]_{of}.csv" for day in ("day1", "day2") for of in ("spikes", "stimuli")]
    assert len(set(sums.values())) == 2
    with pytest.raises(InvalidArgument, match="each file once"):
        hash_files([both[0], both[0]], tmp_path)
    with pytest.raises(InvalidFile, match="no such file"):
        hash_files([tmp_path / "none.nwb"], tmp_path)


@pytest.mark.oracle
def test_the_first_recording_is_the_first_in_time_not_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`recording_0010_min` comes before `recording_02.5_min` by name."""
    monkeypatch.setattr("animat.report.style.save_figure", lambda figure, path: path)
    folder = tmp_path / "study"
    for minute, channels in ((2.5, 24), (10.0, 16)):
        made = synthetic_recording(1, patterns=20, channels=channels)
        write_nwb(replace(made, start_min=minute), folder / "recordings" / recording_name(minute))
    study = Study(culture=Source("files", files=("recordings",)))
    CulturePictures(study).run(folder, Silent())
    assert sum(bool(row["channel"]) for row in rows(folder / "tables" / "culture-array.csv")) == 24


@pytest.mark.oracle
def test_recordings_whose_names_would_be_one_are_refused(tmp_path: Path) -> None:
    for i, start_min in enumerate((1234567.0, 1234567.25)):
        write_nwb(synthetic_recording(1, start_min=start_min, patterns=5, channels=16), tmp_path / f"{i}.nwb")
    study = Study(culture=Source("files", files=("0.nwb", "1.nwb")))
    with pytest.raises(InvalidFile, match=r"two that would both be recording_1\.23457e"):
        MakeRecordings(study, tmp_path).run(tmp_path / "study", Silent())


def test_recordings_that_changed_are_noticed(tmp_path: Path) -> None:
    made = tmp_path / "made"
    write_synthetic_series(1, made, sessions=2, patterns=5, channels=16)
    study = Study(culture=Source("files", files=("made",)), robots=(RobotSpec("navigation", iterations=100),))
    with pytest.raises(AnimatError, match="fit: halted"):
        run_study(study, tmp_path / "study", base=tmp_path, executor=Halts(after=1))
    written = tmp_path / "study" / "study.toml"
    assert read_study(written) == study
    assert written.read_text().startswith("# files: relative to the original specification.")
    write_nwb(synthetic_recording(2, start_min=0.0, patterns=5, channels=16), sorted(made.glob("*.nwb"))[0])
    with pytest.raises(Mismatch, match="sources"):
        run_study(study, tmp_path / "study", base=tmp_path, executor=Halts())


class Halts(Executor):
    """An executor that runs some jobs in this process; the next one fails."""

    def __init__(self, after: int = 0) -> None:
        self._left = after

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if self._left:
            self._left -= 1
            future.set_result(fn(*args, **kwargs))
        else:
            future.set_exception(AnimatError("halted"))
        return future


def episodes_in(folder: Path, **columns: str) -> list[dict[str, str]]:
    """The rows of the table of episodes with these values."""
    return [row for row in rows(folder / "tables/episodes.csv") if columns.items() <= row.items()]


# --- the results ----------------------------------------------------------------------------------------------------


@pytest.mark.oracle
def test_comparisons_are_what_scipy_makes_of_the_episodes(tiny_study: Path) -> None:
    (test,) = rows(tiny_study / "tables/comparisons.csv")
    means = []
    for arm in ("before training", "1 threshold"):
        returns = defaultdict(list)
        for row in episodes_in(tiny_study, arm=arm, agent="policy", at_min="0.0", over_time="False"):
            returns[row["actor"]].append(float(row["return"]))
        assert {len(of_policy) for of_policy in returns.values()} == {5}
        means.append([np.mean(of_policy) for of_policy in returns.values()])
    ours = mannwhitneyu(*means, alternative="two-sided", method="asymptotic")
    assert float(test["p_normal"]) == pytest.approx(min(1.0, ours.pvalue))
    assert float(test["u"]) == min(ours.statistic, 4 - ours.statistic)
    assert float(test["mean_second"]) == pytest.approx(np.mean(means[1]))
    assert (float(test["paper_p"]), test["as_in_paper"]) == (PRINTED[test["comparison"], "navigation"].p, "cannot tell")


@pytest.mark.oracle
def test_scores_are_places_on_the_way_from_random_to_the_optimum(tiny_study: Path) -> None:
    """From the episodes and the optima themselves, not from other columns of the table."""
    arm_of = {
        "none": "without neurons",
        "1-threshold": "1-threshold",
        "9-thresholds": "9-thresholds, percentiles fixed",
    }
    optima = {(row["mapping"], float(row["at_min"])): row for row in rows(tiny_study / "tables/optima.csv")}

    def returns_of(arm: str, agent: str, at_min: str) -> np.ndarray:
        """All have as many episodes."""
        chosen = episodes_in(tiny_study, arm=arm, agent=agent, at_min=at_min, over_time="False")
        return np.array([float(row["return"]) for row in chosen])

    scores = rows(tiny_study / "tables/scores.csv")
    assert {row["mapping"] for row in scores} == set(arm_of)
    for row in scores:
        mapping, at_min = row["mapping"], float(row["at_min"])
        random_ = returns_of(arm_of[mapping], "random", row["at_min"]).mean()
        policies = returns_of(row["arm"], "policy", row["at_min"])
        if row["arm"] in CONTROLS:
            # Whatever it chooses is as good as random: it has no optimum of its own.
            assert (row["optimum"], row["normalised_score"]) == ("", "")
            continue
        optimum = optima[mapping, at_min]
        best = float(optimum["best_return"])
        assert float(row["normalised_score"]) == pytest.approx((policies.mean() - random_) / (best - random_))
        error = policies.std(ddof=1) / np.sqrt(len(policies))
        assert policies.mean() < best + float(optimum["grid_error"]) + 4 * error
    controls = rows(tiny_study / "tables/controls.csv")
    names = {row["control"] for row in controls if row["mapping"] == "1-threshold"}
    assert {"random", "silent", "shuffled", "heuristic", "constant 80 Hz"} <= names


@pytest.mark.oracle
def test_optima_have_intervals_where_arms_are_evaluated_through_thresholds(tiny_study: Path) -> None:
    for row in rows(tiny_study / "tables/optima.csv"):
        assert row["left_out"] == ""
        evaluated = row["mapping"] != "none" and (row["mapping"] == "1-threshold" or float(row["at_min"]) == 140)
        assert bool(row["low_95"]) == bool(row["high_95"]) == evaluated
        if evaluated:
            assert float(row["low_95"]) <= float(row["best_return"]) <= float(row["high_95"])


@pytest.mark.oracle
def test_policies_before_training_have_learned_nothing(tiny_study: Path) -> None:
    trained, before = (
        Policy.load(tiny_study / f"policies/navigation/{slug}/p0.safetensors")
        for slug in ("1-threshold", "before-training")
    )
    assert before.learning_curve.shape == (0, 6)
    assert trained.learning_curve[-1, 0] >= 3000
    assert not np.array_equal(before.weights[0], trained.weights[0])
    # All but undecided.
    assert before.probabilities(np.zeros(3, np.float32)) == pytest.approx(np.full(5, 0.2), abs=0.01)


def test_no_two_arms_start_from_the_same_networks() -> None:
    study = paper_study()
    pairs = [(spec, arm) for spec in study.robots for arm in study.arms]
    assert len({training_of(study, spec, arm).seed for spec, arm in pairs}) == len(pairs)


@pytest.mark.oracle
def test_simulators_are_kept_whole(tiny_study: Path, tmp_path: Path) -> None:
    timeline = load_timeline(tiny_study / "simulators/timeline.safetensors")
    assert timeline.start_min.tolist() == [0.0, 140.0]
    assert [c.label for c in timeline.conditions] == ["5 Hz", "10 Hz", "20 Hz", "40 Hz", "80 Hz"]
    assert float(timeline.at(0.0).percentiles[5]) > 0
    (tmp_path / "cut").write_bytes((tiny_study / "simulators/timeline.safetensors").read_bytes()[:50])
    with pytest.raises(InvalidFile, match="cut: expected simulators as animat study and animat tune write them"):
        load_timeline(tmp_path / "cut")


@pytest.mark.oracle
def test_the_example_of_the_page_runs(
    tiny_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[1] / "docs" / "studies.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    plain, lent = blocks
    # The paper's study takes minutes; whether its example is right is seen on one that is there.
    shutil.copytree(tiny_study, tmp_path / "study-2")
    shutil.copytree(TINY.parent / "data" / "tiny", tmp_path / "data" / "tiny")
    monkeypatch.chdir(tmp_path)
    asked: dict[str, Any] = {}
    monkeypatch.setattr("animat.studies.paper.paper_study", lambda **given: asked.update(given) or read_study(TINY))
    exec(compile(plain, "studies.md", "exec"), {})
    assert capsys.readouterr().out.strip() == str(tmp_path / "study-2" / "report.html")
    assert paper_study(**asked).culture.seed == 2
    # Nothing is left to do in a finished folder: no process is begun.
    shutil.copytree(tiny_study, tmp_path / "study")
    exec(compile(lent, "studies.md", "exec"), {"__name__": "__main__"})
    assert asked == {"culture_seed": 2, "quick": True}


# --- the report -----------------------------------------------------------------------------------------------------


@pytest.mark.oracle
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_no_table_or_figure_is_cut_off_in_print(browser: Any, tiny_study: Path) -> None:
    """Tables that scroll on a screen lost their last columns on paper, and folded ones all of them."""
    browser.get((tiny_study / "report.html").as_uri())

    def size(width_px: int, height_px: int) -> None:
        asked = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", asked)

    def number_of(css: str, which: str) -> int:
        script = f"return [...document.querySelectorAll('{css}')].filter(each => {which}).length"
        return int(browser.execute_script(script))

    # As a long table is.
    browser.execute_script(
        "const table = document.querySelector('.wide:has(table)'), folded = document.createElement('details');"
        "table.replaceWith(folded); folded.append(table)"
    )
    size(700, 900)
    assert number_of(".wide", "each.scrollWidth > each.clientWidth") > 3
    assert number_of("table", "!each.checkVisibility()") == 1
    # A4 in landscape, less margins of a centimetre.
    size(1046, 718)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert number_of(".wide", "each.scrollWidth > each.clientWidth") == 0
    assert number_of("table, figure img", "true") > 20
    beyond = "each.getBoundingClientRect().right > innerWidth"
    assert number_of("table, figure img", f"{beyond} || !each.checkVisibility()") == 0
    assert number_of("figure", "each.offsetHeight > innerHeight") == 0


@pytest.mark.oracle
def test_the_report_holds_every_figure_and_table(tiny_study: Path) -> None:
    page = (tiny_study / "report.html").read_text()
    expected = ["headline"] + [f"culture-{name}" for name in CULTURE] + [f"navigation-{name}" for name in ROBOT]
    for stem in expected:
        for ending in ("png", "svg", "pdf"):
            assert (tiny_study / "figures" / f"{stem}.{ending}").stat().st_size > 1000, stem
        assert f'href="figures/{stem}.svg"' in page
    # The headline has a second one for phones.
    assert page.count("<img ") == page.count("data:image/png;base64,") - 1 == len(expected)
    tables = ("Comparisons", "Every arm", "Optimal returns", "Controllability of every recording")
    for title in (*tables, "Controls"):
        assert f"<caption>{title}</caption>" in page
    assert "<dt>Pole mass</dt>" not in page, "there is no cartpole in this study"
    for decision in ("20 iterations", "Walls", "Histogram range", "Most probable actions", "Bursts", "Policies"):
        assert f"<dt>{decision}</dt>" in page
    assert 'all are in <a href="tables/findings.csv">tables/findings.csv</a>.' in page
    assert "provided that the files are at the same paths relative to study.toml." in page
    assert "A response to the right of the dashed threshold counts as a burst, as in the last panel." in page
    assert "before and after training, navigation" in page
    assert {path.stem for path in (tiny_study / "tables").glob("*.csv")} == {
        "scores", "comparisons", "controls", "heuristic", "reflexes", "learning-curves", "optima", "controllability",
        "findings",
        "culture-array", "culture-psth", "culture-bursts", "culture-conditions", "culture-drift",
        "navigation-learning", "navigation-over-time", "navigation-paths", "episodes",
    }  # fmt: skip


@pytest.mark.oracle
def test_the_numbers_of_the_culture_s_figures_are_those_of_its_recordings(tiny_study: Path) -> None:
    recordings = read_recordings(tiny_study / "recordings")
    first, window_s = recordings[0], (0.002, 0.010)
    psth = rows(tiny_study / "tables/culture-psth.csv")
    since_s = (first.spike_times_s[:, None] - first.stimuli.time_s)[:, first.stimuli.is_last_of_presentation]
    for row in psth:
        low_s, high_s = float(row["from_ms"]) * 1e-3, float(row["to_ms"]) * 1e-3
        # Spikes of synthetic recordings lie on no edge.
        spikes = np.count_nonzero((since_s > low_s) & (since_s < high_s))
        assert int(row["spikes"]) == spikes
        exposure_s = (high_s - low_s) * since_s.shape[1] * 32
        assert float(row["rate_hz_per_channel"]) == pytest.approx(spikes / exposure_s)
        assert float(row["in_window"]) == (window_s[0] - 1e-6 < low_s and high_s < window_s[1] + 1e-6)
    drift, bursts = rows(tiny_study / "tables/culture-drift.csv"), rows(tiny_study / "tables/culture-bursts.csv")
    of_condition = rows(tiny_study / "tables/culture-conditions.csv")
    responses = rows(tiny_study / "simulators/responses.csv")
    assert [row["at_min"] for row in drift] == [row["at_min"] for row in bursts] == ["0.0", "140.0"]
    for row, separated in zip(drift, bursts, strict=True):
        here = [each for each in responses if each["start_min"] == row["at_min"]]
        kept = [float(each["rate_hz"]) for each in here if each["is_burst"] == "0"]
        for percent in (10, 25, 50, 75, 90):
            assert float(row[f"p{percent}_hz"]) == pytest.approx(np.quantile(kept, percent / 100))
        assert float(row["burst_share"]) == float(separated["burst_share"]) == pytest.approx(1 - len(kept) / len(here))
        assert (int(separated["responses"]), int(separated["bursts"])) == (len(here), len(here) - len(kept))
        ratios = np.array([float(each["active_ratio"]) for each in here])
        is_burst = ratios > float(separated["threshold_active_ratio"])
        assert is_burst.tolist() == [each["is_burst"] == "1" for each in here]
        between = is_burst.mean() * (1 - is_burst.mean()) * (ratios[is_burst].mean() - ratios[~is_burst].mean()) ** 2
        assert float(separated["separability"]) == pytest.approx(between / ratios.var())
        conditions = [each for each in of_condition if each["at_min"] == row["at_min"]]
        assert sum(int(each["non_bursts"]) for each in conditions) == len(kept)
        for each in conditions:
            x = [float(r["rate_hz"]) for r in here if r["condition"] == each["condition"] and r["is_burst"] == "0"]
            assert float(each["median_hz"]) == np.median(x)
            assert float(each["above_median"]) == pytest.approx(np.mean(np.array(x) >= np.median(kept)))
    array = rows(tiny_study / "tables/culture-array.csv")
    assert [row["channel"] for row in array if row["channel"]] == first.channels.label.tolist()
    counts = [np.count_nonzero(first.spike_channels == i) for i in range(32)]
    assert [float(row["rate_hz"]) for row in array[:32]] == pytest.approx(np.array(counts) / first.duration_s)
    stimulated = {int(row["electrode"]) for row in array if row["is_stimulated"] == "1"}
    assert stimulated == set(first.stimuli.electrodes.ravel().tolist()) - {-1}


@pytest.mark.oracle
def test_the_numbers_of_a_robot_s_figures_are_those_of_its_tables(tiny_study: Path) -> None:
    parts: dict[tuple[str, str], list[tuple[float, int, float]]] = defaultdict(list)
    for row in rows(tiny_study / "tables/learning-curves.csv"):
        numbers = float(row["iterations"]), int(row["episodes"]), float(row["mean_return"] or 0)
        parts[row["arm"], row["policy"]].append(numbers)
    learning = rows(tiny_study / "tables/navigation-learning.csv")
    # In 40 iterations of each of eight environments all of them end an episode.
    round_of = 40 * 8
    for row in learning:
        end, of = float(row["iterations"]), []
        for (arm, _), each in parts.items():
            within = [(n, mean) for at, n, mean in each if end - round_of < at <= end]
            if arm == row["arm"] and end >= round_of and (n := sum(n for n, _ in within)):
                of.append(sum(n * mean for n, mean in within) / n)
        assert int(row["policies"]) == len(of)
        if not of:
            assert row["mean_return"] == row["low_95"] == row["high_95"] == ""
            continue
        assert float(row["mean_return"]) == pytest.approx(np.mean(of))
        if len(of) < 2:
            assert row["low_95"] == row["high_95"] == ""
            continue
        known = ttest_1samp(of, 0.0).confidence_interval(0.95)
        limits = Navigation(episode_limit=40).return_range
        assert [float(row["low_95"]), float(row["high_95"])] == pytest.approx(np.clip([known.low, known.high], *limits))
    course = rows(tiny_study / "tables/navigation-over-time.csv")
    assert {row["arm"] for row in course} == {"before training", "1 threshold", "control"}
    for row in course:
        returns = defaultdict(list)
        for each in episodes_in(tiny_study, arm=row["arm"], at_min=row["at_min"], over_time="True"):
            returns[each["actor"]].append(float(each["return"]))
        means = [np.mean(of_policy) for of_policy in returns.values()]
        quartiles = [float(row[name]) for name in ("lower_quartile", "median", "upper_quartile")]
        assert quartiles == pytest.approx(np.quantile(means, [0.25, 0.5, 0.75]))
        assert int(row["policies"]) == len(means) == 2


@pytest.mark.oracle
def test_the_report_ends_with_the_study_as_a_file(tiny_study: Path, tmp_path: Path) -> None:
    (written,) = re.findall("<pre>(.*?)</pre>", (tiny_study / "report.html").read_text(), re.DOTALL)
    (tmp_path / "study.toml").write_text(html.unescape(written))
    assert read_study(tmp_path / "study.toml") == read_study(TINY)


@pytest.mark.oracle
def test_the_report_asks_nothing_of_a_network(tiny_study: Path) -> None:
    page = (tiny_study / "report.html").read_text()
    without_data = re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", page)
    assert not re.search(r"https?:|//[a-z]|<script|<link|@import|url\(", without_data)
    for target in re.findall(r'href="([^"]+)"', without_data):
        assert (f'id="{target[1:]}"' in page) if target.startswith("#") else (tiny_study / target).is_file(), target


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (None, "–"),
        (3.0, "3"),
        (-1.0, "−1"),
        (0.00018264, "0.000183"),
        (-79.4567, "−79.5"),
        ("<b>", "<b>"),
        (float("nan"), "–"),
        (float("inf"), "∞"),
        (-float("inf"), "−∞"),
        (2.5e6, "2.50e+06"),
        (1_905_088, "1,905,088"),
        (-1234.5, "−1,234"),
        (-0.0, "0"),
        (999.4, "999"),
        (999.96, "1,000"),
        (22.96, "23.0"),
        (116.9, "117"),
    ],
)
def test_cells_are_short(value: object, written: str) -> None:
    assert cell(value) == written


@pytest.mark.parametrize(
    ("value", "error", "written"),
    [
        (-78.63, 1.128, "−78.6 ± 1.1"),
        (104.2, 12.3, "104 ± 12"),
        (22.4071, 0.00393, "22.407 ± 0.004"),
        (119.98, 7.6e-6, "119.980 ± < 0.001"),
        (120.0, 0.0, "120.0 ± 0.0"),
        (-0.002, 0.41, "0.00 ± 0.41"),
        (-1234.5, 1093.0, "−1,234 ± 1,093"),
        (3.0, None, "3 ± –"),
        (3.0, float("nan"), "3 ± –"),
    ],
)
def test_a_value_has_as_many_digits_as_its_error(value: float, error: float | None, written: str) -> None:
    assert with_error(value, error).replace("\u00a0", " ") == written


# --- the specification ----------------------------------------------------------------------------------------------


ODD = replace(read_study(TINY), title='odd \x7f \\ " \u2028 signs')


@pytest.mark.parametrize("study", [paper_study(), paper_study(3, quick=True), read_study(TINY), ODD])
def test_a_study_written_as_toml_is_read_as_the_same(study: Study, tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(study_to_toml(study))
    assert read_study(tmp_path / "study.toml") == study


def test_what_is_written_of_given_recordings_is_what_is_known_of_them() -> None:
    written = study_to_toml(read_study(TINY)).partition("[culture]")[2].partition("[[")[0].split()
    assert [word for word in written if word in ("files", "order", "sessions", "trials", "seed")] == ["files"]


def test_the_paper_is_kept_to() -> None:
    study = paper_study()
    assert (study.policies, study.culture.sessions, study.culture.interval_min) == (10, 15, 10.0)
    assert [spec.trained_for for spec in study.robots] == [800_000, 500_000]
    assert {(c.at_min, c.episodes) for c in study.comparisons} == {(0.0, 30), (140.0, 100)}
    assert {(c.name, spec.name) for c in study.comparisons for spec in study.robots} == set(PRINTED)
    assert {job.name.split("/")[0] for job in plan_study(paper_study(quick=True), Path())} == {
        job.name.split("/")[0] for job in plan_study(study, Path())
    }


COMPARED = (
    "[[arms]]\nname = '1 threshold'\n[[arms]]\nname = 'b'\n"
    "[[comparisons]]\nname = 'a'\nfirst = '1 threshold'\nsecond = 'b'\nat_min = {}"
)


@pytest.mark.parametrize(
    ("toml", "said"),
    [
        ("policies = 0", "policies: expected at least 1, got 0"),
        ("policies = 2.5", "policies: expected a whole number, got 2.5"),
        ("polices = 2", "polices: no such setting at the top"),
        ("polices = 2", "; did you mean policies?"),
        ("policies = ", "expected TOML"),
        ("# nothing yet", "expected the settings of a study, got none"),
        ("seed = true", "seed: expected a whole number, got True"),
        ("arms = []", "arms: expected at least one"),
        ("robots = 'cartpole'", "robots: expected a list"),
        (
            "[[robots]]\nname = 'cart'",
            f"robot: expected one of {NAMES}, got 'cart'",
        ),
        ("[[robots]]\niterations = 3", "robots.name: expected to be given"),
        ("[[robots]]\nname = 'cartpole'\nparameters = { mass = 1 }", "parameters: cartpole: expected parameters"),
        (
            "[[robots]]\nname = 'cartpol'",
            f"robots.name: robot: expected one of {NAMES}, got 'cartpol';",
        ),
        (
            "[[robots]]\nname = 'a'\nkind = 'b'",
            f"robots.kind: robot: expected one of {NAMES}, got 'b';",
        ),
        ("[robots.cartpole]\niterations = 3", "robots: expected [[robots]] for each, and its name in it, got [robots."),
        ("[[arms]]\nname = 'a/b'", "arms.name: expected letters"),
        ("[[arms]]\nname = '10'", "which would be read as a number in a table"),
        ("[[arms]]\nname = 'NA'", "which would be read as missing in a table"),
        (
            "[[arms]]\nname = 'a'\n[[arms]]\nname = 'A'",
            "expected each name once, got 'a' 2 times: capitals, and spaces for dashes, make no difference",
        ),
        (
            "[[arms]]\nname = 'a'\n[[arms]]\nname = 'b'\n"
            + "[[comparisons]]\nname = 'c'\nfirst = 'a'\nsecond = 'b'\n" * 2,
            "comparisons: expected each name once, got 'c' 2 times",
        ),
        ("[[arms]]\nname = 'a'\nmapping = '2'", "arms.mapping: expected one of"),
        ("[[arms]]\nname = 'a'\nmapping = '2'", "name your own by its module:Class; none is without neurons"),
        ("[tune]\ntrials = 3", "expected a study, got the file of a tuning, with [tune]: use animat tune"),
        (
            "[[arms]]\nname = 'a'\ndelivery = 'none'",
            "arms.delivery: expected 'chosen' or 'shuffled', got 'none'",
        ),
        ("[[comparisons]]\nname = 'a'\nfirst = 'b'\nsecond = 'c'", "comparisons.first: expected one of the arms"),
        (
            "[[comparisons]]\nname = 'a'\nfirst = 'b'\nsecond = 'b'",
            "comparisons.second: expected an arm other than the first",
        ),
        ("[culture]\nkind = 'alive'", "culture.kind: expected 'virtual' or 'files', got 'alive'"),
        (
            "[culture]\nkind = 'files'",
            "culture.files, folders: expected files or folders with kind = 'files', got none",
        ),
        ("[culture]\nsessions = 0", "culture.sessions: expected at least 1"),
        ("[culture]\ninterval_min = inf", "culture.interval_min: expected a finite number, got inf"),
        ("[simulators]\nwindow_ms = [2]", "simulators.window_ms: expected at least 2 values"),
        (
            "[culture]\nkind = 'files'\nfiles = ['a.nwb']\npulses = 5",
            "culture.pulses: expected only for a culture that",
        ),
        ("[[robots]]\nname = 'cartpole'\nparameters = { name = 1 }", "expected parameters among"),
        ('[[arms]]\nname = "a"\nshadowng = [true, false]', "shadowng: no such setting in [arms]"),
        ('[[arms]]\nname = "a"\nshadowing = "off"', "arms.shadowing: expected True, False or 'drawn', got 'off'"),
        ("[culture]\nfrequencies_hz = [20]", "expected two or more for an agent to choose from, got one (20 Hz)"),
        (
            "[culture]\nplaces = 'corners'\n[simulators]\nconditions = 'frequency'",
            "agent to choose from, got one (20 Hz)",
        ),
        (
            "[simulators]\nconditions = 'all'",
            "simulators.conditions: expected two or more for an agent to choose from, got one (all)",
        ),
        ("[algorithm]\nhiden = 8", "hiden: no such setting in [algorithm]; expected some of environments"),
        ("[algorithm]\nhidden = 'x'", "algorithm.hidden: expected a number"),
        ("[algorithm]\nhidden = 64.0", "algorithm.hidden: expected a whole number, got 64.0"),
        ("seed = 9999999999", "seed: expected at most 4,294,967,295, got 9999999999"),
        ("[culture]\nseed = -1", "culture.seed: expected at least 0, got -1"),
        ("[simulators]\nbins = 0", "simulators.bins: expected 1 to"),
        ("[simulators]\nrange_hz = -5", "simulators.range_hz: expected a positive frequency in Hz, got -5"),
        ("[simulators]\nwindow_ms = [10, 2]", "simulators.window_ms: expected 0 <= start < end"),
        ("[simulators]\nburst_threshold = 7", "simulators.burst_threshold: expected at most 1, got 7"),
        (
            "[simulators]\ndespite = ['drift']\nallow = []",
            "despite: no such setting in [simulators]; expected some of kind",
        ),
        ("[simulators]\ndespite = ['drift']", "simulators.allow: expected findings among no-stimuli"),
        ("[simulators]\nconditions = 'bogus'", "simulators.conditions: expected one of all, frequency"),
        *[
            (f"{table}{name} = {10**18}", f"{name}: expected at most")
            for table, name in (
                ("", "policies"),
                ("", "episodes"),
                ("", "episodes_over_time"),
                ("", "optimum_episodes"),
                ("[culture]\n", "sessions"),
                ("[culture]\n", "trials"),
                ("[[robots]]\nname = 'cartpole'\n", "iterations"),
                ("[algorithm]\n", "hidden"),
                ("[algorithm]\n", "environments"),
            )
        ],
        ("policies = 1000\nepisodes = 5001", "episodes: expected at most 5,000,000 of all policies together"),
        (
            "policies = 1000\narms = [{name = 'a'}, {name = 'b'}]\nrobots = ["
            + ", ".join(f"{{name = 'r{i}', kind = 'cartpole'}}" for i in range(11))
            + "]",
            "policies: expected at most 20,000 in a study, got 22,000",
        ),
        ("optimum_resolution = 3.0", "optimum_resolution: expected at most 2, got 3"),
        ("[culture]\ninterval_min = 1e9", "expected recordings within a year"),
        ("[culture]\nfrequencies_hz = []", "culture.frequencies_hz: expected at least 1, got "),
        ("[culture]\nchannels = 32", "channels: no such setting in [culture]; expected some of kind, files"),
        (f"policies = {'9' * 5000}", "expected TOML, got malformed text: Exceeds the limit (4300 digits)"),
        (f"policies = 0x{'f' * 5000}", "policies: expected at most 1,000, got a number of 20,000 bits"),
        (f"training_min = 0x{'f' * 5000}", "training_min: expected a number, got a number of 20,000 bits"),
        (f"title = {'[' * 20_000}", "nested too deeply"),
        (f"title = {'{a=' * 20_000}", "nested too deeply"),
        (f"{'a.' * 4_000}b = 1", "a: no such setting at the top"),
        ("'a\\nb' = 1", "a\\nb"),
        (f"arms = [{'{name = 1},' * 1001}]", "arms: expected at most 1,000, got 1,001"),
        (f"culture = {{files = {['a'] * 1001}}}", "culture.files: expected at most 1,000 entries, got "),
        ("#" * 2**20 + "\n", "expected a text file of at most 1,048,576 bytes, got a larger file"),
        ("[culture]\nkind = 'files'\nfiles = ['']", "culture.files: expected names of files, got ''"),
        ('[culture]\nkind = "files"\nfiles = ["a\\u0000b"]', "culture.files: expected names of files"),
        (COMPARED.format("nan"), "comparisons.at_min: expected a finite number, got nan"),
        (COMPARED.format("500"), "comparisons.at_min: expected a minute of the recordings, from 0 to 140, got 500"),
        (COMPARED.format("-20"), "comparisons.at_min: expected a minute of the recordings, from 0 to 140, got -20"),
    ],
)
def test_mistakes_in_a_specification_are_reported_in_one_line(
    toml: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "study.toml"
    path.write_text(toml)
    assert main(["study", str(path), "--out", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert said in error and "study.toml: " in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("file", ["/dev/zero", "pipe", "folder", "none.nwb", "a" * 5000])
def test_files_that_cannot_be_recordings_are_reported_in_one_line(
    file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    path = tmp_path / "study.toml"
    path.write_text(f"[culture]\nkind = 'files'\nfiles = ['{file}']")
    assert main(["study", str(path), "--out", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and file[:100] in error and not (tmp_path / "out").exists()


def test_the_page_states_the_bounds_of_a_study() -> None:
    page = (Path(__file__).parents[1] / "docs" / "studies.md").read_text()
    for stated in ("1,000", "20,000", "10,000", "5,000,000", "1,000,000", "1,024", "2,000,000,000", "a year", "1 MiB"):
        assert stated in page


def test_choices_are_checked_from_python_too() -> None:
    for make in (
        lambda: Source(kind="alive"),  # type: ignore[arg-type]
        lambda: Simulators(kind="exact"),  # type: ignore[arg-type]
        lambda: Arm("a", delivery="none"),  # type: ignore[arg-type]
        lambda: Study(actions="best"),  # type: ignore[arg-type]
    ):
        with pytest.raises(InvalidArgument, match=r"(kind|delivery|actions): expected '\w"):
            make()


PAIR = (Arm("1 threshold"), Arm("control", delivery="shuffled"))


def test_comparisons_are_made_at_the_nearest_recording() -> None:
    def at(minutes: list[float | None], start_min: list[float]) -> list[float | None]:
        compared = tuple(Compared(f"c{i}", "1 threshold", "control", at) for i, at in enumerate(minutes))
        study = Study(culture=Source("files", files=("a.nwb",)), arms=PAIR, comparisons=compared)
        return [each.at_min for each in study.at_recordings(start_min).comparisons]

    start_min = [0.0, 10.02, 60.0]
    assert at([None, 0.0, 10.0, 36.0, 59.98, 70.0, -1.0], start_min) == [60.0, 0.0, 10.02, 60.0, 60.0, 60.0, 0.0]
    assert at([None, 500.0], []) == [0.0, 0.0]
    assert at([5.0], [0.0]) == [0.0]
    for beyond in (-60.0, 120.0):
        with pytest.raises(InvalidArgument, match=r"at_min: expected a minute of the recordings, from 0 to 60, got"):
            at([beyond], start_min)


@pytest.mark.oracle
def test_a_comparison_moved_to_another_minute_is_reported(tmp_path: Path) -> None:
    write_synthetic_series(1, tmp_path / "made", sessions=2, interval_min=30.0, patterns=10, channels=16)
    moved = Compared("before and after", "1 threshold", "control", at_min=29.0)
    study = Study(
        culture=Source("files", files=("made",)),
        arms=PAIR,
        comparisons=(moved, replace(moved, name="b", at_min=30.0)),
    )
    MakeRecordings(study, tmp_path).run(tmp_path / "study", Silent())
    kept, _ = FitSimulators(study).run(tmp_path / "study", Silent())
    (finding,) = [finding for finding in load_timeline(kept).findings if finding.name == "comparison-minute"]
    assert finding.message == "before and after was requested at 29 min and is made on the recording at 30 min"
    with pytest.raises(InvalidArgument, match="at_min"):
        FitSimulators(replace(study, comparisons=(replace(moved, at_min=99.0),))).run(tmp_path / "study", Silent())


@pytest.mark.oracle
def test_recordings_that_leave_nothing_to_choose_are_refused(tmp_path: Path) -> None:
    write_synthetic_series(1, tmp_path / "made", sessions=1, patterns=10, channels=16)
    one = Study(culture=Source("files", files=("made",)), simulators=Simulators(conditions="all"))
    MakeRecordings(one, tmp_path).run(tmp_path / "study", Silent())
    with pytest.raises(UnusableData, match=r"simulators\.conditions: expected two or more .* got one \(all\)"):
        FitSimulators(one).run(tmp_path / "study", Silent())
    knowing = replace(one, simulators=Simulators(conditions="all", allow=("one-condition",)))
    kept, _ = FitSimulators(knowing).run(tmp_path / "study", Silent())
    assert len(load_timeline(kept).conditions) == 1
    with pytest.raises(UnusableData, match=r"simulators\.conditions: expected two or more"):
        FitVariant(one).run(tmp_path / "study", Silent())
    (kept,) = FitVariant(knowing).run(tmp_path / "study", Silent())
    assert len(load_timeline(kept).conditions) == 1


def test_no_two_arms_or_controls_share_a_file(tmp_path: Path) -> None:
    names = ("a", "a paths", "a over-time", "controls", "controls-1-threshold", "over-time")
    spec = RobotSpec("navigation")
    arms = [Arm(name, percentiles=held) for name in names for held in ("moving", "first")]
    paths_file = partial(episodes_file, what="paths")
    places = {of(tmp_path, spec, arm) for arm in arms for of in (episodes_file, controls_file, paths_file)}
    # An arm's name is its own, whether its percentiles are fixed or not; controls differ by that.
    assert len(places) == 2 * len(names) + 2


def test_a_missing_file_is_reported_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", str(tmp_path / "none.toml"), "--out", str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err.endswith("none.toml: no such file\n")
    with pytest.raises(InvalidArgument, match="workers"):
        run_study(read_study(TINY), tmp_path / "out", workers=0)
    with pytest.raises(InvalidArgument, match="workers: expected None with an executor"):
        run_study(read_study(TINY), tmp_path / "out", workers=2, executor=Halts())
    assert not (tmp_path / "out").exists()


def test_files_with_a_byte_order_mark_are_read_as_without(tmp_path: Path) -> None:
    """Editors of Windows write one; it was malformed text."""
    texts = {"study.toml": TINY.read_text(), "lessons.toml": '[[lessons]]\nname = "é"\n', "slow.json": '{"trials": 7}'}
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
    assert read_study(tmp_path / "study.toml") == read_study(TINY)
    assert [lesson.name for lesson in read_lessons(tmp_path / "lessons.toml")] == ["é"]
    assert read_protocol(tmp_path / "slow.json") == Protocol(trials=7)
    (tmp_path / "twice.toml").write_text("\ufeff" + TINY.read_text(), encoding="utf-8-sig")
    with pytest.raises(InvalidFile, match="expected TOML"):
        read_study(tmp_path / "twice.toml")


def test_the_specifications_on_the_page_are_read(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "studies.md").read_text()
    blocks = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 4
    for block in blocks:
        (tmp_path / "study.toml").write_text(block)
        assert read_study(tmp_path / "study.toml").arms


# --- jobs -----------------------------------------------------------------------------------------------------------


def test_every_need_of_a_plan_is_a_job_of_it() -> None:
    for study in (paper_study(), read_study(TINY), Study(arms=(Arm("direct", mapping="none"),))):
        jobs = in_order(plan_study(study, Path()))
        names = [job.name for job in jobs]
        assert len(set(names)) == len(names)
        for place, job in enumerate(jobs):
            assert set(job.needs) <= set(names[:place]), job.name


def test_recordings_at_hand_are_copied_and_fitted(tmp_path: Path) -> None:
    write_synthetic_series(1, tmp_path / "made", sessions=2, interval_min=30.0, patterns=10, channels=16)
    study = Study(culture=Source("files", files=("made",)), simulators=Simulators(kind="empirical"))
    folder = tmp_path / "study"
    copies = MakeRecordings(study, tmp_path).run(folder, Silent())
    assert [path.name for path in copies] == ["recording_0000_min.nwb", "recording_0030_min.nwb"]
    for copy in copies:
        assert read_recording(copy).equals(read_recording(tmp_path / "made" / copy.name))
    kept, responses = FitSimulators(study).run(folder, Silent())
    timeline = load_timeline(kept)
    fitted = fit_timeline(extract_series(read_recordings(tmp_path / "made")), kind="empirical")
    for one, other in zip(jax.tree.leaves(timeline.simulators), jax.tree.leaves(fitted.simulators), strict=True):
        np.testing.assert_array_equal(one, other)
    for name in ("conditions", "window_ms", "presentation", "findings"):
        assert getattr(timeline, name) == getattr(fitted, name)
    assert len(rows(responses)) == 2 * 5 * 10


@pytest.mark.oracle
def test_a_study_of_files_without_comparisons_runs_on_another_executor(tmp_path: Path) -> None:
    write_synthetic_series(1, tmp_path / "made", sessions=1, patterns=10, channels=16)
    study = replace(
        read_study(TINY),
        culture=Source("files", files=("made",)),
        arms=(Arm("held", percentiles="first"),),
        comparisons=(),
        policies=1,
        paper=False,
    )
    ran: StudyRun = run_study(study, tmp_path / "study", base=tmp_path, executor=ThreadPoolExecutor(1))
    assert len(ran.done_now) == ran.jobs
    page = ran.report.read_text()
    assert "The study compares no arms" in page
    assert "Differences from the paper" not in page


@pytest.mark.parametrize("mapping", ["1-threshold", "9-thresholds"])
def test_the_heuristic_policy_goes_where_it_should(mapping: str) -> None:
    simulator = synthetic_simulator()
    for robot, lean_right in (
        (Cartpole(), [0.0, 0.0, 0.05, 0.0]),
        # At the top, looking right: the goal is below, which is clockwise.
        (Navigation(), [0.5, 0.0, 0.0]),
    ):
        environment: Animat[Any] = Animat(robot, mapping_named(mapping), 5)
        rule = heuristic_policy(environment, simulator)
        seen = np.array([lean_right, lean_right]) / environment.scales
        if isinstance(robot, Cartpole):
            seen[1] *= -1
        else:
            seen[1, 1] = 0.95  # below the goal
        actor = jax.tree.map(lambda leaf: leaf[0], rule)
        # The synthetic means rise with the frequency.
        assert actor.act(environment, jnp.asarray(seen), jnp.zeros((2, 1))).tolist() == [4, 0]
