"""The command that trains policies on recordings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from animat.cli.command import (
    JobOptions,
    SimulatorOptions,
    print_warnings,
    read_numbers,
    read_sac,
    robot_for,
    warnings_of,
)
from animat.errors import InvalidArgument, UnusableData, counted, expect_at_least, in_file, in_min
from animat.recordings.findings import Finding
from animat.records import as_json
from animat.writing import expect_writable

if TYPE_CHECKING:
    from animat.neurons.timeline import SimulatorTimeline
    from animat.responses.readouts import Readouts
    from animat.training.policy import Policy
    from animat.training.specification import Training


@dataclass(frozen=True)
class Train(SimulatorOptions, JobOptions):
    """Train policies for a robot on the simulators of a culture's recordings. Resumes where it stopped."""

    robot: Positional[str] = "cartpole"
    """The robot to drive: cartpole, navigation, swing-up, shuttle, arm, wheels, detour, your own, such as
    my_package.robots:Rover, or any of Gymnasium's, gymnasium:Reacher-v5"""
    recordings: tuple[Path, ...] = ()
    """Files or folders of recordings of one culture"""
    paper: bool = False
    """The paper's setting: 1-threshold, histogram, 10 policies, 60 minutes; default: what works in a closed loop"""
    mapping: str | None = None
    """From responses to motor commands: 1-threshold, 9-thresholds, linear, or your own, such as
    my_package.mappings:Steep; none: the baseline without neurons; default: 9-thresholds, with --paper 1-threshold"""
    readouts: str | None = None
    """Groups of channels, each for one command: all channels as one; halves or quadrants of the array; or a file of
    groups of electrodes, {"left": [1, 2], "right": [3, 4]}; default: for one, two or four commands all, halves or
    quadrants"""
    policies: int | None = None
    """Number of policies, each with its own random numbers; default: 4, with --paper 10"""
    iterations: int | None = None
    """Training iterations of each policy; default: 400000 for cartpole, 500000 for swing-up, 1000000 for arm and
    detour, 250000 for others, with --paper twice as many"""
    seed: int = 1
    """Decides every random draw"""
    shadowing: Literal["on", "off", "drawn"] = "on"
    """on: refresh the simulators during training (parameter shadowing); off: the first one throughout; drawn: each
    episode draws one of those that would have been used"""
    duration_min: float | None = None
    """Minutes of the culture's clock that training represents; default: to one interval after the last recording;
    with --paper 60"""
    percentiles: Literal["moving", "first"] = "moving"
    """The mapping's percentiles move with the simulator, or are fixed by the first recording"""
    delivery: Literal["chosen", "shuffled"] = "chosen"
    """shuffled: the paper's control, the delivered condition is drawn at random whatever the policy chose"""
    goal: str | None = None
    """A goal that replaces the robot's own task: "avoid pole_angle outside -12..12 deg; drive cart_position in
    -0.1..0.1 m within 20"; also reach, minimize, maximize"""
    parameters: tuple[str, ...] = ()
    """Parameters of the robot that replace its defaults, such as pole_mass_kg=0.55"""
    sac: tuple[str, ...] = ()
    """Settings of the algorithm that replace its defaults, such as discount=0.98 learning_rate=3e-4"""
    neural_observation: bool = False
    """Policies also see what the neurons remember: trace and load of the last stimuli and responses"""
    pulse_cost: float = 0.0
    """Cost of each electrode pulse, in the units of the reward: policies are trained on the rewards less the cost.
    For conditions that differ in how many electrodes they pulse (animat record --places FILE)"""
    lessons: Path | None = None
    """A TOML file of successive lessons: ranges of parameters, starts and recordings, and when to advance"""
    assess: int | None = None
    """Episodes of an assessment after each sixtieth of the training; the best policies so far are kept in OUT/best;
    default: none, but 20 where lessons say when to advance"""
    tensorboard: Path | None = None
    """Folder for TensorBoard: live learning curves, one run per policy; needs animat[tensorboard]"""
    out: Path = Path("policies")
    """Folder for the policies"""

    def run(self) -> dict[str, Any]:
        from animat.execution.training import train
        from animat.report.tensorboard import TensorBoard
        from animat.training.folder import MANIFEST, expect_folder_for, expect_trainable, is_finished

        # Check what can be checked before recordings are read, which can take a while.
        expect_at_least("--workers", self.workers, 1)
        if not self.out.is_dir():
            expect_writable(self.out)
        training, readouts = self._training()
        board = nullcontext() if self.tensorboard is None else TensorBoard(self.tensorboard)
        expect_trainable(training, is_saved=True)
        expect_folder_for(training, self.out)
        self.print_caveats([training.robot])
        timeline = None if training.mapping is None else self._timeline(readouts)
        training.environment_on(timeline)
        unused = () if timeline is None else training.unused_recordings(timeline)
        print_warnings(unused)
        was_finished = is_finished(training, self.out)
        if timeline is not None:
            print(_controllability(timeline))
        # Not for a resumed training, which has already reported it.
        random = None if (self.out / MANIFEST).exists() else _random_return(training, timeline)
        with self.executing("training") as execution, board as on_row:
            trained = train(
                training,
                timeline,
                self.out,
                sources=[str(path) for path in self.recordings],
                random_return=random,
                callbacks=() if on_row is None else (on_row,),
                **execution,
            )
        if was_finished:
            print(f"this training is already finished; the policies in {self.out} are unchanged")
        return self._report(trained, timeline, unused)

    def _training(self) -> tuple[Training, str | Readouts]:
        from animat.coding.decoder import expect_readout_per_command
        from animat.coding.mapping import mapping_named
        from animat.responses.readouts import ALL, DEFAULT_READOUTS, count_readouts, read_readouts
        from animat.training.lessons import check_lessons, read_lessons
        from animat.training.specification import Training

        parameters = read_numbers("--parameters", self.parameters)
        try:
            robot = robot_for(self.robot, self.goal, **parameters)
        except InvalidArgument as error:
            # Only messages about its parameters begin with the robot's name.
            if not parameters or not str(error).startswith(f"{self.robot}: "):
                raise
            raise InvalidArgument(f"--parameters: {error}") from error
        usual = _PAPER if self.paper else _USUAL
        mapping = self.mapping or usual["mapping"]
        usual_readouts = "all" if mapping == "none" else DEFAULT_READOUTS.get(robot.n_commands, "all")
        readouts = read_readouts(self.readouts or usual_readouts)
        if mapping != "none":
            expect_readout_per_command(robot.name, robot.n_commands, count_readouts(readouts))
        elif readouts != ALL:
            raise InvalidArgument(f"--readouts: expected none without neurons, got {self.readouts}")
        else:
            self.expect_no_simulator("without neurons")
        lessons = () if self.lessons is None else read_lessons(self.lessons)
        with in_file(self.lessons or ""):
            check_lessons(lessons, robot, draws_recordings=self.shadowing == "drawn")
        training = Training(
            robot=robot,
            mapping=None if mapping == "none" else mapping_named(mapping),
            policies=usual["policies"] if self.policies is None else self.policies,
            iterations=usual["share"] * robot.paper_iterations // 100 if self.iterations is None else self.iterations,
            seed=self.seed,
            shadowing="drawn" if self.shadowing == "drawn" else self.shadowing == "on",
            duration_min=usual["duration_min"] if self.duration_min is None else self.duration_min,
            percentiles=self.percentiles,
            delivery=self.delivery,
            commands=robot.baseline_commands if mapping == "none" else None,
            algorithm=read_sac(self.sac),
            neural_observation=self.neural_observation,
            pulse_cost=self.pulse_cost,
            lessons=lessons,
            assess=self.assess,
        )
        return training, readouts

    def _timeline(self, readouts: str | Readouts) -> SimulatorTimeline:
        fitting = replace(self, simulator="histogram") if self.paper and self.simulator is None else self
        timeline = fitting.timeline(self.recordings, readouts=readouts)
        if len(timeline.conditions) < 2 and "one-condition" not in self.allow:
            raise UnusableData(
                "--conditions: expected two or more for an agent to choose from, got one "
                f"({timeline.conditions[0].label}); sort the stimuli by frequency, interval:5,10, electrode or pattern "
                "(to allow it: --allow one-condition)"
            )
        return timeline

    def _report(
        self, trained: dict[str, Policy], timeline: SimulatorTimeline | None, findings: tuple[Finding, ...]
    ) -> dict[str, Any]:
        """Print and return how good the policies are compared with random actions, and their assessments."""
        from animat.evaluation.table import evaluate

        first = next(iter(trained.values()))
        until = None if timeline is None else first.trained_until_min(float(timeline.start_min[0]))
        evaluation = evaluate(trained, timeline, at_min=until, controls=("random",))
        print_warnings(evaluation.findings)
        policies, control = (row.to_dict() for row in evaluation.rows)
        of = "net_return" if self.pulse_cost else "mean_return"
        if self.delivery == "chosen" and policies[of] <= control[of]:
            means = f"{policies[of]:.1f} against {control[of]:.1f}"
            steer = "" if timeline is None else ", or see whether the culture can be steered (animat validate)"
            remedy = f"train longer (--iterations){steer}"
            message = f"the policies are no better than random actions ({means}): {remedy}"
            findings += (Finding("no-better-than-random", "warning", message),)
            print_warnings(findings[-1:])
        on = "" if evaluation.recorded_at_min is None else f" on the simulator at {in_min(evaluation.recorded_at_min)}"
        error = "" if policies["standard_error"] is None else f" (standard error {policies['standard_error']:.1f})"
        mean, at_random = f"{policies['mean_return']:.1f}{error}", f"{control['mean_return']:.1f}"
        made = f"{counted(len(trained), 'policy', 'policies')} in {self.out}"
        print(f"{made}; mean return{on}: {mean}, of random actions {at_random}")
        if self.pulse_cost:
            net, pulses = f"{policies['net_return']:.1f}", f"{policies['electrode_pulses']:.1f}"
            print(
                f"less {self.pulse_cost:g} for each electrode pulse ({pulses} per episode): {net}, of random actions "
                f"{control['net_return']:.1f} ({control['electrode_pulses']:.1f})"
            )
        assessed = {name: _assessed(policy, policy.best) for name, policy in trained.items() if policy.best is not None}
        for name, assessment in assessed.items():
            print(f"{name}: {_in_words(assessment)}")
        return {
            "policies": [str(self.out / f"{name}.safetensors") for name in trained],
            "returns": dict(zip(evaluation.names, policies["mean_returns"], strict=True)),
            "random": control["mean_return"],
            **{name: policies[name] for name in ("electrode_pulses", "net_return")},
            "recorded_at_min": evaluation.recorded_at_min,
            "findings": [each.to_dict() for each in (*warnings_of(timeline), *findings, *evaluation.findings)],
            **({"assessed": assessed} if assessed else {}),
        }


