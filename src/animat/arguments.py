"""Arguments of what is public: one of another kind than its annotation says is refused in one line."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from animat.errors import InvalidArgument, shown

Thing = TypeVar("Thing", bound=Callable[..., Any])

_ONE = {
    "Calibration": "a calibration, as animat.Calibration.of_series returns",
    "Conditions": "conditions, such as 'frequency:5,10'",
    "Channels": "a channel table, animat.Channels",
    "Culture": "a culture, such as animat.VirtualCulture(seed=1)",
    "Detection": "settings of spike detection, such as animat.recordings.detection.settings.Detection()",
    "Environment": "an environment, such as animat.Animat(animat.Cartpole(), animat.Thresholds(9), 5)",
    "Executor": "an executor, such as a concurrent.futures.ProcessPoolExecutor",
    "Goal": "a goal, such as 'avoid pole_angle outside -12..12 deg'",
    "Mapping": "a mapping, such as animat.Thresholds(9)",
    "NeuronSimulator": "a simulator, as animat.fit_memory returns",
    "Origin": "an origin, such as animat.Origin(subject_id='culture-7')",
    "PathLike": "a path",
    "Policy": "a policy, of those that animat.load_policies returns",
    "Progress": "a progress, such as animat.Bar('training')",
    "Protocol": "a protocol, such as animat.Protocol(trials=5)",
    "Pulse": "a pulse, such as animat.BALANCED_PULSE",
    "Readouts": "readouts, such as 'halves'",
    "Recording": "a recording, as animat.read_recording returns",
    "Responses": "responses, as animat.extract_responses returns",
    "Robot": "a robot, such as animat.Cartpole()",
    "Selection": "a selection, as animat.Selection.load returns",
    "SimulatorTimeline": "simulators, as animat.fit_timeline returns",
    "Stimuli": "a table of stimuli, animat.Stimuli",
    "Study": "a Study, as animat.read_study returns",
    "Training": "a Training, such as animat.Training('cartpole', '9-thresholds')",
    "Callable": "a function",
    "NoneType": "None",
    "bool": "True or False",
    "float": "a number",
    "int": "a whole number",
    "str": "text",
}
"""What a kind is called in a message, and where one comes from."""
_SEVERAL = {
    "Actor by name": "agents by name, such as {'mine': Rule()}",
    "str": "a list of names",
    "str by name": "text by name",
    "Finding": "a list of findings",
    "Mapping": "a list of mappings, such as [animat.Thresholds(9)]",
    "Policy by name": "policies by name, as animat.load_policies returns",
    "Recording": "a list of recordings, as animat.read_recordings returns",
    "Responses": "a list of responses, as animat.extract_series returns",
    "TrainingCallback": "a list of functions that take a row of a learning curve",
}
"""What several of a kind are called."""
_NUMBERS: dict[Any, Any] = {float: Real, int: Integral}
_UNSAID = ("ResponseTable", "str")
"""What may also come and goes without saying: a table in place of a recording, text in place of what it names."""
_hints: Callable[..., dict[str, Any]] = functools.cache(get_type_hints)


def checked_arguments(thing: Thing) -> Thing:
    """A decorator of functions and classes: raises InvalidArgument for an argument not of its annotation's kind.

    A path in place of the recording that it holds would otherwise fail deep inside. What an annotation cannot say, such
    as which names are known, is left to the function, as are arrays and anything without an annotation. Numpy's scalars
    become Python's: results are written as JSON, which does not know them.
    """
    if isinstance(thing, type):
        thing.__init__ = checked_arguments(thing.__init__)  # type: ignore[misc]
        return thing
    function: Callable[..., Any] = thing
    signature = inspect.signature(function)
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    names = [name for name, parameter in signature.parameters.items() if parameter.kind not in several]

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        args, kwargs = python_numbers(args), {name: python_numbers(value) for name, value in kwargs.items()}
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            return function(*args, **kwargs)  # Raises Python's own error for missing or unexpected arguments.
        for name in names:
            if name in given:
                check_argument(name, given[name], _hints(function).get(name, Any))
        return function(*args, **kwargs)

    return cast(Thing, checked)


def python_numbers(value: Any) -> Any:
    """A value with Python's numbers in place of numpy's scalars, also in a tuple."""
    if type(value) is tuple:
        return tuple(map(python_numbers, value))
    return value.item() if isinstance(value, np.generic) else value


def check_argument(name: str, value: Any, hint: Any) -> None:
    """Raise InvalidArgument for one argument of another kind, where the decorator cannot be used."""
    if strangers := _unfitting(value, hint):
        raise InvalidArgument(f"{name}: expected {_words(hint)}, got {shown(strangers[0])}")


def _unfitting(value: Any, hint: Any) -> list[Any]:
    """The value if it does not fit the annotation, or the items in it that do not; empty if all fits."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return [value] if all(_unfitting(value, each) for each in inner) else []
    if kind is Any or not isinstance(kind, type) or kind.__module__ == "jaxtyping" or issubclass(kind, np.ndarray):
        return []
    if issubclass(kind, tuple) and Ellipsis not in inner:
        return [] if isinstance(value, Iterable) else [value]
    if getattr(kind, "_is_protocol", False):
        if getattr(kind, "_is_runtime_protocol", False):
            # From Python 3.12 on `isinstance` does not see what `__getattr__` provides.
            fits = all(hasattr(value, member) for member in vars(kind) if not member.startswith("_"))
        else:
            fits = "__call__" not in vars(kind) or callable(value)
    elif inner and issubclass(kind, Mapping):
        if isinstance(value, Mapping):
            pairs = [pair for item in value.items() for pair in zip(item, inner, strict=True)]
            return [stranger for each, its in pairs for stranger in _unfitting(each, its)]
        fits = False
    elif inner and issubclass(kind, Iterable):
        fits = isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping)
        # The items of an iterator cannot be checked without consuming it.
        if fits and isinstance(value, Collection):
            return [stranger for each in value for stranger in _unfitting(each, inner[0])]
    else:
        fits = isinstance(value, _NUMBERS.get(kind, kind))
    return [] if fits else [value]


def _words(hint: Any) -> str:
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        said = [each for each in inner if _name(each) not in _UNSAID]
        return ", or ".join(map(_words, said if set(said) - {NoneType} else inner))
    if inner and issubclass(kind, tuple) and Ellipsis not in inner:
        return f"a tuple of {' and '.join(map(_words, inner))}"
    if inner and issubclass(kind, Iterable):
        by_name = issubclass(kind, Mapping)
        each = inner[1] if by_name else inner[0]
        each = get_args(each)[0] if get_origin(each) in (Union, UnionType) else each
        return _SEVERAL.get(f"{_name(each)}{' by name' * by_name}") or f"several of: {_words(each)}"
    what = _ONE.get(_name(hint)) or f"a {_name(hint)}"
    if kind is Callable and inner and inner[-1] is not NoneType:
        return f"{what} that returns {_words(inner[-1]).replace('such as ', 'such as lambda: ')}"
    return what


def _name(hint: Any) -> str:
    return str(getattr(get_origin(hint) or hint, "__name__", hint))
