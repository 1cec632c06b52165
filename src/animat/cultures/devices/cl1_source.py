"""The simulated tissue as a data source of the CL1's SDK: any CL application runs on it as on a device."""

from __future__ import annotations

import os
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int16

from animat.cultures.devices.cl1_delivery import FRAMES_PER_S, sdk
from animat.cultures.tissue import Pulse, Tissue, TissueParameters
from animat.cultures.virtual import WARM_UP_S
from animat.cultures.visibility import amplitudes_at_soma_uv
from animat.errors import InvalidArgument
from animat.recordings.formats.cl1_layout import CHANNELS, NO_STIMULATION

FACTORY = "animat.cultures.devices.cl1_source:simulated_culture"
UV_PER_UNIT = 0.195
BLOCK_FRAMES = 1024
REAL_TIME_NEURONS = 200
"""With these, an application that stimulates on every spike at 1,000 ticks a second leaves 30 % of two cores free."""
REAL_TIME_SHARE = 0.7
"""Largest share of real time that computing may take."""
TIMED_FRAMES, FRAMES_PER_READ = 2_500, 5
"""Length of the timing at opening, and its pieces, in which the SDK reads in real time."""
SAMPLES = 75
BEFORE = 25
"""Samples of a spike in the SDK, and how many of them precede its time."""


