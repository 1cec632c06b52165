"""A tissue's state at one time, and whether a tissue can reach it.

The compiled kernel checks no index and no clock: its arguments must have been checked before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from animat.cultures.tissue.arrays import State, Wiring
from animat.cultures.tissue.coupling import Kicks
from animat.cultures.tissue.parameters import TissueParameters
from animat.errors import InvalidArgument, shown

LONGEST_NS = 366 * 86_400 * 1_000_000_000
"""A tissue's clock runs for up to a year: its slow drift is computed from the start."""
KICKS_WITHIN_NS = 1_000_000_000
"""Pending kicks arrive within this time: axons are shorter."""
LARGEST = 1e6
"""No potential (mV) and no conductance (in units of the leak) comes near it."""
_SHARES = ("x", "u", "available", "load", "missing")


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The state of a tissue at one time, made by `Tissue.snapshot`, for tissues of the same seed and parameters."""

    seed: int
    parameters: TissueParameters
    now_ns: int
    step: int
    kicks: Kicks
    state: State


def expect_sound(snapshot: Snapshot, like: State, wiring: Wiring, step_ns: int) -> None:
    """Refuse a snapshot whose clock, shapes, indices or values no tissue can have.

    Args:
        snapshot: to be restored.
        like: a state of the same tissue, whose shapes and types the snapshot's must have.
        wiring: of the tissue.
        step_ns: its time step.

    Raises:
        InvalidArgument: naming the number or the array.
    """
    expect_whole("tissue_now_ns", snapshot.now_ns, 0, LONGEST_NS)
    step = snapshot.now_ns // step_ns
    expect_whole("tissue_step", snapshot.step, step, step)
    for name, values in snapshot.state._asdict().items():
        expect_array(name, values, getattr(like, name).dtype, getattr(like, name).shape)
        if values.dtype.kind == "f":
            # Rounding may take a share past its limit by a last bit.
            low, high = (-1e-9, 1 + 1e-9) if name in _SHARES else (-LARGEST, LARGEST)
            expect_within(name, values, low, high)
    for name in ("arriving_ampa", "arriving_nmda", "arriving_gaba"):
        # The kernel records each target once: arrivals that cancel out would be recorded twice.
        expect_within(name, getattr(snapshot.state, name), 0.0, LARGEST)
    alone = (snapshot.state.arriving_nmda > 0) & (snapshot.state.arriving_ampa == 0)
    if alone.any():
        raise InvalidArgument(
            f"arriving_nmda: expected NMDA to arrive with AMPA, got {int(alone.sum())} arrivals without"
        )
    expect_within("refractory", snapshot.state.refractory, 0, int(wiring.refractory_steps.max(initial=0)))
    for name in ("last_spike", "last_scaled", "last_driven"):
        expect_within(name, getattr(snapshot.state, name), 0, step)
    # A tissue that never spikes approaches the rest value, 1.13 with the default parameters.
    expect_within("scaling", snapshot.state.scaling, 0.0, snapshot.parameters.scaling_rest * (1 + 1e-9))
    for name, values in snapshot.kicks._asdict().items():
        expect_array(f"kicks.{name}", values, np.float32 if name == "mv" else np.int64, (len(snapshot.kicks.step),))
    expect_within("kicks.neuron", snapshot.kicks.neuron, 0, len(wiring.needed) - 1)
    expect_within("kicks.mv", snapshot.kicks.mv, -LARGEST, LARGEST)
    expect_within("kicks.step", snapshot.kicks.step, step, step + KICKS_WITHIN_NS // step_ns)
    expect_rising("kicks.step", snapshot.kicks.step)


def expect_whole(name: str, value: object, low: int, high: int) -> None:
    """Refuse anything but a whole number from `low` to `high`."""
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        expected = f"{low}" if low == high else f"a whole number from {low} to {high}"
        raise InvalidArgument(f"{name}: expected {expected}, got {shown(value)}")


def expect_array(name: str, values: np.ndarray[Any, Any], dtype: Any, shape: tuple[int, ...]) -> None:
    """Refuse an array of another type or shape."""
    if values.dtype != dtype or values.shape != shape:
        raise InvalidArgument(
            f"{name}: expected {np.dtype(dtype)} of shape {shape}, got {values.dtype} of shape {values.shape}"
        )


def expect_within(name: str, values: np.ndarray[Any, Any], low: float, high: float) -> None:
    """Refuse values, NaN among them, that do not lie from `low` to `high`."""
    outside = ~((values >= low) & (values <= high))
    if outside.any():
        raise InvalidArgument(f"{name}: expected values from {low:g} to {high:g}, got {values[outside].flat[0]}")


def expect_rising(name: str, values: np.ndarray[Any, Any]) -> None:
    """Refuse values that are not in ascending order."""
    if np.any(np.diff(values) < 0):
        raise InvalidArgument(f"{name}: expected values in ascending order, got some that fall")
