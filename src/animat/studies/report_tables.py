"""The tables of the report: which columns and rows of the study's results they show, and their notes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from animat.evaluation.statistics import MOST_PAIRS, OUTPERFORMED_P
from animat.neurons.fidelity import LARGEST_LOSS, Fidelity
from animat.report.html import Columns, Table, cell, columns_of, table_of, with_error
from animat.report.results import ComparedReturns, Results, StudyOptimum
from animat.responses.quality.responses import FEW_SAMPLES
from animat.studies.optima import complete_optima, key_of, kinds_over_time, read_optima
from animat.studies.outperforming import NOT
from animat.studies.specification import Study, mapping_label
from animat.studies.tabulating import FIRST, LEVEL, SECOND

_MOST_LABELS = 12
_MOST_ROWS = 40

_SCORE_NOTE = (
    "Optimum: the optimal return of any controller with the same neurons, mapping and robot, by dynamic "
    "programming. Score: (mean − random) / (optimum − random); 0 is as good as random actions, 1 is the optimum, which "
    "can be exceeded by chance. Scores are too high where the optimum's own controller returns more than it (“Optimal "
    "returns”). A control, whose delivered stimuli are drawn at random, has no optimum: whatever it chooses is as good "
    "as random."
)


def comparisons_table(rows: Sequence[ComparedReturns]) -> Table:
    """Tests and outcomes, with the paper's p where it printed one."""
    columns: Columns = [
        *columns_of("comparison", "robot", "at_min", "n"),
        ("U", "u"),
        ("p", "p_normal"),
        ("p exact", lambda row: row.p_exact if row.n**2 <= MOST_PAIRS else None),
        ("p corrected", "p_holm"),
        ("effect", _interval("effect", "effect_low_95", "effect_high_95")),
        ("outcome", _outcome),
    ]
    note = ""
    if any(row.paper_p is not None for row in rows):
        columns += [("the paper's p (U it implies)", _printed), ("as in the paper", "as_in_paper")]
        note = "The paper prints p but not U; U is the value that gives this p. Highlighted: not as in the paper."
    marked = tuple(i for i, row in enumerate(rows) if row.as_in_paper == "no")
    return table_of("Comparisons", rows, columns, note=note, beside="tables/comparisons.csv", marked=marked)


def returns_table(rows: Sequence[ComparedReturns]) -> Table:
    """The comparisons as mean returns, optima and scores."""
    columns = columns_of("first", "second", "robot", "mean_first", "mean_second", "random_second")
    columns += [(f"optimum {side}", _pair(f"optimum_{side}", f"optimum_error_{side}")) for side in ("first", "second")]
    columns += columns_of("score_first", "score_second")
    note = _SCORE_NOTE + " ±: its possible error, due to the grid, or down to the return of its controller."
    return table_of("The same comparisons as returns", rows, columns, note=note, beside="tables/comparisons.csv")


def scores_table(results: Results) -> Table:
    """Every arm at every minute at which it was evaluated."""
    columns: Columns = [
        *columns_of("robot", "arm", "at_min", "policies", "episodes"),
        ("mean", "mean_return"),
        ("s.d.", "standard_deviation"),
        ("interquartile mean", _interval("interquartile_mean", "low_95", "high_95")),
        *columns_of("random", "optimum"),
        ("score", "normalised_score"),
    ]
    return table_of("Every arm", results.scores, columns, note=_SCORE_NOTE, beside="tables/scores.csv")


