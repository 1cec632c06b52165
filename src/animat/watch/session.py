"""The view of a closed-loop session: the seconds before a time, and totals so far."""

from __future__ import annotations

import io
import math
import os
import time
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from animat.closed_loop.header import Header, read_header
from animat.closed_loop.log import LogRecord
from animat.closed_loop.session import LOG_FILE, RECORDING_FILE
from animat.closed_loop.tick import STOP_FILE
from animat.coding.mapping import Thresholds
from animat.errors import InvalidArgument, InvalidFile, as_invalid_file
from animat.goals.robot import robot_of
from animat.progress import format_duration
from animat.robots.base import Robot
from animat.robots.drawing import draw_robot
from animat.stimulation.stimulus import NOTHING
from animat.watch.discovery import is_locked
from animat.watch.files import mapped, number, numbers, packed, text
from animat.watch.tail import PercentilesSince, Sums, Tail, by_agent, first_readout
from animat.watch.view import View, time_left

_MOST_RECORDS = 8000
"""Most records in a view: at 80 Hz more than a minute and a half."""
_GROW_S, _COUNT_S = 0.6, 0.15
"""How long a view may look for new records, and count them; the next view continues."""
_SILENT_S = 5.0
"""After which a session without new records no longer counts as running: it logs every request to a culture."""
_NO_TIME = 64
"""Most consecutive records without a time."""
_TRAIL = 400
"""Number of earlier ticks searched for a robot's trail."""
_NUMBERS = (
    "number", "episode", "iteration", "chosen", "delivered", "spikes", "rate_hz", "reward", "late_s", "decided_s",
)  # fmt: skip
_COLUMNS = (*_NUMBERS, "is_burst", "time_s", "agent", "handled", "pulse_time_s", "command", "observation", "total")


