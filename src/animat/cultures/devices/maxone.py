"""A culture on a MaxWell MaxOne, through the vendor's module `maxlab`, which comes with MaxLab Live."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Int64

from animat.cultures.base import Culture
from animat.cultures.devices.maxone_commands import FRAMES_PER_S, INITIAL_DELAY, SAMPLE_US, Routing, Sequences, route
from animat.cultures.devices.maxone_stream import AMPLIFIERS, SpikeStream, ZmqSpikes
from animat.cultures.failures import as_device_failure, describe_error, once_opened, vendor_module, while_open
from animat.cultures.holding import of_the_machine
from animat.cultures.observed import Observed, observed_in_frames
from animat.cultures.safety import Admitted, Guard, History, Limits
from animat.errors import DeviceFailed, InvalidArgument, expect_kind
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Channels
from animat.stimulation.selection import Selection
from animat.stimulation.stimulus import Stimulus
from animat.tables import UNKNOWN

_NO_MODULE = (
    "maxlab: expected the vendor's Python module, got none: it comes with MaxLab Live (MaxWell Biosystems), and no "
    "package index has it; run where it is installed"
)
DAC_STEPS = 511
"""Converter codes on either side of 0 V."""

MAXONE_LIMITS = Limits(
    kind="voltage",
    amplitude=400.0,
    phase_us=(SAMPLE_US, 1000.0),
    charge_per_phase=200.0,
    # After rounding by the converter; the tolerance is for floating-point errors.
    net_charge=1e-6,
    net_charge_per_session=1e-3,
    electrodes_at_once=32,
    stimuli_per_electrode_s=100,
    stimuli_per_s=200,
    stimuli_per_session=1_000_000,
    phases_per_pulse=4,
    alternates=True,
    phase_step_us=SAMPLE_US,
    interval_us=10_000.0,
    gap_us=1_000.0,
)
"""Ours, not the vendor's, whose converter reaches 1.5 V: for a living culture, up to twice the paper's pulse.
`amplitude_step` is the converter's, queried from the device at opening."""


