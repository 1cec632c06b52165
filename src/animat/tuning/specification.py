"""The specification of a tuning: a study of one robot and one arm, and the space in which its settings are searched."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any

from pydantic import Field

from animat.errors import InvalidArgument, InvalidFile, did_you_mean, in_file, shown, within
from animat.records import Flag, Number, Seed, Whole, read_record, record
from animat.robots.host import HostRobot
from animat.studies.specification import EpisodeCount, Study
from animat.studies.toml import read_specification, study_from
from animat.training.settings import SAC
from animat.training.specification import CHUNKS

NUMBERS = ("learning_rate", "discount", "tau", "reward_scale", "initial_alpha", "target_entropy_ratio", "entropy_nats")
"""Settings that a compiled program takes as numbers: trials that differ only in these share a program."""
_OF_SIMULATORS = {"simulator": "kind", "conditions": "conditions", "readouts": "readouts"}
"""Settings of a study's simulators, and the names of their fields."""
THROUGH_NEURONS = ("mapping", *_OF_SIMULATORS)
FITTING = ("environments", "replay")
"""Settings of the algorithm that depend on each other: one is a multiple of the other."""
SEARCHABLE = (*(field.name for field in fields(SAC)), *THROUGH_NEURONS)
Value = float | int | str
Settings = dict[str, Value]
"""Settings by name: those of the algorithm, and `mapping`, `simulator`, `conditions`, `readouts`."""


@record
class Range:
    """Numbers from `low` to `high`, uniform or, with `log`, uniform in the logarithm; integers for counts.

    The logarithm of a discount is taken of its distance from 1: 0.9 to 0.99 is as far as 0.99 to 0.999.
    """

    low: Number
    high: Number
    log: Flag = False

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InvalidArgument(f"high: expected more than low ({self.low:g}), got {self.high:g}")
        if self.log and self.low <= 0:
            raise InvalidArgument(f"low: expected more than 0 with log = true, got {self.low:g}")

    def __contains__(self, value: object) -> bool:
        return isinstance(value, int | float) and self.low <= value <= self.high


Space = dict[str, Range | tuple[Value, ...]]

DEFAULT: Space = {
    "learning_rate": Range(1e-4, 1e-2, True),
    "discount": Range(0.9, 0.999, True),
    "tau": Range(1e-3, 5e-2, True),
    "reward_scale": Range(0.02, 1.0, True),
    "initial_alpha": Range(0.01, 1.0, True),
    "target_entropy_ratio": Range(0.02, 0.5, True),
    "mapping": ("1-threshold", "9-thresholds", "linear"),
    "simulator": ("histogram", "empirical", "memory"),
}
"""The default search; only what applies to the study is used, widened to include the study's own settings."""


def default_space(study: Study) -> Space:
    """The default search for a study with one robot and one arm."""
    space, own = dict(DEFAULT), own_settings(study)
    if not study.arms[0].through_neurons:
        space = {name: among for name, among in space.items() if name not in THROUGH_NEURONS}
        if study.robots[0].robot().baseline_commands is None:
            del space["target_entropy_ratio"]
            space["entropy_nats"] = Range(-3.0, 0.5)
    for name, among in space.items():
        value: Any = own[name]
        if isinstance(among, Range):
            # A range that reaches 0 has no logarithm, and is searched uniformly.
            low, high = min(among.low, value), max(among.high, value)
            space[name] = Range(low, high, among.log and low > 0 and not (name == "discount" and high == 1))
        elif value not in among:
            space[name] = (value, *among)
    return space


def read_space(table: Mapping[str, Any], study: Study) -> Space:
    """The search of a file's `[tune.search]`: tables `{ low, high, log }` and lists of choices, by name.

    Raises InvalidArgument for a setting that cannot be searched, an invalid range or list of choices, a value that the
    setting cannot have, or a search that does not include the study's own setting, with which it begins.
    """
    if not table:
        raise InvalidArgument("tune.search: expected at least one setting to search for, got none")
    space: Space = {}
    own = own_settings(study)
    for name, among in table.items():
        where = f"tune.search.{name}"
        if name not in SEARCHABLE:
            near = did_you_mean(name, SEARCHABLE) or f"; there are {', '.join(SEARCHABLE)}"
            raise InvalidArgument(f"tune.search: expected names of settings, got {shown(name)}{near}")
        if name in THROUGH_NEURONS and not study.arms[0].through_neurons:
            raise InvalidArgument(f"{where}: expected none without neurons (mapping = 'none')")
        if isinstance(among, dict):
            if name in (*THROUGH_NEURONS, *FITTING):
                raise InvalidArgument(f"{where}: expected a list of choices, got a table")
            space[name] = read_record(Range, among, where)
            if name == "discount" and among.get("log") and among["high"] == 1:
                raise InvalidArgument(f"{where}: expected high below 1 with log = true, got 1")
        elif isinstance(among, list) and len(among) > 1 and all(each not in among[:i] for i, each in enumerate(among)):
            space[name] = tuple(_as_in_study(each, own[name]) for each in among)
        else:
            raise InvalidArgument(
                f"{where}: expected a range {{ low = ..., high = ... }} or a list of two or more different choices, "
                f"got {shown(among)}"
            )
        if name not in FITTING:
            _expect_possible(study, name, space[name], where)
        if own[name] not in space[name]:
            remedy = f"{'widen the range' if isinstance(among, dict) else 'add it'}, or change {name} in the study"
            raise InvalidArgument(
                f"{where}: expected it to include the study's own setting, {own[name]!r}, which is tried first; got "
                f"{shown(among)}: {remedy}"
            )
    for chosen in itertools.product(*(choices_of(name, space, study) for name in FITTING)):
        with within("tune.search"):
            with_settings(study, dict(zip(FITTING, chosen, strict=True)))
    return space


