"""The best coupling: the best reflex, a fixed rule from sensors to stimuli, without memory or knowledge of the goal."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int
from scipy.special import stdtrit

from animat.environment import Environment, Neurons
from animat.errors import InvalidArgument
from animat.evaluation.commands import mean_commands
from animat.evaluation.optimum import Optimum
from animat.evaluation.rollouts import Actor, Seen, Uniforms, heuristic_policy, nearest_action, roll_out, trajectories
from animat.evaluation.statistics import CONFIDENCE, Interval, standard_error
from animat.progress import Progress
from animat.robots.base import capability
from animat.robots.host import HostRobot

Kind = Literal["graded", "switch"]
KINDS: tuple[Kind, ...] = ("graded", "switch")
LARGEST_WEIGHT = 12.0
"""Of a quantity in units of its scale: beyond this, a graded command is nearly a switch."""
GENERATIONS, EPISODES, RESTARTS = 60, 32, 2
"""Generations of a search, episodes of each coupling, and searches of each kind."""
STEEPER = (1.0, 2.0, 4.0, 8.0)
"""Factors for the couplings closest to a heuristic: its commands saturate at -1 and 1, so a linear fit is too flat."""
FRESH_EPISODES = 512
"""Episodes in which the best of the last generations is chosen: returns in those of the search are biased upwards."""
_Z = 1.959964
"""The normal quantile for the ends of a 95 % interval."""
REFLEX_GAP = 0.05
"""A task needs context only if its context gap surely exceeds this; else a coupling is as good as any controller."""


@final
@partial(jax.tree_util.register_dataclass, data_fields=["weights", "actions", "means"], meta_fields=["kind", "seen"])
@dataclass(frozen=True)
class Coupling(Actor):
    """A coupling from sensors to stimuli: the stimulus whose mean command is nearest to

        graded: tanh(W o + b),    switch: sign(W o + b)

    with o the robot's observation, each number divided by its scale, without those of the goal. Braitenberg's vehicles,
    crossed and uncrossed, are couplings of this kind.

    Attributes:
        weights: W, with b as its last column.
        actions: the environment's input for each action; None where any command can be given.
        means: the mean command of each action.
        seen: indices of the observation that it sees.
    """

    weights: Float[Array, "*actors commands seen+1"]
    actions: Int[Array, "*actors actions"] | None
    means: Float[Array, "*actors actions *commands"] | None
    kind: Kind
    seen: tuple[int, ...]

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        drive = observation[:, jnp.array(self.seen, jnp.int32)] @ self.weights[:, :-1].T + self.weights[:, -1]
        wanted = jnp.tanh(drive) if self.kind == "graded" else jnp.sign(drive)
        wanted = wanted if environment.robot.n_commands > 1 else wanted[:, 0]
        return nearest_action(self.actions, self.means, wanted)


def best_coupling(
    environment: Environment[Any], simulator: Neurons, *, seed: int = 1, progress: Progress | None = None
) -> Coupling:
    """The best coupling for an environment and the neurons in it, as one actor for `roll_out`.

    Differential evolution, twice for each kind, over weights from -12 to 12: once from random weights only, and once
    also with couplings closest to the robot's heuristic, if it has one. All couplings of a search have the same starts
    and random numbers. The best of the last generations is chosen in fresh episodes. InvalidArgument for a host robot.

    Source: Storn & Price 1997, doi:10.1023/A:1008202821328.
    """
    from scipy.optimize import differential_evolution

    if isinstance(environment.robot, HostRobot):
        why = "as the search for the best coupling takes thousands of episodes"
        raise InvalidArgument(f"robot: expected one in JAX, {why}, got {environment.robot.name}")
    seen = tuple(i for i, quantity in enumerate(environment.robot.observation_spec) if not quantity.of_goal)
    n_commands = environment.robot.n_commands
    stimuli: Any = (None, None)
    if environment.n_actions is not None:
        actions, commands = mean_commands(environment, simulator)
        stimuli = jnp.asarray(actions), jnp.asarray(commands, jnp.float32)

    def actor(kind: Kind, weights: Float64[np.ndarray, "actors weights"]) -> Coupling:
        inputs, means = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(weights), *x.shape)), stimuli)
        shaped = weights.reshape(len(weights), n_commands, len(seen) + 1)
        return Coupling(jnp.asarray(shaped, jnp.float32), inputs, means, kind, seen)

    def mean_returns(coupling: Coupling, episodes: int, seed: int) -> Float64[np.ndarray, " actors"]:
        ran = roll_out(environment, simulator, coupling, episodes=episodes, seed=seed, alike=True)
        if progress is not None:
            progress.update(next(rounds), len(KINDS) * (RESTARTS * (1 + GENERATIONS) + 1))
        return ran.returns.mean(axis=1)  # type: ignore[no-any-return]

    rounds, bounds = itertools.count(1), (-LARGEST_WEIGHT, LARGEST_WEIGHT)
    size = n_commands * (len(seen) + 1)
    per_weight = max(8, -(-40 // size))
    near_heuristic = _near_heuristic(environment, simulator, seen, seed)

    def last_generation(kind: Kind, restart: int, draws: int, episodes: int) -> Float64[np.ndarray, "actors weights"]:
        first: Any = "latinhypercube"
        if restart and len(near_heuristic):
            others = np.random.default_rng([draws, 1]).uniform(*bounds, (per_weight * size - len(near_heuristic), size))
            first = np.concatenate([near_heuristic, others])
        search = differential_evolution(
            lambda w: -mean_returns(actor(kind, w.T), EPISODES, episodes),
            [bounds] * size,
            maxiter=GENERATIONS,
            popsize=per_weight,
            init=first,
            tol=0.0,
            rng=draws,
            polish=False,
            vectorized=True,
            updating="deferred",
        )
        return search.population  # type: ignore[no-any-return]

    seeds = np.random.default_rng([seed, 31]).integers(2**31, size=(len(KINDS), RESTARTS, 2)).tolist()
    fresh = seeds[0][0][0] + 1
    best = []
    for kind, of_kind in zip(KINDS, seeds, strict=True):
        candidates = np.concatenate([last_generation(kind, i, *of_search) for i, of_search in enumerate(of_kind)])
        returns = mean_returns(actor(kind, candidates), FRESH_EPISODES, fresh)
        best.append((float(returns.max()), actor(kind, candidates[[returns.argmax()]])))
    return max(best, key=lambda each: each[0])[1]


def _near_heuristic(
    environment: Environment[Any], simulator: Neurons, seen: tuple[int, ...], seed: int
) -> Float64[np.ndarray, "starts weights"]:
    """The coupling closest to the robot's heuristic, by least squares over its episodes, and steeper ones, if any."""
    robot = environment.robot
    if not hasattr(robot, "heuristic"):
        return np.zeros((0, 0))
    ran = trajectories(environment, simulator, heuristic_policy(environment, simulator), episodes=EPISODES, seed=seed)
    running = np.arange(robot.episode_limit) < ran.lengths[..., None]
    observed = ran.observations[..., :-1, : len(robot.observation_spec)][running]
    wanted = np.asarray(jax.vmap(capability(robot, "heuristic"))(observed), np.float64).reshape(len(observed), -1)
    scales = np.array([quantity.scale for quantity in robot.observation_spec])
    design = np.column_stack([(observed / scales)[:, seen], np.ones(len(observed))])
    weights = np.linalg.lstsq(design, wanted, rcond=None)[0].T.ravel()
    return np.clip(np.outer(STEEPER, weights), -LARGEST_WEIGHT, LARGEST_WEIGHT)


