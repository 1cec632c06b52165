"""What an electrode's pulse reaches: neurons near it, and neurons whose axons pass it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt64

from animat.cultures.tissue.kernel import AXONAL_KICK_MV, axonal_draws
from animat.cultures.tissue.network import Network, Neurons
from animat.cultures.tissue.parameters import TissueParameters
from animat.errors import InvalidArgument

SMALLEST_KICK_MV = 0.5
"""Smaller kicks are left out: they are negligible next to the noise."""
LARGEST_STRENGTH = 2.0
"""Pulses up to twice the full strength are modelled."""

Place = tuple[int, int]
"""A position (x, y) in tenths of a micrometre."""


@dataclass(frozen=True, eq=False)
class Pulse:
    """One stimulation pulse, on one or several electrodes at once.

    Attributes:
        time_s: start, on the tissue's clock.
        x_um, y_um: positions of the electrodes, shape (electrodes,).
        strength: 0 to 2, 1 for the full pulse; kicks and the number of axons reached grow with it in proportion.
    """

    time_s: float
    x_um: Float64[np.ndarray, " electrodes"]
    y_um: Float64[np.ndarray, " electrodes"]
    strength: float = 1.0

    def __post_init__(self) -> None:
        for name in ("x_um", "y_um"):
            object.__setattr__(self, name, np.atleast_1d(np.asarray(getattr(self, name), dtype=np.float64)))
        if self.x_um.shape != self.y_um.shape or self.x_um.ndim != 1:
            shapes = f"{self.x_um.shape} and {self.y_um.shape}"
            raise InvalidArgument(f"x_um, y_um: expected one position per electrode, got shapes {shapes}")
        if not 0 <= self.strength <= LARGEST_STRENGTH:
            raise InvalidArgument(f"strength: expected 0 to {LARGEST_STRENGTH:g}, 1 being full, got {self.strength}")


class Reach(NamedTuple):
    """What a full pulse reaches on its electrodes; a neuron is listed once for each electrode that reaches it.

    A pulse of strength s reaches the axons whose rank is below s; `axon_key` decides their random draws.
    """

    near: Int64[np.ndarray, " near"]
    kick_mv: Float64[np.ndarray, " near"]
    axons: Int64[np.ndarray, " axons"]
    axon_rank: Float64[np.ndarray, " axons"]
    axon_latency_ms: Float64[np.ndarray, " axons"]
    axon_key: UInt64[np.ndarray, " axons"]


class Kicks(NamedTuple):
    """Kicks: step, neuron and depolarisation of each; shape (kicks,)."""

    step: Int64[np.ndarray, " kicks"]
    neuron: Int64[np.ndarray, " kicks"]
    mv: Float32[np.ndarray, " kicks"]


class ElectrodeCoupling:
    """The coupling of electrodes to a network, fixed by the seed and the electrodes' positions.

    A neuron at distance d is kicked by `kick_mv` f / (1 + (d / `kick_reach_um`)^2), with f its own log-normal factor.
    Its axon passes the electrode with a probability in proportion to exp(-d / `axon_reach_um`), scaled so that an
    electrode reaches `axons_per_electrode` axons on average.
    """

    def __init__(self, seed: int, parameters: TissueParameters, network: Network) -> None:
        rng = np.random.default_rng([seed, 3])
        kick_factor = rng.lognormal(0.0, parameters.kick_sigma, len(network))
        own_latency_ms = parameters.axon_latency_spread_ms * rng.uniform(0, 1, len(network))
        self._parameters = parameters
        # Caches of functions, not of its own methods: such a cycle would stay in memory until it is garbage-collected.
        reach_of_one = cache(partial(_find_reach, seed, parameters, network, kick_factor, own_latency_ms))
        self._reach_of_all = lru_cache(10_000)(partial(_join_reaches, reach_of_one))

    def reach(self, x_um: Float64[np.ndarray, " electrodes"], y_um: Float64[np.ndarray, " electrodes"]) -> Reach:
        """What a pulse on the electrodes at (x, y) reaches; positions are distinguished to 0.1 um."""
        places = tuple((round(10 * x), round(10 * y)) for x, y in zip(x_um.tolist(), y_um.tolist(), strict=True))
        return self._reach_of_all(places)

    def kicks(self, pulse: Pulse, pulse_step: int) -> Kicks:
        """The kicks of a pulse at `pulse_step`, in no particular order.

        An axonal spike occurs with probability `axon_reliability` and arrives after a fixed latency and a jitter, both
        drawn as functions of the pulse's step: they do not depend on how time is divided.
        """
        parameters = self._parameters
        reach = self.reach(pulse.x_um, pulse.y_um)
        draw, jitter = axonal_draws(reach.axon_key, pulse_step)
        passes = (draw < parameters.axon_reliability) & (reach.axon_rank < pulse.strength)
        latency_ms = reach.axon_latency_ms[passes] + parameters.axon_jitter_ms * jitter[passes]
        arrival = pulse_step + np.maximum(np.rint(latency_ms / parameters.step_ms), 0).astype(np.int64)
        return Kicks(
            np.concatenate([np.full(len(reach.near), pulse_step, dtype=np.int64), arrival]),
            np.concatenate([reach.near, reach.axons[passes]]),
            np.concatenate([reach.kick_mv * pulse.strength, np.full(len(arrival), AXONAL_KICK_MV)], dtype=np.float32),
        )


def _join_reaches(reach_of_one: Callable[[Place], Reach], places: tuple[Place, ...]) -> Reach:
    return Reach(*(np.concatenate(columns) for columns in zip(*map(reach_of_one, places), strict=True)))


def _find_reach(
    seed: int, parameters: TissueParameters, network: Network, kick_factor: Neurons, latency_ms: Neurons, place: Place
) -> Reach:
    distance_um = np.hypot(network.x_um - place[0] / 10, network.y_um - place[1] / 10)
    kick_mv = parameters.kick_mv * kick_factor / (1 + (distance_um / parameters.kick_reach_um) ** 2)
    near = np.flatnonzero(kick_mv > SMALLEST_KICK_MV)
    passing = np.exp(-distance_um / parameters.axon_reach_um)
    chance = parameters.axons_per_electrode * passing / passing.sum()
    rng = np.random.default_rng([seed, 4, place[0] % 2**32, place[1] % 2**32])
    rank = rng.uniform(size=len(network)) / chance
    key = rng.integers(0, 2**64, len(network), dtype=np.uint64)
    axons = np.flatnonzero(rank < LARGEST_STRENGTH)
    latency_ms = parameters.axon_latency_ms + latency_ms + distance_um / parameters.conduction_um_per_ms
    return Reach(near, kick_mv[near], axons, rank[axons], latency_ms[axons], key[axons])


def sorted_kicks(*kicks: Kicks) -> Kicks:
    """All kicks in order of their steps; those of one step keep their order."""
    step, neuron, mv = (np.concatenate(column) for column in zip(*kicks, strict=True))
    order = np.argsort(step, kind="stable")
    return Kicks(step[order], neuron[order], mv[order])


NO_KICKS = Kicks(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32))
