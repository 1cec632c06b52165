"""The first record of a session's log, which describes the session; it is checked before use."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
from pydantic import AfterValidator, Field, Strict
from typing_extensions import TypedDict

from animat.errors import AnimatError, InvalidArgument, InvalidFile, shown
from animat.recordings.metadata import date_of
from animat.recordings.recording import Channels
from animat.records import Number, Whole, read_record
from animat.responses.readouts import Readouts
from animat.robots.base import Robot
from animat.robots.registry import robot_from_dict
from animat.stimulation.protocol import Presentation
from animat.stimulation.pulse import Pulse

FORMAT = "animat closed-loop session 1"


def _hdf5_text(value: str) -> str:
    # The session's recording stores it in HDF5.
    if "\0" in value or any("\ud800" <= c <= "\udfff" for c in value):
        raise ValueError(f"expected text without null characters and halves of surrogate pairs, got {shown(value)}")
    return value


def _date(value: str) -> str:
    if date_of({"recorded_at": value}) is None:
        raise ValueError(f"expected a date in ISO 8601, got {shown(value)}")
    return value


_Text = Annotated[str, Strict(), AfterValidator(_hdf5_text)]
_Electrode = Annotated[Whole, Field(ge=-(2**63), lt=2**63)]
_OrNaN = Annotated[float, Strict()]


class _Channels(TypedDict):
    label: list[_Text]
    electrode: list[_Electrode]
    x_um: list[_OrNaN]
    y_um: list[_OrNaN]


class _Loop(TypedDict):
    pulses: Whole
    conditions: list[_Text]


class _Agent(TypedDict):
    name: _Text


class _Fields(TypedDict):
    channels: _Channels
    sampling_rate_hz: _OrNaN
    start_min: Number
    recorded_at: Annotated[_Text, AfterValidator(_date)]
    provenance: dict[_Text, _Text]
    loop: _Loop
    agents: list[_Agent]
    observed: NotRequired[list[_Text]]


@dataclass(frozen=True, eq=False)
class Header:
    """The description of a session, from which its files are made.

    Attributes:
        sampling_rate_hz: of the culture; NaN: unknown.
        start_min: start of the session on the culture's clock.
        recorded_at: when it began, ISO 8601.
        observed: the columns of the robot's observation, with their units.
        loop: all settings, as JSON.
        readouts: names of the groups of channels that were read; none where all channels were read as one.
        pulse: that was delivered.
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
    pulse: Pulse | None = None


def observed_columns(robot: Robot[Any]) -> list[str]:
    """Column names of a robot's observation, with units: `cart_velocity_m_per_s`."""
    return [f"{q.name}_{q.unit.replace('/', '_per_')}" if q.unit else q.name for q in robot.observation_spec]


def read_header(file: Path, fields: Mapping[str, Any]) -> Header:
    """The header of a log, from its first record's fields; InvalidFile names one that is missing or invalid."""
    if fields.get("format") != FORMAT:
        raise InvalidFile(f"{file}: expected {FORMAT!r}, got {shown(fields.get('format'))}")
    try:
        known = read_record(_Fields, fields)
        loop, rate_hz = fields["loop"], known["sampling_rate_hz"]
        if rate_hz <= 0 or np.isinf(rate_hz):
            raise InvalidArgument(f"sampling_rate_hz: expected a rate above 0 Hz, got {rate_hz}")
        # Older logs read all channels as one, and have the robot instead of `observed`.
        readouts = Readouts.from_dict(loop.get("readouts"))
        observed = known["observed"] if "observed" in known else observed_columns(robot_from_dict(loop.get("robot")))
        return Header(
            channels=Channels(**{name: np.array(column) for name, column in known["channels"].items()}),
            sampling_rate_hz=rate_hz,
            start_min=known["start_min"],
            recorded_at=known["recorded_at"],
            provenance=known["provenance"],
            presentation=Presentation("mixed", known["loop"]["pulses"]),
            conditions=tuple(known["loop"]["conditions"]),
            agents=tuple(agent["name"] for agent in known["agents"]),
            observed=tuple(observed),
            loop=json.dumps(loop),
            readouts=() if readouts.are_all else readouts.names,
            pulse=Pulse.from_list(loop["pulse"]) if "pulse" in loop else None,
        )
    except (AnimatError, OverflowError, TypeError) as error:
        raise InvalidFile(f"{file}: the header of the session: {error}") from error
