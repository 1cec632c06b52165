"""What a recording tells of itself in words, by their keys, as a file has it beside its arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

from animat.errors import InvalidArgument
from animat.recordings.findings import Finding, Severity
from animat.recordings.recording import RecordedCulture, Recording
from animat.stimulation.protocol import Protocol


def in_words(recording: Recording) -> dict[str, str]:
    """What a file keeps: the provenance, and the fields that `from_words` takes back out.

    Raises:
        InvalidArgument: for a provenance that a file would be read back from as something else.
    """
    words = dict(recording.provenance)
    if taken := [key for key in words if key == "protocol" or _is_finding(key)]:
        raise InvalidArgument(
            f"provenance: expected other keys than those of protocol and findings in a file, got {taken[0]!r}"
        )
    if (culture := _culture_of(words)) != recording.culture:
        raise InvalidArgument(
            f"culture: expected that of the provenance's source and seed, {culture!r}, got {recording.culture!r}"
        )
    if recording.protocol is not None:
        words["protocol"] = recording.protocol.to_json()
    return words | {f"{finding.severity}: {finding.name}": finding.message for finding in recording.findings}


def from_words(words: Mapping[str, str]) -> dict[str, Any]:
    """A recording's `provenance`, `protocol`, `culture` and `findings`, from the words of a file.

    Raises:
        InvalidArgument: for a protocol that is none.
    """
    provenance, findings, protocol = dict[str, str](), list[Finding](), None
    for key, message in words.items():
        if key == "protocol":
            protocol = Protocol.from_json(message)
        elif _is_finding(key):
            severity, _, name = key.partition(": ")
            findings.append(Finding(name, severity, message))  # type: ignore[arg-type]
        else:
            provenance[key] = message
    culture = _culture_of(words)
    return {"provenance": provenance, "protocol": protocol, "culture": culture, "findings": tuple(findings)}


def _is_finding(key: str) -> bool:
    severity, colon, _ = key.partition(": ")
    return bool(colon) and severity in get_args(Severity)


_KINDS = {
    "virtual culture": ("virtual", "seed"),
    "CL1": ("cl1", "pattern_seed"),
    "MaxOne by animat": ("maxone", ""),
    "replay of recordings": ("replay", ""),
}
"""Of each culture the words that its source begins with, as a file has it: its kind, and the key of its seed."""


def _culture_of(words: Mapping[str, str]) -> RecordedCulture | None:
    source = words.get("source", "")
    for begins, (kind, key) in _KINDS.items():
        if source.startswith(begins):
            seed = words.get(key, "")
            known = int(seed) if seed.isdecimal() and len(seed) <= 20 else None
            return RecordedCulture(kind, known, kind == "cl1" and "simulator" in source)
    return None
