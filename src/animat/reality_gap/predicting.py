"""The returns of policies and controls that the recording's simulator predicts, with their uncertainty."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from animat.environment import Environment
from animat.evaluation.controls import Control, Delivered
from animat.evaluation.rollouts import Episodes, Uniform
from animat.process import own_cores
from animat.progress import Progress, Silent
from animat.reality_gap.calibration import Calibration
from animat.reality_gap.session_responses import CommandSums
from animat.robots.host import HostRobot

EPISODES = 200
"""Episodes of each policy and control in one roll-out."""
ROLL_OUTS = 5
"""Roll-outs on the recording's simulator; there is one on each bootstrap simulator."""
BOOTSTRAPS_ON_HOST = 40
"""Bootstraps for a robot that is stepped outside JAX: fewer, as an episode takes a thousand times as long."""


class Prediction(NamedTuple):
    """The predictions for one agent.

    Attributes:
        returns: of its episodes on the recording's simulator.
        bootstrap_means: its mean return on each bootstrap simulator; their spread is due to the recording's responses
            and, a little, to the episodes.
        commanded: in all its episodes on the recording's simulator; `commanded_bootstraps`: on each bootstrap one.
    """

    returns: Float64[np.ndarray, " episodes"]
    bootstrap_means: Float64[np.ndarray, " bootstraps"]
    commanded: CommandSums
    commanded_bootstraps: CommandSums

    @property
    def presented(self) -> Float64[np.ndarray, " conditions"]:
        """How often each condition is presented in an episode, on average."""
        return np.asarray(self.commanded.presented / len(self.returns))


def pool(predicted: Sequence[Prediction]) -> Prediction:
    """The predictions of several policies as one."""
    return Prediction(
        np.concatenate([each.returns for each in predicted]),
        np.mean([each.bootstrap_means for each in predicted], axis=0),
        _stacked([each.commanded for each in predicted]).summed(0),
        _stacked([each.commanded_bootstraps for each in predicted]).summed(0),
    )


def _stacked(commanded: Sequence[CommandSums]) -> CommandSums:
    return CommandSums(*(np.array(sums) for sums in zip(*commanded, strict=True)))


def predict(
    policies: Control,
    names: Sequence[str],
    controls: Sequence[Control],
    environment: Environment[Any],
    calibration: Calibration,
    *,
    seed: int = 1,
    progress: Progress | None = None,
) -> dict[str, Prediction]:
    """The prediction for each policy and control, by its name: on a recording's simulator and its bootstrap simulators.

    The policies are side by side, with their `names`.
    """
    progress = progress or Silent()
    simulators, episodes_each = [calibration.simulator] * ROLL_OUTS + list(calibration.bootstraps), EPISODES
    if isinstance(environment.robot, HostRobot):
        simulators = simulators[: ROLL_OUTS + BOOTSTRAPS_ON_HOST]
        episodes_each = episodes_on_host(environment.robot)
    acting = [policies, *map(_with_random_actor, controls)]

    def run(number: int, on: int) -> Episodes:
        drawn = roll_out_seed(seed, number, on)
        return acting[number].run(environment, simulators[on], episodes=episodes_each, seed=drawn)

    predictions: dict[str, Prediction] = {}
    # A hanging body on the host is only noticed in the main thread (`animat.robots.host.time_limit`).
    on_host = isinstance(environment.robot, HostRobot)
    with nullcontext() if on_host else ThreadPoolExecutor(len(own_cores())) as executor:
        side_by_side = map if executor is None else executor.map
        # First one of each kind: two of a kind that start at the same time would both be compiled.
        progress.update(0, len(acting), "compiling")
        kinds = {_program_of(control): number for number, control in enumerate(acting)}
        list(side_by_side(run, kinds.values(), repeat(0)))
        for number, control in enumerate(acting):
            progress.update(number, len(acting), control.name)
            episodes = list(side_by_side(run, repeat(number), range(len(simulators))))
            returns = np.array([each.returns for each in episodes])
            presented = np.array([each.presented for each in episodes])
            total = np.array([each.commanded for each in episodes]).reshape(*presented.shape, -1)
            rows = {name: [i] for i, name in enumerate(names)}
            if number:
                rows = {control.name: [*range(control.actor.n_actors)]}
            for name, of in rows.items():
                each = CommandSums(presented[:, of], total[:, of]).summed(1)
                predictions[name] = Prediction(
                    returns[:ROLL_OUTS, of].ravel(),
                    returns[ROLL_OUTS:, of].mean(axis=(1, 2)),
                    CommandSums(*(sums[:ROLL_OUTS] for sums in each)).summed(0),
                    CommandSums(*(sums[ROLL_OUTS:] for sums in each)),
                )
    return predictions


def episodes_on_host(robot: HostRobot) -> int:
    """Episodes of each policy on each simulator: 20, or fewer if longer than 200 iterations, but at least 4."""
    return max(4, min(20, 4_000 // robot.episode_limit))


def roll_out_seed(seed: int, group: int, on: int) -> int:
    """A different seed for each roll-out and each `seed`, so that intervals include the chance of their episodes."""
    return int(np.random.SeedSequence((seed, group, on)).generate_state(1)[0])


def _with_random_actor(control: Control) -> Control:
    """With random choices if they have no effect: without stimuli, or if the delivered condition is random anyway."""
    if control.delivery not in ("silent", "shuffled"):
        return control
    delivery: Delivered = "silent" if control.delivery == "silent" else "chosen"
    return replace(control, actor=Uniform(), delivery=delivery)


def _program_of(control: Control) -> tuple[Hashable, ...]:
    """What determines the compiled program of its episodes."""
    return type(control.actor), control.delivery, control.is_drawn, control.is_turned_round, control.switch_at
