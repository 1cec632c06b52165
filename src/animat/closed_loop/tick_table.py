"""The ticks of a session as a CSV file, a line a tick, for whoever has a spreadsheet or pandas and not this package."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from animat.closed_loop.tick import Tick
from animat.robots.base import Quantity
from animat.writing import written_whole

HEAD = (
    "tick",
    "time_s",
    "contender",
    "episode",
    "iteration",
    "chosen",
    "delivered",
    "frequency_hz",
    "patterns",
    "pulse_times_s",
    "spikes",
    "rate_hz",
    "active_ratio",
    "is_burst",
    "handled",
    "command",
    "reward",
)
"""Before the observation. `time_s` is that of the pulse that the response was read after, on the session's clock."""

TAIL = ("is_terminated", "is_truncated", "late_s", "decided_s", "wall_s")
"""After it."""


def write_ticks(path: Path, ticks: Sequence[Tick], conditions: Sequence[str], quantities: Sequence[Quantity]) -> None:
    """Write ticks with all their digits, complete or absent; `animat.closed_loop.tick.Tick` says what the columns are.

    What is not known is an empty cell: the command and the observation after a response that the robot was not moved
    by. Flags are 0 or 1; of several pulses, patterns and times have a space between them.

    Args:
        path: of the file.
        ticks: in the order of time.
        conditions: their names, which `chosen` and `delivered` are told by.
        quantities: of the robot's observation; a column each, by its name and unit (`cart_velocity_m_per_s`).

    Raises:
        InvalidFile: if it cannot be written.
    """
    observed = [f"{each.name}_{each.unit.replace('/', '_per_')}" if each.unit else each.name for each in quantities]
    with written_whole(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*HEAD, *observed, *TAIL))
        writer.writerows([_cell(value) for value in _row(tick, conditions, len(observed))] for tick in ticks)


def _row(tick: Tick, conditions: Sequence[str], observed: int) -> tuple[Any, ...]:
    return (
        tick.number,
        tick.read_after_s,
        tick.contender,
        tick.episode,
        tick.iteration,
        conditions[tick.chosen],
        conditions[tick.delivered],
        tick.frequency_hz,
        tick.patterns,
        tick.pulse_time_s,
        tick.spikes,
        tick.rate_hz,
        tick.active_ratio,
        tick.is_burst,
        tick.handled,
        tick.command,
        tick.reward,
        *(tick.observation or (None,) * observed),
        tick.terminated,
        tick.truncated,
        tick.late_s,
        tick.decided_s,
        tick.wall_s,
    )


def _cell(value: Any) -> Any:
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    if isinstance(value, bool):
        return int(value)
    return None if isinstance(value, float) and math.isnan(value) else value