class MaxOneCulture(Culture):
    """A culture on a MaxOne: the selected electrodes, with one stimulation unit per site, all driven by one converter.

    Times are exact (50 us) within a sequence of stimuli; the computer determines when it starts, so `stimulus_time_s`
    is an estimate. `stop` cuts the power of all units. Never run on a device: `docs/hardware.md` has more, and lists
    what was tested, and against what.

    Args:
        selection: electrodes to record, to stimulate, and the patterns.
        stream: source of the spikes; None: the vendor's server, through ZeroMQ.
        sequence_s: the longest span of one sequence.
        settle: whether to wait as long as the vendor specifies after each step of opening.
        limits: tighter limits than `MAXONE_LIMITS`.

    Raises:
        InvalidArgument: for a selection on another array, or without sites, or an invalid `sequence_s`.
    """

    name: ClassVar[str] = "maxone"
    sampling_rate_hz = float(FRAMES_PER_S)
    stretch_s = 60.0
    recorded_as = RecordedCulture("maxone")

    def __init__(
        self,
        selection: Selection,
        *,
        stream: SpikeStream | None = None,
        sequence_s: float = 1.0,
        settle: bool = True,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(limits)
        expect_kind("selection", selection, Selection, "a selection, as animat.Selection.load returns")
        array = selection.array
        if (array.columns, array.rows) != (220, 120):
            raise InvalidArgument(f"selection: expected one on a MaxOne, got one on a {array.name}")
        recording, stimulation = len(selection.recording), len(selection.stimulation)
        if not (1 <= recording <= array.channels and 1 <= stimulation <= array.stimulation_units):
            expected = f"1 to {array.channels:,} recording and 1 to {array.stimulation_units} stimulation sites"
            got = f"{recording:,} and {stimulation:,}"
            raise InvalidArgument(f"selection: expected {expected}, got {got}")
        if not 0 < sequence_s <= 60:
            raise InvalidArgument(f"sequence_s: expected above 0 to 60 s, got {sequence_s}")
        self.selection = selection
        self._given_stream, self._sequence_s, self._settle = stream, sequence_s, settle
        self._mx: ModuleType | None = None
        self._stream: SpikeStream | None = None
        self._routing: Routing | None = None
        self._sequences: Sequences | None = None
        self._guard: Guard | None = None
        """On the device's clock."""
        self._begun = History()
        self._lsb_mv = 0.0
        # The first frame, and the last one before closing.
        self._zero_frame, self._last_frame = 0, -1
        self._halted = threading.Event()
        self.spikes_not_recorded = 0
        """Spikes that the device reported on amplifiers without a recording electrode; left out."""

    @property
    def channels(self) -> Channels:
        """The recording electrodes that were routed, labelled by amplifier number."""
        return once_opened(self._routing).channels

    @property
    def not_routed(self) -> tuple[int, ...]:
        """Recording electrodes that were selected but not routed."""
        return once_opened(self._routing).not_routed

    @property
    def stimulation_electrodes(self) -> tuple[int, ...]:
        # All are connected, or the culture does not open.
        return tuple(self.selection.stimulation.tolist())

    @property
    def patterns(self) -> Int64[np.ndarray, "patterns size"]:
        return self.selection.patterns

    @property
    def device(self) -> Path:
        """The device of MaxLab Live's server on this machine."""
        return of_the_machine("maxone")

    @property
    def device_limits(self) -> Limits:
        """`MAXONE_LIMITS` with the device's own voltage step, once it is open."""
        reach_mv = DAC_STEPS * self._lsb_mv or MAXONE_LIMITS.amplitude
        return replace(MAXONE_LIMITS, amplitude=min(MAXONE_LIMITS.amplitude, reach_mv), amplitude_step=self._lsb_mv)

    @property
    def now_s(self) -> float:
        """Time since it was first opened, by the newest frame received."""
        with as_device_failure("MaxOne", "report its time"):
            return (while_open(self._stream).frame() - self._zero_frame) / FRAMES_PER_S

    @property
    def provenance(self) -> dict[str, str]:
        routing = once_opened(self._routing)
        units = ", ".join(f"{electrode}: {unit}" for electrode, unit in routing.unit_of.items())
        return {
            # Must not change, even if a module moves: a series continues only where it is the same.
            "source": "MaxOne by animat.cultures.maxone",
            "dac_lsb_mv": str(self._lsb_mv),
            "stimulation_units": units,
            "not_routed": " ".join(map(str, routing.not_routed)),
            "stimulus_times": "estimated: the newest frame when the server had taken the sequence, and its delay",
        }

    @property
    def left_out(self) -> dict[str, int]:
        names = ("lost_frames", "late_spikes", "dropped_spikes")
        lost, late, dropped = (int(getattr(self._stream, name, 0)) for name in names)
        counts = {"spikes on amplifiers without an electrode": self.spikes_not_recorded}
        counts |= {"frames lost on the way": lost, "spikes reported late": late}
        return counts | {"spikes dropped, as too many came in one delivery": dropped}

    def _open(self) -> None:
        self._mx = mx = vendor_module("maxlab", _NO_MODULE)
        # New for each session: a delivery of an earlier one that hung and resumes sees its own event, which stays set.
        self._halted = threading.Event()
        self.spikes_not_recorded = 0
        with as_device_failure("MaxOne", "open", ": is MaxLab Live's server running?"):
            mx.initialize()
            self._switch_power(True)
            self._wait("waitInit")
            self._lsb_mv = _step_mv(mx.query_DAC_lsb_mV())
            self._routing = route(mx, self.selection, wait=self._wait)
            self._sequences = Sequences(mx, self._routing.unit_of, self._lsb_mv)
            self._stream = self._given_stream or ZmqSpikes()
            self._stream.start()
        frame = self._stream.frame()
        if self._last_frame < 0:
            self._zero_frame = frame
        elif frame < self._last_frame:
            # The frame count restarted: the clock continues from where it was.
            self._zero_frame += frame - self._last_frame
        self._guard = Guard(self.limits, self.stimulation_electrodes, self._begun, frame / FRAMES_PER_S)

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        try:
            return self._send(admitted, duration_s)
        except BaseException as error:
            # A running sequence continues on the device: without power, neither it nor any later one has an effect.
            try:
                self.stop(f"a delivery was interrupted by {describe_error(error)}")
            except DeviceFailed as failed:
                error.add_note(f"and then: {failed}: make sure it gives no more pulses")
            raise

    def _send(self, admitted: Admitted, duration_s: float) -> Observed:
        """Send sequences on time, and read the spikes meanwhile."""
        stream, halted = while_open(self._stream), self._halted
        sequences, guard = while_open(self._sequences), while_open(self._guard)
        # The stream keeps spikes, so observation starts at the request, however long sequences take to build.
        start, late = self._zero_frame + round(admitted.now_s * FRAMES_PER_S), 0
        built = [(group, sequences.of(group)) for group in _groups(admitted.stimuli, self._sequence_s)]
        begun: list[int] = []
        for group, sequence in built:
            due = start + round(group[0].time_s * FRAMES_PER_S) + late
            relative = [replace(stimulus, time_s=stimulus.time_s - group[0].time_s) for stimulus in group]
            earliest = max(due, stream.frame() + INITIAL_DELAY)
            earliest = round(guard.earliest(relative, earliest / FRAMES_PER_S) * FRAMES_PER_S)
            stream.wait(earliest - INITIAL_DELAY)
            if halted.is_set():
                sent = f"{len(begun)} of {len(admitted.stimuli)} stimuli had been sent"
                raise DeviceFailed(f"MaxOne: stopped while delivering: {sent}, and the units have no power")
            sequence.send()
            # The pulse follows the initial delay after the server accepted the command: about now.
            first = stream.frame() + INITIAL_DELAY
            guard.admit(relative, first / FRAMES_PER_S)
            begun += [first + round(stimulus.time_s * FRAMES_PER_S) for stimulus in relative]
            late += first - due
            # Two simultaneous sequences would drive the same converter.
            stream.wait(begun[-1] + round(group[-1].pulse.duration_us / SAMPLE_US))
        if halted.is_set() and admitted.stimuli:
            raise DeviceFailed("MaxOne: stopped while delivering: the units have no power, so pulses may not have come")
        stop = max(start + int(np.ceil(duration_s * FRAMES_PER_S)) + late, stream.frame() if duration_s else start)
        stream.wait(stop)
        frames, amplifiers = stream.take(start, stop)
        if len(amplifiers) and not 0 <= amplifiers.min() <= amplifiers.max() < AMPLIFIERS:
            strange = amplifiers[(amplifiers < 0) | (amplifiers >= AMPLIFIERS)][0]
            raise DeviceFailed(f"MaxOne: expected spikes on amplifiers 0 to {AMPLIFIERS - 1}, got one on {strange}")
        row = once_opened(self._routing).row_of[amplifiers]
        self.spikes_not_recorded += int(np.count_nonzero(row == UNKNOWN))
        began = np.array(begun, dtype=np.float64)
        return observed_in_frames(start, stop, frames, row, began, FRAMES_PER_S, zero=self._zero_frame)

    def _rest(self, duration_s: float) -> None:
        stream = while_open(self._stream)
        until = stream.frame() + int(np.ceil(duration_s * FRAMES_PER_S))
        stream.wait(until)
        # Spikes during the rest are discarded.
        stream.take(until, until)

    def _halt(self) -> None:
        self._halted.set()
        self._switch_power(False)

    def _close(self) -> None:
        mx, routing = self._mx, self._routing
        # Whatever fails, the rest is still tried, in reverse order.
        with ExitStack() as steps:
            steps.callback(self._release)
            if self._sequences is not None:
                steps.callback(self._sequences.delete)
            if mx is not None and routing is not None:
                for unit in routing.unit_of.values():
                    steps.callback(mx.send, mx.StimulationUnit(unit).power_up(False).connect(False))
            steps.callback(self._switch_power, False)

    def _release(self) -> None:
        stream = self._stream
        # The routing stays readable; so do `device_limits`, for the next opening.
        self._mx = self._stream = self._sequences = self._guard = None
        if stream is not None:
            # -1 if no frame was received.
            self._last_frame = stream.frame() if stream.frame() >= 0 else self._last_frame
            stream.stop()

    def _switch_power(self, on: bool) -> None:
        mx = self._mx
        if mx is not None and (reply := mx.send(mx.Core().enable_stimulation_power(on))) != "Ok":
            state = "on" if on else "off"
            raise DeviceFailed(f"MaxOne: expected stimulation power to be switched {state}, got {reply!r}")

    def _wait(self, name: str) -> None:
        if self._settle and self._mx is not None:
            time.sleep(float(getattr(getattr(self._mx, "Timing", None), name, 5.0)))


def _step_mv(reply: Any) -> float:
    try:
        lsb_mv = float(reply)
    except (TypeError, ValueError):
        lsb_mv = np.nan
    if not 0.01 <= lsb_mv <= 100:
        raise DeviceFailed(f"MaxOne: expected the converter's step in mV, got {reply!r}: is the device connected?")
    return lsb_mv


def _groups(stimuli: Sequence[Stimulus], sequence_s: float) -> list[list[Stimulus]]:
    """The stimuli of each sequence, in order of time."""
    groups: list[list[Stimulus]] = []
    for stimulus in stimuli:
        if groups and stimulus.time_s - groups[-1][0].time_s < sequence_s:
            groups[-1].append(stimulus)
        else:
            groups.append([stimulus])
    return groups
