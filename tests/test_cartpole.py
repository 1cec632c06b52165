"""The cartpole, against the equations in plain numpy, against hand-computed cases, and against its energy."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from animat.robots import Cartpole, CartpoleState

QUARTER_SWING = np.array([0.5, 3.0, math.radians(12), 4.0])
NO_NOISE = np.array([0.5])


def euler_step(state, force_n, *, pole_mass_kg):
    """One step by the equations as printed in the method, float64, independent of the code under test."""
    x, v, a, w = state
    g, cart_mass, half_length, dt = 9.8, 0.31, 0.2, 0.02
    total = cart_mass + pole_mass_kg
    tmp = (force_n + pole_mass_kg * half_length * w**2 * math.sin(a)) / total
    a_dd = (g * math.sin(a) - math.cos(a) * tmp) / (half_length * (4 / 3 - pole_mass_kg * math.cos(a) ** 2 / total))
    x_dd = tmp - pole_mass_kg * half_length * a_dd * math.cos(a) / total
    return np.array([x + dt * v, v + dt * x_dd, a + dt * w, w + dt * a_dd])


def solved_step(state, force_n, *, pole_mass_kg):
    """The same accelerations from the coupled equations of motion of cart and rod, solved as a linear system."""
    x, v, a, w = state
    g, cart_mass, half_length, dt = 9.8, 0.31, 0.2, 0.02
    coupling = pole_mass_kg * half_length * math.cos(a)
    inertia = np.array([[cart_mass + pole_mass_kg, coupling], [coupling, pole_mass_kg * half_length**2 * 4 / 3]])
    pull = np.array(
        [force_n + pole_mass_kg * half_length * w**2 * math.sin(a), pole_mass_kg * g * half_length * math.sin(a)]
    )
    x_dd, a_dd = np.linalg.solve(inertia, pull)
    return np.array([x + dt * v, v + dt * x_dd, a + dt * w, w + dt * a_dd])


def run(robot: Cartpole, states, u, uniforms):
    """One step of many, in the float type of `states`: (states after, rewards, terminated) as numpy."""
    step = jax.jit(jax.vmap(robot.advance))
    after, reward, terminated = step(uniforms[:, None], CartpoleState(*jnp.asarray(states).T), u)
    return np.stack([np.asarray(part) for part in after], axis=1), np.asarray(reward), np.asarray(terminated)


@pytest.mark.parametrize("pole_mass_kg", [0.055, 0.55])
@pytest.mark.parametrize("reference", [euler_step, solved_step])
def test_a_thousand_random_steps_agree_with_the_equations(reference, pole_mass_kg: float) -> None:
    rng = np.random.default_rng(1)
    states = rng.uniform(-QUARTER_SWING, QUARTER_SWING, (1000, 4))
    u, uniforms = rng.uniform(-1, 1, 1000), rng.uniform(0, 1, 1000)
    forces_n = u + (2 * uniforms - 1) * 0.02
    expected = np.array([reference(s, f, pole_mass_kg=pole_mass_kg) for s, f in zip(states, forces_n, strict=True)])

    robot = Cartpole(pole_mass_kg=pole_mass_kg)
    with jax.enable_x64(True):
        after, _, _ = run(robot, jnp.asarray(states), jnp.asarray(u), jnp.asarray(uniforms))
    assert after.dtype == np.float64
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-12)

    # In float32, as it is used: numbers up to 5, each rounded to 24 bits a few times.
    after, _, _ = run(robot, *(jnp.asarray(part, jnp.float32) for part in (states, u, uniforms)))
    assert after.dtype == np.float32
    np.testing.assert_allclose(after, expected, rtol=0, atol=3e-6)


def test_long_trajectories_agree_with_the_equations_step_by_step() -> None:
    """Ten whole episodes' length of free play, compared at each iteration, in float64."""
    rng = np.random.default_rng(2)
    u, uniforms = rng.uniform(-1, 1, 1200), rng.uniform(0, 1, (1200, 1))
    robot = Cartpole()
    with jax.enable_x64(True):

        def iterate(state, inputs):
            state, _, _ = robot.advance(inputs[0], state, inputs[1])
            return state, state

        start = CartpoleState(*(jnp.float64(0),) * 4)
        states = np.array(jax.jit(lambda: jax.lax.scan(iterate, start, (jnp.asarray(uniforms), jnp.asarray(u))))()[1]).T
    before = np.vstack([np.zeros(4), states[:-1]])
    for i in range(1200):
        expected = euler_step(before[i], u[i] + (2 * uniforms[i, 0] - 1) * 0.02, pole_mass_kg=0.055)
        np.testing.assert_allclose(states[i], expected, rtol=1e-9, atol=1e-9)


