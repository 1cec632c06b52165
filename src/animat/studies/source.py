"""The source of a study's recordings: files, or a culture that is recorded for it."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from animat.cultures.series import LONGEST_MIN
from animat.errors import InvalidArgument, shown
from animat.records import Positive, Seed, Whole, record
from animat.stimulation.protocol import TWO_COMMANDS, Protocol

MOST_SESSIONS, MOST_TRIALS, MOST_ENTRIES = 10_000, 1_000_000, 1_000
"""Limits of recordings, trials in each, and entries of a list; documented in `docs/studies.md`."""
MOST_DIGITS = 9
LISTED = Field(max_length=MOST_ENTRIES)


@record
class Source:
    """The source of a study's recordings: files, or a culture that is recorded for the study.

    Attributes:
        kind: `"virtual"`, simulated neurons, or `"files"`.
        files: recordings of one culture, or folders of them, for `"files"`; relative to the specification.
        seed: of the virtual culture.
        seeds, folders: for a study over many cultures (`animat.studies.cultures`): seeds such as `"1-5, 8"` in place of
            `seed`, or folders of recordings, one per culture, in place of `files`.
        sessions, interval_min: number of recordings, and minutes from one to the next.
        order, pulses, trials: how stimuli are presented (`animat.stimulation.protocol`).
        places, frequencies_hz: for a virtual culture, `"corners"`, `"halves"` or `"quadrants"`, each place a separate
            condition, and the frequencies; None: the paper's patterns and frequencies, but only 20 Hz with corners.
    """

    kind: Literal["virtual", "files"] = "virtual"
    files: Annotated[tuple[str, ...], LISTED] = ()
    seed: Seed = 1
    sessions: Annotated[Whole, Field(ge=1, le=MOST_SESSIONS)] = 15
    interval_min: Positive = 10.0
    order: Literal["blocked", "mixed"] = "blocked"
    pulses: Annotated[Whole, Field(ge=1, le=MOST_TRIALS)] = 1
    trials: Annotated[Whole, Field(ge=2, le=MOST_TRIALS)] = 100
    places: Literal["corners", "halves", "quadrants"] | None = None
    frequencies_hz: Annotated[tuple[Positive, ...], LISTED] | None = None
    seeds: str | None = None
    folders: Annotated[tuple[str, ...], LISTED] | None = None

    def __post_init__(self) -> None:
        if self.kind == "files" and not (self.files or self.folders):
            raise InvalidArgument("files, folders: expected files or folders with kind = 'files', got none")
        if self.kind != "files" and (self.files or self.folders):
            n = len(self.files) + len(self.folders or ())
            raise InvalidArgument(f"files, folders: expected only with kind = 'files', got {n} for {self.kind!r}")
        if self.files and self.folders:
            raise InvalidArgument("folders: expected files of one culture or folders of many, got both")
        names = [Path(each).name for each in self.folders or ()]
        if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
            raise InvalidArgument(f"folders: expected different names, got {twice[0]!r} twice: rename one")
        if self.seeds is not None:
            read_seeds(self.seeds)
            if self.seed != 1:
                raise InvalidArgument(f"seeds: expected seed or seeds, got both, {self.seed} and {self.seeds!r}")
        if self.sessions * self.interval_min > LONGEST_MIN:
            raise InvalidArgument(
                f"sessions, interval_min: expected recordings within a year, got {self.sessions} every "
                f"{self.interval_min:g} min"
            )
        for file in (*self.files, *(self.folders or ())):
            if not file or not file.isprintable():
                raise InvalidArgument(f"files: expected names of files, got {shown(file)}")
        for each in fields(self) if self.kind == "files" else ():
            if each.name not in ("kind", "files", "folders") and getattr(self, each.name) != each.default:
                raise InvalidArgument(f"{each.name}: expected only for a culture that is recorded, got kind = 'files'")
        # An invalid protocol is refused before a folder is made.
        self.protocol()

    @property
    def name(self) -> str:
        """The culture's seed, or the names of its files, without their folders."""
        return str(self.seed) if self.kind == "virtual" else ", ".join(Path(file).name for file in self.files)

    def protocol(self) -> Protocol:
        """The protocol of each recording of a virtual culture; raises InvalidArgument if it is invalid."""
        places: dict[str, Any] = {} if self.places is None else {"places": self.places}
        if self.frequencies_hz is not None or self.places == "corners":
            given = self.frequencies_hz
            places["frequencies_hz"] = TWO_COMMANDS.frequencies_hz if given is None else given
        return Protocol(order=self.order, pulses=self.pulses, trials=self.trials, **places)


def read_seeds(text: str) -> list[int]:
    """Seeds written as numbers and ranges, such as `1-5, 8`; raises InvalidArgument for other text, or too many."""
    seeds: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*", part)
        if found and max(len(each or "") for each in found.groups()) > MOST_DIGITS:
            raise InvalidArgument(f"seeds: expected numbers of at most {MOST_DIGITS} digits, got {shown(text)}")
        first, last = (int(found[1]), int(found[2] or found[1])) if found else (0, -1)
        if last < first:
            raise InvalidArgument(f"seeds: expected numbers and ranges, such as '1-5, 8', got {shown(text)}")
        if len(seeds) + last - first >= MOST_ENTRIES:
            raise InvalidArgument(f"seeds: expected at most {MOST_ENTRIES} cultures, got {shown(text)}")
        seeds += range(first, last + 1)
    if len(set(seeds)) < len(seeds):
        raise InvalidArgument(f"seeds: expected each culture once, got {shown(text)}")
    return seeds
