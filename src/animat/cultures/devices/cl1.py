"""A culture on a Cortical Labs CL1 or in its simulator, through the vendor's package cl-sdk (the extra `cl1`)."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Int64

from animat.cultures.base import Culture
from animat.cultures.devices.cl1_delivery import FRAMES_PER_S, LEAD_US, Delivery
from animat.cultures.failures import as_device_failure, describe_error
from animat.cultures.history import History
from animat.cultures.holding import of_the_machine, of_the_program
from animat.cultures.observed import Observed, Spikes
from animat.cultures.pace import Pace
from animat.cultures.safety import Admitted, Limits
from animat.errors import AnimatError, DeviceFailed, InvalidArgument
from animat.extras import install_command
from animat.recordings.formats.cl1_layout import CHANNELS, NO_STIMULATION, SITES, STIMULUS_STREAM
from animat.recordings.recording import Channels, RecordedCulture
from animat.stimulation.array import ElectrodeArray
from animat.stimulation.patterns import draw_patterns
from animat.stimulation.pulse import Phase, Pulse
from animat.tables import UNKNOWN, padded

QUEUEING_S = 0.5
"""How long a stop waits while a pulse is being queued."""

CL1_LIMITS = Limits(
    kind="current",
    amplitude=3.0,
    phase_us=(20.0, 10_000.0),
    charge_per_phase=3.0,
    # The SDK does not check balance, which matters to a culture. The tolerance is for rounding: a femtocoulomb.
    net_charge=1e-6,
    net_charge_per_session=1e-3,
    electrodes_at_once=len(SITES),
    stimuli_per_electrode_s=200,
    stimuli_per_s=200,
    stimuli_per_session=1_000_000,
    phases_per_pulse=3,
    alternates=True,
    phase_step_us=20.0,
    interval_us=5_000.0,
    gap_us=float(LEAD_US),
)
"""The SDK's own limits (3 uA, 3 nC per phase, 20 us steps, alternating signs, 200 Hz, 80 us lead), and balance."""

CL1_PULSE = Pulse((Phase(160.0, amplitude_ua=-1.0), Phase(160.0, amplitude_ua=1.0)))
"""Balanced, cathodic first, 0.16 nC per phase: the SDK's default pulse for a current of 1 uA."""


