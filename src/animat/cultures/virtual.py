"""The virtual culture: a simulated tissue on a simulated MaxOne, behind the contract that hardware has."""

from __future__ import annotations

import dataclasses
import json
import os
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Int64

from animat.arguments import check_argument, checked_arguments
from animat.cultures.base import ComputedCulture
from animat.cultures.failures import once_opened
from animat.cultures.observed import Observed, Spikes
from animat.cultures.safety import Admitted, Limits
from animat.cultures.visibility import Visibility
from animat.errors import InvalidArgument, Mismatch, expect_at_least
from animat.plain_file import expect_plain_file
from animat.progress import Progress, Silent
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Channels
from animat.stimulation.array import MAXONE
from animat.stimulation.plain import number, whole_number
from animat.stimulation.pulse import PUBLISHED_PULSE
from animat.stimulation.scan import ScannedActivity
from animat.stimulation.selection import Selection, SelectionRule, select_electrodes
from animat.stimulation.stimulus import Stimulus

if TYPE_CHECKING:
    from animat.cultures.tissue import Pulse as TissuePulse
    from animat.cultures.tissue import Tissue, TissueParameters

NS = 1_000_000_000
WARM_UP_S = 5.0
"""Passes before anything is measured, as a new tissue is not yet in its steady state."""


