"""What a tuning is: a study of one robot and one arm, and how its settings are searched."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from typing import Annotated, Any

from pydantic import Field

from animat.errors import InvalidArgument, InvalidFile
from animat.records import Seed, Whole, read_record, record
from animat.robots.host import HostRobot
from animat.studies.specification import Episodes, Study
from animat.studies.toml import read_toml, study_from
from animat.training.specification import CHUNKS
from animat.tuning.space import Range, Space, read_space, usual_space


@record
class Tune:
    """How settings are searched: the table `[tune]`.

    Attributes:
        trials: settings that are tried; first the study's own, then the defaults of what is searched of the algorithm.
        together: trials that are decided at once, before any of them is known. It bounds how many can run side by
            side, and the same seed gives the same trials with any number of workers.
        policies: of each trial; what counts is their mean return.
        rungs, keep: successive halving: trials are trained for a share of the whole training, one in `keep` of those
            decided together goes on, and so on; the last of the `rungs` is the whole training. One rung: no halving.
        episodes: of each policy, on the simulator.
        finalists: the best trials that were trained anew, beside the settings tried first, with the study's number of
            policies, other random numbers and fresh episodes; the best of these wins.
        seed: decides every draw of the search, of its trainings and of their episodes.
        search: of each setting a range or choices, as TOML has them; empty: the usual ones.
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
                f"rungs: expected keep^(rungs - 1) to be at most {CHUNKS}, the parts of a training, got "
                f"{self.keep}^{self.rungs - 1}"
            )

    @property
    def chunks(self) -> list[int]:
        """Parts of the training after each rung, of `CHUNKS` after the last."""
        return [max(1, round(CHUNKS / self.keep ** (self.rungs - 1 - rung))) for rung in range(self.rungs)]


@dataclass(frozen=True)
class Tuning:
    """Everything that decides how a tuning comes out, but for recordings in files: how is searched, and what.

    The study is of one robot and one arm, with the settings that the search begins with.
    """

    study: Study
    tune: Tune
    space: Space

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        space = {
            name: {"low": among.low, "high": among.high, "log": among.log} if isinstance(among, Range) else list(among)
            for name, among in self.space.items()
        }
        tune = {name: getattr(self.tune, name) for name in self.tune.__dataclass_fields__}
        return {"study": asdict(self.study), "tune": {**tune, "search": space}}


def tuning_of(study: Study, tune: Tune) -> Tuning:
    """A study and how it is searched, checked together.

    Raises:
        InvalidArgument: for other than one robot and one arm, an arm that is not trained, a body of others, or as
            `read_space` does.
    """
    for what in ("robots", "arms"):
        if (n := len(getattr(study, what))) != 1:
            raise InvalidArgument(f"{what}: expected one [[{what}]] to tune for, got {n}")
    if not study.arms[0].trained:
        raise InvalidArgument("arms.trained: expected an arm that is trained, got one that is not")
    if isinstance(robot := study.robots[0].robot(), HostRobot):
        raise InvalidArgument(
            f"robots: expected one that is stepped in JAX, as trials are trained side by side, got {robot.name}"
        )
    if study.robots[0].lessons or study.arms[0].shadowing == "drawn":
        raise InvalidArgument(
            "robots.lessons: expected none, nor shadowing = 'drawn', as trials are trained side by side; teach "
            "the best settings afterwards with animat train --lessons"
        )
    return Tuning(study, tune, usual_space(study) if tune.search is None else read_space(tune.search, study))


def read_tuning(path: str | os.PathLike[str]) -> Tuning:
    """Read a study's file with a table `[tune]`; errors as those of `animat.studies.toml.read_study`."""
    data = read_toml(path)
    tune = data.pop("tune", {})
    if not data:
        raise InvalidFile(f"{path}: expected the settings of a study beside [tune], such as [[robots]], got none")
    study = study_from(data, path)
    try:
        return tuning_of(study, read_record(Tune, tune, "tune"))
    except InvalidArgument as error:
        raise InvalidFile(f"{path}: {error}") from error
