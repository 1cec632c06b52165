"""What the recording's simulator says that policies and controls will live, and how well it can know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from animat.animat import Animat
from animat.closed_loop.contenders import AnyCondition, Contender, Greedy, HandMadeRule, InTurn, OneCondition
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
        delivery = group[0].delivery
        in_ = replace(environment, delivery="shuffled") if delivery == "shuffled" else environment
        actor, many = _actor([contender.controller for contender in group], rule, greedy=greedy)

        def rolled(simulator: NeuronSimulator, episodes: int, seed: int) -> Episodes:
            on = silenced(simulator) if delivery == "silent" else simulator  # noqa: B023
            return roll_out(in_, on, actor, many, episodes=episodes, seed=seed)  # noqa: B023

        predicted = rolled(calibration.simulator, PREDICTED_EPISODES, seed)
        # Seeds of their own: the spread is then also that of the episodes, and no interval is surer than they are.
        redrawn = [
            rolled(simulator, ANEW_EPISODES, (seed + 1 + i) % 2**32) for i, simulator in enumerate(calibration.redrawn)
        ]
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


def _actor(controllers: Sequence[Any], rule: Actor | None, *, greedy: bool) -> tuple[Actor, int]:
    """Who acts on the simulator as controllers do on the culture, and how many they are."""
    first = controllers[0]
    if isinstance(first, AnyCondition):
        return Uniform(), 1
    if isinstance(first, OneCondition):
        return Constant(jnp.array([first.condition])), 1
    if isinstance(first, HandMadeRule) and rule is not None:
        return rule, 1
    acting: list[Any] = []
    for controller in controllers:
        acting += list(controller.by_name.values()) if isinstance(controller, InTurn) else [controller]
    policies: list[Any] = [each.policy if isinstance(each, Greedy) else each for each in acting]
    return networks_of(policies, greedy=greedy), len(policies)