def test_a_push_from_rest_gives_the_numbers_computed_by_hand() -> None:
    """f = 1 N: tmp = 1 / 0.365 = 200/73; a'' = -tmp / (0.2 (4/3 - 11/73)) = -3000/259; x'' = 800/259."""
    after, reward, terminated = run(Cartpole(), np.zeros((1, 4), np.float32), jnp.ones(1), jnp.asarray(NO_NOISE))
    np.testing.assert_allclose(after[0], [0, 0.02 * 800 / 259, 0, -0.02 * 3000 / 259], rtol=1e-6)
    assert reward[0] == 1 and not terminated[0]


def test_positions_move_with_the_velocities_from_before() -> None:
    state = np.array([[0.1, 0.5, 0.05, -1.0]], np.float32)
    after, _, _ = run(Cartpole(), state, jnp.ones(1), jnp.asarray(NO_NOISE))
    np.testing.assert_allclose(after[0, [0, 2]], [0.1 + 0.02 * 0.5, 0.05 - 0.02 * 1.0], rtol=1e-6)


def test_left_and_right_are_mirror_images() -> None:
    rng = np.random.default_rng(3)
    states = rng.uniform(-QUARTER_SWING, QUARTER_SWING, (100, 4)).astype(np.float32)
    u, uniforms = (jnp.asarray(rng.uniform(0, 1, 100), jnp.float32) for _ in range(2))
    right, reward, terminated = run(Cartpole(), states, u, uniforms)
    left, reward_left, terminated_left = run(Cartpole(), -states, -u, 1 - uniforms)
    np.testing.assert_allclose(left, -right, atol=1e-6)
    np.testing.assert_array_equal(reward, reward_left)
    np.testing.assert_array_equal(terminated, terminated_left)


def test_without_a_force_the_energy_is_kept_as_the_step_goes_to_zero() -> None:
    """Closed form: T + V of cart and rod is constant; Euler's error falls with the step."""

    def energy(state) -> np.ndarray:
        _, v, a, w = np.asarray(state, np.float64).T
        m, half_length, total = 0.055, 0.2, 0.365
        kinetic = total * v**2 / 2 + m * half_length * v * w * np.cos(a) + m * half_length**2 * w**2 * 4 / 3 / 2
        return kinetic + m * 9.8 * half_length * np.cos(a)

    drifts = []
    for step_s in (1e-3, 1e-4):
        robot = Cartpole(step_s=step_s, force_noise=0.0)
        with jax.enable_x64(True):
            start = CartpoleState(*(jnp.float64(value) for value in (0.0, 0.1, 0.3, 0.0)))

            def iterate(state, _, robot=robot):
                state, _, _ = robot.advance(jnp.full(1, 0.5), state, jnp.float64(0))
                return state, None

            end, _ = jax.lax.scan(iterate, start, None, length=round(1.0 / step_s))
        drifts.append(abs(energy(np.array(end)) - energy(np.array(start))))
    assert drifts[1] < drifts[0] / 8
    assert drifts[1] < 2e-3 * energy(np.array(start))


