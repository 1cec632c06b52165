"""What was noticed about data: reported to the user, never swallowed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

from animat.errors import did_you_mean

Severity = Literal["note", "warning", "refuse"]

_FEW_IS_BAD = ("few-samples", "no-difference", "readouts-alike")


@dataclass(frozen=True)
class Finding:
    """One thing noticed about a recording or its responses, in one sentence.

    Attributes:
        name: a short fixed name, by which tests and programs know it (`"dead-window"`).
        severity: `"note"`, worth knowing; `"warning"`, results may mislead; `"refuse"`, training on it makes no sense
            unless the user says otherwise.
        message: what was found, what it means and what to do, for people.
        value: the number behind it, if there is one.
        at_min: start of the recording that it is of, among those of several; None elsewhere.
    """

    name: str
    severity: Severity
    message: str
    value: float | None = None
    at_min: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """What it says, as plain data."""
        return {"name": self.name, "severity": self.severity, "message": self.message}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """From all its attributes by their names, as a file has them."""
        # Files of before have a sentence.
        return cls(**{"message" if name == "sentence" else name: value for name, value in data.items()})


def left_out_of(what: str, names: Sequence[str], file: str = "", missing: Sequence[str] = ()) -> Finding:
    """The finding on keys or columns of a file that nobody knows, each with the missing one that it is near to."""
    told = ", ".join(f"{name} ({near[2:]})" if (near := did_you_mean(name, missing)) else name for name in names)
    message = f"{what}{f' of {file}' if file else ''} that are not known were left out: {told}"
    return Finding(f"{what}-left-out", "note", message, float(len(names)))


def merged(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Those of one name and severity as one, with the sentences of all: as they are kept with a recording."""
    messages: dict[tuple[str, Severity], str] = {}
    for finding in findings:
        key = finding.name, finding.severity
        messages[key] = f"{messages[key]}; {finding.message}" if key in messages else finding.message
    return tuple(Finding(*key, message) for key, message in messages.items())


def warnings_once(findings: Sequence[Finding]) -> Iterator[str]:
    """What all but notes say; what is found in several recordings once, where it is worst, with how many others."""
    warnings: dict[str, list[Finding]] = {}
    for finding in findings:
        if finding.severity != "note":
            warnings.setdefault(finding.name, []).append(finding)
    for name, alike in warnings.items():
        # The number that is farthest from 0, or the nearest where few is bad.
        sizes = [abs(finding.value or 0.0) for finding in alike]
        worst = alike[sizes.index(min(sizes) if name in _FEW_IS_BAD else max(sizes))]
        yield worst.message + (f" (and {len(alike) - 1} more like it)" if len(alike) > 1 else "")
