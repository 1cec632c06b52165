"""What the report says of its numbers: outcomes, optima, scores, decisions, and what is left out."""

from __future__ import annotations

import html
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest

from animat.errors import InvalidArgument, InvalidFile
from animat.evaluation.statistics import compare
from animat.neurons.fidelity import Fidelity
from animat.recordings.findings import Finding
from animat.report.html import Picture, Section, Table, with_links, with_minus, write_page
from animat.report.over_time import Courses, LearningCurve, draw_learning_curves, draw_returns_over_time, over_rounds
from animat.report.results import ComparedReturns, ControlReturns, OverCultures, Results, Score, StudyOptimum
from animat.report.returns import Pair, draw_comparisons, draw_controls, draw_headline
from animat.report.style import save_figure
from animat.robots import Cartpole
from animat.studies.arms import arm_differences, arms_table
from animat.studies.captions import CULTURE, HEADLINE, ROBOT
from animat.studies.cultures import CulturesRun, _describe, _summary
from animat.studies.differences import decisions, differing_comparisons, explain
from animat.studies.folder import optima_file
from animat.studies.optima import kinds_of, kinds_over_time
from animat.studies.paper import paper_study
from animat.studies.publishing import (
    _as_in_paper,
    _colophon,
    _facts_of,
    _facts_of_culture,
    _findings,
    _found_better,
    _lead,
    _pictures,
)
from animat.studies.report_tables import comparisons_table, controllability_table, scores_table
from animat.studies.results import write_typed
from animat.studies.run import plan_study
from animat.studies.source import Source
from animat.studies.specification import Arm, Compared, RobotSpec, Simulators, Study
from animat.studies.tabulating import AS_IN_PAPER, FIRST, NONE, SECOND, TOO_FEW, outcome_of
from animat.studies.toml import read_study, study_to_toml
from animat.studies.training import training_of
from test_simulator import responses_of

ROW = ComparedReturns(
    comparison="c", robot="cartpole", first="a", second="b", at_min=140.0, episodes=100, n=10, mean_first=5.0,
    mean_second=16.0, score_first=0.5, score_second=0.6, random_second=-80.0, optimum_first=90.0, optimum_second=80.0,
    optimum_error_first=0.5, optimum_error_second=0.5, u=50.0, p_normal=0.5, p_exact=0.5, p_holm=1.0, effect=0.0,
    effect_low_95=-1.0, effect_high_95=1.0, outcome=NONE, paper_u=0.0, paper_p=1.83e-4, as_in_paper="no",
)  # fmt: skip

NOT_KNOWN = np.array([np.nan]), np.array([np.nan])
"""Returns of random actions and optimal returns of a learning curve."""


# --- outcomes -------------------------------------------------------------------------------------------------------


def test_the_second_is_better_where_its_returns_are_larger() -> None:
    low, high = np.arange(10.0), np.arange(10.0) + 100
    assert outcome_of(compare(low, high)) == SECOND
    assert outcome_of(compare(high, low)) == FIRST
    assert outcome_of(compare(low, low + 0.5)) == NONE
    assert AS_IN_PAPER[SECOND] == "yes" and AS_IN_PAPER[FIRST] == AS_IN_PAPER[NONE] == "no"


def test_few_policies_count_neither_for_nor_against_the_paper() -> None:
    """Four that are all better have p = 0.03."""
    assert outcome_of(compare(np.arange(4.0), np.arange(4.0) + 100)) == TOO_FEW
    assert AS_IN_PAPER[TOO_FEW] == "cannot tell"
    words = _as_in_paper([replace(ROW, as_in_paper=each) for each in ("yes", "cannot tell", "cannot tell")])
    assert words.startswith("1 of 3 comparisons") and "For 2 there are too few policies" in words
    assert "differently" not in words
    assert "With so few policies it is not known" in _as_in_paper([replace(ROW, as_in_paper="cannot tell")] * 2)


def test_one_comparison_is_reported_without_a_count() -> None:
    better, not_better = replace(ROW, outcome=SECOND), replace(ROW, outcome=NONE)
    assert _found_better([not_better]) == "The second arm was not found to be better."
    assert _found_better([better]) == "The second arm was found to be better."
    assert _found_better([better, not_better]) == "In 1 of 2 comparisons the second arm was found to be better."
    assert "it is not known whether the second arm is better" in _found_better([replace(ROW, outcome=TOO_FEW)] * 2)


def test_differing_comparisons_are_named_with_their_outcomes() -> None:
    rows = [replace(ROW, robot=robot, outcome=outcome) for robot, outcome in (("arm", NONE), ("wheels", FIRST))]
    words = _as_in_paper([replace(ROW, as_in_paper="yes"), *rows, replace(ROW, second="c")])
    assert words.startswith("1 of 4 comparisons agrees with the paper")
    assert words.endswith(
        "3 came out differently: the paper found “b” better than “a”, but here “a” was better on wheels and no "
        "difference was found on arm; the paper found “c” better than “a”, but here no difference was found on "
        "cartpole."
    )


