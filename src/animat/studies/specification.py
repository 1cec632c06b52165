"""The specification of a study: recordings or a culture, robots, arms, comparisons, sizes and seeds."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, Strict, ValidatorFunctionWrapHandler, WrapValidator

from animat.coding.mapping import Thresholds, mapping_named
from animat.errors import InvalidArgument, shown, within
from animat.goals.robot import with_goal
from animat.records import Flag, Number, Positive, Seed, Share, Whole, read_record, record
from animat.registry import is_ours, place_of
from animat.responses.readouts import count_readouts, readouts_named
from animat.robots.base import MOST_AT_ONCE, MOST_ITERATIONS, Robot
from animat.robots.registry import REGISTRY, robot_named
from animat.studies.source import LISTED, Source
from animat.training.lessons import Lesson, check_lessons
from animat.training.settings import SAC, Policies, Shadowing

MOST_TRAINED = 20_000
"""Policies of all arms on all robots: each is a file, and five are a job."""
FINEST_RESOLUTION = 2.0
"""Of the optimal return's grid: the cartpole's tables take 2 GiB there, and grow with its fourth power."""

_NO_NAMES = ("na", "null", "none")
"""In small letters, what programs that read tables take for a missing value."""


def _check_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,60}", name):
        raise ValueError(f"expected letters, digits, spaces, dots and dashes, got {shown(name)}")
    try:
        float(name)
    except ValueError:
        if name.lower() in _NO_NAMES:
            raise ValueError(f"expected a name, got {name!r}, which would be read as missing in a table") from None
        return name
    raise ValueError(f"expected a name, got {name!r}, which would be read as a number in a table")


def _unconverted(number: float, check: ValidatorFunctionWrapHandler) -> float:
    check(number)
    return number


Name = Annotated[str, AfterValidator(_check_name)]
Numbers = dict[str, Annotated[float, Strict(), WrapValidator(_unconverted)]]
"""Numbers by name, unconverted: 64 stays an integer."""
EpisodeCount = Annotated[Whole, Field(ge=1, le=MOST_AT_ONCE)]
Resolution = Annotated[Number, Field(ge=0.1, le=FINEST_RESOLUTION)]


@record
class Simulators:
    """How responses are read and simulators fitted to them; as the options of `animat train`.

    Attributes:
        kind, bins, range_hz: of the simulators; by default 20 bins with edges at each recording's own percentiles.
        conditions: what the agent chooses from, such as `frequency` or `interval:5,10+-25%`; empty: by frequency.
        readouts: channels of each command: `all` channels as one, `halves` or `quadrants` of the array, or groups of
            electrodes as JSON, `{"left": [1, 2], "right": [3, 4]}`; every robot of the study takes as many commands.
        window_ms: start and end of the response window.
        burst_threshold: share of active channels above which a response is a burst; None: Otsu's, if there are two
            groups.
        allow: names of findings that do not stop the study.
    """

    kind: Literal["histogram", "empirical", "memory"] = "histogram"
    bins: Whole = 20
    range_hz: Number | None = None
    conditions: str = ""
    readouts: str = "all"
    window_ms: tuple[Number, Number] = (2.0, 10.0)
    burst_threshold: Share | None = None
    allow: Annotated[tuple[str, ...], LISTED] = ()

    def __post_init__(self) -> None:
        from animat.neurons.simulator import check_binning
        from animat.responses.conditions import conditions_named
        from animat.responses.extraction import check_allowed
        from animat.responses.windows import check_window

        # Checked before anything is recorded, as a later correction would need another folder.
        check_binning(self.bins, self.range_hz)
        check_window(self.window_ms)
        check_allowed(self.allow)
        readouts_named(self.readouts)
        if self.conditions:
            conditions_named(self.conditions)


@record
class RobotSpec:
    """A robot of the study.

    Attributes:
        name: in tables and folders; if it is the name of a robot (`animat.robots.robot_named`), `kind` is not needed.
        kind: the robot's name if `name` is another, as with two cartpoles of different parameters; or where to import
            it from, `my_package.robots:Rover`, which is filled in for custom robots.
        iterations: of training, for each policy; None: the paper's.
        parameters: that replace its defaults, such as `pole_mass_kg`.
        optimum_resolution: of its optimal return; replaces the study's.
        goal: that replaces its own task (`animat.goals.goal`); None: its own task.
        lessons: taught to its policies in turn, each a table `[[robots.lessons]]` (`animat.training.lessons`).
    """

    name: Name
    iterations: Annotated[Whole, Field(ge=1, le=MOST_ITERATIONS)] | None = None
    optimum_resolution: Resolution | None = None
    parameters: Numbers = Field(default_factory=dict)
    kind: str = ""
    goal: str | None = None
    lessons: Annotated[tuple[Lesson, ...], LISTED] = ()

    def __post_init__(self) -> None:
        with within("kind" if self.kind else "name"):
            kind = REGISTRY.class_named(self.kind or self.name)
        with within("parameters"):
            robot = robot_named(self.kind or self.name, **self.parameters)
        if self.name == "culture":
            raise InvalidArgument("name: expected a name other than that of the culture's figures, got 'culture'")
        check_lessons(self.lessons, self.robot(), draws_recordings=True)
        if not is_ours(robot):
            # Workers import it from there.
            object.__setattr__(self, "kind", place_of(kind))

    def robot(self) -> Robot[Any]:
        """The robot, with its goal."""
        robot = robot_named(self.kind or self.name, **self.parameters)
        return robot if self.goal is None else with_goal(robot, self.goal)

    @property
    def trained_for(self) -> int:
        """Iterations of training."""
        return self.robot().paper_iterations if self.iterations is None else self.iterations


@record
class Arm:
    """One way to train policies, on each robot.

    Attributes:
        name: in tables and folders.
        mapping: from responses to commands, or where to import one from, `my_package.mappings:Steep` (filled in for
            custom mappings); `"none"` is the baseline without neurons.
        shadowing: whether simulators are refreshed during training; `"drawn"`: each episode draws one of them.
        delivery: `"shuffled"`: the delivered stimulus is drawn at random in training and evaluation (the control).
        percentiles: of the mapping: `"moving"` with the simulator, or fixed by the `"first"` recording.
        trained: false for policies as they are before training.
    """

    name: Name
    mapping: str = "1-threshold"
    shadowing: Shadowing = True
    delivery: Literal["chosen", "shuffled"] = "chosen"
    percentiles: Literal["moving", "first"] = "moving"
    trained: Flag = True

    def __post_init__(self) -> None:
        if not self.through_neurons:
            # Neither has an effect without neurons: with defaults, such arms share controls and an optimum.
            object.__setattr__(self, "delivery", "chosen")
            object.__setattr__(self, "percentiles", "moving")
            return
        try:
            mapping = mapping_named(self.mapping)
        except InvalidArgument as error:
            raise InvalidArgument(f"{error}; none is without neurons") from error
        if not is_ours(mapping):
            # Workers import it from there.
            object.__setattr__(self, "mapping", place_of(type(mapping)))

    @property
    def slug(self) -> str:
        """The name of its folder."""
        return self.name.lower().replace(" ", "-")

    @property
    def through_neurons(self) -> bool:
        """Whether there are neurons in it."""
        return self.mapping != "none"

    @property
    def kind(self) -> tuple[str, str]:
        """Its mapping and percentiles: arms that share them share controls and optima."""
        return self.mapping, self.percentiles

    @property
    def thresholds(self) -> str:
        """The folder name of its mapping and percentiles."""
        return self.mapping.replace(":", ".") + ("-held" if self.percentiles == "first" else "")

    @property
    def has_steps(self) -> bool:
        """Whether its mapping gives only a few commands, so that optimal returns are quick to compute."""
        return self.through_neurons and isinstance(mapping_named(self.mapping), Thresholds)


def mapping_label(mapping: str, percentiles: str) -> str:
    """The label of a mapping, with whether its percentiles are fixed."""
    fixed = ", percentiles fixed" if percentiles == "first" else ""
    return "without neurons" if mapping == "none" else f"{mapping}{fixed}"


@record
class Compared:
    """Two arms that are compared on every robot, by the policies' mean returns.

    Attributes:
        first, second: names of arms; the second is expected to be better.
        at_min: minute whose nearest recording they are evaluated on; None: the last recording.
        episodes: of each policy.
    """

    name: Name
    first: str
    second: str
    at_min: Number | None = None
    episodes: EpisodeCount = 100

    def __post_init__(self) -> None:
        if self.first == self.second:
            raise InvalidArgument(f"second: expected an arm other than the first, got {self.second!r} in {self.name!r}")


@record
class Study:
    """Everything that decides a study's results, except for the recordings in files.

    InvalidArgument names the setting, what was expected and what came.

    Attributes:
        title: of the report.
        culture, simulators: the recordings, and how responses are read from them and fitted.
        robots, arms, comparisons: what is trained and compared.
        policies: of each arm on each robot.
        seed: decides every draw of training and evaluation.
        training_min: duration of training on the culture's clock.
        episodes: of each policy of an arm that no comparison evaluates on that recording, and of controls.
        episodes_over_time: of each policy at every recording.
        actions: how policies act in evaluation: the most probable action, or drawn as in training.
        optimum_resolution: steps of the grid of the optimal return, as a multiple; 0.6 is fast and coarse.
        optimum_episodes: episodes in which the optimal controller's return is checked.
        algorithm: settings of `animat.training.settings.SAC` that replace its defaults.
        paper: whether the paper's results are printed with comparisons of the same name and robot.
    """

    title: str = "Study"
    culture: Source = Field(default_factory=Source)
    simulators: Simulators = Field(default_factory=Simulators)
    robots: Annotated[tuple[RobotSpec, ...], LISTED] = (RobotSpec("cartpole"), RobotSpec("navigation"))
    arms: Annotated[tuple[Arm, ...], LISTED] = (Arm("1 threshold"),)
    comparisons: Annotated[tuple[Compared, ...], LISTED] = ()
    policies: Policies = 10
    seed: Seed = 1
    training_min: Positive = 60.0
    episodes: EpisodeCount = 100
    episodes_over_time: EpisodeCount = 30
    actions: Literal["most probable", "drawn"] = "most probable"
    optimum_resolution: Resolution = 1.0
    optimum_episodes: Annotated[Whole, Field(ge=2, le=MOST_AT_ONCE)] = 4000
    algorithm: Numbers = Field(default_factory=dict)
    paper: Flag = False

    def __post_init__(self) -> None:
        for name in ("robots", "arms"):
            if not getattr(self, name):
                raise InvalidArgument(f"{name}: expected at least one, got none")
        self._expect_fitting_robots()
        _expect_unique("robots", [spec.name for spec in self.robots])
        _expect_unique("arms", [arm.slug for arm in self.arms], ": capitals, and spaces for dashes, make no difference")
        _expect_unique("comparisons", [compared.name for compared in self.comparisons])
        self._expect_feasible()
        known = [arm.name for arm in self.arms]
        for compared in self.comparisons:
            for side in ("first", "second"):
                if (name := getattr(compared, side)) not in known:
                    raise InvalidArgument(
                        f"comparisons.{side}: expected one of the arms {', '.join(known)}, got {name!r} in "
                        f"{compared.name!r}"
                    )
        if self.culture.kind != "files" and self.needs_neurons:
            self._expect_a_choice()
            for compared in self.comparisons:
                self._minute_of(compared, [i * self.culture.interval_min for i in range(self.culture.sessions)])
        read_record(SAC, self.algorithm, "algorithm")

    def _expect_fitting_robots(self) -> None:
        """Raise unless every robot has as many commands as there are readouts, and lessons that suit all arms."""
        n_readouts = count_readouts(readouts_named(self.simulators.readouts))
        for spec in self.robots:
            robot = spec.robot()
            if self.needs_neurons and robot.n_commands != n_readouts:
                raise InvalidArgument(
                    f"simulators.readouts: expected as many as {spec.name} has commands ({robot.n_commands}), got "
                    f"{self.simulators.readouts!r}, which are {n_readouts}; robots with more or fewer commands need "
                    "another study"
                )
            for arm in self.arms:
                drawn = arm.shadowing == "drawn" and arm.through_neurons
                try:
                    check_lessons(spec.lessons, robot, draws_recordings=drawn)
                except InvalidArgument as error:
                    raise InvalidArgument(f"robots.lessons: {error} ({spec.name}, {arm.name})") from error

    def _expect_feasible(self) -> None:
        """Raise for more episodes than fit side by side, or more policies than a study can have."""
        for name, episodes in (
            ("episodes", self.episodes),
            ("episodes_over_time", self.episodes_over_time),
            *(("comparisons.episodes", compared.episodes) for compared in self.comparisons),
        ):
            if episodes * self.policies > MOST_AT_ONCE:
                raise InvalidArgument(
                    f"{name}: expected at most {MOST_AT_ONCE:,} of all policies together, got {episodes:,} for each of "
                    f"{self.policies}"
                )
        if (trained := len(self.robots) * len(self.arms) * self.policies) > MOST_TRAINED:
            raise InvalidArgument(
                f"policies: expected at most {MOST_TRAINED:,} in a study, got {trained:,} (robots x arms x policies)"
            )

    def _expect_a_choice(self) -> None:
        settings, frequencies_hz = self.simulators, self.culture.protocol().frequencies_hz
        by = settings.conditions or ("frequency" if self.culture.places is None else "place")
        is_one = by == "all" or (by == "frequency" and len(frequencies_hz) == 1)
        if is_one and "one-condition" not in settings.allow:
            raise InvalidArgument(
                "simulators.conditions: expected two or more for an agent to choose from, got one "
                f"({'all' if by == 'all' else f'{frequencies_hz[0]:g} Hz'}): group the stimuli otherwise, or add to "
                'culture.frequencies_hz (to allow it: simulators.allow = ["one-condition"])'
            )

    def arm(self, name: str) -> Arm:
        """The arm of this name."""
        return next(arm for arm in self.arms if arm.name == name)

    def arms_of(self, kind: Arm) -> list[Arm]:
        """All arms with the same `kind`."""
        return [arm for arm in self.arms if arm.kind == kind.kind]

    def minutes_of(self, arm: Arm, first_min: float, last_min: float) -> dict[float, int]:
        """The minutes at which an arm is evaluated, with numbers of episodes: those of its comparisons, and the last.

        An arm that is trained, with its chosen stimuli, on the first recording only is evaluated on it too, to show how
        well it learned it.
        """
        minutes: dict[float, int] = {}
        for compared in self.comparisons:
            if arm.name in (compared.first, compared.second):
                at = last_min if compared.at_min is None else compared.at_min
                minutes[at] = max(minutes.get(at, 0), compared.episodes)
        minutes.setdefault(last_min, self.episodes)
        if arm.trained and arm.through_neurons and not arm.shadowing and arm.delivery == "chosen":
            minutes[first_min] = max(minutes.get(first_min, 0), self.episodes)
        return minutes

    def at_recordings(self, start_min: Sequence[float]) -> Study:
        """The same study with every comparison at the minute of a recording: the nearest to its own, or the last.

        `start_min` rises; it is empty without neurons, where every minute is the same. Raises InvalidArgument for a
        comparison before the first recording, or after the last, by more than the longest interval between two.
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

    def optimum_minutes(self, first_min: float, last_min: float) -> list[float]:
        """All minutes at which anything is evaluated, rising."""
        return sorted({at for arm in self.arms for at in self.minutes_of(arm, first_min, last_min)})

    @property
    def needs_neurons(self) -> bool:
        """Whether any arm has neurons in it."""
        return any(arm.through_neurons for arm in self.arms)


def _expect_unique(argument: str, names: Sequence[str], note: str = "") -> None:
    for name, times in Counter(names).items():
        if times > 1:
            raise InvalidArgument(f"{argument}: expected each name once, got {name!r} {times} times{note}")
