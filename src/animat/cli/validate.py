"""The command that checks whether simulators of a recording predict its held-out part."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from animat.cli.command import ResponseOptions, print_warnings
from animat.errors import Mismatch, UnusableData, expect_at_least, within
from animat.writing import expect_writable


@dataclass(frozen=True)
class Validate(ResponseOptions):
    """Fit simulators to the first half of each recording, predict the second, and say whether to trust them."""

    recordings: Positional[tuple[Path, ...]] = ()
    """Recording files, or folders of them"""
    simulator: Literal["histogram", "empirical", "memory"] | None = None
    """The kind that the verdict is about; default: the one that training would use. All kinds are scored"""
    readouts: str = "all"
    """Groups of channels: all as one; halves or quadrants of the array; or a file of groups of electrodes"""
    allow: tuple[str, ...] = ()
    """Findings to allow, by name, such as dead-window"""
    out: Path | None = None
    """Folder for a figure of each recording; default: none is drawn"""
    seed: int = 1
    """Decides every random draw"""

    def run(self) -> dict[str, Any]:
        from animat.compilation import keep_compilations
        from animat.neurons.validation import correlations, validate
        from animat.progress import Bar
        from animat.recordings.reading import list_recordings, read_source
        from animat.report.inspection import expect_unique_stems, figure_stem
        from animat.report.style import save_figure
        from animat.report.validation import COLUMNS, correlations_text, draw_validation, validation_text
        from animat.responses.conditions import conditions_named
        from animat.responses.extraction import extract_series
        from animat.responses.readouts import read_readouts

        expect_at_least("--seed", self.seed, 0)
        by = None if self.conditions is None else conditions_named(self.conditions)
        readouts = read_readouts(self.readouts)
        files = list_recordings(self.recordings)
        if self.out is not None:
            expect_writable(self.out)
            expect_unique_stems([file.name for file in files])
        keep_compilations()
        validated = []
        with Bar("validating") as progress:
            for number, file in enumerate(files):
                progress.update(number, len(files), file.name)
                with within(file, (UnusableData, Mismatch)):
                    (responses,) = extract_series(
                        [read_source(file)],
                        by,
                        self.window_ms,
                        burst_threshold=self.burst_threshold,
                        allow=self.allow,
                        readouts=readouts,
                    )
                    has_several = len(responses.readouts) > 1
                    numbers = range(len(responses.readouts)) if has_several else [None]
                    validations = [validate(responses, kind=self.simulator, seed=self.seed, readout=d) for d in numbers]
                print_warnings(responses.findings)
                for validation, readout in zip(validations, responses.readouts.names, strict=True):
                    name, stem = file.name, f"{figure_stem(file.name)}-validation"
                    if has_several:
                        name, stem = f"{name}, {readout}", f"{stem}-{readout.replace('/', '%2F')}"
                    print(validation_text(name, validation), end="\n\n")
                    validated.append({"name": name, **validation.to_dict()})
                    if self.out is not None:
                        figure = save_figure(draw_validation(name, validation), self.out / f"{stem}.png")
                        print(f"figure: {figure}\n")
                        validated[-1]["figure"] = str(figure)
                if has_several:
                    matrix = correlations(responses)
                    print(correlations_text(responses.readouts.names, matrix), end="\n\n")
                    validated[-1]["correlations"] = matrix.tolist()
        print(COLUMNS)
        return {"recordings": validated}
