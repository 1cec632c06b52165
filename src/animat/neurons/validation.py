"""Whether simulators made from the first half of a recording predict its second half."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float32, Float64

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, expect_at_least
from animat.neurons.history import NO_MEMORY
from animat.neurons.memory import MemorySimulator
from animat.neurons.prediction import CLASSES, Halves, free_runs, halved, in_time, predict, recorded_series, share_below
from animat.neurons.timeline import SimulatorKind, check_kind, default_kind, fit_simulator
from animat.responses.responses import Responses
from animat.tables import briefly

MARGINAL = "marginal"
"""The name of the baseline: the responses to all conditions in one distribution."""
SMALL_DISTANCE, LARGE_DISTANCE = 0.1, 0.2
"""Of the transforms from uniform: with a threshold, a mean command is off by at most twice as much. On virtual cultures
1 to 5, whose measured returns lie in the intervals of their predictions, the largest is 0.07."""
LARGE_DIFFERENCE = 0.15
"""Between the recorded correlation of successive responses and the simulator's: on these cultures at most 0.05 with
memory, and 0.31 to 0.44 without."""
CERTAIN = 2.0
"""Standard errors by which one prediction must be better than another."""
FREE_RUNS = 200
PIT_BINS = 10
_STRETCHES = 20
_CHANCES = 500


class Band(NamedTuple):
    """The middle 95 % of a simulator's free runs, and their mean."""

    low: Any
    mean: Any
    high: Any


class Gain(NamedTuple):
    """How much better one kind predicts than another, per trial, with the standard error."""

    value: float
    error: float

    @property
    def is_certain(self) -> bool:
        """Whether it is better, beyond `CERTAIN` standard errors."""
        return self.value > CERTAIN * self.error


@dataclass(frozen=True, eq=False)
class Scores:
    """The scores of one kind of simulator on the held-out half.

    Attributes:
        kind: its name; `MARGINAL` for the baseline.
        bits: log-likelihood of each held-out command with nine thresholds.
        crps_hz: continuous ranked probability score of each.
        transforms: the probability integral transform of each, from F(x-) to F(x).
        distance: Kolmogorov's distance of the transforms from uniform.
        p_value: of such a distance by chance; None for kinds that do not draw evenly from a condition's responses.
        autocorrelation: of the free runs, at lags 1 to `LAGS`.
        run_length: the mean length, in the free runs, of runs at or above P50 of the first half.
        lasting: the share of these that last 1 to `LAGS` trials or more.
        above: P(x >= P50) predicted for the held-out trials of each condition.
    """

    __repr__ = briefly

    kind: str
    bits: Float64[np.ndarray, " held"]
    crps_hz: Float64[np.ndarray, " held"]
    transforms: Float64[np.ndarray, "held 2"]
    distance: float
    p_value: float | None
    autocorrelation: Band
    run_length: Band
    lasting: Band
    above: Float64[np.ndarray, " conditions"]

    def to_dict(self) -> dict[str, Any]:
        """All numbers as JSON data, except those of single trials."""
        return {
            "bits": float(self.bits.mean()),
            "crps_hz": float(self.crps_hz.mean()),
            "distance": self.distance,
            "p_value": self.p_value,
            "pit": pit_shares(self.transforms).tolist(),
            **{name: _plain(getattr(self, name)) for name in ("above", "autocorrelation", "run_length", "lasting")},
        }


