"""The stepping loop of the virtual tissue, compiled, and the arrays that it works on.

No fast-math: every operation is rounded as written, so the same state gives the same spikes bit for bit, however many
steps a call takes and however wide the processor's vectors are. The compiler vectorises loops over neurons only if they
are short and write few arrays. Numba caches by the date of this file alone: all that it compiles belongs here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, Shaped, UInt64

from animat.compilation import cached_njit

f4 = np.float32
ONE, HALF, TWELFTH = f4(1.0), f4(0.5), f4(1 / 12)
FAINT = f4(1e-20)
"""Added at every decay, so that values level off at about 1e-17 and never become subnormal, which is slow."""
AXONAL_KICK_MV = f4(1000.0)
"""A spike that arrives along the axon takes the soma over any threshold."""
NOISE_STEPS = 5
"""Interval between updates of a neuron's noise: 1 ms, well below its time constant."""
SHARED_STEPS = 25
"""Interval between updates of the slow noise that a community shares."""
STRETCH = 128
SUM_OF_FOUR_MEAN = f4(2 * 65535)
SUM_OF_FOUR_SD = float(np.sqrt((65536.0**2 - 1) / 3))
"""Mean and standard deviation of the sum of four uniform 16-bit integers."""


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


class TissueState(NamedTuple):
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
    """The non-empty places of the rings, as most are empty; the first `filled` entries of a row are targets, each once.

    The first axis is excitation (AMPA and NMDA arrive together) and inhibition.
    """

    filled: Int32[np.ndarray, "2 ring"]
    target: Int32[np.ndarray, "2 ring neurons"]


compiled = cached_njit(error_model="numpy", fastmath=False)
# Without inlining, every call would copy the descriptors of all its arrays, and every function be compiled separately.
inlined = numba.njit(error_model="numpy", inline="always")


@inlined
def mixed(key: np.uint64, step: int) -> np.uint64:
    """The 64 bits of SplitMix64 (Steele et al. 2014, doi 10.1145/2660193.2660195) for a key and a step."""
    z = key + np.uint64(step) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@inlined