_USUAL: dict[str, Any] = {"mapping": "9-thresholds", "policies": 4, "share": 50, "duration_min": None}
"""Settings that work in a closed loop; `share` of the paper's iterations, in per cent."""
_PAPER: dict[str, Any] = {"mapping": "1-threshold", "policies": 10, "share": 100, "duration_min": 60.0}


def _random_return(training: Training, timeline: SimulatorTimeline | None) -> float | None:
    """The mean return of random actions on the first simulator; None for a robot that is stepped outside JAX."""
    from animat.compilation import keep_compilations
    from animat.evaluation.rollouts import Uniform, roll_out
    from animat.robots.host import HostRobot

    if isinstance(training.robot, HostRobot):
        return None
    keep_compilations()
    environment = training.environment(0 if timeline is None else len(timeline.conditions))
    simulator = None if timeline is None else timeline.at(float(timeline.start_min[0]))
    # As many episodes as in the final evaluation, which then reuses the compiled program.
    returns = roll_out(environment, simulator, Uniform(), episodes=100, seed=1).returns
    low, high = training.robot.return_range
    # Up to rounding in float32.
    beyond = returns[(returns < low - 1e-3 * (1 + abs(low))) | (returns > high + 1e-3 * (1 + abs(high)))]
    if len(beyond):
        raise InvalidArgument(
            f"{training.robot.name}.return_range: expected the lowest and highest return of an episode, got {low:g} "
            f"to {high:g}, and an episode of random actions returned {beyond[0]:g}"
        )
    return float(returns.mean())


