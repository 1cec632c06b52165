"""Studies over many cultures: each runs as if alone, a failure stops no other, and there are results over all."""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu, ttest_1samp

from animat.cli import main
from animat.errors import AnimatError, InvalidArgument, InvalidFile, Mismatch, UnusableData
from animat.evaluation.statistics import compare, interval_of_mean
from animat.recordings.findings import Finding
from animat.report.results import ComparedReturns, HeuristicComparison, Results, Score
from animat.studies import cultures
from animat.studies.cultures import (
    CulturesRun,
    over_cultures,
    run_over_cultures,
    studies_of,
    write_cultures_page,
)
from animat.studies.folder import RESULTS, describe_study
from animat.studies.outperforming import NOT, OUTPERFORM
from animat.studies.outperforming import TOO_FEW as TOO_FEW_EPISODES
from animat.studies.results import write_typed
from animat.studies.run import StudyRun, run_study
from animat.studies.source import Source, read_seeds
from animat.studies.specification import Study
from animat.studies.tabulating import NONE, SECOND, TOO_FEW, outcome_of
from animat.studies.toml import read_study, study_to_toml
from animat.studies.training import training_of
from animat.writing import exclusive_lock
from synthetic_recordings import write_synthetic_series

TINY = Path(__file__).parent / "tiny_study.toml"


def compared(first: float, second: float, outcome: str) -> ComparedReturns:
    given: dict[str, Any] = dict.fromkeys(ComparedReturns.__dataclass_fields__, 0.0)
    for name in ("score_first", "score_second", "random_second", "paper_u", "paper_p", "as_in_paper"):
        given[name] = None
    names = {"comparison": "a and b", "robot": "cartpole", "first": "a", "second": "b", "n": 2, "episodes": 5}
    return ComparedReturns(**given | names | {"mean_first": first, "mean_second": second, "outcome": outcome})


@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 30)), min_size=1, max_size=6))
def test_ranges_of_seeds_are_expanded(ranges: list[tuple[int, int]]) -> None:
    text = ", ".join(f"{first}-{first + more}" if more else f"{first}" for first, more in ranges)
    expected = [seed for first, more in ranges for seed in range(first, first + more + 1)]
    if len(set(expected)) < len(expected):
        with pytest.raises(InvalidArgument, match="each culture once"):
            read_seeds(text)
    else:
        assert read_seeds(text) == expected


@pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-1", "1;2", "1-2000", "1.5"])
def test_text_other_than_ranges_of_seeds_is_refused(text: str) -> None:
    with pytest.raises(InvalidArgument, match="seeds: expected"):
        Source(seeds=text)


def test_a_seed_of_too_many_digits_is_refused_as_such() -> None:
    with pytest.raises(InvalidArgument, match="seeds: expected numbers of at most 9 digits, got '1-99999999999'"):
        Source(seeds="1-99999999999")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"seeds": "1-3", "seed": 2}, "seeds: expected seed or seeds"),
        ({"kind": "files", "files": ("a",), "folders": ("b",)}, "folders: expected files of one culture"),
        ({"folders": ("b",)}, "files, folders: expected only with kind = 'files', got 1 for 'virtual'"),
        ({"kind": "files", "folders": ("b",), "seeds": "1-2"}, "seeds: expected only for a culture"),
    ],
)
def test_a_culture_is_one_or_many_and_not_both(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidArgument, match=message):
        Source(**given)


def test_a_study_of_a_single_culture_is_refused_before_its_folder_is_made(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match="culture: expected many, by seeds or folders, got a single one"):
        run_over_cultures(read_study(TINY), tmp_path / "study")
    assert not (tmp_path / "study").exists()


def test_policies_on_two_cultures_are_independent(tmp_path: Path) -> None:
    study = replace(read_study(TINY), culture=Source(seeds="1-40"))
    files = replace(study, culture=Source(kind="files", folders=("day-1", "day-2")))
    every = [each for one in (study, files) for each in studies_of(one).values()]
    spec, arms = study.robots[0], [arm for arm in study.arms if arm.trained]
    assert len({training_of(each, spec, arm).seed for each in every for arm in arms}) == 42 * len(arms)
    # A study that was moved together with its recordings is the same.
    elsewhere, here = (Source(kind="files", files=(f"{folder}day-1",)) for folder in ("/there/", ""))
    seeds = {training_of(replace(study, culture=each), spec, arms[0]).seed for each in (elsewhere, here)}
    assert seeds == {training_of(every[40], spec, arms[0]).seed}


