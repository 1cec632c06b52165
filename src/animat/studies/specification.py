"""What a study is: recordings or a culture, robots, conditions, comparisons, how often and from which seeds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal

from animat.coding.mapping import MAPPING_NAMES
from animat.cultures.series import LONGEST_MIN
from animat.errors import InvalidArgument, shown
from animat.recordings.made_up import MadeUpCulture
from animat.robots.base import MOST_AT_ONCE, Robot
from animat.robots.registry import is_ours, place_of, robot_named
from animat.stimulation.protocol import Protocol
from animat.studies.bounds import (
    MOST_PRESENTATIONS,
    MOST_SESSIONS,
    check_algorithm,
    check_name,
    expect_at_once,
    expect_choices,
    expect_counts,
    expect_positive,
    expect_resolution,
    expect_seed,
    expect_trained,
    expect_unlike,
)
from animat.training.bounds import MOST_ITERATIONS, MOST_POLICIES

MAPPINGS = (*MAPPING_NAMES, "none")
"""Names of mappings that a condition may have; none is the baseline without neurons."""


@dataclass(frozen=True)
class Source:
    """Where the recordings come from: files, or a culture that is recorded for the study.

    Attributes:
        kind: `"virtual"`, simulated neurons; `"made-up"`, responses of known distributions, for trials; `"files"`.
        files: recordings of one culture, or folders of them, for `"files"`; relative to the specification.
        seed: which virtual or made-up culture.
        sessions, interval_min: how many recordings, and the minutes from one to the next.
        order, pulses, presentations: how stimuli are presented (`animat.stimulation.protocol`).
        channels: of a made-up culture.
    """

    kind: Literal["virtual", "made-up", "files"] = "virtual"
    files: tuple[str, ...] = ()
    seed: int = 1
    sessions: int = 15
    interval_min: float = 10.0
    order: Literal["blocked", "mixed"] = "blocked"
    pulses: int = 1
    presentations: int = 100
    channels: int = 256

    def __post_init__(self) -> None:
        if (self.kind == "files") != bool(self.files):
            raise InvalidArgument(f"culture.files: expected some for kind = 'files' only, got {len(self.files)}")
        expect_choices("culture", self)
        expect_seed("culture.seed", self.seed)
        expect_counts(
            "culture",
            self,
            sessions=(1, MOST_SESSIONS),
            pulses=(1, MOST_PRESENTATIONS),
            presentations=(2, MOST_PRESENTATIONS),
            channels=(1, 1024),
        )
        expect_positive("culture.interval_min", self.interval_min)
        if self.sessions * self.interval_min > LONGEST_MIN:
            raise InvalidArgument(
                f"culture.sessions, culture.interval_min: expected recordings within a year, got {self.sessions} every "
                f"{self.interval_min:g} min"
            )
        for file in self.files:
            if not file or not file.isprintable():
                raise InvalidArgument(f"culture.files: expected names of files, got {shown(file)}")
        if self.kind == "files":
            for each in fields(self):
                if each.name not in ("kind", "files") and getattr(self, each.name) != each.default:
                    raise InvalidArgument(
                        f"culture.{each.name}: expected only for a culture that is recorded, got one of files"
                    )
        if self.kind == "made-up" and (self.order, self.pulses) != ("blocked", 1):
            raise InvalidArgument("culture.order: a made-up culture is recorded blocked with one pulse, got otherwise")
        # What the recordings themselves refuse is refused before there is a folder.
        try:
            if self.kind == "virtual":
                Protocol(order=self.order, pulses=self.pulses, presentations=self.presentations)
            elif self.kind == "made-up":
                MadeUpCulture(self.seed, patterns=self.presentations, channels=self.channels)
        except InvalidArgument as error:
            raise InvalidArgument(f"culture.{error}") from error


@dataclass(frozen=True)
class Simulators:
    """How responses are read and neuron simulators made of them; as the options of `animat train`.

    Attributes:
        kind, bins, range_hz: of the simulators; by default 20 bins with edges at each recording's own percentiles.
        conditions: what the agent picks from, such as `frequency` or `interval:5,10+-25%`; empty: by frequency.
        window_ms: start and end of the response window.
        burst_threshold: share of active channels above which a response is a burst; None: Otsu's, where there are two
            groups.
        allow: findings to go on in spite of.
    """

    kind: Literal["histogram", "empirical", "memory"] = "histogram"
    bins: int = 20
    range_hz: float | None = None
    conditions: str = ""
    window_ms: tuple[float, float] = (2.0, 10.0)
    burst_threshold: float | None = None
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        from animat.neurons.simulator import LARGEST_BINS
        from animat.responses.conditions import conditions_named
        from animat.responses.series import check_allowed
        from animat.responses.windows import check_window

        # All before anything is recorded: whoever corrects it later needs another folder.
        expect_choices("simulators", self)
        if not 1 <= self.bins <= LARGEST_BINS:
            raise InvalidArgument(f"simulators.bins: expected 1 to {LARGEST_BINS}, got {self.bins}")
        if self.range_hz is not None:
            expect_positive("simulators.range_hz", self.range_hz)
        if self.burst_threshold is not None and not 0 <= self.burst_threshold <= 1:
            raise InvalidArgument(
                f"simulators.burst_threshold: expected a share of channels from 0 to 1, got {self.burst_threshold:g}"
            )
        try:
            check_window(self.window_ms)
            check_allowed(self.allow)
            if self.conditions:
                conditions_named(self.conditions)
        except InvalidArgument as error:
            raise InvalidArgument(f"simulators.{error}") from error


@dataclass(frozen=True)
class Body:
    """A robot of the study.

    Attributes:
        name: what it is called in tables and folders; where it is a robot's own (`animat.robots.robot_named`), no more
            need be said.
        kind: the robot's own name, where this one is another, such as of two cartpoles with different parameters; or
            where to import it from, `my_package.robots:Rover`, which is filled in for robots that are not ours.
        iterations: of training, for each policy; None: the paper's.
        parameters: in place of its defaults, such as `pole_mass_kg`.
        limit_resolution: of its best possible return, in place of the study's.
    """

    name: str
    iterations: int | None = None
    limit_resolution: float | None = None
    parameters: dict[str, float] = field(default_factory=dict)
    kind: str = ""

    def __post_init__(self) -> None:
        if self.iterations is not None:
            expect_counts("robots", self, iterations=(1, MOST_ITERATIONS))
        if self.limit_resolution is not None:
            expect_resolution("robots.limit_resolution", self.limit_resolution)
        robot = self.robot()
        check_name("robots.name", self.name)
        if self.name == "culture":
            raise InvalidArgument("robots.name: expected another name than the culture's figures have, got 'culture'")
        if not is_ours(robot):
            # Workers know it by that.
            object.__setattr__(self, "kind", place_of(type(robot)))

    def robot(self) -> Robot[Any]:
        """The robot itself."""
        return robot_named(self.kind or self.name, **self.parameters)

    @property
    def trained_for(self) -> int:
        """Iterations of training."""
        return self.robot().paper_iterations if self.iterations is None else self.iterations


@dataclass(frozen=True)
class StudyCondition:
    """One way to train policies, on each robot.

    Attributes:
        name: what it is called in tables and folders.
        mapping: from responses to commands; `"none"` is the baseline without neurons.
        shadowing: whether simulators are refreshed during training.
        delivery: `"shuffled"`: the delivered stimulus is drawn at random in training and evaluation (the control).
        percentiles: of the mapping: `"moving"` with the simulator, or held from the `"first"` recording.
        trained: false for policies as they are before training.
    """

    name: str
    mapping: str = "1-threshold"
    shadowing: bool = True
    delivery: Literal["chosen", "shuffled"] = "chosen"
    percentiles: Literal["moving", "first"] = "moving"
    trained: bool = True

    def __post_init__(self) -> None:
        check_name("conditions.name", self.name)
        expect_choices("conditions", self)
        if self.mapping not in MAPPINGS:
            raise InvalidArgument(f"conditions.mapping: expected one of {', '.join(MAPPINGS)}, got {self.mapping!r}")

    @property
    def slug(self) -> str:
        """The name as a folder's."""
        return self.name.lower().replace(" ", "-")

    @property
    def through_neurons(self) -> bool:
        """Whether there are neurons in it."""
        return self.mapping != "none"

    @property
    def learns_one_recording(self) -> bool:
        """Whether its policies learn what they choose to do with the first recording, and with no other."""
        return self.trained and self.through_neurons and not self.shadowing and self.delivery == "chosen"


