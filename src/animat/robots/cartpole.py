"""Cartpole: keep a pole upright on a cart that is pushed along a short track."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from jaxtyping import Float

from animat.errors import InvalidArgument
from animat.lazy import Array, Axes, jnp
from animat.records import Number, record
from animat.robots.base import Amount, Iterations, Quantity, Robot, Size, Transition, Uniforms
from animat.robots.drawing import ACCENT, BODY, INK, PAPER, RAIL, Canvas, Pixels, draw_over_time, fit
from animat.robots.grid import Axis, Grid
from animat.robots.registry import register_robot

FORESIGHT_S = 0.1
"""The heuristic extrapolates the pole's angle over this time, at its current angular velocity."""


class CartpoleState(NamedTuple):
    """State of cart and pole; positive is to the right, and the pole leaning to the right."""

    position_m: Float[Array, ""]
    velocity_m_per_s: Float[Array, ""]
    angle_rad: Float[Array, ""]
    angular_velocity_rad_per_s: Float[Array, ""]


@final
@register_robot
@record
class Cartpole(Robot[CartpoleState]):
    """A pole hinged on a cart, pushed left or right; +1 per iteration, -100 when it falls or leaves the track.

        f    = force_n (u + uniform(-force_noise, force_noise))
        tmp  = (f + m l w^2 sin a) / M
        a''  = (g sin a - cos a tmp) / (l (4/3 - m cos^2 a / M))
        x''  = tmp - m l a'' cos a / M

    with m the pole's mass, M that of pole and cart together, l half the pole's length, a the pole's angle from upright
    and w its angular velocity. Integration is explicit Euler: positions move with the velocities from before the
    iteration. An episode starts at rest, upright, in the middle of the track.

    Attributes:
        force_noise: largest error of a push, as a fraction of `force_n`.
        track_length_m: the episode fails if the cart's centre is more than half of it from the middle.
        angle_limit_rad: the episode fails if the pole leans further, to either side.
        reward_failed: the reward of the iteration that fails, in place of `reward_upright`.

    Source: Sawada et al. 2022, the cartpole task and its table of constants.
    """

    gravity_m_per_s2: Amount = 9.8
    cart_mass_kg: Size = 0.31
    pole_mass_kg: Size = 0.055
    pole_length_m: Size = 0.4
    track_length_m: Size = 1.0
    angle_limit_rad: Size = math.radians(12.0)
    force_n: Amount = 1.0
    force_noise: Amount = 0.02
    step_s: Size = 0.02
    reward_upright: Number = 1.0
    reward_failed: Number = -100.0
    episode_limit: Iterations = 120

    name: ClassVar[str] = "cartpole"
    noise_size: ClassVar[int] = 1
    paper_iterations: ClassVar[int] = 800_000
    baseline_commands: ClassVar[tuple[float, ...] | None] = (-1.0, 1.0)

    @property
    def return_range(self) -> tuple[float, float]:
        """From the returns of failing in the first iteration, in the last, or never."""
        up, last = self.reward_upright, self.episode_limit - 1
        returns = (self.reward_failed, last * up + self.reward_failed, last * up + up)
        return min(returns), max(returns)

    @classmethod
    def as_printed(cls) -> Cartpole:
        """The paper's table taken literally: a pole of 0.55 kg that fails at 12 rad."""
        return cls(pole_mass_kg=0.55, angle_limit_rad=12.0)

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
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
        zero = jnp.zeros((), jnp.float32)
        return CartpoleState(zero, zero, zero, zero)

    def advance(self, uniforms: Uniforms, state: CartpoleState, u: Float[Array, ""]) -> Transition[CartpoleState]:
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
        is_off_track = jnp.abs(after.position_m) > self.track_length_m / 2
        terminated = is_off_track | (jnp.abs(after.angle_rad) > self.angle_limit_rad)
        reward = jnp.where(terminated, self.reward_failed, self.reward_upright).astype(position.dtype)
        return after, reward, terminated

    def observe(self, state: CartpoleState) -> Float[Array, " observations"]:
        return jnp.stack(state)

    def caveats(self) -> tuple[str, ...]:
        """A warning if the pole may swing round before its angle ends an episode."""
        if self.angle_limit_rad < math.pi / 2:
            return ()
        return (
            f"cartpole: with angle_limit_rad = {self.angle_limit_rad:g} the pole may hang or swing round without "
            f"failing, so the task is to keep the cart on its track, not to balance the pole",
        )

    def departures(self) -> tuple[tuple[str, str], ...]:
        """The pole's mass, and the angle that ends an episode."""
        source = "the simulator's" if math.isclose(self.pole_mass_kg, 0.055) else "chosen for this study"
        return (
            (
                "Pole mass",
                "The paper's table prints 0.55 kg; the open simulator whose other numbers it repeats has 0.055 kg. "
                f"Here it is {self.pole_mass_kg:g} kg, {source} (pole_mass_kg).",
            ),
            (
                "12 degrees",
                "The paper prints that an episode ends when the pole passes 12 rad, nearly two turns; the open "
                f"simulator has 12 degrees. Here it is {math.degrees(self.angle_limit_rad):.3g} degrees "
                "(angle_limit_rad).",
            ),
        )

    def heuristic(self, observation: Any) -> Any:
        """Full power to the side of theta + 0.1 s * theta', the pole's angle 0.1 s from now."""
        return 2.0 * (observation[2] + FORESIGHT_S * observation[3] > 0) - 1.0

    def value_grid(self) -> Grid:
        """The grid found by measurement to suit the task (see docs/evidence/optimal-return.md).

        Position and angle are those after the next iteration, which are already decided: a state in which one of them
        exceeds its limit is lost, and the axes end there. With l half the pole's length, a push changes the cart's
        velocity v and the pole's angular velocity w so that v + 4/3 l w stays nearly the same. This sum changes only
        by gravity, slowly, and takes the place of v. The axis of angular velocities ends 10 % beyond where the pole can
        no longer be caught: r (angle limit + F / (M g)), with r the rate at which it falls, 1/s. That of velocities
        ends at sqrt(g angle limit track length), from which leaning the pole can hardly stop the cart on its track. For
        a large angle limit there is none (InvalidArgument).
        """
        if self.angle_limit_rad > 0.75:
            most = "0.75 without a grid of your own"
            raise InvalidArgument(f"angle_limit_rad: expected at most {most}, got {self.angle_limit_rad:g}")
        half_length_m = self.pole_length_m / 2
        total_kg = self.cart_mass_kg + self.pole_mass_kg
        shear_m = 4 / 3 * half_length_m
        step_s = self.step_s
        gravity = max(self.gravity_m_per_s2, 1.0)
        rate_per_s = math.sqrt(gravity / (half_length_m * (4 / 3 - self.pole_mass_kg / total_kg)))
        held_rad = max(self.force_n, 0.1) / (total_kg * gravity)
        angular_velocity = 1.1 * rate_per_s * (self.angle_limit_rad + held_rad)
        velocity = math.sqrt(gravity * self.angle_limit_rad * self.track_length_m)

        def to_coordinates(state: CartpoleState) -> tuple[Array, ...]:
            x, v, a, w = state
            return x + step_s * v, v + shear_m * w, a + step_s * w, w

        def to_state(coordinates: tuple[Array, ...]) -> CartpoleState:
            x, z, a, w = coordinates
            v = z - shear_m * w
            return CartpoleState(x - step_s * v, v, a - step_s * w, w)

        half_track_m = self.track_length_m / 2
        return Grid(
            Axis("next cart_position", "m", -half_track_m, half_track_m, 17),
            (
                Axis("cart_velocity + 4/3 l w", "m/s", -velocity, velocity, 17),
                Axis("next pole_angle", "rad", -self.angle_limit_rad, self.angle_limit_rad, 41),
                Axis("pole_angular_velocity", "rad/s", -angular_velocity, angular_velocity, 55),
            ),
            to_coordinates,
            to_state,
            smooth_commands=5,
            end_is_known=True,
            noise_in_command=self.force_noise,
        )

    def draw(self, observation: np.ndarray, command: float, earlier: Sequence[np.ndarray], height_px: int) -> Pixels:
        """The cart on its track with the pole, and the command as an arrow (see `animat.robots.drawing`)."""
        half_track, pole = self.track_length_m / 2, self.pole_length_m
        margin = 0.25 * pole
        x, angle = float(observation[0]), float(observation[2])
        # Room for the pole to hang, if the limits allow it.
        below = pole if self.angle_limit_rad > math.pi / 2 else 0.1 * pole
        scale, width_px, above_px = fit(2 * (half_track + pole / 2 + margin), pole + below + 2 * margin, height_px)
        canvas = Canvas(width_px, height_px, (width_px / 2, above_px + scale * (pole + margin)), scale)

        cart_width, cart_height, thick = 0.3 * pole, 0.14 * pole, 0.045 * pole
        canvas.stroke([(-half_track, 0.0), (half_track, 0.0)], 0.02 * pole, RAIL)
        for end in (-half_track, half_track):
            canvas.stroke([(end, -0.5 * cart_height), (end, 0.5 * cart_height)], 0.02 * pole, INK)
        canvas.box((x - cart_width / 2, -cart_height / 2), (x + cart_width / 2, cart_height / 2), 0.02 * pole, INK)
        tip = (x + pole * math.sin(angle), -pole * math.cos(angle))
        canvas.stroke([(x, 0.0), tip], thick, BODY)
        canvas.disc((x, 0.0), 0.6 * thick, PAPER)
        if command:
            y = cart_height / 2 + 0.12 * pole
            head = x + 0.3 * pole * command
            back = head - math.copysign(0.05 * pole, command)
            canvas.stroke([(x, y), (head, y)], 0.02 * pole, ACCENT)
            canvas.stroke([(back, y - 0.04 * pole), (head, y), (back, y + 0.04 * pole)], 0.02 * pole, ACCENT)
        return canvas.picture()

    def draw_paths(self, axes: Axes, paths: Sequence[np.ndarray]) -> None:
        """The pole's angle over time in each episode."""
        limit_deg, angles_deg = math.degrees(self.angle_limit_rad), [np.degrees(path[:, 2]) for path in paths]
        ends = [(abs(float(path[-1, 0])), abs(float(path[-1, 2]))) for path in paths]
        has_failed = [x > self.track_length_m / 2 or angle > self.angle_limit_rad for x, angle in ends]
        # It may fail in the last iteration, too.
        stayed = [len(path) > self.episode_limit and not fails for path, fails in zip(paths, has_failed, strict=True)]
        limits = -limit_deg, limit_deg
        draw_over_time(axes, self, angles_deg, stayed, limits=limits, success="to the end")
        axes.set(ylabel="pole angle (deg)", ylim=(-1.25 * limit_deg, 1.25 * limit_deg))

    def _bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Bounds of (position, velocity) of the cart and of the pole over whole episodes that start at rest.

        Positions move with the old velocities, so a velocity that crosses the whole track (or range of angles) in one
        iteration ends the episode in the next. Until then it grows by at most two iterations' acceleration. The bounds
        are wide, but hold for any commands.
        """
        total_mass = self.cart_mass_kg + self.pole_mass_kg
        half_length = self.pole_length_m / 2
        lightest = 4 / 3 - self.pole_mass_kg / total_mass
        force = self.force_n * (1 + self.force_noise)

        angular_velocity = 2 * self.angle_limit_rad / self.step_s
        velocity = self.track_length_m / self.step_s
        for _ in range(2):
            tmp = (force + self.pole_mass_kg * half_length * angular_velocity**2) / total_mass
            angular_acceleration = (self.gravity_m_per_s2 + tmp) / (half_length * lightest)
            acceleration = tmp + self.pole_mass_kg * half_length * angular_acceleration / total_mass
            velocity += self.step_s * acceleration
            angular_velocity += self.step_s * angular_acceleration
        return (
            (self.track_length_m / 2 + self.step_s * velocity, velocity),
            (self.angle_limit_rad + self.step_s * angular_velocity, angular_velocity),
        )
