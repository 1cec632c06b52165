"""Frames of a film: the robot on the left; raster, response, command and return of the last seconds on the right."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import cache, lru_cache, partial

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from animat.closed_loop.runner import HostRunner
from animat.report.colours import BLUE, ORANGE, RED, condition_colours
from animat.report.film.scene import Moment, Scene
from animat.robots.drawing import Pixels, draw_robot
from animat.robots.host import HostRobot
from animat.robots.starts import robot_generator

WIDTH_PX, HEIGHT_PX = 880, 440
"""Even, as video encoders require."""
SHOWN_S = 4.0
"""The time span of the strips."""
ROBOT_PX = 360
_PAPER, _INK, _FAINT, _LINE = "#fafaf8", "#343a40", "#868e96", "#dee2e6"
_LEFT, _RIGHT = 478, WIDTH_PX - 14
MOST_EARLIER = 500
"""Observations from which a robot's trail is drawn."""
COMMANDS = (ORANGE, BLUE, RED)
"""Colours of the commands, in their order."""


class Frames:
    """Draws a scene at any time; `picture` gives the robot at a moment, None if it cannot be drawn."""

    def __init__(self, scene: Scene, picture: Callable[[int], Pixels | None]) -> None:
        self._scene, self._picture = scene, picture
        self._times_s = np.array([moment.time_s for moment in scene.moments])
        self._colours = dict(zip(scene.conditions, condition_colours(["Hz"] * len(scene.conditions)), strict=True))
        rates = np.array([moment.rate_hz for moment in scene.moments if math.isfinite(moment.rate_hz)])
        # Bursts would squeeze all other responses, so they are triangles at the upper edge.
        self._most_hz = _round_up(max(1.0, float(np.percentile(rates, 95)))) if len(rates) else None
        self._is_some_beyond = bool(len(rates)) and float(rates.max()) > (self._most_hz or 0.0)
        self._has_room_for_all = sum(_font(14).getlength(label) + 14 for label in scene.conditions) < _LEFT - 28
        totals = np.array([moment.total for moment in scene.moments])
        self._totals = min(0.0, float(totals.min())), max(1.0, float(totals.max()))

    @property
    def colours(self) -> tuple[str, ...]:
        """All colours of the frames, except those of robots."""
        return (*self._colours.values(), *COMMANDS, _PAPER, _INK, _FAINT, _LINE, "#ffffff")

    def at(self, time_s: float) -> Image.Image:
        scene = self._scene
        n_begun = int(np.searchsorted(self._times_s, time_s, "right"))
        # Before the first moment its robot is shown, but nothing of it has happened yet.
        now = max(0, n_begun - 1)
        moment = scene.moments[now]
        image = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), _PAPER)
        draw = ImageDraw.Draw(image)
        draw.text((14, 12), _shortened(scene.title, 17), _INK, _font(17))
        self._draw_robot(image, draw, now)
        self._draw_captions(draw, moment)
        first = int(np.searchsorted(self._times_s, time_s - SHOWN_S))
        past = scene.moments[max(0, first - 1) : n_begun]
        top = 18
        if scene.n_channels:
            spikes = _Strip(draw, (top, 150), time_s, (-1, scene.n_channels), "spikes by channel", has_scale=False)
            spikes.raster(scene)
            top = 178
        # Without neurons there is no response.
        n_strips = 3 if self._most_hz else 2
        height = (HEIGHT_PX - 26 - top) // n_strips
        strips = [(top + i * height, top + (i + 1) * height - 26) for i in range(n_strips)]
        if self._most_hz:
            beyond = "; triangles: larger" if self._is_some_beyond else ""
            response = _Strip(draw, strips[0], time_s, (0.0, self._most_hz), f"response (Hz per channel{beyond})")
            for each in past:
                if math.isfinite(each.rate_hz):
                    response.dot(each.time_s, each.rate_hz, self._colours.get(each.delivered, _INK))
        command = _Strip(draw, strips[-2], time_s, (-1.0, 1.0), "command", zero=True)
        for i in range(scene.robot.n_commands if scene.robot.n_commands > 1 else 0):
            at = (_LEFT + 64 + 14 * i, strips[-2][0] - 3)
            draw.text(at, f"{i + 1}", COMMANDS[i % len(COMMANDS)], _font(12), anchor="ls")
        total = _Strip(draw, strips[-1], time_s, self._totals, "return so far")
        for episode in dict.fromkeys(each.episode for each in past):
            of_it = [each for each in past if each.episode == episode]
            until_s = time_s if episode == moment.episode else of_it[-1].time_s
            total.steps([(each.time_s, each.total) for each in of_it], until_s, BLUE)
            for i in range(scene.robot.n_commands):
                known = [(each.time_s, np.atleast_1d(each.command)[i]) for each in of_it if each.command is not None]
                command.steps(known, until_s, COMMANDS[i % len(COMMANDS)])
        draw.text((_RIGHT, HEIGHT_PX - 8), f"{time_s:.1f} s", _INK, _font(13), anchor="rs")
        draw.text((_LEFT, HEIGHT_PX - 8), f"-{SHOWN_S:g} s", _FAINT, _font(11), anchor="ls")
        return image

    def _draw_robot(self, image: Image.Image, draw: ImageDraw.ImageDraw, now: int) -> None:
        box_px = (400, ROBOT_PX - 30)
        picture = self._picture(now)
        if picture is None:
            draw.text((14 + box_px[0] // 2, 190), "no picture of this robot", _FAINT, _font(14), anchor="mm")
            return
        robot = Image.fromarray(picture)
        robot.thumbnail(box_px, Image.Resampling.BOX)
        image.paste(robot, (14 + (box_px[0] - robot.width) // 2, 40 + (box_px[1] - robot.height) // 2))

    def _draw_captions(self, draw: ImageDraw.ImageDraw, moment: Moment) -> None:
        # Iterations are counted as in ticks.csv.
        step = "warm-up" if moment.iteration < 0 else f"iteration {moment.iteration:,} (counted from 0)"
        draw.text((14, HEIGHT_PX - 48), f"{moment.agent}, episode {moment.episode}, {step}", _INK, _font(15))
        if not self._has_room_for_all:
            if moment.delivered:
                stimulus = _shortened(f"stimulus: {moment.delivered}", 13)
                draw.text((14, HEIGHT_PX - 8), stimulus, _INK, _font(13), anchor="ls")
            return
        x = 14
        for label, colour in self._colours.items():
            is_now = label == moment.delivered
            font = _font(14 if is_now else 12)
            draw.text((x, HEIGHT_PX - 8), label, colour if is_now else _FAINT, font, anchor="ls")
            x += int(font.getlength(label)) + 14


class _Strip:
    """A panel over the last seconds, the newest at the right."""

    def __init__(
        self,
        draw: ImageDraw.ImageDraw,
        rows_px: tuple[int, int],
        now_s: float,
        span: tuple[float, float],
        name: str,
        *,
        has_scale: bool = True,
        zero: bool = False,
    ) -> None:
        self._draw, (self._top, self._bottom), self._now_s, self._span = draw, rows_px, now_s, span
        draw.rectangle((_LEFT, self._top, _RIGHT, self._bottom), "#ffffff", _LINE)
        draw.text((_LEFT, self._top - 3), name, _INK, _font(12), anchor="ls")
        if has_scale:
            for value, row in ((span[1], self._top + 5), (span[0], self._bottom - 4)):
                draw.text((_LEFT - 5, row), f"{value:,.4g}", _FAINT, _font(11), anchor="rm")
        if zero:
            self._draw.line((_LEFT, self._y(0.0), _RIGHT, self._y(0.0)), _LINE)

    def dot(self, time_s: float, value: float, colour: str) -> None:
        """Draw a dot, or for a value above the upper edge a triangle at that edge."""
        if time_s < self._now_s - SHOWN_S:
            return
        x, y = self._x(time_s), self._y(value)
        if value > self._span[1]:
            self._draw.polygon([(x - 4, y + 6), (x, y - 1), (x + 4, y + 6)], colour)
        else:
            self._draw.circle((x, y), 3, colour)

    def steps(self, known: Sequence[tuple[float, float]], until_s: float, colour: str) -> None:
        """Draw values that each hold until the next one."""
        if not known:
            return
        points = []
        for (time_s, value), (end_s, _) in zip(known, [*known[1:], (until_s, 0.0)], strict=True):
            points += [(self._x(time_s), self._y(value)), (self._x(end_s), self._y(value))]
        self._draw.line(points, colour, 2)

    def raster(self, scene: Scene) -> None:
        """Draw a point for each spike, and a tick at the upper edge for each pulse."""
        from_s, (low, high) = self._now_s - SHOWN_S, self._span
        pulses_s = scene.pulse_times_s
        for at in map(self._x, pulses_s[(pulses_s > from_s) & (pulses_s <= self._now_s)].tolist()):
            self._draw.line((at, self._top + 1, at, self._top + 5), RED, 2)
        shown = slice(*np.searchsorted(scene.spike_times_s, (from_s, self._now_s)))
        times_s, rows = scene.spike_times_s[shown], scene.spike_channels[shown]
        x = np.rint(_RIGHT - (self._now_s - times_s) * (_RIGHT - _LEFT) / SHOWN_S)
        y = np.rint(self._top + 7 + (high - rows) * (self._bottom - self._top - 8) / (high - low))
        self._draw.point(np.stack([x, y], axis=1).reshape(-1).tolist(), _INK)

    def _x(self, time_s: float) -> float:
        return max(_LEFT, _RIGHT - (self._now_s - time_s) * (_RIGHT - _LEFT) / SHOWN_S)

    def _y(self, value: float) -> float:
        low, high = self._span
        value = min(max(value, low), high)
        return self._bottom - 2 - (value - low) * (self._bottom - self._top - 4) / (high - low)


def _round_up(value: float) -> float:
    """Round up to one digit."""
    unit = 10.0 ** math.floor(math.log10(max(value, 1e-9)))
    return math.ceil(value / unit) * unit


@cache
def _shortened(text: str, size: int) -> str:
    """The text, or as much of it as there is room for left of the strips, with an ellipsis."""
    font, most_px = _font(size), _LEFT - 28
    if font.getlength(text) <= most_px:
        return text
    # The label of a large set of electrodes has thousands of characters.
    first_too_long = bisect_left(range(len(text)), True, key=lambda n: font.getlength(f"{text[:n]}…") > most_px)
    return f"{text[: first_too_long - 1]}…"


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def pictures_of(scene: Scene) -> Callable[[int], Pixels | None]:
    """A function that draws the robot at each moment, called with rising numbers; it returns None without a picture."""
    if not isinstance(scene.robot, HostRobot) and not hasattr(scene.robot, "draw"):
        return lambda number: None
    # Several frames in a row show the same moment.
    return lru_cache(1)(_Replay(scene).picture if isinstance(scene.robot, HostRobot) else partial(_draw, scene))


def _draw(scene: Scene, number: int) -> Pixels | None:
    now = scene.moments[number]
    if not now.observation:
        return None
    before = [m for m in scene.moments[max(0, number - MOST_EARLIER) : number] if m.episode == now.episode]
    command = 0.0 if now.command is None else np.array(now.command)[()]
    earlier = [np.array(m.observation) for m in before if m.observation]
    return draw_robot(scene.robot, np.array(now.observation), command=command, earlier=earlier)


class _Replay:
    """A host robot moved by the same commands again; without a picture from where its observations differ."""

    def __init__(self, scene: Scene) -> None:
        self._moments, self._done = scene.moments, 0
        self._runner = HostRunner(scene.robot, robot_generator(scene.seed), with_pictures=True)
        self._episode: int | None = None
        self._is_same = True

    def picture(self, number: int) -> Pixels | None:
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