class SessionView(View):
    """The folder of a session, with its log."""

    kind = "session"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.tail = Tail(self.file)
        self._generation = -1

    def close(self) -> None:
        self.tail.close()

    def picture(self, at: int) -> bytes | None:
        """A PNG of the robot at a record; None without a tick there or any observation, or if it cannot be drawn."""
        with self._reading():
            self._look()
            tick = self._tick_of(at)
            if tick is None or self._robot is None:
                return None
            before = filter(None, map(self._tick_of, range(at - _TRAIL + 1, at)))
            own = [past["observation"] for past in before if past["episode"] == tick["episode"]]
            earlier = [np.array(observation, np.float64) for observation in own if observation]
            if not tick["observation"] and not earlier:
                return None
            picture = draw_robot(
                self._robot,
                np.array(tick["observation"] or earlier[-1], np.float64),
                command=np.array(tick["command"] or 0.0, np.float64)[()],
                earlier=earlier,
            )
            png = io.BytesIO()
            Image.fromarray(picture).save(png, "PNG", compress_level=1)
            return png.getvalue()

    def _title(self) -> str:
        fields = self._fields
        return f"{text(fields['loop']['robot']['name'])} on the {text(fields.get('culture', ''))} culture"

    def _about(self) -> dict[str, Any]:
        self._look()
        header, fields = self._header, self._fields
        loop, channels = fields["loop"], header.channels
        # In older logs it is a name.
        mapping = mapped(loop.get("mapping")).get("name", loop.get("mapping"))
        percentiles = {kind.name: list(kind.percentile_indices) for kind in (Thresholds(1), Thresholds(9))}
        return {
            "generation": self.tail.generation,
            "title": self._title(),
            "conditions": list(map(text, header.conditions)),
            "observed": list(map(text, header.observed)),
            "readouts": list(map(text, header.readouts)),
            "mapping": text(mapping),
            # Which of the eleven percentiles it compares responses with; both ends if not known.
            "thresholds": percentiles.get(mapping, [0, 10]),
            "adaptive": bool(loop.get("adaptive")),
            "percentiles_hz": first_readout(loop.get("percentiles")),
            "planned": len(fields.get("turns", ())),
            "limits": {text(name): number(value) for name, value in fields.get("limits", {}).items()},
            "account": {text(name): number(value) for name, value in fields.get("account", {}).items()},
            "is_drawn": self._robot is not None,
            "channels": {
                "x_um": list(map(number, channels.x_um.tolist())),
                "y_um": list(map(number, channels.y_um.tolist())),
                "electrode": channels.electrode.tolist(),
            },
        }

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        is_whole = self._look()
        self._sums.go_on(_COUNT_S)
        last = self._span_before(len(self.tail) - 1)
        end_s = 0.0 if last is None else last[1]
        to_s = end_s if to_s is None else min(max(to_s, 0.0), end_s)
        from_s = max(0.0, to_s - span_s)
        shown = self._between(from_s, to_s)
        ticks = [self._tick(at, record) for at, record in shown if record.fields.get("tick")]
        ticks = [tick for tick in ticks if tick["time_s"] <= to_s]
        changed = [record.fields for _, record in shown if "percentiles_hz" in record.fields]
        adapted = [(span[1], first_readout(fields["percentiles_hz"])) for fields in changed if (span := _span(fields))]
        times_s = np.concatenate([np.empty(0), *(record.spike_times_s for _, record in shown)])
        rows = np.concatenate([np.empty(0, np.int64), *(record.spike_channels for _, record in shown)])
        spikes, counts = packed(times_s, rows, from_s, to_s, len(self._header.channels))
        return {
            "generation": self.tail.generation,
            "end_s": end_s,
            "from_s": from_s,
            "to_s": to_s,
            "ticks": {name: [tick[name] for tick in ticks] for name in _COLUMNS},
            "spikes": spikes,
            "counts": counts,
            "pulsed": ticks[-1]["electrodes"] if ticks else [],
            # The last tick with an observation.
            "picture": next((tick["at"] for tick in ticks[::-1] if tick["observation"]), None),
            "is_found": is_whole,
            **self._so_far(),
            "percentiles": _in_force(self._sums.percentiles, adapted),
        }

    def _look(self) -> bool:
        """Find new records in the log; False if there are more than could be found in time."""
        is_whole = self.tail.grow(_GROW_S)
        if self._generation != self.tail.generation:
            if not len(self.tail):
                raise InvalidFile(f"{self.file}: expected a log of a session, got one without a whole beginning")
            self._fields = self.tail.peek(0)
            self._header: Header = read_header(self.file, self._fields)
            self._robot = _drawn_robot(self._fields["loop"])
            self._sums = Sums(self.tail)
            self._generation = self.tail.generation
        return is_whole

    def _so_far(self) -> dict[str, Any]:
        sums = self._sums
        outline, fullest = sums.outline, sums.on_electrode.most_common(1)
        episodes, left_s = outline.episodes, None
        done = sum(episode.is_whole for episode in episodes)
        if done and sums.wall_s is not None:
            # The settling before the first move is not repeated, so it does not count for the remaining episodes.
            moving_s = sums.wall_s - (outline.moved_at_s or 0.0)
            left_s = moving_s * (len(self._fields.get("turns", ())) - done) / done
        state = self._state()
        return {
            **state,
            "summed": sums.share,
            "strange": sums.strange,
            "n_ticks": outline.ticks,
            "pulses": outline.pulses,
            "fullest": [text(fullest[0][0]), fullest[0][1]] if fullest else None,
            "bursts": number(outline.bursts),
            "late": outline.late,
            "latest_s": number(outline.latest_s),
            "unanswered": outline.unanswered_pulses,
            "faults": sums.faults,
            "n_faults": sums.n_faults,
            "episodes_done": done,
            "time_left": time_left(left_s, state),
            "agents": by_agent(self._header.agents, episodes, self._fields.get("predicted")),
        }

    def _state(self) -> dict[str, Any]:
        silent_s = max(0.0, time.time() - self.file.stat().st_mtime)
        silent = f"nothing was written for {format_duration(silent_s)}"
        stop = (self.folder / STOP_FILE).exists()
        last = self.tail.record(len(self.tail) - 1).fields
        damage = self.tail.damage
        if last.get("kind") == "end":
            state, message = "ended", text(last.get("message"))
        elif silent_s < _SILENT_S + self._fields["loop"].get("pause_s", 0.0):
            # A record that is just being written looks like a truncated one.
            state, message, damage = "running", "stopping" if stop else "", ""
        elif is_locked(self.folder):
            state, message = "running", f"{silent}, but its program has not ended: it is waiting, or it hangs"
        else:
            state, message = "silent", f"{silent}, and the log has no end: it was killed, or it hangs"
        return {"state": state, "message": message, "damage": damage, "stop": stop}

    def _span_before(self, at: int) -> tuple[float, float] | None:
        """The span of the last record up to `at` that has a time."""
        for earlier in range(at, max(0, at - _NO_TIME), -1):
            span = _span(self.tail.record(earlier).fields)
            if span is not None:
                return span
        return None

    def _between(self, from_s: float, to_s: float) -> list[tuple[int, LogRecord]]:
        """The records that concern a span, found by bisection, as they are in the order of time."""

        def start_s(at: int) -> float:
            span = self._span_before(at)
            return -math.inf if span is None else span[0]

        records: list[tuple[int, LogRecord]] = []
        for at in range(bisect_right(range(1, len(self.tail)), to_s, key=start_s), 0, -1):
            record = self.tail.record(at)
            span = _span(record.fields)
            if (span is not None and span[1] < from_s) or len(records) >= _MOST_RECORDS:
                break
            records.append((at, record))
        return records[::-1]

    def _tick_of(self, at: int) -> dict[str, Any] | None:
        return self.tail.record(at).fields.get("tick") or None if 0 <= at < len(self.tail) else None

    def _tick(self, at: int, record: LogRecord) -> dict[str, Any]:
        tick, totals = record.fields["tick"], self._sums.totals
        return {
            **{name: number(tick.get(name)) for name in _NUMBERS},
            "at": at,
            "is_burst": bool(tick["is_burst"]),
            "time_s": number(tick["read_after_s"]),
            "agent": text(tick["agent"]),
            "handled": text(tick["handled"]),
            "pulse_time_s": [] if NOTHING in tick["patterns"] else numbers(tick["pulse_time_s"]),
            "command": numbers(tick["command"]),
            "observation": numbers(tick["observation"]),
            "total": number(totals[at]) if at < len(totals) else None,
            "electrodes": [number(each) for *_, electrodes in record.fields["stimuli"][-1:] for each in electrodes],
        }


