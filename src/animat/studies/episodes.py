"""A study's episodes: the table, one row per episode, that summaries are made of; and single ones with their paths."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
from jaxtyping import Float, Float64, Int64
from pandas import DataFrame as DataFrame

from animat.environment import Environment
from animat.evaluation.host_rollouts import paths_on_host
from animat.evaluation.rollouts import Actor, Episodes, trajectories
from animat.goals.robot import RobotWithGoal
from animat.neurons.simulator import NeuronSimulator
from animat.report.results import ObjectiveMet
from animat.robots.host import HostRobot
from animat.studies.results import read_arrays, write_arrays
from animat.studies.specification import Study

COLUMNS = ("robot", "arm", "agent", "actor", "at_min", "over_time", "episode", "return", "iterations", "ended")
"""Columns of the table, described in docs/studies.md; for controls `arm` is the `mapping_label` they act through.

For robots with a goal (`animat.goals.tally.Outcome`) also: `SUCCEEDED`, 1 or 0; `MARGIN`; and the `SATISFACTION` of
each objective, from 0, in %.
"""
SUCCEEDED, MARGIN, SATISFACTION = "succeeded", "margin", "satisfaction_"
POLICY = "policy"
RANDOM = "random"
COUPLING = "coupling"


def episode_rows(
    ran: Episodes, *, robot: str, arm: str, at_min: float, agent: str = POLICY, over_time: bool = False
) -> DataFrame:
    """Episodes that were run together, as rows of the table."""
    actor, episode = (index.ravel() for index in np.indices(ran.returns.shape))
    columns = {
        "robot": robot,
        "arm": arm,
        "agent": agent,
        "actor": actor,
        "at_min": at_min,
        "over_time": over_time,
        "episode": episode,
        "return": ran.returns.ravel(),
        "iterations": ran.lengths.ravel(),
        "ended": np.where(ran.terminated, "terminated", "truncated").ravel(),
    }
    if (outcome := ran.outcome) is not None:
        columns |= {SUCCEEDED: outcome.succeeded.astype(float).ravel(), MARGIN: outcome.margin.ravel()}
        of_each = np.asarray(outcome.satisfaction).reshape(actor.size, -1).T
        columns |= {f"{SATISFACTION}{i}": satisfied for i, satisfied in enumerate(of_each)}
    return DataFrame(columns)


def write_episodes(path: Path, parts: Iterable[DataFrame]) -> Path:
    """Write parts of the table to one file, each column as an array; atomic, and always the same bytes."""
    table = pd.concat(parts)
    columns = {name: of.to_numpy(str if pd.api.types.is_string_dtype(of) else None) for name, of in table.items()}
    return write_arrays(path, columns)


def read_episodes(paths: Iterable[Path]) -> DataFrame:
    """The table, read from its files; raises InvalidFile if one cannot be read."""
    files = [read_arrays(path) for path in paths]
    goal_columns = [name for arrays in files for name in arrays if name.startswith((SUCCEEDED, MARGIN, SATISFACTION))]
    parts = [pd.DataFrame(arrays, columns=list(dict.fromkeys((*COLUMNS, *goal_columns)))) for arrays in files]
    return pd.concat(parts, ignore_index=True)


def rows_where(table: DataFrame, **values: object) -> DataFrame:
    """The rows of the table that have these values in their columns."""
    return table[np.logical_and.reduce([table[name] == value for name, value in values.items()])]


def mean_returns(rows: DataFrame, episodes: int | None = None) -> Float64[np.ndarray, " actors"]:
    """Each actor's mean return over its first episodes, or all: what the paper calls a policy's performance."""
    by_actor = rows.groupby("actor")["return"]
    return np.array([returns.to_numpy()[:episodes].mean() for _, returns in by_actor], np.float64)


def goals_met(study: Study, table: DataFrame) -> Iterator[ObjectiveMet]:
    """How far policies and controls met the goal of each robot at each minute, from the table of episodes."""
    for spec in study.robots:
        robot = spec.robot()
        if not isinstance(robot, RobotWithGoal):
            continue
        at = rows_where(table, robot=spec.name, over_time=False)
        # Next to robots without goals these columns are of objects, else in single precision: sums would differ.
        at = at.astype({name: np.float64 for name in at if name.startswith((SUCCEEDED, MARGIN, SATISFACTION))})
        for (arm, agent, at_min), rows in at.groupby(["arm", "agent", "at_min"], sort=False):
            met = len(rows), float(rows[SUCCEEDED].mean()), float(rows[MARGIN].mean())
            for i, objective in enumerate(robot.goal.objectives):
                satisfaction = float(rows[f"{SATISFACTION}{i}"].mean())
                yield ObjectiveMet(spec.name, arm, agent, at_min, *met, str(objective), satisfaction)


@dataclass(frozen=True, eq=False)
class Paths:
    """One episode of each of several actors; observations and commands beyond its length are meaningless."""

    observations: Float[np.ndarray, "actors iterations+1 observations"]
    commands: Float[np.ndarray, "actors iterations *commands"]
    lengths: Int64[np.ndarray, " actors"]

    def episodes(self) -> list[tuple[np.ndarray, list[float]]]:
        """Observations and commands of each actor, up to the end of its episode."""
        return [
            (observations[: length + 1], commands[:length].tolist())
            for observations, commands, length in zip(self.observations, self.commands, self.lengths, strict=True)
        ]


def record_paths(environment: Environment[Any], simulator: NeuronSimulator | None, actors: Actor, seed: int) -> Paths:
    """Run one episode of each actor; arguments as for `animat.evaluation.rollouts.roll_out`."""
    if isinstance(environment.robot, HostRobot):
        keys = jax.random.split(jax.random.key(seed), actors.n_actors)
        return Paths(*paths_on_host(environment, simulator, actors, keys, seed))
    ran = trajectories(environment, simulator, actors, episodes=1, seed=seed)
    observations, commands, lengths = (each[:, 0] for each in (ran.observations, ran.commands, ran.lengths))
    return Paths(observations, commands, lengths.astype(np.int64))
