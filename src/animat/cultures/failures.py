"""Failures of devices, and requests to cultures that are not open, as animat's errors in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import TypeVar

from animat.errors import AnimatError, DeviceFailed, InvalidArgument

T = TypeVar("T")


@contextmanager
def as_device_failure(who: str, doing: str, advice: str = "") -> Iterator[None]:
    """Turn any exception but animat's own and `MemoryError` into a `DeviceFailed`: `who` was expected to be `doing`."""
    try:
        yield
    except (AnimatError, MemoryError):
        raise
    except Exception as error:
        raise DeviceFailed(f"{who}: expected it to {doing}, got {describe_error(error)}{advice}") from error


def vendor_module(name: str, otherwise: str) -> ModuleType:
    """Import a device's own software, or raise `DeviceFailed` with what to do."""
    try:
        return import_module(name)
    except ImportError as error:
        raise DeviceFailed(otherwise) from error


def describe_error(error: BaseException) -> str:
    """The type and message of an error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'}"


def while_open(part: T | None) -> T:
    """A part of a culture that is there only while it is open."""
    if part is None:
        raise InvalidArgument("culture: expected an open one, got a closed one: use it as `with culture:`")
    return part


def once_opened(part: T | None) -> T:
    """A part of a culture that is there from its first opening on."""
    if part is None:
        raise InvalidArgument("culture: expected one that was opened, got a new one: use it as `with culture:`")
    return part
