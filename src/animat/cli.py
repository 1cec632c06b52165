"""The command line: parses, calls, prints. What the commands do is in the modules that they call."""

from __future__ import annotations

import contextlib
import io
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, subcommand

from animat.cli_convert import Convert
from animat.cli_loop import Live, Recover, Run
from animat.cli_record import Record
from animat.cli_studies import Reproduce, StudyFile
from animat.errors import AnimatError, InvalidArgument, Mismatch, UnusableData
from animat.recordings.findings import Finding

if TYPE_CHECKING:
    from animat.neurons.conditions import Conditions
    from animat.neurons.responses import Responses
    from animat.neurons.timeline import SimulatorTimeline
    from animat.progress import Progress


@dataclass(frozen=True)
class Responding:
    """How responses are read from recordings; the same in every command that reads them."""

    conditions: str | None = None
    """What the agent picks from: frequency, interval:5,10+-25%, electrode, pattern, all; default: by frequency"""
    window_ms: tuple[float, float] = (2.0, 10.0)
    """Start and end of the response window after a stimulus, in ms"""
    burst_threshold: float | None = None
    """Share of active channels above which a response is a burst; 1 keeps all; default: by Otsu's method"""


@dataclass(frozen=True)
class Fitting(Responding):
    """How a neuron simulator is made of responses."""

    simulator: Literal["histogram", "empirical"] = "histogram"
    """histogram: a distribution in bins (the paper); empirical: draw a measured value"""
    bins: int = 20
    """Bins of a histogram"""
    range_hz: float | None = None
    """Bins equally wide from 0 to here, in Hz (the paper: 120); default: edges at percentiles of each recording"""
    despite: tuple[str, ...] = ()
    """Findings to go on in spite of, by name, such as dead-window"""

    def timeline(self, recordings: Sequence[Path]) -> SimulatorTimeline:
        """Read the recordings and fit a simulator to each."""
        from animat.neurons.conditions import conditions_named
        from animat.neurons.series import extract_series
        from animat.neurons.timeline import fit_timeline
        from animat.recordings.reading import read_recordings

        if not recordings:
            raise InvalidArgument("--recordings: expected files or folders of recordings, got none")
        by = None if self.conditions is None else conditions_named(self.conditions)
        series = extract_series(
            read_recordings(recordings),
            by,
            self.window_ms,
            burst_threshold=self.burst_threshold,
            despite=self.despite,
        )
        timeline = fit_timeline(series, kind=self.simulator, bins=self.bins, range_hz=self.range_hz)
        _say_findings(timeline.findings)
        return timeline


