"""The first record of a session's log: what the session is, looked at before anything is made of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from animat.errors import AnimatError, InvalidFile, shown
from animat.recordings.recording import Channels
from animat.responses.readouts import Readouts
from animat.robots.base import Robot
from animat.robots.registry import robot_from_dict
from animat.stimulation.protocol import Presentation

FORMAT = "animat closed-loop session 1"


@dataclass(frozen=True, eq=False)
class Header:
    """What a session's files are made by.

    Attributes:
        channels: of the culture.
        sampling_rate_hz: of the culture; NaN: unknown.
        start_min: of the session, on the culture's clock.
        recorded_at: when it began, ISO 8601.
        provenance: of the culture.
        presentation: how the loop presented.
        conditions: their labels.
        agents: their names.
        observed: the columns of the robot's observation, with their units.
        loop: all settings, as JSON.
        readouts: names of the groups of channels that were read; none where all channels were read as one.
    """

    channels: Channels
    sampling_rate_hz: float
    start_min: float
    recorded_at: str
    provenance: Mapping[str, str]
    presentation: Presentation
    conditions: tuple[str, ...]
    agents: tuple[str, ...]
    observed: tuple[str, ...]
    loop: str
    readouts: tuple[str, ...] = ()


def observed_columns(robot: Robot[Any]) -> list[str]:
    """The numbers of a robot's observation, each by its name and unit: `cart_velocity_m_per_s`."""
    return [f"{q.name}_{q.unit.replace('/', '_per_')}" if q.unit else q.name for q in robot.observation_spec]


def read_header(file: Path, words: Mapping[str, Any]) -> Header:
    """The header of a session's log.

    Args:
        file: the log, for messages.
        words: of its first record.

    Raises:
        InvalidFile: for a field that is missing or cannot be, named.
    """
    of = _Fields(file, words)
    if words.get("format") != FORMAT:
        raise InvalidFile(f"{file}: expected {FORMAT!r}, got {shown(words.get('format'))}")
    label, electrode = of.texts("channels.label"), of.numbers("channels.electrode", is_whole=True)
    x_um, y_um = of.numbers("channels.x_um"), of.numbers("channels.y_um")
    pulses, recorded_at = of.number("loop.pulses", is_whole=True), of.text("recorded_at")
    sampling_rate_hz, start_min = of.number("sampling_rate_hz"), of.number("start_min")
    if sampling_rate_hz <= 0 or np.isinf(sampling_rate_hz):
        of.refuse("sampling_rate_hz", "a rate above 0 Hz")
    if not np.isfinite(start_min):
        of.refuse("start_min", "finite minutes")
    try:
        datetime.fromisoformat(recorded_at)
    except ValueError:
        of.refuse("recorded_at", "a date in ISO 8601")
    agents = of.listed("agents", lambda each: isinstance(each, dict), "a list of who acted, each with a name")
    try:
        channels = Channels(np.array(label, np.str_), np.array(electrode, np.int64), np.array(x_um), np.array(y_um))
        presentation = Presentation("mixed", int(pulses))
        # Logs of before read all channels as one.
        readouts = Readouts.from_dict(of.at("loop.readouts"))
        # Logs of before had the robot alone.
        observed = (
            of.texts("observed") if "observed" in words else observed_columns(robot_from_dict(of.at("loop.robot")))
        )
    except (AnimatError, OverflowError, TypeError) as error:
        raise InvalidFile(f"{file}: the header of the session: {error}") from error
    return Header(
        channels,
        float(sampling_rate_hz),
        float(start_min),
        recorded_at,
        of.words("provenance"),
        presentation,
        tuple(of.texts("loop.conditions")),
        tuple(of.text("name", each, f"agents[{i}].") for i, each in enumerate(agents)),
        tuple(observed),
        json.dumps(words["loop"]),
        () if readouts.are_all else readouts.names,
    )


class _Fields:
    def __init__(self, file: Path, words: Mapping[str, Any]) -> None:
        self._file, self._words = file, words

    def at(self, name: str) -> Any:
        value: Any = self._words
        for part in name.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value

    def refuse(self, name: str, expected: str, value: Any = None) -> NoReturn:
        value = self.at(name) if value is None else value
        raise InvalidFile(f"{self._file}: the header of the session: {name}: expected {expected}, got {shown(value)}")

    def text(self, name: str, within: Mapping[str, Any] | None = None, before: str = "") -> str:
        value = self.at(name) if within is None else within.get(name)
        if not _is_text(value):
            self.refuse(before + name, "text", value)
        return str(value)

    def number(self, name: str, *, is_whole: bool = False) -> float:
        value = self.at(name)
        if not _is_number(value, is_whole):
            self.refuse(name, _NUMBER[is_whole])
        return value  # type: ignore[no-any-return]

    def listed(self, name: str, is_one: Callable[[Any], bool], expected: str) -> Sequence[Any]:
        value = self.at(name)
        if not isinstance(value, list) or not all(map(is_one, value)):
            self.refuse(name, expected)
        return value

    def texts(self, name: str) -> Sequence[str]:
        return self.listed(name, _is_text, "a list of texts")

    def numbers(self, name: str, *, is_whole: bool = False) -> Sequence[float]:
        return self.listed(name, lambda each: _is_number(each, is_whole), f"a list, each {_NUMBER[is_whole]}")

    def words(self, name: str) -> dict[str, str]:
        value = self.at(name)
        if not isinstance(value, dict) or not all(map(_is_text, [*value, *value.values()])):
            self.refuse(name, "names, each with a text")
        return value


_NUMBER = {True: "a whole number", False: "a number"}


def _is_number(value: Any, is_whole: bool) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float) or (is_whole and not isinstance(value, int)):
        return False
    return not isinstance(value, int) or abs(value) < 2**63


def _is_text(value: Any) -> bool:
    # HDF5 holds neither null characters nor halves of surrogate pairs.
    return isinstance(value, str) and "\0" not in value and not any("\ud800" <= c <= "\udfff" for c in value)
