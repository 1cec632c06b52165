"""The command line: it parses, calls and prints. The modules that it calls do the work."""

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
from typing import Annotated, Any, Union

import tyro
from tyro import constructors
from tyro.conf import DisallowNone, FlagCreatePairsOff, OmitArgPrefixes, arg, subcommand

from animat.cli.cluster import ClusterCommand
from animat.cli.command import Command, FolderCommand
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
from animat.cli.streams import prepare_streams
from animat.cli.study import StudyFile
from animat.cli.train import Train
from animat.cli.tune import TuneFile
from animat.cli.validate import Validate
from animat.cli.watch import Watch
from animat.ctrl_c import interruptible
from animat.devices import stay_on_cores
from animat.errors import AnimatError, InvalidArgument, did_you_mean, out_of_memory
from animat.plain_file import is_folder
from animat.records import as_json

COMMANDS: dict[str, type[Command]] = {
    "record": Record,
    "inspect": Inspect,
    "validate": Validate,
    "convert": Convert,
    "train": Train,
    "evaluate": Evaluate,
    "reproduce": Reproduce,
    "study": StudyFile,
    "tune": TuneFile,
    "cluster": ClusterCommand,
    "run": Run,
    "live": Live,
    "recover": Recover,
    "replay": Replay,
    "watch": Watch,
    "robots": Robots,
}
_SUBCOMMANDS: Any = Union[tuple(Annotated[kind, subcommand(name)] for name, kind in COMMANDS.items())]  # noqa: UP007

_MEMORY_REMEDIES: dict[type, str] = {
    Evaluate: "ask for fewer episodes (--episodes {episodes})",
    Run: "ask for fewer episodes (--episodes {episodes})",
    Live: "ask for fewer episodes (--episodes {episodes}) or policies (--policies {policies})",
    Record: "ask for fewer trials or pulses (--trials, --pulses, or those of --protocol)",
    Train: "ask for fewer bins (--bins), or give fewer recordings (--recordings)",
    Validate: "validate fewer recordings at once",
    Inspect: "inspect fewer recordings at once",
}
"""How to run a command with less memory, with the values of its options."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status.

    0; 1 for an error, which a line on standard error names; 2 for a command line that cannot be read; 130 after Ctrl-C
    or a kill; 141 if standard output is no longer read.
    """
    stay_on_cores()
    prepare_streams()
    try:
        try:
            return _run(sys.argv[1:] if arguments is None else list(arguments))
        finally:
            # Here, where errors can be caught, not while Python exits: help ends with SystemExit.
            sys.stdout.flush()
    except KeyboardInterrupt:
        # Ctrl-C while the command was being loaded.
        print("animat: interrupted", file=sys.stderr)
        return 130
    except OSError as error:
        is_closed = isinstance(error, BrokenPipeError)
        # Errors of files have a file name, and those of connections their own types.
        if not is_closed and (type(error) is not OSError or error.filename is not None):
            raise
        # Discard the rest of the output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if is_closed:
            return 141
        print(f"animat: standard output: cannot be written: {error.strerror or error}", file=sys.stderr)
        return 1


def _run(arguments: list[str]) -> int:
    if arguments[:1] == ["--version"]:
        print(f"animat {importlib.metadata.version('animat')}")
        return 0
    try:
        command = _parse(arguments)
    except InvalidArgument as error:
        print(f"animat: {error}", file=sys.stderr)
        return 2
    try:
        Path.cwd()
    except OSError as error:
        # Libraries need it, and their errors would be taken for those of a recording.
        got = f"expected one, got none ({error.strerror}): cd to one that exists"
        print(f"animat: working folder: {got}", file=sys.stderr)
        return 1
    if "" not in sys.path:
        # As for `python -m animat`: the working folder may hold the user's own robots.
        sys.path.append("")
    try:
        with interruptible(), _live_page(command):
            results = command.run()
    except BaseException as error:
        message = _error_line(command, error)
        if message is None:
            raise
        print(f"animat: {message}", file=sys.stderr)
        # What else went wrong, such as a device that could not be switched off.
        for note in getattr(error, "__notes__", ()):
            print(f"animat: {' '.join(note.split())}", file=sys.stderr)
        return 130 if isinstance(error, KeyboardInterrupt) else 1
    if command.json:
        print(json.dumps(as_json(results)))
    # Some of several files could not be read or used; messages have already named them.
    is_refused = any(finding["severity"] == "refuse" for finding in results.get("together", ()))
    return 1 if results.get("unreadable") or results.get("unusable") or is_refused else 0


