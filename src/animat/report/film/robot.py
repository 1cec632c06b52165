"""Pictures of a scene's robot: drawn from its observations, or, for host robots, by replaying its commands."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np

from animat.closed_loop.runner import HostRunner
from animat.report.film.scene import Moment, Scene
from animat.robots.drawing import Picture, draw_robot
from animat.robots.host import HostRobot

MOST_EARLIER = 500
"""Observations from which a trail is drawn."""


def pictures_of(scene: Scene) -> Callable[[int], Picture | None]:
    """A function that draws the robot at each moment, called with rising numbers; it returns None without a picture."""
    if not isinstance(scene.robot, HostRobot) and not hasattr(scene.robot, "draw"):
        return lambda number: None
    # Several frames in a row show the same moment.
    return lru_cache(1)(_Replay(scene).picture if isinstance(scene.robot, HostRobot) else partial(_draw, scene))


def _draw(scene: Scene, number: int) -> Picture | None:
    now = scene.moments[number]
    if not now.observation:
        return None
    before = [m for m in scene.moments[max(0, number - MOST_EARLIER) : number] if m.episode == now.episode]
    return draw_robot(
        scene.robot,
        np.array(now.observation),
        command=0.0 if now.command is None else np.array(now.command)[()],
        earlier=[np.array(m.observation) for m in before if m.observation],
    )


class _Replay:
    """A host robot moved by the same commands again; without a picture from where its observations differ."""

    def __init__(self, scene: Scene) -> None:
        self._moments, self._done = scene.moments, 0
        self._runner = HostRunner(scene.robot, np.random.default_rng(scene.runner_seed), with_pictures=True)
        self._episode: int | None = None
        self._is_same = True

    def picture(self, number: int) -> Picture | None:
        for moment in self._moments[self._done : number + 1]:
            self._move(moment)
        self._done = number + 1
        return self._runner.picture() if self._is_same else None

    def _move(self, moment: Moment) -> None:
        if moment.episode != self._episode:
            self._episode = moment.episode
            observation = self._runner.reset(moment.turn)
        elif moment.command is None or not self._is_same:
            return
        else:
            observation = self._runner.step(moment.command).observation
        self._is_same = not moment.observation or np.array_equal(observation, moment.observation)
