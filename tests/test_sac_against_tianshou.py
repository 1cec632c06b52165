"""Soft Actor-Critic's losses, targets and gradients against tianshou's, with the same weights on the same batches."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sac_reference as reference
from animat.training.networks import Layer, Network
from animat.training.replay import Batch
from animat.training.sac import Parameters, continuous_losses, discrete_losses
from animat.training.settings import SAC

pytestmark = pytest.mark.oracle

WHY = "install tianshou>=2.0 and torch (any build, CPU is enough) to compare with an independent SAC"
torch: Any = pytest.importorskip("torch", reason=WHY)
tianshou_data: Any = pytest.importorskip("tianshou.data", reason=WHY)
tianshou_optim: Any = pytest.importorskip("tianshou.algorithm.optim", reason=WHY)
tianshou_sac: Any = pytest.importorskip("tianshou.algorithm.modelfree.sac", reason=WHY)
tianshou_discrete_sac: Any = pytest.importorskip("tianshou.algorithm.modelfree.discrete_sac", reason=WHY)
tianshou_torch: Any = pytest.importorskip("tianshou.utils.torch_utils", reason=WHY)

N, HIDDEN, ACTIONS, SIZE = 4, 16, 5, 64
SETTINGS = SAC(discount=0.97, target_entropy_ratio=0.3, entropy_nats=-0.8)


def as_modules(network: Network, which: int | None = None) -> Any:
    """Our weights in torch layers, in float64 so that rounding is not what is compared."""
    layers: list[Any] = []
    for layer in network:
        weight, bias = (np.asarray(leaf if which is None else leaf[which], np.float64) for leaf in layer)
        linear = torch.nn.Linear(*weight.shape, dtype=torch.float64)
        linear.weight.data, linear.bias.data = torch.tensor(weight.T.copy()), torch.tensor(bias[0].copy())
        layers += [linear, torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1])


def as_network(module: Any, *, stacked: list[Any] | None = None) -> Network:
    """The gradients that torch left in the layers, in our shapes; of several modules side by side if `stacked`."""
    if stacked is not None:
        networks = [as_network(each) for each in stacked]
        return tuple(jax.tree.map(lambda *leaves: np.stack(leaves), *layers) for layers in zip(*networks, strict=True))
    linear = [layer for layer in module if isinstance(layer, torch.nn.Linear)]
    return tuple(Layer(layer.weight.grad.numpy().T, layer.bias.grad.numpy()[None]) for layer in linear)


def optimiser() -> Any:
    # A step of size 0: every loss is that of the weights as given, whatever the order of the updates.
    return tianshou_optim.TorchOptimizerFactory(torch.optim.SGD, lr=0.0)


class Outputs(torch.nn.Module):  # type: ignore[misc]
    """A network of observations as tianshou calls an actor or a discrete critic."""

    def __init__(self, network: Any, *, with_state: bool, without_time: bool = False) -> None:
        super().__init__()
        self.network, self.with_state, self.without_time = network, with_state, without_time

    def forward(self, obs: Any, state: Any = None, info: Any = None) -> Any:
        seen = torch.as_tensor(np.asarray(obs), dtype=torch.float64)
        outputs = self.network(seen[:, :-1] if self.without_time else seen)
        return (outputs, state) if self.with_state else outputs


class MeanAndDeviation(Outputs):
    """A continuous actor: mean and deviation, the log of the latter kept in [-5, 2] as ours is."""

    def forward(self, obs: Any, state: Any = None, info: Any = None) -> Any:
        outputs, state = super().forward(obs, state)
        means, deviations = outputs.chunk(2, dim=1)
        return (means, deviations.clamp(-5.0, 2.0).exp()), state


class OfAction(torch.nn.Module):  # type: ignore[misc]
    """A continuous critic."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network = network

    def forward(self, obs: Any, act: Any) -> Any:
        both = (torch.as_tensor(np.asarray(obs), dtype=torch.float64), torch.as_tensor(act, dtype=torch.float64))
        return self.network(torch.cat([both[0], both[1].reshape(len(both[0]), -1)], dim=1))


