"""The best coupling: what a reflex could do, a fixed rule from what is sensed to a stimulus, without memory or goal."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from scipy.optimize import differential_evolution
from scipy.stats import t as student_t

from animat.environment import Environment
from animat.errors import InvalidArgument
from animat.evaluation.commands import mean_commands
from animat.evaluation.heuristic import Heuristic, heuristic_policy
from animat.evaluation.optimum import Optimum
from animat.evaluation.rollouts import Actor, Seen, Uniforms, nearest_action, roll_out
from animat.evaluation.statistics import CONFIDENCE, Interval, standard_error
from animat.evaluation.traces import trace
from animat.neurons.simulator import NeuronSimulator
from animat.progress import Progress
from animat.robots.base import capability, lacking
from animat.robots.host import HostRobot

Kind = Literal["graded", "switch"]
KINDS: tuple[Kind, ...] = ("graded", "switch")
LARGEST_WEIGHT = 12.0
"""Of a quantity in units of its scale: beyond, a graded command is nearly a switch."""
GENERATIONS, EPISODES = 60, 32
"""Of a search; episodes of each coupling, the same starts and chances for all of them."""
RESTARTS = 2
"""Of each kind."""
STEEPER = (1.0, 2.0, 4.0, 8.0)
"""Times the couplings that come nearest to a heuristic: its commands end at -1 and 1, and so a fit is too flat."""
FRESH_EPISODES = 512
"""In which the best of the last generations is chosen: those that it was found in flatter it."""
REFLEX_GAP = 0.05
"""A context gap that does not surely exceed this is none: a coupling does what the best controller does."""


@final
@partial(jax.tree_util.register_dataclass, data_fields=["weights", "actions", "means"], meta_fields=["kind", "seen"])
@dataclass(frozen=True)
class Coupling(Actor):
    """A coupling from sensors to stimuli: the stimulus whose mean command is the nearest to

        graded: tanh(W o + b),    switch: sign(W o + b)

    with o the robot's observation, each number divided by its scale, without those that tell of the goal. Braitenberg's
    vehicles, crossed and uncrossed, are among them.

    Attributes:
        weights: W and b as its last column, shape (actors, commands, seen + 1).
        actions: what the environment is handed for each action, shape (actors, actions).
        means: the mean command of each, shape (actors, actions), or (actors, actions, commands); None where any
            command can be given.
        kind: of the two above.
        seen: which numbers of the observation it sees.
    """

    weights: Float[Array, "*actors commands weights"]
    actions: Array
    means: Float[Array, "*actors actions *commands"] | None
    kind: Kind
    seen: tuple[int, ...]

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        drive = observation[:, jnp.array(self.seen, jnp.int32)] @ self.weights[:, :-1].T + self.weights[:, -1]
        wanted = jnp.tanh(drive) if self.kind == "graded" else jnp.sign(drive)
        wanted = wanted if environment.robot.n_commands > 1 else wanted[:, 0]
        return wanted if self.means is None else nearest_action(self.actions, self.means, wanted)


def best_coupling(
    environment: Environment[Any],
    simulator: NeuronSimulator | None,
    *,
    seed: int = 1,
    progress: Progress | None = None,
) -> Coupling:
    """The best coupling for an environment and the neurons in it, as one actor for `roll_out`.

    Differential evolution, twice for each kind, over weights from -12 to 12: once from random ones alone, and once with
    couplings among them that come nearest to the robot's heuristic, where it has one. All couplings of a search meet
    the same starts and chances. The best of the four last generations is chosen in fresh episodes.

    Args:
        simulator: the neurons' answers; None without neurons.
        seed: decides every random draw.
        progress: what to report to.

    Raises:
        InvalidArgument: for a robot that is stepped outside of JAX: the search takes thousands of episodes.

    Source: Storn & Price 1997, doi:10.1023/A:1008202821328.
    """
    if isinstance(environment.robot, HostRobot):
        raise InvalidArgument(
            f"robot: {environment.robot.name} is stepped in Python, and the search for the best coupling takes "
            "thousands of episodes: only robots in JAX have one"
        )
    spec = environment.robot.observation_spec
    seen = tuple(i for i, quantity in enumerate(spec) if not quantity.of_goal)
    n_commands = environment.robot.n_commands
    actions, means = None, None
    if environment.n_actions is not None:
        actions, means = mean_commands(environment, simulator)

    def actor(kind: Kind, weights: Float64[np.ndarray, "actors weights"]) -> Coupling:
        n, shaped = len(weights), weights.reshape(len(weights), n_commands, len(seen) + 1)
        each = None if means is None else jnp.broadcast_to(jnp.asarray(means, jnp.float32), (n, *means.shape))
        acts = jnp.zeros((n, 1)) if actions is None else jnp.broadcast_to(jnp.asarray(actions), (n, len(actions)))
        return Coupling(jnp.asarray(shaped, jnp.float32), acts, each, kind, seen)

    def mean_returns(coupling: Coupling, episodes: int, seed: int) -> Float64[np.ndarray, " actors"]:
        n = len(coupling.weights)
        ran = roll_out(environment, simulator, coupling, n, episodes=episodes, seed=seed, alike=True)
        if progress is not None:
            progress.update(next(rounds), len(KINDS) * (RESTARTS * (1 + GENERATIONS) + 1))
        return ran.returns.mean(axis=1)  # type: ignore[no-any-return]

    rounds = itertools.count(1)
    size = n_commands * (len(seen) + 1)
    per_weight = max(8, -(-40 // size))
    near_heuristic = _near_heuristic(environment, simulator, seen, seed)
    seeds = np.random.default_rng([seed, 31]).integers(2**31, size=(len(KINDS), RESTARTS, 2)).tolist()
    fresh = seeds[0][0][0] + 1
    found = []
    for kind, of_kind in zip(KINDS, seeds, strict=True):
        last = []
        for restart, (draws, episodes) in enumerate(of_kind):
            first: Any = "latinhypercube"
            if restart and len(near_heuristic):
                bounds, others = (-LARGEST_WEIGHT, LARGEST_WEIGHT), (per_weight * size - len(near_heuristic), size)
                first = np.concatenate([near_heuristic, np.random.default_rng([draws, 1]).uniform(*bounds, others)])
            search = differential_evolution(
                lambda w, kind=kind, episodes=episodes: -mean_returns(actor(kind, w.T), EPISODES, episodes),
                [(-LARGEST_WEIGHT, LARGEST_WEIGHT)] * size,
                maxiter=GENERATIONS,
                popsize=per_weight,
                init=first,
                tol=0.0,
                rng=draws,
                polish=False,
                vectorized=True,
                updating="deferred",
            )
            last.append(search.population)
        candidates = np.concatenate(last)
        returns = mean_returns(actor(kind, candidates), FRESH_EPISODES, fresh)
        found.append((float(returns.max()), actor(kind, candidates[[returns.argmax()]])))
    return max(found, key=lambda each: each[0])[1]


def _near_heuristic(
    environment: Environment[Any], simulator: NeuronSimulator | None, seen: tuple[int, ...], seed: int
) -> Float64[np.ndarray, "starts weights"]:
    """Couplings that come nearest to the robot's heuristic, by least squares over its episodes, and steeper ones.

    None where it has no heuristic.
    """
    robot = environment.robot
    if "heuristic" in lacking(robot):
        return np.zeros((0, 0))
    policy = Heuristic() if environment.n_actions is None else heuristic_policy(environment, simulator)
    ran = trace(environment, simulator, policy, 1, episodes=EPISODES, seed=seed)
    under_way = np.arange(robot.episode_limit) < ran.lengths[..., None]
    observed = ran.observations[..., :-1, : len(robot.observation_spec)][under_way]
    wanted = np.asarray(jax.vmap(capability(robot, "heuristic"))(observed), np.float64).reshape(len(observed), -1)
    scales = np.array([quantity.scale for quantity in robot.observation_spec])
    design = np.column_stack([(observed / scales)[:, seen], np.ones(len(observed))])
    weights = np.linalg.lstsq(design, wanted, rcond=None)[0].T.ravel()
    return np.clip(np.outer(STEEPER, weights), -LARGEST_WEIGHT, LARGEST_WEIGHT)


@dataclass(frozen=True)
class ContextGap:
    """How much of a task a reflex leaves undone.

        gap = (optimum - best coupling) / (optimum - random)

    Where no optimal return is known (`least_context_gap`), both the gap and the score are the least that they can be.

    Attributes:
        coupling: mean return of the best coupling.
        standard_error: of that.
        gap: with its interval, on this simulator: for the episodes of coupling and random stimuli, and the optimum's
            grid or the episodes of what is in its place. None where the optimum is not above random stimuli, or of one
            episode.
        best_known: mean return of the best agent that is known, in the optimum's place; None where the optimum is
            known.
        highest: where it is not, the highest return that any episode can have.
    """

    coupling: float
    standard_error: float
    gap: Interval | None
    best_known: float | None = None
    highest: float = np.inf

    @property
    def is_least(self) -> bool:
        """Whether gap and score are the least that they can be, as the optimum is not known."""
        return self.best_known is not None

    @property
    def needs_context(self) -> bool:
        """Whether the gap surely exceeds `REFLEX_GAP`."""
        return self.gap is not None and self.gap.low > REFLEX_GAP

    def score(self, returns: Float64[np.ndarray, " policies"], optimum: Optimum | None) -> Interval | None:
        """The context score of policies, with its interval: 0 is what a coupling does, 1 the optimum.

            score = (mean return - best coupling) / (optimum - best coupling)

        Where the optimum is not known, it is between the best agent that is known and the highest return of an episode.
        The score is then at least what it is with the latter, and where policies are below the coupling with the
        former. None where the task is not known to need context, or of one policy alone.

        Args:
            returns: mean return of each policy.
            optimum: on the same simulator; None where it is not known.
        """
        if not self.needs_context or len(returns) < 2:
            return None
        mean, error = float(returns.mean()), standard_error(returns)
        best, grid_error = (self.highest, 0.0) if optimum is None else (optimum.value, optimum.grid_error)
        if not np.isfinite(best):
            return None
        span, over = best - self.coupling, mean - self.coupling
        # Of a ratio whose denominator is known much better than 0: the half widths of all parts, in quadrature. Few
        # policies have wide tails, so theirs is Student's.
        value = over / span
        of_policies = student_t.ppf((1 + CONFIDENCE) / 2, len(returns) - 1) * error
        spread = float(np.linalg.norm([of_policies, _Z * (1 - value) * self.standard_error, value * grid_error]))
        below = span if self.best_known is None else self.best_known - self.coupling
        value, low, high = (each / (span if each >= 0 else below) for each in (over, over - spread, over + spread))
        return Interval(value, low, high, CONFIDENCE)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "coupling": self.coupling,
            "coupling_standard_error": self.standard_error if np.isfinite(self.standard_error) else None,
            "context_gap": None if self.gap is None else self.gap.to_dict(),
            "needs_context": self.needs_context,
            "is_least": self.is_least,
            "best_known": self.best_known,
        }

    def to_text(self, score: Interval | None = None) -> str:
        """In a line, with the policies' context score where it is known."""
        told = f"best coupling {self.coupling:.1f} ± {self.standard_error:.1f}"
        if not np.isfinite(self.standard_error):
            return f"best coupling {self.coupling:.1f}; no context gap of one episode"
        if self.gap is None:
            best = "the optimal return" if self.best_known is None else f"the best agent known ({self.best_known:.1f})"
            return f"{told}; no context gap, as {best} is not above that of random stimuli"
        least = "at least " if self.is_least else ""
        gap = f"context gap {least}{self.gap.value:.2f} ({self.gap.low:.2f} to {self.gap.high:.2f})"
        if self.best_known is not None:
            gap += f", as the best agent known returns {self.best_known:.1f}"
        if self.needs_context:
            needs = ""
        elif self.is_least or self.gap.high > REFLEX_GAP:
            needs = ": whether this task needs more than a reflex is not known"
        else:
            needs = ": this task needs no more than a reflex"
        scored = ""
        if score is not None:
            scored = f"; context score {least}{score.value:.2f} ({score.low:.2f} to {score.high:.2f})"
        return f"{told}; {gap}{needs}{scored}"


