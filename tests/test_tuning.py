"""Tuning: the same journal whatever happens, the better ones go on, and one program for many settings."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.cli import main
from animat.errors import AnimatError, InvalidFile, Mismatch
from animat.neurons.synthetic import synthetic_simulator
from animat.neurons.timeline import fit_timeline
from animat.progress import Silent
from animat.responses.extraction import extract_responses
from animat.studies.source import Source
from animat.studies.toml import read_study
from animat.training.group import programs, split_groups
from animat.training.policy import CURVE
from animat.training.settings import SAC
from animat.training.specification import CHUNKS, Training
from animat.tuning import tasks
from animat.tuning.results import BEST, HISTORY, RESULTS, Final, TuningResult, write_results
from animat.tuning.run import tune
from animat.tuning.search import JOURNAL, Trial, read_journal
from animat.tuning.specification import Range, Tuning, first_settings, read_tuning, tuning_of, with_settings
from animat.tuning.tasks import TrialsSideBySide, group_by_shape
from synthetic_recordings import synthetic_recording

pytest.importorskip("optuna", reason="animat tune needs the extra [tune]")

TINY = Path(__file__).parent / "tiny_tuning.toml"
SMALL = SAC(environments=8, gradient_steps=2, batch=16, replay=512, hidden=8)


class Ends(ThreadPoolExecutor):
    """An executor in this process that does a number of tasks, and then fails, as a machine does."""

    def __init__(self, room: int) -> None:
        super().__init__(1)
        self.room = room

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(self._within_room, fn, *args, **kwargs)

    def _within_room(self, fn: Any, *args: Any, **kwargs: Any) -> Any:
        self.room -= 1
        if self.room < 0:
            raise AnimatError("the machine is gone")
        return fn(*args, **kwargs)


class In64Bits(ThreadPoolExecutor):
    """Of a user whose program computes in 64 bits."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        def in_64_bits() -> Any:
            with jax.enable_x64(True):
                return fn(*args, **kwargs)

        return super().submit(in_64_bits)


def run(folder: Path, executor: Executor | None = None, tuning: Tuning | None = None) -> TuningResult:
    """In this process, where programs are compiled once."""
    with ThreadPoolExecutor(1) as own:
        return tune(tuning or read_tuning(TINY), folder, base=TINY.parent, executor=executor or own)


def left(folder: Path) -> dict[str, bytes]:
    """What a search leaves to be read; the recordings have dates of their own."""
    names = [JOURNAL, BEST, RESULTS, HISTORY, "tune.json", *(f"finals/{f.name}" for f in (folder / "finals").iterdir())]
    return {name: (folder / name).read_bytes() for name in names}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tunings") / "tiny"
    run(folder)
    return folder


