"""A simulated neuronal tissue: neurons on a plane that spike, can be stimulated, and tire."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from animat.cultures.tissue import kernel
from animat.cultures.tissue.coupling import NO_KICKS, ElectrodeCoupling, Kicks, Pulse, sorted_kicks
from animat.cultures.tissue.kernel import TissueState
from animat.cultures.tissue.network import grow
from animat.cultures.tissue.parameters import TissueParameters
from animat.cultures.tissue.preparation import arrivals_of, fresh_state, prepare_constants, prepare_wiring
from animat.cultures.tissue.snapshot import Snapshot, expect_sound
from animat.errors import InvalidArgument, Mismatch, expect_at_least

NS = 1_000_000_000
MARK_S = 10
"""The drift is constant between marks of the tissue's clock, so it does not depend on how time is divided."""


class Spikes(NamedTuple):
    """Spikes in order of time, on the tissue's clock."""

    time_s: Float64[np.ndarray, " spikes"]
    neuron: Int64[np.ndarray, " spikes"]


NO_SPIKES = Spikes(np.empty(0), np.empty(0, np.int64))


class Drift:
    """The slow drift of excitation: g(t) = 1 + o(t), with o an Ornstein-Uhlenbeck process that starts at 0."""

    def __init__(self, seed: int, parameters: TissueParameters) -> None:
        self._draws = np.random.default_rng([seed, 2])
        self._kept = float(np.exp(-MARK_S / (60 * parameters.drift_min)))
        self._spread = parameters.drift_share * float(np.sqrt(1 - self._kept**2))
        self._drifts = [0.0]

    def gain(self, mark: int) -> float:
        """The factor on all excitatory weights from `mark` to the next, `MARK_S` later."""
        # One draw per mark, in order: the drift is the same function of time, however time is divided.
        for draw in self._draws.standard_normal(max(0, mark + 1 - len(self._drifts))).tolist():
            self._drifts.append(self._drifts[-1] * self._kept + self._spread * draw)
        return max(0.0, 1 + self._drifts[mark])