def uniform(bits: np.uint64) -> float:
    """A number in [0, 1) from the upper 53 bits."""
    return float(bits >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@inlined
def sum_of_four(bits: np.uint64) -> np.float32:
    """The sum of the four 16-bit integers in 64 bits, minus its mean: nearly normal (excess kurtosis -0.3)."""
    low = np.uint64(0xFFFF)
    total = (bits & low) + ((bits >> np.uint64(16)) & low) + ((bits >> np.uint64(32)) & low) + (bits >> np.uint64(48))
    return f4(np.int32(total)) - SUM_OF_FOUR_MEAN


@inlined
def move_membrane(
    constants: np.record, state: TissueState, step_over_membrane: Float32[np.ndarray, " neurons"]
) -> None:
    """One step of V, exact for conductances held over the step, up to (1 - exp(-z)) / z = 1 / (1 + z/2 + z^2/12)."""
    v_mv, drive_mv, ampa, nmda, gaba = state.v_mv, state.drive_mv, state.ampa, state.nmda, state.gaba
    potassium, refractory = state.potassium, state.refractory
    block = constants.block
    b0, b1, b2, b3, b4 = block[0], block[1], block[2], block[3], block[4]
    b5, b6, b7, b8, b9 = block[5], block[6], block[7], block[8], block[9]
    middle_mv, per_mv = constants.block_middle_mv, constants.block_per_mv
    leak_mv, potassium_mv, gaba_mv = constants.leak_mv, constants.potassium_mv, constants.gaba_mv
    for i in range(v_mv.size):
        v = v_mv[i]
        y = min(max((v - middle_mv) * per_mv, -ONE), ONE)
        # Estrin's scheme: unlike Horner's, its products do not depend on one another.
        y2 = y * y
        y4 = y2 * y2
        low = (b0 + b1 * y) + (b2 + b3 * y) * y2
        high = (b4 + b5 * y) + (b6 + b7 * y) * y2
        unblocked = low + y4 * (high + y4 * (b8 + b9 * y))
        total = ONE + ampa[i] + nmda[i] * unblocked + gaba[i] + potassium[i]
        current = leak_mv + drive_mv[i] + gaba[i] * gaba_mv + potassium[i] * potassium_mv - total * v
        z = total * step_over_membrane[i]
        # Select the summand, not the stored value: a conditional store would go through a mask, which is slow.
        change = current * step_over_membrane[i] / (ONE + z * (HALF + z * TWELFTH))
        v_mv[i] = v + (change if refractory[i] == 0 else f4(0.0))


@inlined
def move_noise(
    constants: np.record, wiring: Wiring, state: TissueState, mean_mv: Float32[np.ndarray, " neurons"], step: int
) -> None:
    """`NOISE_STEPS` of the Ornstein-Uhlenbeck drive, whose noise depends only on the neuron and the step."""
    drive_mv, key = state.drive_mv, wiring.noise_key
    keep, scale = constants.keep_noise, constants.noise_scale_mv
    for i in range(drive_mv.size):
        noise_mv = scale * sum_of_four(mixed(key[i], step))
        drive_mv[i] = mean_mv[i] + (drive_mv[i] - mean_mv[i]) * keep + noise_mv


@inlined
def move_shared(constants: np.record, wiring: Wiring, state: TissueState, step: int) -> None:
    """`SHARED_STEPS` of the slow Ornstein-Uhlenbeck noise that the neurons of a community share."""
    shared_mv = state.shared_mv
    for community in range(shared_mv.size):
        noise_mv = constants.shared_scale_mv * sum_of_four(mixed(wiring.shared_key[community], step))
        shared_mv[community] = shared_mv[community] * constants.keep_shared + noise_mv


@inlined
def fill_mean(wiring: Wiring, state: TissueState, mean_mv: Float32[np.ndarray, " neurons"]) -> None:
    """The mean of each neuron's drive: its own constant drive plus the noise of its community."""
    for i in range(mean_mv.size):
        mean_mv[i] = wiring.drive_mv[i] + state.shared_mv[wiring.community[i]]


@inlined
def decay(values: Float32[np.ndarray, " neurons"], lose: np.float32) -> None:
    """One step of exponential decay; single precision represents the small share lost better than the share kept."""
    for i in range(values.size):
        values[i] = values[i] - values[i] * lose + FAINT


@inlined
def count_down(refractory: Int32[np.ndarray, " neurons"]) -> None:
    """One step of the refractory period."""
    for i in range(refractory.size):
        refractory[i] = max(refractory[i] - np.int32(1), np.int32(0))


@inlined
def arrive(constants: np.record, state: TissueState, arrivals: Arrivals, slot: int) -> None:
    """Add this step's arrivals to the conductances, and empty its row of the rings."""
    to_ampa, to_nmda, to_gaba = state.arriving_ampa[slot], state.arriving_nmda[slot], state.arriving_gaba[slot]
    for place in range(arrivals.filled[0, slot]):
        i = arrivals.target[0, slot, place]
        state.ampa[i] += to_ampa[i]
        state.nmda[i] += to_nmda[i] * (constants.nmda_saturation - state.nmda[i])
        to_ampa[i] = to_nmda[i] = f4(0.0)
    for place in range(arrivals.filled[1, slot]):
        i = arrivals.target[1, slot, place]
        state.gaba[i] += to_gaba[i]
        to_gaba[i] = f4(0.0)
    arrivals.filled[0, slot] = arrivals.filled[1, slot] = 0


@inlined
def over_threshold(constants: np.record, state: TissueState, first: int, last: int) -> np.int32:
    """Number of neurons from `first` up to `last` above threshold; refractory ones are at the reset potential."""
    # Slices that begin at 0: an index that could be negative is tested at each access, and its loop not vectorised.
    v_mv, adaptation_mv, threshold_mv = state.v_mv[first:last], state.adaptation_mv[first:last], constants.threshold_mv
    count = np.int32(0)
    for i in range(v_mv.size):
        count += np.int32(v_mv[i] > threshold_mv + adaptation_mv[i])
    return count


@inlined
def recovered(value: float, rest: float, elapsed_s: float, time_constant_s: float) -> float:
    """The value after exponential recovery towards `rest`."""
    return rest + (value - rest) * math.exp(-elapsed_s / time_constant_s)


@inlined
def missing_of(constants: np.record, state: TissueState, i: int, step: int) -> float:
    """The share of spikes that neuron i's stimulated axon fails to conduct: it follows the load, slowly."""
    since_s = (step - state.last_driven[i]) * constants.step_s
    load_kept, missing_kept = math.exp(-since_s / constants.load_s), math.exp(-since_s / constants.conduction_s)
    follows = constants.load_s / (constants.load_s - constants.conduction_s)
    return float(state.missing[i] * missing_kept + follows * state.load[i] * (load_kept - missing_kept))


@inlined
def conducts(constants: np.record, wiring: Wiring, state: TissueState, i: int, step: int) -> bool:
    """Whether neuron i's stimulated axon conducts its spike to the soma, which loads the axon."""
    missing = missing_of(constants, state, i, step)
    if uniform(mixed(wiring.axon_key[i], step)) < missing:
        return False
    load = state.load[i] * math.exp(-(step - state.last_driven[i]) * constants.step_s / constants.load_s)
    state.last_driven[i], state.missing[i] = step, missing
    state.load[i] = load + constants.load_gain * (1.0 - load)
    return True


@inlined
def fire(
    constants: np.record, wiring: Wiring, state: TissueState, arrivals: Arrivals, i: int, step: int, gain: float
) -> None:
    """Let neuron i spike: release, depress, reduce availability, send along every synapse, reset."""
    kind = 0 if i < constants.n_excitatory else 1
    elapsed_s = (step - state.last_spike[i]) * constants.step_s
    state.last_spike[i] = step
    strength = 1.0
    if kind == 0:
        since_s = (step - state.last_scaled[0]) * constants.step_s
        state.last_scaled[0] = step
        scaling = recovered(state.scaling[0], constants.scaling_rest, since_s, constants.scaling_recovery_s)
        strength = scaling * gain
        if state.load[i] > 0.0:
            strength *= 1.0 - constants.output_loss * missing_of(constants, state, i, step)
        state.scaling[0] = scaling * (1.0 - constants.scaling_loss)
    available = recovered(state.available[i], 1.0, elapsed_s, constants.availability_s)
    state.available[i] = available * (1.0 - constants.availability_loss)
    to_e = f4(strength * release_of(constants, state, i, kind, 0, elapsed_s))
    to_i = f4(strength * release_of(constants, state, i, kind, 1, elapsed_s))

    n, n_e = state.v_mv.size, constants.n_excitatory
    last_row = state.arriving_ampa.shape[0] - 1
    sent_to = (state.arriving_ampa if kind == 0 else state.arriving_gaba).ravel()
    to_nmda = state.arriving_nmda.ravel()
    for synapse in range(wiring.start[i], wiring.start[i + 1]):
        target = wiring.target[synapse]
        arriving = wiring.weight[synapse] * (to_e if target < n_e else to_i)
        row = (step + wiring.delay_steps[synapse]) & last_row
        place = row * n + target
        if sent_to[place] == 0 and arriving != 0:
            # The place is no longer empty.
            arrivals.target[kind, row, arrivals.filled[kind, row]] = target
            arrivals.filled[kind, row] += 1
        sent_to[place] += arriving
        if kind == 0:
            # Two arrivals in one step each fill a share of the remaining gap, as if they came one after the other.
            to_nmda[place] += min(constants.nmda_fill * arriving, ONE) * (ONE - to_nmda[place])

    state.v_mv[i] = constants.reset_mv
    state.potassium[i] += constants.hyperpolarisation
    state.adaptation_mv[i] += constants.adaptation_mv
    state.refractory[i] = wiring.refractory_steps[i]


@inlined
def release_of(constants: np.record, state: TissueState, i: int, kind: int, towards: int, elapsed_s: float) -> float:
    """Recover u and x since the last spike, release u x, and store their values after it."""
    use = constants.use[kind, towards]
    x = recovered(state.x[i, towards], 1.0, elapsed_s, constants.recovery_s[kind, towards])
    u = use
    if constants.facilitation_s[kind, towards] > 0.0:
        u = recovered(state.u[i, towards], use, elapsed_s, constants.facilitation_s[kind, towards])
    released = float(u * x)
    state.x[i, towards] = x - released
    state.u[i, towards] = u + use * (1.0 - u)
    return released


@compiled
def advance(
    record: Shaped[np.ndarray, " 1"],
    wires: tuple[np.ndarray, ...],
    values: tuple[np.ndarray, ...],
    arriving: tuple[np.ndarray, ...],
    clock: Int64[np.ndarray, " 2"],
    n_steps: int,
    gain: float,
    kick_step: Int64[np.ndarray, " kicks"],
    kick_neuron: Int64[np.ndarray, " kicks"],
    kick_mv: Float32[np.ndarray, " kicks"],
    spike_step: Int64[np.ndarray, " capacity"],
    spike_neuron: Int64[np.ndarray, " capacity"],
) -> int:
    """Advance by up to `n_steps`, and return how many spikes were written.

    It stops early when a step's spikes might no longer fit the output. Unpacking a named tuple takes a call twice as
    long as a plain one, which matters for calls of 60 steps of 2 us.

    Args:
        record: from `prepare_constants`.
        wires, values, arriving: plain tuples of `Wiring`, `TissueState`, `Arrivals`; the last two are changed in place.
        clock: the tissue's clock, in steps, and how many kicks have passed; changed in place, so that an exception
            that follows, as of Ctrl-C, finds it as the state is.
        gain: factor on excitatory weights during this call.
        kick_step, kick_neuron, kick_mv: kicks in order of their steps; none that has not passed is before the clock.
        spike_step, spike_neuron: output, with room for at least one spike per neuron.
    """
    constants, wiring, state, arrivals = record[0], Wiring(*wires), TissueState(*values), Arrivals(*arriving)
    n = state.v_mv.size
    last_row = state.arriving_ampa.shape[0] - 1
    mean_mv = np.empty(n, np.float32)
    fill_mean(wiring, state, mean_mv)
    kicks, spikes, first_step = clock[1], 0, clock[0]
    for step in range(first_step, first_step + n_steps):
        if spikes + n > spike_step.size:
            clock[0], clock[1] = step, kicks
            return spikes
        count_down(state.refractory)
        while kicks < kick_step.size and kick_step[kicks] == step:
            i = kick_neuron[kicks]
            elapsed_s = (step - state.last_spike[i]) * constants.step_s
            available = recovered(state.available[i], 1.0, elapsed_s, constants.availability_s)
            ready = state.refractory[i] == 0 and available > wiring.needed[i]
            if ready and (kick_mv[kicks] < AXONAL_KICK_MV or conducts(constants, wiring, state, i, step)):
                state.v_mv[i] += kick_mv[kicks]
            kicks += 1
        move_membrane(constants, state, wiring.step_over_membrane)
        if step % SHARED_STEPS == 0:
            move_shared(constants, wiring, state, step)
            fill_mean(wiring, state, mean_mv)
        if step % NOISE_STEPS == 0:
            move_noise(constants, wiring, state, mean_mv, step)
        decay(state.ampa, constants.lose_ampa)
        decay(state.nmda, constants.lose_nmda)
        decay(state.gaba, constants.lose_gaba)
        decay(state.potassium, constants.lose_potassium)
        decay(state.adaptation_mv, constants.lose_adaptation)
        # Vector code counts spikes in a stretch, which is scanned neuron by neuron only if there are any.
        for first in range(0, n, STRETCH):
            last = min(first + STRETCH, n)
            if over_threshold(constants, state, first, last) > 0:
                for i in range(first, last):
                    if state.v_mv[i] > constants.threshold_mv + state.adaptation_mv[i]:
                        spike_step[spikes] = step
                        spike_neuron[spikes] = i
                        spikes += 1
                        fire(constants, wiring, state, arrivals, i, step, gain)
        arrive(constants, state, arrivals, step & last_row)
    clock[0], clock[1] = first_step + n_steps, kicks
    return spikes


@compiled
def axonal_draws(
    key: UInt64[np.ndarray, " axons"], step: int
) -> tuple[Float64[np.ndarray, " axons"], Float64[np.ndarray, " axons"]]:
    """Random draws of a pulse at `step`: a uniform and a nearly standard normal number for each axon's key."""
    draw, jitter = np.empty(key.size), np.empty(key.size)
    for j in range(key.size):
        draw[j] = uniform(mixed(key[j], 2 * step))
        jitter[j] = sum_of_four(mixed(key[j], 2 * step + 1)) / SUM_OF_FOUR_SD
    return draw, jitter