@dataclass(frozen=True, eq=False)
class Validation:
    """All kinds of simulators on one recording: fitted to its first half, scored on its second.

    Attributes:
        labels: of the conditions.
        n_fitted, n_held: non-burst responses to each condition in the first and the second half.
        medians_hz: medians of the responses to each condition in the first and in the second half.
        above: P(x >= P50) of the held-out responses to each, P50 that of the first half.
        autocorrelation, run_length, lasting: of the held-out responses, as in `Scores`; runs at or above their own P50.
        scores: of the marginal distribution and of each kind.
        kind: the kind that the verdict is about.
        is_blocked: whether conditions were presented in blocks.
        pit_band: the middle 95 % of the share of transforms in one of `PIT_BINS` bins, by chance alone.
    """

    __repr__ = briefly

    labels: tuple[str, ...]
    n_fitted: tuple[int, ...]
    n_held: tuple[int, ...]
    medians_hz: Float64[np.ndarray, "2 conditions"]
    above: Float64[np.ndarray, " conditions"]
    autocorrelation: Float64[np.ndarray, " lags"]
    run_length: float
    lasting: Float64[np.ndarray, " lags"]
    scores: tuple[Scores, ...]
    kind: str
    is_blocked: bool
    pit_band: tuple[float, float]

    def of(self, kind: str) -> Scores:
        """The scores of a kind."""
        return next(scores for scores in self.scores if scores.kind == kind)

    def gain(self, kind: str, over: str, score: Literal["bits", "crps_hz"] = "bits") -> Gain:
        """How much better a kind is than another, in bits or Hz.

        The standard error is from the means of `_STRETCHES` stretches in time, as neighbours may be correlated.
        """
        sign = 1 if score == "bits" else -1
        each = sign * (getattr(self.of(kind), score) - getattr(self.of(over), score))
        means = np.array([part.mean() for part in np.array_split(each, min(_STRETCHES, len(each)))])
        return Gain(float(each.mean()), float(means.std(ddof=1) / np.sqrt(len(means))))

    def to_dict(self) -> dict[str, Any]:
        """All numbers as JSON data, except those of single trials."""
        numbers = "n_fitted", "n_held", "medians_hz", "drift", "above", "autocorrelation", "run_length", "lasting"
        return {
            "verdict": self.verdict,
            "simulator": self.kind,
            "conditions": list(self.labels),
            **{name: _plain(getattr(self, name)) for name in numbers},
            "conditions_bring_bits": self.gain("empirical", MARGINAL)._asdict(),
            "memory_brings_bits": self.gain("memory", "empirical")._asdict(),
            "simulators": {scores.kind: scores.to_dict() for scores in self.scores},
        }

    @property
    def drift(self) -> float:
        """The relative change of the median from the first half to the second, conditions weighted by their trials.

        NaN if a median is 0.
        """
        if not np.all(self.medians_hz > 0):
            return float("nan")
        first, second = self.medians_hz
        return float(np.exp(np.average(np.log(second / first), weights=self.n_held)) - 1)

    @property
    def verdict(self) -> str:
        """Whether a policy trained on the simulator can be trusted, in a sentence with the reason."""
        scores = self.of(self.kind)
        conditions = self.gain("empirical", MARGINAL)
        distance, lag = scores.distance, self.autocorrelation[0] - scores.autocorrelation.mean[0]
        gains = {s.kind: self.gain(s.kind, self.kind, "crps_hz") for s in self.scores[1:]}
        better = max((kind for kind, gain in gains.items() if gain.is_certain), key=gains.__getitem__, default=None)
        off = f"the held-out distribution is off by up to {distance:.3f}"
        drifted = f", as responses {'fell' if self.drift < 0 else 'rose'} by {100 * abs(self.drift):.0f} % meanwhile"
        off += drifted if abs(self.drift) > SMALL_DISTANCE / 2 else ""
        if self.is_blocked:
            return "Cannot be trusted: conditions were presented in blocks, unlike in a loop; record with --order mixed"
        # If nearly all responses are in one class, what is added for empty classes looks like information.
        for gain, unit in ((conditions, "bits"), (self.gain("empirical", MARGINAL, "crps_hz"), "Hz of CRPS")):
            if not gain.is_certain:
                worth = f"{gain.value:.3f} +- {gain.error:.3f} {unit} per trial"
                return f"Cannot be trusted: knowing the condition is worth {worth}, which is not clearly above 0"
        if distance > LARGE_DISTANCE:
            return f"Cannot be trusted: {off} (at most {LARGE_DISTANCE:g} with care)"
        if distance > SMALL_DISTANCE:
            return f"With care: {off} (at most {SMALL_DISTANCE:g} to be trusted)"
        if np.isnan(lag):
            return "With care: successive responses cannot be compared, as no two neighbours are both non-burst"
        if abs(lag) > LARGE_DIFFERENCE:
            both = f"{self.autocorrelation[0]:.2f}, the simulator's by {scores.autocorrelation.mean[0]:.2f}"
            apart = f"at most {LARGE_DIFFERENCE:g} apart to be trusted"
            return f"With care: successive responses correlate by {both} ({apart})"
        if better:
            return f"With care: the {better} simulator predicts better; train with --simulator {better}"
        return (
            f"Can be trusted: the held-out distribution is off by {distance:.3f} at most, and the condition is worth "
            f"{conditions.value:.3f} +- {conditions.error:.3f} bits per trial"
        )


