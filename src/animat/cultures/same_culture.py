"""Whether a culture is the one that was recorded, and was not opened at a time before the recording."""

from __future__ import annotations

import numpy as np

from animat.cultures.base import Culture
from animat.cultures.virtual import VirtualCulture
from animat.recordings.findings import Finding
from animat.recordings.recording import Recording
from animat.tables import UNKNOWN


def culture_differences(recording: Recording, culture: Culture, *, patterns_too: bool) -> tuple[Finding, ...]:
    """Warnings where an open culture is not, or not in all, the recorded one; `patterns_too`: if they are used."""
    found = other_culture(recording, culture), other_channels(recording, culture)
    also = (other_patterns(recording, culture),) if patterns_too else ()
    return tuple(finding for finding in (*found, *also) if finding is not None)


def other_culture(recording: Recording, culture: Culture) -> Finding | None:
    """A warning where an open culture is not the recorded one; None where it is, or where that cannot be known.

    Percentiles, taken from the recording, belong to one culture at one time. Devices are compared by their kind, and by
    the names that they give themselves and what is on them. A virtual culture whose clock is before its recording, or a
    CL1 whose clock is before the recording's end, did not live through it: it was restarted, or continued from an
    earlier state. A replay may answer from any recording.
    """
    here, there = culture.recorded_as, recording.culture
    if here is not None and here.kind == "replay":
        return None
    now_min, start_min = culture.now_s / 60, recording.start_min
    stop_min = start_min + recording.duration_s / 60
    if isinstance(culture, VirtualCulture):
        differ = _other_virtual(recording, culture)
    else:
        difference = there.difference(here) if here and there else None
        differ = (f"of {difference[0]}", difference[1]) if difference else None
    if differ:
        message = f"the recordings are {differ[0]}, but this is {differ[1]}: percentiles differ between cultures"
    elif isinstance(culture, VirtualCulture) and now_min < start_min:
        at = f"{' afresh' if now_min == 0 else ''} at {now_min:.0f} min"
        of = f"its percentiles are of the recording at {start_min:.0f} min, and they change over time"
        message = f"the culture starts{at}, but {of}: pass its state after that recording (--state)"
    elif culture.name == "cl1" and now_min < stop_min:
        before = f"before the end of the recording at {start_min:.1f} min that percentiles are taken from"
        why = "the device was restarted, as the SDK's simulator is whenever it is opened; percentiles change over time"
        message = f"the CL1's clock is at {now_min:.1f} min, {before}: {why}"
    else:
        return None
    return Finding("other-culture", "warning", message, stop_min - now_min if stop_min > now_min else None)


def _other_virtual(recording: Recording, culture: VirtualCulture) -> tuple[str, str] | None:
    """What the recordings are of, and what this culture is, where its settings differ."""
    differ = [name for name, value in culture.settings.items() if recording.provenance.get(name) != value]
    recorded, here = recording.culture, f"virtual culture {culture.seed}"
    if not differ:
        return None
    if recorded is None or recorded.kind != "virtual":
        return "not of a virtual culture", here
    with_another = "" if "seed" in differ else f" with a different {' and '.join(differ)}"
    return f"of virtual culture {recorded.seed}{with_another}", here


def other_channels(recording: Recording, culture: Culture) -> Finding | None:
    """A warning where an open culture reads other electrodes than were recorded; None otherwise, or if not known."""
    recorded = recording.channels.electrode
    different = len(np.setxor1d(recorded, culture.channels.electrode))
    if not different or np.any(recorded == UNKNOWN):
        return None
    what = f"{different:,} electrodes are read in the recordings or on this culture, but not in both"
    message = f"{what}: a response is the mean over all channels, and percentiles are those of the recordings"
    return Finding("other-channels", "warning", message, float(different))


def other_patterns(recording: Recording, culture: Culture) -> Finding | None:
    """A warning where electrodes were stimulated together that are not a pattern of this open culture; else None.

    A policy was trained on responses to the recorded patterns. The same culture responds differently to others; a
    replay, whose patterns are those of its first recording, answers to all from its recordings.
    """
    if culture.name == "replay":
        return None
    tables = recording.stimuli.electrodes, culture.patterns
    recorded, patterns = ({frozenset(row) - {UNKNOWN} for row in table.tolist()} for table in tables)
    strange = recorded - patterns - {frozenset()}
    if not strange:
        return None
    are = "is not a pattern" if len(strange) == 1 else "are not patterns"
    message = (
        f"{len(strange)} of the {len(recorded)} sets of electrodes that were stimulated in the recordings {are} of "
        "this culture, which responds differently through other electrodes (a CL1's patterns are drawn by "
        "--culture-seed, a MaxOne's are those of --selection)"
    )
    return Finding("other-patterns", "warning", message, float(len(strange)))
