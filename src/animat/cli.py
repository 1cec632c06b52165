"""The command line: parses, calls, prints. What the commands do is in the modules that they call."""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import itertools
import json
import math
import re
import sys
from collections.abc import Sequence
from typing import Annotated, Any, get_args

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, subcommand

from animat.cli_convert import Convert
from animat.cli_inspect import Inspect
from animat.cli_live import Live
from animat.cli_loop import Recover, Run
from animat.cli_record import Record
from animat.cli_studies import Reproduce, StudyFile
from animat.cli_train import Evaluate, Train
from animat.ctrl_c import heard_everywhere
from animat.errors import AnimatError, InvalidArgument

Command = (
    Annotated[Record, subcommand("record")]
    | Annotated[Inspect, subcommand("inspect")]
    | Annotated[Convert, subcommand("convert")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Reproduce, subcommand("reproduce")]
    | Annotated[StudyFile, subcommand("study")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Live, subcommand("live")]
    | Annotated[Recover, subcommand("recover")]
)

COMMANDS = tuple(command.__metadata__[0].name for command in get_args(Command))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status: 0, 1 for an error that a line on standard error names, 2 for usage."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given == ["--version"]:
        print(f"animat {importlib.metadata.version('animat')}")
        return 0
    try:
        command = _parse(given)
    except InvalidArgument as error:
        print(f"animat: {error}", file=sys.stderr)
        return 2
    try:
        with heard_everywhere():
            results = command.run()
    except AnimatError as error:
        print(f"animat: {' '.join(str(error).split())}", file=sys.stderr)
        _say_notes(error)
        return 1
    except KeyboardInterrupt as error:
        again = "; start again to go on" if isinstance(command, Record | Train | Reproduce | StudyFile) else ""
        print(f"animat: interrupted; what was finished is kept{again}", file=sys.stderr)
        _say_notes(error)
        return 130
    except BrokenPipeError:
        # Whoever read the output closed it; Python would complain once more while exiting.
        sys.stderr.close()
        return 141
    except Exception as error:
        # JAX has an error of its own for it, which is not imported for this.
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        print("animat: out of memory: ask for fewer episodes, policies or stimuli at once", file=sys.stderr)
        return 1
    if command.json:
        print(json.dumps(_as_json(results)))
    return 0


def _parse(
    arguments: list[str],
) -> Record | Inspect | Convert | Train | Evaluate | Reproduce | StudyFile | Run | Live | Recover:
    """Read the command line; usage errors come in one line, not in a box."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        raise InvalidArgument(f"expected a command, one of {', '.join(COMMANDS)}; got {arguments[0]!r}")
    if not arguments:
        raise InvalidArgument(f"expected a command, one of {', '.join(COMMANDS)}; see animat --help")
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                Command,
                prog="animat",
                description="Drive a robot with a living neuronal culture.",
                args=arguments,
                config=(FlagCreatePairsOff, OmitArgPrefixes),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        # A box with a title; where the terminal has no such letters, lines of dashes, one of them under the title.
        lines = [line.strip("│╭╮╰╯ ") for line in said.getvalue().splitlines()[1:]]
        parts = itertools.groupby(lines, lambda line: bool(line) and not line.strip("─-"))
        what = next(" ".join(line for line in part if line) for is_rule, part in parts if not is_rule)
        raise InvalidArgument(f"{_told(what)}; see animat {' '.join(arguments[:1])} --help") from None


_WORDS = (
    (
        r"Error parsing (\S+): (?:no type matching \{None\}\|INT .*? from|invalid literal .*? 10:) \[?('[^']*').*",
        "whole number",
    ),
    (
        r"Error parsing (\S+): (?:no type matching \{None\}\|FLOAT .*? from|could not convert .*?:) \[?('[^']*').*",
        "number",
    ),
)


def _told(what: str) -> str:
    """What the parser says, in the words of all other errors: the argument, what was expected, what came."""
    if wrong := re.fullmatch(r"invalid choice (.+) for argument '(.+)'. Expected one of \((.+)\)\.", what):
        # The parser lists them in any order.
        choices = sorted(set(re.findall(r"'([^']+)'", wrong[3])) - {"None"})
        return f"{wrong[2]}: expected one of {', '.join(choices)}, got {wrong[1]}"
    for words, kind in _WORDS:
        if wrong := re.fullmatch(words, what):
            return f"{wrong[1]}: expected a {kind}, got {wrong[2]}"
    return what


def _say_notes(error: BaseException) -> None:
    """What went wrong besides, such as a device that could not be switched off."""
    for note in getattr(error, "__notes__", ()):
        print(f"animat: {' '.join(note.split())}", file=sys.stderr)


def _as_json(value: Any) -> Any:
    """The same with null for numbers that JSON has no word for (NaN, infinite)."""
    if isinstance(value, dict):
        return {key: _as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