@checked_arguments
def validate(responses: Responses, *, kind: str | None = None, seed: int = 1, readout: int | None = None) -> Validation:
    """Fit all kinds of simulators to the first half of a recording's responses, and score them on the second.

    Args:
        kind: that the verdict is about; None: the one that training would use.
        seed: of the free runs and the chance levels.
        readout: which of several readouts is scored; simulators answer for all of them.

    Raises:
        UnusableData: as `halved` does.
        InvalidArgument: for a kind or a readout that does not exist, or a seed below 0.
    """
    n = len(responses.readouts)
    if (readout is None) != (n == 1) or not 0 <= (readout or 0) < n:
        raise InvalidArgument(f"readout: expected one of {n} readouts, or None if there is only one, got {readout}")
    expect_at_least("seed", seed, 0)
    rng, halves = np.random.default_rng(seed), halved(responses, readout)
    median_hz = halves.percentiles_hz[5]
    kinds: tuple[str, ...] = get_args(SimulatorKind)
    if kind is not None:
        check_kind(kind)
    simulators = {each: fit_simulator(halves.first, kind=each) for each in kinds}
    distances, band = _chance_levels(halves, rng)
    probabilities: dict[str, Float64[np.ndarray, "held classes"]] = {}
    scores = []
    for each in (MARGINAL, *kinds):
        simulator = simulators.get(each)
        prediction = predict(simulator, halves)
        # The prior of a memory simulator is the empirical one, which it refines; that of the others is the marginal.
        remembers = isinstance(simulator, MemorySimulator) and simulator.memory != NO_MEMORY
        prior = probabilities.get("empirical" if remembers else MARGINAL, 1 / CLASSES)
        probabilities[each] = prediction.of_commands(prior)
        of_observed = np.take_along_axis(probabilities[each], halves.commands_of(halves.x_hz)[:, None], 1)[:, 0]
        transforms = prediction.transforms()
        distance = distance_from_uniform(transforms)
        correlation, length, lasting = map(_band, in_time(free_runs(simulator, prediction, FREE_RUNS, rng), median_hz))
        by_chance = (1 + int(np.sum(distances >= distance))) / (1 + _CHANCES)
        scores.append(
            Scores(
                kind=each,
                bits=np.log2(of_observed),
                crps_hz=prediction.crps(),
                transforms=transforms,
                distance=distance,
                p_value=None if each in (MARGINAL, "memory") else by_chance,
                autocorrelation=correlation,
                run_length=length,
                lasting=lasting,
                above=_by_condition(prediction.probability @ (halves.values_hz >= median_hz), halves),
            )
        )
    # At its own median, as a loop's thresholds adapt: drift is reported separately.
    recorded = in_time(recorded_series(halves)[None], float(np.median(halves.x_hz)))
    recorded_correlation, recorded_length, recorded_lasting = (of_one[0] for of_one in recorded)
    conditions = range(len(responses.conditions))
    first = [halves.first_of(c) for c in conditions]
    second = [halves.x_hz[halves.condition == c] for c in conditions]
    return Validation(
        labels=tuple(condition.label for condition in responses.conditions),
        n_fitted=tuple(map(len, first)),
        n_held=tuple(map(len, second)),
        medians_hz=np.array([[np.median(x) for x in half] for half in (first, second)], np.float64),
        above=_by_condition(halves.x_hz >= median_hz, halves),
        autocorrelation=recorded_correlation,
        run_length=recorded_length,
        lasting=recorded_lasting,
        scores=tuple(scores),
        kind=kind or default_kind(responses),
        is_blocked=responses.is_blocked,
        pit_band=band,
    )