def _expect_possible(study: Study, name: str, among: Range | tuple[Value, ...], where: str) -> None:
    """Refuse a search with settings that the study could not run with; of a range its ends are checked."""
    for value in (among.low, among.high) if isinstance(among, Range) else among:
        with within(where):
            if name == "mapping" and value == "none":
                raise InvalidArgument("expected mappings, got 'none': tune policies without neurons separately")
            with_settings(study, {name: _as_in_study(value, own_settings(study)[name])})


def _as_in_study(value: Any, own: Any) -> Any:
    """A number as an integer if the study's own value is one: TOML may have 64.0 for a count."""
    return int(value) if isinstance(value, float) and isinstance(own, int) and value.is_integer() else value


def own_settings(study: Study) -> dict[str, Any]:
    """The values of all searchable settings in a study of one robot and one arm."""
    return {
        **asdict(SAC(**study.algorithm)),  # type: ignore[arg-type]
        "mapping": study.arms[0].mapping,
        **{name: getattr(study.simulators, field) for name, field in _OF_SIMULATORS.items()},
    }


def choices_of(name: str, space: Space, study: Study) -> tuple[Any, ...]:
    """The choices of a setting; only the study's own if it is not searched."""
    among = space.get(name)
    return among if isinstance(among, tuple) else (own_settings(study)[name],)


def first_settings(study: Study, space: Space) -> list[Settings]:
    """The first settings to try: the study's own, and the algorithm's defaults if they differ and are in the search."""
    own = own_settings(study)
    defaults = {**own, **asdict(SAC())}
    first, second = ({name: settings[name] for name in space} for settings in (own, defaults))
    is_searched = all(value in space[name] for name, value in second.items())
    return [first, second] if is_searched and second != first else [first]


def with_settings(study: Study, settings: Mapping[str, Value]) -> Study:
    """The study with changed settings; raises InvalidArgument for a value that a setting cannot have."""
    changed: dict[str, Any] = dict(settings)
    arm = replace(study.arms[0], mapping=changed.pop("mapping", study.arms[0].mapping))
    fields_changed = {field: changed.pop(name) for name, field in _OF_SIMULATORS.items() if name in changed}
    simulators = replace(study.simulators, **fields_changed)
    return replace(study, arms=(arm,), simulators=simulators, algorithm={**study.algorithm, **changed})


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
    episodes: EpisodeCount = 100
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
    """All that determines a tuning's results but recordings in files; the study has one robot and one arm."""

    study: Study
    tune: Tune
    space: Space

    def to_dict(self) -> dict[str, Any]:
        space = {name: asdict(of) if isinstance(of, Range) else list(of) for name, of in self.space.items()}
        return {"study": asdict(self.study), "tune": {**asdict(self.tune), "search": space}}


def tuning_of(study: Study, tune: Tune) -> Tuning:
    """A tuning of a study; raises InvalidArgument for a study that cannot be tuned, and as `read_space` does."""
    for name in ("robots", "arms"):
        if (n := len(getattr(study, name))) != 1:
            raise InvalidArgument(f"{name}: expected one [[{name}]] to tune for, got {n}")
    for name in ("seeds", "folders"):
        if got := getattr(study.culture, name):
            raise InvalidArgument(f"culture.{name}: expected one culture to tune for, got {got!r}")
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
    data = read_specification(path)
    tune = data.pop("tune", {})
    if not data:
        raise InvalidFile(f"{path}: expected a study's settings in addition to [tune], such as [[robots]], got none")
    study = study_from(data, path)
    with in_file(path):
        return tuning_of(study, read_record(Tune, tune, "tune"))
