"""Simulators by their kind, and those of a culture over its recordings, from which parameter shadowing refreshes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from animat.arguments import checked_arguments
from animat.errors import AnimatError, InvalidArgument, InvalidFile, Mismatch, in_min, shown
from animat.neurons.fidelity import Fidelity, fidelity
from animat.neurons.history import INITIAL_HISTORY, NO_MEMORY, Memory
from animat.neurons.memory import MemorySimulator, fit_memory
from animat.neurons.simulator import (
    EmpiricalSimulator,
    HistogramSimulator,
    JointHistogramSimulator,
    NeuronSimulator,
    check_binning,
    fit_empirical,
    fit_histogram,
    fit_joint_histogram,
    stacked,
    to_jax,
)
from animat.recordings.findings import Finding
from animat.recordings.recorded_culture import RecordedCulture, culture_of_series
from animat.records import json_data, read_record
from animat.responses.condition import Condition
from animat.responses.quality.one_culture import series_findings, series_mismatch
from animat.responses.readouts import ALL, Readouts
from animat.responses.responses import Responses
from animat.stimulation.protocol import Presentation
from animat.tables import briefly, freeze_one
from animat.writing import write_whole

SimulatorKind = Literal["histogram", "empirical", "memory"]
"""Draw from a distribution in bins (the paper); a measured response; or one measured after a similar history."""

_MEMORY_OF_BLOCKS = Finding(
    "memory-of-blocks",
    "warning",
    "in recordings presented in blocks each condition follows only itself: the simulator does not know how a culture "
    "responds after a different one; record with --order mixed",
)

_KINDS = {
    kind.__name__: kind for kind in (HistogramSimulator, JointHistogramSimulator, EmpiricalSimulator, MemorySimulator)
}

ALONE_MIN = 10.0
"""How long the simulator of a single recording holds: the paper's interval."""
SIMULATORS = 3
"""Revision of the fits, raised with every change that changes simulators. 3: weights below 0."""
_ROUNDING_MIN = 1e-9
"""Of minutes that are sums."""


@dataclass(frozen=True, eq=False)
class SimulatorTimeline:
    """Simulators of one culture, one per recording, stacked, with the times of the recordings.

    Attributes:
        simulators: one pytree whose arrays have a leading axis of recordings.
        start_min: minutes on the culture's clock, rising, shape (recordings,).
        conditions: from which the agent picks, the same in every recording.
        presentation: how stimuli were presented; None if it is not known.
        fidelities: how faithful each simulator is to its responses.
        fitted: how they were fitted: `kind`, `bins`, `range_hz`; `by`, the rule of the conditions; `burst_threshold`,
            if one was given; `burst_thresholds`, the active share above which each recording's responses were left out.
        findings: on the recordings and the fits, each beginning with the minute.
        responses: to which the simulators were fitted; empty if they come from elsewhere.
        readouts: that they answer for, the same in every recording.
        culture: that was recorded; None if it is not known.
    """

    __repr__ = briefly

    simulators: NeuronSimulator
    start_min: Float64[np.ndarray, " recordings"]
    conditions: tuple[Condition, ...]
    window_ms: tuple[float, float]
    presentation: Presentation | None
    fidelities: tuple[Fidelity, ...]
    findings: tuple[Finding, ...]
    fitted: dict[str, Any] = field(default_factory=dict)
    responses: tuple[Responses, ...] = ()
    readouts: Readouts = ALL
    culture: RecordedCulture | None = None

    def __post_init__(self) -> None:
        freeze_one(self, "start_min", np.float64)

    def __len__(self) -> int:
        return len(self.start_min)

    @property
    def span_min(self) -> float:
        """Minutes from the first recording to one usual interval after the last, for which its simulator holds."""
        gaps_min = np.diff(self.start_min)
        return float(self.start_min[-1] - self.start_min[0] + (np.median(gaps_min) if len(gaps_min) else ALONE_MIN))

    def findings_at(self, start_min: float) -> tuple[Finding, ...]:
        """The findings on the recording that started at a minute, and on its simulator."""
        return tuple(finding for finding in self.findings if finding.at_min == start_min)

    def row_at(self, minute: float) -> int:
        """The newest recording at a minute: the last one that started at or before it (before all: the first)."""
        return max(0, int(np.searchsorted(self.start_min, minute + _ROUNDING_MIN, side="right")) - 1)

    def requested_row(self, minute: float) -> int:
        """`row_at` a minute that a user gave; raises InvalidArgument for one before the first recording, or NaN."""
        if not minute >= self.start_min[0]:
            first = f"the first recording on, which started at {self.start_min[0]:g} min"
            raise InvalidArgument(f"at_min: expected a minute on the culture's clock from {first}, got {minute:g}")
        return self.row_at(minute)

    def at(self, minute: float) -> NeuronSimulator:
        """The simulator in use at a minute of the culture's clock."""
        row = self.row_at(minute)
        # Extracted on the host: JAX would compile a program for each shape.
        return jax.tree.map(lambda each: to_jax(np.asarray(each)[row], None), self.simulators)  # type: ignore[no-any-return]

    def with_percentiles(self, which: str) -> SimulatorTimeline:
        """These simulators, each with its own percentiles (`"moving"`) or with the first recording's (`"first"`)."""
        if which not in ("moving", "first"):
            raise InvalidArgument(f"which: expected moving or first, got {shown(which)}")
        if which == "moving":
            return self
        percentiles = np.asarray(self.simulators.percentiles)
        held = to_jax(np.broadcast_to(percentiles[:1], percentiles.shape), None)
        return replace(self, simulators=replace(self.simulators, percentiles=held))  # type: ignore[type-var]


