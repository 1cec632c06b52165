"""Parameter shadowing as the paper intended: the culture is recorded while policies train on its latest recording."""

from __future__ import annotations

import json
import math
import os
import shlex
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from animat.cultures.base import Culture
from animat.cultures.budget import Account, record_within
from animat.cultures.failures import describe_error
from animat.cultures.series import STATE_FILE, order_seed, room_bytes_of
from animat.cultures.under_way import PartialRecording
from animat.cultures.virtual import VirtualCulture
from animat.errors import AnimatError, BudgetSpent, InvalidFile, Mismatch, UnusableData, as_invalid_file, counted
from animat.folders import POLICIES, RECORDINGS, SESSION
from animat.live.plan import LOG_FILE, Timetable, check_plan, for_the_first_recording
from animat.live.trainers import Trainers
from animat.neurons.timeline import SimulatorKind, SimulatorTimeline, fit_timeline
from animat.progress import Part, Progress, in_phase
from animat.reality_gap import Calibration, RealityGap, run_policies
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.responses.extraction import extract_series
from animat.responses.responses import Responses
from animat.stimulation.protocol import Protocol
from animat.training.folder import describe_training, groups_of
from animat.training.policy import Policy
from animat.training.specification import Training
from animat.writing import exclusive_lock, expect_writable

_EXCHANGE = ".exchange"
"""A folder through which the training processes receive simulators and report progress."""
_POLL_S = 0.1


@dataclass(frozen=True, eq=False)
class LiveRun:
    """The results of a live run.

    Attributes:
        swaps: each time a group of policies switched to newer simulators, with the date.
        iterations: fewest training iterations of a policy.
        culture_min, wall_s: time from the first recording to the end of training.
    """

    recordings: tuple[Path, ...]
    policies: dict[str, Policy]
    swaps: tuple[dict[str, Any], ...]
    iterations: int
    culture_min: float
    wall_s: float
    gap: RealityGap

    def to_dict(self) -> dict[str, Any]:
        plain = {name: getattr(self, name) for name in ("swaps", "iterations", "culture_min", "wall_s")}
        files, gap = [str(file) for file in self.recordings], self.gap.to_dict()
        return {**plain, "recordings": files, "policies": list(self.policies), "closed_loop": gap}


def live(
    training: Training,
    culture: Culture,
    protocol: Protocol,
    folder: str | os.PathLike[str],
    *,
    timetable: Timetable | None = None,
    episodes: int = 5,
    with_controls: bool = False,
    adaptive: bool = True,
    kind: SimulatorKind | None = None,
    account: Account | None = None,
    progress: Progress | None = None,
    report: Callable[[str], None] | None = None,
    **settings: Any,
) -> LiveRun:
    """Record a culture again and again while policies train on its newest simulators, then run them on it.

    After the first recording training starts in separate processes, and never pauses. Every `interval_min` the culture
    is recorded again, and each group of policies switches to the new simulators at its next chunk. Training ends at
    `duration_min`, however many iterations were done; `training.iterations` only sets the length of a chunk. Then the
    policies run in closed loop, with percentiles of the last recording they were trained on.

    A simulated culture whose clock runs fast is not recorded again before all groups use the latest simulators. The
    state of a virtual culture is written next to its recordings (`culture.state`), after each of them and after the
    loop: `animat run` continues from it.

    Args:
        training: robot, mapping, policies, seed, algorithm; its duration is set to the timetable's.
        culture: open.
        protocol: of every recording.
        folder: for `recordings/`, `policies/`, `session/` and `live.log`, which has a line of JSON per event.
        episodes: of each policy in closed loop.
        with_controls: run all controls between the policies' episodes; if not, only the random one.
        adaptive: whether the closed loop's thresholds adapt, or are fixed.
        kind: of simulator; None: what suits the protocol (`fit_timeline`).
        account: of a stimulation budget. If it is too small for another recording, training continues on the last.
        progress: updated with the culture's time, and in the closed loop.
        report: as for `run_policies`.
        settings: of the closed loop (`animat.closed_loop.loop.Loop`).

    Raises:
        InvalidArgument, InvalidFile, Mismatch: before anything is delivered, as in `animat.live.plan.check_plan`.
        BudgetSpent: if the budget is too small for the first recording.
        AnimatError: if a training process or the culture fails: the culture is then stopped, and recordings and
            policies are kept as they are.
    """
    timetable = timetable or Timetable()
    account = account or Account()
    check_plan(training, protocol, Path(folder), timetable, episodes, settings, account)
    schedule = culture.schedule(protocol, order_seed(training.seed, 0))
    with for_the_first_recording():
        account.check([stimulus for block in schedule.blocks for stimulus in schedule.deliveries(block)])
    if report is not None:
        report(f"each pulse: {protocol.pulse}")
    training = replace(training, duration_min=timetable.duration_min, shadowing=True)
    run = _Run(training, culture, protocol, Path(folder), timetable, kind, account)
    try:
        policies = run.shadow(progress)
        first, at_min = next(iter(policies.values())), run.used[-1].start_min
        calibration = Calibration.of_series(run.used, first, at_min=at_min, adaptive=adaptive, kind=kind)
        # The session has its own lock, by which viewers see that it is running.
        with exclusive_lock(run.folder / SESSION):
            gap = run_policies(
                policies,
                culture,
                calibration,
                run.folder / SESSION,
                episodes=episodes,
                with_controls=with_controls,
                seed=training.seed,
                account=run.account,
                progress=progress,
                report=report,
                **settings,
            )
        try:
            run.write("closed loop", **gap.session.to_dict())
            # If the culture failed or hangs, its state may be inconsistent; that after its last recording is not.
            if gap.session.ending.by not in ("culture", "hang"):
                run.keep_state()
            run.write("end", budget=run.account.to_dict())
        except InvalidFile as error:
            # Without room for these files the results are not lost.
            if report is not None:
                report(gap.to_text())
            error.add_note(f"{run.folder / SESSION}: the session ended: {gap.session.ending.message}")
            raise
    except BaseException as error:
        run.end_early(error)
        with suppress(InvalidFile):
            run.write("end", budget=run.account.to_dict())
        if any((run.folder / POLICIES).glob("p*.safetensors")):
            of = str(run.folder / POLICIES), "--recordings", str(run.folder / RECORDINGS)
            command = shlex.join(("animat", "run", *of))
            error.add_note(f"what was trained so far can still be run: {command}")
        raise
    return LiveRun(tuple(run.files), policies, tuple(run.swaps), run.iterations, run.culture_min, run.wall_s, gap)


