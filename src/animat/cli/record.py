"""The command that records a culture at intervals."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from animat.cli.command import FolderCommand
from animat.errors import InvalidArgument, Mismatch, counted, in_min, some_of
from animat.folders import expect_no_other

if TYPE_CHECKING:
    from animat.cultures.base import Culture
    from animat.stimulation.protocol import Protocol


_PRESENTED = ("order", "pulses", "trials", "places")


@dataclass(frozen=True)
class Record(FolderCommand):
    """Record a culture: one NWB file per recording. Resumes where it stopped."""

    culture: Literal["virtual", "replay", "cl1", "maxone"] = "virtual"
    """virtual: simulated neurons on a simulated array; replay: responds from recordings; cl1 and maxone: the devices"""
    recordings: tuple[Path, ...] = ()
    """For a replay: the recordings that it responds from"""
    selection: Path | None = None
    """For a MaxOne: the file of its electrodes"""
    seed: int = 1
    """Which virtual culture; for a replay or a device the order of stimuli, and a CL1's patterns"""
    paper: bool = False
    """The paper's protocol: blocks of one frequency, 100 trials of each, 15 recordings; default: what a closed
    loop needs, frequencies mixed, 1,000 trials of each, 2 recordings"""
    sessions: int | None = None
    """Number of recordings; default: 2, with --paper 15"""
    interval_min: float = 10.0
    """Minutes from one recording to the next"""
    order: Literal["blocked", "mixed"] | None = None
    """mixed: frequencies shuffled, as in a closed loop, the default; blocked: all stimuli of one together (paper)"""
    pulses: int | None = None
    """Pulses per trial; the response to the last one is read; default: 1"""
    trials: int | None = None
    """Trials of each frequency, and of each place of --places; default: 1000, proportionally fewer with several
    pulses or places (except corners); with --paper 100"""
    places: str | None = None
    """corners: four places at 20 Hz, for a robot with two commands; halves, quadrants, or a JSON file with groups of
    electrodes, [[1, 2], [3, 4]]: each place at each frequency is then a condition with that many trials; default: all
    of the culture's patterns at each frequency"""
    protocol: Path | None = None
    """A JSON file, as Protocol.to_json writes it, in place of --paper, --order, --pulses, --trials and --places. It
    also sets frequencies, times and pulse; what it leaves out has its default"""
    out: Path = Path("recordings")
    """Folder for the files"""

    def run(self) -> dict[str, Any]:
        from animat.cultures.kinds import culture_named
        from animat.cultures.series import record_series
        from animat.cultures.under_way import INTERRUPTED
        from animat.progress import Bar
        from animat.recordings.reading import read_recordings

        # Before any device is powered.
        self._check_options()
        protocol = self._protocol()
        if self.protocol is not None:
            _warn_too_fast(protocol)
        if protocol.is_rest:
            print(
                'warning: the only place is "none", so nothing is ever delivered, and no robot can be driven with '
                "such recordings; to stimulate, add groups of electrodes",
                file=sys.stderr,
            )
        _expect_no_others(self.out)
        before, cut_short = set(self.out.glob("*")), set((self.out / INTERRUPTED).glob("*"))
        is_device = self.culture in ("cl1", "maxone")
        with Bar("recording") as progress:
            recordings = read_recordings(self.recordings) if self.recordings else []
            sessions = (15 if self.paper else 2) if self.sessions is None else self.sessions

            def planned(culture: Culture) -> Protocol:
                protocol = self._protocol(len(culture.patterns))
                if is_device:
                    print(_plan(protocol, sessions, self.interval_min), file=sys.stderr)
                return protocol

            series = record_series(
                lambda: culture_named(
                    self.culture, seed=self.seed, recordings=recordings, selection=self.selection, progress=progress
                ),
                # A virtual culture has the usual number of patterns.
                protocol if self.culture == "virtual" else planned,
                self.out,
                sessions=sessions,
                interval_min=self.interval_min,
                seed=self.seed,
                progress=progress,
            )
            if missed := [in_min(minute) for minute in series.missed_min]:
                at = f"{counted(len(missed), 'recording')} not made, as the next was due: at {some_of(missed)}"
                print(f"missed: {at}; for others choose another --out", file=sys.stderr)
        files = series.files
        for file in sorted(set((self.out / INTERRUPTED).glob("*")) - cut_short):
            print(f"what a run that was killed had recorded is in {file}", file=sys.stderr)
        if is_device:
            _print_findings(file for file in files if file not in before)
        existed = "; all existed already" if files and before.issuperset(self.out.glob("*")) else ""
        print(f"{counted(len(files), 'recording')} in {self.out}{existed}")
        if protocol.places:
            print("each place is a condition; --conditions frequency pools the places")
        return {"recordings": [str(file) for file in files]}

    def _check_options(self) -> None:
        for option, some, kind, value in (
            ("--recordings", "some", "replay", len(self.recordings) or None),
            ("--selection", "a file of electrodes", "maxone", self.selection),
        ):
            if (self.culture == kind) != (value is not None):
                expected, got = (some, "none") if value is None else ("none", value)
                raise InvalidArgument(f"{option}: expected {expected} for --culture {self.culture}, got {got}")
        options = [f"--{name}" for name in _PRESENTED if getattr(self, name) is not None]
        if self.protocol is not None and self.paper:
            raise InvalidArgument("--protocol, --paper: expected one of them, as each is a protocol, got both")
        if options and self.protocol is not None:
            raise InvalidArgument(f"--protocol: expected it alone, got {', '.join(options)} too; put them in the file")

    def _protocol(self, patterns: int = 100) -> Protocol:
        """The protocol of the options, with the usual values for the culture's kind and number of patterns."""
        from animat.cultures.kinds import pulse_for
        from animat.stimulation.places import read_places
        from animat.stimulation.protocol import CLOSED_LOOP, PAPER, TWO_COMMANDS, read_protocol

        living = TWO_COMMANDS if self.places == "corners" else CLOSED_LOOP
        usual = replace(PAPER if self.paper else living, patterns=min(100, patterns), pulse=pulse_for(self.culture))
        if self.protocol is not None:
            return read_protocol(self.protocol, usual)
        given = {name: value for name in _PRESENTED if (value := getattr(self, name)) is not None}
        if self.places is not None:
            given["places"] = read_places(self.places)
        protocol = replace(usual, **given)
        if self.trials is not None or self.paper:
            return protocol
        # Fewer with several pulses or more conditions: the recording takes as long, and ends before the next is due.
        times = protocol.pulses * (1 if self.places == "corners" else max(1, protocol.n_places))
        return replace(protocol, trials=max(1, protocol.trials // times))


def _expect_no_others(folder: Path) -> None:
    """Raise for recordings of no series, which would be read as part of this one, and for other work."""
    expect_no_other(folder, "recording")
    others = sorted(file.name for file in folder.glob("[!.]*.nwb") if not file.name.startswith("recording_"))
    if others:
        got = some_of(others, 3)
        raise Mismatch(f"{folder}: expected only recordings of this series, got {got}; choose another --out")


def _print_findings(files: Iterable[Path]) -> None:
    """Print what is found on recordings of a device, which cannot be repeated."""
    from animat.recordings.reading import read_recording

    for file in files:
        for finding in read_recording(file).findings:
            print(f"{file.name}: {finding.severity}: {finding.message}", file=sys.stderr)


def _plan(protocol: Protocol, sessions: int, interval_min: float) -> str:
    """What a device is about to deliver, in a line."""
    from animat.cultures.series import minutes_of
    from animat.stimulation.places import NONE

    # In a rest nothing is delivered.
    places = protocol.n_places - (NONE in protocol.places) if protocol.places else 1
    pulses = len(protocol.frequencies_hz) * protocol.trials * protocol.pulses * places
    series = f"{counted(sessions, 'recording')} of {minutes_of(protocol):.1f} min"
    if sessions > 1:
        series += f", one every {interval_min:g} min"
    return f"{series}, with {counted(pulses, 'stimulus', 'stimuli')} each; each pulse: {protocol.pulse}"


def _warn_too_fast(protocol: Protocol) -> None:
    from animat.responses.windows import DEFAULT_WINDOW_MS

    fast = [f"{hz:g} Hz" for hz in protocol.frequencies_hz if 1000 / hz < DEFAULT_WINDOW_MS[1]]
    if fast:
        print(
            f"warning: at {', '.join(fast)} the next pulse comes before the response window ends at "
            f"{DEFAULT_WINDOW_MS[1]:g} ms, so responses contain its artefact: read them with a shorter --window-ms",
            file=sys.stderr,
        )
