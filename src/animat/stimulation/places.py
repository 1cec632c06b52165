"""Places on an array: groups of electrodes that are pulsed together, named or listed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from animat.errors import InvalidArgument, InvalidFile, in_file, shown
from animat.plain_file import is_absent, read_plain_text
from animat.records import json_data
from animat.stimulation.array import Electrodes, OfElectrodes
from animat.tables import evenly

CUT = {"halves": (2, 1), "quadrants": (2, 2)}
"""Columns and rows into which electrodes are divided, as evenly as possible."""
NAMED = (*CUT, "corners")
SITES = 8
"""Electrodes of a corner: with fewer the commands are less distinct, and more than necessary tire a culture."""
_MOST_BYTES = 2**20
_MOST_PLACES = 1000

NONE: Literal["none"] = "none"
"""The place without electrodes: its trials take their usual time, but nothing is delivered."""

Places = str | tuple[tuple[int, ...] | Literal["none"], ...]
"""One of `NAMED`, or the electrodes of each place, one of which may be `NONE`."""


def check_places(given: Any) -> Places:
    """Places with lists as tuples; raises InvalidArgument for anything but a name or a list of distinct groups."""
    if isinstance(given, str) and given in NAMED:
        return given
    groups = [p for p in given if not (isinstance(p, str) and p == NONE)] if isinstance(given, list | tuple) else None
    is_listed = groups is not None and all(isinstance(place, list | tuple) and place for place in groups)
    if not is_listed or not all(type(e) is int and 0 <= e < 2**63 for place in groups or () for e in place):
        lists = f'groups of electrode numbers such as [[1, 2], [3, 4]], one of which may be "{NONE}"'
        raise InvalidArgument(f"places: expected {', '.join(NAMED)}, or {lists}, got {shown(given)}")
    places = tuple(NONE if place == NONE else tuple(sorted(set(place))) for place in given)
    if len(set(places)) < len(places) or len(places) > _MOST_PLACES:
        raise InvalidArgument(f"places: expected at most {_MOST_PLACES:,} groups, each once, got {shown(given)}")
    return places


def read_places(text: str | os.PathLike[str]) -> Places:
    """One of `NAMED`, or the places in a JSON file, a list of lists of electrodes; raises InvalidFile for another."""
    if text in NAMED:
        return str(text)
    written = read_groups("places", NAMED, text)
    with in_file(text):
        places = check_places(json_data(written, "places", "JSON such as [[1, 2], [3, 4]]"))
        if not places:
            raise InvalidArgument("places: expected groups of electrodes such as [[1, 2], [3, 4]], got none")
        return places


def read_groups(what: str, names: Sequence[str], path: str | os.PathLike[str]) -> str:
    """The text of a file of groups of electrodes, given in place of one of the `names`; else raises InvalidFile."""
    if is_absent(Path(path)):
        expected = f"{', '.join(names)} or a file of groups of electrodes"
        raise InvalidFile(f"{what}: expected {expected}, got {path}, which is not a file")
    try:
        return read_plain_text(path, _MOST_BYTES)
    except InvalidFile as error:
        raise InvalidFile(f"{error}; named {what} are {', '.join(names)}") from error


def count_places(places: Places) -> int:
    return (int(np.prod(CUT[places])) if places in CUT else 4) if isinstance(places, str) else len(places)


def electrodes_of(
    places: Places, electrodes: Electrodes, x_um: OfElectrodes, y_um: OfElectrodes
) -> tuple[tuple[int, ...], ...]:
    """The electrodes of each place, of those that can be stimulated; for `NONE`, no electrodes.

    Halves have the smaller and the larger x; quadrants divide each half by y. Electrodes at the same x (or y) are
    ordered by number. Corners drive two commands, read from the halves, into all four corners: `SITES` electrodes
    spread over the left half, as many over the right half, both together, and one electrode of the left.
    """
    if not isinstance(places, str):
        return tuple(() if place == NONE else place for place in places)
    unknown = np.count_nonzero(~np.isfinite(x_um + y_um))
    if unknown or len(electrodes) < count_places(places):
        missing = f"{unknown} of them unknown" if unknown else f"{len(electrodes)} electrodes"
        expected = f"positions of {count_places(places)} stimulation electrodes or more to cut into {places}"
        raise InvalidArgument(f"places: expected {expected}, got {missing}: list the electrodes of each place")
    if places == "corners":
        y_of_um = dict(zip(electrodes.tolist(), y_um.tolist(), strict=True))
        halves = electrodes_of("halves", electrodes, x_um, y_um)
        # `SITES` electrodes of each half, evenly spaced from its smallest to its largest y.
        sorted_halves = (sorted(half, key=lambda electrode: (y_of_um[electrode], electrode)) for half in halves)
        left, right = (tuple(sorted(half[rank] for rank in evenly(len(half), SITES))) for half in sorted_halves)
        return left, right, tuple(sorted(left + right)), left[:1]
    columns, rows = CUT[places]
    groups = []
    for column in np.array_split(np.lexsort((electrodes, x_um)), columns):
        in_order = column[np.lexsort((electrodes[column], y_um[column]))]
        groups += [tuple(sorted(electrodes[place].tolist())) for place in np.array_split(in_order, rows)]
    return tuple(groups)