def test_every_arm_and_every_difference_between_two_is_explained() -> None:
    study = paper_study()
    shown = dict(arms_table(study).rows)
    assert list(shown) == [arm.name for arm in study.arms]
    assert "depending on how many of nine thresholds it exceeds. Trained with shadowing" in shown["9 thresholds"]
    assert "above the median gives the motor command +1" in shown["control"] and "drawn at random" in shown["control"]
    assert shown["before training"].startswith("New networks") and "hadowing" not in shown["before training"]
    assert "without shadowing: on the simulator of the first recording" in shown["without shadowing"]
    assert shown["without neurons"] == "There are no neurons, and policies give the motor commands themselves."
    (fixed,) = arms_table(Study(arms=(Arm("fixed", percentiles="first"),))).rows
    assert fixed[1].endswith("Percentiles are those of the first recording throughout.")
    parts = {each.name: list(arm_differences(each, study.arm("1 threshold"))) for each in study.arms}
    assert parts["1 threshold"] == parts["before training"] == []
    assert parts["without shadowing"] == [
        "“1 threshold” is trained with shadowing: during training, each newer recording replaces the simulator of the "
        "neurons."
    ]
    assert parts["control"] == ["In “control” the delivered stimulus is drawn at random, whatever the policy chooses."]
    assert [each.split("”")[0] for each in parts["linear"]] == ["In “linear", "In “1 threshold"]
    # Simulators are refreshed only where neurons are trained through.
    first_only = study.arm("without shadowing")
    assert list(arm_differences(first_only, study.arm("before training"))) == []
    assert len(list(arm_differences(first_only, study.arm("without neurons")))) == 2


def test_arms_without_neurons_share_controls_and_an_optimum_whatever_neurons_would_be_given() -> None:
    """Of a grid, for example: each stated its own, and controls were run twice and listed twice as many."""
    stated: Any = {"moving": {}, "first": {"percentiles": "first"}, "shuffled": {"delivery": "shuffled"}}
    study = Study(arms=tuple(Arm(name, mapping="none", **of) for name, of in stated.items()))
    (kind,) = kinds_of(study)
    assert study.arms_of(kind) == list(study.arms) and len({each.thresholds for each in study.arms}) == 1
    (description,) = {text for _, text in arms_table(study).rows}
    assert description == "There are no neurons, and policies give the motor commands themselves."


def test_over_cultures_a_difference_is_explained_only_once() -> None:
    names = [("control and 1 threshold", robot) for robot in ("cartpole", "navigation")]
    rows = [OverCultures(*name, 4, 1.0, 2.0, 1.0, None, None, larger_in=4, holds_in=4, tested=4) for name in names]
    section = _summary(paper_study(), CulturesRun(Path(), {}, {}, {}, tuple(rows), None))
    (_, first), (_, second) = section.points
    assert first.endswith("In “control” the delivered stimulus is drawn at random, whatever the policy chooses.")
    assert first.startswith(second)
    assert section.tables[0].title == "The arms"


def test_an_outcome_that_does_not_hold_after_correction_says_so() -> None:
    rows = [
        replace(ROW, outcome=outcome, p_holm=p_holm)
        for outcome, p_holm in ((SECOND, 0.005), (SECOND, 0.05), (FIRST, 0.05), (NONE, 1.0))
    ]
    shown = comparisons_table(rows)
    outcomes = [row[shown.head.index("outcome")] for row in shown.rows]
    assert outcomes == [SECOND, f"{SECOND}, not after correction", f"{FIRST}, not after correction", NONE]


def test_an_interval_begins_with_its_lower_end() -> None:
    empty: dict[str, Any] = {field.name: () for field in fields(Results)}
    shown = scores_table(Results(**empty | {"scores": (SCORED,)}))
    assert shown.rows[0][shown.head.index("interquartile mean")] == "96\u00a0[95,\u00a097]"


def test_a_p_that_is_too_long_to_compute_is_not_called_exact() -> None:
    shown = comparisons_table([replace(ROW, n=n, p_exact=0.5) for n in (100, 101)])
    assert [row[shown.head.index("p exact")] for row in shown.rows] == [0.5, None]


def test_not_finding_a_difference_is_not_called_no_difference() -> None:
    assert "no difference" not in NONE and "0.01" in NONE


# --- what an optimum says --------------------------------------------------------------------------------------------


def test_a_comparison_is_explained_by_its_optima() -> None:
    assert "other way round" in explain(ROW)
    # Ties can make p smaller: of four equal returns against four larger ones it is 0.013.
    assert "below 0.0304, unless some have equal returns: use more policies" in explain(replace(ROW, n=4))
    assert compare(np.zeros(4), np.ones(4)).p_normal < 0.014
    assert explain(replace(ROW, n=1)).startswith("With 1 policy per side")
    assert "nothing to learn" in explain(replace(ROW, optimum_second=-79.8))
    assert "nothing to learn" in explain(replace(ROW, optimum_second=-79.5)), "equal within its error"
    assert "nothing to learn" not in explain(replace(ROW, optimum_second=-79.4))
    assert "no optimum" in explain(replace(ROW, optimum_second=None))
    assert "leaves room" in explain(replace(ROW, optimum_second=100.0))


