"""The virtual tissue's equations written down in Brian2: what the kernel is held against, and timed beside.

Only the network (who connects to whom, weights, delays) and the list of kicks come from animat; every equation is
Brian2's own, in double precision, and with each arriving spike applied by itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from animat.cultures.tissue.coupling import Kicks
from animat.cultures.tissue.network import Network
from animat.cultures.tissue.parameters import TissueParameters

EQUATIONS = """
dv/dt = (E_L - v + drive - (gA + gN * B) * v + gG * (E_G - v) + gK * (E_K - v)) / tau_m : 1 (unless refractory)
dgA/dt = -gA / tau_A : 1
dgN/dt = -gN / tau_N : 1
dgG/dt = -gG / tau_G : 1
dgK/dt = -gK / tau_K : 1
dtheta/dt = -theta / tau_theta : 1
relE : 1
relI : 1
B = 1 / (1 + exp(-0.062 * v) / 3.57) : 1 (constant over dt)
scale : 1 (linked)
drive : 1
drive_mean : 1 (constant)
needed : 1 (constant)
is_e : 1 (constant)
facilitates : 1 (constant)
tau_m : second (constant)
refractory_time : second (constant)
U_E : 1 (constant)
U_I : 1 (constant)
tau_recE : second (constant)
tau_recI : second (constant)
tau_facE : second (constant)
tau_facI : second (constant)
"""

EVERY_STEP = """
dxE/dt = (1 - xE) / tau_recE : 1
dxI/dt = (1 - xI) / tau_recI : 1
duE/dt = (U_E - uE) / tau_facE : 1
duI/dt = (U_I - uI) / tau_facI : 1
dh/dt = (1 - h) / tau_h : 1
"""
AT_SPIKES = """
xE : 1
xI : 1
uE : 1
uI : 1
h : 1
last : second
"""
RECOVER = """
xE = 1 - (1 - xE) * exp((last - t) / tau_recE)
xI = 1 - (1 - xI) * exp((last - t) / tau_recI)
uE = U_E + (uE - U_E) * exp((last - t) / tau_facE)
uI = U_I + (uI - U_I) * exp((last - t) / tau_facI)
h = 1 - (1 - h) * exp((last - t) / tau_h)
last = t
"""

RESET = """
v = v_reset
gK += dK
theta += dtheta_spike
relE = uE * xE * (is_e * scale + 1 - is_e)
relI = uI * xI * (is_e * scale + 1 - is_e)
xE *= 1 - uE
xI *= 1 - uI
uE += facilitates * U_E * (1 - uE)
uI += facilitates * U_I * (1 - uI)
h *= 1 - loss_h
"""


class Brian2Tissue:
    """A Brian2 network of the same neurons and synapses, ready to run.

    Args:
        parameters, network: of the tissue to compare with.
        needed: the availability each neuron needs, shape (neurons,).
        v_mv, drive_mv: initial potential and drive, shape (neurons,).
        kicks: kicks by step, neuron and size, or None.
        noise: whether the drive is an Ornstein-Uhlenbeck process.
        target: Brian2's code generation, "numpy" or "cython".
        at_spikes: whether plasticity recovers at spikes (fast) or at every step (another way of saying it).
    """

    def __init__(
        self,
        parameters: TissueParameters,
        network: Network,
        needed: np.ndarray,
        v_mv: np.ndarray,
        drive_mv: np.ndarray,
        kicks: Kicks | None = None,
        noise: bool = False,
        target: str = "numpy",
        at_spikes: bool = False,
    ) -> None:
        import brian2 as b2

        p, ms, second = parameters, b2.ms, b2.second
        b2.prefs.codegen.target = target
        is_e = network.is_excitatory
        self.step_ms = p.step_ms
        constants = {
            "E_L": p.leak_mv,
            "E_G": p.gaba_mv,
            "E_K": p.potassium_mv,
            "v_reset": p.reset_mv,
            "v_threshold": p.threshold_mv,
            "dK": p.hyperpolarisation,
            "dtheta_spike": p.adaptation_mv,
            "tau_A": p.ampa_ms * ms,
            "tau_N": p.nmda_ms * ms,
            "tau_G": p.gaba_ms * ms,
            "tau_K": p.hyperpolarisation_ms * ms,
            "tau_theta": p.adaptation_ms * ms,
            "tau_h": p.availability_s * second,
            "tau_scale": p.scaling_min * 60 * second,
            "scale_rest": 1 + p.scaling_loss * p.scaling_at_hz * p.scaling_min * 60,
            "loss_scale": p.scaling_loss / p.n_excitatory,
            "loss_h": p.availability_loss,
            "ratio": p.nmda_ratio,
            "fill": 1 / p.nmda_saturation,
            "keep": np.exp(-p.step_ms / p.noise_ms),
            "kick_sd": p.noise_mv * np.sqrt(1 - np.exp(-2 * p.step_ms / p.noise_ms)),
        }
        clock = b2.Clock(p.step_ms * ms)
        group: Any = b2.NeuronGroup(
            len(network),
            EQUATIONS + (AT_SPIKES if at_spikes else EVERY_STEP),
            threshold="v > v_threshold + theta",
            reset=(RECOVER if at_spikes else "") + RESET,
            refractory="refractory_time",
            method="exponential_euler",
            clock=clock,
            namespace=constants,
        )
        group.v, group.drive, group.drive_mean, group.needed = v_mv, drive_mv, network.drive_mv, needed
        group.is_e, group.facilitates = is_e, is_e
        group.tau_m = np.where(is_e, p.membrane_e_ms, p.membrane_i_ms) * ms
        group.refractory_time = np.where(is_e, p.refractory_e_ms, p.refractory_i_ms) * ms
        group.xE = group.xI = group.h = 1
        for towards, kind in (("E", p.e_to_e), ("I", p.e_to_i)):
            setattr(group, f"U_{towards}", np.where(is_e, kind.use, p.i_to_any.use))
            setattr(group, f"u{towards}", np.where(is_e, kind.use, p.i_to_any.use))
            setattr(group, f"tau_rec{towards}", np.where(is_e, kind.recovery_ms, p.i_to_any.recovery_ms) * ms)
            setattr(group, f"tau_fac{towards}", np.where(is_e, kind.facilitation_ms, 1.0) * ms)

        scaling: Any = b2.NeuronGroup(
            1, "dscale/dt = (scale_rest - scale) / tau_scale : 1", method="exact", clock=clock, namespace=constants
        )
        scaling.scale = 1
        group.scale = b2.linked_var(scaling, "scale")
        scaled: Any = b2.Synapses(
            group, scaling, on_pre="scale_post *= 1 - loss_scale", clock=clock, namespace=constants
        )
        scaled.connect(i=np.flatnonzero(is_e), j=0)

        source = np.repeat(np.arange(len(network)), np.diff(network.start))
        parts = [group, scaling, scaled]
        for from_e in (True, False):
            for to_e in (True, False):
                rows = np.flatnonzero((is_e[source] == from_e) & (is_e[network.target] == to_e))
                released = f"w * {'relE' if to_e else 'relI'}_pre"
                arrival = (
                    f"gA_post += {released}; gN_post += ratio * {released} * (1 - fill * gN_post)"
                    if from_e
                    else f"gG_post += {released}"
                )
                synapses: Any = b2.Synapses(
                    group, group, "w : 1 (constant)", on_pre=arrival, clock=clock, namespace=constants
                )
                if not len(rows):
                    continue
                synapses.connect(i=source[rows], j=network.target[rows])
                synapses.w = network.weight[rows]
                synapses.delay = network.delay_steps[rows] * p.step_ms * ms
                parts.append(synapses)
        if noise:
            group.run_regularly(
                "drive = drive_mean + (drive - drive_mean) * keep + kick_sd * randn()", when="end", clock=clock
            )
        if kicks is not None:
            # Before Brian2 evaluates B, which it does in this slot at order 0.
            kicker = self._kicker(group, kicks, b2)
            parts.append(b2.NetworkOperation(kicker, clock=clock, when="before_start", order=-1))
        self._monitor = b2.SpikeMonitor(group)
        self._network = b2.Network(*parts, self._monitor)
        self._ms = ms

    def _kicker(self, group: Any, kicks: Kicks, b2: Any) -> Any:
        refractory_ms = np.asarray(group.refractory_time / b2.ms)

        def kick(t: Any) -> None:
            step = round(float(t / b2.ms) / self.step_ms)
            for row in np.flatnonzero(kicks.step == step):
                i = int(kicks.neuron[row])
                since_ms = step * self.step_ms - float(group.lastspike[i] / b2.ms)
                if since_ms > refractory_ms[i] - self.step_ms / 2 and group.h[i] > group.needed[i]:
                    group.v[i] = group.v[i] + float(kicks.mv[row])

        return kick

    def run(self, duration_ms: float) -> tuple[np.ndarray, np.ndarray]:
        """Run on, and return the step and the neuron of every spike so far."""
        self._network.run(duration_ms * self._ms)
        return np.rint(np.asarray(self._monitor.t / self._ms) / self.step_ms).astype(int), np.asarray(self._monitor.i)