def test_each_culture_has_the_study_that_it_would_have_alone(tmp_path: Path) -> None:
    study = replace(read_study(TINY), culture=Source(sessions=2, interval_min=140, seeds="2-3, 9"))
    (file := tmp_path / "study.toml").write_text(study_to_toml(study))
    study = read_study(file)
    assert list(studies_of(study)) == ["culture-2", "culture-3", "culture-9"]
    for seed, each in zip((2, 3, 9), studies_of(study).values(), strict=True):
        alone = replace(study, culture=Source(sessions=2, interval_min=140, seed=seed))
        assert each == alone and asdict(each) == asdict(alone)
        assert studies_of(each) == {}
    with pytest.raises(InvalidArgument, match="expected one culture, got many"):
        run_study(study, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InvalidArgument, match="folders: expected different names, got 'rec' twice: rename one"):
        Source(kind="files", folders=("day-1/rec", "day-2/rec"))


def test_intervals_over_cultures_are_those_of_scipy() -> None:
    values = np.random.default_rng(3).normal(5, 2, 12)
    known = ttest_1samp(values, 0).confidence_interval(0.95)
    found = interval_of_mean(values)
    assert (found.low, found.high) == pytest.approx((known.low, known.high))


def test_over_cultures_each_counts_the_same() -> None:
    found = over_cultures([[compared(0, 10, SECOND)], [compared(5, 6, NONE)], [compared(1, 2, SECOND)]])
    (row,) = found
    assert (row.cultures, row.mean_first, row.mean_second, row.difference, row.holds_in) == (3, 2, 6, 4, 2)
    assert (row.larger_in, row.tested, row.found_better) == (3, 3, "2 of 3")
    # Differences of 10, 1 and 1 have a standard error of 3, and Student's t of two degrees of freedom is 4.303.
    assert (row.low_95, row.high_95) == pytest.approx((4 - 12.908, 4 + 12.908), abs=0.001)
    (alone,) = over_cultures([[compared(0, 10, SECOND)]])
    assert (alone.low_95, alone.high_95) == (None, None)


@given(st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9), st.booleans()), min_size=1, max_size=20))
def test_with_too_few_policies_larger_means_are_still_counted(found: list[tuple[int, int, bool]]) -> None:
    rows = [[compared(first, second, TOO_FEW if is_few else NONE)] for first, second, is_few in found]
    (row,) = over_cultures(rows)
    assert row.larger_in == np.sum(np.less(*np.array(found).T[:2]))
    enough = [is_few for *_, is_few in found].count(False)
    assert (row.tested, row.found_better) == (enough, f"0 of {enough}" if enough else "too few policies")


@pytest.mark.parametrize("n", range(1, 12))
def test_policies_are_too_few_if_even_the_best_outcome_is_not_significant(n: int) -> None:
    best = mannwhitneyu(np.arange(n), np.arange(n) + n, method="asymptotic").pvalue
    outcome = outcome_of(compare(np.arange(n), np.arange(n) + n))
    assert outcome == (SECOND if best < 0.01 else TOO_FEW)


