"""Third-party DQN on `Animat/Cartpole-v0`: one policy on one core until it reaches a return or its time is up.

DQN is what both have for discrete actions: SAC in stable-baselines3 and sbx is for continuous actions only.
"""

from __future__ import annotations

import time
from typing import Any

PEERS = {
    "stable_baselines3, tuned": "stable-baselines3 DQN, tuned",
    "stable_baselines3, defaults": "stable-baselines3 DQN, its defaults",
    "sbx, tuned": "sbx DQN, tuned",
}
"""Package and settings of each, and its name in the table."""

TUNED = {
    "learning_rate": 1e-3,
    "batch_size": 64,
    "buffer_size": 131_072,
    "learning_starts": 1_000,
    "gamma": 0.99,
    "train_freq": 8,
    "gradient_steps": 1,
    "target_update_interval": 1_000,
    "exploration_final_eps": 0.05,
    "exploration_fraction": 0.025,
}
"""Our values where both have a setting (including the replay ratio of 1/8); the others are usual for such tasks."""

STEPS = 800_000
"""How long they would train if nothing stopped them, as ours does; `exploration_fraction` refers to this."""

EVALUATED_EVERY = 5_000
"""Steps between evaluations; training ends when the last `HELD` of them reach the return on average."""

HELD = 3


def train_peer(name: str, seed: int, wanted: float, cap_s: float) -> dict[str, Any]:
    """Train one policy; return the time without evaluations, the number of steps, and the returns reached.

    DQN's return fluctuates from one evaluation to the next. So two times are taken: when an evaluation first reached
    the return, and when the return held.
    """
    import gymnasium
    import numpy as np
    from stable_baselines3.common.callbacks import BaseCallback

    package, which = name.split(", ")
    settings: dict[str, Any] = {}
    if package == "sbx":
        from sbx import DQN

        net_arch = [64]  # the width of both hidden layers
    else:
        import torch
        from stable_baselines3 import DQN

        torch.set_num_threads(1)
        net_arch = [64, 64]

    scales = np.array([quantity.scale for quantity in make().unwrapped.setup.environment.observation_spec], np.float32)
    many = gymnasium.make_vec("animat:Animat/Cartpole-v0", num_envs=100, mapping="9-thresholds")

    def mean_return(model: Any) -> float:
        """Mean return of 100 episodes, each the first of one environment, with the best action at each step."""
        observation, _ = many.reset(seed=1000)
        returns, going = np.zeros(100), np.ones(100, bool)
        while going.any():
            action, _ = model.predict(observation / scales, deterministic=True)
            observation, reward, terminated, truncated, _ = many.step(np.asarray(action))
            returns += np.where(going, reward, 0.0)
            going &= ~(terminated | truncated)
        return float(returns.mean())

    class Watch(BaseCallback):  # type: ignore[misc]
        """Evaluates at intervals with the clock stopped, and ends the training."""

        def __init__(self) -> None:
            super().__init__()
            self.returns: list[float] = []
            self.training_s, self.resumed = 0.0, time.perf_counter()
            self.first_s: float | None = None
            self.held = False

        def _on_step(self) -> bool:
            if self.num_timesteps % EVALUATED_EVERY and time.perf_counter() - self.resumed + self.training_s < cap_s:
                return True
            self.training_s += time.perf_counter() - self.resumed
            self.returns.append(mean_return(self.model))
            if self.returns[-1] >= wanted and self.first_s is None:
                self.first_s = self.training_s
            self.held = len(self.returns) >= HELD and float(np.mean(self.returns[-HELD:])) >= wanted
            self.resumed = time.perf_counter()
            return not self.held and self.training_s < cap_s

    environment = make()
    if which == "tuned":
        # The scales by which our learner divides observations and rewards.
        environment = gymnasium.wrappers.TransformObservation(environment, lambda o: o / scales, None)
        environment = gymnasium.wrappers.TransformReward(environment, lambda reward: 0.1 * float(reward))
        settings = TUNED | {"policy_kwargs": {"net_arch": net_arch}}
    else:
        scales = np.ones_like(scales)
    model = DQN("MlpPolicy", environment, seed=seed, **settings)
    mean_return(model)  # compiles what evaluations need
    watch = Watch()
    model.learn(STEPS, callback=watch)
    return {
        "training_s": watch.training_s,
        "steps": model.num_timesteps,
        "held": watch.held,
        "first_s": watch.first_s,
        "best_return": max(watch.returns),
        "returns": watch.returns,
        "settings": settings,
    }


def make() -> Any:
    """The environment, with the synthetic culture."""
    import gymnasium

    return gymnasium.make("animat:Animat/Cartpole-v0", mapping="9-thresholds")
