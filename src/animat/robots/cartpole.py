"""Cartpole: keep a pole upright on a cart that is pushed along a short track."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple, final

from jaxtyping import Bool, Float

from animat.robots.base import LONGEST_EPISODE, Quantity, Robot, check_parameters

if TYPE_CHECKING:
    from jax import Array

_TINY, _HUGE = 1e-9, 1e9


class CartpoleState(NamedTuple):
    """Where the cart and its pole are; positive is to the right, and the pole leaning to the right."""

    position_m: Float[Array, ""]
    velocity_m_per_s: Float[Array, ""]
    angle_rad: Float[Array, ""]
    angular_velocity_rad_per_s: Float[Array, ""]


@final
@dataclass(frozen=True)
class Cartpole(Robot[CartpoleState]):
    """A pole hinged on a cart, pushed left or right; +1 an iteration, -100 when it falls or leaves the track.

        f    = force_n (u + uniform(-force_noise, force_noise))
        tmp  = (f + m l w^2 sin a) / M
        a''  = (g sin a - cos a tmp) / (l (4/3 - m cos^2 a / M))
        x''  = tmp - m l a'' cos a / M

    with m the pole's mass, M pole and cart together, l half the pole's length, a the pole's angle from upright and
    w its rate. Explicit Euler: positions move with the velocities from before the iteration. An episode starts at
    rest, upright, in the middle of the track.

    The paper's table prints a pole of 0.55 kg and an end at 12 "rad"; the open simulator that it used has 0.055 kg and
    12 degrees, the defaults here. `Cartpole.as_printed()` is the table taken at its word.

    Attributes:
        force_noise: largest error of a push, as a part of `force_n`.
        track_length_m: the cart's centre fails beyond half of it, to either side.
        angle_limit_rad: the pole fails beyond it, to either side.
        reward_failed: the reward of the iteration in which it fails, in place of `reward_upright`.

    Raises:
        InvalidArgument: for a parameter that is not finite or has no meaning.

    Source: Sawada et al. 2022, the cartpole task and its table of constants.
    """

    gravity_m_per_s2: float = 9.8
    cart_mass_kg: float = 0.31
    pole_mass_kg: float = 0.055
    pole_length_m: float = 0.4
    track_length_m: float = 1.0
    angle_limit_rad: float = math.radians(12.0)
    force_n: float = 1.0
    force_noise: float = 0.02
    step_s: float = 0.02
    reward_upright: float = 1.0
    reward_failed: float = -100.0
    episode_limit: int = 120

    name: ClassVar[str] = "cartpole"
    noise_size: ClassVar[int] = 1
    paper_iterations: ClassVar[int] = 800_000

    def __post_init__(self) -> None:
        positive = (_TINY, _HUGE)
        check_parameters(
            self,
            gravity_m_per_s2=(0.0, _HUGE),
            cart_mass_kg=positive,
            pole_mass_kg=positive,
            pole_length_m=positive,
            track_length_m=positive,
            angle_limit_rad=positive,
            force_n=(0.0, _HUGE),
            force_noise=(0.0, _HUGE),
            step_s=positive,
            episode_limit=(1, LONGEST_EPISODE),
        )

    @property
    def return_range(self) -> tuple[float, float]:
        """Of an episode that fails in its first or its last iteration, or never."""
        up, last = self.reward_upright, self.episode_limit - 1
        returns = (self.reward_failed, last * up + self.reward_failed, last * up + up)
        return min(returns), max(returns)

    @classmethod
    def as_printed(cls) -> Cartpole:
        """The paper's table to the letter: a pole of 0.55 kg that fails at 12 rad."""
        return cls(pole_mass_kg=0.55, angle_limit_rad=12.0)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Cart position and velocity, pole angle and angular velocity."""
        (x_m, v_m_per_s), (a_rad, w_rad_per_s) = self._bounds()
        return (
            Quantity("cart_position", "m", self.track_length_m / 2, -x_m, x_m),
            Quantity("cart_velocity", "m/s", 1.0, -v_m_per_s, v_m_per_s),
            Quantity("pole_angle", "rad", min(self.angle_limit_rad, math.pi), -a_rad, a_rad),
            Quantity("pole_angular_velocity", "rad/s", 2.0, -w_rad_per_s, w_rad_per_s),
        )

    def reset(self, key: Array) -> CartpoleState:
        """At rest, upright, centred; `key` is not used."""
        import jax.numpy as jnp

        zero = jnp.zeros((), jnp.float32)
        return CartpoleState(zero, zero, zero, zero)

    def advance(
        self, uniforms: Float[Array, " noise_size"], state: CartpoleState, u: Float[Array, ""]
    ) -> tuple[CartpoleState, Float[Array, ""], Bool[Array, ""]]:
        """One push of the cart (see `Robot.advance` and the class)."""
        import jax.numpy as jnp

        position, velocity, angle, angular_velocity = state
        pole_mass, half_length = self.pole_mass_kg, self.pole_length_m / 2
        total_mass = self.cart_mass_kg + pole_mass
        sin, cos = jnp.sin(angle), jnp.cos(angle)

        force = self.force_n * (u + self.force_noise * (2 * uniforms[0] - 1))
        tmp = (force + pole_mass * half_length * angular_velocity**2 * sin) / total_mass
        angular_acceleration = (self.gravity_m_per_s2 * sin - cos * tmp) / (
            half_length * (4 / 3 - pole_mass * cos**2 / total_mass)
        )
        acceleration = tmp - pole_mass * half_length * angular_acceleration * cos / total_mass

        after = CartpoleState(
            position + self.step_s * velocity,
            velocity + self.step_s * acceleration,
            angle + self.step_s * angular_velocity,
            angular_velocity + self.step_s * angular_acceleration,
        )
        terminated = (jnp.abs(after.position_m) > self.track_length_m / 2) | (
            jnp.abs(after.angle_rad) > self.angle_limit_rad
        )
        reward = jnp.where(terminated, self.reward_failed, self.reward_upright).astype(position.dtype)
        return after, reward, terminated

    def observe(self, state: CartpoleState) -> Float[Array, " observations"]:
        """Cart position (m) and velocity (m/s), pole angle (rad) and angular velocity (rad/s)."""
        import jax.numpy as jnp

        return jnp.stack(state)

    def caveats(self) -> tuple[str, ...]:
        """Says so where the pole may swing round before the angle ends an episode."""
        if self.angle_limit_rad < math.pi / 2:
            return ()
        return (
            f"cartpole: with angle_limit_rad = {self.angle_limit_rad:g} the pole may hang or swing round without "
            f"failing, so the task is to keep the cart on its track, not to balance",
        )

    def _bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Bounds of (position, velocity) of the cart and of the pole over whole episodes that start at rest.

        Positions move with the old velocities, so a velocity that crosses all of the track (or the angles allowed) in
        one iteration ends the episode in the next; before that it grows by at most one more iteration's acceleration,
        twice. Wide, but true whatever the commands.
        """
        total_mass = self.cart_mass_kg + self.pole_mass_kg
        half_length = self.pole_length_m / 2
        lightest = 4 / 3 - self.pole_mass_kg / total_mass
        force = self.force_n * (1 + self.force_noise)

        def accelerations(angular_velocity: float) -> tuple[float, float]:
            tmp = (force + self.pole_mass_kg * half_length * angular_velocity**2) / total_mass
            angular = (self.gravity_m_per_s2 + tmp) / (half_length * lightest)
            return tmp + self.pole_mass_kg * half_length * angular / total_mass, angular

        angular_velocity = 2 * self.angle_limit_rad / self.step_s
        velocity = self.track_length_m / self.step_s
        for _ in range(2):
            linear, angular = accelerations(angular_velocity)
            velocity, angular_velocity = velocity + self.step_s * linear, angular_velocity + self.step_s * angular
        return (
            (self.track_length_m / 2 + self.step_s * velocity, velocity),
            (self.angle_limit_rad + self.step_s * angular_velocity, angular_velocity),
        )
