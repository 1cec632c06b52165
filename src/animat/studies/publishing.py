"""The report: a study's tables and figures put together as one page."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, final

from animat.evaluation.optimum import bracket_findings
from animat.evaluation.statistics import p_of_u
from animat.neurons.fidelity import LARGEST_LOSS
from animat.report.html import Picture, Section, Table, cell, write_page
from animat.report.style import FORMATS
from animat.studies.captions import CULTURE, ROBOT
from animat.studies.differences import came_out_otherwise, decisions
from animat.studies.folder import MANIFEST
from animat.studies.jobs import Report, Task
from animat.studies.learned import as_good_as_the_limit_allows, learned_of
from animat.studies.limits import rough_kinds
from animat.studies.places import REPORT, limits_file, read_table, table_file
from animat.studies.specification import Study
from animat.studies.tabulating import AIM, LEVEL, named_mapping

Columns: TypeAlias = list[tuple[str, "str | Callable[[dict[str, Any]], Any]"]]

_MOST_LABELS = 12


@final
@dataclass(frozen=True)
class Publish(Task):
    """Write the report."""

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        manifest = json.loads((folder / MANIFEST).read_text())
        sections = [_short(study, folder), _scores(study, folder)]
        if study.needs_neurons:
            sections.append(_culture(study, folder))
        sections += [_robot(folder, body.name) for body in study.robots]
        sections += [_controls(study, folder), _done(study)]
        if study.paper:
            sections.append(_differences(study, folder))
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


def _columns(rows: Sequence[dict[str, Any]], columns: Columns) -> tuple[tuple[str, ...], tuple[tuple[Any, ...], ...]]:
    """Head and cells of a table: a column is a name and the key, or a function of the row."""
    cells = tuple(tuple(key(row) if callable(key) else row[key] for _, key in columns) for row in rows)
    return tuple(name for name, _ in columns), cells


def _pair(value: str, error: str) -> Callable[[dict[str, Any]], str | None]:
    return lambda row: None if row[value] is None else f"{cell(row[value])}\u00a0±\u00a0{cell(row[error])}"


def _interval(value: str, low: str, high: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: f"{cell(row[value])} [{cell(row[low])}, {cell(row[high])}]".replace(" ", "\u00a0")


def _short(study: Study, folder: Path) -> Section:
    rows = read_table(table_file(folder, "comparisons"))
    paragraphs = []
    printed = [row for row in rows if row["paper_p"] is not None]
    if printed:
        paragraphs.append(_as_in_paper(printed))
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
        "Mann-Whitney U test: p by the normal approximation with continuity correction, as in the paper, and "
        "exactly; p "
        "corrected is Holm's for the number of comparisons. The outcome, and stars in figures, go by the first of the "
        f"three: the better one of two conditions counts as found at p < {LEVEL:g}; that none was found does not say "
        f"that "
        "there is no difference. The effect is the rank-biserial correlation, +1 where every policy of the second "
        "condition is better, with Newcombe's 95 % interval."
    )
    columns: Columns = [
        ("comparison", "comparison"),
        ("robot", "robot"),
        ("at (min)", "at_min"),
        ("n", "n"),
        ("U", "u"),
        ("p", "p_normal"),
        ("p exact", "p_exact"),
        ("p corrected", "p_holm"),
        ("effect", _interval("effect", "effect_low_95", "effect_high_95")),
        ("outcome", "outcome"),
    ]
    if printed:
        columns += [("the paper's p (U it implies)", _printed), ("as in the paper", "as_in_paper")]
    tests = Table(
        "Comparisons",
        *_columns(rows, columns),
        note="The paper prints p and no U; U is the one that gives this p. Highlighted: not as in the paper."
        if printed
        else "",
        beside="tables/comparisons.csv",
        marked=tuple(i for i, row in enumerate(rows) if row["as_in_paper"] == "no"),
    )
    returns = Table(
        "The same comparisons as returns",
        *_columns(
            rows,
            [
                ("first", "first"),
                ("second", "second"),
                ("robot", "robot"),
                ("mean first", "mean_first"),
                ("mean second", "mean_second"),
                ("random", "random_second"),
                ("limit first", _pair("limit_first", "limit_error_first")),
                ("limit second", _pair("limit_second", "limit_error_second")),
                ("score first", "score_first"),
                ("score second", "score_second"),
            ],
        ),
        note=_SCORE_NOTE + " ±: how far it may lie from there, by the grid, or down to its controller's return.",
        beside="tables/comparisons.csv",
    )
    return Section("Results in short", tuple(paragraphs), tables=(tests, returns) if rows else ())


def _as_in_paper(rows: list[dict[str, Any]]) -> str:
    """How many of the paper's comparisons came out as there; what cannot be told is neither yes nor no."""
    told = Counter(row["as_in_paper"] for row in rows)
    words = f"{told['yes']} of {len(rows)} comparisons came out as in the paper: the same one better, at p < {LEVEL:g}."
    if told["cannot tell"]:
        words += f" Of {told['cannot tell']} it cannot be told, with as few policies."
    if told["no"]:
        words += f" {told['no']} came out otherwise: highlighted, and explained under Differences from the paper."
    return words


