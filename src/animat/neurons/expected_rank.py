"""The rank that a response is expected to have, and how far a culture is above or below it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float64

from animat.neurons.history import AT_FIRST, NO_MEMORY, ranks_among
from animat.neurons.remembering import Remembered, Remembering
from animat.neurons.simulator import NeuronSimulator
from animat.responses.responses import Responses


@dataclass(frozen=True, eq=False)
class ExpectedRank:
    """The mean rank that responses of a recording have after such a history.

        e = m_c + a p + b l

    The rank is the share of the recording's responses that are below, ties half; m_c is of the condition, p and l are
    trace and load when the trial comes (`animat.neurons.history.Memory`). It is found by least squares. Of several
    readouts each has its own.

    Attributes:
        remembering: what trace and load are.
        sorted_hz: the recording's non-burst responses, rising, shape (responses,), or (readouts, responses).
        levels: m, shape (conditions, readouts).
        slopes: a and b, shape (2, readouts); 0 of what the recording's simulator does not remember.
    """

    remembering: Remembering
    sorted_hz: Float64[np.ndarray, "*readouts responses"]
    levels: Float64[np.ndarray, "conditions readouts"]
    slopes: Float64[np.ndarray, "2 readouts"]

    @classmethod
    def of(cls, responses: Responses, simulator: NeuronSimulator) -> Self:
        """Of a recording, with the memory of its simulator."""
        remembering, n_conditions = Remembering.of(responses, simulator), len(responses.conditions)
        usable = ~responses.is_burst
        sorted_hz = np.sort(responses.read_hz[usable].T, axis=-1)
        memory = remembering.memory
        history = _states(remembering, responses)[usable] * [memory != NO_MEMORY, memory.load_s > 0]
        given = np.concatenate([np.eye(n_conditions)[responses.condition[usable]], history], axis=1)
        found = np.linalg.lstsq(given, _ranks(sorted_hz, responses.read_hz[usable]), rcond=None)[0]
        return cls(remembering, sorted_hz, found[:n_conditions], found[n_conditions:])

    def rank(self, read_hz: Float64[np.ndarray, "*readouts"]) -> Float64[np.ndarray, " readouts"]:
        """The rank of a response, of each readout."""
        return np.asarray(_ranks(self.sorted_hz, read_hz[None])[0])

    def at(self, came: Remembered, condition: int) -> Float64[np.ndarray, " readouts"]:
        """What is expected of a response.

        Args:
            came: the history state when the trial came (`Remembering.when`).
            condition: of the trial.
        """
        return np.asarray(self.levels[condition] + np.array([came.trace, came.load]) @ self.slopes)

    def along(self, responses: Responses) -> Float64[np.ndarray, "responses readouts"]:
        """How far above the expected rank each response of any recording of the same conditions is, burst or not."""
        expected = self.levels[responses.condition] + _states(self.remembering, responses) @ self.slopes
        return np.asarray(_ranks(self.sorted_hz, responses.read_hz) - expected)


def _ranks(
    sorted_hz: Float64[np.ndarray, "*readouts responses"], read_hz: Float64[np.ndarray, "values *readouts"]
) -> Float64[np.ndarray, "values readouts"]:
    each = zip(np.atleast_2d(sorted_hz), read_hz.reshape(len(read_hz), -1).T, strict=True)
    return np.stack([ranks_among(own, of) for own, of in each], axis=-1)


def _states(remembering: Remembering, responses: Responses) -> Float64[np.ndarray, "responses 2"]:
    """Trace and load when the trial of each response comes."""
    presented, place = responses.presentations
    n = len(presented.condition)
    times_s = np.zeros(n) if presented.time_s is None else presented.time_s
    state, states = Remembered(), np.empty((n, 2))
    trials = zip(presented.condition, presented.rate_hz, presented.is_burst, presented.is_rested, times_s, strict=True)
    for trial, (condition, rate_hz, is_burst, is_rested, at_s) in enumerate(trials):
        came = remembering.when(state, at_s, is_rested=is_rested)
        states[trial] = came.trace, came.load
        state = remembering.after(came, condition, remembering.rank(rate_hz), is_burst=is_burst)
    if presented.time_s is None:
        states[:, 1] = AT_FIRST[1]
    return np.asarray(states[place])