@dataclass(frozen=True)
class Inspect(Responding):
    """Say what is in recordings, whether an Animat can be made of them, and what is wrong with them."""

    recordings: Positional[tuple[Path, ...]] = ()
    """Files, or folders of them: NWB, MaxWell, CL1, NPZ, CSV (NAME_spikes.csv with NAME_stimuli.csv beside it)"""
    stimuli: str | None = None
    """Which of several things in a file are the stimuli (NWB: the name; MaxWell: the events' type)"""
    part: str | None = None
    """Which of several recordings in a MaxWell file, such as well000/rec0000"""
    limit: Literal["cartpole", "navigation"] | None = None
    """Also compute the best return that any controller could get with this robot, before any training"""
    out: Path | None = None
    """Folder for figures; default: none are drawn"""
    format: Literal["png", "svg", "pdf"] = "png"
    """Of the figures"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Inspect each file."""
        from animat.neurons.conditions import conditions_named
        from animat.progress import Bar
        from animat.recordings.reading import list_recordings
        from animat.report.inspection import figure_stem

        by = None if self.conditions is None else conditions_named(self.conditions)
        files = list_recordings(self.recordings)
        # The figures of the series have a name of their own.
        stems = ["series", *(figure_stem(file.name) for file in files)]
        if self.out is not None and len(set(stems)) < len(stems):
            alike = next(stem for stem in stems if stems.count(stem) > 1)
            raise InvalidArgument(
                f"--out: expected recordings of different names, got figures that would all be called {alike}-...; "
                "inspect them apart, or rename one"
            )
        with Bar("inspecting") as progress:
            return self._inspect(files, by, progress)

    def _inspect(self, files: Sequence[Path], by: Conditions | None, progress: Progress) -> dict[str, Any]:
        from animat.neurons.inspection import inspect_recording
        from animat.recordings.reading import read_recording
        from animat.report.inspection import draw_inspection, inspection_text
        from animat.report.series import draw_series

        inspected, series = [], []
        # Reading is one step of each file, drawing another, and the figures of the series are the last.
        steps = 1 if self.out is None else 2
        total = steps * len(files) + (self.out is not None)
        for number, file in enumerate(files):
            progress.update(steps * number, total, file.name)
            recording = read_recording(file, stimuli=self.stimuli, part=self.part)
            try:
                inspection = inspect_recording(recording, by, self.window_ms, self.burst_threshold, file.name)
            except UnusableData as error:
                raise UnusableData(f"{file}: {error}") from error
            print(inspection_text(inspection), end="\n\n")
            inspected.append(inspection.to_dict())
            if self.limit is not None:
                progress.update(steps * number, total, f"{file.name}, best possible return")
                inspected[-1]["limits"] = _limits(self.limit, inspection.responses)
            if self.out is not None:
                progress.update(steps * number + 1, total, f"{file.name}, figures")
                figures = [str(figure) for figure in draw_inspection(recording, inspection, self.out, self.format)]
                print(f"figures: {', '.join(figures)}\n")
                inspected[-1]["figures"] = figures
                series.append((recording.start_min, file, inspection.responses))
        if self.out is None or not series:
            return {"recordings": inspected}
        progress.update(total - 1, total, "figures of the series")
        first = read_recording(min(series, key=lambda one: one[0])[1], stimuli=self.stimuli, part=self.part)
        try:
            figures = [str(figure) for figure in draw_series(first, [one[2] for one in series], self.out, self.format)]
        except Mismatch as unlike:
            print(f"no figures of the series: {unlike}")
            return {"recordings": inspected}
        print(f"figures of the series: {', '.join(figures)}")
        return {"recordings": inspected, "figures": figures}


def _limits(robot: str, responses: Responses) -> list[dict[str, Any]] | None:
    """What a culture could do with a robot, printed; None where that cannot be told."""
    from animat.compilation import keep_compilations
    from animat.evaluation.prospects import prospects
    from animat.robots.registry import robot_named

    keep_compilations()
    try:
        found = prospects(responses, robot_named(robot))
    except UnusableData as error:
        print(f"{robot}: no best possible return: {error}\n")
        return None
    for prospect in found:
        print(prospect.to_text())
        _say_findings(prospect.best.findings())
    print()
    return [prospect.to_dict() for prospect in found]


