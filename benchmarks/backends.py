"""The cultures of `reality_gap.py --backends`: the same tissue behind every driver."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from animat.cultures.base import Culture
from animat.cultures.virtual import VirtualCulture
from animat.stimulation.pulse import Phase, Pulse
from animat.stimulation.selection import SelectionRule
from animat.stimulation.stimulus import Stimulus


@contextmanager
def opened(backend: str, channels: int, seed: int) -> Iterator[Culture]:
    """An open culture by the name of its backend; `channels` is for the virtual culture."""
    if backend == "cl1":
        from animat.cultures.devices.cl1 import CL1Culture
        from animat.cultures.devices.cl1_source import use_simulated_culture

        use_simulated_culture(seed=seed, neurons=1200)
        with CL1Culture(seed=seed) as cl1:
            yield cl1
        return
    rule = SelectionRule(recording_sites=channels, stimulation_sites=min(32, channels)) if channels else None
    with VirtualCulture(seed, rule=rule) as virtual:
        if backend == "virtual":
            yield virtual
            return
        with _maxone_over(virtual) as maxone:
            yield maxone


@contextmanager
def _maxone_over(virtual: VirtualCulture) -> Iterator[Culture]:
    """A MaxOne whose stand-in answers pulses as the virtual culture does."""
    import pytest

    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    import stand_in_maxlab
    from animat.cultures.devices.maxone import MaxOneCulture

    class Answering(stand_in_maxlab.Stream):
        """Advances the tissue up to the frames that are waited for."""

        def __init__(self, rig: stand_in_maxlab.Rig) -> None:
            super().__init__(rig)
            self.stepped = rig.now
            self.spikes = np.empty((0, 2), np.int64)

        def wait(self, frame: int) -> None:
            super().wait(frame)
            due = sorted((p for p in self.rig.delivered if p.frame < frame), key=lambda pulse: pulse.frame)
            self.rig.delivered = [p for p in self.rig.delivered if p.frame >= frame]
            rate_hz = virtual.sampling_rate_hz
            stimuli = [_stimulus(list(pulses), (at - self.stepped) / rate_hz) for at, pulses in groupby(due, _frame)]
            if frame > self.stepped:
                seen = virtual.deliver(stimuli, (frame - self.stepped) / rate_hz)
                frames = self.stepped + np.rint(seen.spikes.time_s * rate_hz).astype(np.int64)
                new = np.column_stack([frames, amplifier[seen.spikes.channel]])
                self.spikes, self.stepped = np.concatenate([self.spikes, new]), frame

        def take(self, start: int, stop: int) -> Any:
            of = self.spikes[(self.spikes[:, 0] >= start) & (self.spikes[:, 0] < stop)]
            self.spikes = self.spikes[self.spikes[:, 0] >= stop]
            return of[:, 0], of[:, 1]

    # Not known before it is open; spikes until then are discarded.
    amplifier = np.full(len(virtual.channels), -1)
    with pytest.MonkeyPatch.context() as patch:
        rig = stand_in_maxlab.install(patch)
        with MaxOneCulture(virtual.selection, stream=Answering(rig), settle=False) as culture:
            number = {int(e): int(a) for e, a in zip(culture.channels.electrode, culture.channels.label, strict=True)}
            amplifier[:] = [number.get(int(e), -1) for e in virtual.channels.electrode]
            yield culture


def _frame(pulse: Any) -> int:
    return int(pulse.frame)


def _stimulus(pulses: list[Any], time_s: float) -> Stimulus:
    """Pulses that began together, in the form that the virtual culture takes."""
    phases = tuple(Phase(50.0 * samples, amplitude_mv=mv) for samples, mv in pulses[0].phases)
    return Stimulus(time_s, tuple(pulse.electrode for pulse in pulses), Pulse(phases))