def _error_line(command: Command, error: BaseException) -> str | None:
    """What ended a command, in a line; None for an error of animat itself."""
    if isinstance(error, AnimatError):
        return _name_option(command, " ".join(str(error).split()))
    if isinstance(error, KeyboardInterrupt):
        return f"interrupted{_how_to_resume(command)}"
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        return f"{str(error.filename)[:60]}...: {error.strerror}; choose a shorter name"
    if isinstance(error, PermissionError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    remedy = _MEMORY_REMEDIES.get(type(command), "use a machine with more memory").format(**vars(command))
    return f"{message}: {remedy}" if (message := out_of_memory(error)) else None


_BEGIN_ANEW = {"maxone": "MaxOne", "replay": "replay"}
"""The cultures whose clock starts with each program."""


def _how_to_resume(command: Command) -> str:
    """What an interrupted command has kept, and how to continue it."""
    if not isinstance(command, FolderCommand) or not is_folder(command.out) or not any(command.out.iterdir()):
        return ""
    if isinstance(command, Record) and command.culture in _BEGIN_ANEW and any(command.out.glob("*.nwb")):
        clock = f"the clock of a {_BEGIN_ANEW[command.culture]} starts with each program"
        return f"; finished work is kept; {clock}: begin another series in another folder"
    if not isinstance(command, Run | Live):
        return "; finished work is kept; run it again to resume"
    what, session = ("session", command.out) if isinstance(command, Run) else ("live run", command.out / "session")
    is_unwritten = (session / "session.log").exists() and not (session / "session.nwb").exists()
    recover = f"; its recording is not written yet: animat recover {shlex.quote(str(session))}" if is_unwritten else ""
    return f"{recover}; finished work is kept; a {what} cannot be resumed: start a new one in another folder"


_RENAMED = {
    "budget.pulses": "budget_pulses",
    "budget.pulses_per_electrode": "budget_per_electrode",
    "seeds": "culture_seed",
}
"""Options whose Python arguments have different names."""


def _name_option(command: Command, message: str) -> str:
    """Replace the argument's name at the beginning of a message by the name of its option."""
    argument, _, rest = message.partition(": ")
    name = _RENAMED.get(argument, argument)
    options = {field.name for field in dataclasses.fields(command) if "Positional" not in str(field.type)}
    values = (value if isinstance(value, tuple) else (value,) for value in vars(command).values())
    # A file or a folder may have the name of an option.
    paths = {str(path) for several in values for path in several if isinstance(path, Path)}
    if isinstance(command, Record) and command.protocol is not None:
        from animat.stimulation.protocol import Protocol

        if name in {field.name for field in dataclasses.fields(Protocol)} - paths:
            return f"{command.protocol}: {message}"
    if name not in options - paths:
        return message
    value = vars(command)[name]
    file = f" {value}" if isinstance(value, str) and os.path.isfile(value) else ""  # noqa: PTH113 - any text at all
    return f"--{name.replace('_', '-')}{file}: {rest}"


def _live_page(command: Command) -> contextlib.AbstractContextManager[None]:
    """The live page of a command with `--watch`, served while the command runs or the page is open."""
    if not isinstance(command, FolderCommand) or not command.watch:
        return contextlib.nullcontext()
    from animat.watch.serving import watching

    return watching(command.out)


_SEE = "; see animat --help"
_DESCRIPTION = (
    "Drive a robot with a living neuronal culture.\n\n"
    "animat COMMAND --help describes a command; animat --version prints the version."
)


def _parse(arguments: list[str]) -> Command:
    """Read the command line; raises usage errors in one line, not in a box."""
    name = arguments[0] if arguments else ""
    if name not in COMMANDS and name != "-h" and not name.startswith("--"):
        got = f"{name!r}{did_you_mean(name, COMMANDS) or _SEE}" if arguments else f"none{_SEE}"
        raise InvalidArgument(f"expected a command, one of {', '.join(COMMANDS)}; got {got}")
    if "" in arguments:
        # From a shell variable that is not set; as a path it would be the working folder.
        before = arguments[arguments.index("") - 1]
        raise InvalidArgument(f"{before}: expected a value after it, got an empty text")
    fields = dataclasses.fields(COMMANDS[name]) if name in COMMANDS else ()
    # What is on by default is switched off by `--no-...`.
    options = {f"--{'no-' * (field.default is True)}{field.name}".replace("_", "-"): field.default for field in fields}
    options |= {"--help": False} if fields else {"--help": False, "--version": False}
    see = f"; see animat {name} --help" if name in COMMANDS else _SEE
    output = io.StringIO()
    command: Command
    try:
        with contextlib.redirect_stderr(output):
            # All commands only where none is named: to read all takes twice as long.
            command, unknown = tyro.cli(
                COMMANDS.get(name, _SUBCOMMANDS),
                prog=f"animat {name}" if fields else "animat",
                description=None if fields else _DESCRIPTION,
                args=arguments[1:] if fields else arguments,
                config=(FlagCreatePairsOff, OmitArgPrefixes, DisallowNone),
                registry=_option_registry(),
                return_unknown_args=True,
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        leading = itertools.takewhile(lambda argument: argument != "--", arguments)
        _expect_known([word for word in leading if word[:2] == "--" and _as_in_help(word) not in options], options, see)
        for option, value in itertools.pairwise([*arguments, "--"]):
            if value.startswith("--") and not isinstance(options.get(option.replace("_", "-"), False), bool):
                raise InvalidArgument(f"{option}: expected a value after it, got none{see}") from None
        raise InvalidArgument(f"{_in_one_line(output.getvalue(), fields)}{see}") from None
    _expect_known(unknown, options, see)
    return command


def _in_one_line(box: str, fields: Sequence[dataclasses.Field[Any]]) -> str:
    """Tyro's error in our words; `fields` are those of the command.

    It is in a box with a title; on terminals without these characters, in lines of dashes, one of them under the title.
    """
    lines = [line.strip("│╭╮╰╯ ") for line in box.splitlines()[1:]]
    parts = itertools.groupby(lines, lambda line: bool(line) and not line.strip("─-"))
    message = next(" ".join(line for line in part if line) for is_rule, part in parts if not is_rule)
    message = message.removeprefix("Error parsing ")
    if message.startswith("Missing from "):
        message = f"{message.partition(': ')[2].split()[0]}: expected a value, got none"
    if message.startswith("Missing value for argument '"):
        _, option, expected = message.split("'")
        dash = f"a value after it, got one that begins with a dash: write {option}=VALUE"
        message = f"{option}: expected {'two numbers, got one' if ' 2 ' in expected else dash}"
    if message.startswith("{") or message.partition(":")[0].isupper():
        # The choices or the kind of a positional argument, in place of its name.
        named = next(field.name for field in fields if "Positional" in str(field.type))
        message = f"{named}: {message.partition(': ')[2]}"
    return message


def _as_in_help(option: str) -> str:
    """An option as help shows it: with dashes, without `=VALUE`."""
    return option.partition("=")[0].replace("_", "-")


def _expect_known(unknown: Sequence[str], options: Mapping[str, Any], see: str) -> None:
    for argument in unknown[:1]:
        option = _as_in_help(argument)
        if option in options:
            raise InvalidArgument(f"{option[2:]}: expected only its value, got {argument} before it{see}") from None
        if argument.startswith("-"):
            # Other commands have --culture-seed; `record`, which alone has --sessions, has --seed.
            is_meant = option == "--culture-seed" and "--sessions" in options
            hint = "; did you mean --seed?" if is_meant else did_you_mean(option, options) or see
            raise InvalidArgument(f"unknown option {argument}{hint}") from None
        hint = "; recordings are named after --recordings" if "--recordings" in options else ""
        raise InvalidArgument(f"unexpected argument {argument!r}{hint}{see}") from None


def _option_registry() -> constructors.ConstructorRegistry:
    """A rule for reading and describing the options of every command."""
    registry = constructors.ConstructorRegistry()
    within = False

    @registry.struct_rule
    def rule(command: constructors.StructTypeInfo) -> constructors.StructConstructorSpec | None:
        nonlocal within
        if within or not (isinstance(command.type, type) and issubclass(command.type, Command)):
            return None
        within = True  # The lookup below would otherwise call this rule again.
        spec = constructors.ConstructorRegistry.get_struct_spec(command)
        within = False
        if not isinstance(spec, constructors.StructConstructorSpec):
            return None
        last = {name: place for place, name in enumerate(command.type.last)}
        fields = sorted(map(_option, spec.fields), key=lambda option: last.get(option.name, -1))
        return dataclasses.replace(spec, fields=tuple(fields))

    return registry


_NUMBERS = {"INT": "a whole number", "FLOAT": "a number", "FLOAT FLOAT": "two numbers"}


def _option(option: constructors.StructFieldSpec) -> constructors.StructFieldSpec:
    """The same option with our errors (what was expected, what was given) and help (what happens without it)."""
    kind: Any = Annotated[option.type, DisallowNone]
    spec = constructors.ConstructorRegistry.get_primitive_spec(constructors.PrimitiveTypeInfo.make(kind, set()))
    if option.type is not bool and isinstance(spec, constructors.PrimitiveConstructorSpec):
        among = sorted(spec.metavar.strip("{}").split(","))
        choices = f"one of {', '.join(among)}" if len(among) > 1 else among[0]
        expected = choices if spec.choices else _NUMBERS.get(spec.metavar.strip("{}"))

        def read(words: list[str]) -> Any:
            with contextlib.suppress(ValueError):
                if not spec.choices or set(words) <= set(among):
                    return spec.instance_from_str(words)
            raise ValueError(f"expected {expected}, got {' '.join(map(repr, words))}")

        if expected is not None:
            # Without the braces in which tyro shows two optional numbers, as if they were choices.
            metavar = spec.metavar if spec.choices else spec.metavar.strip("{}")
            kind = Annotated[kind, dataclasses.replace(spec, instance_from_str=read, choices=None, metavar=metavar)]
    # Flags are off unless given.
    if option.default is None or option.default == () or isinstance(option.default, bool):
        kind = Annotated[kind, arg(help_behavior_hint="")]
    text = option.helptext() if callable(option.helptext) else option.helptext
    # Help would start a new paragraph at an indented line of a docstring.
    return dataclasses.replace(option, type=kind, helptext=text and " ".join(text.split()))
