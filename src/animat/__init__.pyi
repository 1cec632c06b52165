"""The public names in the order of the story, each with the module it is imported from when it is used."""

# ruff: noqa: I001

__version__: str

from animat.recordings.recording import Recording as Recording, Channels as Channels
from animat.stimulation.stimulus import Stimuli as Stimuli
from animat.stimulation.protocol import (
    Presentation as Presentation,
    Protocol as Protocol,
    read_protocol as read_protocol,
)
from animat.stimulation.pulse import PUBLISHED_PULSE as PUBLISHED_PULSE, BALANCED_PULSE as BALANCED_PULSE
from animat.stimulation.selection import Selection as Selection, SelectionRule as SelectionRule
from animat.recordings.findings import Finding as Finding
from animat.recordings.reading import (
    read_recording as read_recording,
    read_recordings as read_recordings,
    read_source as read_source,
)
from animat.recordings.formats.nwb import write_nwb as write_nwb
from animat.recordings.conversion import Origin as Origin, convert_recording as convert_recording
from animat.progress import Bar as Bar
from animat.cultures.base import Culture as Culture
from animat.cultures.safety import Limits as Limits, SIMULATED_LIMITS as SIMULATED_LIMITS
from animat.cultures.virtual import VirtualCulture as VirtualCulture
from animat.cultures.replay import ReplayCulture as ReplayCulture
from animat.cultures.devices.maxone import MaxOneCulture as MaxOneCulture
from animat.cultures.devices.cl1 import CL1Culture as CL1Culture
from animat.cultures.series import record_series as record_series
from animat.responses.condition import Condition as Condition
from animat.responses.conditions import conditions_named as conditions_named
from animat.responses.readouts import Readouts as Readouts
from animat.responses.responses import Responses as Responses
from animat.responses.extraction import extract_responses as extract_responses
from animat.responses.extraction import extract_series as extract_series
from animat.responses.inspection import Inspection as Inspection, inspect_recording as inspect_recording
from animat.neurons.simulator import (
    NeuronSimulator as NeuronSimulator,
    fit_histogram as fit_histogram,
    fit_empirical as fit_empirical,
)
from animat.neurons.memory import fit_memory as fit_memory
from animat.neurons.timeline import SimulatorTimeline as SimulatorTimeline, fit_timeline as fit_timeline
from animat.neurons.validation import Validation as Validation, validate as validate
from animat.coding.encoder import Encoder as Encoder
from animat.coding.decoder import Decoder as Decoder
from animat.coding.mapping import (
    Mapping as Mapping,
    Thresholds as Thresholds,
    Linear as Linear,
    register_mapping as register_mapping,
    mapping_named as mapping_named,
)
from animat.robots import (
    Robot as Robot,
    Quantity as Quantity,
    Cartpole as Cartpole,
    Navigation as Navigation,
    SwingUp as SwingUp,
    TwoLinkArm as TwoLinkArm,
    Wheels as Wheels,
    register_robot as register_robot,
    robot_named as robot_named,
)
from animat.goals.robot import with_goal as with_goal
from animat.environment import Animat as Animat, WithoutNeurons as WithoutNeurons
from animat.wrappers import (
    EpisodeLimit as EpisodeLimit,
    ShuffledDelivery as ShuffledDelivery,
    NeuralObservation as NeuralObservation,
)
from animat.training.settings import SAC as SAC
from animat.training.specification import Training as Training
from animat.training.lessons import Lesson as Lesson
from animat.execution.curves import CurveRow as CurveRow, TrainingCallback as TrainingCallback
from animat.execution.training import train as train
from animat.training.policy import Policy as Policy, load_policies as load_policies
from animat.evaluation.result import Evaluation as Evaluation
from animat.evaluation.table import evaluate as evaluate
from animat.evaluation.optimum import Optimum as Optimum, best_return as best_return, best_returns as best_returns
from animat.evaluation.optimal_returns import optimal_returns as optimal_returns
from animat.evaluation.statistics import compare as compare
from animat.closed_loop.loop import Loop as Loop
from animat.closed_loop.session import read_session as read_session
from animat.reality_gap import Calibration as Calibration, run_policies as run_policies
from animat.studies.specification import Study as Study
from animat.studies.paper import paper_study as paper_study
from animat.studies.toml import read_study as read_study
from animat.studies.run import run_study as run_study
from animat.errors import (
    AnimatError as AnimatError,
    InvalidArgument as InvalidArgument,
    InvalidFile as InvalidFile,
    UnusableData as UnusableData,
    Mismatch as Mismatch,
    UnsafeStimulus as UnsafeStimulus,
    BudgetSpent as BudgetSpent,
    LoopEnded as LoopEnded,
    DeviceFailed as DeviceFailed,
    BodyFailed as BodyFailed,
)