@dataclass(frozen=True)
class Train(Fitting):
    """Train policies for a robot on the simulators of a culture's recordings. Goes on where it stopped."""

    robot: Positional[Literal["cartpole", "navigation"]] = "cartpole"
    """The robot to drive"""
    recordings: tuple[Path, ...] = ()
    """Files or folders of recordings of one culture"""
    mapping: Literal["1-threshold", "9-thresholds", "linear", "none"] = "1-threshold"
    """From responses to motor commands; none: the baseline without neurons"""
    policies: int = 10
    """How many policies, each from its own random numbers"""
    iterations: int | None = None
    """Training iterations of each; default: the paper's, 800000 for cartpole and 500000 for navigation"""
    seed: int = 1
    """Decides every random draw"""
    shadowing: Literal["on", "off"] = "on"
    """on: refresh the simulators during training (parameter shadowing); off: the first one throughout"""
    duration_min: float = 60.0
    """Minutes of the culture's clock that training stands for"""
    percentiles: Literal["moving", "first"] = "moving"
    """The mapping's percentiles move with the simulator, or are held from the first recording"""
    delivery: Literal["chosen", "shuffled"] = "chosen"
    """shuffled: the paper's control, the delivered condition is drawn at random whatever the policy chose"""
    parameters: tuple[str, ...] = ()
    """Parameters of the robot in place of its defaults, such as pole_mass_kg=0.55"""
    workers: int | None = None
    """Processes, each on its own core; default: one a core"""
    out: Path = Path("policies")
    """Folder for the policies"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Train."""
        from animat.mapping import mapping_named
        from animat.progress import Bar
        from animat.robots.registry import robot_named
        from animat.training.specification import Training

        # What can be refused is refused before recordings are read, which can take a while.
        if self.workers is not None and self.workers < 1:
            raise InvalidArgument(f"--workers: expected at least 1, got {self.workers}")
        robot = robot_named(self.robot, **_numbers("--parameters", self.parameters))
        training = Training(
            robot=robot,
            mapping=None if self.mapping == "none" else mapping_named(self.mapping),
            policies=self.policies,
            iterations=robot.paper_iterations if self.iterations is None else self.iterations,
            seed=self.seed,
            shadowing=self.shadowing == "on",
            duration_min=self.duration_min,
            percentiles=self.percentiles,
            delivery=self.delivery,
            commands=(-1.0, 1.0) if self.mapping == "none" and self.robot == "cartpole" else None,
        )
        for caveat in robot.caveats():
            print(f"warning: {caveat}", file=sys.stderr)
        timeline = None if self.mapping == "none" else self.timeline(self.recordings)

        if timeline is not None and len(timeline.conditions) < 2 and "one-condition" not in self.despite:
            raise UnusableData(
                "--conditions: expected two or more for an agent to choose from, got one "
                f"({timeline.conditions[0].label}); sort the stimuli by interval:5,10, electrode or pattern "
                "(to go on in spite of it: --despite one-condition)"
            )
        from animat.training.trainer import train

        if timeline is not None:
            print(_control(timeline))
        with Bar("training") as progress:
            trained = train(
                training,
                timeline,
                self.out,
                workers=self.workers,
                progress=progress,
                sources=[str(path) for path in self.recordings],
            )
        last = {name: policy.learning_curve[-1, 2].item() for name, policy in trained.items()}
        known = [mean for mean in last.values() if math.isfinite(mean)]
        ended = f"{sum(known) / len(known):.1f}" if known else "not known, as no episode ended then"
        print(f"{len(trained)} policies in {self.out}; mean return at the end of training, over policies: {ended}")
        return {"policies": [str(self.out / f"{name}.safetensors") for name in trained], "last_returns": last}


@dataclass(frozen=True)
class Evaluate(Fitting):
    """Run trained policies, and controls beside them, on the simulator of a recording."""

    policies: Positional[Path] = Path("policies")
    """A policy file or a folder of them"""
    recordings: tuple[Path, ...] = ()
    """Files or folders of recordings of one culture"""
    at_min: float | None = None
    """Minute on the culture's clock whose newest recording answers; default: the last recording"""
    episodes: int = 100
    """Episodes of each policy and control"""
    robot: Literal["cartpole", "navigation"] | None = None
    """The robot that is expected; default: the one the policies were trained on"""
    drawn: bool = False
    """Draw actions from the policy, as in training, instead of taking the most probable one"""
    limit: bool = False
    """Also compute the best return that any controller could get there, and scores beside it; takes seconds"""
    seed: int = 1
    """Decides every random draw"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Evaluate."""
        from animat.compilation import keep_compilations
        from animat.progress import Bar
        from animat.training.policy import load_policies

        if self.episodes < 1:
            raise InvalidArgument(f"--episodes: expected at least 1, got {self.episodes}")
        policies = load_policies(self.policies)
        for name, policy in policies.items():
            if self.robot is not None and policy.robot.name != self.robot:
                raise Mismatch(f"{name}: expected a policy for {self.robot}, got one for {policy.robot.name}")
        through_neurons = any(policy.mapping is not None for policy in policies.values())
        timeline = self.timeline(self.recordings) if through_neurons else None

        from animat.evaluation.table import evaluate

        keep_compilations()
        with Bar("evaluating") as progress:
            evaluation = evaluate(
                policies,
                timeline,
                at_min=self.at_min,
                episodes=self.episodes,
                seed=self.seed,
                greedy=not self.drawn,
                limit_resolution=1.0 if self.limit else None,
                progress=progress,
            )
        _say_findings(evaluation.findings)
        print(evaluation.to_text())
        return evaluation.to_dict()


