"""A row of the table of predicted and measured returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import ndtri, stdtrit

from animat.evaluation.statistics import CONFIDENCE, EpisodeComparison, Interval
from animat.records import as_json

Returns = Float64[np.ndarray, " episodes"]
Turns = Int64[np.ndarray, " episodes"]
"""The return of each episode, and which of its agent's episodes it is."""
_RESAMPLES = 10_000


@dataclass(frozen=True, eq=False)
class Row:
    """A row of the table.

    Attributes:
        predicted, bootstrap_means: as in an `AgentPrediction`, together from all starts; where starts differ, from
            those of the measured episodes, one after the other.
        measured: returns of complete episodes on the culture.
        pulses_per_action: given to the culture, without the warm-up; the same holds for the measurements below.
        electrode_pulses: mean number per complete episode, one for each electrode of each pulse; NaN without episodes.
        predicted_electrode_pulses: per episode on the simulator; None if the conditions' electrodes are not known.
        pulse_cost: of an electrode pulse, in the units of the return.
        bursts, late: shares of responses that were bursts, and of trials that came late.
        comparison: of the policies' measured returns with these; None for the policies, and if either has none.
        met: how the goal was met on the culture (`animat.goals.tally.Outcome.means`); empty for a robot without a goal,
            and without complete episodes.
        within: lowest and highest possible return of an episode.
        turn: which of its agent's episodes each measured one is, where starts are drawn: in the same turn all agents
            have the same start; None where all episodes start alike.
        expected: mean predicted return from the start of each measured episode; None where all start alike.
        from_all_starts: mean predicted return from the starts of all rounds, of which some may not be measured; NaN:
            not known.
    """

    name: str
    meaning: str
    predicted: Float64[np.ndarray, " predicted"]
    bootstrap_means: Float64[np.ndarray, " bootstraps"]
    measured: Float64[np.ndarray, " measured"]
    pulses_per_action: float
    electrode_pulses: float
    predicted_electrode_pulses: float | None
    pulse_cost: float
    bursts: float
    late: float
    comparison: EpisodeComparison | None = None
    met: dict[str, Any] = field(default_factory=dict)
    within: tuple[float, float] = (-np.inf, np.inf)
    turn: Int64[np.ndarray, " measured"] | None = None
    expected: Float64[np.ndarray, " measured"] | None = None
    from_all_starts: float = np.nan

    @property
    def prediction(self) -> Interval:
        """Mean predicted return, with its interval over bootstrap samples of the recording's responses."""
        return bootstrap_interval(self.predicted.mean(), self.bootstrap_means)

    @property
    def from_mean_start(self) -> Returns:
        """Measured returns, less how much more is predicted from an episode's start than from those of all rounds."""
        return self.measured if self.expected is None else self.measured - self.expected + self.from_all_starts

    @property
    def gap(self) -> Interval:
        """Mean measured less mean predicted return; its interval is over bootstrap recordings and measured episodes.

        Where starts differ, an episode counts by how much more or less it returns than predicted from its start, and
        episodes of the same turn are drawn together. If measured episodes vary less than predicted ones, as when all
        reach the limit, the interval is over as many predicted episodes instead: rare failures may have been missed.
        It ends where an episode's return does. The ends are infinite with fewer than two measured episodes, or turns.
        Responses are drawn as if they were independent: drift between recording and loop is not in the interval, and
        shows as a gap.
        """
        mean, expected = self.measured.mean(), self.predicted.mean()
        returns, chance = self.measured, self.predicted
        if self.expected is not None:
            returns, chance = returns - self.expected + expected, chance.reshape(len(returns), -1)
            # Few episodes differ too little from their own mean: widen their spread to that of a sample (Bessel).
            wider = np.sqrt(chance.shape[1] / max(chance.shape[1] - 1, 1))
            chance = ((chance - self.expected[:, None]) * wider).ravel() + expected
        drawn = resampled_means(returns, rng := np.random.default_rng(0), self.turn)
        if drawn is None:
            return Interval(float(mean - expected), -np.inf, np.inf, CONFIDENCE)
        fewest = len(self.measured if self.turn is None else np.unique(self.turn))
        # Episodes of a turn count once if they go alike, or if all go alike, and each by itself if they do not.
        independent = int(np.clip(returns.var() / max(drawn.var(), 1e-12), fewest, len(self.measured)))
        missed = expected - rng.choice(chance, (len(drawn), independent)).mean(axis=1)
        # A user's robot may exceed the range of returns that it states.
        limits = min(self.within[0], self.measured.min()), max(self.within[1], self.measured.max())
        measured = np.clip(mean + missed if missed.std() > drawn.std() else drawn, *limits)
        return bootstrap_interval(mean - expected, measured - rng.choice(self.bootstrap_means, len(drawn)))

    @property
    def net(self) -> float | None:
        """Mean measured return less the cost of pulses; None without complete episodes."""
        return float(self.measured.mean() - self.pulse_cost * self.electrode_pulses) if len(self.measured) else None

    @property
    def predicted_net(self) -> float | None:
        """Mean predicted return less the cost of pulses; None if these are not known."""
        pulses = self.predicted_electrode_pulses
        return None if pulses is None else float(self.predicted.mean() - self.pulse_cost * pulses)

    @property
    def gap_sign(self) -> Literal[-1, 0, 1]:
        """-1 if less was measured than predicted, 1 if more, 0 if this cannot be determined."""
        if not len(self.measured):
            return 0
        # Sums in float32 and float64 differ in the last digits.
        gap, rounding = self.gap, 1e-6 * (1 + float(np.abs(self.measured).max()))
        return -1 if gap.high < -rounding else 1 if gap.low > rounding else 0

    def to_dict(self) -> dict[str, Any]:
        measured = bool(len(self.measured))
        return {
            "name": self.name,
            "meaning": self.meaning,
            "predicted": float(self.predicted.mean()),
            "prediction": as_json(self.prediction.to_dict()),
            "measured": float(self.measured.mean()) if measured else None,
            "gap": as_json(self.gap.to_dict()) if measured else None,
            "episodes": len(self.measured),
            "measured_returns": self.measured.tolist(),
            "pulses_per_action": self.pulses_per_action,
            "electrode_pulses": self.electrode_pulses if measured else None,
            "predicted_electrode_pulses": self.predicted_electrode_pulses,
            "net": self.net,
            "predicted_net": self.predicted_net,
            "bursts": self.bursts,
            "late": self.late,
            "p": None if self.comparison is None else self.comparison.p_best,
            "wins": None if self.comparison is None else self.comparison.wins,
            **self.met,
        }


