"""The ticks of a session as a CSV file, a line a tick, for whoever has a spreadsheet or pandas and not this package."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

HEAD = {
    "tick": "number",
    "time_s": "read_after_s",
    **{name: name for name in ("agent", "episode", "iteration", "chosen", "delivered", "frequency_hz", "patterns")},
    "pulse_times_s": "pulse_time_s",
    **{name: name for name in ("electrode_pulses", "spikes", "rate_hz", "active_ratio", "is_burst", "handled")},
    **{name: name for name in ("command", "reward")},
}
"""Columns before the observation, and their names in a tick's words. `time_s` is that of the pulse that the response
was read after, on the session's clock."""

TAIL = {"is_terminated": "terminated", "is_truncated": "truncated"}
TAIL |= {name: name for name in ("late_s", "decided_s", "wall_s")}
"""After it."""


class TickTable:
    """Writes a line a tick with all its digits; `animat.closed_loop.tick.Tick` says what the columns are.

    What is not known is an empty cell: the command and the observation after a response that the robot was not moved
    by. Flags are 0 or 1; of several pulses, patterns and times have a space between them.

    Args:
        file: open for text, without translation of line ends.
        conditions: their names, which `chosen` and `delivered` are told by.
        observed: the columns of the robot's observation.
        readouts: names of groups of channels, each with a column of its `rate_hz` and, where they are several, of its
            `command`; none where all channels are read as one.
    """

    def __init__(
        self, file: TextIO, conditions: Sequence[str], observed: Sequence[str], readouts: Sequence[str] = ()
    ) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        self._conditions, self._n_observed, self._n_readouts = conditions, len(observed), len(readouts)
        names = [name.replace(" ", "_") for name in readouts]
        names = list(readouts) if len(set(names)) < len(names) else names
        commands = [f"command_{name}" for name in names] if len(names) > 1 else ["command"]
        head = [each for column in HEAD for each in (commands if column == "command" else [column])]
        self._writer.writerow((*head, *(f"rate_hz_{name}" for name in names), *observed, *TAIL))

    def add(self, tick: Mapping[str, Any]) -> None:
        """Write a tick, as in the words of its record, with its `electrode_pulses`.

        Raises:
            OSError: if it cannot be written.
        """
        command = tick["command"]
        told = {name: " ".join(map(str, tick[name])) for name in ("patterns", "pulse_time_s")}
        told |= {name: self._conditions[tick[name]] for name in ("chosen", "delivered")}
        flags = {name: int(tick[name]) for name in ("is_burst", "terminated", "truncated")}
        known = {**tick, **told, **flags}
        row = [known[name] for name in HEAD.values()]
        row[-2:-1] = command if isinstance(command, Sequence) else (command,) * max(1, self._n_readouts)
        row += tick["readout_hz"] if self._n_readouts else ()
        row += tick["observation"] or (None,) * self._n_observed
        row += (known[name] for name in TAIL.values())
        # What is not equal to itself is NaN.
        self._writer.writerow([value if value == value else None for value in row])
