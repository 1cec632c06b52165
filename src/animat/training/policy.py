"""Policies, which training produces and closed loops run: a small network with everything needed to use it."""

from __future__ import annotations

import errno
import itertools
import json
import math
import os
from collections.abc import Mapping as Dict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
from jaxtyping import Float, Float32, Float64
from pydantic import Field

from animat.arguments import checked_arguments
from animat.coding.decoder import expect_one_command, expect_readout_per_command
from animat.coding.mapping import REGISTRY as MAPPINGS
from animat.coding.mapping import Mapping, mapping_from_data, mapping_to_data
from animat.errors import AnimatError, InvalidArgument, InvalidFile, Mismatch, expect_kind, in_file, shown
from animat.goals.robot import body_and_goal, robot_of, without_goal
from animat.neurons.history import INITIAL_HISTORY
from animat.plain_file import expect_plain_file, is_absent, is_folder
from animat.recordings.recorded_culture import RecordedCulture
from animat.records import Flag, Number, json_data, read_record
from animat.responses.condition import Condition, abbreviated, stimulus_mismatch
from animat.responses.readouts import ALL, Readouts
from animat.responses.windows import check_window
from animat.robots.base import LARGEST_SCALE, LEAST_SCALE, Robot
from animat.robots.registry import REGISTRY as ROBOTS
from animat.stimulation.protocol import Presentation
from animat.tables import briefly, read_only_copy, reduce_dataclass
from animat.training.settings import PulseCost, check_provenance
from animat.writing import write_whole

FORMAT = "animat-policy-1"
HIDDEN_ACTIVATION = "relu"
"""Activation of both hidden layers, max(0, x); stored in every file for users without this package."""
CURVE = ("iterations", "episodes", "mean_return", "entropy", "alpha", "critic_loss")
"""The columns of a learning curve, one row per chunk: iterations done at its end, the episodes that ended in it, their
mean return, and the learner's diagnosis at its end (`animat.training.sac`); NaN: unknown."""
_LAYERS = 3
_ARRAYS = ("scales", "learning_curve", *(f"layer{i}.{part}" for i in range(_LAYERS) for part in ("weight", "bias")))
_MOST_BYTES = 2**28
_LARGEST = 1e6
"""Trained weights are of order one; with weights larger than this the outputs overflow."""

Command = Annotated[Number, Field(ge=-1, le=1)]
Action: TypeAlias = int | float | Float[np.ndarray, " commands"]
"""The index of a condition (or command), or a continuous command."""