def _printed(row: dict[str, Any]) -> str | None:
    return None if row["paper_p"] is None else f"{cell(row['paper_p'])}\u00a0({cell(row['paper_u'])})"


_SCORE_NOTE = (
    "Limit: the best possible return of any controller with the same neurons, mapping and robot, by dynamic "
    "programming. Score: (mean − random) / (limit − random); 0 is as good as random actions, 1 the limit, which "
    "chance can "
    "pass. A control, whose delivery is drawn at random, has no limit: whatever it chooses is as good as random."
)


def _scores(study: Study, folder: Path) -> Section:
    rows = read_table(table_file(folder, "scores"))
    scores = Table(
        "Every condition",
        *_columns(
            rows,
            [
                ("robot", "robot"),
                ("condition", "condition"),
                ("at (min)", "at_min"),
                ("policies", "policies"),
                ("episodes", "episodes"),
                ("mean", "mean_return"),
                ("s.d.", "standard_deviation"),
                ("interquartile mean", _interval("interquartile_mean", "low_95", "high_95")),
                ("random", "random"),
                ("limit", "limit"),
                ("score", "normalised_score"),
            ],
        ),
        note=_SCORE_NOTE,
        beside="tables/scores.csv",
    )
    limits = read_table(table_file(folder, "limits"))
    best = Table(
        "Best possible returns",
        *_columns(
            limits,
            [
                ("robot", "robot"),
                ("mapping", lambda row: named_mapping(row["mapping"], row["percentiles"])),
                ("at (min)", "at_min"),
                ("limit ± grid", _pair("best_return", "grid_error")),
                ("its controller, run", _pair("monte_carlo", "standard_error")),
                ("without clock", _pair("without_clock", "without_clock_standard_error")),
                ("nodes", "nodes"),
            ],
        ),
        note="± grid: how far the value moved from a grid with 3/4 of the steps. Run: the mean return of the "
        "controller that "
        "takes the best actions, on the robot itself, ± its standard error: a return that can be had. The best "
        "possible "
        "return lies between the two; scores keep to the value, the upper end. Highlighted: they part by more than 3 "
        "standard "
        "errors and the grid's error. Without clock: the same controller if it does not know the time left, as "
        "policies do "
        "not. On a rough grid at every recording: limits/.",
        beside="tables/limits.csv",
        marked=tuple(i for i, row in enumerate(limits) if _parted(row)),
    )
    learned = learned_of(study, rows)
    tables: tuple[Table, ...] = (scores, best)
    paragraphs = [
        "Means over policies; the interquartile mean is that of the middle half, with its 95 % interval by Student's t."
    ]
    if learned:
        paragraphs.append(
            f"As good as the limit allows: a score of {AIM:g} on the very simulator that policies were trained on is "
            f"what "
            "learning should come to. Conditions whose simulators are refreshed during training are not asked this, "
            "as they "
            "are trained on several."
        )
        tables = (as_good_as_the_limit_allows(learned), *tables)
    return Section("Scores", tuple(paragraphs), tables=tables)


def _parted(row: dict[str, Any]) -> bool:
    return bool(bracket_findings(row["best_return"], row["grid_error"], row["monte_carlo"], row["standard_error"]))


def _culture(study: Study, folder: Path) -> Section:
    in_data: dict[float, dict[str, float]] = defaultdict(dict)
    in_simulator: dict[float, dict[str, float]] = defaultdict(dict)
    for row in read_table(table_file(folder, "controllability")):
        in_data[row["at_min"]][row["condition"]] = row["above_median_in_data"]
        in_simulator[row["at_min"]][row["condition"]] = row["above_median_in_simulator"]
    kinds = rough_kinds(study)[:1]
    limits = {
        body.name: {
            row["at_min"]: row["best_return"]
            for row in read_table(limits_file(folder, body.name, "over-time"))
            if (row["mapping"], row["percentiles"]) == (kinds[0].mapping, kinds[0].percentiles)
        }
        for body in study.robots
        if kinds
    }
    every = list(next(iter(in_data.values())))
    labels = every[:_MOST_LABELS]
    lost = {at_min: max(abs(of[x] - in_simulator[at_min][x]) for x in every) for at_min, of in in_data.items()}
    rows = []
    for at_min, of in in_data.items():
        drawn = in_simulator[at_min]
        shares = (
            f"{of[x]:.2f}\u00a0→\u00a0{drawn[x]:.2f}" if abs(of[x] - drawn[x]) > LARGEST_LOSS else of[x] for x in labels
        )
        apart = (max(each.values()) - min(each.values()) for each in (of, drawn))
        rows.append((at_min, *shares, *apart, *(by_minute.get(at_min) for by_minute in limits.values())))
    note = (
        "P(x ≥ P50) of each condition: how often it answers above the median of all. A controller can only work with "
        "the "
        "difference between them, and of that with what the simulator keeps of the responses. Highlighted, with an "
        "arrow: "
        f"binning moves a share by more than {LARGEST_LOSS:g}, and what the simulator, limits and policies have is "
        f"not what "
        "the culture would give."
    )
    if kinds:
        mapping = named_mapping(kinds[0].mapping, kinds[0].percentiles)
        note += f" Limit: the best possible return with {mapping} on a rough grid."
    if len(every) > len(labels):
        note += f" {len(every) - len(labels)} more conditions are in the file; the differences are over all."
    table = Table(
        "Controllability of every recording",
        ("at (min)", *labels, "difference, data", "difference, simulator", *(f"limit, {robot}" for robot in limits)),
        tuple(rows),
        note=note,
        beside="tables/controllability.csv",
        marked=tuple(i for i, loss in enumerate(lost.values()) if loss > LARGEST_LOSS),
    )
    return Section("The culture", tables=(table,), pictures=_pictures(folder, "culture", CULTURE))