@pytest.mark.oracle
def test_stopped_after_every_few_tasks_it_ends_in_the_same_bytes(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time with room for five tasks more than all before, and after each chunk a checkpoint to go on from."""
    monkeypatch.setattr(tasks, "CHECKPOINT_S", -1.0)
    stops = 0
    for _ in range(30):
        try:
            with Ends(5) as executor:
                run(tmp_path / "out", executor)
            break
        except AnimatError as error:
            assert "the machine is gone" in str(error)
            stops += 1
    assert stops >= 2
    assert left(tmp_path / "out") == left(finished)
    assert not (tmp_path / "out" / ".unfinished").exists()


@pytest.mark.oracle
def test_a_trial_that_was_stopped_between_two_chunks_goes_on_from_there(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "CHECKPOINT_S", -1.0)
    trained, train = [], TrialsSideBySide.train

    def fails_now_and_then(self: TrialsSideBySide, index: int, *simulators: Any) -> float:
        trained.append(index)
        if len(trained) in (7, 40, 90):
            raise AnimatError("out of power")
        return train(self, index, *simulators)

    monkeypatch.setattr(TrialsSideBySide, "train", fails_now_and_then)
    for _ in range(3):
        with pytest.raises(AnimatError, match="out of power"):
            run(tmp_path / "out")
        # What it was about to train is what comes next.
        before = trained[-1]
        assert list((tmp_path / "out" / ".unfinished").rglob("*-of-60.npz"))
        trained.append(before)
    run(tmp_path / "out")
    assert left(tmp_path / "out") == left(finished)


def test_the_better_ones_of_each_generation_go_on_and_the_study_s_own_settings_always(finished: Path) -> None:
    trials, settings = read_journal(finished), read_tuning(TINY).tune
    assert [each.trial for each in trials] == list(range(7))
    for first in (0, 4):
        generation = trials[first : first + 4]
        ranked = sorted(generation, key=lambda each: -each.means[0])
        # One in three of four or of three, more than that never but for the study's own.
        n = -(-len(generation) // settings.keep)
        on = {each.trial for each in ranked[:n]} | ({0} if first == 0 else set())
        assert {each.trial for each in generation if each.state == "complete"} == on
    assert all(each.chunks == ((20, 60) if each.state == "complete" else (20,)) for each in trials)
    assert trials[0].settings == {"learning_rate": 1e-3, "discount": 0.99, "simulator": "histogram"}


def test_no_two_policies_of_a_final_meet_the_same_episodes(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = []

    def roll_out(*_: Any, episodes: int, seed: int) -> Any:
        seeds.append(seed)
        return SimpleNamespace(returns=np.zeros((1, episodes)))

    monkeypatch.setattr(tasks, "roll_out", roll_out)
    monkeypatch.setattr(TrialsSideBySide, "train", lambda *_: None)
    study = read_tuning(TINY).study
    settings, place = first_settings(study, read_tuning(TINY).space)[0], "finals-of-six"
    trial = Trial(0, settings, "complete", (), ())
    for group in split_groups(6):
        tasks.TrainTrials(study, (trial,), group[:1], (1, 2), 5, (0, CHUNKS), place).run(finished, Silent())
    shutil.rmtree(finished / place)
    assert len(set(seeds)) == 2
    assert seeds[0] == 2, "the results of up to five policies are what they were"


def test_the_best_is_a_study_of_the_settings_that_won(finished: Path) -> None:
    results = json.loads((finished / RESULTS).read_text())
    best = max(results["finals"], key=lambda row: row["mean_return"])
    assert results["best"] == {"trial": best["trial"], "settings": best["settings"]}
    assert {row["trial"] for row in results["finals"]} >= {0}
    study = read_study(finished / BEST)
    tiny = with_settings(read_tuning(TINY).study, best["settings"])
    assert study == replace(tiny, culture=Source("files", files=("recordings",)))
    assert (
        (finished / BEST)
        .read_text()
        .startswith("# To run it, in the folder where animat tune was run: animat study <this file>\n")
    )


def test_a_finished_folder_is_reported_again_and_nothing_is_trained(finished: Path) -> None:
    before = {file: file.stat().st_mtime_ns for file in (finished / "finals").iterdir()}
    with Ends(0) as executor:
        assert run(finished, executor).best.mean > -100
    assert before == {file: file.stat().st_mtime_ns for file in (finished / "finals").iterdir()}


def test_a_folder_of_another_search_is_refused_and_so_is_a_journal_of_one(finished: Path, tmp_path: Path) -> None:
    tuning = read_tuning(TINY)
    with pytest.raises(Mismatch, match=r"tune\.seed"):
        run(finished, tuning=replace(tuning, tune=replace(tuning.tune, seed=9)))
    out = tmp_path / "out"
    out.mkdir()
    (out / "tune.json").write_bytes((finished / "tune.json").read_bytes())
    changed = (finished / JOURNAL).read_text().replace('"learning_rate": 0.001,', '"learning_rate": 0.002,', 1)
    (out / JOURNAL).write_text(changed)
    with pytest.raises(InvalidFile, match="other settings in trials 0 to 3"):
        run(out)
    (out / JOURNAL).write_text(changed[:100])
    with pytest.raises(InvalidFile, match="journal"):
        run(out)


@pytest.mark.oracle
def test_a_diverging_trial_is_reported_and_leaves_the_others_finite(tmp_path: Path) -> None:
    """Side by side in one program; its learning rate is beyond what float32 can add up."""
    plain = read_tuning(TINY)
    search = {"learning_rate": [1e-3, 1e38], "discount": {"low": 0.9, "high": 0.999}}
    made = tuning_of(plain.study, replace(plain.tune, trials=4, finalists=1, seed=2, search=search))
    run(tmp_path / "out", tuning=made)
    trials = read_journal(tmp_path / "out")
    for each in trials:
        assert (each.state == "diverged") == (each.settings["learning_rate"] == 1e38)
    assert {each.state for each in trials} >= {"complete", "diverged"}
    assert trials[0].state == "complete"


@pytest.mark.oracle
def test_where_programs_compute_in_64_bits_trials_learn_the_same(finished: Path, tmp_path: Path) -> None:
    with In64Bits(1) as executor:
        run(tmp_path, executor)
    assert left(tmp_path) == left(finished)


@pytest.mark.oracle
@pytest.mark.parametrize("mapping", ["9-thresholds", None])
def test_settings_as_arrays_train_as_those_that_are_compiled_in(mapping: str | None) -> None:
    """Against the program of ordinary training, one for each of the settings; alike but for rounding."""
    algorithms = [
        SMALL,
        replace(SMALL, learning_rate=3e-3, discount=0.7, tau=0.2, reward_scale=0.5),
        replace(SMALL, initial_alpha=0.7, target_entropy_ratio=0.6, entropy_nats=-0.3),
    ]
    training = Training("navigation", mapping, policies=2, iterations=8 * 12 * CHUNKS, seed=4)
    simulator = None if mapping is None else synthetic_simulator()
    timeline = None if mapping is None else fit_timeline([extract_responses(synthetic_recording(1, patterns=40))])
    together = TrialsSideBySide(training, timeline, algorithms, (0, 1))
    together.train(0, simulator)
    # The diagnosis would be by the usual settings.
    assert np.isnan(together.curve[0][:, CURVE.index("entropy") :]).all() and np.isfinite(together.curve[0][:, 0]).all()
    found = []
    for i, algorithm in enumerate(algorithms):
        beginning, chunk = programs(training.environment_on(timeline), algorithm)
        keys = jnp.stack([jax.random.fold_in(jax.random.key(4), member) for member in (0, 1)])
        learners, _ = chunk(beginning(keys), simulator, jnp.int32(0), jnp.int32(12))
        networks = together.networks(i, greedy=True)
        assert networks is not None
        for ours, theirs in zip(networks.network, learners.deployed, strict=True):
            np.testing.assert_allclose(ours.weight, theirs.weight, rtol=2e-3, atol=2e-5)
            np.testing.assert_allclose(ours.bias, theirs.bias, rtol=2e-3, atol=2e-5)
        found.append(np.asarray(networks.network[0].weight))
    # Settings that made no difference would pass, too.
    assert np.abs(found[0] - found[1]).max() > 1e-3 and np.abs(found[0] - found[2]).max() > 1e-5


@pytest.mark.parametrize("policies", [1, 2, 3, 7])
def test_trials_of_one_program_are_together_five_policies_at_most(policies: int) -> None:
    rng = random.Random(policies)
    for n in range(1, 12):
        among = [
            {"tau": rng.random(), "mapping": rng.choice(["linear", "1-threshold"]), "batch": rng.choice([8, 9])}
            for _ in range(n)
        ]
        trials = [Trial(i, settings, "complete", (), ()) for i, settings in enumerate(among)]
        groups = group_by_shape(trials, policies)
        assert sorted(trial.trial for group in groups for trial in group) == list(range(n))
        for group in groups:
            assert len(group) * policies <= max(5, policies)
            assert len({(t.settings["mapping"], t.settings["batch"]) for t in group}) == 1


@pytest.mark.oracle
def test_after_a_study_s_own_settings_the_defaults_are_tried_and_both_go_to_the_end(tmp_path: Path) -> None:
    file = tmp_path / "tune.toml"
    own = TINY.read_text().replace("hidden = 8 }", "hidden = 8, learning_rate = 1e-4, discount = 0.95 }")
    file.write_text(own.replace("trials = 7", "trials = 4").replace("3000", "240").replace("rungs = 2", "rungs = 3"))
    tuned = tune(read_tuning(file), tmp_path / "out", base=TINY.parent)
    kind = {"simulator": "histogram"}
    assert tuned.trials[0].settings == {"learning_rate": 1e-4, "discount": 0.95, **kind}
    assert tuned.trials[1].settings == {"learning_rate": SAC().learning_rate, "discount": SAC().discount, **kind}
    assert [len(each.chunks) for each in tuned.trials[:2]] == [3, 3]
    assert [each.trial for each in tuned.finals[:2]] == [0, 1]
    file.write_text(own.replace("high = 0.999", "high = 0.98"))
    tuning = read_tuning(file)
    assert len(first_settings(tuning.study, tuning.space)) == 1, "defaults outside the search are not tried"


def test_a_discount_is_drawn_evenly_in_the_logarithm_of_its_distance_from_1(tmp_path: Path) -> None:
    from scipy.stats import kstest, uniform

    from animat.tuning.search import Search

    text = TINY.read_text()
    assert "high = 0.999 }" in text
    file = tmp_path / "tune.toml"
    file.write_text(text.replace("high = 0.999 }", "high = 0.999, log = true }"))
    drawn = [settings["discount"] for settings in Search(read_tuning(file)).ask(300)]
    assert drawn[0] == 0.99, "the study's own is tried first, and as it is written"
    exponents = np.log10(1 - np.array(drawn[1:], dtype=float))
    assert kstest(exponents, uniform(-3, 2).cdf).pvalue > 0.01


@pytest.mark.parametrize("discount", [0.1, 0.3, 0.45, 0.99])
def test_the_study_s_own_discount_is_tried_as_it_is_written(discount: float) -> None:
    """Searched by its distance from 1, from which not every number can be computed back."""
    from animat.tuning.search import Search

    plain = read_tuning(TINY)
    study = with_settings(plain.study, {"discount": discount})
    search = {"discount": {"low": discount, "high": 0.999, "log": True}, "tau": {"low": 0.001, "high": 0.05}}
    made = tuning_of(study, replace(plain.tune, search=search))
    own, *_ = Search(made).ask(2)
    assert own == {"discount": discount, "tau": 0.005}


def test_importance_finds_the_setting_that_decides() -> None:
    from animat.tuning.search import importance_of

    rng = np.random.default_rng(1)
    space = {"tau": Range(0.0, 1.0), "discount": Range(0.01, 0.99, True), "mapping": ("linear", "1-threshold")}
    results = []
    # However well it began.
    results.append(Trial(60, {"tau": 0.9, "discount": 0.5, "mapping": "linear"}, "diverged", (7,), ((1e6,),)))
    for i in range(60):
        settings: Any = {
            "tau": rng.random(),
            "discount": 0.01 + 0.98 * rng.random(),
            "mapping": ("linear", "1-threshold")[i % 2],
        }
        returns = -((settings["tau"] - 0.3) ** 2) + 1e-3 * rng.random()
        results.append(Trial(i, settings, "complete", (60,), ((float(returns),),)))
    shares = importance_of(space, results)
    assert next(iter(shares)) == "tau" and shares["tau"] > 0.8
    assert sum(shares.values()) == pytest.approx(1)
    assert importance_of(space, results[:3]) == {}


def test_what_diverged_after_a_rung_is_not_drawn_as_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures: list[Any] = []
    monkeypatch.setattr("animat.tuning.results.save_figure", lambda figure, _: figures.append(figure))
    settings = {"learning_rate": 1e-3, "discount": 0.99, "simulator": "histogram"}
    own = Trial(0, settings, "complete", (20, 60), ((1.0,), (2.0,)))
    stopped = Trial(1, settings, "stopped", (20,), ((0.0,),))
    diverged = Trial(2, settings, "diverged", (20,), ((9.0,),))
    finals = [Final(3, settings, (3.0,)), Final(0, settings, (1.0, 3.0, 5.0)), Final(2, settings, None)]
    tuned = write_results(tmp_path, read_tuning(TINY), [own, stopped, diverged], finals)
    assert tuned.best.trial == 0, "of two with the same mean, the one that was found first"
    counted = [(row["mean_return"], row["standard_error"]) for row in tuned.to_dict()["finals"]]
    assert counted == [(3.0, None), (3.0, pytest.approx(2 / 3**0.5)), (None, None)]
    drawn = {line.get_label(): list(line.get_xdata()) for line in figures[0].axes[0].lines}
    assert drawn["stopped at 33 %"] == [1]
    assert drawn["diverged"] == [2]


@pytest.mark.oracle
def test_killed_five_times_with_two_workers_it_ends_in_the_same_bytes(finished: Path, tmp_path: Path) -> None:
    """By SIGKILL, at any moment, in processes of their own; the other was one thread in this process."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "animat", "tune", str(TINY), "--out", str(out)]
    rng, kills = random.Random(5), 0
    while kills < 5:
        before = set(out.rglob("*"))
        began = subprocess.Popen([*command, "--workers", "1"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        # Something has been written by then on a machine of any speed, and not yet all.
        while began.poll() is None and set(out.rglob("*")) == before:
            time.sleep(0.05)
        time.sleep(rng.uniform(0, 1))
        if began.poll() is not None:
            break
        os.kill(began.pid, signal.SIGKILL)
        began.wait()
        kills += 1
    assert kills >= 2
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert left(out) == left(finished)


def test_the_command_prints_what_was_found(
    finished: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["tune", str(TINY), "--out", str(finished), "--json"]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    data = json.loads(last)
    assert data["trials"] == {"complete": 4, "stopped": 3, "diverged": 0}
    assert any("own settings" in line for line in lines)
    assert any(line.startswith("importance: ") for line in lines)
    assert any(str(finished / BEST) in line for line in lines)


def test_the_command_counts_a_single_trial_as_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"learning_rate": 1e-3, "discount": 0.99, "simulator": "histogram"}
    trial = Trial(0, settings, "complete", (20, 60), ((1.0,), (2.0,)))
    final = Final(0, settings, (2.0, 2.1))
    tuned = TuningResult(tmp_path, final, (final,), (trial,), {})
    monkeypatch.setattr("animat.tuning.run.tune", lambda *_, **__: tuned)
    assert main(["tune", str(TINY), "--out", str(tmp_path / "out")]) == 0
    assert "\n1 trial (1 complete) in " in capsys.readouterr().out


def test_there_is_no_importance_where_trials_cannot_tell() -> None:
    from animat.tuning.search import importance_of

    rng = np.random.default_rng(2)
    space = {"tau": Range(0.0, 1.0), "discount": Range(0.01, 0.99), "mapping": ("linear", "1-threshold")}

    def trials(returns: list[float]) -> list[Trial]:
        drawn = [{"tau": rng.random(), "discount": 0.5, "mapping": ("linear", "1-threshold")[i % 2]} for i in range(40)]
        return [
            Trial(i, settings, "complete", (60,), ((of,),))  # type: ignore[arg-type]
            for i, (settings, of) in enumerate(zip(drawn, returns, strict=False))
        ]

    # The best tenth of ten trials is one.
    assert importance_of(space, trials(rng.random(10).tolist())) == {}
    # Nearly all are equally bad, and so among the best tenth.
    assert importance_of(space, trials([0.0] * 37 + [1.0, 2.0, 3.0])) == {}
    assert importance_of(space, trials(rng.random(40).tolist())) != {}


@pytest.mark.parametrize("cultures", ['seeds = "1-2"', 'kind = "files"\nfolders = ["a", "b"]'])
def test_many_cultures_are_refused_by_name(cultures: str, tmp_path: Path) -> None:
    text = f'[culture]\n{cultures}\n[tune]\n[[robots]]\nname = "cartpole"\n[[arms]]\nname = "a"\n'
    (tmp_path / "many.toml").write_text(text)
    with pytest.raises(InvalidFile, match=r"many\.toml: culture\.(seeds|folders): expected one culture to tune for"):
        read_tuning(tmp_path / "many.toml")
