"""The page of the context study: figures, then a summary over cultures, then every number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from animat.errors import counted
from animat.lazy import Figure
from animat.report.colours import BLACK, BLUE, GREY, ORANGE
from animat.report.html import Columns, Section, Table, cell, columns_of, picture_of, table_of, with_minus, write_page
from animat.report.results import CONTEXT_GAP_LEVEL, ContextRow, LostRow
from animat.report.style import add_common_legend, new_figure, save_formats, style_axes
from animat.studies.context import TABLE, WHOSE_WORK, ContextRun, ContextStudy
from animat.studies.folder import REPORT

_SPACING = 0.11
"""Distance between two cultures on a row of the figure, in rows."""


def write_context_page(study: ContextStudy, found: ContextRun) -> Path:
    """Write the page and its figures."""
    by_robot = {robot: [row for row in found.rows if row.robot == robot] for robot in study.robots}
    save_formats(draw_context(by_robot), found.folder, "context")
    caption = (
        "Left: how much of a task the best reflex leaves undone, (optimal return − best coupling) / (optimal return − "
        f"random); from the dashed line on, half of it or more. Right: how far the {study.policies} "
        "policies get from that reflex to the optimum. Each point is a culture, with its 95 % interval on the "
        "culture's simulator; an interval that reaches the frame extends beyond it. Triangles: lower bounds, as the "
        "optimal return is not known."
    )
    gaps = picture_of(found.folder, "context", "Context gaps and context scores", caption, TABLE)
    summaries = tuple((robot, summarise_robot(rows)) for robot, rows in by_robot.items())
    sections = [
        Section("Results in short", (summarise_cultures(by_robot),), summaries, pictures=(gaps,)),
        _whose_work(study, found),
        Section("Every culture", tables=(_on_the_simulator(found.rows), _on_the_culture(found.rows))),
    ]
    cultures = f"Virtual culture{'' if len(study.cultures) == 1 else 's'} {', '.join(map(str, study.cultures))}"
    lead = f"{cultures}; {study.policies} policies of each robot on each, on the simulator and in closed loop."
    title = "Does it need context, and whose work is it?"
    return write_page(found.folder / REPORT, title, lead, sections, [f"Seed {study.seed}."])


def draw_context(rows: Mapping[str, Sequence[ContextRow]]) -> Figure:
    """Context gaps of tasks and context scores of policies: one row per robot, one point with interval per culture."""
    figure = new_figure(9.2, 1.7 + 0.55 * len(rows))
    left, right = figure.subplots(1, 2, sharey=True)
    style_axes(left, "The task: is a reflex enough?", "context gap (0: a reflex does it all, 1: it does nothing)", "")
    style_axes(right, "The policies: more than a reflex?", "context score (0: the best reflex, 1: optimal)", "")
    left.axvline(CONTEXT_GAP_LEVEL, color=ORANGE, linewidth=1, linestyle="--", label="a reflex leaves half undone")
    for axes, name, colour in ((left, "gap", BLUE), (right, "score", BLACK)):
        axes.axvline(0, color=GREY, linewidth=0.8)
        nothing = "not known" if axes is left else "none: no task beyond a reflex, or not known"
        for i, of_robot in enumerate(rows.values()):
            known = [row for row in of_robot if getattr(row, name) is not None]
            if not known:
                axes.text(0.02, i, nothing, fontsize=8, color=GREY, va="center")
            for j, row in enumerate(known):
                place = i + _SPACING * (j - (len(known) - 1) / 2)
                value, low, high = (getattr(row, each) for each in (name, f"{name}_low_95", f"{name}_high_95"))
                ends = [end for end in (low, high) if end is not None]
                axes.plot(ends, [place] * len(ends), color=colour, linewidth=1.2)
                marker, label = (">", "lower bound") if row.is_least else ("o", "a culture, 95 % interval")
                axes.plot([value], [place], marker, color=colour, markersize=4, label=label)
        # An interval of two policies can be arbitrarily wide; only the side of 0 on which it ends matters.
        low, high = axes.get_xlim()
        values = [value for of_robot in rows.values() for row in of_robot if (value := getattr(row, name)) is not None]
        low, high = max(min(low, -0.05), -1.0), min(max(high, 1.05), 2.0)
        axes.set_xlim(min([low, *(value - 0.05 for value in values)]), max([high, *(value + 0.05 for value in values)]))
    left.set_yticks(range(len(rows)), list(rows))
    left.set_ylim(len(rows) - 0.5, -0.5)
    add_common_legend(figure, (left, right), columns=2)
    return figure


def _whose_work(study: ContextStudy, found: ContextRun) -> Section:
    """What the policies lose, on cultures on which they are clearly better than random stimuli."""
    left_out = [f"{row.robot} on culture {row.culture}" for row in found.rows if not _beats_random(row)]
    note = (f"Left out, as the policies are hardly above random stimuli: {', '.join(left_out)}.",) if left_out else ()
    lost = _shares_lost(found.rows, found.lost)
    if not lost:
        return Section("Whose work is it?", note)
    save_formats(draw_whose_work(lost), found.folder, "whose-work")
    caption = (
        "The same policies with a change to the culture, to its stimuli, or to how its responses are used. 0: nothing "
        "is lost; 1: the policies' whole advantage over random stimuli is lost; below 0: something is gained. Each "
        f"point is a culture: the mean of {study.policies} policies, {study.episodes} episodes each, on its simulator."
    )
    picture = picture_of(found.folder, "whose-work", "Return lost by each intervention", caption, WHOSE_WORK)
    names = dict.fromkeys(name for each in lost.values() for name in each)
    rows = tuple((name, *(float(np.mean(of[name])) if name in of else None for of in lost.values())) for name in names)
    mean = "Mean over cultures of the return lost, as a fraction of the policies' advantage over random stimuli."
    table = Table("Return lost", ("", *lost), rows, note=mean, beside=WHOSE_WORK)
    return Section("Whose work is it?", note, pictures=(picture,), tables=(table,))


def draw_whose_work(lost: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Return lost on each culture, by robot and intervention, as a fraction of the advantage over random stimuli."""
    most = max(len(each) for each in lost.values())
    figure = new_figure(2.6 * len(lost) + 1.6, 1.5 + 0.34 * most)
    names = list(dict.fromkeys(name for each in lost.values() for name in each))
    panels = figure.subplots(1, len(lost), squeeze=False, sharey=True)[0]
    for axes, (robot, each) in zip(panels, lost.items(), strict=True):
        style_axes(axes, robot, "return lost (1: whole advantage)", "")
        for at in (0, 1):
            axes.axvline(at, color=GREY, linewidth=0.8)
        for name, values in each.items():
            axes.plot(values, [names.index(name)] * len(values), "o", color=BLUE, alpha=0.6, markersize=4)
    panels[0].set_yticks(range(len(names)), names)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    return figure