_Z = 1.959964
"""The normal distribution's quantile of the interval's ends."""


def context_gap(
    coupling: Float64[np.ndarray, " episodes"], random: Float64[np.ndarray, " episodes"], optimum: Optimum
) -> ContextGap:
    """The context gap of a task, from returns of the best coupling and of random stimuli in fresh episodes."""
    means, errors = ([float(f(x)) for x in (coupling, random)] for f in (np.mean, standard_error))
    best, span = optimum.value, optimum.value - means[1]
    gap = None
    if span > 0 and np.isfinite(errors).all():
        value = (best - means[0]) / span
        # d gap: by the coupling -1, by random stimuli gap, by the optimum 1 - gap, each over the span.
        parts = np.array([errors[0], value * errors[1], (1 - value) * optimum.grid_error / _Z])
        spread = float(_Z * np.linalg.norm(parts) / span)
        gap = Interval(value, value - spread, value + spread, CONFIDENCE)
    return ContextGap(means[0], errors[0], gap)


def least_context_gap(
    coupling: Float64[np.ndarray, " episodes"],
    random: Float64[np.ndarray, " episodes"],
    known: Float64[np.ndarray, "agents episodes"],
    highest: float = np.inf,
) -> ContextGap:
    """The least that the context gap of a task can be, where no optimal return is known.

    The optimum is not below what any agent returns, nor below the coupling. Where the coupling is above random stimuli,
    the gap grows with the optimum, so with an agent in its place it is the least; else it is at least 1. Which of
    several agents that is, is chosen by the first half of their episodes; its return is that of the other half.

    Args:
        coupling, random: returns in the same episodes, with the same starts.
        known: returns of agents of all kinds, policies and heuristics.
        highest: return that any episode can have.
    """
    half = known.shape[1] // 2 if len(known) > 1 else 0
    best = known[known[:, : max(half, 1)].mean(axis=1).argmax(), half:]
    means = [float(each.mean()) for each in (best, coupling, random)]
    error, span = standard_error(best), means[0] - means[2]
    gap = None
    if span > 0 and np.isfinite([error, standard_error(coupling)]).all():
        value = (means[0] - means[1]) / span
        # As above; coupling and random stimuli, which meet the same starts, pair by pair.
        spread = _Z * float(np.hypot((1 - value) * error, standard_error(value * random - coupling)) / span)
        value, low, high = (float(np.clip(each, 0, 1)) for each in (value, value - spread, value + spread))
        gap = Interval(value, low, high, CONFIDENCE)
    return ContextGap(means[1], standard_error(coupling), gap, means[0], highest)
