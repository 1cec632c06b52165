"""What was noticed about data: reported to the user, never swallowed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["note", "warning", "refuse"]


@dataclass(frozen=True)
class Finding:
    """One thing noticed about a recording or its responses, in one sentence.

    Attributes:
        name: a short fixed name, by which tests and programs know it (`"dead-window"`).
        severity: `"note"`, worth knowing; `"warning"`, results may mislead; `"refuse"`, training on it makes no sense
            unless the user says otherwise.
        sentence: what was found, what it means and what to do, for people.
        value: the number behind it, if there is one.
    """

    name: str
    severity: Severity
    sentence: str
    value: float | None = None
