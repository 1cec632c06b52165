"""The returns of policies and controls that the recording's simulator predicts, with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from animat.environment import Environment
from animat.errors import some_of
from animat.evaluation.controllers import Called
from animat.evaluation.controls import Control
from animat.evaluation.rollouts import Episodes, Uniform
from animat.evaluation.statistics import Interval
from animat.process import own_cores
from animat.progress import Progress, Silent
from animat.reality_gap.calibration import Calibration
from animat.reality_gap.row import bootstrap_interval
from animat.reality_gap.session_responses import CommandSums
from animat.recordings.findings import Finding
from animat.robots.base import Robot
from animat.robots.host import HostRobot
from animat.robots.starts import Starts

EPISODES = 200
"""Episodes of each policy and control in one roll-out."""
ROLL_OUTS = 5
"""Roll-outs on the recording's simulator; there is one on each bootstrap simulator."""
MOST_ON_HOST = 20
"""Episodes of each policy in one roll-out of a robot that is stepped outside JAX, if they are short."""
BOOTSTRAPS_ON_HOST = 40
"""Bootstraps for a robot that is stepped outside JAX: fewer, as an episode takes a thousand times as long."""


class AgentPrediction(NamedTuple):
    """The predictions for one agent.

    Attributes:
        returns: of its episodes on the recording's simulator, from each of the session's starts; in one row if all
            episodes start alike.
        bootstrap_means: its mean return on each bootstrap simulator, from each start; their spread is due to the
            recording's responses and, a little, to the episodes.
        commanded: in all its episodes on the recording's simulator; `commanded_bootstraps`: on each bootstrap one.
        delivered: how often each condition is delivered in an episode from each start, on average, on the recording's
            simulator.
    """

    returns: Float64[np.ndarray, "starts episodes"]
    bootstrap_means: Float64[np.ndarray, "bootstraps starts"]
    commanded: CommandSums
    commanded_bootstraps: CommandSums
    delivered: Float64[np.ndarray, "starts conditions"]

    @property
    def interval(self) -> Interval:
        """Mean return, with its interval over bootstrap samples of the recording's responses."""
        return bootstrap_interval(self.returns.mean(), self.bootstrap_means.mean(axis=1))

    @property
    def presented(self) -> Float64[np.ndarray, " conditions"]:
        """How often each condition is presented in an episode, on average over the starts."""
        return np.asarray(self.delivered.mean(axis=0))

    def of_start(self, number: int) -> AgentPrediction:
        """The prediction from one of the starts; its commands are still those from all starts."""
        one = slice(number, number + 1)
        means = self.bootstrap_means[:, one]
        return self._replace(returns=self.returns[one], bootstrap_means=means, delivered=self.delivered[one])


def pool(predicted: Sequence[AgentPrediction]) -> AgentPrediction:
    """The predictions of several policies as one."""
    return AgentPrediction(
        np.concatenate([each.returns for each in predicted], axis=1),
        np.mean([each.bootstrap_means for each in predicted], axis=0),
        _added([each.commanded for each in predicted]),
        _added([each.commanded_bootstraps for each in predicted]),
        np.mean([each.delivered for each in predicted], axis=0),
    )


def _added(commanded: Sequence[CommandSums]) -> CommandSums:
    return CommandSums(*map(np.array, zip(*commanded, strict=True))).summed(0)


