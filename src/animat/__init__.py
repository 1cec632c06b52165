"""Drive a robot with a living neuronal culture: record, simulate, train, evaluate, close the loop.

The public names stand here in the order of the story. Nothing heavy is imported before a name is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from animat.gym import register_environments

if TYPE_CHECKING:
    from animat.animat import Animat, WithoutNeurons
    from animat.closed_loop.loop import Loop
    from animat.cultures.base import Culture
    from animat.cultures.replay import ReplayCulture
    from animat.cultures.safety import Limits
    from animat.cultures.virtual import VirtualCulture
    from animat.errors import (
        AnimatError,
        BudgetSpent,
        DeviceFailed,
        InvalidArgument,
        InvalidFile,
        LoopEnded,
        Mismatch,
        UnsafeStimulus,
        UnusableData,
    )
    from animat.evaluation.optimum import Optimum, best_return, best_returns
    from animat.evaluation.prospects import prospects
    from animat.evaluation.statistics import compare
    from animat.evaluation.table import Evaluation, evaluate
    from animat.mapping import Linear, Mapping, Thresholds, mapping_named
    from animat.neurons.conditions import Condition, conditions_named
    from animat.neurons.extraction import extract_responses
    from animat.neurons.inspection import Inspection, inspect_recording
    from animat.neurons.memory import fit_memory
    from animat.neurons.responses import Responses
    from animat.neurons.series import extract_series
    from animat.neurons.simulator import NeuronSimulator, fit_empirical, fit_histogram
    from animat.neurons.timeline import SimulatorTimeline, fit_timeline
    from animat.reality_gap import Calibration, run_policies
    from animat.recordings.findings import Finding
    from animat.recordings.formats.nwb import write_nwb
    from animat.recordings.reading import read_recording, read_recordings
    from animat.recordings.recording import Channels, Recording
    from animat.robots import Cartpole, Navigation, Robot, robot_named
    from animat.stimulation.protocol import Presentation, Protocol, read_protocol
    from animat.stimulation.selection import Selection
    from animat.stimulation.stimulus import Stimuli
    from animat.studies.paper import paper_study
    from animat.studies.run import run_study
    from animat.studies.specification import Study
    from animat.studies.toml import read_study
    from animat.training.policy import Policy, load_policies
    from animat.training.sac import SAC
    from animat.training.specification import Training
    from animat.training.trainer import train

_WHERE = {
    "recordings.recording": ("Recording", "Channels"),
    "stimulation.stimulus": ("Stimuli",),
    "stimulation.protocol": ("Presentation", "Protocol", "read_protocol"),
    "stimulation.selection": ("Selection",),
    "recordings.findings": ("Finding",),
    "recordings.reading": ("read_recording", "read_recordings"),
    "recordings.formats.nwb": ("write_nwb",),
    "cultures.base": ("Culture",),
    "cultures.safety": ("Limits",),
    "cultures.virtual": ("VirtualCulture",),
    "cultures.replay": ("ReplayCulture",),
    "neurons.conditions": ("Condition", "conditions_named"),
    "neurons.responses": ("Responses",),
    "neurons.extraction": ("extract_responses",),
    "neurons.series": ("extract_series",),
    "neurons.inspection": ("Inspection", "inspect_recording"),
    "neurons.simulator": ("NeuronSimulator", "fit_histogram", "fit_empirical"),
    "neurons.memory": ("fit_memory",),
    "neurons.timeline": ("SimulatorTimeline", "fit_timeline"),
    "mapping": ("Mapping", "Thresholds", "Linear", "mapping_named"),
    "robots": ("Robot", "Cartpole", "Navigation", "robot_named"),
    "animat": ("Animat", "WithoutNeurons"),
    "training.sac": ("SAC",),
    "training.specification": ("Training",),
    "training.trainer": ("train",),
    "training.policy": ("Policy", "load_policies"),
    "evaluation.table": ("Evaluation", "evaluate"),
    "evaluation.optimum": ("Optimum", "best_return", "best_returns"),
    "evaluation.prospects": ("prospects",),
    "evaluation.statistics": ("compare",),
    "closed_loop.loop": ("Loop",),
    "reality_gap": ("Calibration", "run_policies"),
    "studies.specification": ("Study",),
    "studies.paper": ("paper_study",),
    "studies.toml": ("read_study",),
    "studies.run": ("run_study",),
    "errors": (
        "AnimatError",
        "InvalidArgument",
        "InvalidFile",
        "UnusableData",
        "Mismatch",
        "UnsafeStimulus",
        "BudgetSpent",
        "LoopEnded",
        "DeviceFailed",
    ),
}
_MODULE_OF = {name: module for module, names in _WHERE.items() for name in names}

__all__ = [  # noqa: RUF022  (the order of the story)
    "Recording",
    "Channels",
    "Stimuli",
    "Presentation",
    "Protocol",
    "read_protocol",
    "Selection",
    "Finding",
    "read_recording",
    "read_recordings",
    "write_nwb",
    "Culture",
    "Limits",
    "VirtualCulture",
    "ReplayCulture",
    "Condition",
    "conditions_named",
    "Responses",
    "extract_responses",
    "extract_series",
    "Inspection",
    "inspect_recording",
    "NeuronSimulator",
    "fit_histogram",
    "fit_empirical",
    "fit_memory",
    "SimulatorTimeline",
    "fit_timeline",
    "Mapping",
    "Thresholds",
    "Linear",
    "mapping_named",
    "Robot",
    "Cartpole",
    "Navigation",
    "robot_named",
    "Animat",
    "WithoutNeurons",
    "SAC",
    "Training",
    "train",
    "Policy",
    "load_policies",
    "Evaluation",
    "evaluate",
    "Optimum",
    "best_return",
    "best_returns",
    "prospects",
    "compare",
    "Loop",
    "Calibration",
    "run_policies",
    "Study",
    "paper_study",
    "read_study",
    "run_study",
    "AnimatError",
    "InvalidArgument",
    "InvalidFile",
    "UnusableData",
    "Mismatch",
    "UnsafeStimulus",
    "BudgetSpent",
    "LoopEnded",
    "DeviceFailed",
]

# Gymnasium has known plugins only by their import since 1.0. Nothing of an environment is loaded by this.
register_environments()


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'animat' has no attribute {name!r}")
    return getattr(importlib.import_module(f"animat.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
