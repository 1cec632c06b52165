"""The report: a study's tables and figures put together as one page."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from animat.evaluation.statistics import p_of_u
from animat.report.html import Picture, Section, Table, cell, write_page
from animat.report.style import FORMATS
from animat.studies.captions import CULTURE, ROBOT
from animat.studies.differences import came_out_otherwise, decisions
from animat.studies.folder import MANIFEST
from animat.studies.jobs import Report, Task
from animat.studies.places import REPORT, limits_file, read_table, table_file
from animat.studies.specification import Study
from animat.studies.tabulating import LEVEL


@final
@dataclass(frozen=True)
class Publish(Task):
    """Write the report."""

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        manifest = json.loads((folder / MANIFEST).read_text())
        sections = [_short(study, folder), _scores(folder)]
        if study.needs_neurons:
            sections.append(_culture(study, folder))
        sections += [_robot(folder, body.name) for body in study.robots]
        sections += [_controls(folder), _done(study)]
        if study.paper:
            sections.append(_differences(study, folder))
        if study.needs_neurons:
            sections.append(_noticed(folder))
        versions = ", ".join(f"{name} {version}" for name, version in manifest["versions"].items())
        colophon = [
            f"Made with {versions}.",
            f"Seeds: culture {study.culture.seed}, training and evaluation {study.seed}. The same study on the same "
            f"versions and machine is the same "
            "files, bit for bit.",
            f"Study {manifest['fingerprint']}",
        ]
        return [write_page(folder / REPORT, study.title, _lead(study), sections, colophon)]


def _lead(study: Study) -> str:
    robots = " and ".join(body.name for body in study.robots)
    neurons = {"virtual": "a virtual culture", "made-up": "made-up responses", "files": "recordings"}[
        study.culture.kind
    ]
    return (
        f"{robots.capitalize()}, driven through {neurons}: {len(study.conditions)} conditions with {study.policies} "
        f"policies each, " + ", ".join(f"{body.trained_for:,} iterations on {body.name}" for body in study.robots) + "."
    )


def _short(study: Study, folder: Path) -> Section:
    rows = read_table(table_file(folder, "comparisons"))
    paragraphs = []
    if study.paper and rows:
        same = sum(row["as_in_paper"] == "yes" for row in rows)
        paragraphs.append(
            f"{same} of {len(rows)} comparisons came out as in the paper: the same condition better, at p < {LEVEL:g}. "
            + ("The others are marked, and explained under Differences from the paper." if same < len(rows) else "")
        )
    smallest = p_of_u(0.0, study.policies, study.policies)
    if rows and smallest >= LEVEL:
        paragraphs.append(
            f"With {study.policies} policies a side no p can fall below {smallest:.2g}: these are the figures of a "
            "first look, and no results."
        )
    if not rows:
        paragraphs.append("The study compares no conditions; how each did is under Scores.")
    paragraphs.append(
        "A policy's performance is its mean return over the episodes. Policies are compared by the two-sided "
        "Mann-Whitney U test: p by the normal "
        "approximation with continuity correction, as in the paper, and exactly; p corrected is Holm's for the number "
        "of comparisons. The effect is the "
        "rank-biserial correlation, +1 where every policy of the second condition is better, with its 95 % bootstrap "
        "interval."
    )
    paper = ("the paper", "same") if study.paper else ()
    tests = Table(
        "Comparisons",
        ("comparison", "robot", "at (min)", "n", "U", "p", "p exact", "p corrected", "effect", "outcome", *paper),
        tuple(
            (
                row["comparison"],
                row["robot"],
                row["at_min"],
                row["n"],
                row["u"],
                row["p_normal"],
                row["p_exact"],
                row["p_holm"],
                f"{cell(row['effect'])} [{cell(row['effect_low_95'])}, {cell(row['effect_high_95'])}]",
                row["outcome"],
                *((_printed(row), row["as_in_paper"]) if study.paper else ()),
            )
            for row in rows
        ),
        note="Highlighted: not as in the paper." if study.paper else "",
        beside="tables/comparisons.csv",
        marked=tuple(i for i, row in enumerate(rows) if row["as_in_paper"] == "no"),
    )
    returns = Table(
        "The same comparisons as returns",
        (
            "first",
            "second",
            "robot",
            "mean first",
            "mean second",
            "random",
            "limit first",
            "limit second",
            "score first",
            "score second",
        ),
        tuple(
            (
                row["first"],
                row["second"],
                row["robot"],
                row["mean_first"],
                row["mean_second"],
                row["random_second"],
                row["limit_first"],
                row["limit_second"],
                row["score_first"],
                row["score_second"],
            )
            for row in rows
        ),
        note=_SCORE_NOTE,
        beside="tables/comparisons.csv",
    )
    return Section("Results in short", tuple(paragraphs), tables=(tests, returns) if rows else ())


def _printed(row: dict[str, Any]) -> str | None:
    return None if row["paper_p"] is None else f"U {cell(row['paper_u'])}, p {cell(row['paper_p'])}"


_SCORE_NOTE = (
    "Limit: the best possible return of any controller with the same neurons, mapping and robot, by dynamic "
    "programming. Score: (mean − random) / (limit − "
    "random); 0 is as good as random actions, 1 the limit, which chance can pass. For a control, whose delivery is "
    "drawn at random, random and "
    "limit are those of the delivery as chosen."
)


def _scores(folder: Path) -> Section:
    rows = read_table(table_file(folder, "scores"))
    table = Table(
        "Every condition",
        (
            "robot",
            "condition",
            "at (min)",
            "policies",
            "episodes",
            "mean",
            "s.d.",
            "interquartile mean",
            "random",
            "limit",
            "± grid",
            "without clock",
            "score",
        ),
        tuple(
            (
                row["robot"],
                row["condition"],
                row["at_min"],
                row["policies"],
                row["episodes"],
                row["mean_return"],
                row["standard_deviation"],
                f"{cell(row['interquartile_mean'])} [{cell(row['low_95'])}, {cell(row['high_95'])}]",
                row["random"],
                row["limit"],
                row["limit_grid_error"],
                row["limit_without_clock"],
                row["normalised_score"],
            )
            for row in rows
        ),
        note=_SCORE_NOTE
        + " ± grid: how far the limit moved when its grid was refined. Without clock: what the limit's controller "
        "gets if it does not know the "
        "time left, as policies do not.",
        beside="tables/scores.csv",
    )
    return Section(
        "Scores",
        ("Means over policies; the interquartile mean is that of the middle half, with its 95 % bootstrap interval.",),
        tables=(table,),
    )


def _culture(study: Study, folder: Path) -> Section:
    shares: dict[float, dict[str, float]] = {}
    for row in read_table(table_file(folder, "controllability")):
        shares.setdefault(row["at_min"], {})[row["condition"]] = row["above_median_in_data"]
    limits = {
        body.name: {
            row["at_min"]: row["best_return"] for row in read_table(limits_file(folder, body.name, "over-time"))
        }
        for body in study.robots
    }
    labels = list(next(iter(shares.values())))[:12]
    mapping = next(condition.mapping for condition in study.conditions if condition.through_neurons)
    table = Table(
        "Controllability of every recording",
        ("at (min)", *labels, "difference", *(f"limit, {robot}" for robot in limits)),
        tuple(
            (
                at_min,
                *(of[label] for label in labels),
                max(of.values()) - min(of.values()),
                *(by_minute.get(at_min) for by_minute in limits.values()),
            )
            for at_min, of in shares.items()
        ),
        note="P(x ≥ P50) of each condition: how often it answers above the median of all. A controller can only work "
        "with the difference. Limit: the "
        f"best possible return with {mapping} on a rough grid.",
        beside="tables/controllability.csv",
    )
    return Section("The culture", tables=(table,), pictures=_pictures(folder, "culture", CULTURE))


def _robot(folder: Path, robot: str) -> Section:
    return Section(robot.capitalize(), pictures=_pictures(folder, robot, ROBOT))


def _pictures(folder: Path, of: str, captions: dict[str, tuple[str, str]]) -> tuple[Picture, ...]:
    pictures = []
    for name, (title, caption) in captions.items():
        files = [Path("figures") / f"{of}-{name}.{ending}" for ending in FORMATS]
        if (folder / files[0]).exists():
            beside = tuple(file.as_posix() for file in files[1:])
            pictures.append(Picture(folder / files[0], f"{of.capitalize()}: {title}", caption, beside))
    return tuple(pictures)


def _controls(folder: Path) -> Section:
    every = read_table(table_file(folder, "controls"))
    last = max(row["at_min"] for row in every)
    rows = [row for row in every if row["at_min"] == last]
    table = Table(
        f"Controls at {last:g} min",
        ("robot", "mapping", "at (min)", "control", "actors", "mean return", "standard error"),
        tuple(
            (
                row["robot"],
                row["mapping"],
                row["at_min"],
                row["control"],
                row["actors"],
                row["mean_return"],
                row["standard_error"],
            )
            for row in rows
        ),
        beside="tables/controls.csv",
    )
    points = (
        ("random", "Any action, equally likely, whatever is observed."),
        ("constant", "One stimulus always (without neurons: one command)."),
        (
            "made by hand",
            "A rule instead of learning: the stimulus whose mean command lies farthest to the side where the pole "
            "will lean in 0.1 s, or where the goal lies.",
        ),
        ("silent", "The trained policies on a culture that always answers 0."),
        ("shuffled", "The trained policies, but the stimulus that is delivered is drawn at random."),
    )
    return Section("Is it the culture?", ("Each control takes something away.",), points, (table,))


def _done(study: Study) -> Section:
    culture, simulators = study.culture, study.simulators
    if culture.kind == "files":
        recorded = f"Recordings from files: {', '.join(culture.files)}."
    else:
        recorded = (
            f"{culture.sessions} recordings, one every {culture.interval_min:g} min, of the {culture.kind} culture of "
            f"seed {culture.seed}; stimuli "
            f"{culture.order}, {culture.pulses} pulse(s) a presentation, {culture.presentations} presentations of each."
        )
    points = [
        ("Recordings", recorded),
        (
            "Simulators",
            f"{simulators.kind}"
            + (f", {simulators.bins} bins" if simulators.kind == "histogram" else "")
            + f"; responses from {simulators.window_ms[0]:g} to {simulators.window_ms[1]:g} ms; bursts set apart "
            + ("by Otsu's method." if simulators.burst_threshold is None else f"above {simulators.burst_threshold:g}."),
        ),
        (
            "Training",
            f"{study.policies} policies of each condition, each from its own random numbers; training stands for "
            f"{study.training_min:g} min of the culture's clock.",
        ),
    ]
    points.append(("Evaluation", _ACTIONS[study.actions]))
    for condition in study.conditions:
        said = [f"mapping {condition.mapping}" if condition.through_neurons else "the robot is moved directly"]
        if condition.through_neurons:
            said.append(
                "simulators refreshed during training" if condition.shadowing else "the first simulator throughout"
            )
        if condition.delivery == "shuffled":
            said.append("the delivered stimulus is drawn at random, in training and in evaluation")
        if condition.percentiles == "first":
            said.append("percentiles of the first recording held")
        if not condition.trained:
            said.append("not trained")
        points.append((f"Condition: {condition.name}", "; ".join(said) + "."))
    return Section("How it was done", points=tuple(points))


_ACTIONS = {
    "most probable": "Policies take their most probable action.",
    "drawn": "Policies draw their actions, as in training.",
}


def _differences(study: Study, folder: Path) -> Section:
    rows = read_table(table_file(folder, "comparisons"))
    otherwise = came_out_otherwise(rows)
    return Section(
        "Differences from the paper",
        (
            "Sawada, Wake, Sasabuchi, Takamatsu, Takahashi, Ikeuchi: Design strategies for controlling "
            "neuron-connected robots using reinforcement learning "
            "(2022). First what came out otherwise, then what was decided where the paper is silent or contradicts "
            "itself.",
            "" if otherwise else "Every comparison came out as in the paper.",
        ),
        (*otherwise, *decisions(study)),
    )


def _noticed(folder: Path) -> Section:
    rows = read_table(table_file(folder, "findings"))
    grave = [row for row in rows if row["severity"] != "note"]
    notes = len(rows) - len(grave)
    shown = tuple((row["name"], row["sentence"]) for row in grave)
    said = (
        f"{len(grave)} warnings and {notes} notes on the recordings and the simulators made of them; all are in "
        "tables/findings.csv."
    )
    table: tuple[Any, ...] = (
        (Table("Warnings", ("finding", "what"), shown, beside="tables/findings.csv"),) if shown else ()
    )
    return Section("What was noticed", (said,), tables=table)