def room_for(series: Sequence[Responses]) -> int:
    """The largest number of non-burst responses to a condition in any recording.

    With this much room, the simulators of all recordings have the same shape.
    """
    return max(int(np.bincount(each.condition[~each.is_burst], minlength=1).max()) for each in series)


def default_kind(responses: Responses) -> SimulatorKind:
    """The kind that suits a recording: one with memory, unless stimuli in blocks hide the memory."""
    return "histogram" if responses.is_blocked else "memory"


@checked_arguments
def fit_timeline(
    series: Sequence[Responses], *, kind: SimulatorKind | None = None, bins: int = 20, range_hz: float | None = None
) -> SimulatorTimeline:
    """Fit a simulator to each recording's responses and stack them in the order of time.

    Args:
        series: responses of the recordings, all with the same conditions, window and presentation, in any order.
        kind: as in `SimulatorKind`; None: `"memory"`, but `"histogram"` if stimuli were presented in blocks, which do
            not show how a culture responds after a different condition.
        bins, range_hz: of a histogram, the same for all recordings, as in `fit_histogram`.

    Raises:
        InvalidArgument: if there are no responses or the kind is unknown.
        Mismatch: if the recordings differ in conditions, window, presentation or readouts, or two share a minute.
        UnusableData: if a condition of a recording has no non-burst response.
    """
    ordered = sorted(series, key=lambda responses: responses.start_min)
    if not ordered:
        raise InvalidArgument("series: expected the responses of at least one recording, got none")
    first = ordered[0]
    check_binning(bins, range_hz)
    kind = kind or default_kind(first)
    if mismatch := series_mismatch(ordered):
        raise Mismatch(mismatch)
    start_min = np.array([responses.start_min for responses in ordered], dtype=np.float64)
    room = room_for(ordered)
    fitted = [fit_simulator(r, kind=kind, bins=bins, range_hz=range_hz, room=room) for r in ordered]
    fidelities = tuple(fidelity(r, simulator) for r, simulator in zip(ordered, fitted, strict=True))
    findings = tuple(
        replace(finding, message=f"at {in_min(responses.start_min)}: {finding.message}", at_min=responses.start_min)
        for responses, kept in zip(ordered, fidelities, strict=True)
        for finding in (*responses.findings, *kept.findings(of_memory=kind == "memory"))
    )
    if kind == "memory" and first.is_blocked:
        findings += (_MEMORY_OF_BLOCKS,)
    findings += tuple(series_findings(ordered))
    how = {
        "kind": kind,
        "bins": bins if kind == "histogram" else None,
        "range_hz": range_hz if kind == "histogram" else None,
        "by": first.by,
        "burst_threshold": first.burst_threshold,
        "burst_thresholds": [float(responses.threshold) for responses in ordered],
    }
    simulators = jax.tree.map(stacked, *fitted)
    same = first.conditions, first.window_ms, first.presentation
    culture = culture_of_series(responses.culture for responses in ordered)
    return SimulatorTimeline(
        simulators, start_min, *same, fidelities, findings, how, tuple(ordered), first.readouts, culture
    )


