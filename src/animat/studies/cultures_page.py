"""The page of a study over many cultures: results over all of them, then a link to the report of each."""

from __future__ import annotations

from pathlib import Path

from animat.errors import counted
from animat.report.html import Section, cell, columns_of, picture_of, table_of, write_page
from animat.report.over_cultures import draw_over_cultures
from animat.report.results import OverCultures
from animat.report.style import save_formats
from animat.studies.arms import arm_differences, arms_table, summarise_arms
from animat.studies.cultures import COMPARISONS, SUMMARY, CulturesRun
from animat.studies.places import REPORT
from animat.studies.specification import Compared, Study
from animat.studies.tabulating import LEVEL


def write_cultures_page(study: Study, found: CulturesRun) -> Path:
    """Write the page and its figure."""
    sections = []
    if found.summary:
        # Every culture has the same comparisons in the same order.
        of_each = zip(*found.comparisons.values(), strict=True)
        differences = ([row.mean_second - row.mean_first for row in rows] for rows in of_each)
        figure = draw_over_cultures([*zip(found.summary, differences, strict=True)])
        save_formats(figure, found.folder, "over-cultures")
        sections.append(_summary(study, found))
    pages = {name: f"{name}/{REPORT}" for name in found.finished}
    points = [(name, f"finished: {page}") for name, page in pages.items()]
    points += [(name, f"failed: {why}") for name, why in found.failed.items()]
    sections.append(Section("Each culture", points=tuple(points), links=tuple(pages.values())))
    cultures = counted(len(found.finished), "culture") + (f", {len(found.failed)} more failed" if found.failed else "")
    lead = f"{cultures}. {summarise_arms(study)} on every culture."
    return write_page(found.folder / REPORT, f"{study.title}: many cultures", lead, sections, [f"Seed {study.seed}."])


def _summary(study: Study, found: CulturesRun) -> Section:
    points, explained = [], set[str]()
    for row in found.summary:
        compared = next(each for each in study.comparisons if each.name == row.comparison)
        differences = list(arm_differences(study.arm(compared.first), study.arm(compared.second)))
        # Each difference is explained only once.
        text = " ".join([_describe(compared, row), *(each for each in differences if each not in explained)])
        points.append((f"{row.robot}, {row.comparison}", text))
        explained |= set(differences)
    table = table_of(
        "Over cultures",
        found.summary,
        [
            *columns_of("comparison", "robot", "mean_first", "mean_second", "difference"),
            ("95 % interval", lambda row: "–" if row.low_95 is None else f"{cell(row.low_95)} to {cell(row.high_95)}"),
            ("second mean larger in", lambda row: f"{row.larger_in} of {row.cultures}"),
            ("significantly better in", "found_better"),
        ],
        note="Mean returns; each culture counts the same. Intervals are percentile bootstraps over cultures, too "
        "narrow with fewer than ten. Second mean larger in: cultures in which the second arm's mean return is larger. "
        f"Significantly better in: those in which it is better at p < {LEVEL:g}, as in their own reports.",
        beside=SUMMARY,
    )
    picture = picture_of(
        found.folder,
        "over-cultures",
        "Differences on each culture",
        "Each point is a culture: the mean return of the second arm's policies minus that of the first's; to the right "
        "of 0 the second arm is better. Above each row of points: their mean with its 95 % interval, of "
        f"{counted(len(found.comparisons), 'culture')}.",
        COMPARISONS,
    )
    return Section("Results in short", (), tuple(points), (arms_table(study), table), (picture,))


def _describe(compared: Compared, row: OverCultures) -> str:
    larger = (
        f"“{compared.second}” has a larger mean return than “{compared.first}” in {row.larger_in} of "
        f"{counted(row.cultures, 'culture')}"
    )
    if not row.tested:
        return f"{larger}; with so few policies no test finds a difference in one culture."
    return f"{larger}; it is found to be better (p < {LEVEL:g}) in {row.found_better}."
