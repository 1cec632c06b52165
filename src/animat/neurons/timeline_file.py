"""A simulator timeline as a file, without code, that needs no recordings."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from animat.errors import AnimatError, InvalidFile
from animat.neurons.fidelity import Fidelity
from animat.neurons.joint_histogram import JointHistogramSimulator
from animat.neurons.memory import MemorySimulator
from animat.neurons.simulator import EmpiricalSimulator, HistogramSimulator, to_jax
from animat.neurons.timeline import SimulatorTimeline
from animat.recordings.findings import Finding
from animat.responses.condition import Condition
from animat.responses.readouts import Readouts
from animat.stimulation.protocol import Presentation
from animat.writing import write_whole

_KINDS = {
    kind.__name__: kind for kind in (HistogramSimulator, JointHistogramSimulator, EmpiricalSimulator, MemorySimulator)
}


def save_timeline(timeline: SimulatorTimeline, path: Path) -> Path:
    """Write the simulators as safetensors, with everything but arrays as JSON metadata; always the same bytes."""
    arrays = {name: np.ascontiguousarray(array) for name, array in vars(timeline.simulators).items()}
    metadata = {
        "kind": type(timeline.simulators).__name__,
        "start_min": timeline.start_min.tolist(),
        "conditions": [asdict(condition) for condition in timeline.conditions],
        "window_ms": timeline.window_ms,
        "presentation": None if timeline.presentation is None else asdict(timeline.presentation),
        "in_data": [kept.in_data.tolist() for kept in timeline.fidelities],
        "in_simulator": [kept.in_simulator.tolist() for kept in timeline.fidelities],
        "n_above_range": [kept.n_above_range for kept in timeline.fidelities],
        "findings": [asdict(finding) for finding in timeline.findings],
        "fitted": timeline.fitted,
        **({} if timeline.readouts.are_all else {"readouts": timeline.readouts.to_dict()}),
    }
    return write_whole(path, save(arrays, metadata={"animat": json.dumps(metadata, sort_keys=True)}))


def load_timeline(path: Path) -> SimulatorTimeline:
    """Read what `save_timeline` wrote; raises InvalidFile if it cannot be read."""
    try:
        with safe_open(path, framework="numpy") as file:
            metadata: dict[str, Any] = json.loads(file.metadata()["animat"])
            arrays = {name: to_jax(file.get_tensor(name), None) for name in file.keys()}  # noqa: SIM118 - no dictionary
        conditions = tuple(Condition(**each) for each in metadata["conditions"])
        labels = tuple(condition.label for condition in conditions)
        presentation = metadata["presentation"]
        kept = zip(metadata["in_data"], metadata["in_simulator"], metadata["n_above_range"], strict=True)
        readouts = Readouts.from_dict(metadata.get("readouts"))
        return SimulatorTimeline(
            simulators=_KINDS[metadata["kind"]](**arrays),
            start_min=np.array(metadata["start_min"], np.float64),
            conditions=conditions,
            window_ms=tuple(metadata["window_ms"]),
            presentation=None if presentation is None else Presentation(**presentation),
            fidelities=tuple(Fidelity(labels, np.array(a), np.array(b), n, readouts.names) for a, b, n in kept),
            findings=tuple(Finding.from_dict(each) for each in metadata["findings"]),
            fitted=metadata["fitted"],
            readouts=readouts,
        )
    except (OSError, ValueError, KeyError, TypeError, SafetensorError, AnimatError) as error:
        raise InvalidFile(f"{path}: expected a study's simulators, got a file that cannot be read: {error}") from error
