"""The command that runs policies in closed loop on a culture."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from animat.cli.responses import fit_as, policies_for
from animat.cli.stimulating import Stimulating, expect_no_fault
from animat.errors import InvalidArgument, Mismatch, in_min
from animat.plain_file import expect_no_file
from animat.writing import exclusive_lock

if TYPE_CHECKING:
    from animat.closed_loop.loop import Loop
    from animat.cultures.base import Culture
    from animat.progress import Progress
    from animat.reality_gap import Calibration, RealityGap
    from animat.recordings.findings import Finding
    from animat.recordings.recording import Recording
    from animat.responses.conditions import Conditions
    from animat.stimulation.protocol import Protocol
    from animat.stimulation.pulse import Pulse
    from animat.training.policy import Policy


@dataclass(frozen=True)
class Run(Stimulating):
    """Run policies in closed loop on a culture, with controls between them: predicted against measured return."""

    policies: Positional[Path] = Path("policies")
    """A policy file or a folder of them"""
    robot: str | None = None
    """The robot that is expected, and imported: my_package.robots:Rover; default: the one they were trained on"""
    mapping: str | None = None
    """The mapping that is expected, and imported: my_package.mappings:Steep; default: the one they were trained with"""
    recordings: tuple[Path, ...] = ()
    """Recordings the policies were trained on: their percentiles and prediction"""
    at_min: float | None = None
    """Minute whose newest recording is taken; default: the last that the policies were trained on"""
    protocol: Path | None = None
    """The file of record --protocol that the recordings were made with, if they do not state their pulse"""
    state: Path | None = None
    """State of a virtual culture to go on from; default: culture.state beside the recordings, where there is one"""
    episodes: int = 5
    """Of each policy; of each control as many at most, and together no more than of policies, but 5 each"""
    controls: Literal["all", "random", "coupling"] = "all"
    """all: random, constant, silent, shuffled and heuristic; random: only that one; coupling: all, and the best reflex,
    which is searched for on the simulator first, a minute"""
    interventions: bool = False
    """Also say whose work it is: the policies with random spikes in place of responses, the stimuli of another episode,
    the mapping turned round and, of a robot with several goals, the goal switched in mid-episode"""
    pulses: int | None = None
    """Pulses per trial; default: as the policies' recordings had"""
    simulator: Literal["histogram", "empirical", "memory"] | None = None
    """That predicts, as for animat train; default: as the policies were trained"""
    bins: int | None = None
    """Bins of a histogram; default: as the policies were trained"""
    range_hz: float | None = None
    """Bins equally wide from 0 to here, in Hz (the paper: 120); default: as the policies were trained"""
    burst_threshold: float | None = None
    """Share of active channels above which a response is a burst; 1: none is; default: as the policies were trained"""
    allow: tuple[str, ...] = ()
    """Findings on the recordings to allow, by name"""
    real_time: bool = False
    """Hold a simulated culture back to real time; a living one always runs in it"""
    drawn: bool = False
    """Draw actions from the policies, as in training, instead of taking the most probable one"""
    seed: int = 1
    """Decides every random draw, but what a living culture does"""
    out: Path = Path("session")
    """Folder for the session's log and recording"""
    watch: bool = False
    """Serve a page of it beside, for a browser on this machine; needs animat[watch]"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Run."""
        import numpy as np

        from animat.closed_loop.loop import Loop
        from animat.closed_loop.running import check_episodes
        from animat.coding.decoder import percentiles_shape
        from animat.compilation import keep_compilations
        from animat.cultures.budget import Account, Budget
        from animat.neurons.simulator import check_binning
        from animat.progress import Bar
        from animat.reality_gap import check_conditions, check_policies, run_policies
        from animat.recordings.reading import read_recordings
        from animat.robots.host import HostRobot

        # All that can be wrong is found before the culture is opened; no percentiles are needed to look at the rest.
        check_episodes("--episodes", self.episodes)
        if self.seed < 0:
            raise InvalidArgument(f"--seed: expected 0 or more, got {self.seed}")
        self._expect_culture_seed()
        policies = policies_for(self.robot, self.mapping, self.policies)
        first = check_policies(policies)
        if not self.recordings:
            raise InvalidArgument(
                "--recordings: expected those that the policies were trained on, got none: record first with "
                "`animat record`, and train on that"
            )
        if isinstance(first.robot, HostRobot) and (self.interventions or self.controls == "coupling"):
            raise InvalidArgument(
                f"--interventions, --controls coupling: expected a robot in JAX, got {first.robot.name}; leave them out"
            )
        fit = fit_as(first.fitted, self.simulator, self.bins, self.range_hz)
        if fit["kind"] in ("histogram", None):
            check_binning(fit["bins"], fit["range_hz"])
        settings = {**self._of_the_loop(), "pulses": self.pulses, "real_time": self.real_time}
        account = Account(Budget(self.budget_pulses, self.budget_per_electrode))
        keep_compilations()
        recordings = read_recordings(self.recordings)
        calibration = self._calibration(recordings, first)
        check_conditions(first, calibration)
        calibrating = next(each for each in recordings if each.start_min == calibration.start_min)
        protocol, unknown = self._protocol(recordings, calibrating)
        loop, _ = Loop.of_policy(
            first,
            np.zeros(percentiles_shape(first.readouts)),
            conditions=calibration.conditions,
            pulse=protocol.pulse,
            **settings,
        )
        with (
            ExitStack() as told,
            # Last, as it makes the folder.
            _held_for_session(self.out),
            Bar("culture") as progress,
            self._culture(recordings, calibrating, loop.pulse, progress) as culture,
        ):
            noticed = unknown + _other_than(calibrating, culture, loop)
            gap = run_policies(
                policies,
                culture,
                calibration,
                self.out,
                episodes=self.episodes,
                with_controls=self.controls != "random",
                with_coupling=self.controls == "coupling",
                with_interventions=self.interventions,
                greedy=not self.drawn,
                seed=self.seed,
                account=account,
                progress=progress,
                report=partial(print, file=sys.stderr),
                noticed=noticed,
                pulse=loop.pulse,
                # Of recordings that do not tell how many they used, all.
                patterns=None if unknown else min(protocol.patterns, len(culture.patterns)),
                **settings,
            )
            # It is told even where the culture cannot be closed then.
            told.callback(self._report, gap)
        return gap.to_dict()

    def _report(self, gap: RealityGap) -> None:
        print(gap.to_text())
        if gap.session.recording_file.is_file():
            print(f"{gap.session.recording_file} is its recording, {self.out / 'session.log'} has every tick")
        expect_no_fault(gap.session, self.out)

    def _protocol(
        self, recordings: Sequence[Recording], calibrating: Recording
    ) -> tuple[Protocol, tuple[Finding, ...]]:
        """What tells pulse and patterns: the recording that calibrates, else --protocol, else what is usual; which."""
        from animat.cultures.kinds import pulse_for
        from animat.recordings.findings import Finding
        from animat.stimulation.protocol import CLOSED_LOOP, read_protocol

        usual = replace(CLOSED_LOOP, pulse=pulse_for(self.culture))
        given = None if self.protocol is None else read_protocol(self.protocol, usual)
        told = [(f"at {in_min(each.start_min)}", each.protocol) for each in recordings]
        told.append((str(self.protocol), given))
        pulses = {protocol.pulse: where for where, protocol in told if protocol is not None}
        if len(pulses) > 1:
            (one, there), (other, elsewhere), *_ = pulses.items()
            raise Mismatch(
                f"--recordings: expected one pulse in all, got {one} ({there}) and {other} ({elsewhere}): give those "
                "that were recorded with the pulse that the loop is to deliver"
            )
        protocol = calibrating.protocol or given
        if protocol is not None and (self.culture != "replay" or protocol.pulse.kind == usual.pulse.kind):
            return protocol, ()
        if protocol is not None:
            # A replay answers alike whatever the pulse, and its limits are those of voltages.
            return replace(protocol, pulse=usual.pulse), ()
        taken = next(iter(pulses), usual.pulse)
        message = (
            f"the recording at {in_min(calibrating.start_min)}, which calibrates the loop, does not tell its pulse: "
            f"the loop delivers {taken}, {'as the others had' if pulses else f'the usual one on a {self.culture}'}; "
            "another is given by --protocol"
        )
        return replace(usual, pulse=taken), (Finding("unknown-pulse", "warning", message),)

    def _culture(
        self, recordings: Sequence[Recording], calibrating: Recording, pulse: Pulse, progress: Progress
    ) -> Culture:
        from animat.cultures.kinds import culture_of, recorded_culture
        from animat.cultures.safety import Guard

        known = recorded_culture(self.culture, [calibrating], self.recordings)
        state = self.state or (known.get("state") if self.culture_seed is None else None)
        seed = self.culture_seed if self.culture_seed is not None else known.get("seed", 1)
        culture = culture_of(
            self.culture, seed=seed, state=state, recordings=recordings, selection=self.selection, progress=progress
        )
        # Again when it is open: some devices tell their step of amplitude only then.
        Guard(culture.limits, ()).check_pulse(pulse)
        if state is not None:
            print(f"the culture goes on from {state}", file=sys.stderr)
        return culture

    def _calibration(self, recordings: Sequence[Recording], first: Policy) -> Calibration:
        from animat.reality_gap import Calibration
        from animat.responses.series import extract_series
        from animat.responses.windows import DEFAULT_WINDOW_MS

        trained = first.fitted.get("burst_threshold")
        series = extract_series(
            recordings,
            _conditions(recordings, first),
            window_ms=first.window_ms or DEFAULT_WINDOW_MS,
            burst_threshold=trained if self.burst_threshold is None else self.burst_threshold,
            allow=self.allow,
            readouts=first.readouts,
        )
        made = fit_as(first.fitted, self.simulator, self.bins, self.range_hz)
        adaptive = self.thresholds == "adaptive"
        return Calibration.of_series(series, first, at_min=self.at_min, adaptive=adaptive, **made)