def _beats_random(row: ContextRow) -> bool:
    """Whether the policies are above random stimuli by a tenth of the way to the best known return."""
    best = max(each for each in (row.optimum, row.best_known, row.policies, row.coupling) if each is not None)
    return row.policies - row.random > 0.1 * (best - row.random) > 0


def summarise_cultures(by_robot: Mapping[str, Sequence[ContextRow]]) -> str:
    """Two sentences on all robots: of which tasks a reflex leaves half undone, and where the policies do more."""
    halves = [robot for robot, rows in by_robot.items() if rows and all(row.leaves_half for row in rows)]
    has = [robot for robot, rows in by_robot.items() if rows and all(row.has_context for row in rows)]
    return (
        f"A reflex leaves half of the task or more undone on every culture for {', '.join(halves) or 'no robot'}. The "
        f"policies do significantly more than the best reflex on every culture for {', '.join(has) or 'no robot'}."
    )


def summarise_robot(rows: Sequence[ContextRow]) -> str:
    """Two sentences on one robot on all cultures: what a reflex leaves undone, and what the policies do."""
    gaps = [row.gap for row in rows if row.gap is not None]
    if not gaps:
        return "The context gap is not known."
    n, halves, has = len(gaps), sum(row.leaves_half for row in rows), sum(row.has_context for row in rows)
    least = "at least " if any(row.is_least for row in rows) else ""
    between = f" (context gap {least}{_range(gaps)})"
    unknown = f"; on {len(rows) - n} more this is not known" if n < len(rows) else ""
    task = f"A reflex leaves half of the task or more undone on {halves} of {counted(n, 'culture')}{between}{unknown}."
    scores = [row.score for row in rows if row.score is not None]
    if not scores:
        return f"{task} No culture has a context score."
    of = f"{has} of {counted(len(scores), 'culture')} with a context score ({least}{_range(scores)})"
    return f"{task} The policies do significantly more than the best reflex on {of}."


def _range(values: Sequence[float]) -> str:
    low, high = (with_minus(f"{value:z.2f}") for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _shares_lost(rows: Sequence[ContextRow], lost: Sequence[LostRow]) -> dict[str, dict[str, list[float]]]:
    """By robot and intervention: the return lost, as a fraction of the policies' advantage over random stimuli."""
    over_random = {(row.culture, row.robot): row.policies - row.random for row in rows if _beats_random(row)}
    shares: dict[str, dict[str, list[float]]] = {}
    for row in lost:
        span = over_random.get((row.culture, row.robot))
        if span is not None:
            shares.setdefault(row.robot, {}).setdefault(row.intervention, []).append(row.lost / span)
    return shares


def _on_the_simulator(rows: Sequence[ContextRow]) -> Table:
    columns: Columns = [
        *columns_of("robot", "culture", "random", "heuristic"),
        ("best coupling", "coupling"),
        ("policies", "policies"),
        ("optimum", lambda row: row.optimum if row.best_known is None else f"≥ {cell(row.best_known)}"),
        ("gap", lambda row: None if row.gap is None else _least(row) + with_minus(f"{row.gap:z.2f}")),
        ("score, 95 %", _score),
        ("bits", "bits"),
    ]
    note = (
        "Mean returns on the simulator of the last recording. Bits: goal information, for robots with several goals. "
        "≥: no optimal return is known. The gap is then computed with the best of policies and heuristic in its place, "
        "and the score with the highest return of any episode: both are lower bounds."
    )
    return table_of("On the simulator", rows, columns, note=note, beside=TABLE)


def _on_the_culture(rows: Sequence[ContextRow]) -> Table:
    columns: Columns = [
        *columns_of("robot", "culture"),
        ("random", "measured_random"),
        ("heuristic", "measured_heuristic"),
        ("best coupling", "measured_coupling"),
        ("policies", "measured_policies"),
        ("policies, predicted", "predicted_policies"),
    ]
    note = (
        "Mean returns measured in closed loop on the culture, starting where its recordings ended, and the returns "
        "predicted for the same policies."
    )
    return table_of("On the culture, in closed loop", rows, columns, note=note, beside=TABLE)


def _score(row: ContextRow) -> str | None:
    ends = f"({cell(row.score_low_95)} to {cell(row.score_high_95)})"
    return None if row.score is None else f"{_least(row)}{cell(row.score)} {ends}"


def _least(row: ContextRow) -> str:
    return "≥ " if row.is_least else ""
