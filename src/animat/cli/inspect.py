"""The command that inspects recordings."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from animat.cli.command import ResponseOptions, print_warnings
from animat.errors import AnimatError, InvalidArgument, Mismatch, UnusableData, in_min, within
from animat.progress import Bar, Part, Progress
from animat.writing import expect_writable

if TYPE_CHECKING:
    from animat.recordings.recording import Recording, ResponseTable
    from animat.responses.conditions import Conditions
    from animat.responses.inspection import Inspection
    from animat.responses.responses import Responses


@dataclass(frozen=True)
class Inspect(ResponseOptions):
    """Report what is in recordings, whether a robot can be driven with them, and what is wrong with them."""

    recordings: Positional[tuple[Path, ...]] = ()
    """Files, or folders of them: NWB, MaxWell, CL1, NPZ, CSV (NAME_spikes.csv with NAME_stimuli.csv)"""
    stimuli: str | None = None
    """Which of several series or events in a file are the stimuli (NWB: the name; MaxWell: the events' type)"""
    part: str | None = None
    """Which of several recordings in a MaxWell file, such as well000/rec0000"""
    optimum: str | None = None
    """Also compute the best return that any controller could get with this robot, such as cartpole, before any
    training"""
    out: Path | None = None
    """Folder for figures; default: none are drawn"""

    def run(self) -> dict[str, Any]:
        from animat.recordings.placing import placed_by_date
        from animat.recordings.reading import list_recordings
        from animat.report.inspection import expect_unique_stems
        from animat.responses.bursts import check_threshold
        from animat.responses.conditions import conditions_named
        from animat.responses.windows import check_window
        from animat.robots.grid import grid_for
        from animat.robots.registry import robot_named

        if self.optimum is not None:
            try:
                grid_for(robot_named(self.optimum))
            except InvalidArgument as error:
                raise InvalidArgument(f"--optimum: {str(error).removeprefix('robot: ')}") from error
        by = None if self.conditions is None else conditions_named(self.conditions)
        if self.window_ms is not None:
            check_window(self.window_ms)
        check_threshold(self.burst_threshold)
        files = list_recordings(self.recordings)
        if self.out is not None:
            expect_writable(self.out)
            # The figures of the series have a name of their own.
            expect_unique_stems([file.name for file in files], "series")
        inspected: list[dict[str, Any]] = []
        series, unreadable = [], []
        # Reading is one step per file, drawing another, and the figures of the series are the last step.
        steps = 1 if self.out is None else 2
        total = steps * len(files) + (self.out is not None)
        with Bar("inspecting") as progress:
            for number, file in enumerate(files):
                progress.update(steps * number, total, file.name)
                try:
                    source, inspection = self._inspect(file, by)
                except AnimatError as error:
                    if len(files) == 1:
                        raise
                    # The others may be readable.
                    print(f"animat: {' '.join(str(error).split())}", file=sys.stderr)
                    unreadable.append(str(file))
                    continue
                one = Part(progress, steps * number, steps, total)
                inspected.append(self._show(source, inspection, one))
                series.append((file, inspection.responses))
            unusable = [each["name"] for each in inspected if each["verdict"] == "not usable"]
            results: dict[str, Any] = {"recordings": inspected, "unreadable": unreadable, "unusable": unusable}
            of_files = placed_by_date([responses for _, responses in series])
            results["together"] = _compare(inspected, of_files)
            if self.out is not None and series:
                progress.update(total - 1, total, "figures of the series")
                results |= self._draw_series([file for file, _ in series], of_files, self.out)
        if unreadable:
            others = "; the rest were inspected" if inspected else ""
            print(f"animat: {len(unreadable)} of {len(files)} files could not be inspected{others}", file=sys.stderr)
        return results

    def _inspect(self, file: Path, by: Conditions | None) -> tuple[Recording | ResponseTable, Inspection]:
        from animat.recordings.reading import read_source
        from animat.responses.inspection import inspect_recording

        source = read_source(file, stimuli=self.stimuli, part=self.part)
        with within(file, (UnusableData, Mismatch)):
            return source, inspect_recording(source, by, self.window_ms, self.burst_threshold, file.name)

    def _show(self, source: Recording | ResponseTable, inspection: Inspection, progress: Progress) -> dict[str, Any]:
        """Print what was found in a file, and draw its figures; returns it for JSON."""
        from animat.report.inspection import draw_inspection, inspection_text

        print(inspection_text(inspection), end="\n\n")
        found = inspection.to_dict()
        if self.optimum is not None:
            # It takes far longer than reading.
            part = Part(progress, 0, 1, 1 if self.out is None else 2, f"{inspection.name}, optimal return")
            found["optima"] = _optima(self.optimum, inspection.responses, part)
        if self.out is not None:
            progress.update(1, 2, f"{inspection.name}, figures")
            figures = [str(figure) for figure in draw_inspection(source, inspection, self.out)]
            print(f"figures: {', '.join(figures)}\n")
            found["figures"] = figures
        return found

    def _draw_series(self, files: Sequence[Path], series: Sequence[Responses], out: Path) -> dict[str, Any]:
        """Draw the files' responses together, with the array of the first recording; returns the figures, if any."""
        from animat.recordings.reading import read_source
        from animat.recordings.recording import Recording
        from animat.report.inspection import draw_series

        file, _ = min(zip(files, series, strict=True), key=lambda one: one[1].start_min)
        first = read_source(file, stimuli=self.stimuli, part=self.part)
        recording = first if isinstance(first, Recording) else None
        try:
            drawn = draw_series(recording, series, out)
        except Mismatch as unlike:
            print(f"no figures of the series: {unlike}")
            return {"figures": []}
        if drawn:
            of = "figures of the series" if len(files) > 1 else "figure of the array"
            print(f"{of}: {', '.join(map(str, drawn))}")
        return {"figures": [str(figure) for figure in drawn]}


def _compare(inspected: Sequence[dict[str, Any]], series: Sequence[Responses]) -> list[dict[str, Any]]:
    """Print and return what is found on the files together; adds to each of `inspected` when it began."""
    from animat.report.inspection import finding_lines
    from animat.responses.quality.one_culture import series_findings, unlike_finding

    for each, responses in zip(inspected, series, strict=True):
        each["start_min"] = responses.start_min
    placed = {finding for each in series for finding in each.findings if finding.name == "placed-by-date"}
    if together := [*placed, *unlike_finding(series), *series_findings(series)]:
        # Above, each file was printed with the start that it states.
        starts = ", ".join(f"{each['name']} from {in_min(each['start_min'])}" for each in inspected)
        lines = ["all together:", *([f"  {starts}"] if placed else []), *finding_lines(together)]
        print("\n".join(lines), end="\n\n")
    return [{**finding.to_dict(), "value": finding.value} for finding in together]


def _optima(robot: str, responses: Responses, progress: Progress) -> list[dict[str, Any]] | None:
    """Print and return what a culture could do with a robot; None where that is not known."""
    from animat.compilation import keep_compilations
    from animat.evaluation.optimal_returns import optimal_returns
    from animat.robots.registry import robot_named

    keep_compilations()
    try:
        progress.update(0, 1)
        optima = optimal_returns(responses, robot_named(robot), progress=progress)
    except (InvalidArgument, UnusableData) as error:
        print(f"{robot}: no optimal return: {error}\n")
        return None
    print(f"{robot}, on a histogram of these responses, without memory: a simulator with memory may allow more")
    for optimum in optima:
        print(optimum.to_text())
        print_warnings(optimum.best.findings())
    print()
    return [optimum.to_dict() for optimum in optima]
