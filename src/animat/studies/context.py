"""The context study: whether tasks need more than a reflex, and whose work it is, on several cultures."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from animat.coding.mapping import mapping_named
from animat.cultures.series import SELECTION_FILE, STATE_FILE, record_series
from animat.cultures.tissue.parameters import REVISION
from animat.cultures.virtual import VirtualCulture
from animat.errors import AnimatError, InvalidArgument
from animat.evaluation.table import evaluate
from animat.execution.jobs import Job, expect_workers
from animat.execution.receipts import remove_changed
from animat.execution.task import UNFINISHED, Task
from animat.execution.training_task import train_alone
from animat.folders import with_fingerprint
from animat.neurons.timeline import fit_timeline
from animat.progress import EqualPhases, Progress
from animat.reality_gap import Calibration, run_policies
from animat.recordings.reading import read_sources
from animat.records import Positive, Seed, record, write_json
from animat.report.results import ContextRow, LostRow
from animat.responses.extraction import extract_series
from animat.responses.readouts import DEFAULT_READOUTS
from animat.responses.responses import Responses
from animat.robots.host import HostRobot
from animat.robots.registry import robot_named
from animat.stimulation import protocol
from animat.studies.folder import MANIFEST, RECEIPTS, claim_folder
from animat.studies.results import write_records
from animat.studies.run import run_jobs
from animat.studies.specification import EpisodeCount, Resolution
from animat.studies.task import derived_seed
from animat.studies.training import work_on
from animat.training.folder import versions_of
from animat.training.policy import load_policies
from animat.training.settings import Policies
from animat.training.specification import Training

TABLE, WHOSE_WORK = "context.csv", "whose-work.csv"
RECORDINGS, POLICIES, SESSION = "recordings", "policies", "session"
SIMULATED, MEASURED = "simulated.json", "measured.json"
_PACKAGES = ("animat", "jax", "jaxlib", "numpy", "scipy", "optax", "numba")


@record
class ContextStudy:
    """The specification of a context study: its tasks, its virtual cultures, and its size.

    Attributes:
        cultures: seeds of virtual cultures, each recorded as it will run (`protocol_for`).
        robots: names of robots in JAX with one or two commands. Where a robot has no optimal return, its context gap is
            a lower bound (`animat.evaluation.coupling.least_context_gap`).
        policies: number trained for each robot and culture.
        iterations_share: of the robot's default number of iterations.
        episodes: of each policy and control, on the simulator.
        episodes_measured: of each policy, on the culture.
        optimum_resolution: of the grid of the optimal return (`animat.evaluation.optimum`).
        seed: decides every draw of training and evaluation.
    """

    cultures: tuple[Seed, ...] = (1, 2, 3, 4, 5)
    robots: tuple[str, ...] = ("cartpole", "navigation", "swing-up", "shuttle")
    policies: Policies = 4
    iterations_share: Positive = 0.5
    episodes: EpisodeCount = 400
    episodes_measured: EpisodeCount = 5
    optimum_resolution: Resolution = 0.5
    seed: Seed = 1

    def __post_init__(self) -> None:
        for name in ("cultures", "robots"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InvalidArgument(f"{name}: expected at least one, each once, got {values}")
        for name in self.robots:
            robot = robot_named(name)
            if robot.n_commands not in (1, 2) or isinstance(robot, HostRobot):
                raise InvalidArgument(f"robots: expected JAX robots with one or two commands, got {name!r}")


quick_context_study = partial(
    ContextStudy, policies=2, iterations_share=0.1, episodes=30, episodes_measured=1, optimum_resolution=0.25
)
"""All steps at a small scale: a first look, not a result."""


@dataclass(frozen=True)
class ContextTask(Task):
    """A part of the study on the culture of one seed."""

    study: ContextStudy
    culture: int

    @property
    def grows_with(self) -> Mapping[str, object]:
        return {"policies": self.study.policies, "episodes": self.study.episodes}

    def recordings(self, folder: Path, n_commands: int) -> Path:
        """The folder of the culture's recordings for robots with this number of commands."""
        name = RECORDINGS if n_commands == 1 else f"{RECORDINGS}-{n_commands}-commands"
        return folder / f"culture-{self.culture}" / name