def test_a_culture_that_fails_is_reported_and_stops_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ran(study: Study, folder: Path, **_: Any) -> StudyRun:
        if study.culture.seed == 2:
            raise UnusableData("recording 1: no responses")
        return run_with_results(study, folder)

    monkeypatch.setattr(cultures, "run_study", ran)
    study = replace(read_study(TINY), culture=Source(seeds="1-3"))
    found = run_over_cultures(study, tmp_path)
    assert list(found.finished) == ["culture-1", "culture-3"]
    assert found.failed == {"culture-2": "recording 1: no responses"}
    assert json.loads((tmp_path / cultures.MANIFEST).read_text()) == {
        "cultures": ["culture-1", "culture-2", "culture-3"],
        "failed": found.failed,
    }
    page = write_cultures_page(study, replace(found, summary=())).read_text()
    assert 'finished: <a href="culture-3/report.html">culture-3/report.html</a>' in page
    assert "<dd>failed: recording 1: no responses</dd>" in page
    table = pd.read_csv(tmp_path / cultures.COMPARISONS)
    assert table["culture"].tolist() == ["culture-1", "culture-3"]
    assert table["mean_second"].tolist() == [1.0, 3.0]
    assert pd.read_csv(tmp_path / cultures.SUMMARY)["difference"].tolist() == [2.0]
    with pytest.raises(AnimatError, match="culture-2: recording 1: no responses"):
        run_over_cultures(replace(study, culture=Source(seeds="2")), tmp_path)
    before = (tmp_path / cultures.MANIFEST).read_bytes()
    with exclusive_lock(tmp_path), pytest.raises(Mismatch, match="another run"):
        run_over_cultures(study, tmp_path)
    assert (tmp_path / cultures.MANIFEST).read_bytes() == before


def test_warnings_of_every_culture_are_printed_and_counted_on_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ran(study: Study, folder: Path, **_: Any) -> StudyRun:
        ran = run_with_results(study, folder)
        worse = Finding("drift", "warning", "at 0 min: responses fall", -0.5 * float(study.culture.seed or 0))
        found = (worse, Finding("bursts", "note", "few"), *[Finding("optimum", "warning", "differs")] * 2)
        write_typed(folder / RESULTS, Results((), (), (), (), (), found if study.culture.seed != 3 else ()))
        return ran

    monkeypatch.setattr(cultures, "run_study", ran)
    (tmp_path / "many.toml").write_text(study_to_toml(replace(read_study(TINY), culture=Source(seeds="1-3"))))
    assert main(["study", str(tmp_path / "many.toml"), "--out", str(tmp_path / "out")]) == 0
    err = capsys.readouterr().err
    assert "warning: drift: culture-2: at 0 min: responses fall (and 1 more like it)" in err
    assert "warning: optimum: culture-1: differs (and 3 more like it)" in err and "bursts" not in err
    page = (tmp_path / "out" / "report.html").read_text()
    assert "culture-2/report.html</a>, 3 warnings</dd>" in page and "culture-3/report.html</a></dd>" in page


def test_policies_that_do_not_outperform_the_heuristic_are_counted_over_cultures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = {1: (NOT, OUTPERFORM), 2: (OUTPERFORM, OUTPERFORM), 3: (NOT, OUTPERFORM), 4: (TOO_FEW_EPISODES, NOT)}

    def ran(study: Study, folder: Path, **_: Any) -> StudyRun:
        ran = run_with_results(study, folder)
        arms = zip(("9 thresholds", "linear"), outcomes[study.culture.seed or 0], strict=True)
        rows = tuple(HeuristicComparison("cartpole", arm, 10.0, 1.0, 2.0, 0.5, 0.5, outcome) for arm, outcome in arms)
        write_typed(folder / RESULTS, Results((), (), (), rows, (), ()))
        return ran

    monkeypatch.setattr(cultures, "run_study", ran)
    (tmp_path / "many.toml").write_text(study_to_toml(replace(read_study(TINY), culture=Source(seeds="1-4"))))
    assert main(["study", str(tmp_path / "many.toml"), "--out", str(tmp_path / "out"), "--json"]) == 0
    of_nine = (
        "cartpole, 9 thresholds, at 10 min: the policies do not outperform the heuristic policy in 2 of 3 cultures"
    )
    of_linear = "cartpole, linear, at 10 min: the policies do not outperform the heuristic policy in 1 of 4 cultures"
    printed = capsys.readouterr().out.splitlines()
    assert of_nine in printed and of_linear in printed
    assert json.loads(printed[-1])["not_outperforming_the_heuristic"] == [of_nine, of_linear]
    assert f"C{of_nine[1:]}." in (tmp_path / "out" / "report.html").read_text()