Command = (
    Annotated[Record, subcommand("record")]
    | Annotated[Inspect, subcommand("inspect")]
    | Annotated[Convert, subcommand("convert")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Reproduce, subcommand("reproduce")]
    | Annotated[StudyFile, subcommand("study")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Live, subcommand("live")]
    | Annotated[Recover, subcommand("recover")]
)

COMMANDS = tuple(command.__metadata__[0].name for command in get_args(Command))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status: 0, 1 for an error that a line on standard error names, 2 for usage."""
    try:
        command = _parse(sys.argv[1:] if arguments is None else list(arguments))
    except InvalidArgument as error:
        print(f"animat: {error}", file=sys.stderr)
        return 2
    try:
        results = command.run()
    except AnimatError as error:
        print(f"animat: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        again = "; start again to go on" if isinstance(command, Record | Train | Reproduce | StudyFile) else ""
        print(f"animat: interrupted; what was finished is kept{again}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Whoever read the output closed it; Python would complain once more while exiting.
        sys.stderr.close()
        return 141
    except Exception as error:
        # JAX has an error of its own for it, which is not imported for this.
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        print("animat: out of memory: ask for fewer episodes, policies or stimuli at once", file=sys.stderr)
        return 1
    if command.json:
        print(json.dumps(_as_json(results)))
    return 0


def _parse(
    arguments: list[str],
) -> Record | Inspect | Convert | Train | Evaluate | Reproduce | StudyFile | Run | Live | Recover:
    """Read the command line; usage errors come in one line, not in a box."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        raise InvalidArgument(f"expected a command, one of {', '.join(COMMANDS)}; got {arguments[0]!r}")
    if not arguments:
        raise InvalidArgument(f"expected a command, one of {', '.join(COMMANDS)}; see animat --help")
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                Command,
                prog="animat",
                description="Drive a robot with a living neuronal culture.",
                args=arguments,
                config=(FlagCreatePairsOff, OmitArgPrefixes),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [line.strip("│╭╮╰╯ ") for line in said.getvalue().splitlines()]
        rules = [i for i, line in enumerate(lines) if set(line) == {"─"}]
        what = " ".join(line for line in lines[1 : rules[0] if rules else None] if line)
        raise InvalidArgument(f"{what}; see animat {' '.join(arguments[:1])} --help") from None


def _numbers(option: str, pairs: Sequence[str]) -> dict[str, float]:
    numbers = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            numbers[name] = float(value)
        except ValueError:
            raise InvalidArgument(f"{option}: expected NAME=NUMBER, got {pair!r}") from None
    return numbers


def _as_json(value: Any) -> Any:
    """The same with null for numbers that JSON has no word for (NaN, infinite)."""
    if isinstance(value, dict):
        return {key: _as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _say_findings(findings: Sequence[Finding]) -> None:
    """Warnings go to standard error, so that they are seen and results stay readable; notes are for `inspect`.

    What is found in several recordings is told once, where it is worst, with how many others there are.
    """
    warnings: dict[str, list[Finding]] = {}
    for finding in findings:
        if finding.severity != "note":
            warnings.setdefault(finding.name, []).append(finding)
    for alike in warnings.values():
        worst = max(alike, key=_gravity)
        others = f" (and {len(alike) - 1} more like it)" if len(alike) > 1 else ""
        print(f"warning: {worst.sentence}{others}", file=sys.stderr)


def _gravity(finding: Finding) -> float:
    """What makes one of several findings of a name the worst: a number far from 0, or close to it where few is bad."""
    value = abs(finding.value or 0.0)
    return -value if finding.name in ("few-samples", "bursts-not-separable", "no-difference") else value


def _control(timeline: SimulatorTimeline) -> str:
    """How much the conditions differ, which bounds what any controller can do."""
    shares = timeline.fidelities[0].in_simulator
    told = ", ".join(f"{c.label} {share:.2f}" for c, share in zip(timeline.conditions, shares, strict=True))
    said = next((f.sentence for f in timeline.findings if f.name == "difference"), None)
    return f"P(x >= P50) in the simulator at {timeline.start_min[0]:g} min: {told}" + (f"\n{said}" if said else "")
