"""Draws a protocol's schedule from a seed: which pattern is pulsed when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidArgument, expect_at_least
from animat.stimulation.patterns import Patterns
from animat.stimulation.protocol import Protocol
from animat.stimulation.stimulus import NOTHING, Stimuli, Stimulus
from animat.tables import UNKNOWN, padded

TICK_S = 50e-6
"""Stimuli start on a grid of 50 us, one sample at 20 kHz, which stimulation hardware can time exactly."""
RESPONSE_S = 0.01
"""After a pulse, the end of the default window."""
SHORTEST_GAP_S = 0.005
"""Shortest gap between two pulses in which a block may be cut."""


@dataclass(frozen=True, eq=False)
class Block:
    """Continuous stimulation without a break: set-up, which is not recorded, then `duration_s`, which is.

    Times of its stimuli are from the recorded start, and trials are numbered through all blocks.
    """

    setup_s: float
    duration_s: float
    stimuli: Stimuli

    def stretches(self, least_s: float, gap_s: float = SHORTEST_GAP_S) -> tuple[Block, ...]:
        """The block cut into consecutive stretches without set-up, of `least_s` or more but the last.

        It is cut between trials, in the middle of gaps between pulses of `gap_s` or more, or later in short ones, where
        the response is over.
        """
        time_s, presentation = self.stimuli.time_s, self.stimuli.presentation
        # The grid of times is coarser than rounding errors.
        begins = 1 + np.flatnonzero((np.diff(presentation) != 0) & (np.diff(time_s) >= gap_s - TICK_S / 2))
        cuts = [(0, 0.0)]
        middle_s, responded_s = (time_s[begins - 1] + time_s[begins]) / 2, time_s[begins - 1] + RESPONSE_S
        ends_s = np.where(responded_s < time_s[begins] - 1e-3, np.maximum(middle_s, responded_s), middle_s)
        for row, end_s in zip(begins.tolist(), on_ticks(ends_s), strict=True):
            if end_s - cuts[-1][1] >= least_s:
                cuts.append((row, float(end_s)))
        blocks = []
        for (first, start_s), (last, end_s) in pairwise([*cuts, (len(time_s), self.duration_s)]):
            columns = {name: column[first:last] for name, column in vars(self.stimuli).items()}
            stimuli = Stimuli(**columns | {"time_s": on_ticks(columns["time_s"] - start_s)})
            blocks.append(Block(0.0, end_s - start_s, stimuli))
        return tuple(blocks)


@dataclass(frozen=True, eq=False)
class Schedule:
    """All stimuli of one recording, block by block: the protocol, and the seed of every draw."""

    protocol: Protocol
    seed: int
    blocks: tuple[Block, ...]

    @property
    def duration_s(self) -> float:
        """Total duration, including set-up."""
        return sum(block.setup_s + block.duration_s for block in self.blocks)

    @property
    def recorded_s(self) -> float:
        """Recorded part of the duration."""
        return sum(block.duration_s for block in self.blocks)

    def __len__(self) -> int:
        return sum(len(block.stimuli) for block in self.blocks)

    def deliveries(self, block: Block) -> list[Stimulus]:
        """The stimuli of a block for delivery."""
        table = block.stimuli
        columns = table.time_s, table.electrodes, table.frequency_hz, table.pattern, table.presentation
        return [
            Stimulus(time_s, tuple(e for e in on if e != UNKNOWN), self.protocol.pulse, frequency_hz, pattern, number)
            for time_s, on, frequency_hz, pattern, number in zip(*(column.tolist() for column in columns), strict=True)
        ]


def make_schedule(
    protocol: Protocol, patterns: Patterns, seed: int, *, places: Sequence[tuple[int, ...]] = ()
) -> Schedule:
    """Draw the order of conditions and patterns of one recording, from a seed of zero or more.

    Args:
        patterns: the electrodes of each of the culture's patterns, at least as many as the protocol uses; padded
            with -1.
        places: the electrodes of each of the protocol's places, if it has any; empty for `"none"`.
    """
    if len(places) != protocol.n_places:
        raise InvalidArgument(f"places: expected electrodes of {protocol.n_places}, got those of {len(places)}")
    if not places and protocol.patterns > len(patterns):
        expected = f"at most the {len(patterns)} that the culture's electrode selection has"
        raise InvalidArgument(f"patterns: expected {expected}, got {protocol.patterns}: select more, or use fewer")
    expect_at_least("seed", seed, 0)
    rng = np.random.default_rng([seed, 7])
    n_frequencies, trials = len(protocol.frequencies_hz), protocol.trials
    n_conditions = n_frequencies * max(1, len(places))
    if protocol.order == "blocked":
        orders = [np.full(trials, condition) for condition in rng.permutation(n_conditions)]
    else:
        orders = [rng.permutation(np.repeat(np.arange(n_conditions), trials))]
    if places:
        # A place that is one of the culture's patterns has its number.
        number_of = {frozenset(row) - {UNKNOWN}: i for i, row in enumerate(patterns.tolist())}
        number = np.array([number_of.get(frozenset(place), UNKNOWN) if place else NOTHING for place in places])
        electrodes = padded(places)
    else:
        number, electrodes = np.arange(len(patterns)), patterns
        # Each pattern equally often, round by round, each round in random order.
        rounds = range(-(-trials // protocol.patterns))
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
        frequency_hz = np.repeat(np.array(protocol.frequencies_hz)[frequency], protocol.pulses)
        since_s = 1 / frequency_hz
        since_s[0] = protocol.pause_s
        time_s = on_ticks(np.cumsum(since_s))
        end_s = float(on_ticks(time_s[-1:] + protocol.tail_s)[0])
        trial = np.repeat(i * len(order) + np.arange(len(order)), protocol.pulses)
        stimuli = Stimuli(time_s, frequency_hz, number[row], electrodes[row], trial)
        blocks.append(Block(protocol.setup_s, end_s, stimuli))
    return Schedule(protocol, seed, tuple(blocks))


def on_ticks(time_s: Float64[np.ndarray, " times"]) -> Float64[np.ndarray, " times"]:
    """Times rounded to the grid of `TICK_S`."""
    # Division by a whole number is rounded once; multiplying by 50e-6 would add the rounding error of that number.
    return np.asarray(np.rint(time_s / TICK_S) / round(1 / TICK_S))


def _train(rng: np.random.Generator, protocol: Protocol, last: int) -> Int64[np.ndarray, " pulses"]:
    """The patterns of a trial's pulses, different ones as far as possible, ending with `last`."""
    if protocol.patterns == 1:
        return np.full(protocol.pulses, last)
    others = np.delete(np.arange(protocol.patterns), last)
    drawn: list[int] = []
    while len(drawn) < protocol.pulses - 1:
        drawn.extend(rng.permutation(others).tolist())
    return np.array([*drawn[: protocol.pulses - 1], last], dtype=np.int64)
