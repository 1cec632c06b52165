"""The command line: parses, calls, prints. What the commands do is in the modules that they call."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import importlib.metadata
import io
import itertools
import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, get_args

import tyro
from tyro import constructors
from tyro.conf import DisallowNone, FlagCreatePairsOff, OmitArgPrefixes, arg, subcommand

from animat.cli.cluster import ClusterCommand
from animat.cli.convert import Convert
from animat.cli.evaluate import Evaluate
from animat.cli.inspect import Inspect
from animat.cli.live import Live
from animat.cli.record import Record
from animat.cli.recover import Recover
from animat.cli.replay import Replay
from animat.cli.reproduce import Reproduce
from animat.cli.robots import Robots
from animat.cli.run import Run
from animat.cli.study import StudyFile
from animat.cli.train import Train
from animat.cli.tune import TuneFile
from animat.cli.validate import Validate
from animat.cli.watch import Watch
from animat.ctrl_c import interruptible
from animat.devices import stay_on_cores
from animat.errors import AnimatError, InvalidArgument, did_you_mean, out_of_memory

Command = (
    Annotated[Record, subcommand("record")]
    | Annotated[Inspect, subcommand("inspect")]
    | Annotated[Validate, subcommand("validate")]
    | Annotated[Convert, subcommand("convert")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Reproduce, subcommand("reproduce")]
    | Annotated[StudyFile, subcommand("study")]
    | Annotated[TuneFile, subcommand("tune")]
    | Annotated[ClusterCommand, subcommand("cluster")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Live, subcommand("live")]
    | Annotated[Recover, subcommand("recover")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Watch, subcommand("watch")]
    | Annotated[Robots, subcommand("robots")]
)

COMMANDS = {command.__metadata__[0].name: command.__origin__ for command in get_args(Command)}

_LESS: dict[type, str] = {
    Evaluate: "ask for fewer episodes (--episodes {episodes})",
    Run: "ask for fewer episodes (--episodes {episodes})",
    Live: "ask for fewer episodes (--episodes {episodes}) or policies (--policies {policies})",
    Record: "ask for fewer trials or pulses (--trials, --pulses, or those of --protocol)",
    Train: "ask for fewer bins (--bins), or give fewer recordings (--recordings)",
    Validate: "validate fewer recordings at once",
    Inspect: "inspect fewer recordings at once",
}
"""What a command's memory grows with, and what was asked for."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    0; 1 for an error that a line on standard error names; 2 where the command line cannot be read; 130 after Ctrl-C or
    a kill; 141 where nobody reads standard output any more.
    """
    stay_on_cores()
    # Streams that were closed are None, which the parser and others do not expect: what is written goes nowhere.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115, PTH123
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115, PTH123
    try:
        try:
            return _run(sys.argv[1:] if arguments is None else list(arguments))
        finally:
            # Here, where it can be caught, rather than as Python exits: help ends with SystemExit.
            sys.stdout.flush()
    except OSError as error:
        is_closed = isinstance(error, BrokenPipeError)
        # That of a file has its name, and that of a connection a type of its own.
        if not is_closed and (type(error) is not OSError or error.filename is not None):
            raise
        # What is still to be written goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if is_closed:
            return 141
        print(f"animat: standard output: cannot be written: {error.strerror or error}", file=sys.stderr)
        return 1


def _run(given: list[str]) -> int:
    if given == ["--version"]:
        print(f"animat {importlib.metadata.version('animat')}")
        return 0
    try:
        command = _parse(given)
    except InvalidArgument as error:
        print(f"animat: {error}", file=sys.stderr)
        return 2
    if "" not in sys.path:
        # As for `python -m animat`: robots of one's own may lie in the working folder.
        sys.path.append("")
    try:
        with interruptible(), _watched(command):
            results = command.run()
    except AnimatError as error:
        print(f"animat: {_by_option(command, ' '.join(str(error).split()))}", file=sys.stderr)
        _say_notes(error)
        return 1
    except KeyboardInterrupt as error:
        kept = (
            ""
            if isinstance(command, Inspect | Validate | Convert | Evaluate | Replay | ClusterCommand | Watch)
            else "; what was finished is kept"
        )
        again = (
            "; start again to go on"
            if isinstance(command, Record | Train | Reproduce | StudyFile | TuneFile)
            else "; a session cannot be resumed: start a new one in another folder"
            if isinstance(command, Run) and (command.out / "session.log").exists()
            else ""
        )
        if isinstance(command, Run) and again and not (command.out / "session.nwb").exists():
            kept = f"; its recording is not written yet: animat recover {shlex.quote(str(command.out))}{kept}"
        print(f"animat: interrupted{kept}{again}", file=sys.stderr)
        _say_notes(error)
        return 130
    except BrokenPipeError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
            print(f"animat: {str(error.filename)[:60]}...: {error.strerror}; choose a shorter name", file=sys.stderr)
            return 1
        words = out_of_memory(error)
        if words is None:
            raise
        remedy = _LESS.get(type(command), "use a machine with more memory").format(**vars(command))
        print(f"animat: {words}: {remedy}", file=sys.stderr)
        return 1
    if command.json:
        from animat.records import as_json

        print(json.dumps(as_json(results)))
    # Of several files, some of which could not be read or used, as was said on the way.
    return 1 if results.get("unreadable") or results.get("unusable") else 0


_BUDGET = {"budget.pulses": "budget_pulses", "budget.pulses_per_electrode": "budget_per_electrode"}
"""The options of arguments that have another name in Python."""


def _by_option(command: Command, message: str) -> str:
    """A message that begins with the name of an argument, beginning with that of the option it is given by."""
    argument, _, rest = message.partition(": ")
    name = _BUDGET.get(argument, argument)
    options = {field.name for field in dataclasses.fields(command) if "Positional" not in str(field.type)}
    given = (each if isinstance(each, tuple) else (each,) for each in vars(command).values())
    # A file or a folder may have the name of an option.
    paths = {str(path) for each in given for path in each if isinstance(path, Path)}
    if isinstance(command, Record) and command.protocol is not None:
        from animat.stimulation.protocol import Protocol

        if name in {field.name for field in dataclasses.fields(Protocol)} - paths:
            return f"{command.protocol}: {message}"
    if name not in options - paths:
        return message
    value = vars(command)[name]
    file = f" {value}" if isinstance(value, str) and os.path.isfile(value) else ""  # noqa: PTH113 - any text at all
    return f"--{name.replace('_', '-')}{file}: {rest}"


def _watched(command: Command) -> contextlib.AbstractContextManager[None]:
    """The page of a command that is asked for one (`--watch`), for as long as it runs and is looked at."""
    if not isinstance(command, Record | Train | Run | Live | Reproduce | StudyFile | TuneFile) or not command.watch:
        return contextlib.nullcontext()
    from animat.watch.serving import watching

    return watching(command.out)


def _parse(arguments: list[str]) -> Command:
    """Read the command line; usage errors come in one line, not in a box."""
    if not arguments:
        raise InvalidArgument(f"expected a command, one of {', '.join(COMMANDS)}; see animat --help")
    name = arguments[0]
    if name not in COMMANDS and name != "-h" and not name.startswith("--"):
        near = did_you_mean(name, COMMANDS)
        raise InvalidArgument(f"expected a command, one of {', '.join(COMMANDS)}; got {name!r}{near}")
    if "" in arguments:
        # Where a variable of the shell is not set; a path would be the working folder.
        before = arguments[arguments.index("") - 1]
        raise InvalidArgument(f"{before}: expected a value after it, got an empty text")
    fields = dataclasses.fields(COMMANDS[name]) if name in COMMANDS else ()
    options = {f"--{field.name.replace('_', '-')}": field.default for field in fields} | {"--help": False}
    see = f"; see animat {name} --help" if name in COMMANDS else "; see animat --help"
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            command, unknown = tyro.cli(
                Command,
                prog="animat",
                description="Drive a robot with a living neuronal culture.",
                args=arguments,
                config=(FlagCreatePairsOff, OmitArgPrefixes, DisallowNone),
                registry=_options(),
                return_unknown_args=True,
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        given = itertools.takewhile(lambda argument: argument != "--", arguments)
        _expect_known([each for each in given if each[:2] == "--" and _plain(each) not in options], options, see)
        for option, value in itertools.pairwise([*arguments, "--"]):
            if value.startswith("--") and not isinstance(options.get(option.replace("_", "-"), False), bool):
                raise InvalidArgument(f"{option}: expected a value after it, got none{see}") from None
        # A box with a title; where the terminal has no such letters, lines of dashes, one of them under the title.
        lines = [line.strip("│╭╮╰╯ ") for line in said.getvalue().splitlines()[1:]]
        parts = itertools.groupby(lines, lambda line: bool(line) and not line.strip("─-"))
        what = next(" ".join(line for line in part if line) for is_rule, part in parts if not is_rule)
        raise InvalidArgument(f"{what.removeprefix('Error parsing ')}{see}") from None
    _expect_known(unknown, options, see)
    return command


def _plain(option: str) -> str:
    """An option as help has it: without the value that it may end with, with dashes."""
    return option.partition("=")[0].replace("_", "-")


def _expect_known(unknown: Sequence[str], options: Mapping[str, Any], see: str) -> None:
    for given in unknown[:1]:
        option = _plain(given)
        if option in options:
            raise InvalidArgument(f"{option[2:]}: expected its value alone, got {given} before it{see}") from None
        if given.startswith("-"):
            raise InvalidArgument(f"unknown option {given}{did_you_mean(option, options) or see}") from None
        raise InvalidArgument(f"unexpected argument {given!r}{see}") from None


def _options() -> constructors.ConstructorRegistry:
    """A rule by which the options of every command are read and told."""
    registry = constructors.ConstructorRegistry()
    within = False

    @registry.struct_rule
    def rule(command: constructors.StructTypeInfo) -> constructors.StructConstructorSpec | None:
        nonlocal within
        if within or not dataclasses.is_dataclass(command.type):
            return None
        within = True  # What else would ask this rule again.
        spec = constructors.ConstructorRegistry.get_struct_spec(command)
        within = False
        if not isinstance(spec, constructors.StructConstructorSpec):
            return None
        return dataclasses.replace(spec, fields=tuple(map(_option, spec.fields)))

    return registry


_NUMBERS = {"INT": "a whole number", "FLOAT": "a number", "FLOAT FLOAT": "two numbers"}


def _option(option: constructors.StructFieldSpec) -> constructors.StructFieldSpec:
    """The same in our words: an error says what was expected and what came, help what is done without the option."""
    kind: Any = Annotated[option.type, DisallowNone]
    spec = constructors.ConstructorRegistry.get_primitive_spec(constructors.PrimitiveTypeInfo.make(kind, set()))
    if option.type is not bool and isinstance(spec, constructors.PrimitiveConstructorSpec):
        among = sorted(spec.metavar.strip("{}").split(","))
        expected = f"one of {', '.join(among)}" if spec.choices else _NUMBERS.get(spec.metavar.strip("{}"))

        def read(words: list[str]) -> Any:
            with contextlib.suppress(ValueError):
                if not spec.choices or set(words) <= set(among):
                    return spec.instance_from_str(words)
            raise ValueError(f"expected {expected}, got {' '.join(map(repr, words))}")

        if expected is not None:
            kind = Annotated[kind, dataclasses.replace(spec, instance_from_str=read, choices=None)]
    # A flag that turns something off would say that its default is True.
    if option.default is None or option.default == () or option.default is True:
        kind = Annotated[kind, arg(help_behavior_hint="")]
    said = option.helptext() if callable(option.helptext) else option.helptext
    # Help takes an indented line of a docstring for a new paragraph.
    return dataclasses.replace(option, type=kind, helptext=said and " ".join(said.split()))


def _say_notes(error: BaseException) -> None:
    """What went wrong besides, such as a device that could not be switched off."""
    for note in getattr(error, "__notes__", ()):
        print(f"animat: {' '.join(note.split())}", file=sys.stderr)
