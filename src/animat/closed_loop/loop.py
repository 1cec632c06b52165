"""The settings of a closed loop: how actions are presented and responses read, and what happens on failures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal, Self, get_args

import numpy as np
from jaxtyping import Float32
from numpy.typing import ArrayLike

from animat.arguments import check_argument, python_numbers
from animat.coding.decoder import Decoder, expect_readout_per_command
from animat.coding.encoder import Encoder
from animat.coding.mapping import N_PERCENTILES, Mapping, mapping_to_data
from animat.errors import InvalidArgument, UnusableData, expect_at_least
from animat.evaluation.transfer import describe_window, other_presentation
from animat.goals.robot import body_and_goal
from animat.neurons.history_tracker import AdjustedRanks, HistoryTracker
from animat.recordings.findings import Finding
from animat.responses.condition import RESTING, Condition
from animat.responses.readouts import ALL, Readouts
from animat.responses.windows import DEFAULT_WINDOW_MS, check_window
from animat.robots.base import Robot
from animat.stimulation.protocol import Presentation
from animat.stimulation.pulse import PUBLISHED_PULSE, Pulse
from animat.tables import freeze_one
from animat.training.policy import Policy

OnBurst = Literal["use", "repeat", "skip"]
OnLate = Literal["continue", "stop"]

MOST_WARM_UP = 100
"""Most trials of each condition in a warm-up, as many as in a recording; more would only wear the culture out."""
SETTLINGS = 10
"""Number of pauses in the settling, where thresholds adapt and an action is one pulse."""
SETTLING_ROUNDS = 6
"""Trials of each condition after each pause of the settling: 2.3 s with five conditions, next to a pause of 2 s."""


@dataclass(frozen=True, eq=False)
class Loop:
    """The settings of a closed loop.

    An action is a trial of a condition: `pulses` pulses, the first one 1/f after the last pulse of the previous action
    and the others 1/f apart, on the condition's electrodes or, if it names none, each on one of the patterns in random
    order; the response to the last one is read.

    Attributes:
        conditions: to choose from; each states its stimuli (`animat.responses.condition.Condition`).
        percentiles: of the simulator that the policy was trained on, in Hz, shape (11,), or (readouts, 11) for several
            readouts.
        adaptive_from: responses of that recording, from which adaptive thresholds start (see
            `animat.closed_loop.adaptive`). None: thresholds are fixed.
        burst_threshold: ratio of active channels above which a response is a burst; 1: no response is.
        patterns: how many of the culture's patterns are used, the first ones; None: all.
        on_burst: `"use"` the response as any other; `"repeat"` the stimulus, at most `most_repeats` times; `"skip"`
            it, and move the robot by the previous command (0 if there was none).
        most_repeats: of one action; the response after that is used.
        on_late: after a late pulse: `"continue"`, or `"stop"` the session; it is logged.
        pause_s: seconds without a stimulus before each episode, and each time in the settling.
        warm_up: trials of each condition after the pause, in random order, before the robot moves: a rested culture
            responds differently from a recorded one. None: 2 where an action is one pulse, 0 where it is several.
        settling: how many times `pause_s` and a warm-up of `SETTLING_ROUNDS` precede the first episode, so that
            thresholds adapt. None: `SETTLINGS` where thresholds adapt and an action is one pulse, else 0.
        patience_s: time beyond the expected that a culture may take to answer before it counts as hung; and the time
            that the robot, and an agent, may take.
        real_time: whether a simulated culture is held back to real time; a device always keeps its own.
        readouts: groups of channels that are read, by their electrodes: one for each command of the robot.
        remembering: how responses become the history state, for agents that see it; None: no agent does.

    Raises:
        InvalidArgument: for an invalid setting.
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
        for name, value in vars(self).items():
            object.__setattr__(self, name, python_numbers(value))
        check_argument("pulse", self.pulse, Pulse)
        check_argument("real_time", self.real_time, bool)
        check_argument("remembering", self.remembering, HistoryTracker | None)
        expect_readout_per_command(self.robot.name, self.robot.n_commands, len(self.readouts))
        given, percentiles = self.percentiles, freeze_one(self, "percentiles", np.float32)
        if percentiles.shape != self.decoder.percentiles_shape or not np.all(np.diff(percentiles) >= 0):
            each = f" for each of {len(self.readouts)} readouts" if len(self.readouts) > 1 else ""
            raise InvalidArgument(f"percentiles: expected {N_PERCENTILES} rising numbers in Hz{each}, got {given}")
        check_window(self.window_ms)
        _ = self.presentation
        _ = self.encoder
        if self.adaptive_from is not None:
            self._check_start(self.adaptive_from)
        for name, allowed in (("on_burst", get_args(OnBurst)), ("on_late", get_args(OnLate))):
            if getattr(self, name) not in allowed:
                raise InvalidArgument(f"{name}: expected one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        for name, usual in {"warm_up": 2, "settling": SETTLINGS if self.adaptive_from is not None else 0}.items():
            if (number := getattr(self, name)) is None:
                number = usual if self.pulses == 1 else 0
                object.__setattr__(self, name, number)
            if not (isinstance(number, int) and 0 <= number <= MOST_WARM_UP):
                raise InvalidArgument(f"{name}: expected a whole number from 0 to {MOST_WARM_UP}, got {number!r}")
        kinds = {"burst_threshold": float, "pause_s": float, "patience_s": float, "most_repeats": int}
        for name, kind in kinds.items():
            check_argument(name, getattr(self, name), kind)
            if not 0 <= getattr(self, name) < math.inf:
                raise InvalidArgument(f"{name}: expected a finite number from 0, got {getattr(self, name):g}")
        if self.patience_s == 0:
            raise InvalidArgument("patience_s: expected above 0 s, got 0: no answer is immediate")
        check_argument("patterns", self.patterns, int | None)
        expect_at_least("patterns", self.patterns, 1)

    def _check_start(self, recorded: AdjustedRanks) -> None:
        """Check the responses from which adaptive thresholds start."""
        if not isinstance(recorded, AdjustedRanks):
            raise InvalidArgument(f"adaptive_from: expected calibration.adjusted, got {type(recorded).__name__}")
        n, shape = [len(each) for each in recorded.ranks], (len(self.conditions), len(self.readouts))
        if (len(n), recorded.slopes.shape[1]) != shape or not all(n):
            expected = f"responses to each of {shape[0]} conditions, in the loop's number of readouts ({shape[1]})"
            raise InvalidArgument(f"adaptive_from: expected {expected}, got {n} in {recorded.slopes.shape[1]}")
        if self.remembering not in (None, recorded.remembering):
            raise InvalidArgument("remembering: expected adaptive_from.remembering, got a different one")

    def rounds_before(self, episode: int, *, is_silent: bool) -> list[int]:
        """Trials of each condition after each of the pauses before an episode."""
        settling = self.settling if episode == 0 else 0
        return [SETTLING_ROUNDS] * (settling or 0) + [0 if is_silent else self.warm_up or 0]

    @property
    def pulses_until_moved(self) -> int:
        """Pulses delivered before the robot first moves: settling, warm-up and one trial."""
        delivered = sum(condition.electrodes != RESTING for condition in self.conditions)
        return self.pulses * (delivered * sum(self.rounds_before(0, is_silent=False)) + 1)

    @property
    def history(self) -> HistoryTracker | None:
        """How responses become the history state, for adaptive thresholds or for agents; None: not needed."""
        return self.remembering if self.adaptive_from is None else self.adaptive_from.remembering

    @property
    def presentation(self) -> Presentation:
        """How stimuli are presented: mixed, as each condition is chosen when its turn comes."""
        return Presentation("mixed", self.pulses)

    @property
    def encoder(self) -> Encoder:
        """From actions to stimuli."""
        return Encoder(self.conditions, self.pulses)

    @property
    def decoder(self) -> Decoder:
        """From responses to commands."""
        return Decoder(self.mapping, self.readouts)

    @classmethod
    def of_policy(
        cls, policy: Policy, percentiles: ArrayLike, *, pulses: int | None = None, **settings: Any
    ) -> tuple[Self, tuple[Finding, ...]]:
        """The loop for a policy, and its differences from the policy's recordings.

        Args:
            policy: its robot, mapping, readouts, conditions, window and presentation are used, except for those in
                `settings`.
            percentiles: of the simulator that it was trained on, in Hz, shape (11,), or (readouts, 11).
            pulses: of a trial; None: as many as in its recordings (1 if that is not known).
            settings: the other attributes.

        Raises:
            UnusableData: for a policy without neurons.
            InvalidArgument: for another number of `conditions` than the policy's.
        """
        if policy.mapping is None:
            raise UnusableData("policy: expected one that acts through neurons, got one that was trained without them")
        recorded = policy.presentation
        if pulses is None:
            pulses = 1 if recorded is None else recorded.pulses
        window_ms = policy.window_ms or DEFAULT_WINDOW_MS
        settings = {"conditions": policy.conditions, "window_ms": window_ms, "readouts": policy.readouts, **settings}
        percentiles = np.asarray(percentiles, np.float32)
        loop = cls(policy.robot, policy.mapping, percentiles=percentiles, pulses=pulses, **settings)
        if (n := len(loop.conditions)) != len(policy.conditions):
            raise InvalidArgument(f"conditions: expected {len(policy.conditions)}, as the policy has, got {n}")
        findings = list(other_presentation(recorded, loop.presentation))
        if policy.window_ms not in (None, loop.window_ms):
            trained, read = describe_window(policy.window_ms), describe_window(loop.window_ms)
            message = f"the policy was trained on responses {trained}, but the loop reads those {read}"
            findings.append(Finding("other-window", "warning", message))
        return loop, tuple(findings)

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