def _assessed(policy: Policy, best: Policy) -> dict[str, Any]:
    """The iterations after which a policy began each lesson, and its best assessment."""
    from animat.training.course import ASSESSED

    table = policy.assessments
    began = {int(row[2]): int(before) for row, before in zip(table[::-1], [*table[-2::-1, 0], 0], strict=True)}
    lessons = [{"lesson": lesson, "after_iterations": began[lesson]} for lesson in sorted(began)]
    columns = dict(zip(ASSESSED, best.assessments[-1].tolist(), strict=True))
    whole = {name: int(columns[name]) for name in ("iterations", "lesson")}
    return {"lessons": lessons, "best": as_json(columns | whole)}


def _in_words(assessed: dict[str, Any]) -> str:
    best, (_, *later) = assessed["best"], assessed["lessons"]
    success = "" if best["success"] is None else f"{best['success']:.0%} succeeded, "
    lessons = "".join(f"; lesson {each['lesson']} after {each['after_iterations']:,}" for each in later)
    after, reached = f"{best['iterations']:,.0f} iterations", f"{success}return {best['mean_return']:.1f}"
    return f"best after {after} ({reached}){lessons}"


def _controllability(timeline: SimulatorTimeline) -> str:
    """How much the conditions differ, which bounds what any controller can do."""
    shares, names = timeline.fidelities[0].in_simulator, timeline.readouts.names
    if len(names) == 1:
        text = ", ".join(f"{c.label} {share:.2f}" for c, share in zip(timeline.conditions, shares, strict=True))
    else:
        rows = (" ".join(f"{n} {p:.2f}" for n, p in zip(names, row, strict=True)) for row in shares)
        text = ", ".join(f"{c.label}: {row}" for c, row in zip(timeline.conditions, rows, strict=True))
    at = f"in the simulator at {in_min(timeline.start_min[0])}"
    first = f"P(x >= P50), the share of responses that reach the median, {at}: {text}"
    found = [finding.message for finding in timeline.findings if finding.name == "difference"]
    difference = [f"in the recording, before the simulator draws from it, {message}" for message in found[:1]]
    return "\n".join([first, *difference, *_memories(timeline)])


