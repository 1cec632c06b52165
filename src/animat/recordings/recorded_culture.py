"""Which culture was recorded, as far as its device or its file states it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from animat.records import Flag, Whole, record

NAMES = ("subject_id", "cell_batch_id", "chip_id", "well", "system_id")
"""Keys of a provenance by which a device or a file identifies the culture, and what it is on."""
UNKNOWN_SUBJECT_ID = "unknown"
"""NWB requires a subject; this is an unknown one's name."""
_NAMELESS = ("", UNKNOWN_SUBJECT_ID, "n/a", "na", "nan")
"""What programs write where there is no name, in small letters."""
_KINDS = {
    "virtual": "virtual culture",
    "replay": "replay of recordings",
    "cl1": "CL1",
    "maxone": "MaxOne",
    "synthetic": "synthetic culture",
}
_SEEDED = ("virtual", "synthetic")
"""Of these, cultures of different seeds are different ones; a CL1's seed only draws its patterns."""


@record
class RecordedCulture:
    """The culture that was recorded.

    Attributes:
        kind: as `animat.cultures.kinds` names it; None if it is not known.
        seed: of a virtual culture, or of a CL1's patterns; None if there is none, or it is not known.
        is_simulated: whether a simulator stands in for the device, as the CL1's SDK has one.
        names: key and value of those in `NAMES` that are known.
    """

    kind: str | None = None
    seed: Whole | None = None
    is_simulated: Flag = False
    names: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        """Its kind, for messages."""
        name = _KINDS.get(self.kind or "", self.kind or "culture")
        return f"{name} (the SDK's simulator)" if self.is_simulated else name

    def difference(self, other: RecordedCulture) -> tuple[str, str] | None:
        """Why another one cannot be the same culture, in words for each of the two; None where it may be the same.

        Only what is known of both is compared. A replay may respond from any recording.
        """
        if "replay" in (self.kind, other.kind):
            return None
        if self.kind and other.kind and (self.kind, self.is_simulated) != (other.kind, other.is_simulated):
            return f"a {self}", f"a {other}"
        if self.kind in _SEEDED and self.kind == other.kind and None not in (self.seed, other.seed):
            if self.seed != other.seed:
                return f"{self} {self.seed}", f"{other} {other.seed}"
            return None
        names = dict(self.names)
        for name, value in other.names:
            if names.get(name, value) != value:
                return f"{name} {names[name]}", f"{name} {value}"
        return None


def names_in(provenance: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """The entries of a provenance that identify the culture."""
    # Names that differ only in white space are the same.
    known = ((name, " ".join(provenance.get(name, "").split())) for name in NAMES)
    return tuple((name, value) for name, value in known if value.lower() not in _NAMELESS)


def culture_of_series(cultures: Iterable[RecordedCulture | None]) -> RecordedCulture | None:
    """The culture of several recordings, with what any of them states; of different ones, what the first states."""
    known = [culture for culture in cultures if culture is not None]
    if not known:
        return None
    known = [culture for culture in known if not known[0].difference(culture)]
    # In reverse, so that the names that the first one states prevail.
    values = {name: value for culture in reversed(known) for name, value in culture.names}
    names = tuple((name, values[name]) for name in NAMES if name in values)
    return replace(next((culture for culture in known if culture.kind), known[0]), names=names)
