"""The history state: what neurons remember, as two numbers."""

from __future__ import annotations

AT_FIRST = (0.5, 0.5)
"""Trace and load that an episode begins with: its warm-up was presented in random order, as in a recording.

The trace is of what was answered just before, from 0 to 1; the load of what was presented in the seconds before, 0 or
more. Both are 0 after silence (`animat.neurons.memory`).
"""