def correlations(responses: Responses) -> Float64[np.ndarray, "2 pairs"]:
    """Spearman's correlation of every two readouts in the first half, which simulators keep, and in the second.

    It is computed within conditions and averaged, weighted by trials, over those in which both readouts vary; NaN if
    there are none. Pairs are (0, 1), (0, 2), ..., (1, 2), ...
    """
    from scipy.stats import rankdata

    halves, of_halves = halved(responses, 0), []
    for read_hz, condition in (
        (halves.first.read_hz[~halves.first.is_burst], halves.first.condition[~halves.first.is_burst]),
        (responses.read_hz[halves.rows], halves.condition),
    ):
        of_condition = [rankdata(read_hz[condition == c], axis=0) for c in range(len(responses.conditions))]
        upper = np.triu_indices(read_hz.shape[1], 1)
        with np.errstate(invalid="ignore", divide="ignore"):  # NaN for a constant readout.
            each = np.array([np.corrcoef(ranks, rowvar=False)[upper] for ranks in of_condition])
            weights = np.array([[len(ranks)] for ranks in of_condition]) * np.isfinite(each)
            of_halves.append(np.nansum(weights * each, axis=0) / weights.sum(axis=0))
    return np.array(of_halves)


def pit_shares(transforms: Float64[np.ndarray, "held 2"]) -> Float64[np.ndarray, " bins"]:
    """The share of the transforms in each of `PIT_BINS` equal bins."""
    return np.diff(share_below(transforms, np.linspace(0, 1, PIT_BINS + 1)[1:-1]), prepend=0, append=1)


def distance_from_uniform(transforms: Float64[np.ndarray, "held 2"]) -> float:
    """Kolmogorov's distance of the transforms from the uniform distribution, to 0.001."""
    at = np.linspace(0, 1, 1001)
    return float(np.abs(share_below(transforms, at) - at).max())


def _chance_levels(
    halves: Halves, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, " chances"], tuple[float, float]]:
    """Distances from uniform, and the middle 95 % of the bins' shares, if both halves have the same distributions.

    The recorded responses to each condition are shuffled between the halves, so that as many are tied as were recorded.
    """
    conditions = np.unique(halves.condition)
    parts = [(halves.first_of(c).astype(np.float32), halves.x_hz[halves.condition == c]) for c in conditions]
    distances, shares = [], []
    for _ in range(_CHANCES):
        transforms = np.concatenate([_shuffled(*of_condition, rng) for of_condition in parts])
        # Just below and above every step of the distribution, where the distance is largest.
        at = np.unique(transforms)
        distances.append(max(np.abs(share_below(transforms, at + side) - at).max() for side in (0.0, 1e-11)))
        shares.append(pit_shares(transforms))
    low, high = np.quantile(shares, [0.025, 0.975])
    return np.array(distances), (float(low), float(high))


def _shuffled(
    first: Float32[np.ndarray, " fitted"], second: Float32[np.ndarray, " held"], rng: np.random.Generator
) -> Float64[np.ndarray, "held 2"]:
    """The transforms of a second half by the distribution of the first, the responses shuffled between them."""
    shuffled = rng.permutation(np.concatenate([first, second]))
    fitted, held = np.sort(shuffled[: len(first)]), shuffled[len(first) :]
    below, up_to = (np.searchsorted(fitted, held, side) / len(fitted) for side in ("left", "right"))
    return np.stack([below, up_to], axis=1)


def _plain(value: Any) -> Any:
    """A number, an array or a `Band` as JSON data."""
    if isinstance(value, Band):
        return {end: _plain(each) for end, each in value._asdict().items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _by_condition(x: Any, halves: Halves) -> Float64[np.ndarray, " conditions"]:
    return np.array([x[halves.condition == c].mean() for c in range(len(halves.whole.conditions))], np.float64)


def _band(x: Float64[np.ndarray, "n *some"]) -> Band:
    """Over the free runs, ignoring NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NaN in all runs gives NaN.
        low, high = np.nanquantile(x, [0.025, 0.975], axis=0)
        return Band(low, np.nanmean(x, axis=0), high)
