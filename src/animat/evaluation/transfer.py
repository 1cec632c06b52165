"""What keeps a closed loop on the culture from the returns that a simulator predicts, as far as it is known beforehand.

Whoever shows such a return says so in these words: training, evaluation, and the closed loop itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from animat.errors import Mismatch, in_min, some_of
from animat.neurons.timeline import SimulatorTimeline
from animat.recordings.findings import Finding
from animat.responses.condition import Condition, stimulus_mismatch
from animat.responses.readouts import Readouts
from animat.stimulation.protocol import Presentation
from animat.training.policy import Policy

UNKNOWN = "unknown-presentation"

OLD_MIN = 30.0
"""Age of a recording from which on a warning says that the culture may be another by now."""


def other_presentation(recorded: Presentation | None, presented: Presentation) -> Iterator[Finding]:
    """Where a loop presents stimuli otherwise than the recordings that its policies were trained on."""
    if recorded is None:
        message = (
            f"how the policy's recordings were presented is not known; a closed loop presents {presented}, and a "
            "culture answers otherwise to another presentation"
        )
        yield Finding(UNKNOWN, "warning", message)
        return
    if recorded.order != presented.order:
        message = (
            f"the policy's recordings were {recorded.order}: all stimuli of a frequency together; a closed loop "
            "presents them mixed, and a culture answers otherwise then: expect less than predicted (record with "
            "--order mixed, the default, for a closed loop)"
        )
        yield Finding("other-presentation", "warning", message)
    if recorded.pulses != presented.pulses:
        message = (
            f"the policy's recordings had {recorded.pulses} pulse(s) per trial, the loop has {presented.pulses}; "
            "the response after another number of pulses is another"
        )
        yield Finding("other-presentation", "warning", message)


def other_calibration(trained: Presentation | None, predicting: Presentation | None) -> Iterator[Finding]:
    """Where the recording that predicts was presented otherwise than those that policies were trained on."""
    if predicting is not None and predicting != trained:
        message = (
            f"the prediction is from a recording presented {predicting}, the policies' recordings were "
            f"{trained or 'unknown'}"
        )
        yield Finding("other-calibration", "warning", message)


def other_simulator(trained: Mapping[str, Any], given: Mapping[str, Any]) -> Iterator[Finding]:
    """Where a simulator is made otherwise than those that policies were trained on (`Policy.fitted`)."""

    def rule(name: str, value: Any) -> Any:
        # Which frequencies there are is in the conditions themselves; a tolerance is not.
        return None if name == "by" and str(value).startswith("frequency") else value

    differing = [name for name in trained if rule(name, trained[name]) != rule(name, given.get(name))]
    if differing:
        reported = ", ".join(f"{_WORDS.get(name, name)} {trained[name]}, here {given.get(name)}" for name in differing)
        message = f"the policies were trained on simulators made otherwise: {reported}"
        yield Finding("other-simulator", "warning", message)


_WORDS = {"by": "conditions", "burst_threshold": "burst threshold", "range_hz": "range (Hz)"}


def old_calibration(recorded_at_min: float, culture_min: float) -> Iterator[Finding]:
    """Where the culture is much older than the recording that predicts.

    Args:
        recorded_at_min: of the recording, on the culture's clock.
        culture_min: of the culture, or of its newest recording.
    """
    age_min = culture_min - recorded_at_min
    if age_min > OLD_MIN:
        message = (
            f"percentiles and prediction are of {recorded_at_min:.0f} min, and the culture is at {culture_min:.0f} "
            "min: cultures drift; take a later recording (--at-min), or train on later ones"
        )
        yield Finding("old-calibration", "warning", message, age_min)


def no_memory(noticed: Iterable[Finding], presentation: Presentation | None, *, has_memory: bool) -> Iterator[Finding]:
    """Where the recording shows that the culture remembers, and the simulator that predicts does not."""
    remembers = next((finding for finding in noticed if finding.name == "memory"), None)
    if remembers is None or has_memory:
        return
    blocked = presentation is not None and presentation.order == "blocked"
    remedy = "record with --order mixed" if blocked else "--simulator memory"
    message = f"{remembers.message}: a closed loop measures another return than is predicted ({remedy})"
    yield Finding("no-memory", "warning", message, remembers.value)


def other_recording(trained_until_min: float, evaluated_at_min: float) -> Iterator[Finding]:
    """Where policies are evaluated on another recording than the one that would calibrate their closed loop."""
    if trained_until_min != evaluated_at_min:
        message = (
            f"this is the culture at {in_min(evaluated_at_min)}; the policies were last trained on the recording at "
            f"{in_min(trained_until_min)}, which is the one that calibrates their closed loop"
        )
        yield Finding("other-recording", "warning", message, evaluated_at_min - trained_until_min)


NAMES = (UNKNOWN, "other-presentation", "other-calibration", "old-calibration", "no-memory", "other-recording")
"""Of the findings above that say why a culture would answer otherwise. Another simulator is not among them: which one
predicts is asked for, and a loop has none."""


def expect_conditions(policy: Policy, conditions: Sequence[Condition], readouts: Readouts) -> None:
    """Raise unless a policy can act through these.

    Raises:
        Mismatch: for other conditions, stimuli or readouts than it was trained on.
    """
    if policy.conditions != tuple(conditions):
        raise Mismatch(
            f"conditions: expected {some_of([c.label for c in policy.conditions])}, which the policies pick from, got "
            f"recordings with {some_of([c.label for c in conditions])}: take those that the policies were trained on"
        )
    if others := stimulus_mismatch(policy.conditions, conditions):
        raise Mismatch(f"conditions: {others} in the recordings: take those that the policies were trained on")
    if policy.readouts != readouts:
        raise Mismatch(
            f"readouts: expected {', '.join(policy.readouts.names)}, of the electrodes that the policies were trained "
            f"on, got {', '.join(readouts.names)} in the recordings"
        )


def other_timeline(policy: Policy, timeline: SimulatorTimeline) -> tuple[Finding, ...]:
    """Where simulators are otherwise than those that a policy was trained on; errors as of `expect_conditions`."""
    expect_conditions(policy, timeline.conditions, timeline.readouts)
    found = []
    if policy.window_ms != timeline.window_ms:
        trained, these = in_window(policy.window_ms), in_window(timeline.window_ms)
        message = f"the policies were trained on responses {trained}, these lie {these}"
        found.append(Finding("other-window", "warning", message))
    found += other_simulator(policy.fitted, timeline.fitted)
    first_min = next(iter(policy.recorded_at_min), None)
    if policy.percentiles == "first" and first_min not in (None, float(timeline.start_min[0])):
        message = (
            f"the policies' percentiles were fixed from the recording at {in_min(first_min)}, which is not the first "
            f"of these: here they are fixed from {in_min(timeline.start_min[0])}"
        )
        found.append(Finding("other-percentiles", "warning", message))
    return tuple(found)


def not_of_a_loop(policy: Policy, timeline: SimulatorTimeline, minute: float) -> Iterator[Finding]:
    """Why returns on the simulator of a minute are not those of a closed loop on the culture."""
    recorded = policy.presentation
    yield from other_presentation(recorded, Presentation("mixed", 1 if recorded is None else recorded.pulses))
    yield from other_calibration(recorded, timeline.presentation)
    yield from old_calibration(minute, float(timeline.start_min[-1]))
    has_memory = timeline.simulators.has_memory
    yield from no_memory(timeline.findings_at(minute), timeline.presentation, has_memory=has_memory)
    trained_until = policy.trained_until_min(float(timeline.start_min[0]))
    if trained_until is not None:
        yield from other_recording(float(timeline.start_min[timeline.row_at(trained_until)]), minute)


def in_window(window_ms: tuple[float, float] | None) -> str:
    """Of responses, as messages say it."""
    return "in a window that is not known" if window_ms is None else f"from {window_ms[0]:g} to {window_ms[1]:g} ms"
