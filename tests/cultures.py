"""A small virtual culture that is quick to grow and scan, for tests."""

from __future__ import annotations

from typing import Any

from animat.cultures.tissue import TissueParameters
from animat.cultures.virtual import VirtualCulture
from animat.stimulation.selection import SelectionRule

FEW = TissueParameters(neurons=300, in_degree_e=30, in_degree_i=15)
RULE = SelectionRule(recording_sites=150, stimulation_sites=16, patterns=20)


def small_culture(seed: int = 1, **settings: Any) -> VirtualCulture:
    """300 neurons; opening it takes a few tenths of a second."""
    return VirtualCulture(seed, **({"parameters": FEW, "rule": RULE, "scan_s": 1.0} | settings))
