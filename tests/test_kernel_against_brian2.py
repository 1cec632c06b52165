"""The tissue's kernel against the same equations in Brian2, an independent simulator.

The kernel computes in single precision and has a polynomial for B(V), Brian2 computes in double and takes the formula,
and yet they give the same spikes, all of them, to the step.

Brian2 2.9 needs NumPy below 2.4, so it may have to live in an environment of its own: install `brian2`, `numba`,
`gymnasium`, `jax`, `jaxtyping` and `pytest` there, and with `PYTHONPATH=src` run pytest with `-m oracle` on this file.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from animat.cultures.tissue import Pulse, Tissue, TissueParameters

brian2 = pytest.importorskip(
    "brian2", reason="Brian2 is not installed: `pip install 'brian2>=2.9'`, in an environment with NumPy below 2.4"
)
from brian2_tissue import Brian2Tissue  # noqa: E402

pytestmark = [pytest.mark.oracle, pytest.mark.filterwarnings("ignore")]

DURATION_MS = 200.0


def quiet() -> TissueParameters:
    """50 neurons without noise, driven so that they spike, close enough for delays under a refractory period.

    A spike scales as much as in 1,200 neurons: where many spike in one step, Brian2 scales all before any is sent. The
    drive is one at which no neuron comes too near to its threshold for single precision: of 28,000 spikes
    one or a few do (at 24 mV one of seed 2, which is 1.2e-6 mV below in one step, and spikes in the next).
    """
    parameters = TissueParameters(neurons=50, width_um=400.0, height_um=400.0, in_degree_e=12, in_degree_i=5)
    scaling_loss = parameters.scaling_loss * 50 / 1200
    return replace(parameters, noise_mv=0.0, shared_noise_mv=0.0, drive_mv=24.5, scaling_loss=scaling_loss)


def pulse() -> Pulse:
    """On two electrodes, in the middle of the network."""
    return Pulse(0.05, np.array([120.0, 300.0]), np.array([150.0, 280.0]))


def steps_aside(seed: int, pulses: list[Pulse], changed: TissueParameters | None = None) -> np.ndarray:
    """By how many steps each spike of the kernel is aside from Brian2's; every neuron must spike as often in both.

    `changed` are the parameters for Brian2, if they are others.
    """
    parameters = quiet()
    tissue = Tissue(seed, parameters)
    kicks = [tissue._coupling.kicks(pulse, round(pulse.time_s * 1000 / parameters.step_ms)) for pulse in pulses]
    reference = Brian2Tissue(
        changed or parameters,
        tissue._network,
        tissue._wiring.needed,
        tissue._state.v_mv.astype(float),
        tissue._state.drive_mv.astype(float),
        kicks=kicks[0] if kicks else None,
    )
    spikes = tissue.advance(DURATION_MS / 1000, pulses)
    step, neuron = np.rint(spikes.time_s * 1000 / parameters.step_ms).astype(int), spikes.neuron
    expected_step, expected_neuron = reference.run(DURATION_MS)
    order, expected_order = np.lexsort((step, neuron)), np.lexsort((expected_step, expected_neuron))
    assert len(expected_step) > 100
    if pulses:
        assert np.sum(np.abs(expected_step - 250) < 25) > 10
    np.testing.assert_array_equal(neuron[order], expected_neuron[expected_order])
    return np.abs(step[order] - expected_step[expected_order])


@pytest.mark.parametrize("pulses", [[], [pulse()]], ids=["without", "with a pulse"])
@pytest.mark.parametrize("seed", range(1, 21))
def test_the_same_spikes_at_the_same_steps(seed: int, pulses: list[Pulse]) -> None:
    assert np.max(steps_aside(seed, pulses)) == 0


@pytest.mark.parametrize("change", [{"nmda_ms": 110.1}, {"membrane_e_ms": 20.01}, {"hyperpolarisation": 0.001753}])
def test_what_is_a_little_different_is_noticed(change: dict[str, float]) -> None:
    with pytest.raises(AssertionError):
        for seed in range(1, 6):
            assert np.max(steps_aside(seed, [pulse()], changed=replace(quiet(), **change))) == 0
