"""Arm: bring the tip of two links to a target that differs in each episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from jaxtyping import Float

from animat.errors import InvalidArgument
from animat.lazy import Array, Axes, jax, jnp
from animat.records import record
from animat.robots.base import Amount, Iterations, Quantity, Robot, Size, Transition, Uniforms
from animat.robots.drawing import ACCENT, BODY, GOAL, GOAL_FILL, INK, TRAIL, Canvas, Pixels, draw_over_time
from animat.robots.motion import cost_of_distance, runge_kutta
from animat.robots.registry import register_robot

SUBSTEPS = 4
"""Integration steps per iteration: damping settles a light link within a fraction of one."""
STIFFEST = 2.5
"""Largest product of rate and step: the Runge-Kutta method of fourth order is stable up to 2.78."""
TURN_RAD = 1.0
"""Largest turn of a joint in an integration step; with 2.5 times that, states grow without bound."""
PULL, BRAKE_S = 40.0, 1.0
"""The heuristic's commands for a distance of one arm's length, and for a joint velocity of 1 rad/s."""
NEAREST, FARTHEST = 0.3, 0.95
"""Range of the targets' distance from the shoulder, in arm's lengths, within what the tip can reach."""


class ArmState(NamedTuple):
    """Joints and target, seen from above with the shoulder at (0, 0): x to the right, y down.

    Angles increase clockwise and are not wrapped: the shoulder's is 0 to the right, the elbow's for a straight arm.
    """

    shoulder_rad: Float[Array, ""]
    elbow_rad: Float[Array, ""]
    shoulder_rad_per_s: Float[Array, ""]
    elbow_rad_per_s: Float[Array, ""]
    target_x_m: Float[Array, ""]
    target_y_m: Float[Array, ""]


@final
@register_robot
@record
class TwoLinkArm(Robot[ArmState]):
    """Two links on a table, a motor in each joint; 0 for an iteration with the tip at the target, else towards -1.

        M(q) q'' = torque_n_m u - damping_n_m_s q' - c(q, q')
        M11 = m1 l1^2 / 3 + m2 (l1^2 + l2^2 / 3 + l1 l2 cos q2)
        M12 = m2 (l2^2 / 3 + l1 l2 cos q2 / 2),   M22 = m2 l2^2 / 3
        c   = m2 l1 l2 sin q2 / 2 (-2 q1' q2' - q2'^2, q1'^2)
        reward = R / max(d, R) - 1

    with q1 the shoulder's and q2 the elbow's angle, m and l the masses and lengths of uniform rods, d the distance
    from tip to target after the movement and R the target's radius. Gravity plays no part. An iteration is four steps
    of the classical Runge-Kutta method, during which u is constant. An episode starts at rest with the elbow at a right
    angle, and is never terminated. Its target is drawn uniformly from the area between 0.3 and 0.95 of the arm's length
    from the shoulder, limited to what the tip can reach.

    Attributes:
        torque_n_m: of each motor at u = 1.
        damping_n_m_s: of each joint.
        target_radius_m: R.

    Raises:
        InvalidArgument: for links too different in length to reach a target, or a step too long for the equations.

    Source: any robotics textbook, the manipulator with two revolute joints; the task is that of Gymnasium's
    `Reacher-v5`, and of the drawing arm Meart (Bakkum et al. 2007).
    """

    upper_length_m: Size = 0.2
    lower_length_m: Size = 0.2
    upper_mass_kg: Size = 0.1
    lower_mass_kg: Size = 0.1
    torque_n_m: Amount = 0.01
    damping_n_m_s: Amount = 0.005
    target_radius_m: Size = 0.02
    step_s: Size = 0.05
    episode_limit: Iterations = 100

    name: ClassVar[str] = "arm"
    n_commands: ClassVar[int] = 2
    paper_iterations: ClassVar[int] = 2_000_000

    def __post_init__(self) -> None:
        nearest_m, farthest_m = self._target_distances_m
        if nearest_m >= farthest_m:
            lengths = f"{self.lower_length_m:g} m with an upper link of {self.upper_length_m:g} m"
            raise InvalidArgument(f"lower_length_m: expected links similar enough to reach a target, got {lengths}")
        least, _ = self._eigenvalues_kg_m2
        if self.damping_n_m_s * self.step_s > STIFFEST * SUBSTEPS * least:
            most = f"{STIFFEST * SUBSTEPS * least / self.damping_n_m_s:.3g} for links so light and joints so damped"
            raise InvalidArgument(f"step_s: expected at most {most}, got {self.step_s:g}")
        # At the speed at which damping balances full torque, or, if less, that of the elbow alone at an episode's end.
        torque_n_m, elbow_kg_m2 = max(self.torque_n_m, 1e-9), self._inertia[2]
        damped_s = TURN_RAD * SUBSTEPS * self.damping_n_m_s / torque_n_m
        longest_s = max(damped_s, math.sqrt(TURN_RAD * SUBSTEPS * elbow_kg_m2 / (torque_n_m * self.episode_limit)))
        if self.step_s > longest_s:
            raise InvalidArgument(f"step_s: expected at most {longest_s:.3g} for motors so strong, got {self.step_s:g}")

    @property
    def return_range(self) -> tuple[float, float]:
        """From being as far from the target as possible to always being at it."""
        arm_m = self.upper_length_m + self.lower_length_m
        farthest_m = arm_m + self._target_distances_m[1]
        return self.episode_limit * (min(1.0, self.target_radius_m / farthest_m) - 1), 0.0

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        """Cosines and sines of the joint angles, joint velocities, target, and vector to it, as in `Reacher-v5`."""
        arm_m, target_m = self.upper_length_m + self.lower_length_m, self._target_distances_m[1]
        fastest = self._fastest_rad_per_s
        # The velocity at which damping balances full torque, if an episode is long enough to reach it.
        usual = min(self.torque_n_m / max(self.damping_n_m_s, 1e-9), fastest) or 1.0
        names = ("shoulder_cosine", "shoulder_sine", "elbow_cosine", "elbow_sine")
        return (
            *(Quantity(name, "1", 1.0, -1.0, 1.0) for name in names),
            Quantity("shoulder_velocity", "rad/s", usual, -fastest, fastest),
            Quantity("elbow_velocity", "rad/s", usual, -fastest, fastest),
            Quantity("target_x", "m", arm_m, -target_m, target_m, of_goal=True),
            Quantity("target_y", "m", arm_m, -target_m, target_m, of_goal=True),
            Quantity("to_target_x", "m", arm_m, -arm_m - target_m, arm_m + target_m, of_goal=True),
            Quantity("to_target_y", "m", arm_m, -arm_m - target_m, arm_m + target_m, of_goal=True),
        )

    def reset(self, key: Array) -> ArmState:
        """At rest, the upper link to the right and the elbow bent downwards; the target is drawn."""
        outwards, around = jax.random.uniform(key, (2,), jnp.float32)
        nearest_m, farthest_m = self._target_distances_m
        distance_m = jnp.sqrt(nearest_m**2 + outwards * (farthest_m**2 - nearest_m**2))
        direction = 2 * math.pi * around
        zero = jnp.zeros((), jnp.float32)
        x_m, y_m = distance_m * jnp.cos(direction), distance_m * jnp.sin(direction)
        return ArmState(zero, jnp.float32(math.pi / 2), zero, zero, x_m, y_m)

    def advance(self, uniforms: Uniforms, state: ArmState, u: Float[Array, "2"]) -> Transition[ArmState]:
        m11, m12, m22, coupling = self._inertia
        torques = self.torque_n_m * jnp.asarray(u)

        def rates(moving: tuple[Array, ...]) -> tuple[Array, ...]:
            _, q2, w1, w2 = moving
            a11, a12 = m11 + 2 * coupling * jnp.cos(q2), m12 + coupling * jnp.cos(q2)
            turning = coupling * jnp.sin(q2)
            t1 = torques[0] - self.damping_n_m_s * w1 + turning * (2 * w1 + w2) * w2
            t2 = torques[1] - self.damping_n_m_s * w2 - turning * w1**2
            determinant = a11 * m22 - a12**2
            return w1, w2, (m22 * t1 - a12 * t2) / determinant, (a11 * t2 - a12 * t1) / determinant

        moving: tuple[Array, ...] = state[:4]
        for _ in range(SUBSTEPS):
            moving = runge_kutta(rates, moving, self.step_s / SUBSTEPS)
        q1, q2, w1, w2 = moving
        after = ArmState(q1, q2, w1, w2, *state[4:])
        x_m, y_m = self._to_target(after)
        reward = cost_of_distance(jnp.sqrt(x_m**2 + y_m**2), self.target_radius_m).astype(q1.dtype)
        return after, reward, jnp.zeros((), bool)

    def observe(self, state: ArmState) -> Float[Array, " observations"]:
        q1, q2, w1, w2, target_x_m, target_y_m = state
        joints = (jnp.cos(q1), jnp.sin(q1), jnp.cos(q2), jnp.sin(q2))
        return jnp.stack([*joints, w1, w2, target_x_m, target_y_m, *self._to_target(state)])

    def with_goal_of(self, state: ArmState, other: ArmState) -> ArmState:
        """The arm of one state, with the target of the other."""
        return state._replace(target_x_m=other.target_x_m, target_y_m=other.target_y_m)

    def heuristic(self, observation: Any) -> Any:
        """The torques of a spring from tip to target, less a brake: stiffness J(q)^T e / l^2 - brake q'.

        J is the Jacobian of the tip's position, e the vector from tip to target, l the arm's length.
        """
        xp = observation.__array_namespace__()
        cos1, sin1, cos2, sin2, w1, w2, _, _, x_m, y_m = observation
        lower_x_m = self.lower_length_m * (cos1 * cos2 - sin1 * sin2)
        lower_y_m = self.lower_length_m * (sin1 * cos2 + cos1 * sin2)
        tip_x_m, tip_y_m = self.upper_length_m * cos1 + lower_x_m, self.upper_length_m * sin1 + lower_y_m
        stiffness_per_m2 = PULL / (self.upper_length_m + self.lower_length_m) ** 2
        pull = (tip_x_m * y_m - tip_y_m * x_m, lower_x_m * y_m - lower_y_m * x_m)
        commands = [stiffness_per_m2 * torque - BRAKE_S * w for torque, w in zip(pull, (w1, w2), strict=True)]
        return xp.clip(xp.stack(commands), -1.0, 1.0)

    def draw(
        self, observation: np.ndarray, command: np.ndarray, earlier: Sequence[np.ndarray], height_px: int
    ) -> Pixels:
        """The links, the target and the path of the tip, seen from above (see `animat.robots.drawing`)."""
        arm_m = self.upper_length_m + self.lower_length_m
        half_m = 1.1 * arm_m
        canvas = Canvas(height_px, height_px, (height_px / 2, height_px / 2), height_px / 2 / half_m)
        target = (float(observation[6]), float(observation[7]))
        canvas.disc(target, max(self.target_radius_m, 0.02 * arm_m), GOAL)
        canvas.disc(target, 0.8 * max(self.target_radius_m, 0.02 * arm_m), GOAL_FILL)
        tips = [(float(seen[6] - seen[8]), float(seen[7] - seen[9])) for seen in (*earlier, observation)]
        canvas.stroke(tips, 0.012 * arm_m, TRAIL)
        elbow = (self.upper_length_m * float(observation[0]), self.upper_length_m * float(observation[1]))
        canvas.stroke([(0.0, 0.0), elbow, tips[-1]], 0.05 * arm_m, BODY)
        for joint, u in (((0.0, 0.0), command[0]), (elbow, command[1])):
            canvas.disc(joint, (0.03 + 0.02 * abs(float(u))) * arm_m, ACCENT if u else INK)
        return canvas.picture()

    def draw_paths(self, axes: Axes, paths: Sequence[np.ndarray]) -> None:
        """The distance from tip to target over time in each episode."""
        distances_m, radius_m = [np.hypot(path[:, 8], path[:, 9]) for path in paths], self.target_radius_m
        arrived = [bool(distance_m[-1] <= radius_m) for distance_m in distances_m]
        draw_over_time(axes, self, distances_m, arrived, limits=[radius_m], success="end at the target")
        axes.set(ylabel="tip to target (m)", ylim=(0, None))

    def _to_target(self, state: ArmState) -> tuple[Array, Array]:
        both = state.shoulder_rad + state.elbow_rad
        x_m = self.upper_length_m * jnp.cos(state.shoulder_rad) + self.lower_length_m * jnp.cos(both)
        y_m = self.upper_length_m * jnp.sin(state.shoulder_rad) + self.lower_length_m * jnp.sin(both)
        return state.target_x_m - x_m, state.target_y_m - y_m

    @property
    def _target_distances_m(self) -> tuple[float, float]:
        """The smallest and the largest distance of a target from the shoulder."""
        arm_m, hole_m = self.upper_length_m + self.lower_length_m, abs(self.upper_length_m - self.lower_length_m)
        return max(NEAREST * arm_m, hole_m), FARTHEST * arm_m

    @property
    def _inertia(self) -> tuple[float, float, float, float]:
        """M11, M12 and M22 for a right-angled elbow (kg m^2), and the factor of cos q2 in M12, half that in M11."""
        m1, m2, l1, l2 = self.upper_mass_kg, self.lower_mass_kg, self.upper_length_m, self.lower_length_m
        lower = m2 * l2**2 / 3
        return m1 * l1**2 / 3 + m2 * l1**2 + lower, lower, lower, m2 * l1 * l2 / 2

    @property
    def _eigenvalues_kg_m2(self) -> tuple[float, float]:
        """The smallest and the largest eigenvalue of M in any position."""
        # Those of a straight arm, where the trace is largest and the determinant smallest.
        m11, m12, m22, coupling = self._inertia
        trace, determinant = m11 + 2 * coupling + m22, (m11 + 2 * coupling) * m22 - (m12 + coupling) ** 2
        largest = (trace + math.sqrt(max(trace**2 - 4 * determinant, 0.0))) / 2
        return determinant / largest, largest

    @property
    def _fastest_rad_per_s(self) -> float:
        """A bound that no joint velocity exceeds in an episode, for any commands; wide, but true.

        With T the torque of a motor, b the damping and k < K the smallest and largest eigenvalue of M: both motors
        together supply at most sqrt(2) T |q'|, damping takes b |q'|^2, so the energy falls where |q'| > sqrt(2) T / b,
        and is at most K T^2 / b^2. From rest, sqrt(energy) grows by at most T / sqrt(k) per second. Either way
        |q'|^2 <= 2 energy / k. A margin of 5 % allows for finite steps.
        """
        least, largest = self._eigenvalues_kg_m2
        by_time = math.sqrt(2) * self.torque_n_m * self.episode_limit * self.step_s / least
        if not self.damping_n_m_s:
            return 1.05 * by_time + 1e-6
        by_damping = math.sqrt(2 * largest / least) * self.torque_n_m / self.damping_n_m_s
        return 1.05 * min(by_time, by_damping) + 1e-6