@dataclass(eq=False)
class _Run:
    """A live run in progress, and its log."""

    training: Training
    culture: Culture
    protocol: Protocol
    folder: Path
    timetable: Timetable
    kind: SimulatorKind | None
    account: Account
    files: list[Path] = field(default_factory=list)
    used: list[Responses] = field(default_factory=list)
    swaps: list[dict[str, Any]] = field(default_factory=list)
    iterations: int = 0
    culture_min: float = 0.0
    wall_s: float = 0.0
    has_ended_early: bool = False

    def __post_init__(self) -> None:
        self._zero_s, self._wall_zero_s = self.culture.now_s, time.monotonic()
        self._known_s = self._zero_s
        with as_invalid_file(self.folder, "cannot be made"):
            self.folder.mkdir(parents=True, exist_ok=True)
        training, duration_min = self.training, self.timetable.duration_min
        begun = {"robot": training.robot.name, "policies": training.policies, "seed": training.seed}
        self.write("begun", **begun, duration_min=duration_min)

    def shadow(self, progress: Progress | None) -> dict[str, Policy]:
        """Record and train to the end; returns the policies."""
        timeline = self._record(0, in_phase(progress, "recording"))
        assert timeline is not None
        groups = groups_of(self.training, timeline, describe_training(self.training, timeline))
        minutes, policies = self.timetable.duration_min, self.folder / POLICIES
        progress = in_phase(progress, "training", minutes, "min of the culture")
        # Locked, as the recordings and the session are in their turn, so that viewers know that it is running.
        with exclusive_lock(policies), Trainers(groups, self.folder / _EXCHANGE, policies) as trainers:
            self.write("training", policies=self.training.policies, processes=len(groups))
            try:
                self._record_on_schedule(trainers, progress)
            except BaseException as error:
                self.end_early(error)
                # Unfinished policies are better than none.
                with suppress(AnimatError):
                    trainers.finish()
                raise
            progress.update(minutes, minutes, "waiting for the last chunk of training")
            self._log_swaps(trainers.finish())
            self.iterations = trainers.iterations
        self.culture_min = (self.culture.now_s - self._zero_s) / 60
        self.wall_s = time.monotonic() - self._wall_zero_s
        self.write("trained", iterations=self.iterations, swaps=len(self.swaps), wall_s=round(self.wall_s, 1))
        return {f"p{i}": Policy.load(policies / f"p{i}.safetensors") for i in range(self.training.policies)}

    def end_early(self, error: BaseException) -> None:
        """Stop the culture and log why, once."""
        if self.has_ended_early:
            return
        self.has_ended_early = True
        is_person = isinstance(error, KeyboardInterrupt)
        message = "stopped by a person" if is_person else describe_error(error)
        with suppress(Exception):
            self.culture.stop(message)
        with suppress(InvalidFile):
            self.write("interrupted" if is_person else "fault", message=message)

    def _record_on_schedule(self, trainers: Trainers, progress: Progress) -> None:
        """Record on time, for the processes that train meanwhile."""
        in_budget = True
        for number in range(1, self.timetable.recordings):
            minute = number * self.timetable.interval_min
            self._wait(minute, trainers, progress)
            if not in_budget:
                continue
            part = Part(progress, minute, 0, self.timetable.duration_min, f"recording {number + 1}")
            try:
                timeline = self._record(number, part)
            except BudgetSpent as spent:
                self.write("budget", message=str(spent))
                in_budget, timeline = False, None
            if timeline is not None:
                trainers.publish(number, timeline)
        self._wait(self.timetable.duration_min, trainers, progress)

    def _wait(self, minute: float, trainers: Trainers, progress: Progress) -> None:
        """Wait, while training continues, until the culture's clock is at a minute of the run."""
        due_s = self._wall_zero_s + 60 * minute / self.timetable.speed
        while time.monotonic() < due_s or not trainers.use_the_newest:
            self._log_swaps(trainers.swaps(_POLL_S))
            passed_min = (time.monotonic() - self._wall_zero_s) * self.timetable.speed / 60
            mean = "" if math.isnan(trainers.mean_return) else f", return {trainers.mean_return:.1f}"
            note = f"{counted(len(self.files), 'recording')}, {counted(len(self.swaps), 'swap')}{mean}"
            if time.monotonic() >= due_s:
                note += "; waiting for all policies to train on the newest recording"
            progress.update(min(passed_min, minute), self.timetable.duration_min, note)
        # A virtual culture's rest is computed now, which takes seconds.
        progress.update(minute, self.timetable.duration_min, "the culture rests")
        self.culture.rest(max(0.0, self._zero_s + 60 * minute - self.culture.now_s))

    def _record(self, number: int, progress: Progress) -> SimulatorTimeline | None:
        """Record and fit; returns None, and logs why, if a recording cannot be trained on, but raises for the first."""
        began_s = time.monotonic()
        folder = self.folder / RECORDINGS
        # Locked as by `animat record`, so that viewers know that it is in progress.
        with exclusive_lock(folder), PartialRecording(folder, self.culture.device is not None) as follow:
            # Check the space before stimulating the culture.
            expect_writable(folder, room_bytes=room_bytes_of(self.protocol))
            seed = order_seed(self.training.seed, number)
            recording = record_within(self.account, self.culture, self.protocol, seed, progress, follow)
            file = folder / recording_name(round(recording.start_min, 3))
            follow.finish(recording, partial(write_nwb, recording, file))
        self.files.append(file)
        self.keep_state()
        try:
            series = [*self.used, *extract_series([recording])]
            # Fit all of them again, so that their shapes agree.
            timeline = fit_timeline(series, kind=self.kind).with_percentiles(self.training.percentiles)
        except (UnusableData, Mismatch) as error:
            self.write("unusable", file=file.name, message=str(error))
            if not self.used:
                expected = "recording: expected the first one to be usable, got one that is not"
                raise UnusableData(f"{expected}: {error}") from error
            return None
        self.used = series
        took_s = round(time.monotonic() - began_s, 2)
        self.write("recording", file=file.name, number=number, took_s=took_s, budget=self.account.to_dict())
        return timeline

    def keep_state(self) -> None:
        """Write the state of a virtual culture next to its recordings, where `animat run` looks for it."""
        if isinstance(self.culture, VirtualCulture):
            self.culture.save_state(self.folder / RECORDINGS / STATE_FILE)

    def _log_swaps(self, swaps: Sequence[dict[str, Any]]) -> None:
        for swap in swaps:
            if swap["swap"] > 0:
                self.swaps.append({**swap, **self.write("swap", **swap)})
            else:
                self.write("training began", **swap)

    def write(self, what: str, **fields: Any) -> dict[str, Any]:
        # If the connection is lost, the last known time is logged.
        with suppress(Exception):
            self._known_s = self.culture.now_s
        at, wall_s = datetime.now(UTC).isoformat(timespec="milliseconds"), time.monotonic() - self._wall_zero_s
        line = {
            "at": at,
            "wall_s": round(wall_s, 3),
            "culture_min": round(self._known_s / 60, 4),
            "what": what,
            **fields,
        }
        log = self.folder / LOG_FILE
        with as_invalid_file(log, "cannot be written"), log.open("a") as file:
            file.write(json.dumps(line) + "\n")
        return line