def test_there_is_room_as_long_as_the_second_optimum_is_far_above_the_first_arm() -> None:
    """The first is near its own optimum of 60; the second could have 100, and has a third of the way."""
    row = replace(ROW, optimum_first=60.0, optimum_second=100.0, mean_first=56.0, score_first=0.97, score_second=0.3)
    assert "no room" not in explain(row)
    assert "leaves room, 44.0 above a" in explain(row)
    assert "no room is left" in explain(replace(row, mean_first=96.0))
    assert "at its optimum" in explain(replace(row, score_second=0.98))
    assert "at its optimum" not in explain(replace(row, score_second=0.96))


def test_optima_are_ordered_only_if_they_differ_by_more_than_their_errors() -> None:
    close = replace(ROW, optimum_first=119.95, optimum_second=119.94, optimum_error_first=0.4, optimum_error_second=2.2)
    assert "other way round" not in explain(close)
    assert "same within their errors" in explain(close)
    assert "other way round" in explain(replace(close, optimum_first=122.6))


def test_a_control_has_no_optimum() -> None:
    words = explain(replace(ROW, optimum_first=None, optimum_error_first=None))
    assert "a cannot do better than random actions" in words and "for a" not in words


def test_a_loss_by_binning_is_reported_only_where_there_is_one() -> None:
    ((_, words),) = differing_comparisons([ROW], {0.0: 0.5, 140.0: 0.02})
    assert "binning" not in words and "none found" in words
    ((_, words),) = differing_comparisons([ROW], {140.0: 0.21})
    assert "binning moves P(x ≥ P50) by up to 0.21" in words
    assert not [*differing_comparisons([replace(ROW, as_in_paper="yes"), replace(ROW, as_in_paper=None)])]


# --- decisions are the study's ---------------------------------------------------------------------------------------


def test_decisions_of_the_papers_study() -> None:
    decided = dict(decisions(paper_study()))
    assert {"Ten levels without zero", "Pole mass", "12 degrees", "20 iterations", "Histogram range", "Percentiles",
            "Most probable actions", "Walls", "Before training", "Pulse", "Learning", "Drawing from a histogram",
            } <= set(decided)  # fmt: skip
    assert "0.055 kg, the simulator's" in decided["Pole mass"]
    assert "12 degrees (angle" in decided["12 degrees"]
    assert "there are 100" in decided["20 iterations"]
    assert "percentiles of each recording" in decided["Histogram range"]
    assert "simulated" in decided["The culture"]


def test_the_papers_burst_rule_is_reported_with_what_it_would_leave_out() -> None:
    # Of one peak, which Otsu cuts in two: 0.5 is its cut; of two groups; and of no two values.
    one_peak = responses_of([1.0] * 10, active_ratio=np.repeat([0.4, 0.5, 0.6, 0.7], [2, 5, 2, 1]))
    two_groups = responses_of([1.0] * 20, bursts_hz=(9.0,) * 5)
    flat = responses_of([1.0] * 4)
    words = dict(decisions(paper_study(), [one_peak, two_groups, flat]))["Bursts"]
    assert words == (
        "In the paper Otsu's threshold is always applied. Here it is applied only where the ratios of active channels "
        "form two groups; elsewhere no response is set apart. In 1 of 3 recordings this keeps responses that the "
        "paper's rule would leave out, 3 of 39 in total."
    )
    assert dict(decisions(paper_study()))["Bursts"].endswith("elsewhere no response is set apart.")
    given = replace(paper_study(), simulators=Simulators(burst_threshold=0.5))
    assert dict(decisions(given, [one_peak]))["Bursts"].endswith("Here the threshold is set to 0.5 of the channels.")


def test_a_caption_promises_a_threshold_only_where_there_is_one() -> None:
    with_bursts, without = responses_of([1.0] * 20, bursts_hz=(9.0,) * 5), responses_of([1.0] * 20)
    caption = CULTURE["bursts"].text
    assert "to the right of the dashed threshold" in caption.format(**_facts_of_culture([with_bursts]))
    assert "so there is no threshold." in caption.format(**_facts_of_culture([without]))


def test_a_quick_study_reports_what_it_has_less_of_than_the_paper() -> None:
    decided = dict(decisions(paper_study(quick=True)))
    assert decided["Recordings"] == (
        "The paper has 15 recordings, 10 minutes apart, of 100 trials of each stimulus, each frequency in a block. "
        "Here there are 8 recordings, 20 minutes apart, of 100 trials of each stimulus, each frequency in a block."
    )
    assert decided["Policies"] == "The paper has 10 per arm. Here there are 4."
    assert decided["Iterations on cartpole"] == "The paper trains a policy for 800,000. Here it is trained for 60,000."
    assert "500,000" in decided["Iterations on navigation"] and "60,000" in decided["Iterations on navigation"]
    papers = dict(decisions(paper_study()))
    assert not any(name.startswith(("Recordings", "Policies", "Iterations")) for name in papers)


