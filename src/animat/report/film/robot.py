"""The robot of a scene as pictures: drawn from what it observed, or, where the bodies of others move, moved again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from animat.closed_loop.runner import HostRunner
from animat.report.film.scene import Scene
from animat.robots.drawing import Picture, draw_robot
from animat.robots.host import HostRobot

MOST_EARLIER = 500
"""Observations of which a trail is drawn."""


def pictures_of(scene: Scene) -> Callable[[int], Picture | None]:
    """The robot at each moment, by its number, asked for in their order; None where there is no picture of it."""
    if isinstance(scene.robot, HostRobot):
        return _MovedAgain(scene).picture
    if not hasattr(scene.robot, "draw"):
        return lambda number: None
    kept: dict[int, Picture | None] = {}

    def picture(number: int) -> Picture | None:
        if number not in kept:
            kept.clear()
            kept[number] = _drawn(scene, number)
        return kept[number]

    return picture


def _drawn(scene: Scene, number: int) -> Picture | None:
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


class _MovedAgain:
    """A body of somebody else, moved by the same commands; None from where it does not do what it did."""

    def __init__(self, scene: Scene) -> None:
        assert isinstance(scene.robot, HostRobot)
        self._scene, self._next = scene, 0
        self._runner = HostRunner(scene.robot, np.random.default_rng(scene.runner_seed), with_pictures=True)
        self._episode: int | None = None
        self._is_same = True
        self._shown: Picture | None = None

    def picture(self, number: int) -> Picture | None:
        if self._next > number:
            return self._shown
        while self._next <= number:
            self._go_on(self._next)
            self._next += 1
        self._shown = self._runner.picture() if self._is_same else None
        return self._shown

    def _go_on(self, number: int) -> None:
        moment = self._scene.moments[number]
        if moment.episode != self._episode:
            self._episode, self._is_same = moment.episode, True
            seen = self._runner.reset(moment.turn)
        elif moment.command is None or not self._is_same:
            return
        else:
            seen = self._runner.step(moment.command).observation
        self._is_same = not moment.observation or np.array_equal(seen, moment.observation)
