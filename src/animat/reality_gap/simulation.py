"""The policies of a session on the simulator of the calibrating recording, where their controls are prepared."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from jaxtyping import Float64

from animat.closed_loop.agents import Agent, agent_of
from animat.closed_loop.loop import Loop
from animat.environment import Animat, Environment
from animat.errors import InvalidArgument
from animat.evaluation.controllers import Controller
from animat.evaluation.controls import Control, controls_of, interventions_of
from animat.evaluation.rollouts import Networks, networks_of
from animat.neurons.simulator import NeuronSimulator
from animat.reality_gap.calibration import Calibration
from animat.robots.host import HostRobot
from animat.robots.starts import Starts
from animat.training.policy import Policy
from animat.wrappers import NeuralObservation

INTERVENTION_EPISODES = 100
"""Fewest episodes of each policy on the simulator, with an ideal actuator and for the median length of an episode."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """The trained policies, and the simulator of the calibrating recording, on which controls are prepared."""

    trained: Control
    networks: Networks
    animat: Animat[Any]
    environment: Environment[Any]
    simulator: NeuronSimulator
    seed: int
    starts: Starts | None

    @classmethod
    def of(
        cls,
        policies: Mapping[str, Policy],
        loop: Loop,
        calibration: Calibration,
        *,
        greedy: bool,
        seed: int,
        starts: Starts | None,
    ) -> Self:
        animat = Animat(loop.robot, loop.mapping, len(loop.conditions))
        sees_neurons = next(iter(policies.values())).neural_observation
        environment: Environment[Any] = NeuralObservation(animat) if sees_neurons else animat
        networks = networks_of(list(policies.values()), greedy=greedy)
        trained = Control("policies", "as trained", networks)
        return cls(trained, networks, animat, environment, calibration.simulator, seed, starts)

    @property
    def within(self) -> tuple[Environment[Any], NeuronSimulator]:
        return self.environment, self.simulator

    def controls(self, labels: Sequence[str]) -> list[Control]:
        """All controls; the heuristic stays last, as random numbers depend on the place."""
        return sorted(controls_of(*self.within, labels, self.networks), key=lambda control: control.name == "heuristic")

    def interventions(self) -> tuple[list[Control], tuple[Control, Float64[np.ndarray, " episodes"]]]:
        """The interventions that a loop can run, and the ideal actuator with its returns on the simulator."""
        if isinstance(robot := self.environment.robot, HostRobot):
            got = f"{robot.name}, which is stepped outside JAX"
            raise InvalidArgument(f"--interventions: expected a robot in JAX, got {got}")
        rounds = 1 if self.starts is None else self.starts.rounds
        # From each start equally many.
        episodes = rounds * math.ceil(INTERVENTION_EPISODES / rounds)
        simulated: dict[str, Any] = {"episodes": episodes, "seed": self.seed, "starts": self.starts}
        half_way = self.trained.run(*self.within, **simulated).half_way
        actuator, *changed = interventions_of(*self.within, self.networks, switch_at=half_way)
        returns = actuator.run(*self.within, **simulated).returns.ravel()
        # The other two are controls already.
        return [each for each in changed if each.name not in ("silent", "shuffled")], (actuator, returns)

    def agents(
        self, policies: Mapping[str, Controller], controls: Sequence[Control], calibration: Calibration
    ) -> list[Agent]:
        """What takes turns in the loop: the policies, then the controls."""
        pooled = np.concatenate(calibration.responses_hz)
        own = [Agent(name, self.trained.meaning, controller) for name, controller in policies.items()]
        return own + [agent_of(control, self.animat, policies, pooled) for control in controls]
