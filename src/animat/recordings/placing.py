"""Where recordings lie on the culture's clock if their files do not state it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from datetime import datetime
from itertools import pairwise
from typing import Any, Protocol, TypeVar

from animat.errors import in_min
from animat.recordings.findings import Finding
from animat.recordings.recorded_culture import RecordedCulture

RESTARTED_MIN = 1.0
"""How much less time may pass on a device's clock than between the dates of two recordings."""


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
    """The same series, in minutes since the first date if each states one and its starts cannot be of one clock.

    Files of rigs have no culture's clock, so that some start at the same minute, and that of a device may start with
    the program, so that less time passed on it than between the dates. A start that was stated is never replaced. A
    note, `placed-by-date`, in the findings of each says where they are.
    """
    starts_min = [each.start_min for each in series]
    dates = [each.recorded_at for each in series if each.recorded_at is not None]
    of_device = [each.culture is not None and each.culture.kind in ("cl1", "maxone") for each in series]
    is_stated = any(each.start_min and not known for each, known in zip(series, of_device, strict=True))
    if len(dates) < len(series) or is_stated:
        return list(series)
    placed_min = [(date - min(dates)).total_seconds() / 60 for date in dates]
    by_date = sorted(zip(placed_min, starts_min, strict=True))
    was_restarted = all(of_device) and any(
        after - before > clock_after - clock_before + RESTARTED_MIN
        for (before, clock_before), (after, clock_after) in pairwise(by_date)
    )
    if len(set(starts_min)) == len(series) and not was_restarted:
        return list(series)
    listed = ", ".join(map(in_min, sorted(placed_min)))
    why = "some recordings start at the same minute"
    if was_restarted:
        why = "the device's clock was restarted between recordings"
    note = Finding("placed-by-date", "note", f"{why}, so all are placed by their dates: at {listed}")
    changed: list[Any] = list(zip(series, placed_min, strict=True))
    return [dataclasses.replace(each, start_min=at, findings=(*each.findings, note)) for each, at in changed]
