"""The report: a study's tables and figures on one page."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from animat.errors import counted
from animat.neurons.fidelity import Fidelity
from animat.neurons.timeline import load_timeline
from animat.progress import Progress
from animat.recordings.findings import without_notes
from animat.report.html import Picture, Section, Table, cell, picture_of, write_page
from animat.report.results import ComparedReturns, ControlReturns, Results, Score
from animat.report.returns import draw_headline
from animat.report.style import save_figure, save_formats
from animat.responses.responses import Responses
from animat.studies import report_tables
from animat.studies.arms import arm_differences, arms_table, capitalised, describe_mapping, summarise_arms
from animat.studies.captions import BURSTS, CULTURE, HEADLINE, NO_BURSTS, ROBOT, Caption
from animat.studies.differences import decisions, differing_comparisons, too_few_policies
from animat.studies.folder import MANIFEST, REPORT, RESULTS, TIMELINE
from animat.studies.outperforming import describe_reflexes, not_outperforming
from animat.studies.pictures import round_of
from animat.studies.recording import controllability, read_series
from animat.studies.results import read_typed
from animat.studies.specification import Arm, Study
from animat.studies.tabulating import FIRST, LEFT_OUT, LEVEL, NONE, SECOND, TOO_FEW, all_episodes, performances
from animat.studies.task import StudyTask
from animat.studies.toml import study_to_toml


class Publish(StudyTask):
    """Write the report."""

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        study, manifest = self.study, json.loads((folder / MANIFEST).read_text())
        results = read_typed(folder / RESULTS, Results)
        kept: dict[float, Fidelity] = {}
        series: list[Responses] = []
        if study.needs_neurons:
            kept = controllability(load_timeline(folder / TIMELINE))
            series = read_series(study, folder, as_one=True)
        table = all_episodes(study, folder, study.robots)
        # Each arm at the last recording that it was evaluated on, as its scores are in the order of its minutes.
        last = {(row.robot, row.arm): row for row in results.scores}.values()
        headline = [(row, performances(table, row.robot, study.arm(row.arm), row.at_min, row.episodes)) for row in last]
        drawn = save_formats(draw_headline(headline), folder, "figures/headline")
        narrow = save_figure(draw_headline(headline, narrow=True), folder / "figures" / "headline-narrow.png")
        title, caption = "Every arm on every robot", HEADLINE.format(**_facts_of(study))
        picture = picture_of(folder, "figures/headline", title, caption, "tables/scores.csv", narrow=narrow)
        sections = [_summary(study, results, [row for row, _ in headline], picture)]
        for spec in study.robots:
            pictures = _pictures(folder, spec.name, ROBOT, {**_facts_of(study), "round": f"{round_of(study, spec):,}"})
            sections.append(Section(capitalised(spec.name), pictures=pictures))
        if kept:
            tables = (report_tables.controllability_table(study, folder, kept),)
            pictures = _pictures(folder, "culture", CULTURE, _facts_of_culture(series))
            sections.append(Section("The culture", tables=tables, pictures=pictures))
        sections += [_controls(study, results), _compared(study, results), _scores(results)]
        if study.paper:
            sections.append(_differences(study, results, kept, series))
        settings = "All settings, as in study.toml, with which animat study makes the same study again"
        if study.culture.kind == "files":
            settings += ", provided that the files are at the same paths relative to study.toml"
        sections += [_findings(results), Section("How it was done", (f"{settings}.",), verbatim=study_to_toml(study))]
        page = write_page(folder / REPORT, study.title, _lead(study), sections, _colophon(study, manifest))
        return [*drawn, narrow, page]


def _lead(study: Study) -> str:
    robots = _and([spec.name for spec in study.robots])
    neurons = {"virtual": "through a virtual culture", "files": "through recordings"}[study.culture.kind]
    driven = neurons if study.needs_neurons else "without neurons"
    trained = _and([f"{spec.trained_for:,} iterations on {spec.name}" for spec in study.robots])
    return f"{capitalised(robots)}, driven {driven}. {summarise_arms(study)}, trained for {trained}."


def _colophon(study: Study, manifest: Mapping[str, Any]) -> list[str]:
    versions = ", ".join(f"{name} {version}" for name, version in manifest["versions"].items())
    # Recordings from files have no seed.
    is_grown = study.needs_neurons and study.culture.kind == "virtual"
    seeds = f"culture {study.culture.seed}, " if is_grown else ""
    return [
        f"Made with {versions}.",
        f"Seeds: {seeds}training and evaluation {study.seed}. The same study with the same versions on the same "
        "machine has the same results, bit for bit.",
        f"Study {manifest['fingerprint']}",
    ]


def _and(parts: Sequence[str]) -> str:
    return " and ".join([*([", ".join(parts[:-1])] if parts[1:] else []), *parts[-1:]])


def _found_better(rows: Sequence[ComparedReturns]) -> str:
    found = sum(row.outcome == SECOND for row in rows)
    if all(row.outcome == TOO_FEW for row in rows):
        return "With so few policies it is not known whether the second arm is better."
    if len(rows) == 1:
        return f"The second arm was {'' if found else 'not '}found to be better."
    return f"In {found} of {len(rows)} comparisons the second arm was found to be better."


def _summary(study: Study, results: Results, headline: Sequence[Score], picture: Picture) -> Section:
    """The best arm on each robot, the same with random stimuli, and how many comparisons agree with the paper."""
    chosen = {arm.name for arm in study.arms if arm.trained and arm.through_neurons and arm.delivery == "chosen"}
    sentences, explained = [], []
    for spec in study.robots:
        of_robot = [row for row in headline if row.robot == spec.name]
        best = max((row for row in of_robot if row.arm in chosen), key=lambda row: row.interquartile_mean, default=None)
        if best is not None:
            at_random = _at_random(spec.name, study.arm(best.arm), results.controls)
            mapping = f"In “{best.arm}” {describe_mapping(study.arm(best.arm))}"
            text = f"{capitalised(spec.name)}: {_describe(best)}{at_random}"
            sentences.append(text if mapping in explained else f"{text} {mapping}")
            explained.append(mapping)
    rows = results.comparisons
    printed = [row for row in rows if row.paper_p is not None]
    if printed:
        differing = [row for row in printed if row.as_in_paper == "no"]
        parts = [each for row in differing for each in arm_differences(study.arm(row.first), study.arm(row.second))]
        explain = [each for each in dict.fromkeys(parts) if each not in explained]
        if differing:
            explain.append("The section “Differences from the paper” says what is known about the reasons.")
        sentences.append(" ".join([_as_in_paper(printed), *explain]))
    elif rows:
        sentences.append(_found_better(rows))
    if rows and (why := too_few_policies(study.policies)):
        sentences.append(f"{why}: this is a first look, not a result.")
    return Section("Results in short", tuple(sentences), pictures=(picture,), tables=(arms_table(study),))


def _describe(row: Score) -> str:
    """The result in one sentence, and its numbers in another."""
    references = [("random actions", row.random), ("the optimal controller", row.optimum)]
    known = [f"that of {name} {cell(value)}" for name, value in references if value is not None]
    numbers = ", ".join((f"interquartile mean return is {cell(row.interquartile_mean)}", *known)) + "."
    low, high = row.low_95, row.high_95
    if row.random is None or low is None or high is None:
        return f"of the policies trained as “{row.arm}” the {numbers}"
    if low > row.random:
        result = "do better than random actions"
        if row.optimum is not None and row.optimum > row.random:
            way = (row.interquartile_mean - row.random) / (row.optimum - row.random)
            result += f": {100 * way:.0f} % of the way to the optimal controller"
    else:
        result = "do worse than random actions" if high < row.random else "are not found to differ from random actions"
    return f"policies trained as “{row.arm}” {result}. Their {numbers}"


def _at_random(robot: str, arm: Arm, controls: Sequence[ControlReturns]) -> str:
    """The mean return of the control with stimuli drawn at random, in a sentence."""
    kind = robot, arm.mapping, arm.percentiles, "shuffled"
    of = [row for row in controls if (row.robot, row.mapping, row.percentiles, row.control) == kind]
    return f" With stimuli delivered at random, the mean return is {cell(of[-1].mean_return)}." if of else ""


def _compared(study: Study, results: Results) -> Section:
    rows = results.comparisons
    if not rows:
        return Section("Comparisons", ("The study compares no arms; the results of each are under Scores.",))
    method = (
        "A policy's performance is its mean return over the episodes. Policies are compared by the two-sided "
        "Mann-Whitney U test: p by the normal approximation with continuity correction, as in the paper, and "
        "exactly; p corrected is Holm's for the number of comparisons. Stars in figures are of the corrected p. The "
        "outcome is decided by the first p, as in the paper: an arm counts as better at p < "
        f"{LEVEL:g}, and where the corrected p is not below that, the table says so. That no difference was found does "
        "not mean that there is none. The effect is the rank-biserial correlation, +1 where every policy of the second "
        "arm is better, with Newcombe's 95 % interval."
    )
    tables = report_tables.comparisons_table(rows), report_tables.returns_table(rows)
    return Section("Comparisons", (method,), tables=tables)


def _as_in_paper(rows: Sequence[ComparedReturns]) -> str:
    """How many comparisons agree with the paper; undecided ones neither agree nor disagree."""
    count = Counter(row.as_in_paper for row in rows)
    if count["cannot tell"] == len(rows):
        which = "comparison agrees" if len(rows) == 1 else f"{len(rows)} comparisons agree"
        return f"With so few policies it is not known whether the {which} with the paper."
    comparisons = "1 comparison" if len(rows) == 1 else f"{len(rows)} comparisons"
    agree = "agrees" if count["yes"] == 1 else "agree"
    text = f"{count['yes']} of {comparisons} {agree} with the paper: the same arm was better, at p < {LEVEL:g}."
    if count["cannot tell"]:
        text += f" For {count['cannot tell']} there are too few policies."
    if count["no"]:
        differ = "; ".join(_describe_differing([row for row in rows if row.as_in_paper == "no"]))
        text += f" {count['no']} came out differently: {differ}."
    return text


def _describe_differing(rows: Sequence[ComparedReturns]) -> Iterator[str]:
    """How comparisons differ from the paper, those of the same arms together."""
    for first, second in dict.fromkeys((row.first, row.second) for row in rows):
        on: dict[str, list[str]] = {}
        for row in (row for row in rows if (row.first, row.second) == (first, second)):
            on.setdefault(row.outcome, []).append(row.robot)
        better = [f"“{first}” was better on {' and '.join(on[FIRST])}"] if FIRST in on else []
        none = [f"no difference was found on {' or '.join(on[NONE])}"] if NONE in on else []
        yield f"the paper found “{second}” better than “{first}”, but here {' and '.join(better + none)}"


def _scores(results: Results) -> Section:
    note = (
        "Means over policies; the interquartile mean is that of the middle half, with its 95 % interval by Student's t."
    )
    goals = (report_tables.goals_table(results),) if results.goals else ()
    optima = report_tables.optima_table(results.optima)
    return Section("Scores", (note,), tables=(report_tables.scores_table(results), optima, *goals))


def _facts_of(study: Study) -> dict[str, str]:
    """The placeholders in captions of a robot's figures."""
    return {
        "policies": counted(study.policies, "policy", "policies"),
        "episodes": counted(study.episodes, "episode"),
        "episodes_over_time": counted(study.episodes_over_time, "episode"),
    }


