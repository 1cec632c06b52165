"""What the recording's simulator says that policies and controls will live, and how well it can know."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from animat.animat import Animat
from animat.closed_loop.contenders import AnyCondition, Contender, Greedy, HandMadeRule, OneCondition
from animat.evaluation.rollouts import Actor, Constant, Episodes, Uniform, networks_of, roll_out
from animat.neurons.simulator import NeuronSimulator, silenced
from animat.progress import Progress, Silent
from animat.reality_gap.calibration import Calibration
from animat.reality_gap.passes import Passes

PREDICTED_EPISODES = 1000
"""Of each policy and control on the simulator."""
ANEW_EPISODES = 200
"""Of each on every simulator of redrawn responses."""


class Predicted(NamedTuple):
    """What simulators say of one contender.

    Attributes:
        returns: of its episodes on the simulator of the recording, shape (episodes,).
        anew: its mean return on each simulator of the recording's responses drawn anew, shape (redrawn,): it spreads
            as the recording's responses and, a little, as 200 episodes do.
        passes: in all its episodes on the simulator of the recording, shape (conditions,).
        passes_anew: on each simulator of redrawn responses, shape (redrawn, conditions).
    """

    returns: Float64[np.ndarray, " episodes"]
    anew: Float64[np.ndarray, " redrawn"]
    passes: Passes
    passes_anew: Passes

    @property
    def presented(self) -> Float64[np.ndarray, " conditions"]:
        """How often each condition is presented in an episode, on average."""
        return np.asarray(self.passes.presented / len(self.returns))


def together(predicted: Sequence[Predicted]) -> Predicted:
    """Several policies as one contender."""
    return Predicted(
        np.concatenate([each.returns for each in predicted]),
        np.mean([each.anew for each in predicted], axis=0),
        _stacked([each.passes for each in predicted]).summed(0),
        _stacked([each.passes_anew for each in predicted]).summed(0),
    )


def _stacked(passes: Sequence[Passes]) -> Passes:
    return Passes(*(np.array(counts) for counts in zip(*passes, strict=True)))


def predict(
    groups: Sequence[Sequence[Contender]],
    environment: Animat[Any],
    calibration: Calibration,
    rule: Actor | None,
    *,
    greedy: bool = True,
    seed: int = 1,
    progress: Progress | None = None,
) -> dict[str, Predicted]:
    """Run contenders on the simulator of a recording, and on those of its responses drawn anew.

    Args:
        groups: contenders as they will act on the culture; those of a group are policies that are run together.
        environment: robot and mapping.
        calibration: the simulators.
        rule: the hand-made one, where there is one among the contenders.
        greedy: whether policies take the most probable action.
        seed: decides every random draw.
        progress: told after each group.

    Returns:
        By the contender's name.
    """
    progress = progress or Silent()
    found: dict[str, Predicted] = {}
    for number, group in enumerate(groups):
        progress.update(number, len(groups), f"predicting {group[0].name}")
        actor, many = _actor(group, rule, greedy=greedy)

        def rolled(simulator: NeuronSimulator, episodes: int, seed: int) -> Episodes:
            on = silenced(simulator) if group[0].delivery == "silent" else simulator  # noqa: B023
            return roll_out(environment, on, actor, many, episodes=episodes, seed=seed)  # noqa: B023

        # Seeds of their own: the spread is then also that of the episodes, and no interval is surer than they are.
        first = seed + number * (len(calibration.redrawn) + 1)
        predicted = rolled(calibration.simulator, PREDICTED_EPISODES, first % 2**32)
        seeds = [(first + 1 + i) % 2**32 for i in range(len(calibration.redrawn))]
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as side_by_side:
            redrawn = list(side_by_side.map(rolled, calibration.redrawn, repeat(ANEW_EPISODES), seeds))
        anew = np.array([each.returns.mean(axis=1) for each in redrawn])
        passes = Passes(predicted.presented, predicted.passed)
        passes_anew = _stacked([Passes(each.presented, each.passed) for each in redrawn])
        for row, contender in enumerate(group):
            of = [row] if len(group) > 1 else list(range(many))
            found[contender.name] = Predicted(
                predicted.returns[of].ravel(),
                anew[:, of].mean(axis=1),
                Passes(*(counts[of] for counts in passes)).summed(0),
                Passes(*(counts[:, of] for counts in passes_anew)).summed(1),
            )
    return found


def _actor(group: Sequence[Contender], rule: Actor | None, *, greedy: bool) -> tuple[Actor, int]:
    """Who acts on the simulator as a group does on the culture, and how many they are."""
    first = group[0].controller
    # Without stimuli it makes no difference what is chosen, nor where each condition is delivered as often whatever is.
    if isinstance(first, AnyCondition) or group[0].delivery != "chosen":
        return Uniform(), 1
    if isinstance(first, OneCondition):
        return Constant(jnp.array([first.condition])), 1
    if isinstance(first, HandMadeRule) and rule is not None:
        return rule, 1
    policies: list[Any] = [
        each.policy if isinstance(each, Greedy) else each for each in (contender.controller for contender in group)
    ]
    return networks_of(policies, greedy=greedy), len(policies)