def bootstrap_interval(value: float, drawn: Float64[np.ndarray, " draws"]) -> Interval:
    """A value with the interval that contains 95 % of bootstrap draws."""
    # With a hundred draws the usual interpolation would contain 93 %.
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="weibull")
    return Interval(float(value), float(low), float(high), CONFIDENCE)


def resampled_means(
    returns: Returns, rng: np.random.Generator, turn: Turns | None = None
) -> Float64[np.ndarray, " resamples"] | None:
    """Means of bootstrap samples of returns, spread as far as Student's t is beyond the normal distribution.

    From a few episodes, the usual percentile interval contains the true mean too rarely: from two half of the time.
    Episodes of different agents with the same start are as easy, or as hard: all of them are drawn, or none. There are
    no means for fewer than two episodes, or turns (as in a `Row`).

    Source: the expanded percentile interval of Hesterberg 2015, doi:10.1080/00031305.2015.1089789.
    """
    of = np.unique(np.arange(len(returns)) if turn is None else turn, return_inverse=True)[1]
    total, count = np.bincount(of, returns), np.bincount(of)
    n, level = len(count), (1 + CONFIDENCE) / 2
    if n < 2:
        return None
    often = rng.multinomial(n, np.full(n, 1 / n), _RESAMPLES)
    spread = np.sqrt(n / (n - 1)) * stdtrit(n - 1, level) / ndtri(level)
    mean = returns.mean()
    return np.asarray(mean + spread * (often @ total / (often @ count) - mean))
