"""Exceptions of a device's own software as animat's errors: one line, with what was requested from the device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from animat.errors import AnimatError, DeviceFailed


@contextmanager
def as_device_failure(who: str, doing: str) -> Iterator[None]:
    """Turn any exception but animat's own and `MemoryError` into a `DeviceFailed` that names it.

    Args:
        who: the culture.
        doing: what was requested, as in "expected it to ...".

    Raises:
        DeviceFailed: with the exception as its cause.
    """
    try:
        yield
    except (AnimatError, MemoryError):
        raise
    except Exception as error:
        raise DeviceFailed(f"{who}: expected it to {doing}, got {describe_error(error)}") from error


def describe_error(error: BaseException) -> str:
    """The type and message of an error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'}"
