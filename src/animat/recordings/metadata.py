"""What a file keeps about a recording in addition to its arrays: text by key."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, get_args

from animat.errors import InvalidArgument
from animat.recordings.findings import Finding, Severity
from animat.recordings.recorded_culture import RecordedCulture, names_in
from animat.recordings.recording import Recording
from animat.records import json_data, read_record
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import Pulse

LIKE_A_DATE = "an ISO 8601 date such as 2024-05-31T14:00:00+09:00"
_VALUES = "values of findings"
"""The key of the findings' values, as JSON by the keys of their messages."""
_LOOP_PULSE = "closed_loop_pulse"
_AGAIN = " #"
"""Between the key of a finding and its number where several have the same severity and name."""


def to_metadata(recording: Recording) -> dict[str, str]:
    """The provenance, and the fields that `from_metadata` restores; refuses what would be read back as another."""
    metadata = dict(recording.provenance)
    if reserved := [key for key in metadata if key in ("protocol", _VALUES, _LOOP_PULSE) or _is_finding(key)]:
        raise InvalidArgument(f"provenance: expected no key of a file's protocol or findings, got {reserved[0]!r}")
    if _nameless(culture := culture_of(metadata)) != _nameless(recording.culture):
        raise InvalidArgument(f"culture: expected {culture!r} by the provenance's source, got {recording.culture!r}")
    if (recorded_at := recording.recorded_at) is not None and recorded_at != (stated := date_of(metadata)):
        if stated is not None:
            raise InvalidArgument(f"recorded_at: expected {stated} by the provenance, got {recorded_at}")
        metadata["recorded_at"] = recorded_at.isoformat()
    if recording.protocol is not None:
        metadata["protocol"] = recording.protocol.to_json()
    if recording.loop_pulse is not None:
        metadata[_LOOP_PULSE] = json.dumps(recording.loop_pulse.to_list())
    findings: dict[str, Finding] = {}
    for finding in recording.findings:
        key = f"{finding.severity}: {finding.name}"
        same = sum(each.partition(_AGAIN)[0] == key for each in findings)
        findings[f"{key}{_AGAIN}{same + 1}" if same else key] = finding
    if values := {key: finding.value for key, finding in findings.items() if finding.value is not None}:
        metadata[_VALUES] = json.dumps(values)
    return metadata | {key: finding.message for key, finding in findings.items()}


def from_metadata(metadata: Mapping[str, str]) -> dict[str, Any]:
    """Fields of a recording, from its `provenance` to its date; refuses what is no protocol or no number."""
    provenance, findings, protocol, pulse = dict[str, str](), list[Finding](), None, None
    values = read_record(dict[str, float], json_data(metadata.get(_VALUES, "{}"), _VALUES), _VALUES)
    for key, text in metadata.items():
        if key == "protocol":
            protocol = Protocol.from_json(text)
        elif key == _LOOP_PULSE:
            pulse = Pulse.from_list(json_data(text, _LOOP_PULSE))
        elif _is_finding(key):
            first = key.partition(_AGAIN)[0]
            severity, _, name = (first if first in metadata else key).partition(": ")
            findings.append(Finding(name, severity, text, values.get(key)))  # type: ignore[arg-type]
        elif key != _VALUES:
            provenance[key] = text
    origin = {"culture": culture_of(metadata), "recorded_at": date_of(metadata)}
    delivered = {"protocol": protocol, "loop_pulse": pulse}
    return {"provenance": provenance, **delivered, "findings": tuple(findings), **origin}


def _nameless(culture: RecordedCulture | None) -> RecordedCulture | None:
    """A culture without its names, which may have been added to the provenance since it was read."""
    return None if culture is None or culture.kind is None else replace(culture, names=())


def _is_finding(key: str) -> bool:
    severity, colon, _ = key.partition(": ")
    return bool(colon) and severity in get_args(Severity)


_KINDS = {
    "virtual culture": ("virtual", "seed"),
    "CL1": ("cl1", "pattern_seed"),
    "MaxOne": ("maxone", ""),
    "replay of recordings": ("replay", ""),
    "synthetic": ("synthetic", "seed"),
    "made up": ("synthetic", "seed"),
}
"""By how the source in a file begins, the kind of culture and the key of its seed; the last is of earlier files."""
_OURS = " by animat.cultures."
"""In the source of animat's own recordings; the source of any other is the name of its file, which may begin alike."""


def culture_of(metadata: Mapping[str, str]) -> RecordedCulture | None:
    """The culture that a file's provenance states; None if it states nothing."""
    source, names = metadata.get("source", ""), names_in(metadata)
    for beginning, (kind, key) in _KINDS.items():
        if source.startswith(beginning):
            seed = metadata.get(key, "")
            known = int(seed) if seed.isdecimal() and len(seed) <= 20 else None
            if known is not None or _OURS in source:
                return RecordedCulture(kind, known, kind == "cl1" and "simulator" in source, names)
    return RecordedCulture(names=names) if names else None


def date_of(metadata: Mapping[str, str]) -> datetime | None:
    """When a recording began, as its provenance states it, or None; a date without a time zone is taken as UTC."""
    try:
        date = datetime.fromisoformat(metadata.get("recorded_at", ""))
    except ValueError:
        return None
    return date if date.tzinfo else date.replace(tzinfo=UTC)
