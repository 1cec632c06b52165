"""The contents of a recording, whether it can be used, and what is wrong with it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from animat.arguments import checked_arguments
from animat.recordings.findings import Finding
from animat.recordings.quality import recording_findings
from animat.recordings.recording import Recording, ResponseTable
from animat.recordings.time_quality import TIME_UNITS
from animat.records import as_json
from animat.responses.bursts import NetworkBursts, find_network_bursts
from animat.responses.conditions import Conditions
from animat.responses.extraction import extract_responses
from animat.responses.psth import ResponseTime, find_response, spontaneous_rate
from animat.responses.responses import Responses
from animat.responses.windows import Window
from animat.tables import briefly

Verdict = Literal["usable", "usable with care", "not usable"]
_VERDICTS: dict[str, Verdict] = {"refuse": "not usable", "warning": "usable with care", "note": "usable"}
"""By the severity of the gravest finding, the gravest first."""


class ConditionSummary(NamedTuple):
    """The responses to one condition in a few numbers.

    Attributes:
        n_responses: all responses, including bursts.
        n_non_burst: responses that are not bursts, to which the other numbers belong, which are NaN without any.
        share_above_median: P(x >= P50), P50 the median of all conditions together.
    """

    label: str
    n_responses: int
    n_non_burst: int
    median_rate_hz: float
    share_above_median: float


@dataclass(frozen=True, eq=False)
class Inspection:
    """The contents and findings of one recording.

    Attributes:
        name: of the recording, such as its file.
        n_spikes: None for a table of rates.
        n_stimuli: pulses; a response is read after the last pulse of each trial (`n_trials`).
        duration_s: length of the recording; NaN if it is not known.
        by_default: whether the conditions are the default ones.
        mean_spikes_per_stimulus: spikes in the window, over all trials whose window lies in the recording, with or
            without a condition, including bursts; NaN without any.
        spontaneous_rate_hz: per channel, before stimuli; NaN if stimuli leave no quiet time. Without any stimulus, over
            the whole recording.
        response: when the culture responds; None if no response was found.
        responses: from which a simulator would be made.
        findings: the gravest first.
        network_bursts: of a recording without stimuli; None for others, whose responses are separated instead.
    """

    __repr__ = briefly

    name: str
    n_spikes: int | None
    n_stimuli: int
    n_trials: int
    duration_s: float
    by_default: bool
    mean_spikes_per_stimulus: float
    spontaneous_rate_hz: float
    response: ResponseTime | None
    responses: Responses
    findings: tuple[Finding, ...]
    network_bursts: NetworkBursts | None = None

    @property
    def verdict(self) -> Verdict:
        """Not usable if a finding refuses it, usable with care if one warns, else usable."""
        return _VERDICTS[self.findings[0].severity if self.findings else "note"]

    @property
    def conditions(self) -> tuple[ConditionSummary, ...]:
        """The conditions in the order of their index."""
        shares = self.responses.shares_above_median()
        summaries = []
        for i, condition in enumerate(self.responses.conditions):
            rates_hz = self.responses.rates_of(i)
            median_hz = float(np.median(rates_hz)) if len(rates_hz) else math.nan
            n = int(np.count_nonzero(self.responses.condition == i))
            summaries.append(ConditionSummary(condition.label, n, len(rates_hz), median_hz, float(shares[i])))
        return tuple(summaries)

    @property
    def n_bursts(self) -> int:
        """Responses set apart as bursts."""
        return int(np.count_nonzero(self.responses.is_burst))

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data for JSON; unknown values are None."""
        responses, bursts = self.responses, self.network_bursts
        of_condition = ("label", "responses", "non_burst", "median_rate_hz", "share_above_median")
        data = {
            "name": self.name,
            "verdict": self.verdict,
            "spikes": self.n_spikes,
            "channels": responses.n_channels,
            "stimuli": self.n_stimuli,
            "trials": self.n_trials,
            "presentation": None if responses.presentation is None else str(responses.presentation),
            "start_min": responses.start_min,
            "duration_s": self.duration_s,
            "window_ms": list(responses.window_ms),
            "mean_spikes_per_stimulus": self.mean_spikes_per_stimulus,
            "spontaneous_rate_hz": self.spontaneous_rate_hz,
            "response_ms": [self.response.start_ms, self.response.end_ms] if self.response else None,
            "by": responses.by,
            "by_default": self.by_default,
            "responses": len(responses),
            "median_rate_hz": responses.median_rate_hz,
            "burst_threshold": responses.threshold,
            "burst_separability": responses.separability,
            "bursts": self.n_bursts,
            "network_bursts": None
            if bursts is None
            else {"bursts": len(bursts), "median_s": bursts.median_s, "share_of_spikes": bursts.share},
            "conditions": [dict(zip(of_condition, each, strict=True)) for each in self.conditions],
            "findings": [{**finding.to_dict(), "value": finding.value} for finding in self.findings],
        }
        return as_json(data)  # type: ignore[no-any-return]


