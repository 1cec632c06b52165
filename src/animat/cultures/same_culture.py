"""Whether a virtual culture is the one that recordings are of, and not before them on its clock."""

from __future__ import annotations

from animat.cultures.base import Culture
from animat.cultures.virtual import VirtualCulture
from animat.recordings.findings import Finding
from animat.recordings.recording import Recording


def other_culture(recording: Recording, start_min: float, culture: Culture) -> Finding | None:
    """What there is to say of a virtual culture that is not the one recorded; None if it is, or is no virtual one.

    Percentiles are those of one culture at one time. A culture whose clock is before its recording did not live through
    it: it was begun anew, or from a state before.

    Args:
        recording: of the culture.
        start_min: when the recording that percentiles are taken from began, on the culture's clock.
        culture: open.
    """
    if not isinstance(culture, VirtualCulture):
        return None
    now_min, told = culture.now_s / 60, recording.provenance
    differ = [name for name, words in culture.settings.items() if told.get(name) != words]
    if differ:
        of = f"virtual culture {told.get('seed')}"
        if "source" in differ:
            of = "no virtual culture"
        elif "seed" not in differ:
            of += f" with another {' and '.join(differ)}"
        sentence = (
            f"the recordings are of {of}, and this is virtual culture {culture.seed}: another culture has other "
            "percentiles"
        )
    elif now_min < start_min:
        sentence = (
            f"the culture begins{' anew' if now_min == 0 else ''} at {now_min:.0f} min, and its percentiles are of the "
            f"recording at {start_min:.0f} min: another time has other percentiles; give its state after that (--state)"
        )
    else:
        return None
    return Finding("other-culture", "warning", sentence, start_min - now_min)