def test_decisions_follow_a_changed_study() -> None:
    changed = replace(
        paper_study(),
        robots=(
            RobotSpec("cartpole", parameters={"pole_mass_kg": 0.55, "angle_limit_rad": 0.4}),
            RobotSpec("navigation", parameters={"episode_limit": 20}),
        ),
        culture=Source("files", files=("mine",)),
        simulators=Simulators(bins=40, range_hz=60.0),
        arms=paper_study().arms[:2],
        comparisons=(),
        actions="drawn",
    )
    made = dict(decisions(changed))
    assert "0.55 kg, chosen for this study" in made["Pole mass"]
    assert "22.9 degrees" in made["12 degrees"]
    assert "there are 20 " in made["20 iterations"] and "no policy can reach" in made["20 iterations"]
    assert "existing recordings" in made["The culture"] and "Pulse" not in made
    assert (
        "40 bins of equal width reach to 60 Hz" in made["Histogram range"] and "paper's 20" in made["Histogram range"]
    )
    assert "Ten levels without zero" not in made and "Most probable actions" not in made
    drawn = dict(decisions(replace(changed, simulators=Simulators(kind="empirical"))))
    assert "Drawing from a histogram" not in drawn and "measured responses" in drawn["Histogram"]
    kinds = Arm("moving"), Arm("fixed", percentiles="first")
    for arms, end in ((kinds, "they move, except in the arms with those of the first recording."), (kinds[:1], "it.")):
        assert dict(decisions(replace(changed, arms=arms)))["Percentiles"].endswith(end)
    alone = dict(decisions(replace(changed, robots=(RobotSpec("navigation"),))))
    assert "Pole mass" not in alone


def test_a_study_without_neurons_says_nothing_of_a_culture() -> None:
    """It was said to be driven through a virtual culture, whose pulse, bursts and histogram were then described."""
    alone = replace(paper_study(quick=True), arms=(Arm("alone", mapping="none"),), comparisons=())
    assert _lead(alone).startswith("Cartpole and navigation, driven without neurons. An arm is")
    decided = [name for name, _ in decisions(alone)]
    assert not {"Recordings", "The culture", "Pulse", "Bursts", "Histogram range", "Percentiles"} & set(decided)
    assert {"Policies", "Iterations on cartpole", "Pole mass", "Walls", "Learning"} <= set(decided)
    with_neurons = [name for name, _ in decisions(replace(alone, arms=(Arm("1 threshold"), *alone.arms)))]
    assert [name for name in with_neurons if name in decided] == decided


def test_one_of_anything_is_in_the_singular() -> None:
    of_culture = _facts_of_culture([responses_of([1.0])])
    facts = _facts_of(Study(policies=1, episodes=1, episodes_over_time=1)) | of_culture | {"round": "9"}
    for caption in (HEADLINE, *(each.text for each in (*CULTURE.values(), *ROBOT.values()))):
        said = caption.format(**facts)
        assert not re.search(r"\b1 (policies|episodes|recordings|responses|channels)\b", said), said
    many = _facts_of(Study(policies=2, episodes=1000, episodes_over_time=3))
    assert many == {"policies": "2 policies", "episodes": "1,000 episodes", "episodes_over_time": "3 episodes"}
    over = OverCultures("c", "cartpole", 1, 0.0, 1.0, 1.0, None, None, 1, 1, 1)
    found = CulturesRun(Path(), {}, {}, {}, (over,), None)
    assert "in 1 of 1 culture;" in _describe(Compared("c", "a", "b"), found.summary[0])
    note = Results((), (), (), (), (), (Finding("bursts", "note", "m"), Finding("x", "warning", "m")))
    assert _findings(note).paragraphs[0].startswith("1 warning and 1 note on the recordings")


def test_a_report_names_the_seed_of_a_culture_only_if_one_was_grown() -> None:
    manifest = {"versions": {"animat": "0"}, "fingerprint": "f"}
    grown = replace(paper_study(), culture=Source(seed=4), seed=2)
    assert _colophon(grown, manifest)[1].startswith("Seeds: culture 4, training and evaluation 2. ")
    at_hand = replace(grown, culture=Source("files", files=("mine",)))
    for study in (at_hand, replace(grown, arms=(Arm("alone", mapping="none"),), comparisons=())):
        assert _colophon(study, manifest)[1].startswith("Seeds: training and evaluation 2. ")


# --- robots of one kind -----------------------------------------------------------------------------------------------


def test_two_robots_of_a_kind_are_distinguished(tmp_path: Path) -> None:
    """The pole mass as printed beside the simulator's, in one study."""
    printed = RobotSpec("as printed", kind="cartpole", parameters={"pole_mass_kg": 0.55})
    study = Study(robots=(RobotSpec("cartpole"), printed))
    assert printed.robot() == Cartpole(pole_mass_kg=0.55)
    assert printed.trained_for == Cartpole().paper_iterations
    (tmp_path / "study.toml").write_text(study_to_toml(study))
    assert read_study(tmp_path / "study.toml") == study
    names = [job.name for job in plan_study(study, tmp_path)]
    assert len(set(names)) == len(names) and "train/as printed/1-threshold/p0" in names
    assert training_of(study, printed, Arm("a", mapping="none")).commands == (-1.0, 1.0)
    texts = [words for name, words in decisions(study) if name == "Pole mass"]
    assert len(texts) == 2 and "0.55 kg, chosen" in texts[1]
    with pytest.raises(InvalidArgument, match="expected each name once"):
        Study(robots=(RobotSpec("cartpole"), RobotSpec("cartpole", parameters={"pole_mass_kg": 0.55})))
    with pytest.raises(InvalidArgument, match=r"^name: expected letters"):
        RobotSpec("a/b", kind="cartpole")
    with pytest.raises(InvalidArgument, match="culture"):
        RobotSpec("culture", kind="cartpole")
    with pytest.raises(InvalidArgument, match="cartpole, detour, navigation"):
        RobotSpec("as printed")


