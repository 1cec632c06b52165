"""From the options of an environment to an Animat and a neuron simulator."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from inspect import signature
from numbers import Real
from typing import Any

import numpy as np
from gymnasium import spaces

from animat.arguments import check_argument
from animat.coding.checking import check_mapping
from animat.coding.decoder import expect_readout_per_command
from animat.coding.mapping import Mapping, mapping_named
from animat.environment import Animat, Environment
from animat.errors import InvalidArgument, did_you_mean, expect_kind, expect_several
from animat.goals.goal import Goal
from animat.goals.robot import with_goal
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.synthetic import LABELS, synthetic_simulator
from animat.neurons.timeline import SimulatorKind, check_kind, fit_timeline
from animat.recordings.findings import warnings_once
from animat.recordings.reading import read_sources
from animat.registry import is_ours
from animat.responses.conditions import conditions_named
from animat.responses.extraction import extract_series
from animat.responses.readouts import DEFAULT_READOUTS, Readouts, count_readouts, readouts_named
from animat.responses.windows import check_window
from animat.robots.base import Robot
from animat.robots.checking import check_robot
from animat.robots.host import HostRobot
from animat.robots.registry import robot_named
from animat.wrappers import Delivery, EpisodeLimit, NeuralObservation, ShuffledDelivery

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


@dataclass(frozen=True, eq=False)
class Setup:
    """What an environment runs on; `condition_labels` are those of the actions 0, 1, ..., such as `("5 Hz", ...)`."""

    environment: EpisodeLimit[Any]
    simulator: NeuronSimulator
    condition_labels: tuple[str, ...]

    @property
    def observation_space(self) -> spaces.Box:
        """The observations, in their own units, within bounds that no episode exceeds."""
        spec = self.environment.observation_spec
        low, high = (np.array([getattr(q, end) for q in spec], np.float32) for end in ("low", "high"))
        return spaces.Box(low, high, dtype=np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        """The conditions."""
        return spaces.Discrete(len(self.condition_labels))


def set_up(
    robot: str,
    *,
    goal: str | Goal | None = None,
    mapping: str | Mapping = "1-threshold",
    recordings: Paths | None = None,
    simulator: NeuronSimulator | None = None,
    at_min: float | None = None,
    conditions: str | None = None,
    window_ms: tuple[float, float] | None = None,
    kind: SimulatorKind | None = None,
    readouts: str | Readouts | None = None,
    delivery: Delivery = "chosen",
    neural_observation: bool = False,
    **parameters: float,
) -> Setup:
    """Read the options of `Animat/...` environments.

    Args:
        robot: its name, or where to import it from (`robot_named`); set by the environment's id except for `Robot-v0`.
        goal: that replaces the robot's own task, as text or a `Goal` (`animat.with_goal`).
        mapping: from a response to a motor command, or its name: `1-threshold`, `9-thresholds`, `linear`, or your own,
            which may also be named by where to import it from.
        recordings: files or folders of recordings of one culture, to which the neuron simulator is fitted.
        simulator: an existing simulator, in place of `recordings`. Without either, responses come from the five
            conditions of `animat.neurons.synthetic`.
        at_min: which recording's simulator, in minutes on the culture's clock: the newest at that time; None: the
            first.
        conditions: what the agent picks from, `frequency`, `interval:5,10+-25%`, ...; None: what the recording has.
        window_ms: start and end of the response window after a stimulus; None: 2 to 10 ms, or a table's own.
        kind: `histogram` (the paper), `empirical` or `memory`; None: what suits the recordings (`fit_timeline`).
        readouts: of the recordings, as many as the robot takes commands: `halves`, `quadrants`, or groups; None: all
            channels as one or, for several commands, the default of `animat train`.
        delivery: `chosen`, or `shuffled` for the control in which the neurons get a random condition.
        neural_observation: whether the neurons' history state is observed too (`animat.wrappers.NeuralObservation`).
        parameters: of the robot, `pole_mass_kg=0.55`.

    Raises:
        InvalidArgument: for options that are unknown or incompatible, and for a robot or a mapping of your own that
            breaks its contract.
        InvalidFile: for recordings that cannot be read.
        UnusableData: for recordings that no controller can learn from.
    """
    body = _robot(robot, parameters)
    if goal is not None:
        body = with_goal(body, goal)
    for caveat in body.caveats():
        warnings.warn(caveat, stacklevel=2)
    expect_kind("simulator", simulator, NeuronSimulator | None, "a simulator; `kind` takes the name of one")
    if recordings is not None and not isinstance(recordings, str | os.PathLike):
        recordings = expect_several("recordings", recordings, str | os.PathLike, "a path or several")
    if recordings is not None and simulator is not None:
        raise InvalidArgument("recordings, simulator: expected one of them, got both")
    expect_kind("at_min", at_min, Real | None, "a number of minutes")
    if window_ms is not None:
        check_window(window_ms)
    reading = {"at_min": at_min, "conditions": conditions, "kind": kind, "readouts": readouts, "window_ms": window_ms}
    for name, value in reading.items():
        if value is not None and recordings is None:
            raise InvalidArgument(f"{name}: expected only with recordings, as it sets how they are read")
    # All that can be checked before recordings are read, which can take a while.
    by = None if conditions is None else conditions_named(conditions)
    if kind is not None:
        check_kind(kind)
    expect_kind("neural_observation", neural_observation, bool, "True or False")
    if delivery not in ("chosen", "shuffled"):
        raise InvalidArgument(f"delivery: expected 'chosen' or 'shuffled', got {delivery!r}")
    chosen = mapping if isinstance(mapping, Mapping) else mapping_named(mapping)
    if not is_ours(chosen):
        check_mapping(chosen)
    if recordings is not None:
        read = readouts or DEFAULT_READOUTS.get(body.n_commands, "all")
        check_argument("readouts", read, str | Readouts)
        read = readouts_named(read) if isinstance(read, str) else read
        expect_readout_per_command(body.name, body.n_commands, count_readouts(read))
        series = extract_series(read_sources(recordings), by, window_ms, readouts=read)
        timeline = fit_timeline(series, kind=kind)
        for message in warnings_once(timeline.findings):
            warnings.warn(message, stacklevel=2)
        row = 0 if at_min is None else timeline.requested_row(at_min)
        simulator = timeline.at(timeline.start_min[row])
        labels = tuple(condition.label for condition in timeline.conditions)
    elif simulator is not None:
        expect_readout_per_command(body.name, body.n_commands, simulator.n_readouts)
        labels = tuple(f"condition {i}" for i in range(simulator.n_conditions))
    elif body.n_commands > 1:
        raise InvalidArgument(
            f"recordings: expected some for {body.name}, which takes {body.n_commands} commands: synthetic responses "
            "have only one readout"
        )
    else:
        simulator, labels = synthetic_simulator(), LABELS
    environment: Environment[Any] = Animat(body, chosen, simulator.n_conditions)
    if delivery == "shuffled":
        environment = ShuffledDelivery(environment)
    if neural_observation:
        environment = NeuralObservation(environment)
    return Setup(EpisodeLimit(environment), simulator, labels)


def _robot(name: str, parameters: dict[str, Any]) -> Robot[Any]:
    """The robot of this name, checked if it is not one of ours; an error hints at a misspelt option."""
    if name == "":
        raise InvalidArgument(
            "robot: expected a name, as in gymnasium.make('Animat/Robot-v0', robot='shuttle'), got none"
        )
    try:
        robot = robot_named(name, **parameters)
    except InvalidArgument as error:
        # A misspelt option is taken for a parameter of the robot.
        named = [parameter for parameter in parameters if str(error).endswith(repr(parameter))]
        hint = did_you_mean(named[0], signature(set_up).parameters) if named else ""
        if "max_episode_steps" in named:
            hint = ": the robot's own is episode_limit"
        raise InvalidArgument(f"{error}{hint}") from None
    if isinstance(robot, HostRobot):
        raise InvalidArgument(
            f"robot: expected one stepped in JAX, got {robot.name}, which Gymnasium steps: use it with animat train"
        )
    if not is_ours(robot):
        check_robot(robot)
    return robot
