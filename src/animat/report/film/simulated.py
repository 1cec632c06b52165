"""The scene of policies on a neuron simulator: one episode of each in sequence, in the time it would take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from animat.closed_loop.runner import runner_of
from animat.environment import Animat, Environment, Neurons, WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation.rollouts import check_seed
from animat.neurons.timeline import SimulatorTimeline
from animat.report.film.scene import Moment, Scene
from animat.report.film.session import USUAL_S
from animat.responses.condition import Condition
from animat.robots.starts import robot_generator
from animat.stimulation.protocol import Presentation
from animat.training.policy import Policy, first_of_alike
from animat.wrappers import ShuffledDelivery

_PAUSE_S = 1.0
"""Between episodes, during which the last frame stays."""
_WITHOUT_NEURONS_S = 0.02
"""An iteration of a policy that moves its robot directly, whose duration is unknown: as in Gymnasium."""
_ALIKE = ("robot", "mapping", "readouts", "conditions", "commands", "delivery", "percentiles")


def scene_of_policies(
    policies: Mapping[str, Policy],
    timeline: SimulatorTimeline | None,
    *,
    at_min: float | None = None,
    span_s: tuple[float, float] | None = None,
    seed: int = 1,
) -> Scene:
    """Run an episode of each policy with the most probable actions, until the span is over.

    Args:
        policies: by name; all with the same robot, mapping and conditions.
        timeline: the culture's simulators; None for policies without neurons.
        at_min: minute whose newest recording is used; None: the last recording.
        span_s: start and end of the film; None: the first minute.

    InvalidArgument for a span after the last episode, other conditions than the policies', or a seed above 32 bits.
    """
    check_seed(seed)
    first = first_of_alike(policies, _ALIKE, "film it alone")
    from_s, to_s = span_s or (0.0, USUAL_S)
    robot = first.robot
    environment, simulator = _environment(first, timeline, at_min)
    respond = jax.jit(environment.respond)
    state = environment.reset(jax.random.key(seed))
    rng, runner = np.random.default_rng([seed, 1]), runner_of(robot, robot_generator(seed))
    time_s, moments = 0.0, list[Moment]()
    for episode, (name, policy) in enumerate(policies.items()):
        if time_s >= to_s:
            break
        observation, neurons, total = runner.reset(episode), state.neurons, 0.0
        moments.append(Moment(time_s, name, episode, -1, episode, tuple(observation.tolist())))
        for iteration in range(robot.episode_limit):
            observed = np.concatenate([observation, np.asarray(neurons)]) if policy.neural_observation else observation
            uniforms = jnp.asarray(rng.random(environment.noise_size, np.float32))
            action = jnp.asarray(policy.act_greedily(observed))
            delivered, response, command = respond(uniforms, state._replace(neurons=neurons), action, simulator)
            neurons, u = response.history, np.asarray(command, np.float64)
            moved = runner.step(u)
            observation, total = moved.observation, total + moved.reward
            label, period_s = "", _WITHOUT_NEURONS_S
            if simulator is not None:
                condition = first.conditions[int(delivered)]
                label, period_s = condition.label, _period_s(condition, first.presentation)
            time_s += period_s
            at, rate_hz = tuple(observation.tolist()), float(np.mean(response.rate_hz))
            commands = tuple(u.tolist()) if u.ndim else float(u)
            moments.append(Moment(time_s, name, episode, iteration, episode, at, commands, total, label, rate_hz))
            if moved.terminated or moved.truncated or time_s >= to_s:
                break
        time_s += _PAUSE_S
    if from_s >= time_s:
        raise InvalidArgument(f"span_s: expected a start within the episodes' {time_s:.1f} s, got {from_s:g}")
    shown = max((each.episode for each in moments if each.time_s <= from_s), default=0)
    labels = tuple(condition.label for condition in first.conditions)
    through = "on the simulator" if simulator is not None else "without neurons"
    kept = tuple(each for each in moments if each.episode >= shown)
    return Scene(f"{robot.name} {through}", robot, labels, kept, from_s, min(time_s, to_s), seed=seed)


def _environment(
    policy: Policy, timeline: SimulatorTimeline | None, at_min: float | None
) -> tuple[Environment[Any], Neurons]:
    """What a policy acts in: through the simulator of the newest recording at a minute, or without neurons."""
    if policy.mapping is None or timeline is None:
        return WithoutNeurons(policy.robot, policy.commands), None
    if timeline.conditions != policy.conditions:
        raise InvalidArgument("recordings: expected the conditions that the policies choose from, got others")
    row = timeline.requested_row(timeline.start_min[-1] if at_min is None else at_min)
    simulator = timeline.with_percentiles(policy.percentiles).at(float(timeline.start_min[row]))
    environment: Environment[Any] = Animat(policy.robot, policy.mapping, len(policy.conditions))
    return ShuffledDelivery(environment) if policy.delivery == "shuffled" else environment, simulator


def _period_s(condition: Condition, presentation: Presentation | None) -> float:
    """How long a trial of a condition takes; if its frequency is not known, its pulses count as iterations."""
    pulses = 1 if presentation is None else presentation.pulses
    return pulses / (condition.frequencies_hz or (1 / _WITHOUT_NEURONS_S,))[0]