def _memories(timeline: SimulatorTimeline) -> Iterator[str]:
    import numpy as np

    from animat.neurons.history import NO_MEMORY
    from animat.neurons.memory import MemorySimulator

    for start_min in timeline.start_min.tolist():
        simulator = timeline.at(start_min)
        if isinstance(simulator, MemorySimulator):
            decay, weight, _, load_s = memory = simulator.memory
            near, total = (int(np.median(counts)) for counts in (simulator.nearest, simulator.followers))
            load = f". It also depends on the amount of stimulation in the last {load_s:g} s" if load_s else ""
            share = f"each trial counts {decay:.2g} times as much as the one after it"
            if weight < 0:
                less = f"{-weight:.2g} times the mean rank of its condition is subtracted from the rank of its response"
                earlier = (
                    f"earlier trials, where {share}, and {less}" if decay else f"the trial before it, where {less}"
                )
            else:
                counts = f"{weight:.2g} times as much as its response"
                earlier = f"the trial before it, whose stimulus counts {counts}"
                earlier = f"earlier trials, where {share}, and its stimulus {counts}" if decay else earlier
            text = (
                f"a response depends on {earlier}{load}. The simulator "
                f"draws from the {near} responses with the most similar history, out of {total:,} per condition"
            )
            yield f"memory at {in_min(start_min)}: {'none was found' if memory == NO_MEMORY else text}"
