"""Gymnasium environments: `Animat/Cartpole-v0`, `Animat/Navigation-v0`, `Animat/SwingUp-v0` and `Animat/Robot-v0`.

Each exists as a single environment and as a vector. `Animat/Robot-v0` is for robots with several commands, whose
readouts only recordings or a simulator define, and for custom robots.

`import animat` registers them; `gymnasium.make("animat:Animat/Cartpole-v0")` does both. Their options are the arguments
of `animat.gym.setup.set_up`.
"""

from __future__ import annotations

IDS = {"Animat/Cartpole-v0": "cartpole", "Animat/Navigation-v0": "navigation", "Animat/SwingUp-v0": "swing-up"}
"""The environments of robots with one command, which need no recordings."""

ANY = "Animat/Robot-v0"
"""The environment that takes its robot as an option."""


def register_environments() -> None:
    """Register the environments with Gymnasium, unless they are registered already.

    Nothing else of animat, nor JAX, is loaded before an environment is created.
    """
    from gymnasium.envs.registration import register, registry

    for id_, robot in (*IDS.items(), (ANY, None)):
        if id_ not in registry:
            # No max_episode_steps: the robot's episode limit truncates, and is an option like all others.
            register(
                id_,
                entry_point="animat.gym.environments:AnimatEnv",
                vector_entry_point="animat.gym.environments:AnimatVectorEnv",
                kwargs={} if robot is None else {"robot_of_id": robot},
            )
