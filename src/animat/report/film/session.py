"""The scene of a closed-loop session, from its log; a killed session is shown as far as it got."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from animat.closed_loop.header import read_header
from animat.closed_loop.outline import Episode, Outline
from animat.closed_loop.session import LOG_FILE, expect_session_log, read_session
from animat.closed_loop.tick import Tick
from animat.errors import InvalidArgument, UnusableData
from animat.goals.robot import robot_of
from animat.report.film.scene import Moment, Scene
from animat.stimulation.stimulus import NOTHING

USUAL_S = 60.0
"""The length of a film by default."""
LOOK_BACK_S = 5.0
"""Time before a span whose spikes and pulses are in its first frames."""


def is_session(path: Path) -> bool:
    """Whether a path is a session's folder or its log."""
    return path.name == LOG_FILE or (path / LOG_FILE).exists()


def scene_of_session(path: str | os.PathLike[str], span_s: tuple[float, float] | None = None) -> Scene:
    """The scene of a span of a session, from its log; by default a minute from just before the robot first moves.

    Raises InvalidFile if there is no session, or its log cannot be read; InvalidArgument for a span in which nothing
    happened, or an unknown robot; and UnusableData for a session without episodes.
    """
    session = read_session(path)
    file, fields = session.folder / LOG_FILE, session.log.header
    header = read_header(file, fields)
    from_s, to_s = span_s or (0.0, USUAL_S)
    is_found = span_s is not None
    with expect_session_log(file):
        seed, window_s = int(fields["seed"]), float(fields["loop"]["window_ms"][1]) * 1e-3
        reading = _Reading(header.conditions, window_s)
        for record in session.log:
            is_past = is_found and record.fields["kind"] == "seen" and record.fields.get("start_s", 0.0) >= to_s
            # In a pause before the first trial nothing moves yet; the robot's state is known from that trial.
            if is_past and reading.moments:
                break
            reading.add(record.fields)
            if not is_found and reading.moments:
                # The start of the film is postponed until the robot moves.
                is_found = reading.moments[-1].iteration >= 0
                from_s = max(0.0, reading.moments[-1].time_s - LOOK_BACK_S)
                to_s = from_s + USUAL_S
            if not is_past and reading.stop_s > from_s - LOOK_BACK_S and len(record.spike_times_s):
                reading.spikes.append((record.spike_times_s, record.spike_channels))
    moments = reading.moments
    if not moments:
        raise UnusableData(f"{file}: expected at least one episode, got none: {session.ending.message}")
    if not from_s < min(reading.stop_s, to_s):
        raise InvalidArgument(
            f"span_s: expected a stretch that begins within the session's {reading.stop_s:.1f} s, got {from_s:g} to "
            f"{to_s:g}"
        )
    first = max((each.episode for each in moments if each.time_s <= from_s), default=moments[0].episode)
    times_s, channels = (np.concatenate(each) for each in zip(*reading.spikes, strict=True))
    order = np.argsort(times_s, kind="stable")
    robot = robot_of({"robot": None} | fields["loop"])
    return Scene(
        title=f"{robot.name} on the {fields.get('culture', '')} culture",
        robot=robot,
        conditions=header.conditions,
        moments=tuple(each for each in moments if each.episode >= first),
        start_s=from_s,
        stop_s=min(reading.stop_s, to_s),
        spike_times_s=times_s[order],
        spike_channels=channels[order],
        pulse_times_s=np.array(reading.pulses_s, np.float64),
        n_channels=len(header.channels),
        lost_bytes=session.log.lost_bytes,
        seed=seed,
    )


class _Reading:
    """What a film needs of a session's records."""

    def __init__(self, conditions: tuple[str, ...], window_s: float) -> None:
        self.moments: list[Moment] = []
        # The empty arrays are for a session without spikes.
        self.spikes: list[tuple[np.ndarray, np.ndarray]] = [(np.empty(0), np.empty(0, np.int64))]
        self.pulses_s: list[float] = []
        self.stop_s = 0.0
        self._conditions, self._window_s, self._turns = conditions, window_s, Counter[str]()
        self._outline = Outline()

    def add(self, fields: dict[str, Any]) -> None:
        episode = self._outline.add(fields)
        if fields["kind"] == "seen" and fields.get("start_s") is not None:
            self.stop_s = max(self.stop_s, fields["start_s"] + fields["duration_s"])
        if episode is not None:
            self._add_tick(Tick.from_dict(fields["tick"]), episode)

    def _add_tick(self, tick: Tick, episode: Episode) -> None:
        if NOTHING not in tick.patterns:
            self.pulses_s += tick.pulse_time_s
        if not self.moments or self.moments[-1].episode != tick.episode:
            # If a session ends before the robot moves, only its start is known.
            turn = self._turns[tick.agent]
            self.moments.append(Moment(tick.read_after_s, tick.agent, tick.episode, -1, turn, episode.start))
            self._turns[tick.agent] += 1
        before = self.moments[-1]
        moment = replace(
            before,
            time_s=tick.read_after_s + self._window_s,
            iteration=tick.iteration,
            observation=tick.observation or before.observation,
            command=tick.command,
            total=episode.total,
            delivered=self._conditions[tick.delivered] if tick.pulse_time_s else "",
            rate_hz=tick.rate_hz,
        )
        self.moments.append(moment)