def in_buffer(batch: Batch, *, continuous: bool) -> Any:
    """The batch in tianshou's own replay, every third transition the last of its episode, the time
    limit among what ends it, and some others cut off where looking ahead goes on."""
    buffer = tianshou_data.ReplayBuffer(size=SIZE)
    s, s_next, a, r, ended = (np.asarray(column, np.float64) for column in batch)
    for i in range(SIZE):
        ends = bool(ended[i])
        buffer.add(
            tianshou_data.Batch(
                obs=s[i],
                obs_next=s_next[i],
                act=a[i] if continuous else int(a[i]),
                rew=r[i],
                terminated=ends,
                truncated=not ends and i % 5 == 0,
                info={},
            )
        )
    return buffer


def updated(algorithm: Any, buffer: Any) -> tuple[Any, np.ndarray]:
    """(statistics, targets) of tianshou's own update on all of the buffer."""
    kept = {}
    update_with_batch = algorithm._update_with_batch

    def watched(batch: Any) -> Any:
        kept["targets"] = batch.returns.detach().numpy().ravel().copy()
        return update_with_batch(batch)

    algorithm._update_with_batch = watched
    with tianshou_torch.policy_within_training_step(algorithm.policy):
        statistics = algorithm.update(buffer, sample_size=0)  # 0: all of it, in order
    return statistics, kept["targets"]


def problem(seed: int, n_actions: int | None, n_commands: int = 1) -> tuple[Parameters, Network, Batch]:
    trained, targets = reference.drawn_networks(seed, N, HIDDEN, n_actions, n_commands)
    batch = reference.drawn_batch(seed, SIZE, N, n_actions, n_commands)
    return trained, targets, batch._replace(ended=jnp.arange(SIZE) % 3 == 0)


def shared_arguments(trained: Parameters, wrapped: list[Any], wanted: float) -> dict[str, Any]:

    return {
        "policy_optim": optimiser(),
        "critic": wrapped[0],
        "critic_optim": optimiser(),
        "critic2": wrapped[1],
        "critic2_optim": optimiser(),
        "tau": 0.0,
        "gamma": SETTINGS.discount,
        "alpha": tianshou_sac.AutoAlpha(wanted, float(trained.log_alpha), optimiser()),
    }


def give_targets(algorithm: Any, targets: Network, wrap: Any) -> None:
    for old, which in ((algorithm.critic_old, 0), (algorithm.critic2_old, 1)):
        old.module.load_state_dict(wrap(as_modules(targets, which)).state_dict())


def compare(ours: Any, statistics: Any) -> None:
    """Losses: tianshou's critics each have the mean square, ours half of it, added up."""
    theirs = ((statistics.critic1_loss + statistics.critic2_loss) / 2, statistics.actor_loss, statistics.alpha_loss)
    np.testing.assert_allclose(np.array(ours), np.array(theirs), rtol=1e-5, atol=1e-5)


