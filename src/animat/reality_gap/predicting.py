"""What the recording's simulator says that policies and controls will return, and how well it can know."""

from __future__ import annotations

import os
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
from animat.evaluation.rollouts import Episodes, Uniform, roll_out
from animat.progress import Progress, Silent
from animat.reality_gap.answered import Commanded
from animat.reality_gap.calibration import Calibration
from animat.robots.host import HostRobot

EPISODES = 200
"""Of each policy and control in one roll-out."""
ROLL_OUTS = 5
"""On the recording's simulator; one on each simulator of bootstrapped responses."""

BOOTSTRAPS_ON_HOST = 40
"""Fewer for a robot that is stepped on the host, where an episode takes a thousand times as long."""


class Predicted(NamedTuple):
    """What simulators say of one agent.

    Attributes:
        returns: of its episodes on the simulator of the recording, shape (episodes,).
        anew: its mean return on each simulator of the recording's responses drawn anew, shape (bootstraps,): it spreads
            as the recording's responses and, a little, as its episodes do.
        commanded: in all its episodes on the simulator of the recording, shape (conditions,).
        commanded_anew: on each simulator of bootstrapped responses, shape (bootstraps, conditions).
    """

    returns: Float64[np.ndarray, " episodes"]
    anew: Float64[np.ndarray, " bootstraps"]
    commanded: Commanded
    commanded_anew: Commanded

    @property
    def presented(self) -> Float64[np.ndarray, " conditions"]:
        """How often each condition is presented in an episode, on average."""
        return np.asarray(self.commanded.presented / len(self.returns))


def together(predicted: Sequence[Predicted]) -> Predicted:
    """Several policies as one agent."""
    return Predicted(
        np.concatenate([each.returns for each in predicted]),
        np.mean([each.anew for each in predicted], axis=0),
        _stacked([each.commanded for each in predicted]).summed(0),
        _stacked([each.commanded_anew for each in predicted]).summed(0),
    )


def _stacked(commanded: Sequence[Commanded]) -> Commanded:
    return Commanded(*(np.array(sums) for sums in zip(*commanded, strict=True)))


def predict(
    policies: Control,
    names: Sequence[str],
    controls: Sequence[Control],
    environment: Environment[Any],
    calibration: Calibration,
    *,
    seed: int = 1,
    progress: Progress | None = None,
) -> dict[str, Predicted]:
    """Run policies and controls on the simulator of a recording, and on those of its responses drawn anew.

    Args:
        policies: as they act, side by side.
        names: of each of them.
        controls: beside them.
        environment: robot and mapping, and what policies see besides.
        seed: decides every random draw.
        progress: told after the policies and each control.

    Returns:
        By the name of the policy or control.
    """
    progress = progress or Silent()
    simulators, episodes_each = [calibration.simulator] * ROLL_OUTS + list(calibration.bootstraps), EPISODES
    if isinstance(environment.robot, HostRobot):
        simulators = simulators[: ROLL_OUTS + BOOTSTRAPS_ON_HOST]
        episodes_each = episodes_on_host(environment.robot)
    acting = [policies, *map(_by_anybody, controls)]

    def rolled(number: int, on: int) -> Episodes:
        control, drawn = acting[number], roll_out_seed(seed, number, on)
        within = control.within(environment, simulators[on])
        return roll_out(*within, control.actor, control.n_actors, episodes=episodes_each, seed=drawn)

    found: dict[str, Predicted] = {}
    # A body on the host hangs in the first thread or is not noticed (`animat.robots.host.time_limit`).
    on_host = isinstance(environment.robot, HostRobot)
    with nullcontext() if on_host else ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        side_by_side = map if pool is None else pool.map
        # First one of each kind: two of a kind that start together would both be compiled.
        progress.update(0, len(acting), "compiling")
        kinds = {_program_of(control): number for number, control in enumerate(acting)}
        list(side_by_side(rolled, kinds.values(), repeat(0)))
        for number, control in enumerate(acting):
            progress.update(number, len(acting), control.name)
            episodes = list(side_by_side(rolled, repeat(number), range(len(simulators))))
            returns = np.array([each.returns for each in episodes])
            commanded = _stacked([Commanded(each.presented, each.commanded) for each in episodes])
            rows = {control.name: [*range(control.n_actors)]} if number else {name: [i] for i, name in enumerate(names)}
            for name, of in rows.items():
                each = Commanded(*(sums[:, of] for sums in commanded)).summed(1)
                found[name] = Predicted(
                    returns[:ROLL_OUTS, of].ravel(),
                    returns[ROLL_OUTS:, of].mean(axis=(1, 2)),
                    Commanded(*(sums[:ROLL_OUTS] for sums in each)).summed(0),
                    Commanded(*(sums[ROLL_OUTS:] for sums in each)),
                )
    return found


def episodes_on_host(robot: HostRobot) -> int:
    """Of each policy on each simulator: twenty, or fewer of more than 200 iterations, but four at least."""
    return max(4, min(20, 4_000 // robot.episode_limit))


def roll_out_seed(seed: int, group: int, on: int) -> int:
    """One of its own for each roll-out, and others for every `seed`: no interval is surer than its episodes are."""
    return int(np.random.SeedSequence((seed, group, on)).generate_state(1)[0])


def _by_anybody(control: Control) -> Control:
    """With random choices, where they decide nothing: without stimuli, or where what is delivered is drawn anyway."""
    if control.delivery not in ("silent", "shuffled"):
        return control
    delivery: Delivered = "silent" if control.delivery == "silent" else "chosen"
    return replace(control, actor=Uniform(), n_actors=1, delivery=delivery)


def _program_of(control: Control) -> tuple[Hashable, ...]:
    """What decides which program its episodes run in."""
    return type(control.actor), control.delivery, control.is_drawn, control.is_turned_round, control.switch_at
