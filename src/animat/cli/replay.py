"""The command that films a session, or policies on the simulator."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from animat.cli.command import SimulatorOptions, policies_for
from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.plain_file import is_absent

_OF_SESSIONS = ("source", "span_s", "robot", "out", "json")


@dataclass(frozen=True)
class Replay(SimulatorOptions):
    """Film a closed-loop session, or policies on the simulator, in real time: robot, spikes, command and return."""

    source: Positional[Path] = Path("session")
    """A session's folder, even if it was killed; or a policy file or a folder of them"""
    recordings: tuple[Path, ...] = ()
    """For policies: files or folders of recordings of one culture, whose simulator responds"""
    at_min: float | None = None
    """For policies: use the newest recording made by this minute; default: the last recording"""
    span_s: tuple[float, float] | None = None
    """What to show, in s from the start; default: a minute, for a session from just before the first move"""
    robot: str | None = None
    """The expected robot, with its import path: my_package.robots:Rover"""
    mapping: str | None = None
    """For policies: the expected mapping, with its import path: my_package.mappings:Steep"""
    seed: int = 1
    """For policies: decides every random draw"""
    out: Path = Path("film.gif")
    """The film: .gif, or .mp4, which needs animat[film]"""

    def run(self) -> dict[str, Any]:
        from animat.closed_loop.session import lost_message
        from animat.progress import Bar
        from animat.report.film.session import is_session, scene_of_session
        from animat.report.film.simulated import scene_of_policies
        from animat.report.film.writing import check_film, write_film
        from animat.robots.registry import REGISTRY

        check_film(self.out)
        if self.span_s is not None and not 0 <= self.span_s[0] < self.span_s[1] < float("inf"):
            raise InvalidArgument(
                f"--span-s: expected a start from 0 s and a later end, got {self.span_s[0]:g} {self.span_s[1]:g}"
            )
        expected = None if self.robot is None else REGISTRY.name_of(self.robot)
        if is_absent(self.source):
            raise InvalidFile(f"{self.source}: expected a session, a policy or a folder of policies, got no such file")
        if is_session(self.source):
            for option in fields(self):
                if option.name not in _OF_SESSIONS and getattr(self, option.name) != option.default:
                    raise InvalidArgument(f"{option.name}: expected none with a session, which is shown as it was")
            scene = scene_of_session(self.source, self.span_s)
            if expected not in (None, scene.robot.name):
                raise Mismatch(
                    f"{self.source}: expected a session of {expected}, got one of {scene.robot.name}; give another, or "
                    "no --robot"
                )
        else:
            if self.source.is_dir() and not any(self.source.glob("*.safetensors")):
                raise InvalidArgument(
                    f"{self.source}: expected a session (session.log) or policies in this folder, got neither"
                )
            policies = policies_for(self.robot, self.mapping, self.source)
            timeline = self.timeline_for(policies, self.recordings)
            scene = scene_of_policies(policies, timeline, at_min=self.at_min, span_s=self.span_s, seed=self.seed)
        with Bar("drawing") as progress:
            write_film(scene, self.out, progress)
        print(f"{self.out}: {scene.title}, {scene.start_s:.1f} to {scene.stop_s:.1f} s")
        if scene.lost_bytes:
            print(lost_message(scene.lost_bytes))
        return {
            "film": str(self.out),
            "span_s": [scene.start_s, scene.stop_s],
            "robot": scene.robot.name,
            "lost_bytes": scene.lost_bytes,
        }