def _facts_of_culture(series: Sequence[Responses]) -> dict[str, str]:
    """The placeholders in captions of the culture's figures."""
    return {
        "channels": counted(series[0].n_channels, "channel"),
        "responses": counted(len(series[0]), "response"),
        "recordings": counted(len(series), "recording"),
        "cut": BURSTS if series[0].is_burst.any() else NO_BURSTS,
    }


def _pictures(folder: Path, of: str, captions: Mapping[str, Caption], facts: Mapping[str, str]) -> tuple[Picture, ...]:
    """The figures that were drawn; `facts` fill the placeholders in captions."""
    pictures = []
    for name, (title, caption, numbers) in captions.items():
        file, files = f"figures/{of}-{name}", (each.format(of=of) for each in numbers)
        if (folder / f"{file}.png").exists():
            pictures.append(picture_of(folder, file, f"{capitalised(of)}: {title}", caption.format(**facts), *files))
    return tuple(pictures)


def _controls(study: Study, results: Results) -> Section:
    points = (
        ("random", "Any action, equally likely, whatever is observed."),
        ("constant", "Always the same stimulus (without neurons: the same command)."),
        (
            "heuristic",
            "A rule instead of learning: the stimulus whose mean command is nearest to a push to the side where the "
            "pole will lean in 0.1 s, to a turn towards the goal, or to the command of another robot's rule.",
        ),
        ("silent", "The trained policies, but no pulse; the activity without stimuli is read (0 on a simulator)."),
        ("shuffled", "The trained policies, but the delivered stimulus is drawn at random."),
        (
            "coupling",
            "The best reflex: a fixed rule from sensed values to a stimulus, without memory and without a goal.",
        ),
    )
    comparisons = report_tables.heuristic_table(results), report_tables.reflexes_table(results)
    sentences = [*(f"{each}." for each in not_outperforming(results)), *describe_reflexes(results.reflexes)]
    paragraphs = ("Each control removes something.", *map(capitalised, sentences))
    tables = (*(table for table in comparisons if table.rows), report_tables.controls_table(study, results))
    return Section("Is it the culture?", paragraphs, points, tables)


