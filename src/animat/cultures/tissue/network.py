"""Positions, types and connections of the neurons of a virtual tissue, from one seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from animat.cultures.tissue.parameters import TissueParameters

Neurons = Float64[np.ndarray, " neurons"]


@dataclass(frozen=True, eq=False)
class Network:
    """Neurons, excitatory ones first, and synapses; those of neuron i are rows start[i] to start[i + 1], by delay.

    `community` is the patch of the plane that a neuron belongs to; `weight` is a synapse's peak conductance in units of
    the leak, before release.
    """

    x_um: Neurons
    y_um: Neurons
    is_excitatory: Bool[np.ndarray, " neurons"]
    community: Int64[np.ndarray, " neurons"]
    drive_mv: Float32[np.ndarray, " neurons"]
    start: Int64[np.ndarray, " neurons_and_one"]
    target: Int32[np.ndarray, " synapses"]
    weight: Float32[np.ndarray, " synapses"]
    delay_steps: Int32[np.ndarray, " synapses"]

    def __len__(self) -> int:
        return len(self.x_um)


def grow(seed: int, parameters: TissueParameters) -> Network:
    """Generate a network: neurons uniform on the array, each with a fixed number of synapses from each type.

    The probability of a synapse from j to i falls with their distance d as
    s_j c_ij ((1 - a) exp(-d / reach) / Z_i + a / C_i), where a is the long-range share, s_j the log-normal propensity
    of j to send, c_ij 1 within a community and `between_share` between two, and Z_i and C_i the sums of
    c exp(-d / reach) and of c over the neurons of j's type; the weight is log-normal about its mean.
    """
    rng = np.random.default_rng([seed, 1])
    n, n_e = parameters.neurons, parameters.n_excitatory
    x_um, y_um = rng.uniform(0, parameters.width_um, n), rng.uniform(0, parameters.height_um, n)
    drive_mv = rng.normal(parameters.drive_mv, parameters.drive_spread_mv, n)
    community, community_drive_mv = _communities(np.random.default_rng([seed, 9]), x_um, y_um, parameters)
    drive_mv += community_drive_mv[community]
    coupled = np.where(community[:, None] == community, 1.0, parameters.between_share)
    sends = rng.lognormal(0.0, parameters.out_degree_sigma, n)
    distance_um = np.hypot(x_um[:, None] - x_um[None, :], y_um[:, None] - y_um[None, :])

    sources, targets = [], []
    for first, last, degree in ((0, n_e, parameters.in_degree_e), (n_e, n, parameters.in_degree_i)):
        anywhere = coupled[:, first:last]
        near = anywhere * np.exp(-distance_um[:, first:last] / parameters.reach_um)
        near /= near.sum(axis=1, keepdims=True)
        far = anywhere / anywhere.sum(axis=1, keepdims=True)
        share = parameters.long_range_share
        chance = sends[first:last] * ((1 - share) * near + share * far)
        # The largest values of log chance + Gumbel noise are a weighted draw without replacement.
        score = np.log(chance) + rng.gumbel(size=chance.shape)
        own = np.arange(first, last)
        score[own, own - first] = -np.inf
        chosen = np.argpartition(-score, degree, axis=1)[:, :degree] + first
        sources.append(chosen.ravel())
        targets.append(np.repeat(np.arange(n), degree))
    source, target = np.concatenate(sources), np.concatenate(targets)
    delay_ms = parameters.delay_ms + distance_um[target, source] / parameters.conduction_um_per_ms
    delay_steps = np.maximum(np.rint(delay_ms / parameters.step_ms), 1).astype(np.int32)
    # Each neuron's synapses are sorted by delay, so that arrivals of one step are adjacent in memory.
    order = np.lexsort((target, delay_steps, source))
    source, target, delay_steps = source[order], target[order], delay_steps[order]

    mean = np.array([[parameters.weight_ee, parameters.weight_ei], [parameters.weight_ie, parameters.weight_ii]])
    sigma = parameters.weight_sigma
    spread = rng.lognormal(-(sigma**2) / 2, sigma, len(source))
    weight = mean[(source >= n_e).astype(int), (target >= n_e).astype(int)] * spread
    return Network(
        x_um=x_um,
        y_um=y_um,
        is_excitatory=np.arange(n) < n_e,
        community=community,
        drive_mv=drive_mv.astype(np.float32),
        start=np.searchsorted(source, np.arange(n + 1)).astype(np.int64),
        target=target.astype(np.int32),
        weight=weight.astype(np.float32),
        delay_steps=delay_steps,
    )


def _communities(
    rng: np.random.Generator, x_um: Neurons, y_um: Neurons, parameters: TissueParameters
) -> tuple[Int64[np.ndarray, " neurons"], Float64[np.ndarray, " communities"]]:
    """Each neuron's community, that of the nearest centre, and each community's additional drive in mV."""
    communities = parameters.communities
    size_um = np.array([parameters.width_um, parameters.height_um])
    # Of many draws, take the one with the centres furthest apart, for communities of similar size.
    drawn = rng.uniform(0, size_um, (200, communities, 2))
    apart_um = np.hypot(*np.moveaxis(drawn[:, :, None] - drawn[:, None], -1, 0))
    apart_um[:, np.arange(communities), np.arange(communities)] = np.inf
    centre_x_um, centre_y_um = drawn[np.argmax(apart_um.min(axis=(1, 2)))].T
    community = np.argmin(np.hypot(x_um[:, None] - centre_x_um, y_um[:, None] - centre_y_um), axis=1)
    return community, parameters.community_drive_mv * rng.standard_normal(communities)
