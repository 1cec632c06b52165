"""Which electrodes record, which stimulate, and in which patterns: chosen from a scan, and saved as a file."""

from __future__ import annotations

import itertools
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Int64
from pydantic import Field

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, in_file
from animat.plain_file import read_plain_text
from animat.records import Number, Whole, json_data, read_record, record
from animat.stimulation.array import ElectrodeArray, Electrodes, OfElectrodes
from animat.stimulation.patterns import Patterns, draw_patterns
from animat.stimulation.scan import ScannedActivity
from animat.tables import briefly, freeze_one
from animat.writing import write_whole

_MOST_BYTES = 2**24


@record
class SelectionRule:
    """The criteria of a selection; the defaults are the paper's where it states them.

    Attributes:
        recording_sites: at most this many channels.
        signal_to_noise: smallest ratio for an electrode to be recorded.
        spacing_um: an electrode is left out if a neighbour within this distance has a better signal-to-noise ratio, so
            that a neuron is not counted on every electrode around it; 0 leaves none out.
        stimulation_sites: exactly this many.
        patterns, pattern_size, pattern_spacing_um: see `draw_patterns`.
    """

    recording_sites: Whole = 1024
    signal_to_noise: Number = 6.0
    spacing_um: Number = 18.0
    stimulation_sites: Whole = 32
    patterns: Whole = 100
    pattern_size: Whole = 5
    pattern_spacing_um: Number = 100.0


Electrode = Annotated[Whole, Field(ge=0, le=2**63 - 1)]


@record
class _Saved:
    """A selection as stored in its file."""

    format: Literal["animat electrode selection 1"]
    array: ElectrodeArray
    rule: SelectionRule
    seed: Electrode
    scanned: Electrode
    passed: Electrode
    stimulation: tuple[Electrode, ...]
    patterns: tuple[tuple[Electrode, ...], ...]
    recording: tuple[Electrode, ...]