@dataclass(frozen=True)
class ContextGap:
    """How much of the achievable return the best reflex leaves unused.

        gap = (optimum - best coupling) / (optimum - random)

    Where no optimal return is known (`least_context_gap`), both gap and score are lower bounds.

    Attributes:
        coupling: mean return of the best coupling.
        gap: with its interval for episodes and grid; None for too few episodes, or an optimum not above random stimuli.
        best_known: mean return of the best known agent, which replaces the optimum; None if the optimum is known.
        highest: if it is not, the highest possible return of an episode.
        random: if it is not, the mean return of random stimuli.
    """

    coupling: float
    standard_error: float
    gap: Interval | None
    best_known: float | None = None
    highest: float = np.inf
    random: float = np.inf

    @property
    def needs_context(self) -> bool:
        """Whether the gap surely exceeds `REFLEX_GAP`."""
        return self.gap is not None and self.gap.low > REFLEX_GAP

    @property
    def _is_reflex(self) -> bool:
        """Whether the gap surely does not exceed `REFLEX_GAP`."""
        return self.gap is not None and self.best_known is None and self.gap.high <= REFLEX_GAP

    def score(self, returns: Float64[np.ndarray, " policies"], optimum: Optimum | None) -> Interval | None:
        """The context score of policies, with its interval: 0 is the best coupling, 1 the optimum.

            score = (mean return - best coupling) / (optimum - best coupling)

        An unknown optimum is between the best known agent and the highest possible return of an episode. The lower
        bound of the score then uses the latter, or the former if the policies are below the coupling. None if the task
        is not known to need context, or with a single policy; `returns` are the policies' means.
        """
        if not self.needs_context or len(returns) < 2:
            return None
        mean, error = float(returns.mean()), standard_error(returns)
        best, grid_error = (self.highest, 0.0) if optimum is None else (optimum.value, optimum.grid_error)
        if not np.isfinite(best):
            return None
        span, over = best - self.coupling, mean - self.coupling
        # For a ratio whose denominator is far from 0 relative to its error: the half widths of all parts, in
        # quadrature. With few policies tails are wide, so theirs is Student's.
        value = over / span
        of_policies = float(stdtrit(len(returns) - 1, (1 + CONFIDENCE) / 2)) * error
        spread = float(np.linalg.norm([of_policies, _Z * (1 - value) * self.standard_error, value * grid_error]))
        below = span if self.best_known is None else self.best_known - self.coupling
        value, low, high = (each / (span if each >= 0 else below) for each in (over, over - spread, over + spread))
        return Interval(value, low, high)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "coupling": self.coupling,
            "coupling_standard_error": self.standard_error if np.isfinite(self.standard_error) else None,
            "context_gap": None if self.gap is None else self.gap.to_dict(),
            "needs_context": self.needs_context or (False if self._is_reflex else None),
            "is_least": self.best_known is not None,
            "best_known": self.best_known,
        }

    def to_text(self, score: Interval | None = None) -> str:
        """One line, with the policies' context score if it is known."""
        coupling = f"best coupling {self.coupling:.1f}"
        if not np.isfinite(self.standard_error):
            return f"{coupling}; no context gap with one episode"
        coupling, known = f"{coupling} +- {self.standard_error:.1f}", self.best_known
        if self.gap is None and known is not None and known > self.random:
            return f"{coupling}; no context gap, as the best known agent ({known:.1f}) was measured in one episode"
        if self.gap is None:
            best = "the optimal return" if known is None else f"the best known agent ({known:.1f})"
            return f"{coupling}; no context gap, as {best} is not above that of random stimuli"
        least = "" if known is None else "at least "
        text = f"{coupling}; context gap {least}{self.gap.value:.2f} ({self.gap.low:.2f} to {self.gap.high:.2f})"
        if known is not None:
            text += f", as the best known agent returns {known:.1f}"
        if self._is_reflex:
            text += ": this task needs no more than a reflex"
        elif not self.needs_context:
            text += ": whether this task needs more than a reflex is not known"
        if score is not None:
            text += f"; context score {least}{score.value:.2f} ({score.low:.2f} to {score.high:.2f})"
        return text


