"""Records that hold arrays are printed in a few lines, whatever they hold."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from animat.neurons.simulator import fit_empirical
from animat.neurons.timeline import fit_timeline
from animat.responses.extraction import extract_responses
from animat.responses.inspection import inspect_recording
from synthetic_recordings import synthetic_recording


@pytest.mark.parametrize("kind", ["histogram", "empirical", "memory"])
def test_recordings_responses_and_simulators_are_printed_by_type_and_shape(kind: str) -> None:
    recording = synthetic_recording(1, patterns=40, channels=64)
    responses = extract_responses(recording)
    timeline = fit_timeline([responses], kind=kind)
    for record in (
        recording,
        recording.stimuli,
        responses,
        timeline,
        timeline.simulators,
        inspect_recording(recording),
    ):
        text = repr(record)
        assert text.startswith(type(record).__name__ + "(")
        assert len(text) < 1200
        assert "array(" not in text
    assert f"rate_hz=float64[{len(responses)}]" in repr(responses)


def test_a_traced_simulator_is_printed_too() -> None:
    seen = []
    simulator = fit_empirical(extract_responses(synthetic_recording(1, patterns=40, channels=64)))
    jax.jit(lambda traced: seen.append(repr(traced)) or np.float32(0))(simulator)
    assert "values_hz=float32[5, " in seen[0]