def _robot(folder: Path, robot: str) -> Section:
    return Section(robot.capitalize(), pictures=_pictures(folder, robot, ROBOT))


_NUMBERS = {"learning": "learning-curves", "comparisons": "comparisons", "controls": "controls"}
"""Tables that hold what figures of a robot show."""


def _pictures(folder: Path, of: str, captions: dict[str, tuple[str, str]]) -> tuple[Picture, ...]:
    pictures = []
    for name, (title, caption) in captions.items():
        files = [Path("figures") / f"{of}-{name}.{ending}" for ending in FORMATS]
        if (folder / files[0]).exists():
            beside = tuple(file.as_posix() for file in files[1:])
            if name in _NUMBERS:
                beside = (*beside, f"tables/{_NUMBERS[name]}.csv")
            pictures.append(Picture(folder / files[0], f"{of.capitalize()}: {title}", caption, beside))
    return tuple(pictures)


def _controls(study: Study, folder: Path) -> Section:
    rows = read_table(table_file(folder, "controls"))
    table = Table(
        "Controls",
        *_columns(
            rows,
            [
                ("robot", "robot"),
                ("mapping", lambda row: named_mapping(row["mapping"], row["percentiles"])),
                ("at (min)", lambda row: None if row["mapping"] == "none" else row["at_min"]),
                ("control", "control"),
                ("actors", "actors"),
                ("mean return", _pair("mean_return", "standard_error")),
                ("random", "random"),
                ("limit", "limit"),
                ("score", "normalised_score"),
            ],
        ),
        note="Trained policies stand beside their controls. ±: standard error over actors, of one actor over its "
        "episodes."
        + (
            " Without neurons, where any command can be chosen, none is held constant."
            if any(row["mapping"] == "none" for row in rows) and "navigation" in {body.name for body in study.robots}
            else ""
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
            f"{study.policies} policies of each condition on each robot, each from random numbers of its own; "
            f"training stands for "
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
    rows = [row for row in read_table(table_file(folder, "comparisons")) if row["paper_p"] is not None]
    lost: dict[float, float] = {}
    for row in read_table(table_file(folder, "controllability")) if study.needs_neurons else ():
        loss = abs(row["above_median_in_data"] - row["above_median_in_simulator"])
        lost[row["at_min"]] = max(lost.get(row["at_min"], 0.0), loss)
    otherwise = came_out_otherwise(rows, lost)
    paragraphs = [
        "Sawada, Wake, Sasabuchi, Takamatsu, Takahashi, Ikeuchi: Design strategies for controlling neuron-connected "
        "robots "
        "using reinforcement learning (2022). First what came out otherwise, then what was decided where the paper is "
        "silent or contradicts itself."
    ]
    if rows and not otherwise:
        paragraphs.append("Every comparison came out as in the paper.")
    return Section("Differences from the paper", tuple(paragraphs), (*otherwise, *decisions(study)))


def _noticed(folder: Path) -> Section:
    rows = read_table(table_file(folder, "findings"))
    grave = [row for row in rows if row["severity"] != "note"]
    notes = len(rows) - len(grave)
    shown = tuple((row["name"], row["sentence"]) for row in grave)
    said = (
        f"{len(grave)} warnings and {notes} notes on the recordings, the simulators made of them and the limits; all "
        f"are in "
        "tables/findings.csv."
    )
    table: tuple[Any, ...] = (
        (Table("Warnings", ("finding", "what"), shown, beside="tables/findings.csv"),) if shown else ()
    )
    return Section("What was noticed", (said,), tables=table)