def optima_table(optima: Sequence[StudyOptimum]) -> Table:
    """The optimal returns as brackets, with their intervals and the conditions that were left out."""
    columns: Columns = [
        ("robot", "robot"),
        ("mapping", lambda row: mapping_label(row.mapping, row.percentiles)),
        *columns_of("at_min"),
        ("optimum ± grid", _pair("best_return", "grid_error")),
        ("95 % interval", lambda row: None if row.low_95 is None else _ends(row.low_95, row.high_95)),
        ("its controller, run", _pair("monte_carlo", "standard_error")),
        ("without clock", _pair("without_clock", "without_clock_standard_error")),
        ("nodes", "nodes"),
    ]
    note = (
        "± grid: by how much the value differs from that on a grid with 3/4 of the steps. Interval: how well the "
        "responses determine the value, bootstrapped 39 times; for threshold mappings, where an arm is evaluated. "
        "Run: the mean return of the controller that takes the best actions, on the robot itself, ± its standard "
        "error: a return that is achievable. The optimal return lies between the two; scores use the value, the upper "
        "end. Highlighted: the two differ by more than 3 standard errors and the grid's error. If the controller "
        "returns more, the grid is too coarse, and scores are too high. Without clock: the same controller without "
        "knowledge of the time left, which policies do not have either. Optima at every recording, on a coarse grid, "
        "are in optima/."
    )
    without = [row for row in optima if row.left_out is not None]
    if without:
        columns.append(("left out (responses)", "left_out"))
        note += (
            f" {len(without)} of {len(optima)} optima leave out conditions with fewer than {FEW_SAMPLES} responses, "
            "which would raise them too much. These are not used for scores, as policies act on all conditions."
        )
    marked = tuple(i for i, row in enumerate(optima) if row.findings())
    return table_of("Optimal returns", optima, columns, note=note, beside="tables/optima.csv", marked=marked)


def controllability_table(study: Study, folder: Path, kept: Mapping[float, Fidelity]) -> Table:
    """How often each condition exceeds the median in every recording, in the data and in the simulator."""
    kind = next(iter(kinds_over_time(study)), None)
    names = [spec.name for spec in study.robots] if kind else []
    optima = {name: complete_optima(read_optima(folder, name, "over-time")) for name in names}
    labels = next(iter(kept.values())).labels
    rows, marked = [], []
    for i, (at_min, of) in enumerate(kept.items()):
        in_data, in_simulator = of.in_data.tolist(), of.in_simulator.tolist()
        shares = [
            f"{a:.2f}\u00a0→\u00a0{b:.2f}" if abs(a - b) > LARGEST_LOSS else a
            for a, b in zip(in_data, in_simulator, strict=True)
        ]
        ranges = (max(each) - min(each) for each in (in_data, in_simulator))
        found = [of_robot.get(key_of(kind, at_min)) for of_robot in optima.values()] if kind else []
        best = (None if optimum is None else optimum.best_return for optimum in found)
        rows.append((at_min, *shares[:_MOST_LABELS], *ranges, *best))
        if of.largest_loss > LARGEST_LOSS:
            marked.append(i)
    note = (
        "P(x ≥ P50) of each condition: how often its responses are above the median of all. A controller can only use "
        "the difference between conditions, as far as the simulator keeps it. Highlighted, with an arrow: binning "
        f"moves a share by more than {LARGEST_LOSS:g}, so the simulator, the optima and the policies differ from what "
        "the culture would allow."
    )
    if kind:
        note += f" Optimum: the optimal return with {mapping_label(*kind.kind)} on a coarse grid."
    if len(labels) > _MOST_LABELS:
        note += f" {len(labels) - _MOST_LABELS} more conditions are in the file; the differences are over all of them."
    differences = "difference, data", "difference, simulator"
    head = ("at (min)", *labels[:_MOST_LABELS], *differences, *(f"optimum, {robot}" for robot in optima))
    title, file = "Controllability of every recording", "tables/controllability.csv"
    return Table(title, head, tuple(rows), note=note, beside=file, marked=tuple(marked))


