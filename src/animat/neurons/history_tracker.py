"""The history state of a culture in a closed loop, trial by trial, as defined by the simulator of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float64

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

    def when(self, before: HistoryState, at_s: float, *, is_rested: bool) -> HistoryState:
        """The state at a trial that is read after the pulse at `at_s`.

        `before` is the state after the previous trial, `is_rested` whether no pulse came in the second before this one.
        """
        load_s = self.memory.load_s
        load = before.load * np.exp((before.at_s - at_s) / load_s) if load_s else before.load
        return HistoryState(0.0 if is_rested else before.trace, float(load), float(at_s))

    def after(self, came: HistoryState, condition: int, rate_hz: float, *, is_burst: bool) -> HistoryState:
        """The state after a trial, from that at it and the response of all channels, Hz per channel.

        After a burst the trace is not known.
        """
        rank = ranks_among(self.sorted_hz, np.array([rate_hz]))
        # For trials without a condition, the middle rank is as good as any.
        mean = 0.5 if condition == NO_CONDITION else float(self.mean_ranks[condition])
        (more,) = trace_increment(rank, mean, self.memory).tolist()
        trace = 0.5 if is_burst else self.memory.decay * came.trace + more
        return HistoryState(float(trace), came.load + self.added, came.at_s)

    def observed(self, state: HistoryState) -> tuple[float, float]:
        """Trace and load as a policy sees them (`animat.wrappers.NeuralObservation`)."""
        if self.memory == NO_MEMORY:
            return INITIAL_HISTORY
        return state.trace, state.load if self.memory.load_s else INITIAL_HISTORY[1]

    def to_dict(self) -> dict[str, float]:
        """Its parameters as plain data."""
        return {**self.memory._asdict(), "added": self.added}
