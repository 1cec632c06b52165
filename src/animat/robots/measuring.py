"""Measurements on an external body under random commands: the scale of its observations, and whether it repeats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from animat.robots.host import Bodies, HostRobot

_MEASURED_STEPS = 1_000
"""Random commands, in consecutive episodes."""
_REPEATED_STEPS = 50
_SEED = 20_260_000


def measured_scales(robot: HostRobot, bounds: Sequence[float]) -> tuple[float, ...]:
    """The scale of each observed number: its bound, or, where that is 0 (not known), its root mean square.

    The root mean square is over random commands. It has two digits, so that it does not depend on how a processor
    rounds, and is 1 for a number that is always 0.
    """
    if all(bounds):
        return tuple(map(float, bounds))
    rng = np.random.default_rng(_SEED)
    bodies = Bodies(robot, [(_SEED,)])
    observed = [bodies.begin()[0]]
    for _ in range(_MEASURED_STEPS):
        stepped = bodies.step(_random_command(robot, rng))
        observed.append(stepped.observation[0])
        if stepped.ended[0]:
            observed.append(bodies.begin()[0])
    size = np.sqrt(np.mean(np.square(observed, dtype=np.float64), axis=0))
    return tuple(
        float(bound or f"{min(float(rms), 1e9):.2g}") if bound or rms > 1e-9 else 1.0
        for bound, rms in zip(bounds, size, strict=True)
    )


def is_repeatable(robot: HostRobot) -> bool:
    """Whether its seed and commands determine an episode, in a new body as in one that was used before."""
    used, new = Bodies(robot, [(_SEED, 1)]), Bodies(robot, [(_SEED, 2)])
    rng = np.random.default_rng(_SEED)
    used.begin()
    for _ in range(_REPEATED_STEPS):
        if used.step(_random_command(robot, rng)).ended[0]:
            break
    again = Bodies(robot, [(_SEED, 2)])
    # The same episode in fresh bodies and in one that has run another.
    used.reseed([(_SEED, 2)])
    starts = [bodies.begin() for bodies in (used, new, again)]
    if any(not np.array_equal(start, starts[0]) for start in starts):
        return False
    for _ in range(_REPEATED_STEPS):
        command = _random_command(robot, rng)
        one, *others = (bodies.step(command) for bodies in (used, new, again))
        if any(not np.array_equal(a, b) for other in others for a, b in zip(one, other, strict=True)):
            return False
        if one.ended[0]:
            break
    return True


def _random_command(robot: HostRobot, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (1, robot.n_commands)).astype(np.float32)
