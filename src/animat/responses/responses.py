"""The culture's responses to the stimuli of each condition, one row per stimulus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from animat.errors import InvalidArgument, Mismatch, UnusableData
from animat.recordings.findings import Finding
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Channels, Recording
from animat.responses.condition import Condition
from animat.responses.conditions import NO_CONDITION
from animat.responses.readouts import ALL, Readouts
from animat.stimulation.protocol import Presentation
from animat.tables import briefly, freeze_one, reduce_dataclass

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, eq=False)
class Trials:
    """All trials of a recording in the order of time, which form the history of each response.

    Attributes:
        condition: index of each, `NO_CONDITION` if it has none.
        is_rested: whether there was no pulse for `extraction.SILENCE_S` before it.
        time_s: of the pulse after which it was read, on the recording's clock; None if it is not known.
        set_up_s: seconds of setting up stimulation until then, which that clock leaves out; None: none.
    """

    __repr__, __reduce__ = briefly, reduce_dataclass

    condition: Int64[np.ndarray, " presentations"]
    rate_hz: Float64[np.ndarray, " presentations"]
    is_burst: Bool[np.ndarray, " presentations"]
    is_rested: Bool[np.ndarray, " presentations"]
    time_s: Float64[np.ndarray, " presentations"] | None = None
    set_up_s: Float64[np.ndarray, " presentations"] | None = None

    @property
    def clock_s(self) -> Float64[np.ndarray, " presentations"] | None:
        """When each was read, on a clock that runs on between blocks; None if it is not known."""
        return self.time_s if self.time_s is None or self.set_up_s is None else self.time_s + self.set_up_s

    def __post_init__(self) -> None:
        for name, column in vars(self).items():
            if column is not None and (shape := freeze_one(self, name).shape) != (len(self.condition),):
                raise Mismatch(f"presented.{name}: expected {len(self.condition)} values, got {shape}")


@dataclass(frozen=True, eq=False)
class Responses:
    """Responses to the stimuli of one recording, in the order of time. Arrays are read-only.

    Attributes:
        condition: index into `conditions`, shape (responses,).
        rate_hz: x, spikes in the window per second and channel, shape (responses,).
        active_ratio: share of channels with at least one spike in the window, shape (responses,).
        is_burst: whether `active_ratio` is above `threshold`, shape (responses,).
        conditions: from which the agent chooses, in the order of their index.
        window_ms: start and end of the window, after the last pulse of each trial.
        n_channels: the number of channels over which x is a mean.
        threshold, separability: of the active ratio, see `animat.responses.bursts.BurstSeparation`.
        presentation: how stimuli were presented; None if it is not known.
        start_min: start of the recording on the culture's clock, in minutes.
        time_s: of the pulse before each response, on the recording's clock, shape (responses,); None if not known.
        presented: all trials, including those without a condition; None: these responses are all (see `presentations`).
        place: the index of each response among them, shape (responses,).
        by: the rule that sorted stimuli into conditions, as `conditions_named` reads it; None if it is not known.
        burst_threshold: the given threshold; None: it is Otsu's.
        culture, recorded_at: which was recorded, and when; None if it is not known.
        pattern_names: the names that the file has for patterns, by their numbers; empty if it has none.
        channels: those over which x is a mean; None if they are not known.
        readouts: the groups of channels read; by default all channels as one.
        readout_hz: x of each readout, shape (responses, readouts), or (responses,) for one; None: it is `rate_hz`.
        recording: without its spikes; None for responses that were not extracted from one.

    Raises:
        Mismatch: for columns of different lengths, or a condition that is not in the list.
        UnusableData: for rates that are not finite.
    """

    __repr__, __reduce__ = briefly, reduce_dataclass

    condition: Int64[np.ndarray, " responses"]
    rate_hz: Float64[np.ndarray, " responses"]
    active_ratio: Float64[np.ndarray, " responses"]
    is_burst: Bool[np.ndarray, " responses"]
    conditions: tuple[Condition, ...]
    window_ms: tuple[float, float]
    n_channels: int
    threshold: float
    separability: float
    presentation: Presentation | None = None
    start_min: float = 0.0
    findings: tuple[Finding, ...] = ()
    time_s: Float64[np.ndarray, " responses"] | None = None
    presented: Trials | None = None
    place: Int64[np.ndarray, " responses"] | None = None
    by: str | None = None
    burst_threshold: float | None = None
    culture: RecordedCulture | None = None
    recorded_at: datetime | None = None
    pattern_names: Mapping[int, str] = field(default_factory=dict)
    channels: Channels | None = None
    readouts: Readouts = ALL
    readout_hz: Float64[np.ndarray, "responses *readouts"] | None = None
    recording: Recording | None = None

    def __post_init__(self) -> None:
        shape = (len(self),)
        columns = {"condition": np.int64, "rate_hz": np.float64, "active_ratio": np.float64, "is_burst": np.bool_}
        for name, dtype in (columns | {"time_s": np.float64, "place": np.int64}).items():
            if getattr(self, name) is not None and (got := freeze_one(self, name, dtype).shape) != shape:
                raise Mismatch(f"responses.{name}: expected {len(self)} values, one per response, got {got}")
        if not np.all(np.isfinite(self.rate_hz)):
            raise UnusableData("responses.rate_hz: expected finite numbers, got NaN or infinite ones")
        if (self.readout_hz is None) != self.readouts.are_all:
            raise Mismatch("responses.readout_hz: expected if, and only if, readouts are groups of channels")
        if self.readout_hz is not None:
            expected = shape if len(self.readouts) == 1 else (len(self), len(self.readouts))
            if (got := freeze_one(self, "readout_hz", np.float64).shape) != expected:
                raise Mismatch(f"responses.readout_hz: expected shape {expected}, got {got}")
        if (self.presented is None) != (self.place is None):
            raise Mismatch("responses.presented, responses.place: expected both or neither, got one")
        n, trials = len(self.conditions), 0 if self.presented is None else len(self.presented.condition)
        bounds = (("place", trials, f"rows from 0 to {trials - 1}"), ("condition", n, f"indices of {n} conditions"))
        for name, end, words in bounds:
            index = getattr(self, name)
            if index is not None and len(index) and not (index.min() >= 0 and index.max() < end):
                raise Mismatch(f"responses.{name}: expected {words}, got {index.min()} to {index.max()}")

    def __len__(self) -> int:
        return len(self.condition)

    @property
    def is_blocked(self) -> bool:
        """Whether all trials of a condition were presented together; False if that is not known."""
        return self.presentation is not None and self.presentation.order == "blocked"

    @property
    def presentations(self) -> tuple[Trials, Int64[np.ndarray, " responses"]]:
        """All trials of the recording in the order of time, and the index of each response among them."""
        if self.presented is not None and self.place is not None:
            return self.presented, self.place
        every = Trials(self.condition, self.rate_hz, self.is_burst, np.zeros(len(self), np.bool_))
        return every, np.arange(len(self))

    @property
    def last_hz(self) -> Float64[np.ndarray, " responses"]:
        """x of the response before each one, Hz: 0 after silence, NaN after a burst."""
        presented, place = self.presentations
        before_hz = np.concatenate([[0.0], np.where(presented.is_burst, np.nan, presented.rate_hz)])[:-1]
        return np.asarray(np.where(presented.is_rested, 0.0, before_hz)[place])

    @property
    def read_hz(self) -> Float64[np.ndarray, "responses *readouts"]:
        """x of the readouts, Hz: what simulators are fitted to and decoders read."""
        return self.rate_hz if self.readout_hz is None else self.readout_hz

    def read_of(self, condition: int) -> Float64[np.ndarray, "non_bursts *readouts"]:
        """x of the readouts in the non-burst responses to one condition, in Hz."""
        return np.asarray(self.read_hz[(self.condition == condition) & ~self.is_burst])

    def of_readout(self, readout: int) -> Responses:
        """The responses of one of several readouts, as if it were the only one."""
        rate_hz = self.read_hz[:, readout]
        # Trials without a condition are only known for all channels together.
        return replace(self, rate_hz=rate_hz, readouts=ALL, readout_hz=None, presented=None, place=None)

    @property
    def non_burst_rate_hz(self) -> Float64[np.ndarray, " non_bursts"]:
        """x of the non-burst responses of all conditions together, in Hz."""
        return np.asarray(self.rate_hz[~self.is_burst])

    @property
    def median_rate_hz(self) -> float:
        """P50: the median of the non-burst responses of all conditions together, in Hz; NaN without any."""
        rates_hz = self.non_burst_rate_hz
        return float(np.median(rates_hz)) if len(rates_hz) else float("nan")

    def rates_of(self, condition: int) -> Float64[np.ndarray, " non_bursts"]:
        """x of the non-burst responses of one condition, in Hz."""
        return np.asarray(self.rate_hz[(self.condition == condition) & ~self.is_burst])

    def to_frame(self) -> DataFrame:
        """A table with a row for each response.

        Its columns are `condition` (the label), `rate_hz`, `active_ratio`, `is_burst`, `start_min` of the recording,
        `time_s` if it is known, and for each of several readouts its x, `rate_hz_NAME`.
        """
        from pandas import DataFrame

        labels = np.array([condition.label for condition in self.conditions], object)
        columns = {"condition": labels[self.condition], "rate_hz": self.rate_hz, "active_ratio": self.active_ratio}
        columns |= {"is_burst": self.is_burst, "start_min": np.full(len(self), self.start_min)}
        if self.time_s is not None:
            columns["time_s"] = self.time_s
        if self.readout_hz is not None:
            each = self.readout_hz.reshape(len(self), -1).T
            columns |= {f"rate_hz_{name}": x for name, x in zip(self.readouts.names, each, strict=True)}
        return DataFrame(columns)

    def bootstrapped(self, rng: np.random.Generator) -> Responses:
        """A bootstrap sample: as many non-burst responses to each condition, drawn from them with replacement.

        Each keeps its history. Bursts are left out, and a condition without other responses remains empty.
        """
        rows = [np.flatnonzero((self.condition == c) & ~self.is_burst) for c in range(len(self.conditions))]
        drawn = np.sort(np.concatenate([rng.choice(of, len(of)) for of in rows if len(of)] or [np.empty(0, np.int64)]))
        return replace(self.at_rows(drawn), findings=())

    def only(self, conditions: Sequence[int]) -> Responses:
        """The responses to some conditions, by index, each once; their history is kept.

        Raises InvalidArgument for another index.
        """
        if len({*conditions}) < len(conditions) or not {*conditions} <= {*range(len(self.conditions))}:
            expected = f"some of 0 to {len(self.conditions) - 1}, each once"
            raise InvalidArgument(f"conditions: expected {expected}, got {', '.join(map(str, conditions))}")
        index = np.full(len(self.conditions) + 1, NO_CONDITION)
        index[list(conditions)] = np.arange(len(conditions))
        kept = self.at_rows(np.flatnonzero(index[self.condition] != NO_CONDITION))
        presented, _ = kept.presentations
        return replace(
            kept,
            condition=index[kept.condition],
            conditions=tuple(self.conditions[i] for i in conditions),
            # NO_CONDITION, -1, is the last index, and stays.
            presented=replace(presented, condition=index[presented.condition]),
        )

    def at_rows(self, rows: Int64[np.ndarray, " rows"]) -> Responses:
        """Some of the responses; their history is kept."""
        presented, place = self.presentations
        names = ("condition", "rate_hz", "active_ratio", "is_burst", "time_s", "readout_hz")
        columns: dict[str, Any] = {name: of[rows] for name in names if (of := getattr(self, name)) is not None}
        return replace(self, **columns, presented=presented, place=place[rows])

    def shares_above_median(self) -> Float64[np.ndarray, " conditions"]:
        """P(x >= P50) of every condition's non-burst responses; NaN for a condition without any."""
        median_hz = self.median_rate_hz
        rates_hz = map(self.rates_of, range(len(self.conditions)))
        return np.array([np.mean(x >= median_hz) if len(x) else np.nan for x in rates_hz], np.float64)
