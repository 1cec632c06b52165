"""The history state of a culture, trial by trial, as a recording's simulator defines it, and ranks adjusted for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float64

from animat.errors import UnusableData
from animat.neurons.history import INITIAL_HISTORY, NO_MEMORY, Memory, Ranked, ranks_among, trace_increment
from animat.neurons.memory import MemorySimulator
from animat.neurons.simulator import NeuronSimulator
from animat.responses.conditions import NO_CONDITION
from animat.responses.responses import Responses


class HistoryState(NamedTuple):
    """The history state after a trial, and its time: trace and load as in `animat.neurons.history.Memory`."""

    trace: float = 0.0
    load: float = 0.0
    at_s: float = -np.inf


@dataclass(frozen=True, eq=False)
class HistoryTracker:
    """Updates the history state by responses of the culture, ranked among a recording's responses.

    Attributes:
        memory: of the recording's simulator; without memory the state does not change.
        added: what a trial adds to the load.
        sorted_hz: non-burst responses of that recording, all channels as one, rising.
        mean_ranks: the mean rank of each condition's responses.
    """

    memory: Memory
    added: float
    sorted_hz: Float64[np.ndarray, " responses"]
    mean_ranks: Float64[np.ndarray, " conditions"]

    @classmethod
    def of(cls, responses: Responses, simulator: NeuronSimulator) -> Self:
        """With the memory of a simulator of these responses."""
        ranked = Ranked(responses)
        memory, added = NO_MEMORY, 0.0
        if isinstance(simulator, MemorySimulator):
            memory, added = simulator.memory, float(simulator.added)
        return cls(memory, added, ranked.sorted_hz, ranked.means)

    @property
    def at_rest(self) -> HistoryState:
        """The state before the first trial."""
        return HistoryState(self.memory.silence)

    def when(self, before: HistoryState, at_s: float, *, is_rested: bool) -> HistoryState:
        """The state at a trial that is read after the pulse at `at_s`.

        `before` is the state after the previous trial, `is_rested` whether the time before this one was silence
        (`animat.responses.extraction.SILENCE_S`).
        """
        load_s = self.memory.load_s
        load = before.load * np.exp((before.at_s - at_s) / load_s) if load_s else before.load
        return HistoryState(self.memory.silence if is_rested else before.trace, float(load), float(at_s))

    def after(self, at_trial: HistoryState, condition: int, rate_hz: float, *, is_burst: bool) -> HistoryState:
        """The state after a trial, from that at it and the response of all channels, Hz per channel."""
        rank = ranks_among(self.sorted_hz, np.array([rate_hz]))
        # For trials without a condition, the middle rank is as good as any.
        mean = 0.5 if condition == NO_CONDITION else float(self.mean_ranks[condition])
        (more,) = trace_increment(rank, mean, self.memory).tolist()
        # After a burst the trace is not known.
        trace = 0.5 if is_burst else self.memory.decay * at_trial.trace + more
        return HistoryState(float(trace), at_trial.load + self.added, at_trial.at_s)

    def observed(self, state: HistoryState) -> tuple[float, float]:
        """Trace and load as a policy sees them (`animat.wrappers.NeuralObservation`)."""
        if self.memory == NO_MEMORY:
            return INITIAL_HISTORY
        return state.trace, state.load if self.memory.load_s else INITIAL_HISTORY[1]

    def to_dict(self) -> dict[str, float]:
        """Its parameters as plain data."""
        return {**self.memory._asdict(), "added": self.added}


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
        self, at_trial: HistoryState, read_hz: Float64[np.ndarray, "*readouts"]
    ) -> Float64[np.ndarray, " readouts"]:
        """y of another response, with the history state at its trial (`HistoryTracker.when`)."""
        return np.asarray(
            _ranks(self.sorted_hz, read_hz[None])[0] - np.array([at_trial.trace, at_trial.load]) @ self.slopes
        )

    def of_responses(self, responses: Responses) -> Float64[np.ndarray, "responses readouts"]:
        """y of other responses; raises UnusableData if the times of their trials are not known."""
        presented, place = responses.presentations
        if (clock_s := presented.clock_s) is None:
            raise UnusableData("responses.presented.time_s: expected the times of all trials, got none")
        state, history = self.remembering.at_rest, []
        trials = (clock_s, presented.is_rested, presented.condition, presented.rate_hz, presented.is_burst)
        for at_s, is_rested, condition, rate_hz, is_burst in zip(*(x.tolist() for x in trials), strict=True):
            at_trial = self.remembering.when(state, at_s, is_rested=is_rested)
            state = self.remembering.after(at_trial, condition, rate_hz, is_burst=is_burst)
            history.append((at_trial.trace, at_trial.load))
        return np.asarray(_ranks(self.sorted_hz, responses.read_hz) - np.array(history)[place] @ self.slopes)


def _ranks(
    sorted_hz: Float64[np.ndarray, "*readouts responses"], read_hz: Float64[np.ndarray, "values *readouts"]
) -> Float64[np.ndarray, "values readouts"]:
    each = zip(np.atleast_2d(sorted_hz), read_hz.reshape(len(read_hz), -1).T, strict=True)
    return np.stack([ranks_among(own, of) for own, of in each], axis=-1)