def _other_than(recording: Recording, culture: Culture, loop: Loop) -> tuple[Finding, ...]:
    """Where the culture differs from the one of the recording that calibrates the loop."""
    from animat.cultures.same_culture import other_culture, other_patterns

    found = [other_culture(recording, culture)]
    if loop.encoder.takes_patterns:
        found.append(other_patterns(recording, culture))
    return tuple(finding for finding in found if finding is not None)


@contextmanager
def _held_for_session(folder: Path) -> Iterator[None]:
    """Hold a folder that can take a new session; the error of one that cannot says what is there."""
    from animat.closed_loop.session import expect_no_session

    expect_no_file(folder, "the session")
    with exclusive_lock(folder):
        expect_no_session(folder)
        yield


def _conditions(recordings: Sequence[Recording], first: Policy) -> Conditions | None:
    """What policies pick from: as they were trained, but some of the recordings' frequencies may be all there are."""
    from animat.responses.conditions import ByFrequency, conditions_named

    by = first.fitted.get("by") or "frequency"
    if not by.startswith("frequency") or " x " in by:
        return conditions_named(by)
    if not first.conditions or any(condition.unit != "Hz" for condition in first.conditions):
        return None
    picked = ByFrequency(tuple(condition.value for condition in first.conditions))
    every = range(len(picked.values_hz))
    # Where one lacks, the recordings' own conditions say better what is there instead.
    return picked if all(set(every) <= set(picked.assign(r.stimuli).condition.tolist()) for r in recordings) else None
