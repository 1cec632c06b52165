"""Drive a robot with a living neuronal culture: record, simulate, train, evaluate, close the loop.

The public names stand here in the order of the story. Nothing heavy is imported before a name is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from animat.gym import register_environments

if TYPE_CHECKING:
    from animat.closed_loop.loop import Loop as Loop
    from animat.coding.decoder import Decoder as Decoder
    from animat.coding.encoder import Encoder as Encoder
    from animat.coding.mapping import Linear as Linear
    from animat.coding.mapping import Mapping as Mapping
    from animat.coding.mapping import Thresholds as Thresholds
    from animat.coding.mapping import mapping_named as mapping_named
    from animat.coding.mapping import register_mapping as register_mapping
    from animat.cultures.base import Culture as Culture
    from animat.cultures.replay import ReplayCulture as ReplayCulture
    from animat.cultures.safety import Limits as Limits
    from animat.cultures.virtual import VirtualCulture as VirtualCulture
    from animat.environment import Animat as Animat
    from animat.environment import WithoutNeurons as WithoutNeurons
    from animat.errors import AnimatError as AnimatError
    from animat.errors import BodyFailed as BodyFailed
    from animat.errors import BudgetSpent as BudgetSpent
    from animat.errors import DeviceFailed as DeviceFailed
    from animat.errors import InvalidArgument as InvalidArgument
    from animat.errors import InvalidFile as InvalidFile
    from animat.errors import LoopEnded as LoopEnded
    from animat.errors import Mismatch as Mismatch
    from animat.errors import UnsafeStimulus as UnsafeStimulus
    from animat.errors import UnusableData as UnusableData
    from animat.evaluation.optimal_returns import optimal_returns as optimal_returns
    from animat.evaluation.optimum import Optimum as Optimum
    from animat.evaluation.optimum import best_return as best_return
    from animat.evaluation.optimum import best_returns as best_returns
    from animat.evaluation.statistics import compare as compare
    from animat.evaluation.table import Evaluation as Evaluation
    from animat.evaluation.table import evaluate as evaluate
    from animat.execution.training import train as train
    from animat.goals.robot import with_goal as with_goal
    from animat.neurons.memory import fit_memory as fit_memory
    from animat.neurons.simulator import NeuronSimulator as NeuronSimulator
    from animat.neurons.simulator import fit_empirical as fit_empirical
    from animat.neurons.simulator import fit_histogram as fit_histogram
    from animat.neurons.timeline import SimulatorTimeline as SimulatorTimeline
    from animat.neurons.timeline import fit_timeline as fit_timeline
    from animat.reality_gap import Calibration as Calibration
    from animat.reality_gap import run_policies as run_policies
    from animat.recordings.findings import Finding as Finding
    from animat.recordings.formats.nwb import write_nwb as write_nwb
    from animat.recordings.reading import read_recording as read_recording
    from animat.recordings.reading import read_recordings as read_recordings
    from animat.recordings.recording import Channels as Channels
    from animat.recordings.recording import Recording as Recording
    from animat.responses.condition import Condition as Condition
    from animat.responses.conditions import conditions_named as conditions_named
    from animat.responses.extraction import extract_responses as extract_responses
    from animat.responses.inspection import Inspection as Inspection
    from animat.responses.inspection import inspect_recording as inspect_recording
    from animat.responses.readouts import Readouts as Readouts
    from animat.responses.responses import Responses as Responses
    from animat.responses.series import extract_series as extract_series
    from animat.robots import Cartpole as Cartpole
    from animat.robots import Navigation as Navigation
    from animat.robots import Quantity as Quantity
    from animat.robots import Robot as Robot
    from animat.robots import SwingUp as SwingUp
    from animat.robots import TwoLinkArm as TwoLinkArm
    from animat.robots import Wheels as Wheels
    from animat.robots import register_robot as register_robot
    from animat.robots import robot_named as robot_named
    from animat.stimulation.protocol import Presentation as Presentation
    from animat.stimulation.protocol import Protocol as Protocol
    from animat.stimulation.protocol import read_protocol as read_protocol
    from animat.stimulation.selection import Selection as Selection
    from animat.stimulation.stimulus import Stimuli as Stimuli
    from animat.studies.paper import paper_study as paper_study
    from animat.studies.run import run_study as run_study
    from animat.studies.specification import Study as Study
    from animat.studies.toml import read_study as read_study
    from animat.training.callbacks import CurveRow as CurveRow
    from animat.training.callbacks import TrainingCallback as TrainingCallback
    from animat.training.policy import Policy as Policy
    from animat.training.policy import load_policies as load_policies
    from animat.training.settings import SAC as SAC
    from animat.training.specification import Training as Training
    from animat.wrappers import EpisodeLimit as EpisodeLimit
    from animat.wrappers import NeuralObservation as NeuralObservation
    from animat.wrappers import ShuffledDelivery as ShuffledDelivery

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
    "responses.condition": ("Condition",),
    "responses.conditions": ("conditions_named",),
    "responses.readouts": ("Readouts",),
    "responses.responses": ("Responses",),
    "responses.extraction": ("extract_responses",),
    "responses.series": ("extract_series",),
    "responses.inspection": ("Inspection", "inspect_recording"),
    "neurons.simulator": ("NeuronSimulator", "fit_histogram", "fit_empirical"),
    "neurons.memory": ("fit_memory",),
    "neurons.timeline": ("SimulatorTimeline", "fit_timeline"),
    "coding.encoder": ("Encoder",),
    "coding.decoder": ("Decoder",),
    "coding.mapping": ("Mapping", "Thresholds", "Linear", "register_mapping", "mapping_named"),
    "robots": (
        "Robot",
        "Quantity",
        "Cartpole",
        "Navigation",
        "SwingUp",
        "TwoLinkArm",
        "Wheels",
        "register_robot",
        "robot_named",
    ),
    "goals.robot": ("with_goal",),
    "environment": ("Animat", "WithoutNeurons"),
    "wrappers": ("EpisodeLimit", "ShuffledDelivery", "NeuralObservation"),
    "training.settings": ("SAC",),
    "training.specification": ("Training",),
    "training.callbacks": ("CurveRow", "TrainingCallback"),
    "execution.training": ("train",),
    "training.policy": ("Policy", "load_policies"),
    "evaluation.table": ("Evaluation", "evaluate"),
    "evaluation.optimum": ("Optimum", "best_return", "best_returns"),
    "evaluation.optimal_returns": ("optimal_returns",),
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
        "BodyFailed",
    ),
}
"""The modules of the public names, in the order of the story."""
_MODULE_OF = {name: module for module, names in _WHERE.items() for name in names}

__all__ = list(_MODULE_OF)

# Gymnasium has known plugins only by their import since 1.0. Nothing of an environment is loaded by this.
register_environments()


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'animat' has no attribute {name!r}")
    return getattr(importlib.import_module(f"animat.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
