"""Where a study's recordings come from: files, or a culture that is recorded for it."""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Literal

from pydantic import Field

from animat.cultures.series import LONGEST_MIN
from animat.errors import InvalidArgument, shown
from animat.recordings.synthetic import SyntheticCulture
from animat.records import Positive, Seed, Whole, record
from animat.stimulation.protocol import Protocol

MOST_SESSIONS, MOST_TRIALS, MOST_ENTRIES = 10_000, 1_000_000, 1_000
"""Recordings, trials in each, and entries of a list; `docs/studies.md` states them."""

LISTED = Field(max_length=MOST_ENTRIES)


@record
class Source:
    """Where the recordings come from: files, or a culture that is recorded for the study.

    Attributes:
        kind: `"virtual"`, simulated neurons; `"synthetic"`, responses of known distributions, to try things; `"files"`.
        files: recordings of one culture, or folders of them, for `"files"`; relative to the specification.
        seed: which virtual or synthetic culture.
        sessions, interval_min: how many recordings, and the minutes from one to the next.
        order, pulses, trials: how stimuli are presented (`animat.stimulation.protocol`).
        channels: of a synthetic culture.
    """

    kind: Literal["virtual", "synthetic", "files"] = "virtual"
    files: Annotated[tuple[str, ...], LISTED] = ()
    seed: Seed = 1
    sessions: Annotated[Whole, Field(ge=1, le=MOST_SESSIONS)] = 15
    interval_min: Positive = 10.0
    order: Literal["blocked", "mixed"] = "blocked"
    pulses: Annotated[Whole, Field(ge=1, le=MOST_TRIALS)] = 1
    trials: Annotated[Whole, Field(ge=2, le=MOST_TRIALS)] = 100
    channels: Annotated[Whole, Field(ge=1, le=1024)] = 256

    def __post_init__(self) -> None:
        if (self.kind == "files") != bool(self.files):
            raise InvalidArgument(f"files: expected some for kind = 'files' only, got {len(self.files)}")
        if self.sessions * self.interval_min > LONGEST_MIN:
            raise InvalidArgument(
                f"sessions, interval_min: expected recordings within a year, got {self.sessions} every "
                f"{self.interval_min:g} min"
            )
        for file in self.files:
            if not file or not file.isprintable():
                raise InvalidArgument(f"files: expected names of files, got {shown(file)}")
        if self.kind == "files":
            for each in fields(self):
                if each.name not in ("kind", "files") and getattr(self, each.name) != each.default:
                    raise InvalidArgument(
                        f"{each.name}: expected only for a culture that is recorded, got one of files"
                    )
        if self.kind == "synthetic" and (self.order, self.pulses) != ("blocked", 1):
            raise InvalidArgument("order: a synthetic culture is recorded blocked with one pulse, got otherwise")
        # What the recordings themselves refuse is refused before there is a folder.
        if self.kind == "virtual":
            Protocol(order=self.order, pulses=self.pulses, trials=self.trials)
        elif self.kind == "synthetic":
            SyntheticCulture(self.seed, patterns=self.trials, channels=self.channels)
