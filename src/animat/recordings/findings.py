"""Findings: what was noticed in data, always reported to the user."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

from animat.errors import did_you_mean

Severity = Literal["note", "warning", "refuse"]

_FEW_IS_BAD = ("few-samples", "no-difference", "readouts-alike")


@dataclass(frozen=True)
class Finding:
    """One observation about a recording or its responses, in one sentence.

    Attributes:
        name: a short fixed name by which tests and programs identify it (`"dead-window"`).
        severity: `"note"`, worth knowing; `"warning"`, results may mislead; `"refuse"`, training makes no sense unless
            the user allows it.
        message: for people: what was found, what it means and what to do.
        value: the number behind it, if there is one.
        at_min: start of the recording it concerns, when there are several; otherwise None.
    """

    name: str
    severity: Severity
    message: str
    value: float | None = None
    at_min: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Name, severity and message as plain data."""
        return {"name": self.name, "severity": self.severity, "message": self.message}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """From its attributes by name, as stored in a file."""
        # Older files have a sentence.
        return cls(**{"message" if name == "sentence" else name: value for name, value in data.items()})


def left_out_findings(
    what: str, names: Sequence[str], file: str = "", missing: Sequence[str] = ()
) -> tuple[Finding, ...]:
    """The finding on keys or columns of a file that are unknown, or missing as they cannot be read, if there are any.

    Each unknown one is listed with the missing one whose name is similar.
    """
    if not names:
        return ()
    whys = ["cannot have such values" if name in missing else did_you_mean(name, missing)[2:] for name in names]
    listed = ", ".join(f"{name} ({why})" if why else name for name, why in zip(names, whys, strict=True))
    kind = what if any(name in missing for name in names) else f"unknown {what}"
    message = f"{kind}{f' of {file}' if file else ''} were left out: {listed}"
    return (Finding(f"{what}-left-out", "note", message, float(len(names))),)


def merged(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings with the same name and severity merged into one with all their messages, as a recording keeps them.

    Several have no value of their own: a sum would be wrong for times and shares.
    """
    kept: dict[tuple[str, Severity], Finding] = {}
    for finding in findings:
        key = finding.name, finding.severity
        kept[key] = Finding(*key, f"{kept[key].message}; {finding.message}") if key in kept else finding
    return tuple(kept.values())


def without_notes(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings of severity warning or refuse."""
    return tuple(finding for finding in findings if finding.severity != "note")


def warnings_once(findings: Sequence[Finding]) -> Iterator[str]:
    """Name and message of all but notes; if several recordings have the same one, its worst, with how many others."""
    warnings: dict[str, list[Finding]] = {}
    for finding in without_notes(findings):
        warnings.setdefault(finding.name, []).append(finding)
    for name, same in warnings.items():
        # The value farthest from 0, or the nearest where small values are bad.
        sizes = [abs(finding.value or 0.0) for finding in same]
        worst = same[sizes.index(min(sizes) if name in _FEW_IS_BAD else max(sizes))]
        yield f"{name}: {worst.message}" + (f" (and {len(same) - 1} more like it)" if len(same) > 1 else "")
