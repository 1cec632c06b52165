"""The jobs that make a study's recordings, by recording a culture or copying files, and neuron simulators from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from animat.cultures.series import SELECTION_FILE, STATE_FILE, record_series
from animat.cultures.virtual import VirtualCulture
from animat.errors import InvalidFile, UnusableData
from animat.evaluation.transfer import no_memory
from animat.execution.receipts import remove_changed
from animat.neurons.fidelity import Fidelity
from animat.neurons.timeline import SimulatorTimeline, fit_timeline, save_timeline
from animat.progress import Progress
from animat.recordings.findings import Finding
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.reading import read_recordings
from animat.responses.extraction import extract_series
from animat.responses.readouts import ALL, readouts_named
from animat.responses.responses import Responses
from animat.studies.folder import RECEIPTS, RECORDINGS, RESPONSES, TIMELINE, source_files
from animat.studies.results import write_table
from animat.studies.specification import Study
from animat.studies.task import StudyTask

JOB = "record"


@dataclass(frozen=True)
class MakeRecordings(StudyTask):
    """Make the recordings as NWB; the specification's file names are relative to `base`."""

    sizes = ("culture.trials", "culture.pulses")

    base: Path

    @property
    def reads_elsewhere(self) -> bool:
        return self.study.culture.kind == "files"

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        remove_changed(folder, folder / RECEIPTS, JOB)
        out, culture = folder / RECORDINGS, self.study.culture
        if culture.kind == "files":
            return self._copies(out, progress)
        series = record_series(
            lambda: VirtualCulture(culture.seed),
            culture.protocol(),
            out,
            sessions=culture.sessions,
            interval_min=culture.interval_min,
            progress=progress,
        )
        return [*series.files, out / SELECTION_FILE, out / STATE_FILE]

    def _copies(self, out: Path, progress: Progress) -> list[Path]:
        copies: list[Path] = []
        recordings = read_recordings(source_files(self.study, self.base))
        for i, recording in enumerate(recordings):
            copy = out / recording_name(recording.start_min)
            if copy in copies:
                raise InvalidFile(
                    f"culture.files: expected recordings at different minutes, got two that would both be {copy.name}"
                )
            copies.append(copy)
            write_nwb(recording, copy)
            progress.update(i + 1, len(recordings))
        return copies


class FitSimulators(StudyTask):
    """Extract the responses of all recordings and fit a simulator to each."""

    sizes = ("culture.sessions", "culture.trials", "simulators.bins")

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        study, series = self.study, read_series(self.study, folder)
        timeline = fit_study_timeline(study, series)
        noticed = [*timeline.findings, *_moved_comparisons(study, timeline.start_min.tolist())]
        presentation = timeline.presentation
        # Recordings in blocks, as the paper's, cannot be simulated with memory.
        if presentation is None or presentation.order != "blocked":
            has_memory, setting = timeline.fitted["kind"] == "memory", 'simulators.kind = "memory"'
            noticed += no_memory(timeline.findings, presentation, has_memory=has_memory, setting=setting)
        timeline = replace(timeline, findings=tuple(noticed))
        return [save_timeline(timeline, folder / TIMELINE), _write_responses(folder / RESPONSES, series)]


def fit_study_timeline(study: Study, series: list[Responses]) -> SimulatorTimeline:
    """Fit simulators to responses with a study's settings; UnusableData for only one condition, unless allowed."""
    settings = study.simulators
    timeline = fit_timeline(series, kind=settings.kind, bins=settings.bins, range_hz=settings.range_hz)
    if len(timeline.conditions) < 2 and "one-condition" not in settings.allow:
        raise UnusableData(
            "simulators.conditions: expected two or more for an agent to choose from, got one "
            f"({timeline.conditions[0].label}); sort the stimuli by frequency, interval:5,10, electrode or pattern "
            '(to allow it: simulators.allow = ["one-condition"])'
        )
    return timeline


def _write_responses(path: Path, series: list[Responses]) -> Path:
    """One row per response: x of all channels, as in the figures, and of each readout if there are several."""
    names = () if series[0].readouts.are_all else series[0].readouts.names
    rows = (
        (responses.start_min, responses.conditions[c].label, x, ratio, int(burst), *(of_each if names else ()))
        for responses in series
        for c, x, ratio, burst, of_each in zip(
            responses.condition.tolist(),
            responses.rate_hz.tolist(),
            responses.active_ratio.tolist(),
            responses.is_burst.tolist(),
            responses.read_hz.reshape(len(responses), -1).tolist(),
            strict=True,
        )
    )
    head = ("start_min", "condition", "rate_hz", "active_ratio", "is_burst")
    return write_table(path, [*head, *(f"rate_hz of {name}" for name in names)], rows)


def _moved_comparisons(study: Study, start_min: list[float]) -> Iterator[Finding]:
    """A finding for each comparison at a minute at which no recording starts."""
    for old, new in zip(study.comparisons, study.at_recordings(start_min).comparisons, strict=True):
        if old.at_min is not None and old.at_min != new.at_min:
            text = f"{old.name} was requested at {old.at_min:g} min and is made on the recording at {new.at_min:g} min"
            yield Finding("comparison-minute", "note", text, new.at_min)


def read_series(study: Study, folder: Path, *, as_one: bool = False) -> list[Responses]:
    """The responses of the study's recordings, in order of time; `as_one`: of all channels, whatever the readouts."""
    settings = study.simulators
    return extract_series(
        read_recordings(folder / RECORDINGS),
        settings.conditions or None,
        settings.window_ms,
        burst_threshold=settings.burst_threshold,
        allow=settings.allow,
        readouts=ALL if as_one else readouts_named(settings.readouts),
    )


def controllability(timeline: SimulatorTimeline) -> dict[float, Fidelity]:
    """What each simulator keeps of its responses, by minute; for several readouts by condition and readout."""
    fidelities, names = {}, timeline.readouts.names
    for at_min, kept in zip(timeline.start_min.tolist(), timeline.fidelities, strict=True):
        if len(names) > 1:
            labels = tuple(f"{label}, {name}" for label in kept.labels for name in names)
            kept = replace(kept, labels=labels, in_data=kept.in_data.ravel(), in_simulator=kept.in_simulator.ravel())
        fidelities[at_min] = kept
    return fidelities
