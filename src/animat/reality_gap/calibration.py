"""What a closed loop takes from recordings: percentiles, the burst threshold, and the predicting simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Self

import numpy as np
from jaxtyping import Float64

from animat.arguments import checked_arguments
from animat.closed_loop.adaptive import AdaptiveThresholds, kept_counts
from animat.coding.mapping import Thresholds
from animat.cultures.base import Culture
from animat.cultures.kinds import pulse_for
from animat.errors import counted, in_min
from animat.evaluation.transfer import other_percentiles
from animat.neurons.history import Ranked
from animat.neurons.history_tracker import AdjustedRanks, HistoryState, HistoryTracker
from animat.neurons.memory import MemorySimulator
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorKind, fit_simulator, fit_timeline, room_for
from animat.recordings.findings import Finding
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Recording
from animat.responses.condition import Condition
from animat.responses.quality.drift import MedianDrift, median_drift
from animat.responses.readouts import ALL, Readouts
from animat.responses.responses import Responses
from animat.stimulation.protocol import Presentation
from animat.tables import briefly
from animat.training.policy import FITTED, Policy

BOOTSTRAPS = 100
"""Bootstrap samples of the recording's responses."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a closed loop takes from a recording, and the simulators of its prediction.

    Attributes:
        adaptive: whether the loop's thresholds adapt (`animat.closed_loop.adaptive`) or are fixed.
        simulator: of the recording; with adaptive thresholds, of its responses as these read them.
        percentiles: P0, P10, ..., P100 of its non-burst responses, Hz, shape (11,), or (readouts, 11), with which the
            loop begins.
        bootstraps: simulators of bootstrap samples of its responses.
        burst_threshold: ratio of active channels above which a response was a burst.
        drift: over the recordings up to this one; None if it cannot be determined from one recording.
        start_min: of the recording on the culture's clock.
        fitted: how the simulators were fitted, as in `Policy.fitted`.
        adjusted: its responses, from which adaptive thresholds start.
        recording: without its spikes; None for one that has none, as a table of responses.
        culture, recorded_at: which was recorded, and when; None if it is not known.
    """

    __repr__ = briefly

    adaptive: bool
    percentiles: Float64[np.ndarray, "*readouts percentiles"]
    simulator: NeuronSimulator
    bootstraps: tuple[NeuronSimulator, ...]
    burst_threshold: float
    burst_share: float
    drift: MedianDrift | None
    start_min: float
    conditions: tuple[Condition, ...]
    presentation: Presentation | None
    findings: tuple[Finding, ...]
    fitted: dict[str, Any]
    adjusted: AdjustedRanks
    readouts: Readouts = ALL
    recording: Recording | None = None
    culture: RecordedCulture | None = None
    recorded_at: datetime | None = None

    @property
    def responses_hz(self) -> tuple[Float64[np.ndarray, "responses *readouts"], ...]:
        """Non-burst responses of each condition, in order of time, shape (responses,), or (responses, readouts)."""
        return self.adjusted.responses_hz

    def age_min(self, culture: Culture) -> float:
        """How old the recording is: on a device by the computer's clock, if known, as the device's may start anew."""
        if culture.device is not None and self.recorded_at is not None:
            return (datetime.now(UTC) - self.recorded_at).total_seconds() / 60
        return culture.now_s / 60 - self.start_min

    def delivered(self, culture: Culture) -> tuple[dict[str, Any], tuple[Finding, ...]]:
        """The recording's pulse and number of patterns, as settings of a loop, and a finding without a known pulse."""
        recording = self.recording
        stated = None if recording is None else recording.pulse
        settings: dict[str, Any] = {"pulse": pulse_for(culture.name, stated)}
        if recording is not None and recording.protocol is not None:
            settings["patterns"] = min(recording.protocol.patterns, len(culture.patterns)) or None
        if stated is not None:
            return settings, ()
        message = (
            f"the recording at {in_min(self.start_min)}, which calibrates the loop, does not state its pulse: the loop "
            f"delivers {settings['pulse']}, the usual one; to change it, give `pulse`"
        )
        return settings, (Finding("unknown-pulse", "warning", message),)

    @property
    def remembering(self) -> HistoryTracker:
        """How a loop's responses update the history state, with the memory of the recording's own simulator."""
        return self.adjusted.remembering

    @classmethod
    @checked_arguments
    def of_series(
        cls,
        series: Sequence[Responses],
        policy: Policy | None = None,
        *,
        at_min: float | None = None,
        adaptive: bool = True,
        kind: SimulatorKind | None = None,
        bins: int = 20,
        range_hz: float | None = None,
    ) -> Self:
        """Calibrate by the responses of a culture's recordings.

        Args:
            series: in any order.
            policy: determines the recording, that of its last simulator in training; those before its first one are
                left out. Fixed thresholds are those with which it was trained.
            at_min: the minute whose newest recording is used instead; None without a policy: the last.
            adaptive: whether the loop's thresholds will adapt, or are fixed. With adaptive thresholds, simulators are
                made of responses as these read them (`reread`), except for recordings in blocks and for policies
                whose mapping is not thresholds.
            kind, bins, range_hz: of the simulator, see `fit_timeline`, whose errors are raised.
        """
        series, findings = _own_recordings(series, policy, at_min)
        timeline = fit_timeline(series, kind=kind, bins=bins, range_hz=range_hz)
        fit: dict[str, Any] = {"kind": timeline.fitted["kind"], "bins": bins, "range_hz": range_hz}
        if at_min is None:
            first_min, last_min = timeline.start_min[[0, -1]].tolist()
            at_min = last_min if policy is None else policy.trained_until_min(first_min)
            # A policy that does not know its own recordings is run on the first.
            at_min = first_min if at_min is None else at_min
        start_min = float(timeline.start_min[timeline.requested_row(at_min)])
        responses = next(each for each in series if each.start_min == start_min)
        rng = np.random.default_rng(0)
        recorded = simulator = timeline.at(start_min)
        adjusted = AdjustedRanks.of(responses, recorded)
        # All of the same shape, so that programs are compiled once.
        fit["room"] = room_for(series)
        answers = responses
        if adaptive and not responses.is_blocked and (policy is None or isinstance(policy.mapping, Thresholds)):
            answers = reread(responses, adjusted)
            # The loop shows policies the history state of the recording's own simulator.
            known = recorded.memory if isinstance(recorded, MemorySimulator) else None
            sees = policy is not None and policy.neural_observation
            simulator = fit_simulator(answers, **fit, memory=known if sees else None)
        # In a bootstrap sample a response can be its own neighbour: the memory is not fitted again.
        fit["memory"] = simulator.memory if isinstance(simulator, MemorySimulator) else None
        calibration = cls(
            adaptive=adaptive,
            percentiles=np.asarray(recorded.percentiles, np.float64),
            simulator=simulator,
            bootstraps=tuple(fit_simulator(answers.bootstrapped(rng), **fit) for _ in range(BOOTSTRAPS)),
            burst_threshold=responses.threshold,
            burst_share=float(responses.is_burst.mean()),
            drift=median_drift([each for each in timeline.responses if each.start_min <= start_min]),
            start_min=start_min,
            conditions=timeline.conditions,
            presentation=timeline.presentation,
            findings=findings + timeline.findings_at(start_min),
            fitted={name: timeline.fitted[name] for name in FITTED},
            readouts=timeline.readouts,
            adjusted=adjusted,
            recording=responses.recording,
            culture=timeline.culture,
            recorded_at=responses.recorded_at,
        )
        if adaptive or policy is None or policy.percentiles != "first":
            return calibration
        found = calibration.findings + tuple(other_percentiles(policy, float(timeline.start_min[0])))
        calibration = replace(calibration, findings=found)
        return calibration.with_percentiles(timeline.with_percentiles("first").at(start_min).percentiles)

    def with_percentiles(self, percentiles: Any) -> Self:
        """The calibration with one set of percentiles in all simulators, independent of their responses."""
        fitted: Any = (self.simulator, *self.bootstraps)
        simulator, *bootstraps = (replace(each, percentiles=percentiles) for each in fitted)
        own = np.asarray(percentiles, np.float64)
        return replace(self, percentiles=own, simulator=simulator, bootstraps=tuple(bootstraps))


