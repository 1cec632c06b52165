"""What a line of text beside a stimulus says about it: how animat's drivers keep its parameters in a rig's file.

A rig's own file knows when a pulse was and perhaps where, not at which frequency it was presented or which presentation
it ends. animat writes one JSON object a pulse (MaxWell: the event's message; CL1: an entry of the data stream
`animat_stimuli`), of which every key is optional:

    {"frequency_hz": 20, "pattern": 3, "presentation": 17, "electrodes": [909, 23923], "order": "mixed", "pulses": 5}

Text by others in the manner of `frequency 20 electrode 909` or `frequency_hz=20` is understood for the same names.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from animat.tables import UNKNOWN, padded

LONGEST = 4096
"""Characters of a line; what is longer says nothing that is understood here."""
NAMES = {name: name for name in ("frequency_hz", "pattern", "presentation", "electrodes", "order", "pulses")}
NAMES |= {"frequency": "frequency_hz", "freq": "frequency_hz", "electrode": "electrodes"}
_MOST_ELECTRODES = 1024
_PAIR = re.compile(r"([A-Za-z_]+)\s*[=:\s]\s*(-?[\d.]+(?:[,+]\d+)*)")


def said(text: str) -> dict[str, Any]:
    """What one line says, by our names; nothing where it says nothing that is understood."""
    text = text.strip()
    if not text or len(text) > LONGEST:
        return {}
    words: dict[str, Any] = {}
    if text.startswith("{"):
        try:
            read = json.loads(text)
        except (ValueError, RecursionError):
            return {}
        words = {NAMES[key]: value for key, value in read.items() if key in NAMES}
    else:
        for key, value in _PAIR.findall(text):
            name = NAMES.get(key.lower())
            if name == "electrodes":
                words[name] = [int(number) for number in re.findall(r"\d{1,9}", value)]
            elif name:
                words[name] = value
    return words


def stimulus_columns(lines: Sequence[str]) -> dict[str, Any]:
    """The columns of `PlainColumns` that the lines of all pulses give together, one line a pulse.

    A column that no line speaks of is left out; so is a presentation that only some name: it would be guessed.
    """
    read = [said(line) for line in lines]
    columns: dict[str, Any] = {}
    frequency = np.array([_number(words.get("frequency_hz")) for words in read], dtype=np.float64)
    frequency[~(frequency > 0)] = np.nan
    if np.any(~np.isnan(frequency)):
        columns["stimulus_frequency_hz"] = frequency
    pattern = np.array([_whole(words.get("pattern")) for words in read], dtype=np.int64)
    if np.any(pattern != UNKNOWN):
        columns["stimulus_pattern"] = pattern
    presentation = np.array([_whole(words.get("presentation")) for words in read], dtype=np.int64)
    # One number for all is what a pulse has that belongs to no presentation in particular.
    has_presentation = bool(np.all(presentation != UNKNOWN)) and len(np.unique(presentation)) > 1
    if has_presentation:
        # Numbers can begin anew in the middle of a file: what counts is where they change.
        columns["stimulus_presentation"] = np.cumsum(np.diff(presentation, prepend=presentation[0]) != 0)
    electrodes = [_electrodes(words.get("electrodes")) for words in read]
    if any(electrodes):
        columns["stimulus_electrodes"] = padded(electrodes)
    orders = {order if isinstance(order := words.get("order"), str) else None for words in read}
    pulses = {_whole(words.get("pulses")) for words in read}
    if len(orders) == 1 and orders <= {"blocked", "mixed"}:
        n_pulses = next(iter(pulses)) if len(pulses) == 1 else UNKNOWN
        if n_pulses == 1 or (n_pulses > 1 and has_presentation):
            columns |= {"presentation_order": next(iter(orders)), "presentation_pulses": n_pulses}
    return columns


def _number(value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def _whole(value: Any) -> int:
    number = _number(value)
    return int(number) if 0 <= number < 2**53 and number == round(number) else UNKNOWN


def _electrodes(value: Any) -> list[int]:
    values = value if isinstance(value, list) else [value]
    numbers = [_whole(number) for number in values[:_MOST_ELECTRODES]]
    return [number for number in numbers if number != UNKNOWN]