def compare_gradients(ours: Network, theirs: Network) -> None:
    for got, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_discrete_losses_targets_and_gradients(seed: int) -> None:
    import gymnasium

    trained, targets, batch = problem(seed, ACTIONS)
    actor, critics = as_modules(trained.actor), [as_modules(trained.critics, i) for i in (0, 1)]
    policy = tianshou_discrete_sac.DiscreteSACPolicy(
        actor=Outputs(actor, with_state=True, without_time=True), action_space=gymnasium.spaces.Discrete(ACTIONS)
    )
    wrapped = [Outputs(critic, with_state=False) for critic in critics]
    wanted = SETTINGS.target_entropy_ratio * math.log(ACTIONS)
    algorithm = tianshou_discrete_sac.DiscreteSAC(policy=policy, **shared_arguments(trained, wrapped, wanted))
    give_targets(algorithm, targets, lambda module: Outputs(module, with_state=False))
    statistics, their_targets = updated(algorithm, in_buffer(batch, continuous=False))

    with jax.enable_x64(True):
        trained, targets, batch = jax.tree.map(jnp.asarray, reference.in_float64((trained, targets, batch)))
        compare(discrete_losses(trained, targets, batch, SETTINGS), statistics)
        gradient = jax.grad(lambda t: sum(discrete_losses(t, targets, batch, SETTINGS)))(trained)
        compare_gradients(gradient.actor, as_network(actor))
        # theirs is of the mean square, ours of half of it
        compare_gradients(jax.tree.map(lambda g: 2 * g, gradient.critics), as_network(None, stacked=critics))
        np.testing.assert_allclose(targets_of(trained, targets, batch, None), their_targets, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("commands", [1, 2])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_continuous_losses_targets_and_gradients(seed: int, commands: int, monkeypatch: pytest.MonkeyPatch) -> None:
    import gymnasium
    from scipy.special import ndtri

    trained, targets, batch = problem(seed, None, commands)
    # tianshou keeps its logarithm from overflowing by adding 1e-7 inside, which shows where tanh is near 1: so
    # means near 0, and deviations near exp(-1), that do not lead there.
    last = trained.actor[-1]
    narrow = Layer(0.05 * last.weight, 0.05 * last.bias - jnp.repeat(jnp.array([0.0, 1.0]), commands))
    trained = trained._replace(actor=(*trained.actor[:-1], narrow))
    uniforms = np.random.default_rng(seed).uniform(0.01, 0.99, (2, SIZE, commands))
    actor, critics = as_modules(trained.actor), [as_modules(trained.critics, i) for i in (0, 1)]
    policy = tianshou_sac.SACPolicy(
        actor=MeanAndDeviation(actor, with_state=True, without_time=True),
        action_space=gymnasium.spaces.Box(-1.0, 1.0, (commands,), np.float64),
    )
    wrapped = [OfAction(critic) for critic in critics]
    algorithm = tianshou_sac.SAC(policy=policy, **shared_arguments(trained, wrapped, SETTINGS.entropy_nats * commands))
    give_targets(algorithm, targets, OfAction)

    noise = iter(ndtri(uniforms))

    def drawn(self: Any, sample_shape: Any = ()) -> Any:
        return self.loc + self.scale * torch.tensor(next(noise))

    # The same noise in both: first the targets' actions, then the new ones, in the order of tianshou's update.
    monkeypatch.setattr(torch.distributions.Normal, "rsample", drawn)
    statistics, their_targets = updated(algorithm, in_buffer(batch, continuous=True))

    with jax.enable_x64(True):
        trained, targets, batch = jax.tree.map(jnp.asarray, reference.in_float64((trained, targets, batch)))
        compare(continuous_losses(trained, targets, batch, jnp.asarray(uniforms), SETTINGS), statistics)
        gradient = jax.grad(lambda t: sum(continuous_losses(t, targets, batch, jnp.asarray(uniforms), SETTINGS)))(
            trained
        )
        compare_gradients(gradient.actor, as_network(actor))
        expected = targets_of(trained, targets, batch, jnp.asarray(uniforms))
        np.testing.assert_allclose(expected, their_targets, rtol=1e-5, atol=1e-5)


def targets_of(trained: Parameters, targets: Network, batch: Batch, uniforms: jax.Array | None) -> np.ndarray:
    """Our target of each transition, out of the critic loss: critics that answer 0 leave the square of the target,
    and critics that answer 1 leave the square of one less."""

    def loss(answer: float, i: int) -> float:
        critics = jax.tree.map(jnp.zeros_like, trained.critics)
        last = critics[-1]
        constant = (*critics[:-1], Layer(last.weight, jnp.full_like(last.bias, answer)))
        one = jax.tree.map(lambda column: column[i : i + 1], batch)
        if uniforms is None:
            return float(discrete_losses(trained._replace(critics=constant), targets, one, SETTINGS)[0])
        drawn = uniforms[:, i : i + 1]
        return float(continuous_losses(trained._replace(critics=constant), targets, one, drawn, SETTINGS)[0])

    # Two critics, each with half the square: y^2 - (y - 1)^2 = 2 y - 1.
    return np.array([(loss(0.0, i) - loss(1.0, i) + 1) / 2 for i in range(SIZE)])
