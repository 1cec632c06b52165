"""The command that records, trains and runs on one culture."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from animat.cli.command import StimulationOptions, expect_no_fault, read_sac, robot_for
from animat.errors import InvalidArgument, counted
from animat.writing import exclusive_lock

if TYPE_CHECKING:
    from animat.live.shadowing import LiveRun
    from animat.stimulation.protocol import Protocol
    from animat.training.specification import Training


@dataclass(frozen=True)
class Live(StimulationOptions):
    """Parameter shadowing on one culture as it changes: record, train, refresh, then run in closed loop."""

    robot: Positional[str] = "cartpole"
    """The robot to drive: cartpole, navigation, swing-up, shuttle, or your own, such as my_package.robots:Rover"""
    mapping: str = "9-thresholds"
    """From responses to motor commands: 1-threshold, 9-thresholds, linear, or your own, such as
    my_package.mappings:Steep"""
    goal: str | None = None
    """A goal that replaces the robot's own task, as --goal of animat train"""
    policies: int = 4
    """Number of policies, each with its own random numbers"""
    order: Literal["mixed", "blocked"] | None = None
    """Order of the trials in recordings; a closed loop presents mixed trials; default: mixed"""
    pulses: int | None = None
    """Pulses per trial; the response to the last one is read; default: 1"""
    trials: int | None = None
    """Trials of each frequency in a recording; default: 500"""
    protocol: Path | None = None
    """A JSON file in place of --order, --pulses and --trials, as for animat record, such as
    {"frequencies_hz": [5, 10, 20, 40]}; what it leaves out has its default"""
    interval_min: float = 10.0
    """Minutes of the culture's clock from one recording to the next"""
    duration_min: float = 60.0
    """Minutes of the culture's clock that training lasts"""
    speed: float | None = None
    """Minutes of the culture's clock per minute of real time; default: 30 for a simulated culture, 1 for a living
    one"""
    episodes: int = 5
    """Episodes of each policy in closed loop, at the end"""
    controls: Literal["all", "random"] = "all"
    """Controls to run between the policies' episodes"""
    percentiles: Literal["moving", "first"] = "moving"
    """The mapping's percentiles move with the simulator, or are fixed by the first recording"""
    simulator: Literal["histogram", "empirical", "memory"] | None = None
    """memory: draw a response that was measured after a similar history, the default except for recordings in blocks;
    histogram: the paper's; empirical: draw any measured value"""
    sac: tuple[str, ...] = ()
    """Settings of the algorithm that replace its defaults, such as discount=0.98 learning_rate=3e-4"""
    recordings: tuple[Path, ...] = ()
    """For a replay: the recordings that it responds from"""
    seed: int = 1
    """Decides every random draw, except what the culture does and when simulators are swapped"""
    out: Path = Path("live")
    """Folder for recordings, policies, the session, and live.log"""

    def run(self) -> dict[str, Any]:
        from animat.compilation import keep_compilations
        from animat.cultures.kinds import culture_named
        from animat.live.plan import Timetable, check_plan
        from animat.live.shadowing import live
        from animat.progress import Bar
        from animat.recordings.reading import read_recordings

        simulated = self.culture in ("virtual", "replay")
        if self.speed is not None and self.speed != 1 and not simulated:
            raise InvalidArgument(f"--speed: expected 1, as a living culture runs in real time, got {self.speed:g}")
        if (self.culture == "replay") != bool(self.recordings):
            raise InvalidArgument(
                "--recordings: expected the recordings that a replay responds from, and none with another culture, got "
                f"{len(self.recordings)} with --culture {self.culture}"
            )
        self._check_culture_seed()
        speed = (30.0 if simulated else 1.0) if self.speed is None else self.speed
        timetable = Timetable(self.interval_min, self.duration_min, speed)
        training, account, protocol = self._training(), self._account(), self._protocol()
        settings = self._loop_settings()
        check_plan(training, protocol, self.out, timetable, self.episodes, settings, account)
        keep_compilations()
        recordings = read_recordings(self.recordings) if self.recordings else []
        seed = 1 if self.culture_seed is None else self.culture_seed
        with (
            ExitStack() as stack,
            exclusive_lock(self.out),
            Bar("culture") as progress,
            culture_named(
                self.culture, seed=seed, recordings=recordings, selection=self.selection, progress=progress
            ) as culture,
        ):
            ran = live(
                training,
                culture,
                replace(protocol, patterns=min(protocol.patterns, len(culture.patterns))),
                self.out,
                timetable=timetable,
                episodes=self.episodes,
                with_controls=self.controls == "all",
                adaptive=self.thresholds == "adaptive",
                kind=self.simulator,
                account=account,
                progress=progress,
                report=partial(print, file=sys.stderr),
                **settings,
            )
            # Reported even if closing the culture fails.
            stack.callback(self._report, ran)
        return ran.to_dict()

    def _training(self) -> Training:
        from animat.coding.mapping import mapping_named
        from animat.training.specification import Training

        robot = robot_for(self.robot, self.goal)
        return Training(
            robot,
            mapping_named(self.mapping),
            policies=self.policies,
            iterations=robot.paper_iterations,
            seed=self.seed,
            percentiles=self.percentiles,
            algorithm=read_sac(self.sac),
        )

    def _protocol(self) -> Protocol:
        """The protocol of the file, or of the options that it replaces."""
        from animat.cultures.kinds import pulse_for
        from animat.stimulation.protocol import Protocol, read_protocol

        usual = Protocol(order="mixed", trials=500, pulse=pulse_for(self.culture))
        given = {name: value for name in ("order", "pulses", "trials") if (value := getattr(self, name)) is not None}
        if self.protocol is None:
            return replace(usual, **given)
        if given:
            options = ", ".join(f"--{name}" for name in given)
            raise InvalidArgument(f"--protocol: expected it alone, got {options} too; put them in the file")
        return read_protocol(self.protocol, usual)

    def _report(self, ran: LiveRun) -> None:
        from animat.execution.training import as_range

        print(
            f"{counted(len(ran.recordings), 'recording')} in {ran.culture_min:.0f} min of the culture's clock "
            f"({ran.wall_s:.0f} s of real time); {ran.iterations:,} iterations of each policy without a pause; "
            f"{counted(len(ran.swaps), 'swap')} of simulators:"
        )
        for swap in ran.swaps:
            print(
                f"  {swap['at']}  culture at {swap['culture_min']:.1f} min, policies {as_range(swap['members'])} after "
                f"{swap['iterations']:,} iterations: the recording at {swap['recorded_at_min']:.1f} min"
            )
        print(ran.gap.to_text())
        expect_no_fault(ran.gap.session, self.out)