@checked_arguments
def inspect_recording(
    recording: Recording | ResponseTable,
    by: Conditions | str | None = None,
    window_ms: Window | None = None,
    burst_threshold: float | None = None,
    name: str | None = None,
) -> Inspection:
    """Inspect a recording as training would use it: its contents, and what is wrong with it.

    Args:
        by, window_ms, burst_threshold: as in `extract_responses`.
        name: what to call it; by default the source in its provenance.

    Raises:
        InvalidArgument: for a window that does not follow the stimulus, or conditions that cannot be read.
        UnusableData: for a recording without channels.
        Mismatch: for a window that differs from a table's.
    """
    responses = extract_responses(recording, by, window_ms, burst_threshold)
    stimuli, (presented, _) = recording.stimuli, responses.presentations
    # Channels times the length of a window.
    window_s = (responses.window_ms[1] - responses.window_ms[0]) * 1e-3 * responses.n_channels
    # Nothing was delivered in a rest.
    pulses_s, rates_hz = stimuli.time_s[~stimuli.is_rest], presented.rate_hz
    if presented.time_s is not None:
        rates_hz = rates_hz[np.isin(presented.time_s, pulses_s)]
    bursts = response = None
    rate_hz = duration_s = math.nan
    if isinstance(recording, ResponseTable):
        # Without spike times, the rest is not known.
        kind, n_spikes = "table", int(recording.values.sum()) if recording.kind == "count" else None
        if recording.has_times and len(stimuli):
            duration_s = float(np.ptp(stimuli.time_s))
    else:
        kind, n_spikes, duration_s = "recording", len(recording.spike_times_s), recording.duration_s
        rate_hz = spontaneous_rate(recording, after_ms=responses.window_ms[1])[0] / len(recording.channels)
        if not len(stimuli):
            bursts = find_network_bursts(recording)
            exposure_s = recording.duration_s * len(recording.channels)
            rate_hz = len(recording.spike_times_s) / exposure_s if exposure_s else math.nan
        response = find_response(recording)
    return Inspection(
        name=name or recording.provenance.get("source", kind),
        n_spikes=n_spikes,
        n_stimuli=len(pulses_s),
        n_trials=int(np.count_nonzero(stimuli.is_last_of_presentation)),
        duration_s=duration_s,
        by_default=by is None,
        mean_spikes_per_stimulus=float(np.mean(rates_hz)) * window_s if len(rates_hz) else math.nan,
        spontaneous_rate_hz=rate_hz,
        response=response,
        responses=responses,
        findings=_gravest_first(recording, responses),
        network_bursts=bursts,
    )


def _gravest_first(source: Recording | ResponseTable, responses: Responses) -> tuple[Finding, ...]:
    """All findings; of those with the same name the responses', which say more, except on missing stimuli."""
    found = [finding for finding in responses.findings if finding.name != "no-stimuli"]
    names = {finding.name for finding in found}
    found += [finding for finding in recording_findings(source) if finding.name not in names]
    distinct = {finding.name + finding.message: finding for finding in found}.values()
    # Times in other units are a cause of much else.
    grave = list(_VERDICTS)
    return tuple(sorted(distinct, key=lambda finding: (grave.index(finding.severity), finding.name != TIME_UNITS)))
