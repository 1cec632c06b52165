"""Where recordings lie on the culture's clock if their files do not state it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from datetime import datetime
from typing import Any, Protocol, TypeVar

from animat.errors import in_min
from animat.recordings.findings import Finding
from animat.recordings.recorded_culture import RecordedCulture


class Dated(Protocol):
    """A recording, or what was made of one."""

    @property
    def start_min(self) -> float: ...
    @property
    def recorded_at(self) -> datetime | None: ...
    @property
    def culture(self) -> RecordedCulture | None: ...
    @property
    def findings(self) -> tuple[Finding, ...]: ...


D = TypeVar("D", bound=Dated)


def placed_by_date(series: Sequence[D]) -> list[D]:
    """The same series, in minutes since the first date if some start at the same minute and each states a date.

    Files of rigs have no culture's clock, and that of a device may start with the program. A start that was stated is
    never replaced. A note, `placed-by-date`, in the findings of each says where they are.
    """
    starts_min = [each.start_min for each in series]
    dates = [each.recorded_at for each in series if each.recorded_at is not None]
    is_stated = any(each.start_min and not _is_of_device(each.culture) for each in series)
    if len(set(starts_min)) == len(series) or len(dates) < len(series) or is_stated:
        return list(series)
    placed_min = [(date - min(dates)).total_seconds() / 60 for date in dates]
    listed = ", ".join(map(in_min, sorted(placed_min)))
    message = f"some recordings start at the same minute, so all are placed by their dates: at {listed}"
    note = Finding("placed-by-date", "note", message)
    changed: list[Any] = list(zip(series, placed_min, strict=True))
    return [dataclasses.replace(each, start_min=at, findings=(*each.findings, note)) for each, at in changed]


def _is_of_device(culture: RecordedCulture | None) -> bool:
    return culture is not None and culture.kind in ("cl1", "maxone")
