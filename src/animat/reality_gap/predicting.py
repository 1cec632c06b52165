"""What the recording's simulator says that policies and controls will return, and how well it can know."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from itertools import repeat
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from animat.closed_loop.agents import (
    Agent,
    AnyCondition,
    CouplingController,
    Greedy,
    HeuristicController,
    InTurn,
    OneCondition,
)
from animat.environment import Environment
from animat.evaluation.controls import turned_round
from animat.evaluation.rollouts import Actor, Constant, Episodes, Uniform, networks_of, roll_out
from animat.neurons.simulator import NeuronSimulator, indifferent, silenced
from animat.progress import Progress, Silent
from animat.reality_gap.answered import Passes
from animat.reality_gap.calibration import Calibration
from animat.robots.host import HostRobot
from animat.wrappers import GoalSwitch, YokedDelivery

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
            as the recording's responses and, a little, as 200 episodes do.
        passes: in all its episodes on the simulator of the recording, shape (conditions,).
        passes_anew: on each simulator of bootstrapped responses, shape (bootstraps, conditions).
    """

    returns: Float64[np.ndarray, " episodes"]
    anew: Float64[np.ndarray, " bootstraps"]
    passes: Passes
    passes_anew: Passes

    @property
    def presented(self) -> Float64[np.ndarray, " conditions"]:
        """How often each condition is presented in an episode, on average."""
        return np.asarray(self.passes.presented / len(self.returns))


def together(predicted: Sequence[Predicted]) -> Predicted:
    """Several policies as one agent."""
    return Predicted(
        np.concatenate([each.returns for each in predicted]),
        np.mean([each.anew for each in predicted], axis=0),
        _stacked([each.passes for each in predicted]).summed(0),
        _stacked([each.passes_anew for each in predicted]).summed(0),
    )


def _stacked(passes: Sequence[Passes]) -> Passes:
    return Passes(*(np.array(counts) for counts in zip(*passes, strict=True)))


def predict(
    groups: Sequence[Sequence[Agent]],
    environment: Environment[Any],
    calibration: Calibration,
    rule: Actor | None,
    *,
    greedy: bool = True,
    seed: int = 1,
    progress: Progress | None = None,
) -> dict[str, Predicted]:
    """Run agents on the simulator of a recording, and on those of its responses drawn anew.

    Args:
        groups: agents as they will act on the culture; those of a group are policies that are run together.
        environment: robot and mapping, and what policies see besides.
        rule: the heuristic policy, where it is among the agents.
        greedy: whether policies take the most probable action.
        seed: decides every random draw.
        progress: told after each group.

    Returns:
        By the agent's name.
    """
    progress = progress or Silent()
    simulators, episodes_each = [calibration.simulator] * ROLL_OUTS + list(calibration.bootstraps), EPISODES
    if isinstance(environment.robot, HostRobot):
        simulators = simulators[: ROLL_OUTS + BOOTSTRAPS_ON_HOST]
        episodes_each = episodes_on_host(environment.robot)
    acting = [_actor(group, rule, greedy=greedy) for group in groups]

    def rolled(group: int, on: int) -> Episodes:
        actor, many = acting[group]
        changed, simulator = _changed(groups[group][0], environment, simulators[on])
        return roll_out(changed, simulator, actor, many, episodes=episodes_each, seed=roll_out_seed(seed, group, on))

    found: dict[str, Predicted] = {}
    # A body on the host hangs in the first thread or is not noticed (`animat.robots.host.within`).
    on_host = isinstance(environment.robot, HostRobot)
    with nullcontext() if on_host else ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        side_by_side = map if pool is None else pool.map
        # First one of each kind: two of a kind that start together would both be compiled.
        progress.update(0, len(groups), "compiling")
        kinds = {(type(acting[i][0]), *_how(group[0])): i for i, group in enumerate(groups)}
        list(side_by_side(rolled, kinds.values(), repeat(0)))
        for number, group in enumerate(groups):
            progress.update(number, len(groups), group[0].name)
            episodes = list(side_by_side(rolled, repeat(number), range(len(simulators))))
            returns = np.array([each.returns for each in episodes])
            passes = _stacked([Passes(each.presented, each.passed) for each in episodes])
            for row, agent in enumerate(group):
                of = [row] if len(group) > 1 else list(range(acting[number][1]))
                each = Passes(*(counts[:, of] for counts in passes)).summed(1)
                found[agent.name] = Predicted(
                    returns[:ROLL_OUTS, of].ravel(),
                    returns[ROLL_OUTS:, of].mean(axis=(1, 2)),
                    Passes(*(counts[:ROLL_OUTS] for counts in each)).summed(0),
                    Passes(*(counts[ROLL_OUTS:] for counts in each)),
                )
    return found


def episodes_on_host(robot: HostRobot) -> int:
    """Of each policy on each simulator: twenty, or fewer of more than 200 iterations, but four at least."""
    return max(4, min(20, 4_000 // robot.episode_limit))


def roll_out_seed(seed: int, group: int, on: int) -> int:
    """One of its own for each roll-out, and others for every `seed`: no interval is surer than its episodes are."""
    return int(np.random.SeedSequence((seed, group, on)).generate_state(1)[0])


def _how(agent: Agent) -> tuple[bool, ...]:
    """What decides which program its episodes run in."""
    yoked, drawn = agent.delivery == "yoked", agent.drawn_from is not None
    return agent.delivery == "silent", drawn, yoked, agent.is_turned_round, agent.switch_at is not None


def _changed(
    agent: Agent, environment: Environment[Any], simulator: NeuronSimulator
) -> tuple[Environment[Any], NeuronSimulator]:
    """What an agent acts in: the culture or the environment is another one for some."""
    changed: Environment[Any] = environment
    if agent.delivery == "silent":
        simulator = silenced(simulator) if agent.drawn_from is None else indifferent(simulator)
    if agent.delivery == "yoked":
        changed = YokedDelivery(environment)
    if agent.is_turned_round:
        changed = turned_round(environment)
    if agent.switch_at is not None:
        changed = GoalSwitch(changed, agent.switch_at)
    return changed, simulator


def _actor(group: Sequence[Agent], rule: Actor | None, *, greedy: bool) -> tuple[Actor, int]:
    """Who acts on the simulator as a group does on the culture, and how many they are."""
    first = group[0].controller
    # Without stimuli it makes no difference what is chosen, nor where each condition is delivered as often whatever is.
    if isinstance(first, AnyCondition) or group[0].delivery in ("silent", "shuffled"):
        return Uniform(), 1
    if isinstance(first, OneCondition):
        return Constant(jnp.array([first.condition])), 1
    if isinstance(first, HeuristicController) and rule is not None:
        return rule, 1
    if isinstance(first, CouplingController):
        return first.coupling, 1
    acting = first.by_name.values() if isinstance(first, InTurn) else (agent.controller for agent in group)
    policies: list[Any] = [each.policy if isinstance(each, Greedy) else each for each in acting]
    return networks_of(policies, greedy=greedy), len(policies)
