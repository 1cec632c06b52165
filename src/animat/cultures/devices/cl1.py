"""A culture on a Cortical Labs CL1 or in its simulator, through the vendor's package cl-sdk (the extra `cl1`)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Int64

from animat.cultures.base import Culture
from animat.cultures.devices.cl1_delivery import FRAMES_PER_S, LEAD_US, CL1Session, sdk
from animat.cultures.failures import as_device_failure, describe_error, while_open
from animat.cultures.holding import of_the_machine, of_the_program
from animat.cultures.observed import Observed, Spikes
from animat.cultures.safety import Admitted, Guard, History, Limits
from animat.errors import AnimatError, DeviceFailed, InvalidArgument
from animat.recordings.formats.cl1_layout import CHANNELS, IDENTIFIERS, NO_STIMULATION, SITES, STIMULUS_STREAM
from animat.recordings.recorded_culture import RecordedCulture, names_in
from animat.recordings.recording import Channels
from animat.stimulation.array import ElectrodeArray
from animat.stimulation.patterns import draw_patterns
from animat.stimulation.pulse import Phase, Pulse
from animat.tables import UNKNOWN, padded, read_only_copy

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

_GRID = ElectrodeArray("CL1", columns=8, rows=8, pitch_um=1.0, channels=CHANNELS, stimulation_units=len(SITES))
"""Channels are numbered down the columns; distances are the same as along the rows."""
Patterns = Sequence[Sequence[int]] | Int64[np.ndarray, "patterns size"]


class CL1Culture(Culture):
    """A culture on a CL1, or on the SDK's simulator if that is installed.

    Its clock is the device's, which runs on between calls, when nothing is observed. Intervals within a delivery are
    exact to a frame (40 us); as a whole it can begin late, as its `stimulus_time_s` shows. See `docs/hardware.md`.

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
    sampling_rate_hz = float(FRAMES_PER_S)
    stretch_s = 60.0
    stimulation_electrodes = SITES

    def __init__(
        self,
        patterns: Patterns | None = None,
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
        drawn = draw_patterns(_GRID, np.array(SITES), seed=seed, spacing_um=1.0) if patterns is None else patterns
        self._patterns = _check_patterns(drawn)
        self._seed = seed if patterns is None else None
        self._ticks_per_s, self._margin_frames = ticks_per_s, round(margin_ms * 1e-3 * FRAMES_PER_S)
        tolerance = None if jitter_tolerance_ms is None else round(jitter_tolerance_ms * 1e-3 * FRAMES_PER_S)
        self._jitter = {"ignore_jitter": True} if tolerance is None else {"jitter_tolerance_frames": tolerance}
        channel, pitch = np.array(SITES, np.int64), np.nan if pitch_um is None else float(pitch_um)
        self._channels = Channels(channel.astype(np.str_), channel, (channel // 8) * pitch, (channel % 8) * pitch)
        self._record_to, self._raw = record_to, raw
        self._stack = ExitStack()
        self._session: CL1Session | None = None
        self._begun = History()
        self.spikes_not_on_electrodes = 0
        """Spikes that the device reported on ground or reference, which are not recording electrodes; left out."""
        self.spikes_reported_late = 0
        """Spikes that the device reported after the delivery, or the rest, in which they lie; left out."""

    @property
    def channels(self) -> Channels:
        """The 59 electrodes, without ground and reference."""
        return self._channels

    @property
    def patterns(self) -> Int64[np.ndarray, "patterns size"]:
        return self._patterns

    @property
    def device_limits(self) -> Limits:
        return CL1_LIMITS

    @property
    def device(self) -> Path:
        """The CL1 on this machine; each program has its own SDK simulator."""
        return of_the_program("cl1-simulator") if sdk().is_simulator() else of_the_machine("cl1")

    @property
    def now_s(self) -> float:
        """The device's clock, which starts with the device, not when it is opened."""
        with as_device_failure("CL1", "report its time"):
            return float(while_open(self._session).neurons.timestamp() / FRAMES_PER_S)

    @property
    def recorded_as(self) -> RecordedCulture:
        """The kind, with the seed of its patterns if they were drawn, and the device's own identifiers."""
        with as_device_failure("CL1", "report what it is"):
            is_simulated = bool(while_open(self._session).cl.is_simulator())
        return RecordedCulture("cl1", self._seed, is_simulated, names_in(self._identifiers()))

    @property
    def provenance(self) -> dict[str, str]:
        """The device's own identifiers, and whether it is a simulator."""
        kind = "the SDK's simulator" if self.recorded_as.is_simulated else "device"
        return {
            # Must not change, even if a module moves: a series continues only where it is the same.
            "source": f"CL1 ({kind}) by animat.cultures.cl1",
            "ticks_per_s": str(self._ticks_per_s),
            "pattern_seed": "none: they were given" if self._seed is None else str(self._seed),
            **self._identifiers(),
        }

    def _identifiers(self) -> dict[str, str]:
        with as_device_failure("CL1", "identify itself"):
            attributes = while_open(self._session).cl.get_system_attributes()
        return {name: str(attributes[name]) for name in IDENTIFIERS if name in attributes}

    @property
    def left_out(self) -> dict[str, int]:
        late = self.spikes_reported_late
        return {"spikes on ground or reference": self.spikes_not_on_electrodes, "spikes reported late": late}

    def _open(self) -> None:
        cl = sdk()
        self.spikes_not_on_electrodes = self.spikes_reported_late = 0
        with as_device_failure("CL1", "open", ": is another program using it?"):
            neurons = self._stack.enter_context(cl.open(take_control=True, wait_until_recordable=True))
            session = CL1Session(cl, neurons, self._ticks_per_s, self._margin_frames, self._jitter)
            self._session = session
            if (rate_hz := neurons.get_frames_per_second()) != FRAMES_PER_S:
                raise DeviceFailed(f"CL1: expected {FRAMES_PER_S} frames a second, got {rate_hz}")
            if (count := neurons.get_channel_count()) != CHANNELS:
                raise DeviceFailed(f"CL1: expected {CHANNELS} channels, got {count}")
            if self._record_to is not None:
                folder = Path(self._record_to).resolve()
                folder.mkdir(parents=True, exist_ok=True)
                recording = neurons.record(file_location=str(folder), include_raw_samples=self._raw)
                self._stack.callback(recording.stop)
                session.stream = neurons.create_data_stream(STIMULUS_STREAM)
            session.guard = Guard(self.limits, SITES, self._begun, self.now_s)

    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        if duration_s == 0:
            return Observed(self.now_s, 0.0, Spikes(np.empty(0), np.empty(0, np.int64)), np.empty(0))
        session, since = while_open(self._session), round(admitted.now_s * FRAMES_PER_S)
        try:
            observed, not_on_electrodes, late = session.deliver(admitted.stimuli, duration_s, since)
        except BaseException as error:
            outcome = "what had not begun was interrupted"
            try:
                # Not the session that delivered, which may have ended while the delivery hung.
                if (now_open := self._session) is not None:
                    now_open.interrupt()
            except Exception as failed:
                outcome = f"and it could not be interrupted ({describe_error(failed)}): make sure no more pulses come"
                error.add_note(outcome)
            if isinstance(error, AnimatError) or not isinstance(error, Exception):
                raise
            got = f"{describe_error(error)}: {outcome}{_remedy(error, session)}"
            raise DeviceFailed(f"CL1: expected a loop over {duration_s:g} s, got {got}") from error
        self.spikes_not_on_electrodes += not_on_electrodes
        self.spikes_reported_late += late
        return observed

    def _rest(self, duration_s: float) -> None:
        session = while_open(self._session)
        now = int(session.neurons.timestamp())
        until = now + int(np.ceil(duration_s * FRAMES_PER_S))
        # In pieces of a second, well under the five seconds that the SDK buffers.
        while now < until:
            piece = min(FRAMES_PER_S, until - now)
            try:
                session.neurons.read(piece, now)
            except TimeoutError as error:
                expected = f"CL1: expected to rest {duration_s:g} s"
                raise DeviceFailed(f"{expected}, got {describe_error(error)}{_remedy(error, session)}") from error
            now += piece

    def _halt(self) -> None:
        if (session := self._session) is not None:
            session.halt()

    def _close(self) -> None:
        try:
            self._halt()
        finally:
            self._session = None
            self._stack.close()


def _remedy(error: Exception, session: CL1Session) -> str:
    """What to do if the SDK's simulator was too slow; empty for other errors, and on a device."""
    if "Timeout waiting for timestamp" not in str(error) or not session.cl.is_simulator():
        return ""
    return "; the simulator did not keep up: run without CL_SDK_ACCELERATED_TIME, or with nothing else running"


def _check_patterns(patterns: Patterns) -> Int64[np.ndarray, "patterns size"]:
    rows = [[int(channel) for channel in row if channel != UNKNOWN] for row in patterns]
    for number, row in enumerate(rows):
        if not row or len(set(row)) < len(row):
            raise InvalidArgument(f"patterns: expected distinct channels in each, got {row} as number {number}")
        if strange := [channel for channel in row if channel not in SITES]:
            what = NO_STIMULATION.get(strange[0], "not one of the 64")
            expected = "patterns: expected channels that can stimulate"
            raise InvalidArgument(f"{expected}, got channel {strange[0]} in number {number}, which is {what}")
    if not rows:
        raise InvalidArgument("patterns: expected at least one, got none")
    return read_only_copy(padded(rows))
