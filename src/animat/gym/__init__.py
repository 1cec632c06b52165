"""Gymnasium environments: `Animat/Cartpole-v0`, `Animat/Navigation-v0`, `Animat/SwingUp-v0` and `Animat/Robot-v0`.

Each is there alone and as a vector. `Animat/Robot-v0` is for robots of several commands, whose readouts only
recordings or a simulator tell, and for a user's own.

`import animat` registers them; `gymnasium.make("animat:Animat/Cartpole-v0")` does both. What they accept is the
signature of `animat.gym.setup.set_up`.
"""

from __future__ import annotations

IDS = {"Animat/Cartpole-v0": "cartpole", "Animat/Navigation-v0": "navigation", "Animat/SwingUp-v0": "swing-up"}
"""The environments of a robot each: of those with one command, which need no recordings."""

ANY = "Animat/Robot-v0"
"""The environment that is told its robot."""


def register_environments() -> None:
    """Tell Gymnasium about the environments; doing it again changes nothing.

    Nothing else of animat, and no JAX, is loaded before an environment is made.
    """
    from gymnasium.envs.registration import register, registry

    for id_, robot in (*IDS.items(), (ANY, None)):
        if id_ not in registry:
            # No max_episode_steps: the robot's own episode limit truncates, and is an option like all others.
            register(
                id_,
                entry_point="animat.gym.single:AnimatEnv",
                vector_entry_point="animat.gym.vector:AnimatVectorEnv",
                kwargs={} if robot is None else {"robot": robot},
            )
