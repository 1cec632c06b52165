"""The view of a closed-loop session: the seconds before a time, and totals so far."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from animat.closed_loop.header import Header, read_header
from animat.closed_loop.log import Record
from animat.closed_loop.outline import Outline
from animat.closed_loop.session_data import LOG_FILE, STOP_FILE
from animat.errors import InvalidArgument, InvalidFile
from animat.progress import format_duration
from animat.stimulation.stimulus import NOTHING
from animat.watch.agents import by_agent
from animat.watch.blocks import time_left
from animat.watch.picture import is_drawn
from animat.watch.plain import listed, mapped, number, numbers, text, whole
from animat.watch.spikes import packed
from animat.watch.state import is_locked
from animat.watch.sums import Sums, first_readout
from animat.watch.tail import Tail
from animat.watch.view import View

MOST_SPAN_S = 60.0
"""Longest span shown at once."""
_MOST_RECORDS = 8000
"""Most records in a view: at 80 Hz more than a minute and a half."""
_GROW_S, _COUNT_S = 0.6, 0.15
"""How long a view may look for new records, and count them; the next view continues."""
_AGENTS_S, _MANY = 0.5, 500
"""Interval between updates of the returns by agent, from this many episodes on."""
_SILENT_S = 5.0
"""After which a session without new records no longer counts as running: it logs every request to a culture."""
_NO_TIME = 64
"""Most consecutive records without a time."""


class SessionView(View):
    """The folder of a session, with its log."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.tail = Tail(folder / LOG_FILE)
        self._generation = -1
        self._agents: list[dict[str, Any]] = []
        self._agents_at = -1, -1
        self._agents_until_s, self._done = 0.0, 0

    def close(self) -> None:
        self.tail.close()

    def about(self) -> dict[str, Any]:
        self._look()
        header, fields = self._header, self._fields
        loop, channels = mapped(fields.get("loop")), header.channels
        robot = text(mapped(loop.get("robot")).get("name", "robot"))
        return {
            "generation": self.tail.generation,
            "title": f"{robot} on the {text(fields.get('culture', ''))} culture",
            "conditions": list(map(text, header.conditions)),
            "agents": [text(agent.get("name")) for agent in map(mapped, listed(fields.get("agents")))],
            "observed": list(map(text, header.observed)),
            "readouts": list(map(text, header.readouts)),
            "mapping": text(mapped(loop.get("mapping")).get("name", loop.get("mapping"))),
            "thresholds": _thresholds(loop.get("mapping")),
            "adaptive": bool(loop.get("adaptive")),
            "percentiles_hz": first_readout(listed(loop.get("percentiles"))),
            "planned": len(listed(fields.get("turns"))),
            "limits": {text(name): number(value) for name, value in mapped(fields.get("limits")).items()},
            "account": {text(name): number(value) for name, value in mapped(fields.get("account")).items()},
            "is_drawn": is_drawn(loop),
            "channels": {
                "x_um": list(map(number, channels.x_um.tolist())),
                "y_um": list(map(number, channels.y_um.tolist())),
                "electrode": list(map(whole, channels.electrode.tolist())),
            },
        }

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The seconds before a time on the session's clock; None: now, or its end.

        Raises:
            InvalidFile: if there is no longer a session.
            InvalidArgument: for an invalid span.
        """
        if not 0 < span_s <= MOST_SPAN_S:
            raise InvalidArgument(f"span: expected above 0 and at most {MOST_SPAN_S:g} s, got {span_s:g}")
        is_whole = self._look()
        self._sums.go_on(_COUNT_S)
        end_s = self._end_s()
        to_s = end_s if to_s is None else min(to_s, end_s)
        from_s = to_s - span_s
        shown = self._between(from_s, to_s)
        ticks = [(at, tick) for at, record in shown if (tick := self._tick(at, record)) is not None]
        ticks = [(at, tick) for at, tick in ticks if (tick["time_s"] or 0.0) <= to_s]
        adapted = [
            (span[1], first_readout(record.fields["percentiles_hz"]))
            for _, record in shown
            if "percentiles_hz" in record.fields and (span := _span(record.fields)) is not None
        ]
        spikes, counts = packed([record for _, record in shown], from_s, to_s, len(self._header.channels))
        return {
            "generation": self.tail.generation,
            "end_s": end_s,
            "from_s": from_s,
            "to_s": to_s,
            "ticks": {name: [tick[name] for _, tick in ticks] for name in _COLUMNS},
            "spikes": spikes,
            "counts": counts,
            "pulsed": listed(ticks[-1][1]["electrodes"]) if ticks else [],
            # The last tick with an observation.
            "picture": next((at for at, tick in ticks[::-1] if tick["observation"]), None),
            "is_found": is_whole,
            **self._so_far(),
            "percentiles": _in_force(self._sums.percentiles, adapted),
        }

    def tick_at(self, at: int) -> tuple[Record, list[list[float | None]]] | None:
        """The record of a tick, and the earlier observations of its episode, for a picture; None without a tick."""
        self._look()
        record = self.tail.record(at)
        tick = None if record is None else record.fields.get("tick")
        if record is None or not isinstance(tick, dict):
            return None
        earlier: list[list[float | None]] = []
        for before in range(at - 1, max(-1, at - _TRAIL), -1):
            previous = self.tail.record(before)
            past = None if previous is None else previous.fields.get("tick")
            if isinstance(past, dict) and past.get("episode") != tick.get("episode"):
                break
            if isinstance(past, dict) and past.get("observation"):
                earlier.append(numbers(past["observation"]))
        return record, earlier[::-1]

    @property
    def robot_data(self) -> dict[str, Any]:
        """The header's description of the robot and its goal."""
        self._look()
        return mapped(self._fields.get("loop"))

    def _look(self) -> bool:
        """Find new records in the log; False if there are more than could be found in time."""
        is_whole = self.tail.grow(_GROW_S)
        if self._generation != self.tail.generation or not hasattr(self, "_fields"):
            first = self.tail.record(0)
            if first is None:
                raise InvalidFile(f"{self.tail.path}: expected a log of a session, got one without a whole beginning")
            self._header: Header = read_header(self.tail.path, first.fields)
            self._fields = first.fields
            self._sums = Sums(self.tail)
            self._generation = self.tail.generation
        return is_whole

    def _so_far(self) -> dict[str, Any]:
        sums = self._sums
        outline = sums.outline
        fullest = sums.on_electrode.most_common(1)
        # With thousands of episodes, not every time.
        is_due = self._done < _MANY or time.monotonic() > self._agents_until_s
        if self._agents_at != (outline.ticks, self._generation) and is_due:
            self._agents_at = outline.ticks, self._generation
            episodes = outline.episodes
            self._done = sum(episode.is_whole for episode in episodes)
            self._agents = by_agent(episodes, self._fields)
            self._agents_until_s = time.monotonic() + _AGENTS_S
        done = self._done
        last = self._last_tick()
        planned, wall_s = len(listed(self._fields.get("turns"))), number(mapped(last).get("wall_s"))
        # The time before the first move is spent only once.
        moving_s = None if wall_s is None else wall_s - (number(outline.moved_at_s) or 0.0)
        left_s = None if not done or moving_s is None else moving_s * (planned - done) / done
        state = self._state()
        return {
            **state,
            "summed": sums.share,
            "strange": sums.strange,
            "n_ticks": outline.ticks,
            "pulses": outline.pulses,
            "fullest": [text(fullest[0][0]), fullest[0][1]] if fullest else None,
            "bursts": outline.bursts,
            "late": outline.late,
            "latest_s": number(outline.latest_s),
            "unanswered": _unanswered(outline),
            "faults": sums.faults,
            "n_faults": sums.n_faults,
            "episodes_done": done,
            "time_left": time_left(left_s, state),
            "agents": self._agents,
        }

    def _state(self) -> dict[str, Any]:
        """The session's state, with a message."""
        silent_s = max(0.0, time.time() - self.tail.path.stat().st_mtime)
        silent = f"nothing was written for {format_duration(silent_s)}"
        stop = (self.folder / STOP_FILE).exists()
        last = {} if not len(self.tail) else (self.tail.peek(len(self.tail) - 1) or {})
        damage = self.tail.damage
        if last.get("kind") == "end":
            state, message = "ended", text(last.get("message"))
        elif silent_s < _SILENT_S + (number(mapped(self._fields.get("loop")).get("pause_s")) or 0.0):
            # A record that is just being written looks like a truncated one.
            state, message, damage = "running", "stopping" if stop else "", ""
        elif is_locked(self.folder):
            state, message = "running", f"{silent}, but its program has not ended: it is waiting, or it hangs"
        else:
            state, message = "silent", f"{silent}, and the log has no end: it was killed, or it hangs"
        return {"state": state, "message": message, "damage": damage, "stop": stop}

    def _end_s(self) -> float:
        at = self._before(len(self.tail) - 1)
        return 0.0 if at is None else at[1]

    def _last_tick(self) -> dict[str, Any] | None:
        for at in range(len(self.tail) - 1, max(0, len(self.tail) - _NO_TIME), -1):
            tick = (self.tail.peek(at) or {}).get("tick")
            if isinstance(tick, dict):
                return tick
        return None

    def _before(self, at: int) -> tuple[float, float] | None:
        """The span of the last record up to `at` that has a time."""
        for earlier in range(at, max(0, at - _NO_TIME), -1):
            span = _span(self.tail.peek(earlier) or {})
            if span is not None:
                return span
        return None

    def _between(self, from_s: float, to_s: float) -> list[tuple[int, Record]]:
        """The records that concern a span, found by bisection, as they are in the order of time."""
        low, high = 1, len(self.tail)
        while low < high:
            middle = (low + high) // 2
            span = self._before(middle)
            if span is not None and span[0] > to_s:
                high = middle
            else:
                low = middle + 1
        records: list[tuple[int, Record]] = []
        for at in range(low - 1, 0, -1):
            record = self.tail.record(at)
            if record is None:
                continue
            span = _span(record.fields)
            if (span is not None and span[1] < from_s) or len(records) >= _MOST_RECORDS:
                break
            records.append((at, record))
        return records[::-1]

    def _tick(self, at: int, record: Record) -> dict[str, Any] | None:
        tick = record.fields.get("tick")
        if not isinstance(tick, dict):
            return None
        totals = self._sums.totals
        electrodes = [row[3] for row in listed(record.fields.get("stimuli")) if isinstance(row, list) and len(row) == 4]
        return {
            **{name: _plain(tick.get(name)) for name in _NUMBERS},
            "time_s": number(tick.get("read_after_s")),
            "agent": text(tick.get("agent", "")),
            "handled": text(tick.get("handled", "")),
            "pulse_time_s": [] if NOTHING in listed(tick.get("patterns")) else numbers(tick.get("pulse_time_s")),
            "command": numbers(tick.get("command")),
            "observation": numbers(tick.get("observation")),
            "total": number(totals[at]) if at < len(totals) else None,
            "electrodes": list(map(whole, listed(electrodes[-1]))) if electrodes else [],
        }