def context_gap(
    coupling: Float64[np.ndarray, " episodes"], random: Float64[np.ndarray, " episodes"], optimum: Optimum
) -> ContextGap:
    """The context gap of a task, from returns of the best coupling and of random stimuli in fresh episodes.

    If the optimal return is known only to lie between a value and what its controller achieves, as with memory, the gap
    is that for the value, and its interval begins where the optimum is what was achieved, by a coupling or by it.
    """
    means, errors = ([float(f(x)) for x in (coupling, random)] for f in (np.mean, standard_error))
    span, gap = optimum.value - means[1], None
    if span > 0 and np.isfinite(errors).all():
        value = (optimum.value - means[0]) / span
        # Derivatives of the gap: by coupling -1, by random stimuli gap, by optimum 1 - gap, each divided by the span.
        parts = np.array([errors[0], value * errors[1], (1 - value) * optimum.grid_error / _Z])
        spread = float(_Z * np.linalg.norm(parts) / span)
        low, (achieved, error) = value - spread, optimum.achieved
        # An optimum that its controller does not reach may be as low as what is achieved, by it or by the coupling.
        if optimum.findings() and achieved < optimum.value:
            least = 0.0
            if achieved > max(means):
                ratio = (achieved - means[0]) / (achieved - means[1])
                parts = np.array([errors[0], ratio * errors[1], (1 - ratio) * error])
                least = ratio - float(_Z * np.linalg.norm(parts) / (achieved - means[1]))
            low = min(low, least)
        gap = Interval(value, low, value + spread)
    return ContextGap(means[0], errors[0], gap)


def least_context_gap(
    coupling: Float64[np.ndarray, " episodes"],
    random: Float64[np.ndarray, " episodes"],
    known: Float64[np.ndarray, "agents episodes"],
    highest: float = np.inf,
) -> ContextGap:
    """A lower bound of the context gap of a task without a known optimal return.

    The optimum is not below the return of any agent, nor below the coupling. If the coupling is above random stimuli,
    the gap grows with the optimum, so an agent in its place gives a lower bound; else the gap is at least 1. The best
    of several agents (policies and heuristics, all in `known`) is chosen by the first half of their episodes; its
    return is that of the second half. `coupling` and `random` have the same starts; `highest` is the highest possible.
    """
    half = known.shape[1] // 2 if len(known) > 1 else 0
    best = known[known[:, : max(half, 1)].mean(axis=1).argmax(), half:]
    means = [float(each.mean()) for each in (best, coupling, random)]
    error, span = standard_error(best), means[0] - means[2]
    gap = None
    if span > 0 and np.isfinite([error, standard_error(coupling)]).all():
        value = (means[0] - means[1]) / span
        # As above; coupling and random stimuli have the same starts and are compared pair by pair.
        spread = _Z * float(np.hypot((1 - value) * error, standard_error(value * random - coupling)) / span)
        value, low, high = (float(np.clip(each, 0, 1)) for each in (value, value - spread, value + spread))
        gap = Interval(value, low, high)
    return ContextGap(means[1], standard_error(coupling), gap, means[0], highest, means[2])
