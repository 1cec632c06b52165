"""The command that says whether simulators of a recording predict what was held out of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from animat.cli.responses import Responding, say_findings
from animat.errors import InvalidArgument, Mismatch, UnusableData
from animat.writing import expect_writable


@dataclass(frozen=True)
class Validate(Responding):
    """Make simulators of the first half of each recording, predict the second, and say whether to trust them."""

    recordings: Positional[tuple[Path, ...]] = ()
    """Files of recordings, or folders of them"""
    simulator: Literal["histogram", "empirical", "memory"] | None = None
    """The kind that the verdict is on; default: the one that a training would take. All are scored"""
    readouts: str = "all"
    """What is read: all channels as one; halves or quadrants of the array; or a file of groups of electrodes"""
    allow: tuple[str, ...] = ()
    """Findings to allow, by name, such as dead-window"""
    out: Path | None = None
    """Folder for a figure of each recording; default: none is drawn"""
    format: Literal["png", "svg", "pdf"] = "png"
    """Of the figures"""
    seed: int = 1
    """Decides every random draw"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Validate each recording."""
        from animat.compilation import keep_compilations
        from animat.neurons.validation import correlations, validate
        from animat.progress import Bar
        from animat.recordings.reading import list_recordings, read_source
        from animat.report.inspection import expect_unique_stems, figure_stem
        from animat.report.style import save_figure
        from animat.report.validation import correlations_text, draw_validation, validation_text
        from animat.responses.conditions import conditions_named
        from animat.responses.readouts import read_readouts
        from animat.responses.series import extract_series
        from animat.responses.windows import DEFAULT_WINDOW_MS

        if self.out is not None:
            expect_writable(self.out)
        if self.seed < 0:
            raise InvalidArgument(f"--seed: expected 0 or more, got {self.seed}")
        by = None if self.conditions is None else conditions_named(self.conditions)
        readouts = read_readouts(self.readouts)
        files = list_recordings(self.recordings)
        if self.out is not None:
            expect_unique_stems([file.name for file in files])
        keep_compilations()
        validated = []
        with Bar("validating") as progress:
            for number, file in enumerate(files):
                progress.update(number, len(files), file.name)
                try:
                    (responses,) = extract_series(
                        [read_source(file)],
                        by,
                        self.window_ms or DEFAULT_WINDOW_MS,
                        burst_threshold=self.burst_threshold,
                        allow=self.allow,
                        readouts=readouts,
                    )
                    several = range(len(responses.readouts)) if len(responses.readouts) > 1 else [None]
                    found = [validate(responses, kind=self.simulator, seed=self.seed, readout=d) for d in several]
                except (Mismatch, UnusableData) as error:
                    raise type(error)(f"{file}: {error}") from error
                say_findings(responses.findings)
                for validation, readout in zip(found, responses.readouts.names, strict=True):
                    apart = len(found) > 1
                    name, stem = file.name, f"{figure_stem(file.name)}-validation"
                    name, stem = (f"{name}, {readout}", f"{stem}-{readout}") if apart else (name, stem)
                    print(validation_text(name, validation), end="\n\n")
                    validated.append({"name": name, **validation.to_dict()})
                    if self.out is not None:
                        figure = save_figure(draw_validation(name, validation), self.out / f"{stem}.{self.format}")
                        print(f"figure: {figure}\n")
                        validated[-1]["figure"] = str(figure)
                if len(found) > 1:
                    of_pairs = correlations(responses)
                    print(correlations_text(responses.readouts.names, of_pairs), end="\n\n")
                    validated[-1]["correlations"] = of_pairs.tolist()
        return {"recordings": validated}