def test_names_of_robots_keep_their_capitals_and_every_section_its_anchor(tmp_path: Path) -> None:
    """A Gymnasium CartPole beside the house's own cartpole was called Cartpole too, and its entry led to the other."""
    robots = (RobotSpec("my Rover", kind="navigation"), RobotSpec("CartPole", kind="cartpole"), RobotSpec("cartpole"))
    assert _lead(Study(robots=robots)).startswith("My Rover, CartPole and cartpole, driven through a virtual culture.")
    rows = [(score("CartPole", "a", 5.0, 4.0, 6.0, 0.0, 10.0), np.ones(2))]
    (tmp_path / "figures").mkdir()
    save_figure(draw_headline(rows), tmp_path / "figures" / "CartPole-controls.png")
    (picture,) = _pictures(tmp_path, "CartPole", ROBOT, {"policies": 2, "episodes": 3})
    assert picture.title == "CartPole: controls"
    titles = ("CartPole", "Cartpole", "Scores", "Cartpole-", "Scores", "my Rover")
    page = write_page(tmp_path / "page.html", "t", "l", [Section(title) for title in titles], []).read_text()
    anchors = re.findall('<h2 id="([^"]*)">', page)
    assert len(set(anchors)) == len(titles) and re.findall('href="#([^"]*)"', page) == anchors
    assert anchors[0] == "cartpole" and anchors[-1] == "my-rover"


# --- what arms are evaluated on ------------------------------------------------------------------------------------


def test_what_is_trained_on_one_recording_is_evaluated_on_it() -> None:
    study = paper_study()
    assert study.minutes_of(study.arm("without shadowing"), 0.0, 140.0) == {140.0: 100, 0.0: 100}
    assert study.minutes_of(study.arm("9 thresholds"), 0.0, 140.0) == {140.0: 100}
    assert study.minutes_of(study.arm("1 threshold"), 0.0, 140.0) == {0.0: 30, 140.0: 100}
    assert study.optimum_minutes(0.0, 140.0) == [0.0, 140.0]
    for other in (Arm("c", shadowing=False, delivery="shuffled"), Arm("c", shadowing=False, trained=False)):
        assert study.minutes_of(other, 0.0, 140.0) == {140.0: 100}
    # Of several comparisons at a minute, as many episodes as the longest takes.
    arms = Arm("a", shadowing=False), Arm("b")
    takes = {"first": (0.0, 30), "longest": (0.0, 300), "last": (140.0, 20), "shortest": (140.0, 10)}
    compared = tuple(Compared(name, "a", "b", at_min=at, episodes=n) for name, (at, n) in takes.items())
    several = Study(arms=arms, comparisons=compared, episodes=50)
    assert [several.minutes_of(arm, 0.0, 140.0) for arm in arms] == [{0.0: 300, 140.0: 20}] * 2


@pytest.mark.parametrize(
    ("at", "settled"), [(None, 40), (-30, 0), (5, 0), (6, 10), (26, 40), (70, 40), (-31, None), (71, None)]
)
def test_a_comparison_is_made_on_the_nearest_recording_up_to_the_longest_interval_away(
    at: float | None, settled: float | None
) -> None:
    # Of two as near the earlier one; the longest interval is 30 min.
    arms, starts = (Arm("a"), Arm("b")), [0.0, 10.0, 40.0]
    study = Study(culture=Source("files", files=("a",)), arms=arms, comparisons=(Compared("c", "a", "b", at_min=at),))
    if settled is None:
        with pytest.raises(
            InvalidArgument, match=r"comparisons\.at_min: expected a minute of the recordings, from 0 to 40"
        ):
            study.at_recordings(starts)
    else:
        assert study.at_recordings(starts).comparisons[0].at_min == settled


SCORED = Score(
    robot="cartpole", arm="without shadowing", mapping="1-threshold", at_min=0.0, policies=9, episodes=100,
    mean_return=96.0, standard_deviation=3.0, interquartile_mean=96.0, low_95=95.0, high_95=97.0, random=-80.0,
    optimum=110.0, normalised_score=0.88,
)  # fmt: skip


def score(
    robot: str, arm: str, middle: float, low: float | None, high: float | None, random: float | None, best: float | None
) -> Score:
    """That of an arm, as far as figures and sentences go by it."""
    known = {"interquartile_mean": middle, "low_95": low, "high_95": high, "random": random, "optimum": best}
    return replace(SCORED, robot=robot, arm=arm, **known)


# --- what is shown ----------------------------------------------------------------------------------------------------