def predict_agents(
    policies: Control,
    names: Sequence[str],
    controls: Sequence[Control],
    environment: Environment[Any],
    calibration: Calibration,
    *,
    seed: int = 1,
    starts: Starts | None = None,
    progress: Progress | None = None,
) -> dict[str, AgentPrediction]:
    """The prediction for each policy and control, by its name: on a recording's simulator and its bootstrap simulators.

    The policies are side by side, with their `names`. `starts` are those of the session, equally often each; None if
    all episodes start alike.
    """
    progress = progress or Silent()
    simulators = [calibration.simulator] * ROLL_OUTS + list(calibration.bootstraps)
    on_host = isinstance(environment.robot, HostRobot)
    rounds = 1 if starts is None else starts.rounds
    acting = [policies, *map(_with_random_actor, controls)]

    def is_slow(number: int) -> bool:
        return on_host or isinstance(acting[number].actor, Called)

    def run(number: int, on: int) -> Episodes:
        drawn = roll_out_seed(seed, number, on)
        episodes = episodes_each(environment.robot, starts, is_slow=is_slow(number))
        return acting[number].run(environment, simulators[on], episodes=episodes, seed=drawn, starts=starts)

    predictions: dict[str, AgentPrediction] = {}
    # A hanging body on the host is only noticed in the main thread (`animat.robots.host.time_limit`).
    with nullcontext() if on_host else ThreadPoolExecutor(len(own_cores())) as executor:
        side_by_side = map if executor is None else executor.map
        # First one of each compiled program: two of a kind that start at the same time would both be compiled.
        progress.update(0, len(acting), "compiling")
        in_jax = {number: each for number, each in enumerate(acting) if not isinstance(each.actor, Called)}
        kinds = {
            (type(each.actor), each.delivery, each.is_drawn, each.is_turned_round, each.switch_at): number
            for number, each in in_jax.items()
        }
        list(side_by_side(run, kinds.values(), repeat(0)))
        for number, control in enumerate(acting):
            progress.update(number, len(acting), control.name)
            n = min(len(simulators), ROLL_OUTS + BOOTSTRAPS_ON_HOST) if is_slow(number) else len(simulators)
            ran = list((side_by_side if number in in_jax else map)(run, repeat(number), range(n)))
            returns = np.array([each.returns for each in ran])
            presented = np.array([each.presented for each in ran])
            total = np.array([each.commanded for each in ran]).reshape(*presented.shape, -1)
            rows = {name: [i] for i, name in enumerate(names)}
            if number:
                rows = {control.name: [*range(control.actor.n_actors)]}
            for name, of in rows.items():
                # The first `ROLL_OUTS` are on the recording's simulator, each later one on a bootstrap of it.
                from_starts = returns[:, of].reshape(len(ran), -1, rounds)
                delivered = np.array([each.delivered[of] for each in ran[:ROLL_OUTS]])
                commanded = CommandSums(presented[:, of], total[:, of]).summed(1)
                predictions[name] = AgentPrediction(
                    from_starts[:ROLL_OUTS].reshape(-1, rounds).T,
                    from_starts[ROLL_OUTS:].mean(axis=1),
                    CommandSums(*(sums[:ROLL_OUTS] for sums in commanded)).summed(0),
                    CommandSums(*(sums[ROLL_OUTS:] for sums in commanded)),
                    delivered.reshape(-1, rounds, delivered.shape[-1]).mean(axis=0),
                )
    return predictions


def episodes_on_host(robot: Robot[Any]) -> int:
    """Fewest episodes of each policy: 20, or fewer if longer than 200 iterations, but at least 4."""
    return max(4, min(MOST_ON_HOST, 4_000 // robot.episode_limit))


def episodes_each(robot: Robot[Any], starts: Starts | None, *, is_slow: bool = False) -> int:
    """Episodes of each policy in a roll-out, from each start equally many; fewer where a robot or an agent is slow."""
    least = episodes_on_host(robot) if is_slow or isinstance(robot, HostRobot) else EPISODES
    return least if starts is None else starts.rounds * math.ceil(least / starts.rounds)


def few_predicted(robot: Robot[Any], starts: Starts | None, called: Sequence[str]) -> Iterator[Finding]:
    """A note if predictions are from few episodes: the robot is stepped, or agents are `called`, outside JAX."""
    who = f"{robot.name} is stepped" if isinstance(robot, HostRobot) else f"{some_of(called)}: called" if called else ""
    if who:
        episodes = ROLL_OUTS * episodes_each(robot, starts, is_slow=True)
        few = f"from {episodes} episodes, and their intervals from {BOOTSTRAPS_ON_HOST} bootstraps"
        yield Finding("few-predicted", "note", f"{who} outside JAX: predicted returns are {few}")


def roll_out_seed(seed: int, group: int, on: int) -> int:
    """A different seed for each roll-out and each `seed`, so that intervals include the chance of their episodes."""
    return int(np.random.SeedSequence((seed, group, on)).generate_state(1)[0])


def _with_random_actor(control: Control) -> Control:
    """The control with a random actor where choices have no effect: without stimuli, or with shuffled delivery."""
    if control.delivery == "silent":
        return replace(control, actor=Uniform())
    return replace(control, actor=Uniform(), delivery="chosen") if control.delivery == "shuffled" else control