class VirtualCulture(ComputedCulture):
    """A simulated culture on a simulated MaxOne; `docs/virtual-culture.md` describes its tissue.

    On first opening the array is scanned and electrodes are chosen; the tissue is then restored to its state before, so
    that a culture with those electrodes as `selection` is the same, spike for spike. The same requests give the same
    spikes, however time is divided. A pulse acts with a strength in proportion to the charge of its largest cathodic
    (negative) phase, the published pulse being 1. No artefact blinds the electrodes after a pulse (`record_traces` adds
    it).

    Args:
        seed: decides the tissue, the spike shapes, and the patterns; zero or more.
        selection: electrodes to use; None: scan and choose by `rule`, which takes some seconds.
        scan_s: how long the array is scanned, all blocks of 1,024 electrodes at once; in a shorter scan more neurons
            stay silent, and unseen.
        limits: tighter limits than `SIMULATED_LIMITS`.
        progress: updated during the scan.

    Raises:
        InvalidArgument: for an invalid setting.
    """

    name: ClassVar[str] = "virtual"
    sampling_rate_hz = 20_000.0
    """That of a MaxOne; spikes fall on the tissue's steps, which are four of its samples long."""
    stretch_s = 10.0
    """Its clock stands still between calls, and a block is the same in stretches."""

    def __init__(
        self,
        seed: int,
        *,
        parameters: TissueParameters | None = None,
        selection: Selection | None = None,
        rule: SelectionRule | None = None,
        scan_s: float = 20.0,
        limits: Limits | None = None,
        progress: Progress | None = None,
    ) -> None:
        super().__init__(limits)
        expect_at_least("seed", seed := whole_number("seed", seed), 0)
        check_argument("selection", selection, Selection | None)
        if not 0 < number("scan_s", scan_s) <= 3600:
            raise InvalidArgument(f"scan_s: expected above 0 to 3600 s, got {scan_s}")
        self.seed = seed
        self._parameters, self._rule, self._scan_s = parameters, rule or SelectionRule(), float(scan_s)
        self._progress = progress or Silent()
        self._selection = selection
        self.scan: ScannedActivity | None = None
        """Results of the scan; None if the electrodes were passed or restored."""
        self._tissue: Tissue | None = None
        self._visibility: Visibility | None = None
        self._channels: Channels | None = None
        self._zero_ns = 0
        self._now_ns = 0
        # Spikes later in the step that contains the clock's time, on the tissue's clock.
        self._held_ns, self._held_neuron = np.empty(0, np.int64), np.empty(0, np.int64)
        self.fired = np.empty(0), np.empty(0, np.int64)
        """Time from the start and neuron of every spike of the last delivery, whether or not an electrode sees it."""

    def __repr__(self) -> str:
        return f"VirtualCulture(seed={self.seed})"

    @property
    def tissue(self) -> Tissue:
        """The tissue, once opened, for inspection; advancing it directly breaks the culture's clock."""
        return once_opened(self._tissue)

    @property
    def selection(self) -> Selection:
        """The electrodes in use."""
        return once_opened(self._selection)

    @property
    def visibility(self) -> Visibility:
        """Which electrode sees which neuron, and how."""
        return once_opened(self._visibility)

    @property
    def channels(self) -> Channels:
        return once_opened(self._channels)

    @property
    def stimulation_electrodes(self) -> tuple[int, ...]:
        return tuple(self.selection.stimulation.tolist())

    @property
    def patterns(self) -> Int64[np.ndarray, "patterns size"]:
        return self.selection.patterns

    @property
    def n_patterns(self) -> int:
        """Number of patterns, known before opening."""
        return self._rule.patterns if self._selection is None else len(self._selection.patterns)

    @property
    def now_s(self) -> float:
        """The culture's clock: 0 when it was first opened."""
        return (self._now_ns - self._zero_ns) / NS

    @property
    def provenance(self) -> dict[str, str]:
        """The settings, and the electrodes in use."""
        return {
            **self.settings,
            "stimulation_electrodes": " ".join(map(str, self.selection.stimulation.tolist())),
            "selection": f"{len(self.selection.recording)} of {self.selection.passed} electrodes that passed, of "
            f"{self.selection.scanned} scanned",
        }

    @property
    def recorded_as(self) -> RecordedCulture:
        return RecordedCulture("virtual", self.seed)

    @property
    def settings(self) -> dict[str, str]:
        """Everything that determines the culture's behaviour, known before opening."""
        from animat.cultures.tissue.parameters import REVISION, TissueParameters

        return {
            "source": "virtual culture: simulated by animat.cultures.virtual",
            "seed": str(self.seed),
            "scan_s": str(self._scan_s),
            "selection_rule": json.dumps(dataclasses.asdict(self._rule)),
            "tissue_revision": str(REVISION),
            "tissue_parameters": json.dumps(dataclasses.asdict(self._parameters or TissueParameters())),
        }

    @checked_arguments
    def save_state(self, path: str | os.PathLike[str], **remarks: int) -> None:
        """Write the state, to continue from bit for bit, and whole numbers as remarks; InvalidFile if that fails."""
        from animat.cultures.virtual_state import VirtualState, write_state

        held = self._held_ns, self._held_neuron
        state = VirtualState(self.selection, self._zero_ns, self._now_ns, *held, self.tissue.snapshot(), remarks)
        write_state(path, self.settings, state)

    @checked_arguments
    def restore_state(self, path: str | os.PathLike[str]) -> dict[str, int]:
        """Restore the state of a culture of the same seed, settings and electrodes, and return the remarks.

        Raises:
            InvalidFile: if the file is missing or damaged.
            Mismatch: for the state of another culture.
            InvalidArgument: for a culture that is open.
        """
        from animat.cultures.virtual_state import read_state

        if self.is_open:
            raise InvalidArgument("culture: expected a closed one to restore, got one that is open")
        path = expect_plain_file(path)
        tissue, visibility = self._grown()
        state = read_state(path, self.settings, tissue)
        if self._selection is not None and self._selection.to_dict() != state.selection.to_dict():
            remedy = "use the same electrodes, or start another culture in another folder"
            raise Mismatch(f"{path}: expected this culture's state, got one which differs in selection: {remedy}")
        # Only now: a failed restore leaves the culture unchanged.
        self._tissue, self._visibility = tissue, visibility
        self._selection, self._zero_ns, self._now_ns = state.selection, state.zero_ns, state.now_ns
        self._held_ns, self._held_neuron = state.held_ns, state.held_neuron
        return dict(state.remarks)

    def _open(self) -> None:
        if self._tissue is None:
            tissue, visibility = self._grown()
            tissue.advance(WARM_UP_S)
            if self._selection is None:
                before = tissue.snapshot()
                scan = self._scan_array(tissue, visibility)
                selection = select_electrodes(MAXONE, scan, self._rule, seed=self.seed)
                tissue.restore(before)
                self.scan, self._selection = scan, selection
            self._zero_ns = self._now_ns = round(tissue.now_s * NS)
            # Only now: a culture whose opening was interrupted is still new, and can be opened again.
            self._tissue, self._visibility = tissue, visibility
        else:
            # Compile here, and not while a loop waits: without a compilation cache it takes seconds.
            before = self._tissue.snapshot()
            self._tissue.advance(self._tissue.step_ns / NS)
            self._tissue.restore(before)
        self._map_channels()

    def _grown(self) -> tuple[Tissue, Visibility]:
        """A new tissue, and its visibility to the electrodes."""
        from animat.cultures.tissue import Tissue

        tissue = Tissue(self.seed, self._parameters)
        return tissue, Visibility(self.seed, MAXONE, tissue.x_um, tissue.y_um, tissue.is_excitatory)

    def _scan_array(self, tissue: Tissue, visibility: Visibility) -> ScannedActivity:
        """Spontaneous activity of the whole array at once; a real array scans its blocks one after the other."""
        rng = np.random.default_rng([self.seed, 12])
        self._progress.update(0, 1, f"scanning the array for {self._scan_s:g} s")
        spikes_of = np.bincount(tissue.advance(self._scan_s).neuron, minlength=len(tissue.x_um))
        blocks = [visibility.measure(block, spikes_of, self._scan_s, rng) for block in MAXONE.scan_blocks()]
        return ScannedActivity.from_blocks(blocks)

    def _map_channels(self) -> None:
        selection = self.selection
        self._channels = Channels.on(selection.array, selection.recording)
        pairs = self.visibility.pairs_of(selection.recording)
        order = np.lexsort((pairs.electrode, pairs.neuron))
        self._n_seen_by = np.bincount(pairs.neuron, minlength=len(self.tissue.x_um))
        # One row per neuron, filled from the left: a delivery of 12.5 ms has time for few array operations.
        self._is_seen = np.arange(self._n_seen_by.max(initial=0)) < self._n_seen_by[:, None]
        self._seen_by = np.zeros(self._is_seen.shape, dtype=np.int64)
        self._seen_by[self._is_seen] = pairs.electrode[order]

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        start_ns, tissue = self._now_ns, self.tissue
        end_ns = start_ns + round(duration_s * NS)
        tissue_ns = round(tissue.now_s * NS)
        stimulus_ns = [round(stimulus.time_s * NS) for stimulus in admitted.stimuli]
        # The tissue may be up to a step ahead; a pulse in the middle of a step acts at its end anyway.
        pulses = [
            _tissue_pulse(stimulus, max(start_ns + since_ns, tissue_ns))
            for stimulus, since_ns in zip(admitted.stimuli, stimulus_ns, strict=True)
        ]
        # To the end of the step that contains the end, so that every spike before the end is known.
        target_ns = -(-end_ns // tissue.step_ns) * tissue.step_ns
        if pulses and target_ns <= tissue_ns:
            target_ns = tissue_ns + tissue.step_ns
        time_ns_of, neuron = self._held_ns, self._held_neuron
        try:
            if target_ns > tissue_ns:
                fired_s, fired = tissue.advance((target_ns - tissue_ns) / NS, pulses)
                fired_ns = np.rint(fired_s * NS).astype(np.int64)
                time_ns_of = np.concatenate((time_ns_of, fired_ns)) if len(time_ns_of) else fired_ns
                neuron = np.concatenate((neuron, fired)) if len(neuron) else fired
            known = int(time_ns_of.searchsorted(end_ns))
            self._held_ns, self._held_neuron = time_ns_of[known:], neuron[known:]
            self._now_ns = end_ns
        except BaseException:
            self._end_at(end_ns)
            raise
        time_s, neuron = (time_ns_of[:known] - start_ns) / NS, neuron[:known]
        self.fired = time_s, neuron
        # Each spike, repeated on every channel that sees its neuron.
        spikes = Spikes(time_s.repeat(self._n_seen_by[neuron]), self._seen_by[neuron][self._is_seen[neuron]])
        stimulus_s = np.array(stimulus_ns, dtype=np.float64) / NS
        return Observed((start_ns - self._zero_ns) / NS, (end_ns - start_ns) / NS, spikes, stimulus_s)

    def _rest(self, duration_s: float) -> None:
        now_ns, tissue = self._now_ns + round(duration_s * NS), self.tissue
        target_ns = -(-now_ns // tissue.step_ns) * tissue.step_ns
        try:
            tissue.rest(max(0, target_ns - round(tissue.now_s * NS)) / NS)
        finally:
            self._end_at(now_ns)

    def _end_at(self, end_ns: int) -> None:
        """Set the clock to an end, or to how far the tissue has come if it was interrupted (Ctrl-C)."""
        self._now_ns = min(end_ns, round(self.tissue.now_s * NS))
        held = self._held_ns >= self._now_ns
        self._held_ns, self._held_neuron = self._held_ns[held], self._held_neuron[held]


def _tissue_pulse(stimulus: Stimulus, time_ns: int) -> TissuePulse:
    from animat.cultures.tissue import Pulse as TissuePulse

    x_um, y_um = MAXONE.position_um(np.array(stimulus.electrodes))
    half_um = MAXONE.pitch_um / 2
    # The charge of the largest cathodic phase, relative to the published pulse.
    cathodic = max(-phase.charge for phase in stimulus.pulse.phases)
    strength = max(0.0, cathodic / -PUBLISHED_PULSE.phases[0].charge)
    return TissuePulse(time_ns / NS, x_um + half_um, y_um + half_um, strength)
