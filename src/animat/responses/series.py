"""From the recordings of one culture to their responses, refusing those on which training is pointless."""

from __future__ import annotations

from collections.abc import Sequence

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, Mismatch, UnusableData, in_min
from animat.recordings.findings import Finding
from animat.recordings.quality import recording_findings
from animat.recordings.recording import Recording
from animat.recordings.response_table import ResponseTable
from animat.responses.conditions import Conditions, conditions_named
from animat.responses.extraction import extract_responses
from animat.responses.quality.one_culture import series_findings
from animat.responses.readouts import ALL, Readouts, readouts_on
from animat.responses.responses import Responses
from animat.responses.windows import DEFAULT_WINDOW_MS

REFUSING = (
    "no-stimuli",
    "no-spikes",
    "no-condition",
    "one-condition",
    "empty-condition",
    "dead-window",
    "times-not-in-seconds",
    "more-stimuli-than-spikes",
    "simultaneous-stimuli",
    "several-cultures",
)
"""Names of the findings that make training pointless; a user may allow them."""
_NOTHING_TO_FIT = ("no-stimuli", "no-condition", "empty-condition")
"""Those after which no simulator can be fitted, even if they are allowed."""


@checked_arguments
def extract_series(
    recordings: Sequence[Recording | ResponseTable],
    by: Conditions | str | None = None,
    window_ms: tuple[float, float] | None = None,
    *,
    burst_threshold: float | None = None,
    allow: Sequence[str] = (),
    readouts: str | Readouts = ALL,
) -> list[Responses]:
    """Extract the responses of recordings, to fit simulators to them.

    Args:
        recordings: of one culture; or response tables.
        by: the rule of the conditions, or its text form (`conditions_named`); None: by frequency if it is known, by
            place if the protocol has places.
        window_ms: start and end of the window after the pulse; None: the paper's, 2 to 10 ms.
        burst_threshold: a ratio of active channels in place of Otsu's threshold; 1 keeps every response.
        allow: names of findings (`"dead-window"`) to ignore.
        readouts: groups of channels, the same electrodes in all recordings; `halves` and `quadrants` are those of the
            first one.

    Raises:
        UnusableData: if a finding refuses a recording, or recordings are of different cultures, unless `allow` names
            it.
        InvalidArgument: for conditions that cannot be read, a name in `allow` that is not a refusing finding, or
            channels that do not form readouts.
        Mismatch: for a recording whose channels do not read all electrodes of the readouts.
    """
    recordings = tuple(recordings)
    check_allowed(allow)
    by = by if by is None or isinstance(by, Conditions) else conditions_named(by)
    window_ms = DEFAULT_WINDOW_MS if window_ms is None else window_ms
    series = []
    for recording in recordings:
        try:
            readouts = readouts_on(readouts, recording.channels)
            responses = extract_responses(recording, by, window_ms, burst_threshold, readouts)
        except (UnusableData, Mismatch) as error:
            # Appended, as the message begins with the argument.
            raise type(error)(f"{error} (the recording at {in_min(recording.start_min)})") from error
        for finding in (*recording_findings(recording), *responses.findings):
            if finding.severity == "refuse" and finding.name not in allow:
                remedy = f" (to allow it: {_allowing(finding)}, or in a study simulators.allow)"
                if finding.name in _NOTHING_TO_FIT:
                    remedy = ""
                raise UnusableData(f"the recording at {in_min(recording.start_min)}: {finding.message}{remedy}")
        series.append(responses)
    for finding in series_findings(series):
        if finding.severity == "refuse" and finding.name not in allow:
            raise UnusableData(f"recordings: {finding.message} (to allow it: {_allowing(finding)})")
    return series


def _allowing(finding: Finding) -> str:
    return f"--allow {finding.name}, in Python allow=['{finding.name}']"


def check_allowed(names: Sequence[str]) -> None:
    """Raise InvalidArgument unless all are names of refusing findings: a misspelt one would have no effect."""
    for name in names:
        if name not in REFUSING:
            raise InvalidArgument(f"allow: expected findings among {', '.join(REFUSING)}, got {name!r}")
