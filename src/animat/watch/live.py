"""The view of a live run: learning curves so far, the recordings that were swapped in, and the events of its log."""

from __future__ import annotations

import json
from typing import Any

from animat.errors import InvalidFile
from animat.folders import POLICIES, RECORDINGS, SESSION
from animat.watch.discovery import is_locked, state_of
from animat.watch.files import listed, mapped, number, text, text_of
from animat.watch.learning import MOST_POLICIES, Curves, curve_of_policy, learning_charts
from animat.watch.view import View, facts, in_blocks, settings, short, table

_MOST_BYTES = 2**24
_MOST_SHOWN = 200
_FAULTS = ("fault", "interrupted")
_ENDS = (*_FAULTS, "end")
"""The last event; without room on the disk a fault may be."""
_OF_ALL = ("at", "wall_s", "culture_min", "what", "budget")
"""Fields that are shown elsewhere, or in no event of their own."""

Event = dict[str, Any]
"""A line of `live.log`."""


class LiveView(View):
    kind = "live"

    def _title(self) -> str:
        begun = _first(self._events(), "begun")
        return f"live training of {text(begun.get('robot', ''))} policies"

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        events = self._events()
        begun, last = _first(events, "begun"), events[-1]
        recorded = [event for event in events if event["what"] == "recording"]
        curves = self._curves(number(begun.get("policies")) or 0)
        swaps, spent = _swaps(events), mapped(_newest(events, "budget"))
        done = [float(rows[-1, 0]) for rows in curves.values() if len(rows)]
        rows: list[tuple[str, Any]] = [
            ("policies", begun.get("policies", "not known")),
            ("recordings", len(recorded)),
            ("newest swapped in", f"that of {swaps[-1][1]}" if swaps else "the first"),
            ("iterations of each", _from_to(done)),
            ("minutes at the last event", _passed_min(begun, last)),
            ("minutes of training", begun.get("duration_min", "not known")),
            ("pulses at the last event", number(spent.get("pulses"))),
        ]
        charts = learning_charts(curves, swaps, None, {}, "")
        return in_blocks(self._state(events), [facts("So far", rows), *charts, _table(events)])

    def _events(self) -> list[Event]:
        """The log's readable lines; the last may be one that is just being written."""
        events = [event for line in text_of(self.file, _MOST_BYTES).splitlines() if (event := _event(line))]
        if not events:
            raise InvalidFile(f"{self.file}: expected the log of a live run, got something else")
        return events

    def _curves(self, policies: float) -> Curves:
        """The learning curves of the policies saved so far."""
        files = {i: self.folder / POLICIES / f"p{i}.safetensors" for i in range(min(int(policies), MOST_POLICIES))}
        curves = {i: self._cached_content(file, curve_of_policy) for i, file in files.items()}
        return {i: rows for i, rows in curves.items() if rows is not None}

    def _state(self, events: list[Event]) -> dict[str, Any]:
        """The state of the run; how it ended is the message of the event before its end."""
        names = [event["what"] for event in events]
        # The command locks the whole folder, a run from Python what it writes to.
        parts = self.folder, *(self.folder / part for part in (RECORDINGS, POLICIES, SESSION))
        state = state_of(next(filter(is_locked, parts), self.folder), is_done=names[-1] in _ENDS)
        if state["state"] == "ended":
            why = [event for event in events if event["what"] in (*_FAULTS, "closed loop")]
            return state | {"message": _details(why[-1]) if why else ""}
        if state["state"] == "silent":
            return state | {"message": "its program was killed: what it left can still be used, but not continued"}
        if "trained" in names:
            return state | {"message": "training has ended: the closed loop is prepared or runs"}
        return state | {"message": "training" if "training began" in names else "the first recording is made"}


def _event(line: str) -> Event | None:
    try:
        event = mapped(json.loads(line))
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event.get("what"), str) else None


def _first(events: list[Event], what: str) -> Event:
    return next((event for event in events if event["what"] == what), {})


def _newest(events: list[Event], field: str) -> Any:
    return next((event[field] for event in reversed(events) if field in event), None)


def _swaps(events: list[Event]) -> list[tuple[float, str]]:
    """After how many iterations the first group of policies was refreshed with each recording, and its minute."""
    swaps: dict[float, float] = {}
    for event in events:
        after, minute = number(event.get("iterations")), number(event.get("recorded_at_min"))
        if event["what"] == "swap" and after is not None and minute is not None:
            swaps[minute] = min(after, swaps.get(minute, after))
    return [(swaps[minute], f"minute {minute:g}") for minute in sorted(swaps)]


def _passed_min(begun: Event, last: Event) -> float | None:
    """Minutes of the culture's clock from the beginning of the run."""
    from_min, to_min = number(begun.get("culture_min")), number(last.get("culture_min"))
    return None if from_min is None or to_min is None else round(to_min - from_min, 1)


def _from_to(values: list[float]) -> str:
    known = [value for value in values if number(value) is not None]
    if not known:
        return "not known yet"
    least, most = min(known), max(known)
    return f"{least:,.0f}" if least == most else f"{least:,.0f} to {most:,.0f}"


def _details(event: Event) -> str:
    """What happened in an event: its message, or its values by name."""
    for name in ("message", "ended"):
        if name in event:
            return text(event[name])
    rest = {name: value for name, value in event.items() if name not in _OF_ALL}
    if members := listed(rest.pop("members", None)):
        rest = {"policies": f"{short(members[0])} to {short(members[-1])}"} | rest
    return settings(rest)


def _table(events: list[Event]) -> dict[str, Any]:
    newest = events[::-1][:_MOST_SHOWN]
    rows = [[number(event.get("culture_min")), text(event["what"], 60), _details(event)] for event in newest]
    note = "The newest first; minutes are on the culture's clock."
    return table("Events", ["minute", "event", "details"], rows, note, width="whole")
