"""A protocol made definite: which pattern is pulsed when, from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidArgument
from animat.stimulation.protocol import Protocol
from animat.stimulation.stimulus import NOTHING, Stimuli, Stimulus
from animat.tables import UNKNOWN, padded

TICK_S = 50e-6
"""Stimuli start on a grid of 50 us, a sample at 20 kHz: what stimulation hardware can time exactly."""
_GAP_S = 0.005
"""Between two pulses at least, for a block to be cut there."""


@dataclass(frozen=True, eq=False)
class Block:
    """A stretch of stimulation without a break.

    Attributes:
        setup_s: passes before it, unrecorded.
        duration_s: recorded.
        stimuli: their times counted from the block's recorded start; presentations numbered through all blocks.
    """

    setup_s: float
    duration_s: float
    stimuli: Stimuli

    def stretches(self, least_s: float) -> tuple[Block, ...]:
        """The block in stretches, without set-up, that come one right after the other; cut between presentations.

        Args:
            least_s: how long each is but for the last; it is cut in the next gap between pulses.
        """
        time_s, presentation = self.stimuli.time_s, self.stimuli.presentation
        begins = 1 + np.flatnonzero((np.diff(presentation) != 0) & (np.diff(time_s) >= _GAP_S))
        rows, ends_s = [0], [0.0]
        for row, end_s in zip(begins.tolist(), on_ticks((time_s[begins - 1] + time_s[begins]) / 2), strict=True):
            if end_s - ends_s[-1] >= least_s:
                rows.append(row)
                ends_s.append(float(end_s))
        rows, ends_s = [*rows, len(time_s)], [*ends_s, self.duration_s]
        return tuple(
            Block(0.0, end_s - start_s, _between(self.stimuli, first, last, start_s))
            for (first, last), (start_s, end_s) in zip(pairwise(rows), pairwise(ends_s), strict=True)
        )


@dataclass(frozen=True, eq=False)
class Schedule:
    """All stimuli of one recording, block by block.

    Attributes:
        protocol: that it follows.
        seed: that decided every draw.
        blocks: in the order of time.
    """

    protocol: Protocol
    seed: int
    blocks: tuple[Block, ...]

    @property
    def duration_s(self) -> float:
        """How long it takes, set-up included."""
        return sum(block.setup_s + block.duration_s for block in self.blocks)

    @property
    def recorded_s(self) -> float:
        """How much of that is recorded."""
        return sum(block.duration_s for block in self.blocks)

    def __len__(self) -> int:
        return sum(len(block.stimuli) for block in self.blocks)

    def deliveries(self, block: Block) -> list[Stimulus]:
        """The stimuli of a block as they are delivered."""
        table = block.stimuli
        columns = table.time_s, table.electrodes, table.frequency_hz, table.pattern, table.presentation
        return [
            Stimulus(time_s, tuple(e for e in on if e != UNKNOWN), self.protocol.pulse, frequency_hz, pattern, number)
            for time_s, on, frequency_hz, pattern, number in zip(*(each.tolist() for each in columns), strict=True)
        ]


def _between(stimuli: Stimuli, first: int, last: int, start_s: float) -> Stimuli:
    """Rows of a table, their times counted from a start."""
    columns = {each.name: getattr(stimuli, each.name)[first:last] for each in fields(Stimuli)}
    return Stimuli(**columns | {"time_s": on_ticks(columns["time_s"] - start_s)})


def make_schedule(
    protocol: Protocol,
    patterns: Int64[np.ndarray, "patterns size"],
    seed: int,
    *,
    places: Sequence[tuple[int, ...]] = (),
) -> Schedule:
    """Draw the order of conditions and patterns of one recording.

    Args:
        protocol: what to do.
        patterns: the culture's patterns, electrodes of each, padded with -1.
        seed: zero or more.
        places: electrodes of each of the protocol's places, where it has any; of one that is none, none.

    Raises:
        InvalidArgument: if the culture has fewer patterns than the protocol uses, for other places than it has, or for
            a negative seed.
    """
    if len(places) != protocol.n_places:
        raise InvalidArgument(f"places: expected electrodes of {protocol.n_places}, got those of {len(places)}")
    if not places and protocol.patterns > len(patterns):
        raise InvalidArgument(
            f"patterns: expected at most the {len(patterns)} that the culture's electrode selection has, got "
            f"{protocol.patterns}: select more, or use fewer"
        )
    if seed < 0:
        raise InvalidArgument(f"seed: expected 0 or more, got {seed}")
    rng = np.random.default_rng([seed, 7])
    n_frequencies, each = len(protocol.frequencies_hz), protocol.trials
    n_conditions = n_frequencies * max(1, len(places))
    if protocol.order == "blocked":
        orders = [np.full(each, condition) for condition in rng.permutation(n_conditions)]
    else:
        orders = [rng.permutation(np.repeat(np.arange(n_conditions), each))]
    if places:
        # A place that is a pattern of the culture has its number.
        number_of = {frozenset(row) - {UNKNOWN}: i for i, row in enumerate(patterns.tolist())}
        number = np.array([number_of.get(frozenset(place), UNKNOWN) if place else NOTHING for place in places])
        electrodes = padded(places)
    else:
        number, electrodes = np.arange(len(patterns)), patterns
        # Each pattern as often as the others, one round after the other, each round in random order.
        rounds = range(-(-each // protocol.patterns))
        left = [
            iter([pattern for _ in rounds for pattern in rng.permutation(protocol.patterns).tolist()])
            for _ in range(n_frequencies)
        ]
    blocks = []
    for i, order in enumerate(orders):
        frequency, place = np.divmod(order, max(1, len(places)))
        if places:
            row = np.repeat(place, protocol.pulses)
        else:
            row = np.concatenate([_train(rng, protocol, next(left[f])) for f in frequency.tolist()])
        frequency_hz = np.array(protocol.frequencies_hz)[frequency]
        blocks.append(_block(protocol, frequency_hz, electrodes[row], number[row], i * len(order)))
    return Schedule(protocol, seed, tuple(blocks))


def on_ticks(time_s: Float64[np.ndarray, " times"]) -> Float64[np.ndarray, " times"]:
    """Times moved to the grid of `TICK_S`."""
    # A division by a whole number is rounded once; a product with 50e-6 would be off by the error of that number.
    return np.asarray(np.rint(time_s / TICK_S) / round(1 / TICK_S))


def _block(
    protocol: Protocol,
    frequency_hz: Float64[np.ndarray, " trials"],
    electrodes: Int64[np.ndarray, "pulses size"],
    pattern: Int64[np.ndarray, " pulses"],
    first: int,
) -> Block:
    """A block of trials, numbered from `first`."""
    presentation = np.repeat(first + np.arange(len(frequency_hz)), protocol.pulses)
    frequency_hz = np.repeat(frequency_hz, protocol.pulses)
    since_s = 1 / frequency_hz
    since_s[0] = protocol.pause_s
    time_s = on_ticks(np.cumsum(since_s))
    end_s = on_ticks(time_s[-1:] + protocol.tail_s)[0]
    stimuli = Stimuli(time_s, frequency_hz, pattern, electrodes, presentation)
    return Block(protocol.setup_s, float(end_s), stimuli)


def _train(rng: np.random.Generator, protocol: Protocol, last: int) -> Int64[np.ndarray, " pulses"]:
    """The patterns of a presentation's pulses: different ones, as long as there are; the last one is given."""
    before = protocol.pulses - 1
    if protocol.patterns == 1:
        return np.full(protocol.pulses, last)
    others = np.delete(np.arange(protocol.patterns), last)
    drawn: list[int] = []
    while len(drawn) < before:
        drawn.extend(rng.permutation(others)[: before - len(drawn)].tolist())
    return np.array([*drawn, last], dtype=np.int64)
