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
            f"culture: expected the one that source and seed of the provenance tell, {culture}, got {recording.culture}"
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


def _culture_of(words: Mapping[str, str]) -> RecordedCulture | None:
    for kind, begins, seed in (("virtual", "virtual culture", "seed"), ("cl1", "CL1", "pattern_seed")):
        if words.get("source", "").startswith(begins) and words.get(seed, "").isdecimal() and len(words[seed]) <= 20:
            return RecordedCulture(kind, int(words[seed]))
    return None
