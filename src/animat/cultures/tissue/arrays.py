"""Data of the stepping loop as plain arrays: constants, wiring, state, and arrivals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, Shaped, UInt64


class Constants(NamedTuple):
    """Numbers common to all neurons; factors are per time step, conductances in units of the leak."""

    block: Float32[np.ndarray, " coefficients"]  # B(V) = b0 + b1 y + ... + b9 y^9
    block_middle_mv: np.float32  # y = (V - middle) / half, between -1 and 1
    block_per_mv: np.float32  # 1 / half
    leak_mv: np.float32
    threshold_mv: np.float32
    reset_mv: np.float32
    potassium_mv: np.float32
    gaba_mv: np.float32
    lose_ampa: np.float32
    lose_nmda: np.float32
    lose_gaba: np.float32
    lose_potassium: np.float32
    lose_adaptation: np.float32
    keep_noise: np.float32  # over `NOISE_STEPS`, like the next
    noise_scale_mv: np.float32
    keep_shared: np.float32  # over `SHARED_STEPS`, like the next
    shared_scale_mv: np.float32
    nmda_saturation: np.float32
    nmda_fill: np.float32  # share of the gap to saturation that a unit of AMPA fills
    hyperpolarisation: np.float32
    adaptation_mv: np.float32
    step_s: float
    use: Float64[np.ndarray, "from_type to_type"]
    recovery_s: Float64[np.ndarray, "from_type to_type"]
    facilitation_s: Float64[np.ndarray, "from_type to_type"]
    availability_loss: float
    availability_s: float
    scaling_loss: float  # share of all weights lost per spike of one neuron
    scaling_rest: float
    scaling_recovery_s: float
    load_gain: float
    output_loss: float
    load_s: float
    conduction_s: float
    n_excitatory: int


class Wiring(NamedTuple):
    """Properties of each neuron, and its synapses; see `Network`."""

    step_over_membrane: Float32[np.ndarray, " neurons"]
    refractory_steps: Int32[np.ndarray, " neurons"]
    drive_mv: Float32[np.ndarray, " neurons"]
    noise_key: UInt64[np.ndarray, " neurons"]
    axon_key: UInt64[np.ndarray, " neurons"]
    community: Int32[np.ndarray, " neurons"]
    shared_key: UInt64[np.ndarray, " communities"]
    needed: Float64[np.ndarray, " neurons"]
    start: Int64[np.ndarray, " neurons_and_one"]
    target: Int32[np.ndarray, " synapses"]
    weight: Float32[np.ndarray, " synapses"]
    delay_steps: Int32[np.ndarray, " synapses"]


class State(NamedTuple):
    """Everything that changes. Columns of `x` and `u` are for excitatory and for inhibitory targets.

    `drive` is the noisy drive, `shared` the community's contribution to its mean, in mV; `refractory` the steps left;
    `arriving_*` a ring buffer of future arrivals, one row per step: conductance for AMPA and GABA, for NMDA the share
    of the gap to saturation that will be filled. `x`, `u` and `available` are values just after each neuron's last
    spike, `scaling` just after the last spike of any excitatory neuron, `load` and `missing` (the share that conduction
    lacks) just after the last spike that a stimulus started in the axon.
    """

    v_mv: Float32[np.ndarray, " neurons"]
    drive_mv: Float32[np.ndarray, " neurons"]
    shared_mv: Float32[np.ndarray, " communities"]
    ampa: Float32[np.ndarray, " neurons"]
    nmda: Float32[np.ndarray, " neurons"]
    gaba: Float32[np.ndarray, " neurons"]
    potassium: Float32[np.ndarray, " neurons"]
    adaptation_mv: Float32[np.ndarray, " neurons"]
    refractory: Int32[np.ndarray, " neurons"]
    arriving_ampa: Float32[np.ndarray, "ring neurons"]
    arriving_nmda: Float32[np.ndarray, "ring neurons"]
    arriving_gaba: Float32[np.ndarray, "ring neurons"]
    last_spike: Int64[np.ndarray, " neurons"]
    x: Float64[np.ndarray, "neurons 2"]
    u: Float64[np.ndarray, "neurons 2"]
    available: Float64[np.ndarray, " neurons"]
    scaling: Float64[np.ndarray, " 1"]
    last_scaled: Int64[np.ndarray, " 1"]
    load: Float64[np.ndarray, " neurons"]
    missing: Float64[np.ndarray, " neurons"]
    last_driven: Int64[np.ndarray, " neurons"]


class Arrivals(NamedTuple):
    """The non-empty places of the rings. Most are empty, so a step looks only at these.

    The first axis is excitation (AMPA and NMDA arrive together) and inhibition; the first `filled` entries of a row are
    its targets, each once.
    """

    filled: Int32[np.ndarray, "2 ring"]
    target: Int32[np.ndarray, "2 ring neurons"]


def arrivals_of(state: State) -> Arrivals:
    """The arrivals in a state's rings."""
    is_arriving = np.stack([state.arriving_ampa, state.arriving_gaba]) != 0
    targets_first = np.argsort(~is_arriving, axis=2, kind="stable")
    return Arrivals(is_arriving.sum(2, dtype=np.int32), targets_first.astype(np.int32))


def pack(constants: Constants) -> Shaped[np.ndarray, " 1"]:
    """The constants as one record with the same names: unpacking a tuple of 34 values takes 3 us in each call."""
    values = {name: np.asarray(value) for name, value in constants._asdict().items()}
    record = np.zeros(1, np.dtype([(name, value.dtype, value.shape) for name, value in values.items()], align=True))
    for name, value in values.items():
        record[name] = value
    return record
