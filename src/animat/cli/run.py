"""The command that runs policies in closed loop on a culture."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from animat.cli.command import StimulationOptions, expect_no_fault, policies_for, simulator_settings
from animat.errors import BudgetSpent, InvalidArgument, Mismatch, UnsafeStimulus, expect_at_least, in_min
from animat.plain_file import expect_no_file
from animat.progress import Bar, Progress
from animat.recordings.findings import Finding
from animat.writing import exclusive_lock

if TYPE_CHECKING:
    from animat.cultures.base import Culture
    from animat.reality_gap import Calibration, RealityGap
    from animat.recordings.recording import Recording
    from animat.responses.conditions import Conditions
    from animat.stimulation.pulse import Pulse
    from animat.training.policy import Policy


@dataclass(frozen=True)
class Run(StimulationOptions):
    """Run policies in closed loop on a culture, interleaved with controls: predicted against measured return."""

    policies: Positional[Path] = Path("policies")
    """A policy file or a folder of them"""
    robot: str | None = None
    """The expected robot, with its import path: my_package.robots:Rover; default: the one they were trained on"""
    mapping: str | None = None
    """The expected mapping, with its import path: my_package.mappings:Steep; default: the one they were trained with"""
    recordings: tuple[Path, ...] = ()
    """Recordings that the policies were trained on, for percentiles and prediction"""
    at_min: float | None = None
    """Calibrate by the newest recording made by this minute; default: the last that the policies were trained on"""
    protocol: Path | None = None
    """The file of record --protocol that the recordings were made with, if they do not state their pulse"""
    state: Path | None = None
    """State that a virtual culture continues from; default: culture.state next to the recordings, if it exists"""
    episodes: int = 5
    """Episodes of each policy. All controls share as many as all policies have together; each has at least 5, unless
    a policy has fewer, and at most as many as a policy"""
    controls: Literal["all", "random", "coupling"] = "all"
    """all: random, constant, silent, shuffled and heuristic; random: only that one; coupling: all, and the best reflex,
    searched for on the simulator first, which takes a minute"""
    agents: tuple[str, ...] = ()
    """Your own agents, each with as many episodes as a policy: my_rule:Rule (docs/agents.md)"""
    interventions: bool = False
    """Also measure whose work it is: run the policies with random spikes in place of responses, with the stimuli of
    another episode, with the mapping turned round and, for a robot with several goals, with the goal switched in
    mid-episode"""
    pulses: int | None = None
    """Pulses per trial; default: as in the policies' recordings"""
    simulator: Literal["histogram", "empirical", "memory"] | None = None
    """The simulator that predicts, as for animat train; default: as in the policies' training"""
    bins: int | None = None
    """Bins of a histogram; default: as in the policies' training"""
    range_hz: float | None = None
    """Equally wide bins from 0 to this rate, in Hz (the paper: 120); default: as in the policies' training"""
    burst_threshold: float | None = None
    """Share of active channels above which a response is a burst; 1: no response is; default: as in the policies'
    training"""
    allow: tuple[str, ...] = ()
    """Findings about the recordings to allow, by name"""
    real_time: bool = False
    """Hold a simulated culture back to real time; a living one always runs in real time"""
    drawn: bool = False
    """Draw actions from the policies, as in training, instead of taking the most probable one"""
    seed: int = 1
    """Decides every random draw, except what a living culture does"""
    out: Path = Path("session")
    """Folder for the session's log and recording"""

    def run(self) -> dict[str, Any]:
        from animat.closed_loop.loop import Loop
        from animat.closed_loop.session import expect_no_session
        from animat.compilation import keep_compilations
        from animat.evaluation.own_agents import agents_at
        from animat.neurons.simulator import check_binning
        from animat.reality_gap import run_policies
        from animat.recordings.reading import read_recordings

        # Everything is checked before the culture is opened.
        policies, first = self._policies()
        agents = agents_at(self.agents, first.conditions)
        fit = simulator_settings(first.fitted, self.simulator, self.bins, self.range_hz)
        if fit["kind"] in ("histogram", None):
            check_binning(fit["bins"], fit["range_hz"])
        settings = {**self._loop_settings(), "pulses": self.pulses, "real_time": self.real_time}
        account = self._account()
        keep_compilations()
        recordings = read_recordings(self.recordings)
        calibration = self._calibration(recordings, first, fit)
        calibrating = next(recording for recording in recordings if recording.start_min == calibration.start_min)
        pulse, patterns, unknown = self._delivered(recordings, calibrating)
        loop, _ = Loop.of_policy(
            first,
            calibration.percentiles,
            conditions=calibration.conditions,
            pulse=pulse,
            adaptive_from=calibration.adjusted if calibration.adaptive else None,
            **settings,
        )
        try:
            account.check_number(loop.pulses_until_moved)
        except BudgetSpent as spent:
            until = "until the robot first moves, with settling and warm-up: give a larger budget"
            raise BudgetSpent(f"{spent} {until}") from spent
        expect_no_file(self.out, "the session")
        # After all checks, as the lock makes the folder.
        with ExitStack() as stack, exclusive_lock(self.out), Bar("culture") as progress:
            expect_no_session(self.out)
            with self._culture(recordings, calibrating, loop.pulse, progress) as culture:
                gap = run_policies(
                    policies,
                    culture,
                    calibration,
                    self.out,
                    episodes=self.episodes,
                    with_controls=self.controls != "random",
                    with_coupling=self.controls == "coupling",
                    with_interventions=self.interventions,
                    agents=agents,
                    greedy=not self.drawn,
                    seed=self.seed,
                    account=account,
                    progress=progress,
                    report=partial(print, file=sys.stderr),
                    noticed=unknown,
                    pulse=loop.pulse,
                    # All, if the recordings do not state how many they used.
                    patterns=None if patterns is None else min(patterns, len(culture.patterns)) or None,
                    **settings,
                )
                # Reported even if closing the culture fails.
                stack.callback(self._report, gap)
        return gap.to_dict()

    def _policies(self) -> tuple[dict[str, Policy], Policy]:
        """The policies and the first of them, which represents all; refuses options that do not suit them."""
        from animat.closed_loop.running import check_episodes
        from animat.evaluation.rollouts import check_seed
        from animat.reality_gap import check_policies
        from animat.robots.host import HostRobot

        check_episodes("--episodes", self.episodes)
        expect_at_least("--seed", self.seed, 0)
        self._check_culture_seed()
        policies = policies_for(self.robot, self.mapping, self.policies)
        first = check_policies(policies)
        if not self.recordings:
            raise InvalidArgument(
                "--recordings: expected those that the policies were trained on, got none: make some with "
                "`animat record` and train on them, or name those that there are"
            )
        in_jax = {"--interventions": self.interventions, "--controls coupling": self.controls == "coupling"}
        for option in (option for option, is_given in in_jax.items() if is_given):
            if isinstance(first.robot, HostRobot):
                raise InvalidArgument(f"{option}: expected a robot in JAX, got {first.robot.name}; leave it out")
        if any(in_jax.values()):
            check_seed(self.seed)
        return policies, first

    def _calibration(self, recordings: Sequence[Recording], first: Policy, fit: dict[str, Any]) -> Calibration:
        """The calibration by the recordings' responses, read by the options and otherwise as in the training."""
        from animat.evaluation.transfer import expect_same_conditions
        from animat.reality_gap import Calibration
        from animat.responses.extraction import extract_series

        trained = first.fitted.get("burst_threshold")
        series = extract_series(
            recordings,
            _conditions(recordings, first),
            window_ms=first.window_ms,
            burst_threshold=trained if self.burst_threshold is None else self.burst_threshold,
            allow=self.allow,
            readouts=first.readouts,
        )
        adaptive = self.thresholds == "adaptive"
        calibration = Calibration.of_series(series, first, at_min=self.at_min, adaptive=adaptive, **fit)
        expect_same_conditions(first, calibration.conditions, calibration.readouts)
        return calibration

    def _report(self, gap: RealityGap) -> None:
        print(gap.to_text())
        if gap.session.recording_file.is_file():
            print(f"recording: {gap.session.recording_file}; every tick: {self.out / 'session.log'}")
        expect_no_fault(gap.session, self.out)

    def _delivered(
        self, recordings: Sequence[Recording], calibrating: Recording
    ) -> tuple[Pulse, int | None, list[Finding]]:
        """The pulse and the number of patterns of the calibrating recording, else of --protocol.

        If neither states a pulse, it is that of another recording, or the usual one, with a warning; no number: it is
        not known.
        """
        from animat.cultures.kinds import pulse_for
        from animat.stimulation.protocol import CLOSED_LOOP, read_protocol

        usual = pulse_for(self.culture)
        option = None if self.protocol is None else read_protocol(self.protocol, replace(CLOSED_LOOP, pulse=usual))
        given = None if option is None else option.pulse
        stated = [(f"at {in_min(recording.start_min)}", recording.pulse) for recording in recordings]
        stated.append((str(self.protocol), given))
        pulses = {pulse: where for where, pulse in stated if pulse is not None}
        if len(pulses) > 1:
            (one, where), (other, elsewhere), *_ = pulses.items()
            raise Mismatch(
                f"--recordings: expected one pulse in all, got {one} ({where}) and {other} ({elsewhere}): give those "
                "that were recorded with the pulse that the loop is to deliver"
            )
        protocol = calibrating.protocol or option
        patterns = None if protocol is None else protocol.patterns
        if (stated_here := calibrating.pulse or given) is not None:
            return pulse_for(self.culture, stated_here), patterns, []
        pulse = next(iter(pulses), usual)
        source = "as in the other recordings" if pulses else f"the usual one with --culture {self.culture}"
        message = (
            f"the recording at {in_min(calibrating.start_min)}, which calibrates the loop, does not state its pulse: "
            f"the loop delivers {pulse}, {source}; to change it, use --protocol"
        )
        return pulse, patterns, [Finding("unknown-pulse", "warning", message)]

    def _culture(
        self, recordings: Sequence[Recording], calibrating: Recording, pulse: Pulse, progress: Progress
    ) -> Culture:
        from animat.cultures.kinds import culture_arguments, culture_named

        known = culture_arguments(self.culture, [calibrating], self.recordings)
        if self.culture_seed is not None:
            known = {"seed": self.culture_seed}
        state, seed = self.state or known.get("state"), known.get("seed", 1)
        culture = culture_named(
            self.culture, seed=seed, state=state, recordings=recordings, selection=self.selection, progress=progress
        )
        # Checked again once it is open: some devices report their amplitude step only then.
        try:
            culture.limits.check_pulse(pulse)
        except UnsafeStimulus as error:
            source = "--recordings" if calibrating.pulse or not self.protocol else "--protocol"
            raise Mismatch(
                f"{source}: expected a pulse that suits a {self.culture}, got another ({error}): record on that "
                f"culture first, with animat record --culture {self.culture}, and train on those recordings"
            ) from error
        if state is not None:
            print(f"the culture continues from {state}", file=sys.stderr)
        return culture


def _conditions(recordings: Sequence[Recording], first: Policy) -> Conditions | None:
    """The conditions of the policies' training; None for those of the recordings themselves."""
    from animat.responses.conditions import ByFrequency, conditions_named

    by = first.fitted.get("by") or "frequency"
    if not by.startswith("frequency") or " x " in by:
        return conditions_named(by)
    if not first.conditions or any(condition.unit != "Hz" for condition in first.conditions):
        return None
    picked = ByFrequency(tuple(condition.value for condition in first.conditions))
    every = set(range(len(picked.values_hz)))
    # If one is missing, an error about the recordings' own conditions is clearer.
    return picked if all(every <= set(picked.assign(r.stimuli).condition.tolist()) for r in recordings) else None