@dataclass(frozen=True)
class Compared:
    """Two conditions that are compared on every robot, by the policies' mean returns.

    Attributes:
        name: of the comparison.
        first, second: names of conditions; the second is the one expected to be better.
        at_min: minute of the recording that they are evaluated on, the nearest to it; None: the last recording.
        episodes: of each policy.
    """

    name: str
    first: str
    second: str
    at_min: float | None = None
    episodes: int = 100

    def __post_init__(self) -> None:
        check_name("comparisons.name", self.name)
        if self.first == self.second:
            raise InvalidArgument(
                f"comparisons.second: expected another condition than the first, got {self.second!r} twice in "
                f"{self.name!r}"
            )
        expect_counts("comparisons", self, episodes=(1, MOST_AT_ONCE))
        if self.at_min is not None and not math.isfinite(self.at_min):
            raise InvalidArgument(f"comparisons.at_min: expected finite minutes, got {self.at_min:g}")


@dataclass(frozen=True)
class Study:
    """Everything that decides how a study comes out, but for the recordings in files.

    Attributes:
        title: of the report.
        culture: the recordings.
        simulators: how responses are read and fitted.
        robots, conditions, comparisons: what is trained and what is compared.
        policies: of each condition on each robot.
        seed: decides every draw of training and evaluation.
        training_min: minutes of the culture's clock that a training stands for.
        episodes: of each policy where no comparison says otherwise, and of controls.
        episodes_over_time: of each policy at every recording.
        actions: how policies act when they are evaluated: the most probable one, or drawn as in training.
        limit_resolution: steps of the grid of the best possible return, as a multiple; 0.6 is fast and rough.
        limit_episodes: episodes in which that controller's return is checked.
        algorithm: settings of `animat.training.sac.SAC` in place of its defaults.
        paper: whether the paper's own figures are printed beside comparisons of the same name and robot.

    Raises:
        InvalidArgument: naming the setting, what was expected and what came.
    """

    title: str = "Study"
    culture: Source = field(default_factory=Source)
    simulators: Simulators = field(default_factory=Simulators)
    robots: tuple[Body, ...] = (Body("cartpole"), Body("navigation"))
    conditions: tuple[StudyCondition, ...] = (StudyCondition("1 threshold"),)
    comparisons: tuple[Compared, ...] = ()
    policies: int = 10
    seed: int = 1
    training_min: float = 60.0
    episodes: int = 100
    episodes_over_time: int = 30
    actions: Literal["most probable", "drawn"] = "most probable"
    limit_resolution: float = 1.0
    limit_episodes: int = 4000
    algorithm: dict[str, float] = field(default_factory=dict)
    paper: bool = False

    def __post_init__(self) -> None:
        for what in ("robots", "conditions"):
            if not getattr(self, what):
                raise InvalidArgument(f"{what}: expected at least one, got none")
        expect_unlike("robots", [body.name for body in self.robots])
        expect_unlike("conditions", [condition.slug for condition in self.conditions])
        expect_unlike("comparisons", [compared.name for compared in self.comparisons])
        expect_choices("", self)
        expect_seed("seed", self.seed)
        expect_counts(
            "",
            self,
            policies=(1, MOST_POLICIES),
            episodes=(1, MOST_AT_ONCE),
            episodes_over_time=(1, MOST_AT_ONCE),
            limit_episodes=(2, MOST_AT_ONCE),
        )
        for name, episodes in (
            ("episodes", self.episodes),
            ("episodes_over_time", self.episodes_over_time),
            *(("comparisons.episodes", compared.episodes) for compared in self.comparisons),
        ):
            expect_at_once(name, episodes, self.policies)
        expect_trained(len(self.robots) * len(self.conditions) * self.policies)
        expect_positive("training_min", self.training_min)
        expect_resolution("limit_resolution", self.limit_resolution)
        known = [condition.name for condition in self.conditions]
        for compared in self.comparisons:
            for side in ("first", "second"):
                name = getattr(compared, side)
                if name not in known:
                    raise InvalidArgument(
                        f"comparisons.{side}: expected one of the conditions {', '.join(known)}, got {name!r} in "
                        f"{compared.name!r}"
                    )
        if self.culture.kind != "files" and self.needs_neurons:
            for compared in self.comparisons:
                self._minute_of(compared, [i * self.culture.interval_min for i in range(self.culture.sessions)])
        if self.algorithm:
            check_algorithm(self.algorithm)

    def condition(self, name: str) -> StudyCondition:
        """The condition of this name."""
        return next(condition for condition in self.conditions if condition.name == name)

    def minutes_of(self, condition: StudyCondition, first_min: float, last_min: float) -> dict[float, int]:
        """Minutes that a condition is evaluated at, and in how many episodes: of its comparisons, and the last.

        If it is trained on the first recording alone, also that one: how well did it learn what it was taught?
        """
        minutes: dict[float, int] = {}
        for compared in self.comparisons:
            if condition.name in (compared.first, compared.second):
                at = last_min if compared.at_min is None else compared.at_min
                minutes[at] = max(minutes.get(at, 0), compared.episodes)
        minutes.setdefault(last_min, self.episodes)
        if condition.learns_one_recording:
            minutes[first_min] = max(minutes.get(first_min, 0), self.episodes)
        return minutes

    def at_recordings(self, start_min: Sequence[float]) -> Study:
        """The same study with every comparison at the minute of a recording: the nearest to its own, or the last.

        Args:
            start_min: when the recordings start, rising; none without neurons, where every minute is the same.

        Raises:
            InvalidArgument: for a comparison before the first recording, or after the last by more than an interval.
        """
        settled = (replace(each, at_min=self._minute_of(each, start_min)) for each in self.comparisons)
        return replace(self, comparisons=tuple(settled))

    def _minute_of(self, compared: Compared, start_min: Sequence[float]) -> float:
        if not start_min:
            return 0.0
        first, last = start_min[0], start_min[-1]
        at = last if compared.at_min is None else compared.at_min
        gaps = (later - earlier for earlier, later in itertools.pairwise(start_min))
        longest = max(gaps, default=self.culture.interval_min)
        if not first - longest <= at <= last + longest:
            raise InvalidArgument(
                f"comparisons.at_min: expected a minute of the recordings, from {first:g} to {last:g}, got {at:g} in "
                f"{compared.name!r}"
            )
        return min(start_min, key=lambda start: (abs(start - at), start))

    def limit_minutes(self, first_min: float, last_min: float) -> list[float]:
        """Minutes at which anything is evaluated, rising."""
        return sorted({at for condition in self.conditions for at in self.minutes_of(condition, first_min, last_min)})

    @property
    def needs_neurons(self) -> bool:
        """Whether any condition has neurons in it."""
        return any(condition.through_neurons for condition in self.conditions)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return asdict(self)