def test_controllability_shows_what_binning_moves_and_what_is_left_out(tmp_path: Path) -> None:
    study = Study(robots=(RobotSpec("cartpole"),), arms=(Arm("linear", mapping="linear"),
                                                         Arm("1 threshold")))  # fmt: skip
    labels = tuple(f"{i} Hz" for i in range(13))
    in_data, in_simulator = np.full((2, 13), 0.5), np.full((2, 13), 0.5)
    in_data[1, [0, 12]], in_simulator[1, [0, 12]] = (0.13, 0.9), (0.28, 0.88)
    kept = {10.0 * i: Fidelity(labels, in_data[i], in_simulator[i], 0) for i in range(2)}
    unknown = dict.fromkeys(field.name for field in fields(StudyOptimum))
    known = {"robot": "cartpole", "percentiles": "moving"}
    optima = [
        StudyOptimum(
            **unknown | known | {"mapping": m, "at_min": at, "best_return": x, "left_out": None if at else "0 Hz (3)"}
        )
        for m, x in (("9-thresholds", 99.0), ("1-threshold", 42.0))
        for at in (0.0, 10.0)
    ]
    write_typed(optima_file(tmp_path, "cartpole", "over-time"), optima)
    table = controllability_table(study, tmp_path, kept)
    assert table.head[-3:] == ("difference, data", "difference, simulator", "optimum, cartpole")
    assert table.marked == (1,)
    assert table.rows[1][1] == "0.13\u00a0→\u00a00.28"
    # Over all conditions, also those that there is no column for.
    assert table.rows[1][-3:] == pytest.approx((0.77, 0.6, 42.0))
    assert table.rows[0][-1] is None, "an optimum of some conditions is none of all"
    assert len(table.head) == 1 + 12 + 3
    assert "1 more conditions are in the file" in table.note


def test_every_mapping_has_its_own_optima_over_time() -> None:
    study = paper_study()
    assert [kind.mapping for kind in kinds_of(study)] == ["1-threshold", "9-thresholds", "linear", "none"]
    assert [kind.mapping for kind in kinds_over_time(study)] == ["1-threshold", "9-thresholds"]


def test_every_line_of_a_figure_is_in_its_legend() -> None:
    means = np.array([1.0, 2.0, 3.0])
    row = replace(ROW, first="control", second="1 threshold", score_first=None, optimum_first=None, score_second=0.75)
    figure = draw_comparisons([Pair(row, means, means + 5, None)], "cartpole")
    assert legend(figure) == {"random actions", "optimal return"}
    labels = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert labels == ["control\n", "1\nthreshold\nscore 0.75"]
    controls = [
        ControlReturns("cartpole", "1-threshold", "moving", 0.0, name, 2, 5.0, error, 0.0, optimum, None)
        for name, error, optimum in (("trained: control", 0.1, None), ("trained: b", 0.1, 9.0), ("silent", None, None))
    ]
    assert legend(draw_controls([("1-threshold", controls)], "cartpole")) == {
        "trained", "control", "random actions", "optimal return",
    }  # fmt: skip


def test_the_optimum_steps_with_the_simulator_in_use() -> None:
    optimum = np.array([1.0, 1.0, 7.0])
    curve = LearningCurve("a", np.array([1000.0, 2000.0, 3000.0]), np.zeros((2, 3)), np.full(3, np.nan), optimum)
    figure = draw_learning_curves([curve], "cartpole")
    (line,) = [line for line in figure.axes[0].lines if line.get_label() == "optimal return"]
    assert line.get_drawstyle() == "steps-pre"
    assert np.asarray(line.get_xdata()).tolist() == [0, 1, 2, 3]
    assert np.asarray(line.get_ydata()).tolist() == [1, 1, 1, 7]
    # What is not known, such as the optimum of a robot without a grid, has no line.
    assert "random actions" not in legend(figure)


def test_learning_curves_are_of_whole_rounds_of_episodes() -> None:
    """Four environments in step: all fail after 1 iteration, go on for 3, and fail again; the truth is -0.5 throughout.

    Each part is two iterations of all four, a round eight of each; in half of the parts only the short ones end.
    """
    iterations = 8.0 * np.arange(1, 9)
    episodes = np.array([[4, 0, 0, 4, 4, 0, 0, 4], [0, 0, 0, 0, 0, 0, 0, 0]], float)
    returns = np.array([[1, np.nan, np.nan, -2, 1, np.nan, np.nan, -2], [np.nan] * 8])
    found = over_rounds(iterations, episodes, returns, 32)
    np.testing.assert_array_equal(found[0], [np.nan] * 3 + [-0.5] * 5)
    assert np.isnan(found[1]).all()
    # Weighted by how many ended.
    uneven = over_rounds(iterations[:2], np.array([[1.0, 3.0]]), np.array([[8.0, 0.0]]), 16)
    np.testing.assert_array_equal(uneven, [[np.nan, 2.0]])
    # Shorter than a round: all there is.
    np.testing.assert_array_equal(over_rounds(iterations[:2], *(np.ones((1, 2)),) * 2, 99), [[np.nan, 1.0]])