@dataclass(frozen=True)
class RecordCulture(ContextTask):
    """Record the culture twice, ten minutes apart, for robots with this number of commands."""

    n_commands: int = 1

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        remove_changed(folder, folder / RECEIPTS, _record_job(self.culture, self.n_commands))
        out, stimuli = self.recordings(folder, self.n_commands), protocol_for(self.n_commands)
        series = record_series(lambda: VirtualCulture(self.culture), stimuli, out, sessions=2, progress=progress)
        return [*series.files, out / STATE_FILE, out / SELECTION_FILE]


@dataclass(frozen=True)
class RobotTask(ContextTask):
    """A part of the study with one robot."""

    robot: str

    @property
    def n_commands(self) -> int:
        return robot_named(self.robot).n_commands

    def series(self, folder: Path) -> list[Responses]:
        """The responses of the culture's recordings on the robot's readouts."""
        recordings = read_sources([self.recordings(folder, self.n_commands)])
        return extract_series(recordings, readouts=DEFAULT_READOUTS[self.n_commands])

    def seed_for(self, purpose: str) -> int:
        """A seed for each culture and robot; otherwise sessions of all would begin at the same few starts."""
        return derived_seed(purpose, self.study.seed, self.robot, str(self.culture))

    def path(self, folder: Path, name: str) -> Path:
        """A file or folder of this robot on this culture."""
        return folder / f"culture-{self.culture}" / self.robot / name


class TrainPolicies(RobotTask):
    """Train the policies as `animat train` does by default, resuming where a killed run stopped."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        robot, timeline = robot_named(self.robot), fit_timeline(self.series(folder))
        training = Training(
            robot=robot,
            mapping=mapping_named("9-thresholds"),
            policies=self.study.policies,
            iterations=int(self.study.iterations_share * robot.paper_iterations),
            seed=self.seed_for("context"),
            shadowing=True,
        ).with_duration_of(timeline)
        checkpoint = folder / UNFINISHED / f"culture-{self.culture}" / f"{self.robot}.npz"
        members = tuple(range(training.policies))
        return train_alone(work_on(training, members, timeline, self.path(folder, POLICIES), checkpoint), progress)


class Judge(RobotTask):
    """Evaluate on the simulator: policies, controls, coupling, optimum, context gap and score, and whose work it is."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        evaluation = evaluate(
            load_policies(self.path(folder, POLICIES)),
            fit_timeline(self.series(folder)),
            episodes=self.study.episodes,
            seed=self.seed_for("judge"),
            optimum_resolution=self.study.optimum_resolution,
            interventions=True,
            progress=EqualPhases(progress, 3),
        )
        return [write_json(self.path(folder, SIMULATED), evaluation.to_dict())]