def run_with_results(study: Study, folder: Path) -> StudyRun:
    (folder / RESULTS).parent.mkdir(parents=True, exist_ok=True)
    rows = (compared(0.0, float(study.culture.seed or 0), SECOND),)
    write_typed(folder / RESULTS, Results((), rows, (), (), (), ()))
    return StudyRun(folder, folder / "report.html", 1, {})


def test_another_study_is_refused_before_it_touches_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More cultures may be added, and a study that stopped before it made anything may be corrected."""

    def ran(study: Study, folder: Path, **_: Any) -> StudyRun:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "study.json").write_text(json.dumps(describe_study(study, {})))
        return run_with_results(study, folder)

    monkeypatch.setattr(cultures, "run_study", ran)
    study = replace(read_study(TINY), culture=Source(seeds="1-2"))
    run_over_cultures(study, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(
        Mismatch, match=r"culture-1: expected a folder of this study, got one of another \(study.policies"
    ):
        run_over_cultures(replace(study, policies=study.policies + 1), tmp_path)
    with pytest.raises(
        Mismatch, match=r"culture-[12]: expected a folder of this study, got one of another \(study.policies"
    ):
        run_over_cultures(replace(study, policies=study.policies + 1, culture=Source(seeds="3")), tmp_path)
    with pytest.raises(Mismatch, match=r"culture-1: .* of another \(study.culture.sessions: 15 there, 2 now\)"):
        run_over_cultures(replace(study, culture=Source(seeds="3", sessions=2)), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    # What is damaged is a matter of its own culture.
    (tmp_path / "culture-2" / "study.json").write_text("{")
    assert list(run_over_cultures(replace(study, culture=Source(seeds="1-3")), tmp_path).finished)[-1] == "culture-3"
    for name in ("culture-1", "culture-2", "culture-3"):
        shutil.rmtree((tmp_path / name / RESULTS).parent)
    assert run_over_cultures(replace(study, policies=study.policies + 1), tmp_path).failed == {}


def test_cultures_go_on_side_by_side_one_for_each_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The barrier lets nobody through before two are there; reported in order, the whole never goes back."""
    both, at_once, most = threading.Barrier(2, timeout=60), 0, 0

    def ran(study: Study, folder: Path, *, progress: Any, **_: Any) -> StudyRun:
        nonlocal at_once, most
        at_once += 1
        both.wait()
        most = max(most, at_once)
        for done in range(4):
            progress.update(done, 3)
        at_once -= 1
        return run_with_results(study, folder)

    reports: list[tuple[float, str]] = []
    monkeypatch.setattr(cultures, "run_study", ran)
    monkeypatch.setattr(cultures, "find_gpu", lambda: None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    whole = SimpleNamespace(update=lambda done, total, note="": reports.append((done / total, note)))
    found = run_over_cultures(replace(read_study(TINY), culture=Source(seeds="1-4")), tmp_path, progress=whole)
    assert list(found.finished) == ["culture-1", "culture-2", "culture-3", "culture-4"]
    assert most == 2
    assert [share for share, _ in reports] == sorted(share for share, _ in reports)
    assert reports[-1] == (1.0, "4 of 4 cultures")
    assert any(note.startswith("0 of 4 cultures; culture-") for _, note in reports)


def test_an_unexpected_error_ends_all_cultures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Ctrl-C does: the others are stopped at their next report, and no more are begun."""
    begun, running = [], threading.Event()

    def ran(study: Study, folder: Path, *, progress: Any, **_: Any) -> StudyRun:
        begun.append(study.culture.seed)
        if study.culture.seed == 1:
            running.wait(60)
            raise KeyboardInterrupt
        while True:
            progress.update(1, 2)
            running.set()
            time.sleep(0.01)

    monkeypatch.setattr(cultures, "run_study", ran)
    monkeypatch.setattr(cultures, "find_gpu", lambda: None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    with pytest.raises(KeyboardInterrupt):
        run_over_cultures(replace(read_study(TINY), culture=Source(seeds="1-9")), tmp_path)
    assert set(begun) <= {1, 2, 3}, "one may take the place of the first before all are stopped"
    assert not [each for each in threading.enumerate() if each.name.startswith("culture")]


SCORED: dict[str, Any] = {
    **dict.fromkeys(Score.__dataclass_fields__, 1.5),
    "robot": "cartpole",
    "arm": "1 threshold",
    "mapping": "9-thresholds",
    "policies": 2,
    "episodes": 5,
    "optimum": None,
}


def run_scored(folder: Path, monkeypatch: pytest.MonkeyPatch) -> CulturesRun:
    def ran(study: Study, folder: Path, **_: Any) -> StudyRun:
        (folder / RESULTS).parent.mkdir(parents=True, exist_ok=True)
        scores = tuple(Score(**SCORED | {"mean_return": study.culture.seed + i / 3}) for i in range(2))
        write_typed(folder / RESULTS, Results(scores, (), (), (), (), ()))
        return StudyRun(folder, folder / "report.html", 1, {})

    monkeypatch.setattr(cultures, "run_study", ran)
    return run_over_cultures(replace(read_study(TINY), culture=Source(seeds="1-3")), folder)


def test_without_fastparquet_there_is_csv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fastparquet", None)
    assert run_scored(tmp_path, monkeypatch).parquet is None
    assert len(pd.read_csv(tmp_path / cultures.SCORES)) == 6
    assert not (tmp_path / "scores.parquet").exists()


def test_scores_of_all_cultures_are_one_table_the_same_in_parquet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fastparquet = pytest.importorskip("fastparquet", reason="fastparquet, of the extra [parquet], is not installed")
    found = run_scored(tmp_path, monkeypatch)
    assert found.parquet == tmp_path / "scores.parquet"
    with found.parquet.open("rb") as file:
        table = fastparquet.ParquetFile(file).to_pandas()
    assert table["culture"].tolist() == [f"culture-{seed}" for seed in (1, 1, 2, 2, 3, 3)]
    assert table["mean_return"].tolist() == [seed + i / 3 for seed in (1, 2, 3) for i in range(2)]
    assert table["optimum"].isna().all() and table["optimum"].dtype == np.float64
    assert table["policies"].dtype == np.int64 and set(table["arm"]) == {"1 threshold"}
    csv = pd.read_csv(tmp_path / cultures.SCORES, dtype=dict(table.dtypes), float_precision="round_trip")
    pd.testing.assert_frame_equal(table, csv, check_exact=True)
    before = found.parquet.read_bytes()
    assert run_scored(tmp_path, monkeypatch).parquet == found.parquet and found.parquet.read_bytes() == before


@pytest.mark.long
def test_as_a_user_it_ends_with_the_tables_of_each_culture_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(TINY.parent / "data" / "tiny", tmp_path / "one")
    write_synthetic_series(2, tmp_path / "other", sessions=2, interval_min=140, patterns=40, channels=32)
    files = 'files = ["data/tiny"]'
    (tmp_path / "many.toml").write_text(TINY.read_text().replace(files, 'folders = ["one", "other"]'))
    assert main(["study", str(tmp_path / "many.toml"), "--out", str(tmp_path / "many"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert summary["cultures"] == ["culture-one", "culture-other"]
    assert {row["cultures"] for row in summary["over_cultures"]} == {2}
    alone = replace(read_study(TINY), culture=Source("files", files=("other",)))
    run_study(alone, tmp_path / "alone", base=tmp_path)
    both = (tmp_path / "many" / "culture-other", tmp_path / "alone")
    results = [(folder / RESULTS).read_bytes() for folder in both]
    assert results[0] == results[1]
    page = (tmp_path / "many" / "report.html").read_text()
    assert "better in" in page and "culture-one/report.html" in page
    (tmp_path / "files.toml").write_text(
        TINY.read_text().replace(files, 'folders = ["many/culture-one/recordings", "missing"]')
    )
    assert main(["study", str(tmp_path / "files.toml"), "--out", str(tmp_path / "files")]) != 0
    err = capsys.readouterr().err
    assert "failed: culture-missing" in err and "1 of 2 cultures failed" in err


def test_results_that_cannot_be_read_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cultures, "run_study", lambda study, folder, **_: StudyRun(folder, folder, 1, {}))
    with pytest.raises(InvalidFile, match="results"):
        run_over_cultures(replace(read_study(TINY), culture=Source(seeds="1")), tmp_path)
