"""The kernel's input from parameters and a network: constants per step, wiring, the initial state, and arrivals."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Shaped

from animat.cultures.tissue import kernel
from animat.cultures.tissue.kernel import Arrivals, TissueState, Wiring
from animat.cultures.tissue.network import Network
from animat.cultures.tissue.parameters import TissueParameters

BLOCK_MIDDLE_MV, BLOCK_HALF_MV, BLOCK_DEGREE = -60.0, 25.0, 9
"""Range in which a polynomial replaces the NMDA block, to 1e-7; beyond it, the value at the nearer end applies."""


def prepare_constants(parameters: TissueParameters) -> Shaped[np.ndarray, " 1"]:
    """The numbers common to all neurons as one record: unpacking a tuple of 34 values takes 3 us in each call.

    Factors are per time step, conductances in units of the leak, both in single precision.
    """
    f4, step_ms = np.float32, parameters.step_ms

    def lose(time_constant_ms: float) -> np.float32:
        return f4(-np.expm1(-step_ms / time_constant_ms))

    def table(of: str) -> Float64[np.ndarray, "from_type to_type"]:
        kinds = (parameters.e_to_e, parameters.e_to_i), (parameters.i_to_any, parameters.i_to_any)
        return np.array([[getattr(kind, of) for kind in row] for row in kinds])

    noise_keep = np.exp(-kernel.NOISE_STEPS * step_ms / parameters.noise_ms)
    shared_spread = np.sqrt(-np.expm1(-2 * kernel.SHARED_STEPS * step_ms / parameters.shared_noise_ms))
    in_single = "leak_mv threshold_mv reset_mv potassium_mv gaba_mv nmda_saturation hyperpolarisation adaptation_mv"
    in_double = "availability_loss availability_s scaling_rest load_gain output_loss n_excitatory"
    constants = {
        **{name: f4(getattr(parameters, name)) for name in in_single.split()},
        **{name: getattr(parameters, name) for name in in_double.split()},
        # B(V) = b0 + b1 y + ... + b9 y^9 with y = (V - middle) / half, between -1 and 1.
        "block": block_polynomial(),
        "block_middle_mv": f4(BLOCK_MIDDLE_MV),
        "block_per_mv": f4(1 / BLOCK_HALF_MV),
        "lose_ampa": lose(parameters.ampa_ms),
        "lose_nmda": lose(parameters.nmda_ms),
        "lose_gaba": lose(parameters.gaba_ms),
        "lose_potassium": lose(parameters.hyperpolarisation_ms),
        "lose_adaptation": lose(parameters.adaptation_ms),
        # Over `NOISE_STEPS` and `SHARED_STEPS`.
        "keep_noise": f4(noise_keep),
        "noise_scale_mv": f4(parameters.noise_mv * np.sqrt(1 - noise_keep**2) / kernel.SUM_OF_FOUR_SD),
        "keep_shared": f4(np.exp(-kernel.SHARED_STEPS * step_ms / parameters.shared_noise_ms)),
        "shared_scale_mv": f4(parameters.shared_noise_mv * shared_spread / kernel.SUM_OF_FOUR_SD),
        # Share of the gap to saturation that a unit of AMPA fills.
        "nmda_fill": f4(parameters.nmda_ratio / parameters.nmda_saturation),
        "step_s": step_ms / 1000,
        "use": table("use"),
        "recovery_s": table("recovery_ms") / 1000,
        "facilitation_s": table("facilitation_ms") / 1000,
        # Share of all weights lost per spike of one neuron.
        "scaling_loss": parameters.scaling_loss / parameters.n_excitatory,
        "scaling_recovery_s": parameters.scaling_min * 60,
        "load_s": parameters.load_min * 60,
        "conduction_s": parameters.conduction_min * 60,
    }
    values = {name: np.asarray(value) for name, value in constants.items()}
    fields = [(name, value.dtype, value.shape) for name, value in values.items()]
    return np.array([tuple(values.values())], np.dtype(fields, align=True))


def nmda_block(v_mv: Float64[np.ndarray, " potentials"]) -> Float64[np.ndarray, " potentials"]:
    """B(V) = 1 / (1 + exp(-0.062 V) / 3.57): the share of NMDA channels that magnesium leaves open.

    Jahr & Stevens 1990, doi 10.1523/JNEUROSCI.10-09-03178.1990, at 1 mM magnesium.
    """
    return 1 / (1 + np.exp(-0.062 * v_mv) / 3.57)


def block_polynomial() -> Float32[np.ndarray, " coefficients"]:
    """The coefficients of B(V) in y = (V - middle) / half, constant term first, through the Chebyshev nodes."""
    y = np.cos(np.pi * (np.arange(BLOCK_DEGREE + 1) + 0.5) / (BLOCK_DEGREE + 1))
    coefficients = np.polynomial.polynomial.polyfit(y, nmda_block(BLOCK_MIDDLE_MV + BLOCK_HALF_MV * y), BLOCK_DEGREE)
    return coefficients.astype(np.float32)


def prepare_wiring(seed: int, parameters: TissueParameters, network: Network) -> Wiring:
    """The network in the form that the kernel takes, with each neuron's noise key and needed availability."""
    rng = np.random.default_rng([seed, 7])
    is_e, step_ms = network.is_excitatory, parameters.step_ms
    membrane_ms = np.where(is_e, parameters.membrane_e_ms, parameters.membrane_i_ms)
    refractory_ms = np.where(is_e, parameters.refractory_e_ms, parameters.refractory_i_ms)
    return Wiring(
        step_over_membrane=(step_ms / membrane_ms).astype(np.float32),
        refractory_steps=np.rint(refractory_ms / step_ms).astype(np.int32),
        noise_key=rng.integers(0, 2**64, len(network), dtype=np.uint64),
        axon_key=np.random.default_rng([seed, 10]).integers(0, 2**64, len(network), dtype=np.uint64),
        community=network.community.astype(np.int32),
        shared_key=np.random.default_rng([seed, 11]).integers(0, 2**64, parameters.communities, dtype=np.uint64),
        needed=rng.uniform(parameters.availability_needed_low, parameters.availability_needed_high, len(network)),
        **{name: getattr(network, name) for name in ("drive_mv", "start", "target", "weight", "delay_steps")},
    )


