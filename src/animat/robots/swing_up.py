"""Swing-up: bring a pendulum upright with a motor that is too weak to lift it, and keep it there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, NamedTuple, final

import numpy as np
from jaxtyping import Float
from pydantic import Field

from animat.errors import InvalidArgument
from animat.lazy import Array, Axes, jnp
from animat.records import Number, record
from animat.robots.base import Amount, Iterations, Quantity, Robot, Size, Transition, Uniforms
from animat.robots.drawing import ACCENT, BODY, GOAL, GOAL_FILL, INK, Canvas, Pixels, draw_over_time
from animat.robots.grid import TAPS, Axis, Grid
from animat.robots.motion import runge_kutta, within_half_a_turn
from animat.robots.registry import register_robot

SPARE = 0.07
"""The heuristic's surplus over the energy needed to stand, as a fraction of the largest acceleration due to gravity."""


class SwingUpState(NamedTuple):
    """State of the pendulum: 0 is upright and pi is hanging, positive is clockwise; the angle is in (-pi, pi]."""

    angle_rad: Float[Array, ""]
    angular_velocity_rad_per_s: Float[Array, ""]


@final
@register_robot
@record
class SwingUp(Robot[SwingUpState]):
    """A pendulum swung up by a motor too weak to lift it; +1 for an iteration that ends near upright, else 0.

        m l^2 / 3 a'' = m g l / 2 sin a + torque_n_m u

    with m the mass and l the length of a uniform rod that turns about its end, and a its angle from upright. With the
    defaults, a'' = 15 sin a + 6 u: the motor alone lifts the rod to 24 degrees from hanging. An iteration is one step
    of the classical Runge-Kutta method, after which the angular velocity is clipped to `speed_limit_rad_per_s`, as by
    a brake. An episode starts at rest, hanging, and is never terminated.

    Attributes:
        speed_limit_rad_per_s: the largest angular velocity, in either direction.
        upright_rad: the largest rewarded angle from upright, to either side.
        reward_upright: the reward of an iteration that ends there.

    Raises:
        InvalidArgument: for a step in which the rod could make a whole turn.

    Source: the pendulum of Gymnasium (`Pendulum-v1`) with another reward.
    """

    gravity_m_per_s2: Amount = 10.0
    mass_kg: Size = 1.0
    length_m: Size = 1.0
    torque_n_m: Amount = 2.0
    speed_limit_rad_per_s: Size = 8.0
    upright_rad: Annotated[Number, Field(ge=1e-9, le=math.pi)] = math.radians(30.0)
    step_s: Size = 0.05
    reward_upright: Number = 1.0
    episode_limit: Iterations = 200

    name: ClassVar[str] = "swing-up"
    paper_iterations: ClassVar[int] = 1_000_000
    # Full power either way swings highest, and gives random commands a chance of swinging it up.
    baseline_commands: ClassVar[tuple[float, ...] | None] = (-1.0, 1.0)

    def __post_init__(self) -> None:
        most_rad = self.step_s * (self.speed_limit_rad_per_s + self.step_s * (self._gravity_per_s2 + self._push_per_s2))
        if most_rad > math.tau:
            raise InvalidArgument(f"step_s: expected a step of less than a turn, got {most_rad / math.tau:.3g} turns")

    @property
    def return_range(self) -> tuple[float, float]:
        """From never being near upright to always."""
        always = self.episode_limit * self.reward_upright
        return min(0.0, always), max(0.0, always)

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        """Cosine and sine of the angle, which do not jump at the bottom, and the angular velocity."""
        fastest = self.speed_limit_rad_per_s
        return (
            Quantity("angle_cosine", "1", 1.0, -1.0, 1.0),
            Quantity("angle_sine", "1", 1.0, -1.0, 1.0),
            Quantity("angular_velocity", "rad/s", fastest, -fastest, fastest),
        )

    def reset(self, key: Array) -> SwingUpState:
        """At rest, hanging; `key` is not used."""
        return SwingUpState(jnp.float32(math.pi), jnp.zeros((), jnp.float32))

    def advance(self, uniforms: Uniforms, state: SwingUpState, u: Float[Array, ""]) -> Transition[SwingUpState]:
        def rates(state: SwingUpState) -> SwingUpState:
            angle, angular_velocity = state
            return SwingUpState(angular_velocity, self._gravity_per_s2 * jnp.sin(angle) + self._push_per_s2 * u)

        angle, angular_velocity = runge_kutta(rates, state, self.step_s)
        fastest = self.speed_limit_rad_per_s
        after = SwingUpState(within_half_a_turn(angle), jnp.clip(angular_velocity, -fastest, fastest))
        upright = jnp.abs(after.angle_rad) <= self.upright_rad
        reward = jnp.where(upright, self.reward_upright, 0.0).astype(angle.dtype)
        return after, reward, jnp.zeros((), bool)

    def observe(self, state: SwingUpState) -> Float[Array, " observations"]:
        return jnp.stack([jnp.cos(state.angle_rad), jnp.sin(state.angle_rad), state.angular_velocity_rad_per_s])

    def caveats(self) -> tuple[str, ...]:
        """A warning if the motor can lift the pendulum without swinging."""
        if self._push_per_s2 < self._gravity_per_s2:
            return ()
        weakest_n_m = self.mass_kg * self.gravity_m_per_s2 * self.length_m / 2
        return (
            f"swing-up: with torque_n_m = {self.torque_n_m:g} the motor lifts the pendulum directly (from "
            f"{weakest_n_m:g} N m on), so no swing is needed",
        )

    def heuristic(self, observation: Any) -> Any:
        """Full power in the direction of movement until the energy suffices to stand; near upright, against the fall.

        The energy is w^2 / 2 + k (cos a - 1) with k the largest acceleration due to gravity, 0 for a standing rod. Near
        upright the rod falls with a + w / sqrt(k); the motor catches it if that is less than it can hold.
        """
        xp = observation.__array_namespace__()
        cosine, sine, angular_velocity = observation
        gravity = max(self._gravity_per_s2, 1e-9)
        energy = angular_velocity**2 / 2 + gravity * (cosine - 1)
        direction = xp.where(angular_velocity >= 0, 1.0, -1.0)
        # With some energy to spare: with exactly enough to stand, the pole would take for ever to get there.
        pumping = xp.where(energy < SPARE * gravity, direction, -direction)
        falling = sine + angular_velocity / math.sqrt(gravity)
        held = min(self._push_per_s2 / gravity, 1.0)
        catching = xp.clip(-4 * falling, -1.0, 1.0)
        return xp.where((cosine > 0) & (xp.abs(falling) < held), catching, pumping)

    def value_grid(self) -> Grid:
        """Angle by angular velocity, computed for every command, as a command may decide whether a step is rewarded."""
        fastest = self.speed_limit_rad_per_s
        return Grid(
            # A grid's first coordinate must not affect the others, and both of these do: add a dummy.
            Axis("nothing", "1", 0.0, 1.0, TAPS),
            (
                Axis("angle", "rad", -math.pi, math.pi, 180, periodic=True),
                Axis("angular_velocity", "rad/s", -fastest, fastest, 121),
            ),
            lambda state: (jnp.zeros_like(state.angle_rad), *state),
            lambda coordinates: SwingUpState(*coordinates[1:]),
        )

    def draw(self, observation: np.ndarray, command: float, earlier: Sequence[np.ndarray], height_px: int) -> Pixels:
        """The rod, the rewarded range, and the command as an arc about the pivot (see `animat.robots.drawing`)."""
        length = self.length_m
        scale = height_px / (2.5 * length)
        canvas = Canvas(height_px, height_px, (height_px / 2, height_px / 2), scale)

        def at(angle: float, radius: float) -> tuple[float, float]:
            return radius * math.sin(angle), -radius * math.cos(angle)

        rewarded = np.linspace(-self.upright_rad, self.upright_rad, 40)
        canvas.stroke([at(float(angle), 1.1 * length) for angle in rewarded], 0.03 * length, GOAL_FILL)
        for end in (-self.upright_rad, self.upright_rad):
            canvas.disc(at(end, 1.1 * length), 0.015 * length, GOAL)
        tip = (length * float(observation[1]), -length * float(observation[0]))
        canvas.stroke([(0.0, 0.0), tip], 0.08 * length, BODY)
        canvas.disc((0.0, 0.0), 0.03 * length, INK)
        if command:
            arc = np.linspace(0.0, command * math.pi / 2, 20)
            canvas.stroke([at(float(angle), 0.2 * length) for angle in arc], 0.03 * length, ACCENT)
            canvas.disc(at(float(arc[-1]), 0.2 * length), 0.035 * length, ACCENT)
        return canvas.picture()

    def draw_paths(self, axes: Axes, paths: Sequence[np.ndarray]) -> None:
        """The pendulum's angle from upright over time in each episode."""
        limit_deg = math.degrees(self.upright_rad)
        off_deg = [np.degrees(np.arccos(np.clip(path[:, 0], -1, 1))) for path in paths]
        stood = [bool(angles[-1] <= limit_deg) for angles in off_deg]
        draw_over_time(axes, self, off_deg, stood, limits=[limit_deg], success="end upright")
        axes.set(ylabel="angle from upright (deg)", ylim=(0, 185))

    @property
    def _gravity_per_s2(self) -> float:
        """The largest angular acceleration due to gravity: 3 g / (2 l)."""
        return 1.5 * self.gravity_m_per_s2 / self.length_m

    @property
    def _push_per_s2(self) -> float:
        """The largest angular acceleration due to the motor: 3 torque / (m l^2)."""
        return 3 * self.torque_n_m / (self.mass_kg * self.length_m**2)
