"""Findings known beforehand that keep a closed loop on the culture from reaching a simulator's returns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from animat.errors import Mismatch, in_min, some_of
from animat.neurons.timeline import SimulatorTimeline
from animat.recordings.findings import Finding
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Recording
from animat.responses.condition import Condition, stimulus_mismatch
from animat.responses.readouts import Readouts
from animat.stimulation.protocol import Presentation
from animat.training.policy import Policy

UNKNOWN = "unknown-presentation"
_RARELY, _FASTER = 0.01, 1.5
"""Share of the intervals of a recording that may be shorter, and how many times as fast a loop may be."""
OLD_MIN = 30.0
"""Age of a recording above which a warning says that the culture may have drifted."""


def other_presentation(recorded: Presentation | None, presented: Presentation) -> Iterator[Finding]:
    """Warnings if a loop presents stimuli differently from the recordings on which its policies were trained."""
    if recorded is None:
        message = f"it is not known how stimuli were presented in the recordings; a closed loop presents {presented}"
        yield Finding(UNKNOWN, "warning", message)
        return
    if recorded.order != presented.order:
        were = f"the policy's recordings were {recorded.order}, but a closed loop mixes stimuli"
        message = f"{were}: expect less than predicted; record with --order mixed, the default"
        yield Finding("other-presentation", "warning", message)
    if recorded.pulses != presented.pulses:
        message = f"the policy's recordings had {recorded.pulses} pulse(s) per trial, the loop has {presented.pulses}"
        yield Finding("other-presentation", "warning", message)


def other_calibration(trained: Presentation | None, predicting: Presentation | None) -> Iterator[Finding]:
    """A warning if the presentation in the predicting recording differs from that in the training recordings."""
    if predicting is not None and predicting != trained:
        message = f"the prediction is from a recording presented {predicting}, the policies' was {trained or 'unknown'}"
        yield Finding("other-calibration", "warning", message)


def other_simulator(trained: Mapping[str, Any], given: Mapping[str, Any]) -> Iterator[Finding]:
    """A warning if a simulator was fitted differently from those in training (`Policy.fitted`)."""

    def rule(name: str, value: Any) -> Any:
        # The conditions themselves contain their frequencies, but not a tolerance.
        return None if name == "by" and str(value).startswith("frequency") else value

    differing = [name for name in trained if rule(name, trained[name]) != rule(name, given.get(name))]
    if "kind" in differing:
        # Only histograms have bins and a range.
        differing = [name for name in differing if name not in ("bins", "range_hz")]
    values = []
    for name in differing:
        before, here = ("by default" if of.get(name) is None else of[name] for of in (trained, given))
        values.append(f"{_LABELS.get(name, name)} {before}, here {here}")
    if values:
        message = f"the policies were trained on simulators that were fitted differently: {', '.join(values)}"
        yield Finding("other-simulator", "warning", message)


_LABELS = {"by": "conditions", "burst_threshold": "burst threshold", "range_hz": "range (Hz)"}


def other_culture(trained: RecordedCulture | None, given: RecordedCulture | None) -> Iterator[Finding]:
    """A warning if recordings are not of the culture that was recorded for the policies' training."""
    if trained and given and (difference := trained.difference(given)):
        message = (
            f"the policies were trained on recordings of {difference[0]}, but these are of {difference[1]}: another "
            "culture responds differently"
        )
        yield Finding("other-culture", "warning", message)


def faster_than_recorded(recording: Recording | None, conditions: Sequence[Condition]) -> Iterator[Finding]:
    """A warning if a loop stimulates faster than the recording ever did, as where its frequencies are wrong."""
    if recording is None or len(recording.stimuli) < 2:
        return
    # Not the very shortest, which may be a late pulse or a coarse time.
    shortest_s = float(np.quantile(np.diff(recording.stimuli.time_s), _RARELY))
    fastest_hz = max((hz for condition in conditions for hz in condition.frequencies_hz), default=0.0)
    if fastest_hz * shortest_s > _FASTER:
        message = (
            f"the loop stimulates at up to {fastest_hz:g} Hz, {1000 / fastest_hz:.3g} ms apart, but in the recording "
            f"stimuli were hardly ever less than {1000 * shortest_s:.3g} ms apart: check its frequencies"
        )
        yield Finding("faster-than-recorded", "warning", message, fastest_hz * shortest_s)


def old_calibration(age_min: float, now: str) -> Iterator[Finding]:
    """A warning if the predicting recording was made long before another one, or a session."""
    if age_min > OLD_MIN:
        age = f"{age_min:.0f} min" if age_min < 600 else f"{age_min / 60:.0f} h"
        remedy = "use a later recording (--at-min of evaluate and run), or train on later ones"
        message = f"percentiles and prediction are from a recording made {age} before {now}: cultures drift; {remedy}"
        yield Finding("old-calibration", "warning", message, age_min)