def _span(fields: dict[str, Any]) -> tuple[float, float] | None:
    start_s, duration_s = number(fields.get("start_s")), number(fields.get("duration_s"))
    if fields.get("kind") != "seen" or start_s is None or duration_s is None:
        return None
    return start_s, start_s + duration_s


def _in_force(rows: Sequence[PercentilesSince], shown: Sequence[PercentilesSince]) -> list[PercentilesSince]:
    """The session's rows, evenly thinned to 400 but including the last, and all rows of the span shown."""
    step = max(1, math.ceil(len(rows) / 400))
    rows = [*rows[:-1:step], *rows[-1:]]
    if not shown:
        return rows
    from_s, to_s = shown[0][0], shown[-1][0]
    return [*(row for row in rows if row[0] < from_s), *shown, *(row for row in rows if row[0] > to_s)]


def stop_session(folder: Path) -> None:
    """Ask a session to end, without waiting or reading anything first, as it may be urgent.

    Raises InvalidArgument if there is none, or it has ended, and InvalidFile if the file cannot be created.
    """
    if not (folder / LOG_FILE).is_file():
        raise InvalidArgument(f"{folder.name}: expected a session to stop, got none")
    if (folder / RECORDING_FILE).exists():
        raise InvalidArgument(f"{folder.name}: the session has ended: there is nothing to stop")
    with as_invalid_file(folder / STOP_FILE, "cannot be created"):
        # Never through a link, which may lead anywhere.
        os.close(os.open(folder / STOP_FILE, os.O_CREAT | os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666))


def _drawn_robot(loop: dict[str, Any]) -> Robot[Any] | None:
    """The robot of a session's header; None if it is not known here or cannot be drawn."""
    try:
        robot = robot_of(loop)
    except Exception:  # a robot of a third party may raise anything
        return None
    return robot if hasattr(robot, "draw") else None
