"""A tissue's state at one time, and whether a tissue can reach it: the kernel checks neither indices nor clocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from animat.cultures.tissue.coupling import Kicks
from animat.cultures.tissue.kernel import TissueState, Wiring
from animat.cultures.tissue.parameters import TissueParameters
from animat.errors import InvalidArgument, shown

LONGEST_NS = 366 * 86_400 * 1_000_000_000
"""A tissue's clock runs for up to a year: its slow drift is computed from the start."""
KICKS_WITHIN_NS = 1_000_000_000
"""Pending kicks arrive within this time: axons are shorter."""
LARGEST = 1e6
"""No potential (mV) and no conductance (in units of the leak) comes near it."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The state of a tissue at one time, made by `Tissue.snapshot`, for tissues of the same seed and parameters."""

    seed: int
    parameters: TissueParameters
    now_ns: int
    step: int
    kicks: Kicks
    state: TissueState


def expect_sound(snapshot: Snapshot, like: TissueState, wiring: Wiring, step_ns: int) -> None:
    """Refuse a snapshot with a clock, shapes, indices or values that no tissue can have; `like` is such a state."""
    expect_whole("tissue_now_ns", snapshot.now_ns, 0, LONGEST_NS)
    step = snapshot.now_ns // step_ns
    expect_whole("tissue_step", snapshot.step, step, step)
    state, kicks = snapshot.state, snapshot.kicks
    ranges: dict[str, tuple[float, float]] = {
        # Rounding may take a share past its limit by a last bit.
        **dict.fromkeys(("x", "u", "available", "load", "missing"), (-1e-9, 1 + 1e-9)),
        # The kernel records each target once: arrivals that cancel out would be recorded twice.
        **dict.fromkeys(("arriving_ampa", "arriving_nmda", "arriving_gaba"), (0.0, LARGEST)),
        **dict.fromkeys(("last_spike", "last_scaled", "last_driven"), (0, step)),
        "refractory": (0, int(wiring.refractory_steps.max(initial=0))),
        # A tissue that never spikes approaches the rest value, 1.13 with the default parameters.
        "scaling": (0.0, snapshot.parameters.scaling_rest * (1 + 1e-9)),
    }
    for name, values in state._asdict().items():
        expected = getattr(like, name)
        expect_array(name, values, expected.dtype, expected.shape, ranges.get(name, (-LARGEST, LARGEST)))
    if alone := np.count_nonzero((state.arriving_nmda > 0) & (state.arriving_ampa == 0)):
        raise InvalidArgument(f"arriving_nmda: expected NMDA to arrive with AMPA, got {alone} arrivals without")
    one_each = (len(kicks.step),)
    expect_array("kicks.step", kicks.step, np.int64, one_each, (step, step + KICKS_WITHIN_NS // step_ns))
    expect_array("kicks.neuron", kicks.neuron, np.int64, one_each, (0, len(wiring.needed) - 1))
    expect_array("kicks.mv", kicks.mv, np.float32, one_each, (-LARGEST, LARGEST))
    expect_rising("kicks.step", kicks.step)


def expect_whole(name: str, value: object, low: int, high: int) -> None:
    """Refuse anything but a whole number from `low` to `high`."""
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        expected = f"{low}" if low == high else f"a whole number from {low} to {high}"
        raise InvalidArgument(f"{name}: expected {expected}, got {shown(value)}")


def expect_array(
    name: str, values: np.ndarray[Any, Any], dtype: Any, shape: tuple[int, ...], within: tuple[float, float]
) -> None:
    """Refuse an array of another type or shape, or with values, NaN among them, outside a range."""
    if values.dtype != dtype or values.shape != shape:
        expected = f"{np.dtype(dtype)} of shape {shape}"
        raise InvalidArgument(f"{name}: expected {expected}, got {values.dtype} of shape {values.shape}")
    low, high = within
    outside = ~((values >= low) & (values <= high))
    if outside.any():
        raise InvalidArgument(f"{name}: expected values from {low:g} to {high:g}, got {values[outside].flat[0]}")


def expect_rising(name: str, values: np.ndarray[Any, Any]) -> None:
    """Refuse values that are not in ascending order."""
    if np.any(np.diff(values) < 0):
        raise InvalidArgument(f"{name}: expected values in ascending order, got some that fall")