def _own_recordings(
    series: Sequence[Responses], policy: Policy | None, at_min: float | None
) -> tuple[Sequence[Responses], tuple[Finding, ...]]:
    """The recordings without those before a policy's first one, and a note on these; all if no others are left.

    All too if an earlier minute is asked for.
    """
    own_min = min(policy.recorded_at_min[:1], default=-np.inf) if policy is not None else -np.inf
    own = [each for each in series if each.start_min >= own_min]
    older = len(series) - len(own)
    if not older or not own or (at_min is not None and at_min < own_min):
        return series, ()
    what = f"not used: {counted(older, 'recording')} before that at {in_min(own_min)}, the policies' first one"
    return own, (Finding("older-recordings", "note", what, float(older)),)


def reread(responses: Responses, adjusted: AdjustedRanks) -> Responses:
    """Replace each response by the recording's quantile of the rank that adaptive thresholds give it at its time.

    Responses rise and fall together, over seconds and minutes. Adaptive thresholds follow this, so it disturbs the
    controller less. A simulator draws responses from all times, and takes all of this for chance. So the recording is
    read again, by thresholds that begin with the first responses of each condition and adapt after each trial
    (`animat.closed_loop.adaptive`). A simulator of these responses takes only the rest for chance.

    The recording is not in blocks, where condition and time would be confounded. Only x changes, of all channels or of
    readouts.
    """
    kept = kept_counts(adjusted)
    first_hz = tuple(each[:n] for each, n in zip(adjusted.responses_hz, kept, strict=True))
    first_ranks = tuple(each[:n] for each, n in zip(adjusted.ranks, kept, strict=True))
    thresholds = AdaptiveThresholds(replace(adjusted, responses_hz=first_hz, ranks=first_ranks))
    read_hz, ranks = responses.read_hz, []
    histories = Ranked(responses).states(adjusted.remembering.memory)
    trials = zip(responses.condition, read_hz, histories, responses.is_burst, strict=True)
    for condition, x_hz, history, is_burst in trials:
        ranks.append(thresholds.ranks(x_hz))
        if not is_burst:
            thresholds.add(int(condition), HistoryState(*history), x_hz)
    of_readouts = zip(np.atleast_2d(adjusted.sorted_hz), np.array(ranks).T, strict=True)
    reread_hz = np.stack([np.quantile(sorted_hz, rank) for sorted_hz, rank in of_readouts], axis=-1)
    reread_hz = reread_hz.reshape(read_hz.shape)
    if responses.readout_hz is not None:
        return replace(responses, readout_hz=reread_hz)
    presented, place = responses.presentations
    all_hz = presented.rate_hz.copy()
    all_hz[place] = reread_hz
    return replace(responses, rate_hz=reread_hz, presented=replace(presented, rate_hz=all_hz), place=place)