def fresh_state(seed: int, parameters: TissueParameters, network: Network, wiring: Wiring) -> TissueState:
    """A rested tissue: recovered synapses, no conductances, drive and potential drawn from plausible ranges."""
    rng = np.random.default_rng([seed, 8])
    n = len(network)
    drive_mv = wiring.drive_mv + parameters.noise_mv * rng.standard_normal(n)
    ring = 1 << int(max(network.delay_steps, default=1)).bit_length()
    of_excitatory = parameters.e_to_e.use, parameters.e_to_i.use
    use = np.where(network.is_excitatory[:, None], of_excitatory, parameters.i_to_any.use)

    return TissueState(
        v_mv=rng.uniform(parameters.leak_mv, parameters.reset_mv, n).astype(np.float32),
        drive_mv=drive_mv.astype(np.float32),
        shared_mv=np.zeros(parameters.communities, np.float32),
        refractory=np.zeros(n, np.int32),
        x=np.ones((n, 2)),
        u=use,
        available=np.ones(n),
        scaling=np.ones(1),
        last_scaled=np.zeros(1, np.int64),
        load=np.zeros(n),
        missing=np.zeros(n),
        **{name: np.zeros(n, np.float32) for name in ("ampa", "nmda", "gaba", "potassium", "adaptation_mv")},
        **{f"arriving_{name}": np.zeros((ring, n), np.float32) for name in ("ampa", "nmda", "gaba")},
        **{f"last_{name}": np.zeros(n, np.int64) for name in ("spike", "driven")},
    )


def arrivals_of(state: TissueState) -> Arrivals:
    """The arrivals in a state's rings."""
    is_arriving = np.stack([state.arriving_ampa, state.arriving_gaba]) != 0
    targets_first = np.argsort(~is_arriving, axis=2, kind="stable")
    return Arrivals(is_arriving.sum(2, dtype=np.int32), targets_first.astype(np.int32))
