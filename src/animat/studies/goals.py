"""How far a study's policies met the goals of its robots, objective by objective."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields

from animat.goals.robot import RobotWithGoal
from animat.report.html import Table, table_of
from animat.report.results import ObjectiveMet
from animat.studies.episodes import MARGIN, SATISFACTION, SUCCEEDED, DataFrame, rows_where
from animat.studies.specification import Study


def goals_met(study: Study, table: DataFrame) -> Iterator[ObjectiveMet]:
    """How far policies and controls met the goal of each robot at each minute, from the table of episodes."""
    for spec in study.robots:
        robot = spec.robot()
        if not isinstance(robot, RobotWithGoal):
            continue
        at = rows_where(table, robot=spec.name, over_time=False)
        for (arm, agent, at_min), rows in at.groupby(["arm", "agent", "at_min"], sort=False):
            met = len(rows), float(rows[SUCCEEDED].mean()), float(rows[MARGIN].mean())
            for i, objective in enumerate(robot.goal.objectives):
                satisfaction = float(rows[f"{SATISFACTION}{i}"].mean())
                yield ObjectiveMet(spec.name, arm, agent, at_min, *met, str(objective), satisfaction)


def goals_table(rows: Sequence[ObjectiveMet]) -> Table:
    """One row for each objective, arm and control."""
    names = ("robot", "arm", "agent", "at (min)", "episodes", "success", "margin", "objective", "satisfied (%)")
    return table_of(
        "Goals",
        rows,
        [*zip(names, (field.name for field in fields(ObjectiveMet)), strict=True)],
        note="Means over all episodes. Success: share of episodes. Margin: how far an episode was from failing its "
        "goal, or from meeting it, in scales of the quantities: above 0 if it succeeded, and the larger the better.",
        beside="tables/goals.csv",
    )
