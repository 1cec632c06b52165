"""From a response to a motor command: thresholds at percentiles of the responses, or a line between their extremes."""

from __future__ import annotations

import abc
from dataclasses import dataclass, is_dataclass
from typing import Any, TypeAlias, TypeVar, final

import numpy as np

from animat.errors import InvalidArgument
from animat.registry import Registry, is_ours

N_PERCENTILES = 11
"""P0 (the smallest response), P10, ..., P90, P100 (the largest), which every mapping receives."""

Numbers: TypeAlias = Any
"""A number, or a numpy or JAX array: the commands have the same kind and shape."""


class Mapping(abc.ABC):
    """Turns a response x into a motor command u in [-1, 1], given the percentiles of the non-burst responses.

    The same code runs on numpy and JAX arrays, also under `jit` and `vmap`, and does not import JAX.
    Implementations are frozen dataclasses: two mappings are equal if they compute the same.
    """

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """The name that `mapping_named` knows it by; in a custom class a plain attribute, `name = "steep"`."""

    @abc.abstractmethod
    def command(self, x: Numbers, percentiles: Numbers) -> Numbers:
        """The motor command for the response `x`.

        Args:
            x: firing rate per channel in the response window, in Hz, any shape.
            percentiles: P0, P10, ..., P100 of the non-burst responses of all conditions together, in Hz, rising,
                shape (11,).

        Returns:
            u in [-1, 1], never falling as x rises, in the shape of `x`.
        """


@final
@dataclass(frozen=True)
class Thresholds(Mapping):
    """Commands in steps, with thresholds at percentiles of the responses; a response on a threshold is above it.

        1 threshold:   u = +1 if x >= P50, else -1
        9 thresholds:  P10 ... P90 divide the axis into ten; u = -1.0, -0.8, -0.6, -0.4, -0.2, +0.2, ..., +1.0

    There is no zero among the ten: the published end points and step leave it out. If percentiles are tied (many equal
    responses), a response on the tie passes all of them at once, and the commands in between never occur.

    Raises:
        InvalidArgument: for a `count` other than 1 and 9.

    Source: Sawada et al. 2022, the mappings with 1 and 9 thresholds.
    """

    count: int

    def __post_init__(self) -> None:
        if type(self.count) is not int or self.count not in (1, 9):
            raise InvalidArgument(f"count: expected 1 or 9 thresholds, got {self.count!r}")

    @property
    def name(self) -> str:
        """`1-threshold` or `9-thresholds`."""
        return "1-threshold" if self.count == 1 else f"{self.count}-thresholds"

    @property
    def levels(self) -> tuple[float, ...]:
        """The possible commands, rising; one more than there are thresholds."""
        half = (self.count + 1) // 2
        return tuple(n / half for n in range(-half, half + 1) if n != 0)

    @property
    def percentile_indices(self) -> tuple[int, ...]:
        """Which of the eleven percentiles are the thresholds, rising."""
        return (5,) if self.count == 1 else tuple(range(1, 10))

    def command(self, x: Numbers, percentiles: Numbers) -> Numbers:
        """The level of the interval between thresholds in which `x` lies (see `Mapping.command`)."""
        half = (self.count + 1) // 2
        # Starts with a whole number, as numpy booleans would add up to a boolean.
        n_passed = sum((x >= percentiles[i] for i in self.percentile_indices), start=0)
        # The middle threshold is a step of two, over the zero. Dividing whole numbers rounds each level to the nearest
        # float, so numpy and JAX agree.
        return (n_passed - half + (x >= percentiles[5])) / half


@final
@dataclass(frozen=True)
class Linear(Mapping):
    """Commands in proportion to the response, between the smallest and the largest one measured.

        u = clip((2 x - (a + b)) / (a - b), -1, 1),    a = P100, b = P0

    If all measured responses are equal (a = b) there is no scale, and u = 0.

    Source: prepared by the authors of Sawada et al. 2022 and left out of the paper.
    """

    name = "linear"

    def command(self, x: Numbers, percentiles: Numbers) -> Numbers:
        """The position of `x` between the extremes of the measured responses (see `Mapping.command`)."""
        smallest, largest = percentiles[0], percentiles[N_PERCENTILES - 1]
        span = largest - smallest
        # Clipped before dividing: the extremes are then exactly -1 and +1, and a span of zero gives 0 / 1.
        xp = namespace_of(x, percentiles)
        return xp.clip(2 * x - (largest + smallest), -span, span) / (span + (span == 0))


REGISTRY: Registry[Mapping] = Registry(
    "mapping",
    Mapping,  # type: ignore[type-abstract]
    {mapping.name: mapping for mapping in (Thresholds(1), Thresholds(9), Linear())},
    reserved=("none",),
)
"""An installed package announces its mappings in the entry point group `animat.mappings`."""

mapping_named = REGISTRY.named

Kind = TypeVar("Kind", bound=type[Mapping])


def register_mapping(kind: Kind) -> Kind:
    """Register a mapping, so that policies with it can be saved and loaded; a class decorator.

    Args:
        kind: a frozen dataclass of all parameters, with a `name` and a `command` (see `Mapping`).

    Raises:
        InvalidArgument: for a class of another kind, one that lacks a method, or a name already taken.
    """
    REGISTRY.register(kind)
    return kind


def mapping_to_data(mapping: Mapping) -> str | dict[str, Any]:
    """The mapping as JSON data: its name; a custom one as in `animat.registry.Registry.to_dict`."""
    # A mapping that is not a dataclass can only be trained in memory.
    return REGISTRY.to_dict(mapping) if is_dataclass(type(mapping)) and not is_ours(mapping) else mapping.name


def mapping_from_data(data: str | dict[str, Any]) -> Mapping:
    """The inverse of `mapping_to_data`; raises as `animat.registry.Registry.from_dict` does."""
    return REGISTRY.from_dict({"name": data, "parameters": {}} if isinstance(data, str) else data)


def namespace_of(*arrays: Numbers) -> Any:
    """The array library of the first array that is not numpy's; numpy if there is none."""
    for array in arrays:
        if not isinstance(array, np.ndarray | np.generic) and hasattr(array, "__array_namespace__"):
            return array.__array_namespace__()
    return np
