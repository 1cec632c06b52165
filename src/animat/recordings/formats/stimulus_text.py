"""Parses the text that accompanies a stimulus in a rig's file, in which animat's drivers store its parameters.

    {"frequency_hz": 20, "pattern": 3, "presentation": 17, "electrodes": [909, 23923], "order": "mixed", "pulses": 5}

Every key is optional. Text of other programs is parsed for the same names: `frequency 20 electrode 909`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from animat.stimulation.stimulus import Stimulus
from animat.tables import UNKNOWN, padded

LONGEST = 4096
"""Most characters of a line; longer lines are ignored."""
NAMES = {name: name for name in ("frequency_hz", "pattern", "presentation", "electrodes", "order", "pulses")}
NAMES |= {"frequency": "frequency_hz", "freq": "frequency_hz", "electrode": "electrodes"}
_MOST_ELECTRODES = 1024
_PAIR = re.compile(r"(?i)([a-z_]+)\s*[=:\s]\s*(-?[\d.]+(?:e[+-]?\d+)?(?:[,+]\d+)*)((?:[,;+\s]+\d+(?![.\w]))*)")
"""A name and its value; and whole numbers that follow, which belong to it if it is `electrodes`."""


def parameters_of(stimulus: Stimulus) -> dict[str, Any]:
    """The parameters of a stimulus that a rig's own file lacks, as far as they are known."""
    known: dict[str, Any] = {"electrodes": list(stimulus.electrodes), "presentation": stimulus.presentation}
    if math.isfinite(stimulus.frequency_hz):
        known["frequency_hz"] = stimulus.frequency_hz
    if stimulus.pattern >= 0:
        known["pattern"] = stimulus.pattern
    return known


def parse_line(text: str) -> dict[str, Any]:
    """The parameters in one line, under our names; empty if there are none."""
    text = text.strip()
    if not text or len(text) > LONGEST:
        return {}
    parameters: dict[str, Any] = {}
    if text.startswith("{"):
        try:
            read = json.loads(text)
        except (ValueError, RecursionError):
            return {}
        parameters = {NAMES[key]: value for key, value in read.items() if key in NAMES}
    else:
        for key, value, more in _PAIR.findall(text):
            name = NAMES.get(key.lower())
            if name == "electrodes":
                listed = f"{value} {more}" if key.lower() == name else value
                parameters[name] = [*parameters.get(name, ()), *re.split(r"[,;+\s]+", listed.strip())]
            elif name:
                parameters[name] = value
    return parameters


def stimulus_columns(lines: Sequence[str]) -> dict[str, Any]:
    """The columns of `PlainColumns` from the lines of all pulses, one line per pulse.

    A column that is in no line is left out; so are presentations that are not in all, as the others would be guesses.
    """
    pulses = [parse_line(line) for line in lines]
    columns: dict[str, Any] = {}
    frequency = np.array([_number(pulse.get("frequency_hz")) for pulse in pulses], dtype=np.float64)
    frequency[~(frequency > 0)] = np.nan
    if np.any(~np.isnan(frequency)):
        columns["stimulus_frequency_hz"] = frequency
    pattern = np.array([_whole(pulse.get("pattern")) for pulse in pulses], dtype=np.int64)
    if np.any(pattern != UNKNOWN):
        columns["stimulus_pattern"] = pattern
    counts = {_whole(pulse.get("pulses")) for pulse in pulses}
    n_pulses = next(iter(counts)) if len(counts) == 1 else UNKNOWN
    presentation = np.array([_whole(pulse.get("presentation")) for pulse in pulses], dtype=np.int64)
    # If trials are not known, all pulses have the same number and state no pulses per trial.
    is_numbered = len(np.unique(presentation)) > 1 or n_pulses > 1
    has_presentation = is_numbered and bool(np.all(presentation != UNKNOWN))
    if has_presentation:
        # Numbers may restart in the middle of a file: what counts is where they change, and how many are alike.
        rows = np.arange(len(presentation))
        begins = np.diff(presentation, prepend=presentation[0]) != 0
        since = rows - np.maximum.accumulate(np.where(begins, rows, 0))
        again = (since > 0) & (since % n_pulses == 0) if n_pulses > 1 else False
        columns["stimulus_presentation"] = np.cumsum(begins | again)
    electrodes = [_electrodes(pulse.get("electrodes")) for pulse in pulses]
    if any(electrodes):
        columns["stimulus_electrodes"] = padded(electrodes)
    orders = {order if isinstance(order := pulse.get("order"), str) else None for pulse in pulses}
    is_ordered = len(orders) == 1 and orders <= {"blocked", "mixed"}
    if is_ordered and (n_pulses == 1 or (n_pulses > 1 and has_presentation)):
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
