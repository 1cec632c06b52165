"""The table of episodes, one row per episode, from which all returns are summarised."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float64
from pandas import DataFrame as DataFrame

from animat.evaluation.rollouts import Episodes
from animat.studies.results import read_arrays, write_arrays

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
        columns |= {
            f"{SATISFACTION}{i}": of.ravel()
            for i, of in enumerate(np.moveaxis(np.asarray(outcome.satisfaction), -1, 0))
        }
    return DataFrame(columns)


def write_episodes(path: Path, parts: Iterable[DataFrame]) -> Path:
    """Write parts of the table to one file, each column as an array; atomic, and always the same bytes."""
    table = pd.concat(parts)
    columns = {
        name: column.to_numpy(str if pd.api.types.is_string_dtype(column) else None) for name, column in table.items()
    }
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
