"""The job that makes a study's recordings: by recording a culture, or by copying existing files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

from animat.cultures.series import SELECTION_FILE, STATE_FILE, record_series
from animat.cultures.virtual import VirtualCulture
from animat.errors import InvalidFile
from animat.execution.receipts import Receipt
from animat.progress import Progress
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.reading import read_recordings
from animat.studies.folder import source_files
from animat.studies.places import RECEIPTS, RECORDINGS
from animat.studies.task import StudyTask

JOB = "record"


@final
@dataclass(frozen=True)
class Record(StudyTask):
    """Make the recordings as NWB; the specification's file names are relative to `base`."""

    sizes = ("culture.trials", "culture.pulses")

    base: Path

    @property
    def reads_elsewhere(self) -> bool:
        return self.study.culture.kind == "files"

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        out, receipt = folder / RECORDINGS, Receipt.load(folder / RECEIPTS, JOB)
        # Changed recordings are deleted here, as they may be valid and nothing later would notice the change.
        for name in () if receipt is None else receipt.changed(folder):
            (folder / name).unlink(missing_ok=True)
        culture = self.study.culture
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