class SimulatedCL1:
    """A tissue under the CL1's 8 x 8 electrodes, read in frames; independent of the SDK.

    A pulse acts with strength q / `charge_nc`, where q is its largest cathodic charge, up to the tissue's limit of 2,
    at the first step of the tissue (0.2 ms, five frames) that does not begin before it. A channel sees every neuron
    within `reach_um`. Frames hold noise and every spike from its trough on. Everything depends only on seed, parameters
    and pulses, not on the pieces in which it is read: noise is drawn for whole blocks of frames.

    Args:
        neurons: of the tissue; with fewer than 1,200, each has proportionally fewer partners. More than the default may
            be too many for real time, as a warning at opening says: the application then falls behind the SDK's buffer.
        pitch_um: between electrodes, in the middle of the tissue. Assumed: the SDK does not specify it.
        reach_um: of an electrode; assumed, and wider than a CMOS array's, as its electrodes are larger.
        charge_nc: of a pulse of strength 1; assumed: that of the SDK's default pulse for 1 uA (160 us).
        noise_uv: root mean square of the noise.
    """

    def __init__(
        self,
        seed: int = 1,
        *,
        neurons: int = REAL_TIME_NEURONS,
        pitch_um: float = 200.0,
        reach_um: float = 100.0,
        charge_nc: float = 0.16,
        noise_uv: float = 2.4,
    ) -> None:
        for name, value in (("pitch_um", pitch_um), ("reach_um", reach_um), ("charge_nc", charge_nc)):
            if not 0 < value < 1e6:
                raise InvalidArgument(f"{name}: expected above 0, got {value}")
        whole = TissueParameters()
        share = min(1.0, neurons / whole.neurons)
        degree_e, degree_i = (max(1, round(degree * share)) for degree in (whole.in_degree_e, whole.in_degree_i))
        parameters = TissueParameters(neurons=neurons, in_degree_e=degree_e, in_degree_i=degree_i)
        self._tissue = Tissue(seed, parameters)
        self._seed, self._charge_nc, self._noise_units = seed, charge_nc, noise_uv / UV_PER_UNIT
        self._step_frames = round(parameters.step_ms * 1e-3 * FRAMES_PER_S)
        x_um, y_um, channel = self._tissue.x_um, self._tissue.y_um, np.arange(CHANNELS)
        self.x_um = x_um.max() / 2 + (channel // 8 - 3.5) * pitch_um
        self.y_um = y_um.max() / 2 + (channel % 8 - 3.5) * pitch_um
        self._is_electrode = ~np.isin(channel, list(NO_STIMULATION))
        distance_um = np.hypot(x_um[:, None] - self.x_um, y_um[:, None] - self.y_um)
        self._sees = [np.flatnonzero(near).tolist() for near in (distance_um <= reach_um) & self._is_electrode]
        amplitude_uv = amplitudes_at_soma_uv(np.random.default_rng([seed, 11]), len(self._tissue.x_um))
        self._shapes = _waveform()[None, :] * amplitude_uv[:, None].astype(np.float32)
        self._tissue.advance(WARM_UP_S)
        # The first pulse on an electrode looks up what it reaches, and compiles: the SDK waits no longer than 100 ms.
        before = self._tissue.snapshot()
        self._tissue.advance(
            0.01, [Pulse(self._tissue.now_s, self.x_um[c : c + 1], self.y_um[c : c + 1]) for c in channel.tolist()]
        )
        self._tissue.restore(before)
        self._zero_frames = round(self._tissue.now_s * FRAMES_PER_S)
        self._next = 0
        self._pulses: list[Pulse] = []
        self._held: list[tuple[int, int, int]] = []
        self._unfinished: list[tuple[int, int, int]] = []
        self._block: tuple[int, Int16[np.ndarray, "frames channels"]] | None = None

    def stimulate(self, events: Sequence[Any]) -> None:
        """Schedule pulses (`cl.sim.DataSourceStim`); those of one frame are one stimulus. Late ones act immediately."""
        channels_of = defaultdict[tuple[int, float], list[int]](list)
        for event in events:
            if 0 <= event.channel < CHANNELS and self._is_electrode[event.channel]:
                charges = zip(event.phase_durations_us, event.phase_currents_uA, strict=True)
                cathodic_nc = max([0.0, *(-us * ua / 1000 for us, ua in charges)])
                if cathodic_nc > 0:
                    channels_of[event.timestamp, min(2.0, cathodic_nc / self._charge_nc)].append(event.channel)
        for (frame, strength), channels in sorted(channels_of.items()):
            at_s = (self._zero_frames + max(0, frame)) / FRAMES_PER_S
            self._pulses.append(Pulse(at_s, self.x_um[sorted(channels)], self.y_um[sorted(channels)], strength))

    def read(
        self, from_frame: int, frame_count: int
    ) -> tuple[Int16[np.ndarray, "frames channels"], list[tuple[int, int, Float32[np.ndarray, " samples"]]]]:
        """Frames from `from_frame` on, not read before, and their spikes in order: frame, channel, waveform."""
        if from_frame < self._next:
            expected = f"{self._next} or later: time only moves forward"
            raise InvalidArgument(f"from_frame: expected {expected}, got {from_frame}")
        to_frame = from_frame + frame_count
        self._advance(to_frame)
        # Spikes in skipped frames are dropped.
        due = [spike for spike in self._held if from_frame <= spike[0] < to_frame]
        self._held = [spike for spike in self._held if spike[0] >= to_frame]
        unfinished = [*(self._unfinished if from_frame == self._next else ()), *due]
        frames = self._noise(from_frame, frame_count)
        if unfinished:
            signal = frames.astype(np.float32)
            for frame, channel, neuron in unfinished:
                shape = self._shapes[neuron, BEFORE:] / np.float32(UV_PER_UNIT)
                part = shape[max(0, from_frame - frame) : to_frame - frame]
                first = max(0, frame - from_frame)
                signal[first : first + len(part), channel] += part
            frames = np.clip(np.rint(signal), -32768, 32767).astype(np.int16)
        self._unfinished = [spike for spike in unfinished if spike[0] + SAMPLES - BEFORE > to_frame]
        self._next = to_frame
        return frames, [(frame, channel, self._shapes[neuron]) for frame, channel, neuron in due]

    def share_of_real_time(self) -> float:
        """Share of real time that computing takes, timed on a tenth of a second, before anything is read."""
        if self._next:
            raise InvalidArgument(f"culture: expected one not yet read, got one that was read to frame {self._next}")
        before, begun_s = self._tissue.snapshot(), time.perf_counter()
        for frame in range(0, TIMED_FRAMES, FRAMES_PER_READ):
            self.read(frame, FRAMES_PER_READ)
        took_s = time.perf_counter() - begun_s
        self._tissue.restore(before)
        self._next, self._held, self._unfinished = 0, [], []
        return took_s / (TIMED_FRAMES / FRAMES_PER_S)

    def real_time_warning(self) -> str | None:
        """A warning if the culture may be too large for real time; None if it is not."""
        neurons, share = len(self._sees), self.share_of_real_time()
        if neurons <= REAL_TIME_NEURONS and share <= REAL_TIME_SHARE:
            return None
        return (
            f"warning: a simulated culture of {neurons} neurons in real time: computing a second of it takes "
            f"{share:.2f} s here, stimuli and the application not counted; {REAL_TIME_NEURONS} neurons leave 30 % of "
            "two idle cores to spare: take fewer, or CL_SDK_ACCELERATED_TIME=1"
        )

    def _advance(self, to_frame: int) -> None:
        target = -(-(self._zero_frames + to_frame) // self._step_frames) * self._step_frames
        now = round(self._tissue.now_s * FRAMES_PER_S)
        if target <= now:
            return
        now_s, end_s = now / FRAMES_PER_S, target / FRAMES_PER_S
        due = [replace(pulse, time_s=max(pulse.time_s, now_s)) for pulse in self._pulses if pulse.time_s < end_s]
        self._pulses = [pulse for pulse in self._pulses if pulse.time_s >= end_s]
        spikes = self._tissue.advance(end_s - now_s, due)
        for time_s, neuron in zip(spikes.time_s.tolist(), spikes.neuron.tolist(), strict=True):
            frame = round(time_s * FRAMES_PER_S) - self._zero_frames
            self._held += [(max(frame, self._next), channel, neuron) for channel in self._sees[neuron]]

    def _noise(self, from_frame: int, count: int) -> Int16[np.ndarray, "frames channels"]:
        """Noise of these frames, drawn block by block so that it does not depend on the pieces read."""
        pieces, frame = [], from_frame
        while frame < from_frame + count:
            number, first = divmod(frame, BLOCK_FRAMES)
            if self._block is None or self._block[0] != number:
                rng = np.random.default_rng([self._seed, 15, number])
                drawn = np.rint(self._noise_units * rng.standard_normal((BLOCK_FRAMES, CHANNELS), np.float32))
                drawn[:, ~self._is_electrode] = 0
                self._block = number, drawn.astype(np.int16)
            taken = min(BLOCK_FRAMES - first, from_frame + count - frame)
            pieces.append(self._block[1][first : first + taken])
            frame += taken
        return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)


def _waveform() -> Float64[np.ndarray, " samples"]:
    """A spike of unit amplitude: a narrow trough at sample 25 and a wide peak half a millisecond later."""
    t_ms = (np.arange(SAMPLES) - BEFORE) / FRAMES_PER_S * 1e3
    shape = -np.exp(-((t_ms / 0.09) ** 2) / 2) + 0.3 * np.exp(-(((t_ms - 0.45) / 0.35) ** 2) / 2) * (t_ms > 0)
    return np.asarray(shape / -shape[BEFORE], dtype=np.float32)


def _metadata() -> Any:
    from cl.sim import SimulatorDataSourceMetadata

    return SimulatorDataSourceMetadata(channel_count=CHANNELS, uV_per_sample_unit=UV_PER_UNIT, seekable=False)


def simulated_culture(**settings: Any) -> Any:
    """The factory that the SDK imports in its own process: a `cl.sim.SimulatorDataSource` of a `SimulatedCL1`."""
    from cl.sim import DataSourceBatch, DataSourceSpike, SimulatorDataSource

    class Source(SimulatorDataSource):  # type: ignore[misc]
        def __init__(self) -> None:
            self._culture: SimulatedCL1 | None = None

        @property
        def metadata(self) -> Any:
            return _metadata()

        def open(self) -> None:
            self._culture = SimulatedCL1(**settings)
            is_real_time = os.environ.get("CL_SDK_ACCELERATED_TIME") != "1"
            if is_real_time and (warning := self._culture.real_time_warning()) is not None:
                print(warning, file=sys.stderr, flush=True)

        def close(self) -> None:
            self._culture = None

        def on_stims(self, stims: Sequence[Any]) -> None:
            if self._culture is not None:
                self._culture.stimulate(stims)

        def read(self, from_timestamp: int, frame_count: int) -> Any:
            assert self._culture is not None
            frames, spikes = self._culture.read(from_timestamp, frame_count)
            return DataSourceBatch(frames=frames, spikes=[DataSourceSpike(f, c, samples=w) for f, c, w in spikes])

    return Source()


def use_simulated_culture(**settings: Any) -> None:
    """Make the SDK's simulator read from a simulated culture, from the next `cl.open()` on.

    The settings are those of `SimulatedCL1`, serialisable as JSON.
    """
    sdk("cl.sim").set_simulator_data_source(FACTORY, config=settings, metadata=_metadata())