class CL1Culture(Culture):
    """A culture on a CL1, or on the SDK's simulator if that is installed.

    Its clock is the device's, which runs on between calls, when nothing is observed. Stimuli run at frames of that
    clock, so intervals within a delivery are exact to a frame (40 us). A delivery as a whole can begin late, by a tick,
    a lead time and the computer's delay, as its `stimulus_time_s` shows. Every requested pulse is looked up among those
    that the device reports.

    Args:
        patterns: channels that are pulsed together, rows padded with -1; None: 100 sets of five, no two of a set
            neighbours, drawn with `seed`.
        seed: decides the patterns.
        ticks_per_s: of the loop that reads the spikes; a delivery lasts whole ticks.
        margin_ms: from a tick to the first pulse that can follow it, in addition to the lead time.
        jitter_tolerance_ms: how late the loop may run before the device gives up; None: without limit, as nothing is
            decided within the loop.
        pitch_um: between electrodes, for positions; None: unknown.
        record_to: a folder for the SDK's own recording of each session (H5), with the parameters of each stimulus in
            the data stream `animat_stimuli`; None: no such recording.
        raw: whether that recording keeps raw samples.
        limits: tighter limits than `CL1_LIMITS`.

    Raises:
        InvalidArgument: for a pattern with a channel that cannot stimulate, or another invalid setting.
    """

    name: ClassVar[str] = "cl1"

    def __init__(
        self,
        patterns: Sequence[Sequence[int]] | Int64[np.ndarray, "patterns size"] | None = None,
        *,
        seed: int = 0,
        ticks_per_s: int = 1000,
        margin_ms: float = 0.5,
        jitter_tolerance_ms: float | None = None,
        pitch_um: float | None = None,
        record_to: str | os.PathLike[str] | None = None,
        raw: bool = False,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(limits)
        if not 1 <= ticks_per_s <= FRAMES_PER_S:
            raise InvalidArgument(f"ticks_per_s: expected 1 to {FRAMES_PER_S:,}, got {ticks_per_s}")
        if not 0 <= margin_ms <= 1000:
            raise InvalidArgument(f"margin_ms: expected 0 to 1000 ms, got {margin_ms}")
        if jitter_tolerance_ms is not None and not jitter_tolerance_ms >= 0:
            raise InvalidArgument(f"jitter_tolerance_ms: expected 0 ms or more, or None, got {jitter_tolerance_ms}")
        self._patterns = _draw_patterns(seed) if patterns is None else _check_patterns(patterns)
        self._seed = seed if patterns is None else None
        self._ticks_per_s = ticks_per_s
        self._margin_frames = round(margin_ms * 1e-3 * FRAMES_PER_S)
        self._jitter: dict[str, Any] = {"ignore_jitter": True}
        if jitter_tolerance_ms is not None:
            self._jitter = {"jitter_tolerance_frames": round(jitter_tolerance_ms * 1e-3 * FRAMES_PER_S)}
        self._channels = _channel_table(pitch_um)
        self._record_to, self._raw = record_to, raw
        self._stack = ExitStack()
        self._cl: ModuleType | None = None
        self._neurons: Any = None
        self._stream: Any = None
        self._delivery: Delivery | None = None
        self._begun = History()
        self._halted = threading.Event()
        self._lock = threading.RLock()
        self.spikes_not_on_electrodes = 0
        """Spikes that the device reported on ground or reference, which are not recording electrodes; left out."""

    @property
    def channels(self) -> Channels:
        """The 59 electrodes, without ground and reference."""
        return self._channels

    @property
    def stimulation_electrodes(self) -> tuple[int, ...]:
        """All of them, by channel number."""
        return SITES

    @property
    def patterns(self) -> Int64[np.ndarray, "patterns size"]:
        return self._patterns

    @property
    def device(self) -> Path:
        """The CL1 on this machine; each program has its own SDK simulator."""
        return of_the_program("cl1-simulator") if _sdk().is_simulator() else of_the_machine("cl1")

    @property
    def device_limits(self) -> Limits:
        return CL1_LIMITS

    @property
    def now_s(self) -> float:
        """The device's clock, which starts with the device, not when it is opened."""
        neurons = self._opened_neurons()
        with as_device_failure("CL1", "report its time"):
            return float(neurons.timestamp() / FRAMES_PER_S)

    @property
    def sampling_rate_hz(self) -> float:
        return float(FRAMES_PER_S)

    @property
    def recorded_as(self) -> RecordedCulture:
        """The kind, with the seed of its patterns if they were drawn."""
        self._opened_neurons()
        assert self._cl is not None
        with as_device_failure("CL1", "report what it is"):
            return RecordedCulture("cl1", self._seed, bool(self._cl.is_simulator()))

    @property
    def provenance(self) -> dict[str, str]:
        """The device's own identifiers, and whether it is a simulator."""
        self._opened_neurons()
        assert self._cl is not None
        with as_device_failure("CL1", "identify itself"):
            attributes = self._cl.get_system_attributes()
            kind = "the SDK's simulator" if self._cl.is_simulator() else "device"
        names = ("system_id", "chip_id", "cell_batch_id", "project_id")
        return {
            # As in existing recordings, though the module has moved: a series continues only if this text stays.
            "source": f"CL1 ({kind}) by animat.cultures.cl1",
            "ticks_per_s": str(self._ticks_per_s),
            "pattern_seed": "none: they were given" if self._seed is None else str(self._seed),
            **{name: str(attributes[name]) for name in names if name in attributes},
        }

    @property
    def left_out(self) -> dict[str, int]:
        return {"spikes on ground or reference": self.spikes_not_on_electrodes}

    def _open(self) -> None:
        self._cl = _sdk()
        # New for each session: a delivery of an earlier one that hung and resumes sees its own event, which stays set.
        self._halted = threading.Event()
        self.spikes_not_on_electrodes = 0
        try:
            self._neurons = self._stack.enter_context(self._cl.open(take_control=True, wait_until_recordable=True))
            if (rate_hz := self._neurons.get_frames_per_second()) != FRAMES_PER_S:
                raise DeviceFailed(f"CL1: expected {FRAMES_PER_S} frames a second, got {rate_hz}")
            if (count := self._neurons.get_channel_count()) != CHANNELS:
                raise DeviceFailed(f"CL1: expected {CHANNELS} channels, got {count}")
            if self._record_to is not None:
                folder = Path(self._record_to).resolve()
                folder.mkdir(parents=True, exist_ok=True)
                recording = self._neurons.record(file_location=str(folder), include_raw_samples=self._raw)
                self._stack.callback(recording.stop)
                self._stream = self._neurons.create_data_stream(STIMULUS_STREAM)
        except AnimatError:
            raise
        except Exception as error:
            raise DeviceFailed(
                f"CL1: expected a device to open, got {describe_error(error)}: is another program using it?"
            ) from error
        self._delivery = Delivery(
            self._cl,
            self._neurons,
            Pace(self.limits, SITES, self._begun, self.now_s),
            ticks_per_s=self._ticks_per_s,
            margin_frames=self._margin_frames,
            jitter=self._jitter,
            log=self._log,
            lock=self._lock,
        )

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        if duration_s == 0:
            return Observed(self.now_s, 0.0, Spikes(np.empty(0), np.empty(0, np.int64)), np.empty(0))
        assert self._delivery is not None
        try:
            start, stop, frame, channel, begun = self._delivery.run(
                admitted.stimuli,
                duration_s,
                since=round(admitted.now_s * FRAMES_PER_S),
                is_halted=self._halted.is_set,
            )
        except BaseException as error:
            outcome = "what had not begun was interrupted"
            try:
                self._interrupt()
            except Exception as failed:
                outcome = (
                    f"and it could not be interrupted ({describe_error(failed)}): make sure it gives no more pulses"
                )
                error.add_note(outcome)
            if isinstance(error, AnimatError) or not isinstance(error, Exception):
                raise
            raise DeviceFailed(
                f"CL1: expected a loop over {duration_s:g} s, got {describe_error(error)}: "
                f"{outcome}{self._remedy(error)}"
            ) from error
        row = _ROW_OF[channel]
        self.spikes_not_on_electrodes += int(np.count_nonzero(row == UNKNOWN))
        frame, row = frame[row != UNKNOWN], row[row != UNKNOWN]
        order = np.lexsort((row, frame))
        return Observed(
            start_s=start / FRAMES_PER_S,
            duration_s=(stop - start) / FRAMES_PER_S,
            spikes=Spikes((frame[order] - start) / FRAMES_PER_S, row[order]),
            stimulus_time_s=(begun - start) / FRAMES_PER_S,
        )

    def _rest(self, duration_s: float) -> None:
        neurons = self._opened_neurons()
        now = int(neurons.timestamp())
        until = now + int(np.ceil(duration_s * FRAMES_PER_S))
        # In pieces of a second, well under the five seconds that the SDK buffers.
        while now < until:
            piece = min(FRAMES_PER_S, until - now)
            try:
                neurons.read(piece, now)
            except TimeoutError as error:
                raise DeviceFailed(
                    f"CL1: expected to rest {duration_s:g} s, got {describe_error(error)}{self._remedy(error)}"
                ) from error
            now += piece

    def _remedy(self, error: Exception) -> str:
        """What to do if the SDK's simulator was too slow; empty for other errors, and on a device."""
        if self._cl is None or "Timeout waiting for timestamp" not in str(error) or not self._cl.is_simulator():
            return ""
        return "; the simulator did not keep up: run without CL_SDK_ACCELERATED_TIME, or with nothing else running"

    def _halt(self) -> None:
        # First of all: a delivery checks it, with the lock held, before it queues a pulse.
        self._halted.set()
        # Wait while a pulse is being queued, but not for ever: the queue must be cleared even if that hangs.
        is_held = self._lock.acquire(timeout=QUEUEING_S)
        try:
            self._interrupt()
        finally:
            if is_held:
                self._lock.release()

    def _close(self) -> None:
        self._halted.set()
        try:
            self._interrupt()
        finally:
            self._neurons = self._stream = self._delivery = None
            self._stack.close()

    def _interrupt(self) -> None:
        """Stop pulses in progress on every channel, and clear the queue."""
        cl, neurons = self._cl, self._neurons
        if cl is not None and neurons is not None:
            neurons.interrupt(cl.ChannelSet(*SITES))

    def _log(self, frame: int, parameters: dict[str, Any]) -> None:
        if self._stream is not None:
            self._stream.append(frame, json.dumps(parameters))

    def _opened_neurons(self) -> Any:
        if self._neurons is None:
            raise InvalidArgument("culture: expected an open one, got a closed one: use it as `with culture:`")
        return self._neurons


_ROW_OF = np.full(CHANNELS, UNKNOWN, dtype=np.int64)
_ROW_OF[list(SITES)] = np.arange(len(SITES))


def _sdk() -> ModuleType:
    try:
        import cl
    except ImportError as error:
        raise DeviceFailed(
            "culture: expected the vendor's package cl-sdk for a cl1, which is not installed: on Python 3.12 or later "
            f"{install_command('cl1')} (its licence is CC BY-NC 4.0); on a CL1 it is preinstalled"
        ) from error
    sdk: ModuleType = cl
    return sdk


def _check_patterns(
    patterns: Sequence[Sequence[int]] | Int64[np.ndarray, "patterns size"],
) -> Int64[np.ndarray, "patterns size"]:
    rows = [[int(channel) for channel in row if channel != UNKNOWN] for row in patterns]
    for number, row in enumerate(rows):
        if not row or len(set(row)) < len(row):
            raise InvalidArgument(f"patterns: expected distinct channels in each, got {row} as number {number}")
        for channel in row:
            if channel in NO_STIMULATION:
                raise InvalidArgument(
                    f"patterns: expected channels that can stimulate, got channel {channel} in number {number}, which "
                    f"is {NO_STIMULATION[channel]}: the SDK would not report it; choose another"
                )
            if not 0 <= channel < CHANNELS:
                raise InvalidArgument(f"patterns: expected channels from 0 to 63, got {channel} in number {number}")
    if not rows:
        raise InvalidArgument("patterns: expected at least one, got none")
    table = padded(rows)
    table.setflags(write=False)
    return table


def _draw_patterns(seed: int) -> Int64[np.ndarray, "patterns size"]:
    """100 patterns of five channels, no two of which are neighbours in a row or column."""
    # Channels are numbered down the columns; distances are the same as along the rows.
    grid = ElectrodeArray("CL1", columns=8, rows=8, pitch_um=1.0, channels=CHANNELS, stimulation_units=len(SITES))
    return _check_patterns(draw_patterns(grid, np.array(SITES), seed=seed, spacing_um=1.0))


def _channel_table(pitch_um: float | None) -> Channels:
    channel = np.array(SITES, dtype=np.int64)
    pitch = np.nan if pitch_um is None else float(pitch_um)
    return Channels(
        label=channel.astype(np.str_), electrode=channel, x_um=(channel // 8) * pitch, y_um=(channel % 8) * pitch
    )
