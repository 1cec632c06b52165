"""Who acts in a closed loop: policies, and the controls that ask whether it is the culture that does the work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float, Float64

from animat.robots.base import Robot, capability

LoopDelivery = Literal["chosen", "shuffled", "silent", "yoked"]
"""What the culture is given; a training (`animat.wrappers.Delivery`) has the first two alone."""


class Controller(Protocol):
    """Whoever chooses conditions: a `Policy`, or anything else that acts like one."""

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The index of the condition to present, given the robot's observation in its own units."""


@dataclass(frozen=True)
class AnyCondition:
    """Every condition equally likely, whatever is observed: the random control."""

    n_conditions: int

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        """Draw."""
        return int(rng.integers(self.n_conditions))


@dataclass(frozen=True)
class OneCondition:
    """One condition always: the constant control."""

    condition: int

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        """The same as ever."""
        return self.condition


@dataclass(frozen=True)
class Greedy:
    """A policy's most probable condition, where the policy itself would draw one."""

    policy: Any

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The most probable one."""
        return self.policy.act_greedily(observation)


@dataclass(frozen=True)
class HeuristicController:
    """The condition whose mean command is the nearest to the one that the robot's `heuristic` gives.

    Attributes:
        robot: one with a `heuristic`.
        means: the mean command of each condition; of several commands, one of each.
    """

    robot: Robot[Any]
    means: tuple[Any, ...]

    def __post_init__(self) -> None:
        # Now: what JAX compiles for a first call would come late in a loop.
        self.act(np.zeros(len(self.robot.observation_spec)), np.random.default_rng())

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        """The nearest."""
        return _nearest(self.means, np.asarray(capability(self.robot, "heuristic")(observation), np.float32))


@dataclass(frozen=True, eq=False)
class CouplingController:
    """The best coupling (`animat.evaluation.coupling`), which was found on a simulator.

    Attributes:
        coupling: as it acts there; one actor.
        scales: what the numbers of an observation are divided by.
    """

    coupling: Any
    scales: Float[np.ndarray, " observations"]

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> int:
        """The condition whose mean command is the nearest to the one that the coupling wants."""
        weights = np.asarray(self.coupling.weights)[0]
        seen = (np.asarray(observation, np.float32) / np.asarray(self.scales, np.float32))[list(self.coupling.seen)]
        drive = weights[:, :-1] @ seen + weights[:, -1]
        wanted = np.tanh(drive) if self.coupling.kind == "graded" else np.sign(drive)
        return _nearest(np.asarray(self.coupling.means)[0], wanted if len(wanted) > 1 else wanted[0])


def _nearest(means: Any, wanted: Any) -> int:
    """The condition whose mean command is the nearest; of several commands by the straight line."""
    apart = np.asarray(means, np.float32) - wanted
    return int(np.argmin(np.abs(apart) if apart.ndim == 1 else np.linalg.norm(apart, axis=1)))


@dataclass(frozen=True)
class InTurn:
    """Several who take turns, an episode each: a control is then one of all policies, and not of one of them.

    Attributes:
        by_name: who, in their order.
    """

    by_name: Mapping[str, Controller]

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Any:
        """The first one's choice; the loop takes each at its turn (`Agent.acting`)."""
        return self.acting(0).act(observation, rng)

    def acting(self, turn: int) -> Controller:
        """Whose turn it is."""
        controllers = tuple(self.by_name.values())
        return controllers[turn % len(controllers)]