_Row = tuple[float, list[float | None]]
"""When thresholds changed, and the percentiles in Hz since then."""
_TRAIL = 400
"""Number of earlier ticks searched for a robot's trail."""
_NUMBERS = (
    "number", "episode", "iteration", "chosen", "delivered", "spikes", "rate_hz", "reward", "late_s", "decided_s",
    "is_burst",
)  # fmt: skip
_COLUMNS = (*_NUMBERS, "time_s", "agent", "handled", "pulse_time_s", "command", "observation", "total")


def _plain(value: Any) -> float | bool | None:
    return value if isinstance(value, bool) else number(value)


def _span(fields: dict[str, Any]) -> tuple[float, float] | None:
    start, duration = number(fields.get("start_s")), number(fields.get("duration_s"))
    if fields.get("kind") != "seen" or start is None or duration is None or number(start + duration) is None:
        return None
    return start, start + duration


def _thresholds(mapping: Any) -> list[int]:
    """Which of the eleven percentiles a mapping compares responses with; both ends if not known."""
    from animat.coding.mapping import Thresholds

    name = mapping if isinstance(mapping, str) else mapped(mapping).get("name")
    known = {kind.name: list(kind.percentile_indices) for kind in (Thresholds(1), Thresholds(9))}
    return known.get(str(name), [0, 10])


def _unanswered(outline: Outline) -> int | None:
    try:
        return outline.unanswered_pulses
    except (KeyError, TypeError, AttributeError):
        return None


def _in_force(rows: Sequence[_Row], shown: Sequence[_Row], most: int = 400) -> list[_Row]:
    """The session's rows, evenly thinned to `most` but including the last, and all rows of the span shown."""
    step = max(1, math.ceil(len(rows) / most))
    rows = [*rows[:-1:step], *rows[-1:]]
    if not shown:
        return rows
    from_s, to_s = shown[0][0], shown[-1][0]
    return [*(row for row in rows if row[0] < from_s), *shown, *(row for row in rows if row[0] > to_s)]