def test_intervals_of_learning_curves_cover_what_they_say_and_one_policy_has_none() -> None:
    returns = np.random.default_rng(1).normal(size=(4, 4000))
    returns[:2, :1000] = np.nan
    mean, low, high = LearningCurve("a", np.arange(1.0, 4001.0), returns, *NOT_KNOWN).mean_with_interval()
    np.testing.assert_allclose(mean, np.nanmean(returns, axis=0))
    for some in (slice(1000), slice(1000, None)):
        assert np.mean((low[some] <= 0) & (high[some] >= 0)) == pytest.approx(0.95, abs=0.02)
    alone = LearningCurve("a", np.array([1.0, 2.0]), np.array([[5.0, np.nan]]), *NOT_KNOWN)
    np.testing.assert_equal(alone.mean_with_interval(), [[5.0, np.nan], [np.nan] * 2, [np.nan] * 2])
    assert legend(draw_learning_curves([alone], "cartpole")) == {"mean of the policies"}
    ends = LearningCurve("a", np.array([1.0]), np.array([[120.0], [-91.0]]), *NOT_KNOWN, within=(-219.0, 120.0))
    assert ends.mean_with_interval()[:, 0].tolist() == [14.5, -219.0, 120.0]


def test_an_interval_that_leaves_the_scale_ends_in_an_arrow() -> None:
    rows = [
        (score("cartpole", "a", 5.0, -500.0, 510.0, 0.0, 10.0), np.array([4.0, 6.0])),
        (score("cartpole", "b", 5.0, 4.0, 6.0, 0.0, 10.0), np.array([3.0, 7.0])),
    ]
    figure = draw_headline(rows)
    axes = figure.axes[0]
    left, right = axes.get_xlim()
    assert -1 < left < 0 and 10 < right < 11
    assert [(line.get_marker(), line.get_ydata()[0]) for line in axes.lines if line.get_marker() in "<>"] == [
        ("<", 0), (">", 0),
    ]  # fmt: skip
    for line in axes.lines:
        assert left <= min(line.get_xdata()) <= max(line.get_xdata()) <= right
    said = {"random actions", "optimal return", "95 % interval", "each policy", "their interquartile mean"}
    assert legend(figure) == said


@pytest.mark.oracle
def test_on_a_phone_the_headline_fits_the_screen(tmp_path: Path) -> None:
    rows = [
        (score(robot, arm, 5.0, 4.0, 6.0, 0.0, 10.0), np.array([3.0, 7.0]))
        for robot in ("cartpole", "navigation", "swing-up")
        for arm in ("1-threshold", "before training")
    ]
    wide, narrow = (
        save_figure(draw_headline(rows, narrow=is_narrow), tmp_path / f"{is_narrow}.png") for is_narrow in (False, True)
    )
    # Of 400 pixels 20 on either side are the page's; a figure has a hundred pixels an inch.
    assert Picture(narrow, "", "").width_px <= 400 - 2 * 20 < Picture(wide, "", "").width_px
    figure = draw_headline(rows, narrow=True)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["cartpole", "navigation", "swing-up"]
    figure.canvas.draw()
    edge_px = figure.bbox.width
    drawn = [axes.get_tightbbox() for axes in figure.axes] + [figure.legends[0].get_window_extent()]
    assert all(0 <= box.x0 < box.x1 <= edge_px for box in drawn)
    page = write_page(
        tmp_path / "page.html", "t", "l", [Section("s", pictures=(Picture(wide, "a", "b", (), narrow),))], []
    ).read_text()
    assert re.search(r'<picture><source media="[^"]*max-width[^"]*" srcset="data:image/png', page)
    assert page.count("<picture>") == page.count("</picture>") == 1
    alone = write_page(tmp_path / "one.html", "t", "l", [Section("s", pictures=(Picture(wide, "a", "b"),))], [])
    assert "<picture>" not in alone.read_text()


@pytest.mark.parametrize("part", ["file", "narrow"])
def test_a_figure_that_is_gone_is_named_by_the_error(part: str, tmp_path: Path) -> None:
    there = save_figure(
        draw_headline([(score("arm", "1-threshold", 5.0, 4.0, 6.0, 0.0, 10.0), np.ones(2))]), tmp_path / "a.png"
    )
    gone = tmp_path / "gone.png"
    picture = replace(Picture(there, "a", "b", narrow=there), **{part: gone})
    with pytest.raises(InvalidFile, match=f"^{gone}: cannot be read: No such file or directory; run the command again"):
        write_page(tmp_path / "page.html", "t", "l", [Section("s", pictures=(picture,))], [])
    assert not (tmp_path / "page.html").exists()
    with pytest.raises(InvalidFile, match=f"^{gone}: cannot be read: "):
        _ = Picture(gone, "a", "b").width_px


def test_figures_saved_in_several_threads_share_no_settings(tmp_path: Path) -> None:
    """Of two at a time the later SVG had other bytes, and matplotlib kept the settings of one for all later figures."""
    from matplotlib import rcParams

    first_began, second_began, first_ended = threading.Event(), threading.Event(), threading.Event()
    texts = []

    class First:
        def savefig(self, path: Path, **_: Any) -> None:
            first_began.set()
            # Alone it waits in vain.
            second_began.wait(0.3)
            path.touch()

    class Second:
        def savefig(self, path: Path, **_: Any) -> None:
            second_began.set()
            first_ended.wait(10.0)
            texts.append(rcParams["svg.fonttype"])
            path.touch()

    before = rcParams["svg.fonttype"]
    with ThreadPoolExecutor(2) as executor:
        first: Any = executor.submit(save_figure, First(), tmp_path / "a.svg")  # type: ignore[arg-type]
        first.add_done_callback(lambda _: first_ended.set())
        first_began.wait(10.0)
        second: Any = executor.submit(save_figure, Second(), tmp_path / "b.svg")  # type: ignore[arg-type]
        assert [first.result(), second.result()] == [tmp_path / "a.svg", tmp_path / "b.svg"]
    after, rcParams["svg.fonttype"] = rcParams["svg.fonttype"], before
    assert texts == ["none"] and after == before == "path"