def controls_table(study: Study, results: Results) -> Table:
    """Trained policies and the controls of their mapping, at every recording at which anything is evaluated."""
    note = (
        "Trained policies are listed with their controls, as in the figures above. ±: standard error over actors; for "
        "one actor, over its episodes. Silent and shuffled (also if trained so) have no score: their optimum differs."
    )
    any_command = any(spec.robot().baseline_commands is None for spec in study.robots)
    if any_command and any(row.mapping == "none" for row in results.controls):
        note += " Without neurons, where any command can be chosen, there is no constant control."
    columns: Columns = [
        ("robot", "robot"),
        ("mapping", lambda row: mapping_label(row.mapping, row.percentiles)),
        ("at (min)", lambda row: None if row.mapping == "none" else row.at_min),
        *columns_of("control", "actors"),
        ("mean return", _pair("mean_return", "standard_error")),
        *columns_of("random", "optimum"),
        ("score", "normalised_score"),
    ]
    folded = len(results.controls) > _MOST_ROWS
    return table_of("Controls", results.controls, columns, note=note, beside="tables/controls.csv", folded=folded)


def goals_table(results: Results) -> Table:
    """One row for each objective, arm and control."""
    columns: Columns = [*columns_of("robot", "arm", "agent", "at_min", "episodes"), ("success", "success_share")]
    columns += [*columns_of("margin", "objective"), ("satisfied (%)", "satisfaction")]
    note = (
        "Means over all episodes. Success: share of episodes. Margin: how far an episode was from failing its goal, or "
        "from meeting it, in scales of the quantities: above 0 if it succeeded, and the larger the better."
    )
    return table_of("Goals", results.goals, columns, note=note, beside="tables/goals.csv")


def heuristic_table(results: Results) -> Table:
    """Trained policies and the heuristic policy, compared over episodes."""
    columns: Columns = [*columns_of("robot", "arm", "at_min"), ("policies", "mean_return")]
    columns += [*columns_of("heuristic"), ("p", "p_best"), ("pairs won", "wins"), ("the policies", "outcome")]
    note = (
        "p: Mann-Whitney over episodes, two-sided. Pairs won: share of pairs of episodes in which the policies' return "
        "is larger, ties counting half. Highlighted: the policies are not shown to outperform it at "
        f"p < {OUTPERFORMED_P:g}."
    )
    title, rows, file = "Policies and the heuristic policy", results.heuristic, "tables/heuristic.csv"
    marked = tuple(i for i, row in enumerate(rows) if row.outcome == NOT)
    return table_of(title, rows, columns, note=note, beside=file, marked=marked)


def reflexes_table(results: Results) -> Table:
    """Trained policies and the best coupling: context gap and context score."""
    columns: Columns = [
        *columns_of("robot", "arm", "at_min"),
        ("best coupling", _pair("coupling", "coupling_standard_error")),
        ("optimum", "optimum"),
        ("context gap", _interval("gap", "gap_low_95", "gap_high_95")),
        ("context score", _interval("score", "score_low_95", "score_high_95")),
    ]
    note = (
        "Best coupling: a fixed rule from sensed values to a stimulus, without memory and without a goal, found by a "
        "search. Context gap: (optimum − coupling) / (optimum − random), what such a rule leaves undone. Context "
        "score: (policies − coupling) / (optimum − coupling), where the task needs more. With 95 % intervals."
    )
    return table_of("Policies and the best reflex", results.reflexes, columns, note=note, beside="tables/reflexes.csv")


def _pair(value: str, error: str) -> Callable[[Any], str | None]:
    return lambda row: None if getattr(row, value) is None else with_error(getattr(row, value), getattr(row, error))


def _interval(value: str, low: str, high: str) -> Callable[[Any], str]:
    def text(row: Any) -> str:
        ends = getattr(row, low), getattr(row, high)
        return cell(getattr(row, value)) + ("" if None in ends else f"\u00a0{_ends(*ends)}")

    return text


def _ends(low: float, high: float) -> str:
    return f"[{cell(low)}, {cell(high)}]".replace(" ", "\u00a0")


def _printed(row: ComparedReturns) -> str | None:
    return None if row.paper_p is None else f"{cell(row.paper_p)}\u00a0({cell(row.paper_u)})"


def _outcome(row: ComparedReturns) -> str:
    """The outcome by the paper's p, with a remark if it does not hold after correction."""
    is_lost = row.outcome in (FIRST, SECOND) and row.p_holm >= LEVEL
    return f"{row.outcome}, not after correction" if is_lost else row.outcome
