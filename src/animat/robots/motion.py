"""Computations that several robots share: angles, equations of motion over a step, and the cost of distance."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

from jaxtyping import Float

from animat.lazy import Array, jax, jnp

Numbers = TypeVar("Numbers")


def within_half_a_turn(angle_rad: Float[Array, ""]) -> Float[Array, ""]:
    """The same direction in (-pi, pi], of an angle in (-3 pi, 3 pi]."""
    least = jnp.where(angle_rad > math.pi, angle_rad - 2 * math.pi, angle_rad)
    return jnp.where(angle_rad <= -math.pi, angle_rad + 2 * math.pi, least)


def cost_of_distance(distance_m: Float[Array, ""], radius_m: float) -> Float[Array, ""]:
    """R / d - 1 with R the radius of a goal and d the distance to its centre: 0 within it, towards -1 far away."""
    # The distance may be zero at the goal; the maximum keeps R / d finite there.
    return radius_m / jnp.maximum(distance_m, radius_m) - 1


def runge_kutta(rates: Callable[[Numbers], Numbers], state: Numbers, step_s: float) -> Numbers:
    """The state one step later, by the classical Runge-Kutta method of fourth order.

        y(t + h) = y + h/6 (k1 + 2 k2 + 2 k3 + k4),
        k1 = f(y), k2 = f(y + h/2 k1), k3 = f(y + h/2 k2), k4 = f(y + h k3)

    with f the `rates`, y the state (a pytree) and h `step_s`; commands are constant within a step.
    """

    def after(rate: Numbers, share: float) -> Numbers:
        moved: Numbers = jax.tree.map(lambda y, k: y + share * step_s * k, state, rate)
        return moved

    k1 = rates(state)
    k2 = rates(after(k1, 0.5))
    k3 = rates(after(k2, 0.5))
    k4 = rates(after(k3, 1.0))
    mean: Numbers = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    return after(mean, 1.0)
