"""Pictures of robots: the places of their parts, by the colours of the drawing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from animat.errors import InvalidArgument
from animat.robots import Cartpole, Navigation
from animat.robots.drawing import ACCENT, BODY, GOAL_FILL, INK, PAPER, TRAIL, Canvas, draw_robot


def places(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """(x, y) of the pixels of exactly this colour."""
    return np.argwhere(np.all(picture == colour, axis=-1))[:, ::-1]


def test_the_pole_leans_to_the_side_of_its_angle_and_the_cart_stands_at_its_place() -> None:
    for x_m, angle in [(0.3, 0.2), (-0.3, -0.2)]:
        picture = draw_robot(Cartpole(), np.array([x_m, 0, angle, 0]), command=math.copysign(1, x_m))
        height, width, _ = picture.shape
        pole, cart, arrow = places(picture, BODY), places(picture, INK), places(picture, ACCENT)
        top, foot = pole[pole[:, 1].argmin()], pole[pole[:, 1].argmax()]
        assert (top[0] - foot[0]) * angle > 0
        slope = (top[0] - foot[0]) / (foot[1] - top[1])
        assert slope == pytest.approx(math.tan(angle), abs=0.05)
        assert (foot[0] - width / 2) * x_m > 0
        assert (arrow[:, 0].mean() - foot[0]) * x_m > 0
        assert len(cart) and len(pole) and height == 360


def test_a_resting_cart_has_no_arrow() -> None:
    assert not len(places(draw_robot(Cartpole(), np.zeros(4)), ACCENT))


def test_the_robot_the_goal_and_the_path_are_where_they_should_be() -> None:
    robot = Navigation()
    earlier = [np.array([0.1 * i, 0.4, 0.0]) for i in range(5)]
    picture = draw_robot(robot, np.array([0.5, 0.4, math.pi / 2]), earlier=earlier)
    px_per_m = 360 / 1.12
    origin = 0.06 * px_per_m

    def place_m(colour: tuple[int, int, int]) -> np.ndarray:
        return (places(picture, colour).mean(axis=0) + 0.5 - origin) / px_per_m

    np.testing.assert_allclose(place_m(BODY), [0.5, 0.4], atol=0.005)
    np.testing.assert_allclose(place_m(GOAL_FILL), [0.7, 0.7], atol=0.005)
    np.testing.assert_allclose(place_m(TRAIL)[1], 0.4, atol=0.005)
    # Heading pi/2 looks down: the nose is below the body.
    assert place_m(ACCENT)[1] > 0.41


def test_a_disc_covers_its_area_with_soft_edges() -> None:
    canvas = Canvas(100, 100, (50.0, 50.0), 10.0)
    canvas.disc((0.0, 0.0), 2.0, (0, 0, 0))
    cover = 1 - canvas.picture()[..., 0] / PAPER[0]
    assert cover.sum() == pytest.approx(math.pi * 20**2, rel=0.005)


def test_what_is_too_small_to_be_seen_is_left_out_without_harm() -> None:
    canvas = Canvas(20, 20, (10.0, 10.0), 1.0)
    for radius in (0.1, 0.0, -1.0):
        canvas.disc((0.0, 0.0), radius, INK)
    canvas.box((1.0, 1.0), (-1.0, 2.0), 0.1, INK)
    assert np.all(canvas.picture() == PAPER)
    # The goal's edge is wider than the goal.
    assert draw_robot(Navigation(arena_width_m=20, arena_height_m=20), np.zeros(3), height_px=30).shape == (30, 30, 3)


@pytest.mark.parametrize(
    "robot", [Cartpole(track_length_m=50), Cartpole(pole_length_m=0.01), Navigation(arena_width_m=50)]
)
def test_a_long_track_is_shown_whole_in_a_picture_of_limited_size(robot: Cartpole | Navigation) -> None:
    """A thousand times as long, it would take gigabytes."""
    x_m = robot.observation_spec[0].scale
    picture = draw_robot(robot, np.array([x_m, 0, 0, 0][: len(robot.observation_spec)]), height_px=120)
    assert picture.shape == (120, 480, 3)
    rows, columns = np.nonzero((picture != PAPER).any(axis=2))
    np.testing.assert_allclose([rows.min() + rows.max(), columns.min() + columns.max()], [119, 479], atol=6)
    assert columns.min() < 30


def test_what_lies_outside_the_picture_is_left_out_without_harm() -> None:
    canvas = Canvas(20, 20, (0.0, 0.0), 1.0)
    canvas.stroke([(-50.0, -50.0), (-30.0, -20.0)], 2.0, INK)
    canvas.stroke([(-50.0, 10.0), (70.0, 10.0)], 2.0, INK)
    assert places(canvas.picture(), INK)[:, 1].tolist() == [9] * 20 + [10] * 20


def test_a_robot_without_a_drawing_is_refused() -> None:
    @dataclass(frozen=True)
    class Unicycle:
        name = "unicycle"
        n_commands = 1

    class Crashing(Unicycle):
        def draw(self, observation: np.ndarray, *_: object) -> None:
            raise ValueError(f"no wheel\nin {observation}")

    with pytest.raises(InvalidArgument, match="unicycle has no method `draw`"):
        draw_robot(Unicycle(), np.zeros(3))  # type: ignore[arg-type]
    with pytest.raises(
        InvalidArgument,
        match=r"^unicycle\.draw: expected a picture, got ValueError: no wheel "
        rf"\(test_frames\.py, line {Crashing.draw.__code__.co_firstlineno + 1}\)$",
    ):
        draw_robot(Crashing(), np.zeros(3))  # type: ignore[arg-type]
