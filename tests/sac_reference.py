"""Soft Actor-Critic's losses once more, in float64 numpy and sample by sample: what the tests of `sac.py` trust."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from animat.training.networks import Network, initial_networks
from animat.training.replay import Batch
from animat.training.sac import Parameters


def drawn_networks(
    seed: int, n: int, hidden: int, n_actions: int | None, n_commands: int = 1
) -> tuple[Parameters, Network]:
    """Actor, critics, log alpha and target critics with weights of ordinary size everywhere, biases included."""
    continuous = (n + 1 + n_commands, 1, 2 * n_commands)
    inputs, values, outputs = continuous if n_actions is None else (n + 1, n_actions, n_actions)
    # For their shapes alone.
    actor, critics, targets = jax.eval_shape(
        lambda key: initial_networks(
            key,
            ((n, hidden, hidden, outputs), ()),
            ((inputs, hidden, hidden, values), (2,)),
            ((inputs, hidden, hidden, values), (2,)),
        ),
        jax.random.key(seed),
    )
    rng = np.random.default_rng(seed)

    def drawn(network: Network) -> Any:
        return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(0, 0.6, leaf.shape), jnp.float32), network)

    return Parameters(drawn(actor), drawn(critics), jnp.float32(rng.uniform(-3, 1))), drawn(targets)


def drawn_batch(seed: int, size: int, n: int, n_actions: int | None, n_commands: int = 1) -> Batch:
    """Transitions of a task that does not exist, a third of them the last of their episode."""
    rng = np.random.default_rng(seed)
    action = rng.uniform(-1, 1, (size, n_commands)) if n_actions is None else rng.integers(0, n_actions, size)
    columns = (
        rng.normal(size=(size, n + 1)),
        rng.normal(size=(size, n + 1)),
        action,
        rng.normal(0, 5, size),
        rng.random(size) < 1 / 3,
    )
    return Batch(*(jnp.asarray(column, jnp.float32) for column in columns))


def in_float64(tree: Any) -> Any:
    """The same arrays for numpy, exactly, with all the digits that sums need."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def outputs(network: Network, x: np.ndarray, which: int | None = None) -> Any:
    """One network's outputs for one input; `which` picks it from a stack."""
    layers: list[Any] = [(w if which is None else w[which], (b if which is None else b[which])[0]) for w, b in network]
    for weight, bias in layers[:-1]:
        x = np.maximum(weight.T @ x + bias, 0.0)
    weight, bias = layers[-1]
    return weight.T @ x + bias


def probabilities(logits: np.ndarray) -> Any:
    """Softmax."""
    exponentials = np.exp(logits - logits.max())
    return exponentials / exponentials.sum()


def log_density(action_z: float, mean: float, log_std: float) -> float:
    """Log density of tanh(z) for normal z, by the change of variables."""
    # The slope of tanh is 1 / cosh^2, and log(cosh z) = logaddexp(z, -z) - log 2.
    return float(
        stats.norm.logpdf(action_z, mean, np.exp(log_std)) + 2 * (np.logaddexp(action_z, -action_z) - np.log(2))
    )


def discrete_losses(
    trained: Parameters, targets: Network, batch: Batch, *, discount: float, entropy_wanted: float
) -> tuple[float, float, float]:
    """Losses of critics, actor and alpha (Christodoulou 2019, equations 10 to 12), averaged over the batch.

    The last number of a state, its time left, is not for the actor.
    """
    alpha = np.exp(trained.log_alpha)
    critic_losses, actor_losses, alpha_losses = [], [], []
    for s, s_next, a, r, ended in zip(*batch, strict=True):
        target = r
        if not ended:
            pi = probabilities(outputs(trained.actor, s_next[:-1]))
            q_next = [min(outputs(targets, s_next, i)[b] for i in (0, 1)) for b in range(len(pi))]
            target = r + discount * sum(p * (q - alpha * np.log(p)) for p, q in zip(pi, q_next, strict=True))
        q = [outputs(trained.critics, s, i) for i in (0, 1)]
        critic_losses.append(sum((q[i][int(a)] - target) ** 2 for i in (0, 1)) / 2)
        pi = probabilities(outputs(trained.actor, s[:-1]))
        actor_losses.append(sum(p * (alpha * np.log(p) - min(q0, q1)) for p, q0, q1 in zip(pi, *q, strict=True)))
        alpha_losses.append(trained.log_alpha * (-sum(p * np.log(p) for p in pi) - entropy_wanted))
    return float(np.mean(critic_losses)), float(np.mean(actor_losses)), float(np.mean(alpha_losses))


def continuous_losses(
    trained: Parameters, targets: Network, batch: Batch, uniforms: np.ndarray, *, discount: float, entropy_wanted: float
) -> tuple[float, float, float]:
    """The same for continuous actions (Haarnoja et al. 2018, equations 5, 7 and 18), their entropies added up."""
    alpha = np.exp(trained.log_alpha)

    def drawn(s: np.ndarray, uniforms: np.ndarray) -> tuple[list[float], float]:
        of_actor, n = outputs(trained.actor, s[:-1]), len(uniforms)
        action, log_p = [], 0.0
        for mean, log_std, uniform in zip(of_actor[:n], of_actor[n:], uniforms, strict=True):
            kept = min(max(log_std, -5.0), 2.0)
            z = stats.norm.ppf(uniform, mean, np.exp(kept))
            action.append(float(np.tanh(z)))
            log_p += log_density(z, mean, kept)
        return action, log_p

    def value(critics: Network, s: np.ndarray, a: Any, which: int) -> float:
        return float(outputs(critics, np.append(s, a), which)[0])

    critic_losses, actor_losses, alpha_losses = [], [], []
    for s, s_next, a, r, ended, u_next, u_new in zip(*batch, *uniforms, strict=True):
        a_next, log_p = drawn(s_next, u_next)
        target = r
        if not ended:
            target = r + discount * (min(value(targets, s_next, a_next, i) for i in (0, 1)) - alpha * log_p)
        critic_losses.append(sum((value(trained.critics, s, a, i) - target) ** 2 for i in (0, 1)) / 2)
        a_new, log_p = drawn(s, u_new)
        actor_losses.append(alpha * log_p - min(value(trained.critics, s, a_new, i) for i in (0, 1)))
        alpha_losses.append(trained.log_alpha * (-log_p - entropy_wanted))
    return float(np.mean(critic_losses)), float(np.mean(actor_losses)), float(np.mean(alpha_losses))