@dataclass(frozen=True, eq=False)
class Agent:
    """Someone who acts in some of a session's episodes.

    Attributes:
        name: unique in its session.
        meaning: what it is, in a few words.
        controller: who chooses.
        delivery: `"chosen"`: the culture gets what was chosen; `"shuffled"`: a condition drawn anew at each iteration;
            `"silent"`: no pulse, and what the culture fires by itself is read where the response would be; `"yoked"`:
            what was given in the last whole episode of those who take turns here, over and over.
        calibrates: whether its responses count for adaptive thresholds; one condition presented over and over is
            answered otherwise than between others. The warm-up of its episodes always counts.
        drawn_from: responses that one is drawn from in place of the culture's; None: the culture's own is read.
        is_turned_round: whether every command is turned into its opposite.
        switch_at: after how many iterations the robot is given another goal; None: never.
    """

    name: str
    meaning: str
    controller: Controller
    delivery: LoopDelivery = "chosen"
    calibrates: bool = True
    drawn_from: Float64[np.ndarray, "responses *readouts"] | None = None
    is_turned_round: bool = False
    switch_at: int | None = None

    def sees_neurons(self, turn: int) -> bool:
        """Whether whoever chooses in its episode number `turn` sees the history state too."""
        controller = self.acting(turn)
        policy = controller.policy if isinstance(controller, Greedy) else controller
        return bool(getattr(policy, "neural_observation", False))

    def acting(self, turn: int) -> Controller:
        """Who chooses in the agent's episode number `turn`, counted from 0."""
        return self.controller.acting(turn) if isinstance(self.controller, InTurn) else self.controller


def random_control(n_conditions: int) -> Agent:
    """The control that chooses any condition."""
    return Agent("random", "any condition, equally likely", AnyCondition(n_conditions))


def controls(
    robot: Robot[Any],
    labels: Sequence[str],
    *,
    means: Sequence[Any] | None,
    policies: Mapping[str, Controller] | None = None,
) -> list[Agent]:
    """The controls of the study.

    Args:
        robot: that is driven.
        labels: of the conditions, in the order of their index.
        means: the mean command (or commands) of each condition, for the heuristic policy; None: without that control.
        policies: by name, who act in turn under the silent and the shuffled control; without any these two are left
            out.
    """
    found = [random_control(len(labels))]
    for i, label in enumerate(labels):
        found.append(Agent(f"constant {label}", "this one always", OneCondition(i), calibrates=False))
    if policies:
        who = InTurn(dict(policies))
        found.append(Agent("silent", "no pulse; the culture's own activity is read", who, "silent"))
        found.append(Agent("shuffled", "the delivered condition is drawn anew", who, "shuffled"))
    if means is not None:
        nearest = HeuristicController(robot, tuple(means))
        meaning = "no learning: the stimulus nearest to the command of the robot's heuristic"
        found.append(Agent("heuristic", meaning, nearest))
    return found


def interventions(
    robot: Robot[Any],
    policies: Mapping[str, Controller],
    responses_hz: Float64[np.ndarray, "responses *readouts"],
    switch_at: int,
) -> list[Agent]:
    """The same policies, in turn, in what is changed in one way each (`animat.evaluation.controls.interventions_of`).

    Only a culture's own part is changed here: who is replaced by an ideal actuator needs none, and silent and shuffled
    ones are among the controls.

    Args:
        robot: that is driven.
        policies: by name.
        responses_hz: non-burst responses of all conditions, for random spikes.
        switch_at: after how many iterations the goal is switched, where the robot can be given another one.
    """
    who = InTurn(dict(policies))
    found = [
        Agent("random spikes", "no pulse; any recorded response", who, "silent", drawn_from=responses_hz),
        Agent("yoked", "the stimuli of another episode", who, "yoked", calibrates=False),
        Agent("turned round", "the opposite of every command", who, is_turned_round=True),
    ]
    if hasattr(robot, "with_goal_of"):
        found.append(Agent("goal switched", f"another goal after {switch_at} actions", who, switch_at=switch_at))
    return found


def interleaved(episodes: Sequence[int], rng: np.random.Generator) -> list[int]:
    """Whose turn each episode is, in random order and spread evenly: whatever drifts in the culture hits all alike.

    The session is cut into as many equal parts as an agent has episodes, and one of them is in each part. Where all
    have as many, round follows round of all of them.

    Args:
        episodes: of each agent.
        rng: of the places within the parts.
    """
    places = [(part + rng.random()) / n for n in episodes for part in range(n)]
    whose = np.repeat(np.arange(len(episodes)), episodes)
    return [int(who) for who in whose[np.argsort(places, kind="stable")]]