@checked_arguments
@dataclass(frozen=True, eq=False)
class Selection:
    """Recording sites, stimulation sites and patterns on an array, to save, plot and pass to hardware.

    Attributes:
        recording: electrodes that are recorded, channel by channel, shape (channels,).
        stimulation: electrodes that stimulate, shape (sites,).
        patterns: electrodes pulsed together, all of them stimulation sites, shape (patterns, size).
        rule: the criteria.
        seed: of the patterns' draw.
        scanned: number of electrodes scanned.
        passed: number of electrodes that met the threshold and the spacing.
    """

    __repr__ = briefly

    array: ElectrodeArray
    recording: Int64[np.ndarray, " channels"]
    stimulation: Int64[np.ndarray, " sites"]
    patterns: Patterns
    rule: SelectionRule = field(default_factory=SelectionRule)
    seed: int = 0
    scanned: int = 0
    passed: int = 0

    def __post_init__(self) -> None:
        for name, dimensions in (("recording", 1), ("stimulation", 1), ("patterns", 2)):
            electrodes = freeze_one(self, name, np.int64)
            if electrodes.ndim != dimensions:
                raise InvalidArgument(f"selection.{name}: expected {dimensions} dimensions, got {electrodes.shape}")
            self.array.position_um(electrodes.ravel())
            if name != "patterns" and len(np.unique(electrodes)) != len(electrodes):
                raise InvalidArgument(f"selection.{name}: expected each electrode once, got some twice or more")
        others = self.patterns[~np.isin(self.patterns, self.stimulation)]
        if others.size:
            raise InvalidArgument(f"selection.patterns: expected stimulation sites only, got electrode {others[0]}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Selection) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(json.dumps(self.to_dict()))

    def to_dict(self) -> dict[str, Any]:
        """As data for JSON."""
        return {
            "format": "animat electrode selection 1",
            "array": dict(vars(self.array)),
            "rule": dict(vars(self.rule)),
            **{name: getattr(self, name) for name in ("seed", "scanned", "passed")},
            **{name: getattr(self, name).tolist() for name in ("stimulation", "patterns", "recording")},
        }

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Selection:
        """From the output of `to_dict`; raises InvalidArgument for anything else."""
        saved = read_record(_Saved, data, "selection")
        if len(set(map(len, saved.patterns))) > 1:
            raise InvalidArgument("selection.patterns: expected the same number of electrodes in each, got others")
        fields: dict[str, Any] = {name: value for name, value in vars(saved).items() if name != "format"}
        return Selection(**fields | {"patterns": saved.patterns or np.empty((0, 0))})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write as JSON; the file is complete or absent."""
        write_whole(Path(path), json.dumps(self.to_dict(), indent=1) + "\n")

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Selection:
        """Read a file written by `save`; raises InvalidFile if it is missing, damaged, or not a selection."""
        with in_file(path):
            return Selection.from_dict(json_data(read_plain_text(path, _MOST_BYTES), "selection"))


def select_electrodes(
    array: ElectrodeArray, scan: ScannedActivity, rule: SelectionRule | None = None, *, seed: int = 0
) -> Selection:
    """Choose recording sites, stimulation sites and patterns from a scan.

    Recording sites: of the electrodes whose signal-to-noise ratio reaches the threshold and is the best within
    `spacing_um`, those with the highest rate. Stimulation sites: of the recording sites, those with the highest
    product of spike amplitude and excitatory score, since stimulation is most reliable where the spike is largest.

    Raises:
        InvalidArgument: for criteria that cannot be met, with what to relax.

    Source: the paper's methods; the spacing and the score are ours (the paper says "by spike shape and amplitude").
    """
    rule = rule or SelectionRule()
    for name, most in (("recording_sites", array.channels), ("stimulation_sites", array.stimulation_units)):
        if not 1 <= (sites := getattr(rule, name)) <= most:
            raise InvalidArgument(f"{name}: expected 1 to {most} on the {array.name}, got {sites}")
    ratio = scan.signal_to_noise
    passed = np.flatnonzero((ratio >= rule.signal_to_noise) & (scan.rate_hz > 0))
    if rule.spacing_um > 0:
        passed = passed[_is_best_nearby(array, scan.electrode[passed], ratio[passed], rule.spacing_um)]
    if len(passed) < rule.stimulation_sites:
        best = f"; the best ratio is {ratio.max():.1f}" if len(ratio) else ""
        remedy = "lower the ratio or the spacing, scan for longer, or ask for fewer sites"
        passing = f"{len(passed)} of {len(scan)} electrodes pass a signal-to-noise ratio of {rule.signal_to_noise:g}"
        expected = f"{rule.stimulation_sites} among the recording sites"
        raise InvalidArgument(f"stimulation_sites: expected {expected}, but only {passing}{best}: {remedy}")
    # Ties are broken by electrode number, so that a scan always gives the same selection.
    recording = passed[np.lexsort((scan.electrode[passed], -scan.rate_hz[passed]))][: rule.recording_sites]
    if len(recording) < rule.stimulation_sites:
        n, most = rule.stimulation_sites, len(recording)
        raise InvalidArgument(f"stimulation_sites: expected at most as many as recording sites ({most}), got {n}")
    worth = (scan.amplitude_uv * scan.excitatory_score)[recording]
    stimulation = recording[np.lexsort((scan.electrode[recording], -worth))][: rule.stimulation_sites]
    chosen = np.sort(scan.electrode[stimulation])
    patterns = draw_patterns(
        array, chosen, seed=seed, patterns=rule.patterns, size=rule.pattern_size, spacing_um=rule.pattern_spacing_um
    )
    return Selection(array, np.sort(scan.electrode[recording]), chosen, patterns, rule, seed, len(scan), len(passed))


def _is_best_nearby(
    array: ElectrodeArray, electrode: Electrodes, ratio: OfElectrodes, spacing_um: float
) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Whether no electrode within the spacing has a higher ratio; of two equal ones the lower number wins."""
    reach = int(spacing_um / array.pitch_um)
    row, column = electrode // array.columns + reach, electrode % array.columns + reach
    grid = np.full((array.rows + 2 * reach, array.columns + 2 * reach), -np.inf)
    grid[row, column] = ratio
    is_best = np.ones(len(electrode), dtype=bool)
    for up, right in itertools.product(range(-reach, reach + 1), repeat=2):
        if (up, right) != (0, 0) and array.pitch_um * np.hypot(up, right) <= spacing_um:
            neighbour = grid[row + up, column + right]
            is_best &= (neighbour < ratio) if (up, right) < (0, 0) else (neighbour <= ratio)
    return is_best
