"""The logged data of a tick of a closed loop, the table of ticks, and the ending of a session."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, Self, TextIO

from animat.closed_loop.header import Header

Handled = Literal["used", "repeated", "skipped", "warm-up", "unfinished"]
EndedBy = Literal["plan", "budget", "person", "culture", "hang", "lateness", "robot", "controller", "disk", "crash"]
STOP_FILE = "STOP"
"""In a session's folder: creating it, empty or not, ends the session as Ctrl-C does."""


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One trial, its response, and the result. Times are in seconds on the session's clock.

    Attributes:
        number, episode: in the session, from 0.
        iteration: of the robot in the episode, from 0; a repeated presentation has its own row and the same iteration,
            and the warm-up has -1.
        chosen: the condition that was chosen, by the agent or, in a warm-up, at random.
        delivered: the condition that the culture received; of a silent agent the chosen one, without its pulses.
        patterns: of each pulse, -1 where its electrodes are not one of the culture's patterns; none of a silent agent.
        pulse_time_s: when each pulse really began.
        read_after_s: time of the pulse after which the response was read, or when it would have come.
        spikes, active_ratio: in the response window, and the share of channels that had any.
        rate_hz: x of all channels; of an agent whose responses are drawn, the drawn one.
        readout_hz: x of each readout, where these are groups of channels; else empty.
        handled: what was done with the response; `"warm-up"` before the robot of an episode moves; `"unfinished"` if
            something went wrong before the robot had moved.
        command: that moved the robot, one for each readout where there are several; None where it was not moved.
        reward, observation: of the step, and after it.
        late_s: largest lateness of its pulses; 0 if the grid and the rounding to samples explain it.
        decided_s: from when the data of the previous response window had arrived until this presentation was requested.
        wall_s: the machine's clock at the end, from the start of the session.
        neurons: the history state after it, trace and load; empty if no agent sees it.
    """

    number: int
    agent: str
    episode: int
    iteration: int
    chosen: int
    delivered: int
    frequency_hz: float
    patterns: tuple[int, ...]
    pulse_time_s: tuple[float, ...]
    read_after_s: float
    spikes: int
    rate_hz: float
    active_ratio: float
    is_burst: bool
    handled: Handled
    command: float | tuple[float, ...] | None = None
    reward: float | None = None
    observation: tuple[float, ...] = ()
    terminated: bool = False
    truncated: bool = False
    late_s: float
    decided_s: float
    wall_s: float
    readout_hz: tuple[float, ...] = ()
    neurons: tuple[float, ...] = ()

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """A tick from its `vars`, read back from JSON."""
        # Older logs have neither readouts nor neurons.
        data = {"readout_hz": (), "neurons": (), **data}
        values: dict[str, Any] = {each.name: data[each.name] for each in fields(cls)}
        values |= {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
        return cls(**values)


@dataclass(frozen=True)
class Ending:
    """How a session ended.

    Attributes:
        by: `"plan"`, all episodes were run; else what ended it early: the budget, a person (Ctrl-C), a fault of the
            culture, a missing answer (`"hang"`), a late pulse with `on_late="stop"`, the robot, the controller, the
            disk; `"crash"` where no ending was written.
    """

    by: EndedBy
    message: str


class Stop(Exception):
    """The session ends before its plan is completed."""

    def __init__(self, ending: Ending) -> None:
        super().__init__(ending.message)
        self.ending = ending


HEAD: tuple[str, ...] = ("tick", "time_s", "agent", "episode", "iteration", "chosen", "delivered", "frequency_hz")
HEAD += ("patterns", "pulse_times_s", "electrode_pulses", "spikes", "rate_hz", "active_ratio", "is_burst", "handled")
HEAD += ("command", "reward")
TAIL = ("is_terminated", "is_truncated", "late_s", "decided_s", "wall_s")
"""Columns before and after the observation."""


class TickTable:
    """Writes ticks to a CSV file, one line each, for users of a spreadsheet or pandas without this package.

    All digits are written; `Tick` describes the columns, of which `time_s` is its `read_after_s`. Unknown values are
    empty cells: the command and the observation if the response did not move the robot. Flags are 0 or 1; patterns and
    times of several pulses are separated by spaces.

    Each group of channels has a column of its `rate_hz` and, if there are several, of its `command`. The file is open
    for text, without translation of line ends.
    """

    def __init__(self, file: TextIO, header: Header) -> None:
        self._writer, self._header = csv.writer(file, lineterminator="\n"), header
        names = [name.replace(" ", "_") for name in header.readouts]
        names = list(header.readouts) if len(set(names)) < len(names) else names
        commands = [f"command_{name}" for name in names] if len(names) > 1 else ["command"]
        head = [name for column in HEAD for name in (commands if column == "command" else [column])]
        self._writer.writerow((*head, *(f"rate_hz_{name}" for name in names), *header.observed, *TAIL))

    def add(self, tick: Mapping[str, Any]) -> None:
        """Write a tick, as in the fields of its record, with its `electrode_pulses`."""
        command, n_readouts = tick["command"], len(self._header.readouts)
        cells = {
            **tick,
            "tick": tick["number"],
            "time_s": tick["read_after_s"],
            "chosen": self._header.conditions[tick["chosen"]],
            "delivered": self._header.conditions[tick["delivered"]],
            "patterns": " ".join(map(str, tick["patterns"])),
            "pulse_times_s": " ".join(map(str, tick["pulse_time_s"])),
            "is_burst": int(tick["is_burst"]),
            "is_terminated": int(tick["terminated"]),
            "is_truncated": int(tick["truncated"]),
        }
        row = [cells[name] for name in HEAD]
        row[-2:-1] = command if isinstance(command, Sequence) else (command,) * max(1, n_readouts)
        row += tick["readout_hz"] if n_readouts else ()
        row += tick["observation"] or (None,) * len(self._header.observed)
        row += (cells[name] for name in TAIL)
        # NaN is not equal to itself.
        self._writer.writerow([value if value == value else None for value in row])
