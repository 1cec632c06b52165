"""How a closed loop is run: how actions are presented and answers read, and what happens when something goes wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal, Self, get_args

import numpy as np
from jaxtyping import Float32
from numpy.typing import ArrayLike

from animat.coding.decoder import Decoder, expect_fit
from animat.coding.encoder import Encoder
from animat.coding.mapping import N_PERCENTILES, Mapping, mapping_to_data
from animat.errors import InvalidArgument, UnusableData
from animat.evaluation.transfer import in_window, other_presentation
from animat.goals.robot import body_and_goal
from animat.neurons.adjusted_rank import AdjustedRanks
from animat.neurons.history_tracker import HistoryTracker
from animat.recordings.findings import Finding
from animat.responses.condition import Condition
from animat.responses.readouts import ALL, Readouts
from animat.responses.windows import DEFAULT_WINDOW_MS, check_window
from animat.robots.base import Robot
from animat.stimulation.protocol import Presentation
from animat.stimulation.pulse import PUBLISHED_PULSE, Pulse
from animat.training.policy import Policy

OnBurst = Literal["use", "repeat", "skip"]
OnLate = Literal["continue", "stop"]

MOST_WARM_UP = 100
"""Presentations of each condition in a warm-up: as many as a recording holds; more wears a culture out for nothing."""
SETTLINGS = 10
"""How many pauses the settling has, where thresholds adapt and an action is one pulse."""
SETTLING_ROUNDS = 6
"""Presentations of each condition after each pause of the settling: with five of them 2.3 s, next to a pause of 2 s."""


@dataclass(frozen=True, eq=False)
class Loop:
    """The settings of a closed loop.

    An action is a trial of a condition: `pulses` pulses, the first one 1/f after the last pulse of the action
    before it and the others 1/f apart, on the condition's electrodes or, where it names none, each one of the patterns
    in random order; the response to the last one is read.

    Attributes:
        robot: that is driven.
        mapping: from a response to a command.
        conditions: what is chosen from; each tells its stimuli (`animat.responses.condition.Condition`).
        percentiles: of the simulator that the policy was trained on, in Hz, shape (11,); of several readouts
            (readouts, 11).
        adaptive_from: responses of that recording, which adaptive thresholds start from (see
            `animat.closed_loop.adaptive`). None: thresholds are fixed.
        pulses: of a trial.
        window_ms: the response window.
        burst_threshold: ratio of active channels above which a response is a burst; 1: none is.
        pulse: what each electrode delivers.
        patterns: how many of the culture's patterns are used, the first ones; None: all.
        on_burst: `"use"` the response as any other; `"repeat"` the stimulus, at most `most_repeats` times; `"skip"`
            it, and move the robot by the command before it (0 where there was none).
        most_repeats: of one action; the response after that is used.
        on_late: when a pulse comes later than it should: `"continue"`, or `"stop"` the session; it is logged.
        pause_s: observed without a stimulus before each episode, and each time in the settling.
        warm_up: how often each condition is presented after that, in random order, before the robot moves: a culture
            that has rested answers otherwise than in a recording. The responses count for adaptive thresholds. None:
            2 where an action is one pulse, 0 where it is several, which are each other's past.
        settling: how many times `pause_s` and a warm-up of `SETTLING_ROUNDS` precede the first episode. A recording
            tires a culture more than a loop does. The culture recovers in the first minute. None: `SETTLINGS` where
            thresholds adapt and an action is one pulse, else 0.
        patience_s: how much longer than it should a culture may take to answer before it counts as hung; and how long
            the robot, and whoever acts, may take.
        real_time: whether a culture that is faster is held back to real time.
        readouts: groups of channels that are read, by their electrodes: one for each command of the robot.
        remembering: how responses become the history state, for agents that see it; None: nobody does.

    Raises:
        InvalidArgument: for a setting that cannot be.
        UnusableData: for conditions that cannot be delivered (`animat.coding.encoder.Encoder`).
    """

    robot: Robot[Any]
    mapping: Mapping
    conditions: tuple[Condition, ...]
    percentiles: Float32[np.ndarray, "*readouts percentiles"] = field(repr=False)
    adaptive_from: AdjustedRanks | None = field(default=None, repr=False)
    pulses: int = 1
    window_ms: tuple[float, float] = DEFAULT_WINDOW_MS
    burst_threshold: float = 1.0
    pulse: Pulse = PUBLISHED_PULSE
    patterns: int | None = None
    on_burst: OnBurst = "use"
    most_repeats: int = 3
    on_late: OnLate = "continue"
    pause_s: float = 2.0
    warm_up: int | None = None
    settling: int | None = None
    patience_s: float = 10.0
    real_time: bool = False
    readouts: Readouts = ALL
    remembering: HistoryTracker | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        expect_fit(self.robot.name, self.robot.n_commands, len(self.readouts))
        percentiles = np.array(self.percentiles, np.float32)
        if percentiles.shape != self.decoder.percentiles_shape or not np.all(np.diff(percentiles) >= 0):
            of_each = f" for each of {len(self.readouts)} readouts" if len(self.readouts) > 1 else ""
            raise InvalidArgument(
                f"percentiles: expected {N_PERCENTILES} rising numbers in Hz{of_each}, got {self.percentiles}"
            )
        percentiles.setflags(write=False)
        object.__setattr__(self, "percentiles", percentiles)
        check_window(self.window_ms)
        _ = self.presentation
        _ = self.encoder
        if self.adaptive_from is not None:
            self._check_start(self.adaptive_from)
        for name, allowed in (("on_burst", get_args(OnBurst)), ("on_late", get_args(OnLate))):
            if getattr(self, name) not in allowed:
                raise InvalidArgument(f"{name}: expected one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        if self.warm_up is None:
            object.__setattr__(self, "warm_up", 2 if self.pulses == 1 else 0)
        if self.settling is None:
            object.__setattr__(
                self, "settling", SETTLINGS if self.pulses == 1 and self.adaptive_from is not None else 0
            )
        for name in ("warm_up", "settling"):
            if not (isinstance(number := getattr(self, name), int) and 0 <= number <= MOST_WARM_UP):
                raise InvalidArgument(f"{name}: expected a whole number from 0 to {MOST_WARM_UP}, got {number!r}")
        for name in ("burst_threshold", "pause_s", "patience_s", "most_repeats"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InvalidArgument(f"{name}: expected a finite number from 0, got {getattr(self, name)}")
        if self.patience_s == 0:
            raise InvalidArgument("patience_s: expected above 0 s, got 0: nothing answers at once")
        if self.patterns is not None and self.patterns < 1:
            raise InvalidArgument(f"patterns: expected at least 1, got {self.patterns}")

    def _check_start(self, recorded: AdjustedRanks) -> None:
        """Thresholds start from responses that they can be of."""
        if not isinstance(recorded, AdjustedRanks):
            raise InvalidArgument(f"adaptive_from: expected calibration.adjusted, got {type(recorded).__name__}")
        n, shape = [len(each) for each in recorded.ranks], (len(self.conditions), len(self.readouts))
        if (len(n), recorded.slopes.shape[1]) != shape or not all(n):
            raise InvalidArgument(
                f"adaptive_from: expected responses to each of {shape[0]} conditions, in as many readouts as the loop "
                f"has ({shape[1]}), got {n} in {recorded.slopes.shape[1]}"
            )
        if self.remembering not in (None, recorded.remembering):
            raise InvalidArgument("remembering: expected adaptive_from.remembering, got another one")

    def rounds_before(self, episode: int, *, is_silent: bool) -> list[int]:
        """How often each condition is presented after each of the pauses before an episode."""
        settling = self.settling if episode == 0 else 0
        return [SETTLING_ROUNDS] * (settling or 0) + [0 if is_silent else self.warm_up or 0]

    @property
    def history(self) -> HistoryTracker | None:
        """How its responses become the history state, for thresholds that adapt or for agents; None: nobody asks."""
        return self.remembering if self.adaptive_from is None else self.adaptive_from.remembering

    @property
    def presentation(self) -> Presentation:
        """How it presents; conditions are mixed, as each is chosen when it is its turn."""
        return Presentation("mixed", self.pulses)

    @property
    def encoder(self) -> Encoder:
        """What its actions are as stimuli."""
        return Encoder(self.conditions, self.pulses)

    @property
    def decoder(self) -> Decoder:
        """What its responses are as commands."""
        return Decoder(self.mapping, self.readouts)

    @classmethod
    def of_policy(
        cls, policy: Policy, percentiles: ArrayLike, *, pulses: int | None = None, **settings: Any
    ) -> tuple[Self, tuple[Finding, ...]]:
        """The loop that a policy was trained for, and where it differs from how the policy's recordings were made.

        Args:
            policy: its robot, mapping, readouts, conditions, window and presentation are taken, but for those in
                `settings`.
            percentiles: of the simulator that it was trained on, in Hz, shape (11,), or (readouts, 11).
            pulses: of a trial; None: as many as in its recordings (1 where that is not known).
            settings: the other attributes.

        Raises:
            UnusableData: for a policy without neurons.
        """
        if policy.mapping is None:
            raise UnusableData("policy: expected one that acts through neurons, got one that was trained without")
        recorded = policy.presentation
        if pulses is None:
            pulses = 1 if recorded is None else recorded.pulses
        taken = {"conditions": policy.conditions, "window_ms": policy.window_ms, "readouts": policy.readouts}
        settings = {**taken, **settings}
        if settings["window_ms"] is None:
            del settings["window_ms"]
        loop = cls(
            policy.robot, policy.mapping, percentiles=np.asarray(percentiles, np.float32), pulses=pulses, **settings
        )
        return loop, _differences(policy, loop)

    def to_dict(self) -> dict[str, Any]:
        """As plain data, for the log of a session."""
        plain: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        plain["adaptive"] = plain.pop("adaptive_from") is not None
        _ = plain.pop("remembering")
        plain |= {} if self.history is None else {"memory": self.history.to_dict()}
        return plain | {
            **body_and_goal(self.robot),
            "mapping": mapping_to_data(self.mapping),
            "conditions": [condition.label for condition in self.conditions],
            "percentiles": self.percentiles.tolist(),
            "readouts": self.readouts.to_dict(),
            "pulse": self.pulse.to_list(),
        }


def _differences(policy: Policy, loop: Loop) -> tuple[Finding, ...]:
    findings = list(other_presentation(policy.presentation, loop.presentation))
    if policy.window_ms is not None and policy.window_ms != loop.window_ms:
        trained, read = in_window(policy.window_ms), in_window(loop.window_ms)
        message = f"the policy was trained on responses {trained}, the loop reads those {read}"
        findings.append(Finding("other-window", "warning", message))
    return tuple(findings)
