"""The rank of a response, adjusted for its history."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float64

from animat.errors import UnusableData
from animat.neurons.history import NO_MEMORY, Ranked, ranks_among
from animat.neurons.history_tracker import HistoryState, HistoryTracker
from animat.neurons.simulator import NeuronSimulator
from animat.responses.responses import Responses


@dataclass(frozen=True, eq=False)
class AdjustedRanks:
    """Responses of a recording by condition, with their ranks less the effect of the history.

        y = r - a p - b l

    r is the rank of the response, the share of the recording's responses below it, ties counted half; p and l are trace
    and load at its trial (`animat.neurons.history.Memory`). The slopes a and b, the same for all conditions, are fitted
    by least squares together with a mean for each condition; each readout has its own.

    Attributes:
        sorted_hz: the recording's non-burst responses, rising, shape (responses,), or (readouts, responses).
        slopes: a and b, shape (2, readouts); 0 for parts of the history that the recording's simulator does not have.
        responses_hz: non-burst responses of each condition, in the order of time, Hz.
        ranks: y of each.
    """

    remembering: HistoryTracker
    sorted_hz: Float64[np.ndarray, "*readouts responses"]
    slopes: Float64[np.ndarray, "2 readouts"]
    responses_hz: tuple[Float64[np.ndarray, "responses *readouts"], ...]
    ranks: tuple[Float64[np.ndarray, "responses readouts"], ...]

    @classmethod
    def of(cls, responses: Responses, simulator: NeuronSimulator) -> Self:
        """From a recording's responses, with the memory of its simulator."""
        remembering, usable = HistoryTracker.of(responses, simulator), ~responses.is_burst
        condition, read_hz = responses.condition[usable], responses.read_hz[usable]
        n_conditions = len(responses.conditions)
        sorted_hz, memory = np.sort(read_hz.T, axis=-1), remembering.memory
        history = Ranked(responses).states(memory)[usable] * [memory != NO_MEMORY, memory.load_s > 0]
        ranks = _ranks(sorted_hz, read_hz)
        design = np.concatenate([np.eye(n_conditions)[condition], history], axis=1)
        slopes = np.linalg.lstsq(design, ranks, rcond=None)[0][n_conditions:]
        adjusted = ranks - history @ slopes
        of_condition = (tuple(x[condition == c] for c in range(n_conditions)) for x in (read_hz, adjusted))
        return cls(remembering, sorted_hz, slopes, *of_condition)

    def of_response(
        self, came: HistoryState, read_hz: Float64[np.ndarray, "*readouts"]
    ) -> Float64[np.ndarray, " readouts"]:
        """y of another response, with the history state at its trial (`HistoryTracker.when`)."""
        return np.asarray(_ranks(self.sorted_hz, read_hz[None])[0] - np.array([came.trace, came.load]) @ self.slopes)

    def of_responses(self, responses: Responses) -> Float64[np.ndarray, "responses readouts"]:
        """y of other responses; raises UnusableData if the times of their trials are not known."""
        presented, place = responses.presentations
        if presented.time_s is None:
            raise UnusableData("responses.presented.time_s: expected the times of all trials, got none")
        state, history = HistoryState(), []
        trials = (presented.time_s, presented.is_rested, presented.condition, presented.rate_hz, presented.is_burst)
        for at_s, is_rested, condition, rate_hz, is_burst in zip(*(x.tolist() for x in trials), strict=True):
            came = self.remembering.when(state, at_s, is_rested=is_rested)
            state = self.remembering.after(came, condition, rate_hz, is_burst=is_burst)
            history.append((came.trace, came.load))
        return np.asarray(_ranks(self.sorted_hz, responses.read_hz) - np.array(history)[place] @ self.slopes)


def _ranks(
    sorted_hz: Float64[np.ndarray, "*readouts responses"], read_hz: Float64[np.ndarray, "values *readouts"]
) -> Float64[np.ndarray, "values readouts"]:
    each = zip(np.atleast_2d(sorted_hz), read_hz.reshape(len(read_hz), -1).T, strict=True)
    return np.stack([ranks_among(own, of) for own, of in each], axis=-1)