FITTED = ("kind", "bins", "range_hz", "by", "burst_threshold")
"""The entries of `SimulatorTimeline.fitted` that determine a recording's simulator."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained controller that runs in numpy: neither loading it nor acting imports JAX.

    The network has two hidden layers of rectified units. Its outputs are the logits of the actions, or the means and
    then the log standard deviations of continuous commands, which tanh maps to [-1, 1].

    Attributes:
        weights, biases: those of the three layers, shapes (inputs, outputs) and (outputs,).
        scales: divisors of the observations, shape (observations,).
        robot: the robot it was trained on, with its goal if it had one.
        mapping: from a response to a command; None for a policy without neurons.
        conditions: the conditions that its actions select, for a policy that acts through neurons.
        commands: the commands that its actions select, for a policy without neurons; None: continuous commands.
        window_ms: the response window, for a policy that acts through neurons.
        presentation: how stimuli were presented when the neurons were recorded; None if unknown.
        provenance: what it was trained on and how, as plain data.
        learning_curve: one row per chunk of training, columns as `CURVE`, shape (chunks, 6).
        readouts: the electrodes from which each command is read.
        neural_observation: whether it also sees the neurons' history state (`animat.wrappers.NeuralObservation`).
        pulse_cost: cost of an electrode pulse in training, in the units of the reward.
        assessments: iterations, minute of the simulators, lesson (from 1), share of successes (NaN if the robot does
            not report success) and mean return, one row each, shape (assessments, 5); empty if it was not assessed.
        best: the policy at its best assessment, after training; stored in a separate file in `best/`.
    """

    __repr__, __reduce__ = briefly, reduce_dataclass

    weights: tuple[Float32[np.ndarray, "inputs outputs"], ...]
    biases: tuple[Float32[np.ndarray, " outputs"], ...]
    scales: Float32[np.ndarray, " observations"]
    robot: Robot[Any]
    mapping: Mapping | None
    conditions: tuple[Condition, ...] = ()
    commands: tuple[float, ...] | None = None
    window_ms: tuple[float, float] | None = None
    presentation: Presentation | None = None
    provenance: Dict[str, Any] = field(default_factory=dict)
    learning_curve: Float[np.ndarray, "chunks 6"] = field(default_factory=lambda: np.zeros((0, len(CURVE))))
    readouts: Readouts = ALL
    neural_observation: bool = False
    assessments: Float[np.ndarray, "assessments 5"] = field(default_factory=lambda: np.zeros((0, 5)))
    best: Policy | None = None
    pulse_cost: float = 0.0

    def __post_init__(self) -> None:
        read_record(PulseCost, self.pulse_cost, "pulse_cost")
        # As a Python bool, since numpy's cannot be written to a file.
        vars(self)["neural_observation"] = read_record(Flag, self.neural_observation, "neural_observation")
        if self.neural_observation and self.mapping is None:
            raise InvalidArgument("neural_observation: expected only with a mapping, got no mapping")
        self._check_network()
        if self.window_ms is not None:
            check_window(read_record(tuple[Number, Number], self.window_ms, "window_ms"))
        if self.commands is not None:
            read_record(tuple[Command, ...], self.commands, "commands")
            expect_one_command(self.robot.name, self.robot.n_commands)
        if self.learning_curve.shape[1:] != (len(CURVE),) or self.learning_curve.dtype.kind != "f":
            raise InvalidArgument(f"learning_curve: expected rows of six, got shape {self.learning_curve.shape}")
        if self.assessments.ndim != 2 or self.assessments.shape[1] != 5 or self.assessments.dtype.kind != "f":
            raise InvalidArgument(f"assessments: expected rows of five, got shape {self.assessments.shape}")
        check_provenance(self.provenance)
        # Read-only, so that a checked policy cannot be changed.
        for name in ("weights", "biases"):
            vars(self)[name] = tuple(map(read_only_copy, getattr(self, name)))
        for name in ("scales", "learning_curve", "assessments"):
            vars(self)[name] = read_only_copy(getattr(self, name))
        if self.mapping is not None:
            expect_readout_per_command(self.robot.name, self.robot.n_commands, len(self.readouts))

    def _check_network(self) -> None:
        """Refuse weights whose shapes do not fit together, or that are not finite."""
        n_outputs = 2 * self.robot.n_commands if self.n_actions is None else self.n_actions
        n_inputs = len(self.robot.observation_spec) + len(INITIAL_HISTORY) * self.neural_observation
        widths = [n_inputs, *(bias.size for bias in self.biases)]
        shapes = [weight.shape for weight in self.weights]
        if len(widths) != 4 or widths[-1] != n_outputs or min(widths) < 1 or shapes != list(itertools.pairwise(widths)):
            expected = f"three layers from {n_inputs} observations of {self.robot.name} to {n_outputs} outputs"
            raise InvalidArgument(f"weights: expected {expected}, got shapes {shapes}")
        others = [self.scales.shape, *(bias.shape for bias in self.biases)]
        if others != [(width,) for width in widths]:
            raise InvalidArgument(f"scales, biases: expected vectors of {widths} numbers, got shapes {others}")
        for name, arrays in (("weights", self.weights), ("biases", self.biases), ("scales", (self.scales,))):
            if kinds := {str(array.dtype) for array in arrays} - {"float32"}:
                raise InvalidArgument(f"{name}: expected float32, got {', '.join(kinds)}")
            # Also false for NaN.
            if name != "scales" and not all(np.all(np.abs(array) <= _LARGEST) for array in arrays):
                raise InvalidArgument(f"{name}: expected finite numbers up to {_LARGEST:g}, got NaN or larger ones")
        if not np.all((self.scales >= LEAST_SCALE) & (self.scales <= LARGEST_SCALE)):
            limits = f"from {LEAST_SCALE:g} to {LARGEST_SCALE:g}"
            raise InvalidArgument(f"scales: expected numbers {limits}, got {self.scales.tolist()}")

    @property
    def n_actions(self) -> int | None:
        """Number of discrete actions; None: continuous commands in [-1, 1], as many as the robot takes."""
        if self.mapping is not None:
            return len(self.conditions)
        return None if self.commands is None else len(self.commands)

    @property
    def percentiles(self) -> str:
        """Whether the mapping's percentiles were `"moving"` with the simulator or fixed by the `"first"` one."""
        return str(self._trained.get("percentiles", "moving"))

    @property
    def delivery(self) -> str:
        """`"shuffled"` for the paper's control, trained with conditions drawn at random regardless of its choice."""
        return str(self._trained.get("delivery", "chosen"))

    @property
    def fitted(self) -> Dict[str, Any]:
        """How its simulators were made: the `FITTED` entries of a timeline; empty if unknown."""
        simulators = self.provenance.get("simulators") or {}
        return {name: simulators[name] for name in FITTED if name in simulators} if "kind" in simulators else {}

    @property
    def recorded_at_min(self) -> tuple[float, ...]:
        """The minutes of the recordings from which those simulators were made; empty if unknown."""
        return tuple((self.provenance.get("simulators") or {}).get("recorded_at_min", ()))

    @property
    def culture(self) -> RecordedCulture | None:
        """The culture that was recorded for its training; None if it is not known."""
        stated = self.provenance.get("culture")
        return None if stated is None else read_record(RecordedCulture, stated, "provenance.culture")

    @property
    def _trained(self) -> Dict[str, Any]:
        return self.provenance.get("training") or {}

    def trained_until_min(self, first_min: float) -> float | None:
        """The minute at which training ended, on the culture's clock; None if unknown.

        Args:
            first_min: of the recordings; training did not begin before its own first one, if that is later.
        """
        trained = self._trained
        first_min = max([first_min, *self.recorded_at_min[:1]])
        if not trained:
            return None
        if swaps := self.provenance.get("swaps"):
            # In live training the recordings in use are known only from the swaps, also if it was interrupted.
            return max(first_min, float(swaps[-1]["recorded_at_min"]))
        if not trained.get("shadowing") or trained.get("duration_min") is None:
            return first_min
        return first_min + float(trained["duration_min"] * (trained["chunks"] - 1) / trained["chunks"])

    def outputs(self, observation: Float[np.ndarray, " observations"]) -> Float32[np.ndarray, " outputs"]:
        """The network's outputs for an observation in physical units.

        Raises InvalidArgument for one of the wrong shape, or with NaN or infinity, which would pass for an action.
        """
        shape = self.scales.shape
        # The attribute is read first: `np.shape` takes much longer, at every decision.
        if getattr(observation, "shape", None) != shape and np.shape(observation) != shape:
            got, name = np.shape(observation), self.robot.name
            raise InvalidArgument(f"observation: expected one of {name}, shape {shape}, got shape {got}")
        # From JAX too, such as `environment.observe(state)`.
        hidden = np.asarray(observation) / self.scales
        if not np.isfinite(hidden).all():
            raise InvalidArgument(f"observation: expected finite numbers, got {np.asarray(observation).tolist()}")
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = hidden @ weight
            hidden += bias
            np.maximum(hidden, 0.0, out=hidden)
        return hidden @ self.weights[-1] + self.biases[-1]  # type: ignore[no-any-return]

    def probabilities(self, observation: Float[np.ndarray, " observations"]) -> Float32[np.ndarray, " actions"]:
        """The probability of each discrete action: softmax of the outputs."""
        logits = self.outputs(observation)
        exponentials = np.exp(logits - logits.max())
        return exponentials / exponentials.sum()  # type: ignore[no-any-return]

    def act(self, observation: Float[np.ndarray, " observations"], rng: np.random.Generator) -> Action:
        """Draw an action for an observation in physical units."""
        expect_kind("rng", rng, np.random.Generator, "a generator, such as np.random.default_rng(1)")
        if self.n_actions is None:
            mean, log_std = np.split(self.outputs(observation).astype(np.float64), 2)
            return _squash(mean + np.exp(np.clip(log_std, -5.0, 2.0)) * rng.standard_normal(len(mean)))
        below = np.cumsum(self.probabilities(observation))
        return min(int(np.searchsorted(below, rng.random() * below[-1], side="right")), len(below) - 1)

    def act_greedily(self, observation: Float[np.ndarray, " observations"]) -> Action:
        """The most probable action; for continuous commands tanh of the mean."""
        outputs = self.outputs(observation)
        if self.n_actions is not None:
            return int(outputs.argmax())
        return _squash(outputs[: len(outputs) // 2].astype(np.float64))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy as safetensors, with everything that is not an array as JSON in its metadata.

        Raises InvalidFile if it cannot be written, which leaves an existing file unchanged, and InvalidArgument for a
        robot or a mapping that is not registered, as the file could not be loaded.
        """
        from safetensors.numpy import save

        ROBOTS.expect_loadable(without_goal(self.robot))
        if self.mapping is not None:
            MAPPINGS.expect_loadable(self.mapping)

        arrays = {"scales": self.scales, "learning_curve": self.learning_curve}
        if len(self.assessments):
            arrays["assessments"] = self.assessments
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"layer{i}.weight": weight, f"layer{i}.bias": bias}
        description = {
            "format": FORMAT,
            "hidden_activation": HIDDEN_ACTIVATION,
            **body_and_goal(self.robot),
            "mapping": None if self.mapping is None else mapping_to_data(self.mapping),
            "conditions": [asdict(condition) for condition in self.conditions],
            "commands": self.commands,
            "window_ms": self.window_ms,
            "presentation": None if self.presentation is None else asdict(self.presentation),
            "provenance": dict(self.provenance),
            "readouts": self.readouts.to_dict(),
            "neural_observation": self.neural_observation,
            "pulse_cost": self.pulse_cost,
        }
        # A single entry, as safetensors writes several in random order, and equal policies must give equal files.
        metadata = {"animat": json.dumps(description, sort_keys=True)}
        write_whole(Path(path), save({name: np.ascontiguousarray(array) for name, array in arrays.items()}, metadata))

    @staticmethod
    @checked_arguments
    def load(path: str | os.PathLike[str]) -> Policy:
        """Read a policy that `save` wrote.

        Raises InvalidFile if it is missing, damaged, or not a policy in this format; or, with what to import, if its
        robot or mapping is not registered here.
        """
        path = expect_plain_file(path, _MOST_BYTES)
        arrays, description = _read_arrays(path)
        try:
            return Policy(
                weights=tuple(arrays[f"layer{i}.weight"] for i in range(_LAYERS)),
                biases=tuple(arrays[f"layer{i}.bias"] for i in range(_LAYERS)),
                scales=arrays["scales"],
                robot=robot_of(description),
                mapping=None if description["mapping"] is None else mapping_from_data(description["mapping"]),
                conditions=abbreviated(read_record(tuple[Condition, ...], description["conditions"], "conditions")),
                commands=None if description["commands"] is None else tuple(description["commands"]),
                window_ms=None if description["window_ms"] is None else tuple(description["window_ms"]),
                presentation=None if (how := description["presentation"]) is None else Presentation(**how),
                provenance=description["provenance"],
                learning_curve=whole_curve(arrays["learning_curve"]),
                assessments=arrays.get("assessments", np.zeros((0, 5))),
                # Policies in older files read all channels as one, and saw only the robot.
                readouts=Readouts.from_dict(description.get("readouts")),
                neural_observation=description.get("neural_observation", False),
                pulse_cost=description.get("pulse_cost", 0.0),
            )
        except (KeyError, TypeError, ValueError, OverflowError, AnimatError) as error:
            reason = f"no entry {error}" if isinstance(error, KeyError) else error
            raise InvalidFile(f"{path}: this policy cannot be loaded: {reason}") from error


def whole_curve(curve: Float[np.ndarray, "*_ columns"]) -> Float[np.ndarray, "*_ columns"]:
    """Learning curves with all columns; older files have the first three."""
    if curve.shape[-1:] != (3,):
        return curve
    return np.concatenate([curve, np.full((*curve.shape[:-1], len(CURVE) - 3), np.nan, curve.dtype)], axis=-1)


def _squash(z: Float64[np.ndarray, " commands"]) -> float | Float64[np.ndarray, " commands"]:
    """Continuous commands, tanh(z); a single one as a number."""
    return math.tanh(z[0]) if len(z) == 1 else np.tanh(z)


def _read_arrays(path: Path) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """A policy's arrays and its description; a file with other arrays is refused unread."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if "animat" not in metadata:
                raise InvalidFile(f"{path}: expected a policy of animat, got another kind of safetensors file")
            kinds = {name: file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118
            if set(kinds) - {"assessments"} != set(_ARRAYS) or not set(kinds.values()) <= {"F32", "F64"}:
                listing = ", ".join(f"{name} {kind}" for name, kind in kinds.items())
                expected = f"a policy's arrays ({', '.join(_ARRAYS)}) of F32 or F64"
                raise InvalidFile(f"{path}: expected {expected}, got {listing[:400]}")
            arrays = {name: file.get_tensor(name) for name in kinds}
    except (SafetensorError, OSError, ValueError) as error:
        reason = str(error).removeprefix("Error while deserializing header: ")
        got = f"a file that cannot be read as one ({reason})"
        raise InvalidFile(f"{path}: expected a policy, as animat train writes it, got {got}") from error
    with in_file(path):
        description = json_data(metadata["animat"], "metadata")
        file_format = description.get("format") if isinstance(description, dict) else description
        if file_format != FORMAT:
            raise InvalidArgument(f"expected the format {FORMAT!r}, got {shown(file_format)}")
        # Older files lack this entry, and use this activation.
        activation = description.get("hidden_activation", HIDDEN_ACTIVATION)
        if activation != HIDDEN_ACTIVATION:
            raise InvalidArgument(f"expected hidden layers of {HIDDEN_ACTIVATION!r}, got {shown(activation)}")
    return arrays, description


@checked_arguments
def first_of_alike(policies: Dict[str, Policy], attributes: Sequence[str], advice: str) -> Policy:
    """The first of several policies, which represents all of them.

    `attributes` include their conditions. Raises Mismatch if one differs, or stimuli do; InvalidArgument for none.
    """
    if not policies:
        raise InvalidArgument("policies: expected at least one, got none")
    first_name, first = next(iter(policies.items()))
    for name, policy in policies.items():
        for attribute in (*attributes, "neural_observation"):
            if getattr(policy, attribute) != getattr(first, attribute):
                raise Mismatch(f"{name}: expected the same {attribute} as {first_name}, got a different one; {advice}")
        if others := stimulus_mismatch(first.conditions, policy.conditions):
            raise Mismatch(f"{name}: conditions: {others}, unlike {first_name}; {advice}")
    return first


@checked_arguments
def load_policies(path: str | os.PathLike[str]) -> dict[str, Policy]:
    """Read policies by name, in the order of their numbers (p2 before p10); `path`: a policy file, or a folder of them.

    Raises InvalidFile if there is none, or one cannot be read.
    """
    path = Path(path)
    if not is_folder(path):
        if is_absent(path):
            raise InvalidFile(f"{path}: expected a policy or a folder of policies, got no such file; train them first")
        return {path.stem: Policy.load(path)}
    if not os.access(path, os.R_OK | os.X_OK):
        raise InvalidFile(f"{path}: cannot be read: {os.strerror(errno.EACCES)}")
    # Hidden files are unfinished: a process was killed while writing them.
    whole = [file for file in path.glob("*.safetensors") if not file.name.startswith(".")]
    files = sorted(whole, key=lambda file: (len(file.name), file.name))
    if not files:
        raise InvalidFile(f"{path}: expected policies (*.safetensors) in the folder, got none; train them first")
    return {file.stem: Policy.load(file) for file in files}
