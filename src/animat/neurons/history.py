"""The history state: what neurons remember, as numbers."""

from __future__ import annotations

from animat.robots.base import Quantity

HISTORY_SPEC = (Quantity("trace", "1", 1.0, 0.0, 1.0), Quantity("load", "1", 1.0, 0.0))
"""The trace of what was answered just before, and the load of the seconds before; both are 0 after silence."""

AT_FIRST = (0.5, 0.5)
"""The history state that an episode begins with: its warm-up was presented in random order, as in a recording."""