def save_timeline(timeline: SimulatorTimeline, path: Path) -> Path:
    """Write the simulators as safetensors, with everything but arrays as JSON metadata; always the same bytes."""
    # Those that an older version wrote may lack some.
    known = {name: array for name, array in vars(timeline.simulators).items() if array is not None}
    arrays = {name: np.ascontiguousarray(array) for name, array in known.items()}
    metadata = {
        "kind": type(timeline.simulators).__name__,
        "start_min": timeline.start_min.tolist(),
        "conditions": [asdict(condition) for condition in timeline.conditions],
        "window_ms": timeline.window_ms,
        "presentation": None if timeline.presentation is None else asdict(timeline.presentation),
        "in_data": [kept.in_data.tolist() for kept in timeline.fidelities],
        "in_simulator": [kept.in_simulator.tolist() for kept in timeline.fidelities],
        "n_above_range": [kept.n_above_range for kept in timeline.fidelities],
        "findings": [asdict(finding) for finding in timeline.findings],
        "fitted": timeline.fitted,
        "culture": None if timeline.culture is None else asdict(timeline.culture),
        **({} if timeline.readouts.are_all else {"readouts": timeline.readouts.to_dict()}),
    }
    return write_whole(path, save(arrays, metadata={"animat": json.dumps(metadata, sort_keys=True)}))


def load_timeline(path: Path) -> SimulatorTimeline:
    """Read what `save_timeline` wrote; raises InvalidFile if it cannot be read."""
    try:
        with safe_open(path, framework="numpy") as file:
            metadata: dict[str, Any] = json_data((file.metadata() or {})["animat"], "metadata")
            arrays = {name: to_jax(file.get_tensor(name), None) for name in file.keys()}  # noqa: SIM118 - no dictionary
        conditions = tuple(Condition(**each) for each in metadata["conditions"])
        labels = tuple(condition.label for condition in conditions)
        presentation = metadata["presentation"]
        kept = zip(metadata["in_data"], metadata["in_simulator"], metadata["n_above_range"], strict=True)
        readouts = Readouts.from_dict(metadata.get("readouts"))
        return SimulatorTimeline(
            simulators=_KINDS[metadata["kind"]](**arrays),
            start_min=np.array(metadata["start_min"], np.float64),
            conditions=conditions,
            window_ms=tuple(metadata["window_ms"]),
            presentation=None if presentation is None else Presentation(**presentation),
            fidelities=tuple(Fidelity(labels, np.array(a), np.array(b), n, readouts.names) for a, b, n in kept),
            findings=tuple(Finding.from_dict(each) for each in metadata["findings"]),
            fitted=metadata["fitted"],
            readouts=readouts,
            # Older files do not state it.
            culture=read_record(RecordedCulture, stated, "culture") if (stated := metadata.get("culture")) else None,
        )
    except (OSError, ValueError, KeyError, TypeError, RecursionError, SafetensorError, AnimatError) as error:
        reason = f"no entry {error}" if isinstance(error, KeyError) else error
        expected = "simulators as animat study and animat tune write them"
        got = f"another file ({reason}); run the command again to replace it"
        raise InvalidFile(f"{path}: expected {expected}, got {got}") from error


def fit_simulator(
    responses: Responses,
    *,
    kind: str = "histogram",
    bins: int = 20,
    range_hz: float | None = None,
    room: int | None = None,
    memory: Memory | None = None,
) -> NeuronSimulator:
    """Fit a simulator of a kind; arguments and errors are those of `fit_histogram`, `fit_empirical` and `fit_memory`.

    Histograms of several readouts need `room`, too.
    """
    check_kind(kind)
    if kind == "histogram" and len(responses.readouts) > 1:
        return fit_joint_histogram(responses, bins=bins, range_hz=range_hz, room=room)
    if kind == "histogram":
        return fit_histogram(responses, bins=bins, range_hz=range_hz)
    if kind == "empirical":
        return fit_empirical(responses, room=room)
    fitted = fit_memory(responses, room=room, memory=memory)
    # Without memory the trace keeps its initial value, as for policies in a loop (`HistoryTracker`).
    still = jnp.full_like(fitted.left, INITIAL_HISTORY[0])
    return replace(fitted, left=still) if fitted.memory == NO_MEMORY else fitted


def check_kind(kind: str) -> None:
    """Raise InvalidArgument for a kind of simulators that does not exist."""
    if kind not in get_args(SimulatorKind):
        raise InvalidArgument(f"kind: expected one of {', '.join(get_args(SimulatorKind))}, got {kind!r}")
