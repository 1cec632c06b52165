"""A row of the table of policies and controls on a simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.evaluation.rollouts import Episodes
from animat.evaluation.statistics import standard_error


@dataclass(frozen=True, eq=False)
class Row:
    """A row of the table: `policies` or a control, with its returns.

    Attributes:
        changed: whether its environment differs from that of the policies: another culture, or another delivery.
        electrode_pulses: mean number per episode, for each actor; None if the conditions' electrodes are not known.
        pulse_cost: of one electrode pulse, in the units of the return.
    """

    name: str
    meaning: str
    episodes: Episodes
    changed: bool = False
    electrode_pulses: Float64[np.ndarray, " actors"] | None = None
    pulse_cost: float = 0.0

    @property
    def mean_returns(self) -> Float64[np.ndarray, " actors"]:
        """Each actor's mean return over its episodes, which the paper calls a policy's performance."""
        return self.episodes.returns.mean(axis=1)  # type: ignore[no-any-return]

    def to_dict(self) -> dict[str, Any]:
        """The row as plain data; the net return is the mean return less the cost of pulses, if these are known."""
        means = self.mean_returns
        pulses = None if self.electrode_pulses is None else float(self.electrode_pulses.mean())
        # The samples are the actors; a control has one actor, whose episodes are the samples.
        samples = means if len(means) > 1 else self.episodes.returns[0]
        return {
            "name": self.name,
            "meaning": self.meaning,
            "actors": len(means),
            "episodes": self.episodes.returns.shape[1],
            "mean_return": float(means.mean()),
            "standard_error": standard_error(samples) if len(samples) > 1 else None,
            "mean_length": float(self.episodes.lengths.mean()),
            "terminated_share": float(self.episodes.terminated.mean()),
            "mean_returns": means.tolist(),
            "electrode_pulses": pulses,
            "net_return": None if pulses is None else float(means.mean()) - self.pulse_cost * pulses,
            **self.met,
        }

    @property
    def met(self) -> dict[str, Any]:
        """How the goal was met (`animat.goals.tally.Outcome.means`); empty for a robot without one."""
        return {} if self.episodes.outcome is None else self.episodes.outcome.means()