class Tissue:
    """A simulated culture of neurons without electrodes; `docs/virtual-culture.md` has its equations.

    Conductance-based leaky integrate-and-fire neurons with Tsodyks-Markram synapses. The same seed, parameters and
    pulses give the same spikes bit for bit, however time is divided. Positions count from the array's corner.

    Args:
        seed: decides the network, every draw of noise, and the drift over hours; zero or more.

    Attributes:
        x_um, y_um: position of each neuron along the array's long and short side, shape (neurons,).
        is_excitatory: type of each neuron, shape (neurons,).
        step_ns: the time step.
    """

    def __init__(self, seed: int, parameters: TissueParameters | None = None) -> None:
        expect_at_least("seed", seed, 0)
        self.seed = seed
        self.parameters = parameters or TissueParameters()
        self._network = network = grow(seed, self.parameters)
        self.x_um, self.y_um = network.x_um.copy(), network.y_um.copy()
        self.is_excitatory = network.is_excitatory.copy()
        self._coupling = ElectrodeCoupling(seed, self.parameters, self._network)
        self._drift = Drift(seed, self.parameters)
        self._constants = prepare_constants(self.parameters)
        self._wiring = prepare_wiring(seed, self.parameters, self._network)
        self._adopt(fresh_state(seed, self.parameters, self._network, self._wiring))
        self.step_ns = round(self.parameters.step_ms * 1e6)
        self._step_s = self.step_ns / NS
        self._now_ns, self._kicks = 0, NO_KICKS
        # In steps, and how many of the kicks have passed.
        self._clock = np.zeros(2, np.int64)
        # Step and neuron of each spike, as the kernel writes them.
        self._output = tuple(np.empty((2, max(4 * self.parameters.neurons, 20_000)), np.int64))

    @property
    def now_s(self) -> float:
        """The tissue's clock: the time advanced and rested since its creation."""
        return self._now_ns / NS

    def advance(self, duration_s: float, pulses: Sequence[Pulse] = ()) -> Spikes:
        """Let time pass, stimulate meanwhile, and return the spikes.

        The clock counts nanoseconds and the model runs all steps that are complete, so a second in eighty pieces of
        12.5 ms is the same as in one. A pulse acts at the first step that does not begin before it.

        Interrupted, as by Ctrl-C, it ends at the step that it has come to, and the other pulses are not delivered.

        Args:
            pulses: with times in [now_s, now_s + duration_s), in any order; for any other no time passes.
        """
        end_ns = self._now_ns + _nanoseconds(duration_s)
        before = self._kicks_to_come
        if pulses:
            new = [self._kicks_of(pulse, end_ns) for pulse in sorted(pulses, key=lambda pulse: pulse.time_s)]
            self._set_kicks(sorted_kicks(before, *new))
        last_step = end_ns // self.step_ns
        parts = []
        try:
            while (done := self._step) < last_step:
                mark = done * self.step_ns // (MARK_S * NS)
                mark_end = -(-(mark + 1) * MARK_S * NS // self.step_ns)
                steps, gain = min(last_step, mark_end) - done, self._drift.gain(mark)
                n = kernel.advance(*self._run, self._clock, steps, gain, *self._kicks, *self._output)
                step, neuron = self._output
                parts.append(Spikes(step[:n] * self._step_s, neuron[:n].copy()))
        except BaseException:
            self._set_kicks(Kicks(*(column[before.step >= self._step] for column in before)))
            self._now_ns = max(self._now_ns, self._step * self.step_ns)
            raise
        self._now_ns = end_ns
        self._set_kicks(self._kicks_to_come)
        # Usually there is one part, which is not copied: that would add 1 % to the cost of 12.5 ms.
        return parts[0] if len(parts) == 1 else Spikes(*map(np.concatenate, zip(NO_SPIKES, *parts, strict=True)))

    def rest(self, duration_s: float) -> None:
        """Let time pass like `advance`, without keeping the spikes: any duration takes the memory of a minute."""
        end_ns = self._now_ns + _nanoseconds(duration_s)
        while self._now_ns < end_ns:
            self.advance(min(end_ns - self._now_ns, 60 * NS) / NS)

    def snapshot(self) -> Snapshot:
        """A copy of the state, for `restore`."""
        state = TissueState(*(values.copy() for values in self._state))
        return Snapshot(self.seed, self.parameters, self._now_ns, self._step, self._kicks_to_come, state)

    def restore(self, snapshot: Snapshot) -> None:
        """Return to a snapshot, from which the tissue continues bit for bit; refuses a state that it cannot reach."""
        if (snapshot.seed, snapshot.parameters) != (self.seed, self.parameters):
            raise Mismatch(f"snapshot: expected one of this tissue, with seed {self.seed}, got one of another")
        expect_sound(snapshot, self._state, self._wiring, self.step_ns)
        self._adopt(TissueState(*(values.copy() for values in snapshot.state)))
        self._now_ns, self._clock[0] = snapshot.now_ns, snapshot.step
        self._set_kicks(snapshot.kicks)

    @property
    def _step(self) -> int:
        return int(self._clock[0])

    @property
    def _kicks_to_come(self) -> Kicks:
        """The kicks that have not passed."""
        passed = int(self._clock[1])
        return Kicks(*(column[passed:] for column in self._kicks)) if passed else self._kicks

    def _set_kicks(self, kicks: Kicks) -> None:
        self._kicks, self._clock[1] = kicks, 0

    def _adopt(self, state: TissueState) -> None:
        self._state = state
        self._run = self._constants, tuple(self._wiring), tuple(state), tuple(arrivals_of(state))

    def _kicks_of(self, pulse: Pulse, end_ns: int) -> Kicks:
        pulse_ns = round(pulse.time_s * NS) if isfinite(pulse.time_s) else -1
        if not self._now_ns <= pulse_ns < end_ns:
            expected = f"times from {self.now_s:g} s to before {end_ns / NS:g} s on the tissue's clock"
            raise InvalidArgument(f"pulses: expected {expected}, got {pulse.time_s:g} s")
        return self._coupling.kicks(pulse, -(-pulse_ns // self.step_ns))


def _nanoseconds(duration_s: float) -> int:
    if not 0 <= duration_s < float("inf"):
        raise InvalidArgument(f"duration_s: expected a time of 0 s or more, got {duration_s}")
    return round(duration_s * NS)
