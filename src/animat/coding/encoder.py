"""From an action to a stimulus, delivered as in the recording, and the number of electrodes that it pulses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, UnusableData, expect_at_least, shown
from animat.responses.condition import RESTING, Condition
from animat.stimulation.patterns import Patterns
from animat.stimulation.stimulus import NOTHING
from animat.tables import UNKNOWN

SLOWEST_HZ, FASTEST_HZ = 0.001, 10_000.0
"""Range of a trial's frequency: a pulse, and a whole train, may take at most about a quarter of an hour."""


@checked_arguments
@dataclass(frozen=True)
class Encoder:
    """From an agent's actions to stimuli: each action is a condition, presented as trials of several pulses.

    Attributes:
        conditions: in the order of the actions.
        pulses: per trial.

    Raises:
        InvalidArgument: for no conditions, or trains that take too long.
        UnusableData: for a condition that cannot be delivered, as its frequency or electrodes are not known.
    """

    conditions: tuple[Condition, ...]
    pulses: int = 1

    def __post_init__(self) -> None:
        if not self.conditions:
            raise InvalidArgument("conditions: expected at least one, got none")
        expect_at_least("pulses", self.pulses, 1)
        for condition in self.conditions:
            expected = f"condition {condition.label}: expected recordings that state the"
            if not condition.frequencies_hz:
                remedy = "sort the stimuli by their intervals too: --conditions 'interval:5,10 x electrode'"
                raise UnusableData(f"{expected} frequency of its pulses, which a closed loop needs, got none; {remedy}")
            if not all(SLOWEST_HZ <= each <= FASTEST_HZ for each in condition.frequencies_hz):
                given = ", ".join(f"{f:g}" for f in condition.frequencies_hz)
                needed = f"a frequency from {SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz for a closed loop"
                raise UnusableData(f"condition {condition.label}: expected {needed}, got {given}")
            if condition.electrodes == ():
                remedy = "train on conditions by frequency or interval"
                raise UnusableData(f"{expected} electrodes of its pulses, as a closed loop needs, got none; {remedy}")
        slowest_hz = min(min(condition.frequencies_hz) for condition in self.conditions)
        if self.pulses > slowest_hz / SLOWEST_HZ:
            most = int(slowest_hz / SLOWEST_HZ)
            take = f"which take {self.pulses / slowest_hz:,.10g} s at {slowest_hz:g} Hz: use at most {most:,}"
            expected = f"expected trials of {1 / SLOWEST_HZ:g} s at most"
            raise InvalidArgument(f"pulses: {expected}, got {shown(self.pulses)} pulses per trial, {take}")

    @property
    def electrodes(self) -> tuple[int, ...]:
        """All electrodes that its conditions name, rising."""
        sets = (one for condition in self.conditions for one in condition.electrodes or ())
        return tuple(sorted({electrode for one in sets for electrode in one} - {NOTHING}))

    @property
    def takes_patterns(self) -> bool:
        """Whether any pulse is on one of the culture's patterns, whichever they are."""
        return any(each.electrodes is None or (each.only_last and self.pulses > 1) for each in self.conditions)


class Target(NamedTuple):
    """The electrodes of one pulse, and the culture's pattern that they form; -1: none; -2: nothing is delivered."""

    electrodes: tuple[int, ...]
    pattern: int


class Dealer:
    """Deals out the stimuli of successive trials, as the schedule of a recording does.

    What a condition leaves open is drawn: patterns (of the culture, padded with -1) from a deck that is reshuffled when
    empty, so that all are used equally often, and frequencies at random.
    """

    def __init__(self, encoder: Encoder, patterns: Patterns, rng: np.random.Generator) -> None:
        self._encoder, self._rng = encoder, rng
        # In the order of a condition's electrodes, so that the same pattern is the same target.
        rows = (tuple(sorted(e for e in row if e != UNKNOWN)) for row in patterns.tolist())
        targets = [Target(row, number) for number, row in enumerate(rows)]
        number_of = {frozenset(target.electrodes): target.pattern for target in targets}
        self._any = _Deck(targets, rng)
        self._decks = [
            self._any
            if each.electrodes is None
            else _Deck([Target((), NOTHING)], rng)
            if each.electrodes == RESTING
            else _Deck([Target(one, number_of.get(frozenset(one), UNKNOWN)) for one in each.electrodes], rng)
            for each in encoder.conditions
        ]

    def frequency_hz(self, condition: int) -> float:
        """The frequency of the next trial of a condition."""
        known = self._encoder.conditions[condition].frequencies_hz
        return known[0] if len(known) == 1 else float(known[self._rng.integers(len(known))])

    def targets(self, condition: int) -> list[Target]:
        """The targets of the pulses of a condition's next trial, all different if there are enough."""
        pulses, deck = self._encoder.pulses, self._decks[condition]
        if not self._encoder.conditions[condition].only_last:
            return deck.hand(pulses)
        last = deck.hand(1)
        return [*self._any.hand(pulses - 1, but=last), *last]


class _Deck:
    def __init__(self, targets: Sequence[Target], rng: np.random.Generator) -> None:
        self._targets, self._rng = targets, rng
        self._left: list[Target] = []

    def hand(self, n: int, but: Iterable[Target] = ()) -> list[Target]:
        """Draw n targets, different from each other and from those in `but` as far as the deck allows."""
        hand: list[Target] = []
        avoided = list(but)
        while len(hand) < n:
            is_used_up = _fresh(self._left, avoided) is None and _fresh(self._targets, avoided) is not None
            if is_used_up or not self._left:
                # Each of those left only once: they would pile up while one condition is repeated.
                drawn = [self._targets[i] for i in self._rng.permutation(len(self._targets))]
                self._left = [*dict.fromkeys(self._left), *drawn]
            hand.append(self._left.pop(_fresh(self._left, avoided) or 0))
            avoided.append(hand[-1])
        return hand


def _fresh(targets: Sequence[Target], avoided: Sequence[Target]) -> int | None:
    """The first of the targets that is not to be avoided; None if there is none."""
    return next((i for i, each in enumerate(targets) if each not in avoided), None)


def electrode_pulses(conditions: Sequence[Condition], pulses: int) -> tuple[float, ...] | None:
    """The electrode pulses of a trial of each condition; None if the electrodes of all pulses are not known for some.

    For a condition on one of several sets it is their mean, as they are used equally often.
    """
    counts = []
    for each in conditions:
        if not each.electrodes or (each.only_last and pulses > 1):
            return None
        sets = [] if each.electrodes == RESTING else each.electrodes
        counts.append(pulses * sum(map(len, sets)) / len(each.electrodes))
    return tuple(counts)


def expect_electrode_pulses(conditions: Sequence[Condition], pulses: int) -> tuple[float, ...]:
    """`electrode_pulses` where they have a cost; raises UnusableData if they are not known."""
    counts = electrode_pulses(conditions, pulses)
    if counts is None:
        labels = ", ".join(condition.label for condition in conditions)
        expected = "conditions that state the electrodes of all their pulses"
        remedy = "record places of several sizes, or leave the cost out"
        raise UnusableData(f"pulse_cost: expected {expected}, got {labels}; {remedy}")
    return counts
