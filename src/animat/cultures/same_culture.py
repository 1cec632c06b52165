"""Whether a culture is the one that recordings are of, and not before them on its clock, as far as it tells."""

from __future__ import annotations

from collections.abc import Mapping

from animat.cultures.base import Culture
from animat.cultures.replay import ReplayCulture
from animat.cultures.virtual import VirtualCulture
from animat.recordings.findings import Finding
from animat.recordings.recording import Recording
from animat.tables import UNKNOWN

_BY = " by animat.cultures."
"""In the source of what animat recorded itself, between the kind of culture and where it is made."""
_NAMES = ("system_id", "chip_id", "cell_batch_id")
"""By which a device tells itself, and what is on it, from others."""


def other_culture(recording: Recording, culture: Culture) -> Finding | None:
    """What there is to say of a culture that is not the one recorded; None if it is, or tells nothing of it.

    Percentiles are those of one culture at one time. Devices are compared by their kind and the names that they have
    for themselves and for what is on them, as far as both sides tell. A culture whose clock is before its recording did
    not live through it: it was begun anew, or from a state before. Of a CL1 the clock tells too: the SDK's simulator
    begins anew whenever it is opened, and a simulated culture with it. A replay answers from whatever was recorded.

    Args:
        recording: that percentiles are taken from.
        culture: open.
    """
    now_min, told, start_min = culture.now_s / 60, recording.provenance, recording.start_min
    if not isinstance(culture, VirtualCulture | ReplayCulture) and (strange := _told_otherwise(told, culture)):
        message = f"the recordings are of {strange}: another culture has other percentiles"
        return Finding("other-culture", "warning", message)
    if culture.name == "cl1" and now_min < start_min + recording.duration_s / 60:
        message = (
            f"the CL1's clock is at {now_min:.1f} min, before the end of the recording at {start_min:.1f} min that "
            "percentiles are of: the device was started anew, as the SDK's simulator is whenever it is opened, and a "
            "simulated culture then is anew too: another time has other percentiles"
        )
        return Finding("other-culture", "warning", message, start_min - now_min)
    if not isinstance(culture, VirtualCulture):
        return None
    differ = [name for name, words in culture.settings.items() if told.get(name) != words]
    if differ:
        of = f"virtual culture {'?' if recording.culture is None else recording.culture.seed}"
        if "source" in differ:
            of = "no virtual culture"
        elif "seed" not in differ:
            of += f" with another {' and '.join(differ)}"
        message = (
            f"the recordings are of {of}, and this is virtual culture {culture.seed}: another culture has other "
            "percentiles"
        )
    elif now_min < start_min:
        message = (
            f"the culture begins{' anew' if now_min == 0 else ''} at {now_min:.0f} min, and its percentiles are of the "
            f"recording at {start_min:.0f} min: another time has other percentiles; give its state after that (--state)"
        )
    else:
        return None
    return Finding("other-culture", "warning", message, start_min - now_min)


def _told_otherwise(told: Mapping[str, str], culture: Culture) -> str:
    """What the recorded culture was, and what this one is, where both tell and differ; nothing where they do not."""
    here, there = culture.provenance, told.get("source", "")
    # A converted recording has its file as its source, and says nothing of a culture.
    if _BY in there and _BY in here.get("source", "") and there != here["source"]:
        kind, other = (words.split(_BY)[0].split(":")[0] for words in (there, here["source"]))
        return f"a {kind}, and this is a {other}"
    for name in _NAMES:
        if name in told and name in here and told[name] != here[name]:
            return f"{name} {told[name]}, and this is {name} {here[name]}"
    return ""


def other_patterns(recording: Recording, culture: Culture) -> Finding | None:
    """What there is to say of patterns of a recording that the culture does not have; None if it has all of them.

    A policy was trained on responses to those patterns; through other electrodes the same culture answers otherwise.

    Args:
        recording: of the culture.
        culture: open.
    """
    tables = recording.stimuli.electrodes, culture.patterns
    recorded, there = ({frozenset(row) - {UNKNOWN} for row in table.tolist()} for table in tables)
    strange = recorded - there - {frozenset()}
    if not strange:
        return None
    message = (
        f"{len(strange)} of the {len(recorded)} sets of electrodes that were stimulated in the recordings are no "
        "pattern of this culture: through other electrodes it answers otherwise (a CL1's patterns are drawn by "
        "--culture-seed, a MaxOne's are those of --selection)"
    )
    return Finding("other-patterns", "warning", message, float(len(strange)))
