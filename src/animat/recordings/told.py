"""A recording told: in words by their keys, as a file has it beside its arrays, and all of it in bytes."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, get_args

import numpy as np

from animat.recordings.findings import Finding, Severity
from animat.recordings.recording import RecordedCulture, Recording
from animat.stimulation.protocol import Protocol


def in_words(recording: Recording) -> dict[str, str]:
    """What a file keeps: the provenance, and the fields that `from_words` takes back out."""
    words = dict(recording.provenance)
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
        severity, colon, name = key.partition(": ")
        if key == "protocol":
            protocol = Protocol.from_json(message)
        elif colon and severity in get_args(Severity):
            findings.append(Finding(name, severity, message))  # type: ignore[arg-type]
        else:
            provenance[key] = message
    culture = None
    for kind, begins, seed in (("virtual", "virtual culture", "seed"), ("cl1", "CL1", "pattern_seed")):
        if words.get("source", "").startswith(begins) and words.get(seed, "").isdecimal() and len(words[seed]) <= 20:
            culture = RecordedCulture(kind, int(words[seed]))
    return {"provenance": provenance, "protocol": protocol, "culture": culture, "findings": tuple(findings)}


def packed(recording: Recording) -> bytes:
    """All of a recording as bytes, the same for recordings that are equal."""
    arrays = {name: getattr(recording, name) for name in ("spike_times_s", "spike_channels")}
    for name, table in (("channels", recording.channels), ("stimuli", recording.stimuli)):
        arrays |= {f"{name}_{field.name}": getattr(table, field.name) for field in fields(table)}
    numbers = ("sampling_rate_hz", "start_s", "duration_s", "start_min")
    words = {
        "numbers": {name: float(getattr(recording, name)) for name in numbers},
        "presentation": None if recording.presentation is None else asdict(recording.presentation),
        "told": list(in_words(recording).items()),
    }
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, words=np.frombuffer(json.dumps(words).encode(), np.uint8), **arrays)
    return buffer.getvalue()