def test_the_noise_is_uniform_and_at_most_two_hundredths_of_the_force() -> None:
    n = 20_000
    uniforms = jax.random.uniform(jax.random.key(0), (n,))
    after, _, _ = run(Cartpole(), np.zeros((n, 4), np.float32), jnp.zeros(n), uniforms)
    per_newton = run(Cartpole(force_noise=0.0), np.zeros((1, 4), np.float32), jnp.ones(1), uniforms[:1])[0][0, 1]
    noise = after[:, 1] / per_newton
    assert np.abs(noise).max() <= 0.02 * (1 + 1e-5)
    assert abs(noise.mean()) < 5 * 0.02 / math.sqrt(3 * n)
    assert noise.std() == pytest.approx(0.02 / math.sqrt(3), rel=0.02)


@pytest.mark.parametrize(
    ("position_m", "angle_rad", "fails"),
    [
        (0.0, 0.0, False),
        (0.5, 0.0, False),  # on the end of the track: not yet off it
        (0.5001, 0.0, True),
        (-0.5, 0.0, False),
        (-0.5001, 0.0, True),
        (0.0, math.radians(11.99), False),
        (0.0, math.radians(12.01), True),
        (0.0, math.radians(-11.99), False),
        (0.0, math.radians(-12.01), True),
        (0.6, 1.0, True),
    ],
)
def test_it_fails_beyond_the_track_and_beyond_twelve_degrees(position_m, angle_rad, fails) -> None:
    """At rest positions do not move in the iteration, so the state before is the state judged."""
    state = np.array([[position_m, 0, angle_rad, 0]], np.float32)
    _, reward, terminated = run(Cartpole(), state, jnp.zeros(1), jnp.asarray(NO_NOISE))
    assert bool(terminated[0]) is fails
    assert reward[0] == (-100.0 if fails else 1.0)


def test_the_printed_variants_are_selectable_and_say_what_they_mean() -> None:
    printed = Cartpole.as_printed()
    assert (printed.pole_mass_kg, printed.angle_limit_rad) == (0.55, 12.0)
    tilted = np.array([[0, 0, 3.0, 0]], np.float32)
    assert not run(printed, tilted, jnp.zeros(1), jnp.asarray(NO_NOISE))[2][0]
    assert run(Cartpole(), tilted, jnp.zeros(1), jnp.asarray(NO_NOISE))[2][0]
    assert Cartpole().caveats() == ()
    (message,) = printed.caveats()
    assert "angle_limit_rad = 12" in message and "not to balance" in message


def test_a_pole_left_alone_falls_and_a_simple_rule_keeps_it_up() -> None:
    """A heuristic policy lasts for all 120 iterations, so the optimal return of 120 can be achieved."""
    robot = Cartpole()

    def episode(key, rule):
        def iterate(carry, key):
            state, alive, total = carry
            state, reward, terminated = robot.step(key, state, rule(state))
            return (state, alive & ~terminated, total + alive * reward), None

        keys = jax.random.split(key, robot.episode_limit)
        (_, alive, total), _ = jax.lax.scan(iterate, (robot.reset(key), jnp.bool_(True), jnp.float32(0)), keys)
        return alive, total

    def balance(state):
        push = 30 * state.angle_rad + 4 * state.angular_velocity_rad_per_s
        return jnp.clip(push + state.position_m + 2 * state.velocity_m_per_s, -1.0, 1.0)

    keys = jax.random.split(jax.random.key(0), 50)
    alive, total = jax.vmap(lambda key: episode(key, balance))(keys)
    assert alive.all() and np.all(total == 120)
    alive, total = jax.vmap(lambda key: episode(key, lambda state: jnp.float32(1)))(keys)
    assert not alive.any() and np.all(total < -80)


def test_an_episode_that_fails_in_its_last_iteration_is_not_drawn_as_one_to_the_end() -> None:
    robot = Cartpole()
    stays, falls, leaves = np.zeros((3, robot.episode_limit + 1, 4))
    falls[-1, 2], leaves[-1, 0] = 1.01 * robot.angle_limit_rad, 0.51
    axes = Figure().subplots()
    robot.draw_paths(axes, [stays, falls, leaves, stays[:50]])
    assert axes.get_xlabel() == "time (s); 1 of 4 to the end"