def no_memory(
    noticed: Iterable[Finding],
    presentation: Presentation | None,
    *,
    has_memory: bool,
    setting: str = "--simulator memory",
) -> Iterator[Finding]:
    """A warning if the recording shows that the culture has memory, but the predicting simulator has none.

    `setting` is what gives it one.
    """
    remembers = next((finding for finding in noticed if finding.name == "memory"), None)
    if remembers is None or has_memory:
        return
    # The finding on recordings in blocks has its remedy already.
    blocked = presentation is not None and presentation.order == "blocked"
    remedy = "" if blocked else f" ({setting})"
    message = f"{remembers.message}: the measured return may differ from the prediction{remedy}"
    yield Finding("no-memory", "warning", message, remembers.value)


NAMES = (UNKNOWN, "other-presentation", "other-calibration", "old-calibration", "no-memory", "other-recording")
"""Names of the findings because of which a culture would respond differently. `other-simulator` is not among them: the
user chooses the simulator that predicts, and a loop has none."""


def expect_same_conditions(policy: Policy, conditions: Sequence[Condition], readouts: Readouts) -> None:
    """Raise Mismatch unless conditions, stimuli and readouts are those of a policy's training."""
    if policy.conditions != tuple(conditions):
        raise Mismatch(
            f"conditions: expected {some_of([c.label for c in policy.conditions])}, from which the policies choose, "
            f"got recordings with {some_of([c.label for c in conditions])}: use those that the policies were trained on"
        )
    if others := stimulus_mismatch(policy.conditions, conditions):
        raise Mismatch(f"conditions: {others} in the recordings: use those that the policies were trained on")
    if policy.readouts != readouts:
        trained, got = (", ".join(each.names) for each in (policy.readouts, readouts))
        raise Mismatch(f"readouts: expected {trained}, with the electrodes of the policies' training, got {got}")


def timeline_differences(policy: Policy, timeline: SimulatorTimeline) -> Iterator[Finding]:
    """Differences between simulators and those that a policy was trained on; errors as in `expect_same_conditions`."""
    expect_same_conditions(policy, timeline.conditions, timeline.readouts)
    if policy.window_ms != timeline.window_ms:
        trained, these = describe_window(policy.window_ms), describe_window(timeline.window_ms)
        message = f"the policies were trained on responses {trained}, but these are {these}"
        yield Finding("other-window", "warning", message)
    yield from other_simulator(policy.fitted, timeline.fitted)
    yield from other_culture(policy.culture, timeline.culture)
    yield from other_percentiles(policy, float(timeline.start_min[0]))


def other_percentiles(policy: Policy, first_min: float) -> Iterator[Finding]:
    """Whether a policy's percentiles are those of another recording than the first of those given."""
    own_min = next(iter(policy.recorded_at_min), None)
    if policy.percentiles == "first" and own_min not in (None, first_min):
        fixed = f"{in_min(own_min)}, which is not the first of these ({in_min(first_min)})"
        message = f"the policies' percentiles were fixed from the recording at {fixed}"
        yield Finding("other-percentiles", "warning", message)


def loop_differences(policy: Policy, timeline: SimulatorTimeline, minute: float) -> Iterator[Finding]:
    """`timeline_differences`, and why returns on the simulator of a minute would differ from those of a closed loop."""
    yield from timeline_differences(policy, timeline)
    recorded = policy.presentation
    yield from other_presentation(recorded, Presentation("mixed", 1 if recorded is None else recorded.pulses))
    yield from other_calibration(recorded, timeline.presentation)
    yield from old_calibration(float(timeline.start_min[-1]) - minute, "the last one")
    has_memory = timeline.simulators.has_memory
    yield from no_memory(timeline.findings_at(minute), timeline.presentation, has_memory=has_memory)
    trained_until = policy.trained_until_min(float(timeline.start_min[0]))
    if trained_until is not None and (newest := float(timeline.start_min[timeline.row_at(trained_until)])) != minute:
        calibrating = f"the policies' last recording, which calibrates their closed loop, is that at {in_min(newest)}"
        message = f"this is the culture at {in_min(minute)}; {calibrating}"
        yield Finding("other-recording", "warning", message, minute - newest)


def describe_window(window_ms: tuple[float, float] | None) -> str:
    """A response window in words, for messages."""
    return "in an unknown window" if window_ms is None else f"from {window_ms[0]:g} to {window_ms[1]:g} ms"
