"""The specification of a tuning: a study of one robot and one arm, and how its settings are searched."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from typing import Annotated, Any

from pydantic import Field

from animat.errors import InvalidArgument, InvalidFile, in_file
from animat.records import Seed, Whole, read_record, record
from animat.robots.host import HostRobot
from animat.studies.specification import Episodes, Study
from animat.studies.toml import read_toml, study_from
from animat.training.specification import CHUNKS
from animat.tuning.space import Range, Space, default_space, read_space


@record
class Tune:
    """How settings are searched: the table `[tune]`.

    Attributes:
        trials: number of settings tried; first the study's own, then the algorithm's defaults of what is searched.
        together: trials proposed as one batch, before the result of any of them is known. It limits how many can run
            side by side, and makes the trials of a seed the same with any number of workers.
        policies: policies per trial, which is judged by their mean return.
        rungs, keep: successive halving: the trials of a batch are trained for a share of the whole training, one in
            `keep` continues, and so on; the last of the `rungs` is the whole training. One rung: no halving.
        episodes: episodes of each policy, on the simulator.
        finalists: number of best trials to retrain, along with the settings tried first, with the study's number of
            policies, different random numbers and fresh episodes; the best of these wins.
        seed: decides every draw of the search, of its trainings and of their episodes.
        search: a range or choices for each setting, as in TOML; None: the default search.
    """

    trials: Annotated[Whole, Field(ge=1, le=10_000)] = 40
    together: Annotated[Whole, Field(ge=1, le=1_000)] = 10
    policies: Annotated[Whole, Field(ge=1, le=100)] = 2
    rungs: Annotated[Whole, Field(ge=1, le=6)] = 3
    keep: Annotated[Whole, Field(ge=2, le=CHUNKS)] = 3
    episodes: Episodes = 100
    finalists: Annotated[Whole, Field(ge=1, le=1_000)] = 3
    seed: Seed = 1
    search: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.keep ** (self.rungs - 1) > CHUNKS:
            raise InvalidArgument(
                f"rungs: expected keep^(rungs - 1) to be at most {CHUNKS}, the chunks of a training, got "
                f"{self.keep}^{self.rungs - 1}"
            )

    @property
    def chunks(self) -> list[int]:
        """Chunks of training done after each rung, `CHUNKS` after the last."""
        return [round(CHUNKS / self.keep ** (self.rungs - 1 - rung)) for rung in range(self.rungs)]


@dataclass(frozen=True)
class Tuning:
    """Everything that determines a tuning's results, except for recordings in files.

    The study has one robot and one arm, and the settings with which the search begins.
    """

    study: Study
    tune: Tune
    space: Space

    def to_dict(self) -> dict[str, Any]:
        """The specification as plain data."""
        space = {name: asdict(of) if isinstance(of, Range) else list(of) for name, of in self.space.items()}
        return {"study": asdict(self.study), "tune": {**asdict(self.tune), "search": space}}


def tuning_of(study: Study, tune: Tune) -> Tuning:
    """A tuning of a study; raises InvalidArgument for a study that cannot be tuned, and as `read_space` does."""
    for name in ("robots", "arms"):
        if (n := len(getattr(study, name))) != 1:
            raise InvalidArgument(f"{name}: expected one [[{name}]] to tune for, got {n}")
    if not study.arms[0].trained:
        raise InvalidArgument("arms.trained: expected an arm that is trained, got one that is not")
    if isinstance(robot := study.robots[0].robot(), HostRobot):
        raise InvalidArgument(
            f"robots: expected one that is stepped in JAX, as trials are trained side by side, got {robot.name}"
        )
    if study.robots[0].lessons or study.arms[0].shadowing == "drawn":
        raise InvalidArgument(
            "robots.lessons: expected neither lessons nor shadowing = 'drawn', as trials are trained side by side; "
            "train with lessons afterwards, with the best settings (animat train --lessons)"
        )
    return Tuning(study, tune, default_space(study) if tune.search is None else read_space(tune.search, study))


def read_tuning(path: str | os.PathLike[str]) -> Tuning:
    """Read a study's file with a table `[tune]`; errors as in `animat.studies.toml.read_study`."""
    data = read_toml(path)
    tune = data.pop("tune", {})
    if not data:
        raise InvalidFile(f"{path}: expected a study's settings in addition to [tune], such as [[robots]], got none")
    study = study_from(data, path)
    with in_file(path):
        return tuning_of(study, read_record(Tune, tune, "tune"))