def _differences(study: Study, results: Results, kept: dict[float, Fidelity], series: Sequence[Responses]) -> Section:
    rows = [row for row in results.comparisons if row.paper_p is not None]
    differing = tuple(differing_comparisons(rows, {at_min: of.largest_loss for at_min, of in kept.items()}))
    paragraphs = [
        "Sawada, Wake, Sasabuchi, Takamatsu, Takahashi, Ikeuchi: Design strategies for controlling neuron-connected "
        "robots using reinforcement learning (2022). First the results that differ, then the decisions taken where the "
        "paper is silent or contradicts itself."
    ]
    if rows and not differing:
        paragraphs.append("Every comparison agrees with the paper.")
    return Section("Differences from the paper", tuple(paragraphs), (*differing, *decisions(study, series)))


def _findings(results: Results) -> Section:
    file = "tables/findings.csv"
    warnings = tuple((finding.name, finding.message) for finding in without_notes(results.findings))
    counts = (
        f"{counted(len(warnings), 'warning')} and {counted(len(results.findings) - len(warnings), 'note')} on the "
        f"recordings, the simulators made from them and the optima; all are in {file}."
    )
    tables = (Table("Warnings", ("finding", "message"), warnings, beside=file),) if warnings else ()
    left_out = tuple(("Left out", f"{finding.message}.") for finding in results.findings if finding.name == LEFT_OUT)
    return Section("Findings", (counts,), left_out, tables, links=(file,))