def test_there_is_one_kind_of_minus() -> None:
    assert with_minus("constant -1 from -0.5 to -.5, 1.5e-05") == "constant −1 from −0.5 to −.5, 1.5e−05"
    same = "2-10 ms, p0-1, --at-min 5, tables/-1.csv, Mann-Whitney, recording_0-1, 2022-11-23"
    assert with_minus(same) == same
    assert with_minus("by 41 % (+- 9 %), of interval:5+-25%") == "by 41 % (± 9 %), of interval:5+-25%"


def test_files_that_a_page_names_are_links() -> None:
    files = ("culture-1/report.html", "my-culture-1/report.html")
    assert with_links(f"<b> & {files[1]}, {files[0]}.", files) == (
        f'&lt;b&gt; &amp; <a href="{files[1]}">{files[1]}</a>, <a href="{files[0]}">{files[0]}</a>.'
    )
    assert with_links("a/report.html -1 <", ()) == "a/report.html −1 &lt;"
    low = Pair(replace(ROW, score_first=-0.07, score_second=-0.001), *np.array([[1.0, 2.0], [1.0, 2.0]]), 0.0)
    labels = [text.get_text() for text in draw_comparisons([low], "").axes[0].get_xticklabels()]
    assert [label.split("\n")[-1] for label in labels] == ["score −0.07", "score 0.00"]


def test_links_lead_to_files_whatever_their_folders_are_called(tmp_path: Path) -> None:
    """`culture-12:30/report.html` was taken for a protocol, and all after # or ? for no part of the name."""
    names = ("day #1", "12:30", "50%", "30%25", "a?b=1", "ü & <i>", "day -1", "1e-05", "plain_1")
    files = tuple(f"culture-{name}/report.html" for name in names)
    for file in files:
        (tmp_path / file).parent.mkdir()
        (tmp_path / file).touch()
    there = save_figure(
        draw_headline([(score("arm", "1-threshold", 5.0, 4.0, 6.0, 0.0, 10.0), np.ones(2))]), tmp_path / "a.png"
    )
    points = tuple((file, f"finished: {file}") for file in files)
    tables = tuple(Table("t", ("a",), (("b",),), beside=file) for file in files)
    picture = Picture(there, "t", "c", files)
    section = Section("s", points=points, links=files, tables=tables, pictures=(picture,))
    page = write_page(tmp_path / "page.html", "t", "l", [section], []).read_text()
    found = [urlsplit(html.unescape(each)) for each in re.findall(r'href="([^"#][^"]*)"', page)]
    assert all((each.scheme, each.netloc, each.query, each.fragment) == ("", "", "", "") for each in found)
    assert [unquote(each.path) for each in found] == [*files, *files, *files]
    shown = [html.unescape(each) for each in re.findall(r"finished: <a [^>]*>([^<]*)</a>", page)]
    assert shown == [*files]


def test_optima_over_time_are_labelled_coarse_and_missing_arms_are_counted() -> None:
    minutes = np.array([0.0, 10.0])
    returns = {f"c{i}": np.zeros((2, 2)) for i in range(8)}
    panels = [
        Courses("1-threshold", minutes, returns, np.zeros(2), np.ones(2), {0.0: 1.1}),
        Courses("linear", minutes, {"linear": np.zeros((2, 2))}, np.zeros(2), np.full(2, np.nan)),
    ]
    figure = draw_returns_over_time(panels, "cartpole", trained_until_min=5.0)
    said = legend(figure)
    assert {
        "optimal return, coarse grid",
        "optimal return, fine grid",
        "random actions",
        "linear",
        "c5",
    } <= said
    assert not {"c6", "c7"} & said
    assert "2 more arms" in figure.axes[0].get_title(loc="left")
    colours = {line.get_color() for line in figure.axes[0].lines if str(line.get_label()).startswith("c")}
    (dashed,) = [line for line in figure.axes[0].lines if "coarse" in str(line.get_label())]
    assert len(colours) == 6 and dashed.get_color() not in colours
    arms = [line for axes in figure.axes for line in axes.lines if str(line.get_label()) in {*returns, "linear"}]
    assert len({(line.get_color(), line.get_marker()) for line in arms}) == len(arms) == 7


def test_the_legend_of_a_single_panel_is_whole() -> None:
    minutes = np.array([0.0, 10.0])
    names = ("before training", "without shadowing", "1 threshold")
    returns = {name: np.ones((4, 2)) for name in names}
    panel = Courses("1-threshold", minutes, returns, minutes, minutes, {0.0: 1.0})
    figure = draw_returns_over_time([panel], "cartpole", trained_until_min=5.0)
    figure.canvas.draw()
    within = figure.legends[0].get_window_extent()
    assert within.x0 >= 0 and within.x1 <= figure.bbox.width


def legend(figure: Any) -> set[str]:
    return {text.get_text() for legend in figure.legends for text in legend.get_texts()}