class Measure(RobotTask):
    """Run in closed loop on the culture from where its recordings ended, controls between the policies' episodes."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        policies = load_policies(self.path(folder, POLICIES))
        calibration = Calibration.of_series(self.series(folder), next(iter(policies.values())))
        session = self.path(folder, SESSION)
        # A session that was killed cannot be resumed: the state of its culture is lost.
        shutil.rmtree(session, ignore_errors=True)
        culture = VirtualCulture(self.culture)
        culture.restore_state(self.recordings(folder, self.n_commands) / STATE_FILE)
        with culture:
            gap = run_policies(
                policies,
                culture,
                calibration,
                session,
                episodes=self.study.episodes_measured,
                with_coupling=True,
                seed=self.seed_for("measure"),
                # Best coupling, prediction, optimal return, closed loop.
                progress=EqualPhases(progress, 4),
            )
        if gap.session.ending.by != "plan":
            raise AnimatError(f"the session ended early: {gap.session.ending.message}; run the study again to continue")
        fields = gap.to_dict()
        # Left out: the session, whose folder and times differ from run to run.
        kept = {name: fields[name] for name in ("robot", "mapping", "rows", "optimum", "verdict", "reasons")}
        return [write_json(self.path(folder, MEASURED), kept)]


def protocol_for(n_commands: int) -> protocol.Protocol:
    """The protocol of recordings for robots with this number of commands, as in `animat record`."""
    return protocol.CLOSED_LOOP if n_commands == 1 else protocol.TWO_COMMANDS


@dataclass(frozen=True)
class ContextRun:
    """Rows of each culture and robot, what was lost by each intervention, and CPU seconds of the jobs of this run."""

    folder: Path
    rows: tuple[ContextRow, ...]
    lost: tuple[LostRow, ...]
    done_now: dict[str, float]


def run_context_study(
    study: ContextStudy,
    folder: str | os.PathLike[str],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> ContextRun:
    """Run the study in a folder, or resume it there; arguments and errors as in `animat.studies.run.run_study`."""
    expect_workers(workers, executor)
    folder = Path(folder).absolute()
    versions = versions_of(_PACKAGES, map(robot_named, study.robots)) | {"virtual tissue": f"revision {REVISION}"}
    manifest = with_fingerprint({"context study": asdict(study), "versions": versions})
    cultures = [f"culture-{culture}" for culture in study.cultures]
    rows: list[ContextRow] = []
    lost: list[LostRow] = []
    with claim_folder(folder, "study", manifest, MANIFEST, {}, (*cultures, RECEIPTS)):
        jobs = plan_context_study(study)
        took_s = run_jobs(jobs, folder, manifest["fingerprint"], progress, workers=workers, executor=executor)
        for robot, culture in product(study.robots, study.cultures):
            files = (folder / f"culture-{culture}" / robot / name for name in (SIMULATED, MEASURED))
            simulated, measured = (json.loads(file.read_text()) for file in files)
            rows.append(_row(culture, robot, simulated, measured))
            # The first row is that of the policies as they are.
            for row in simulated["whose_work"]["rows"][1:]:
                ends = (row["lost"][of] for of in ("value", "low", "high"))
                lost.append(LostRow(culture, robot, row["name"], row["mean_return"], *ends))
        write_records(folder / TABLE, ContextRow, rows)
        write_records(folder / WHOSE_WORK, LostRow, lost)
    return ContextRun(folder, tuple(rows), tuple(lost), took_s)


def plan_context_study(study: ContextStudy) -> list[Job]:
    jobs = []
    commands = {robot: robot_named(robot).n_commands for robot in study.robots}
    for culture in study.cultures:
        records = {n: _record_job(culture, n) for n in sorted({*commands.values()})}
        jobs += [Job(name, RecordCulture(study, culture, n), (), 60) for n, name in records.items()]
        for robot, n in commands.items():
            trained = f"train/{culture}/{robot}"
            jobs += [
                Job(trained, TrainPolicies(study, culture, robot), (records[n],), 30),
                Job(f"judge/{culture}/{robot}", Judge(study, culture, robot), (trained,), 100),
                Job(f"measure/{culture}/{robot}", Measure(study, culture, robot), (trained,), 100),
            ]
    return jobs


def _record_job(culture: int, n_commands: int) -> str:
    return f"record/{culture}" + (f"/{n_commands}-commands" if n_commands > 1 else "")


def _row(culture: int, robot: str, evaluation: dict[str, Any], session: dict[str, Any]) -> ContextRow:
    simulated = {row["name"]: row["mean_return"] for row in evaluation["rows"]}
    measured = {row["name"]: row["measured"] for row in session["rows"]}
    context = evaluation["context"] or {}
    gap, score = context.get("context_gap") or {}, evaluation["context_score"] or {}
    information = evaluation["whose_work"]["rows"][0]["goal_information"]
    return ContextRow(
        culture=culture,
        robot=robot,
        random=simulated["random"],
        heuristic=simulated.get("heuristic"),
        coupling=simulated.get("coupling"),
        policies=simulated["policies"],
        optimum=None if evaluation["optimum"] is None else evaluation["optimum"]["value"],
        best_known=context.get("best_known"),
        gap=gap.get("value"),
        gap_low_95=gap.get("low"),
        gap_high_95=gap.get("high"),
        score=score.get("value"),
        score_low_95=score.get("low"),
        score_high_95=score.get("high"),
        bits=None if information is None else information["bits"]["value"],
        **{f"measured_{name}": measured.get(name) for name in ("random", "heuristic", "coupling")},
        # The first row is that of all policies, or of the only one.
        measured_policies=session["rows"][0]["measured"],
        predicted_policies=session["rows"][0]["predicted"],
    )
