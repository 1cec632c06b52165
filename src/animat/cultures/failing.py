"""What a device's own software raises, as an error of ours: in one line, with what was asked of the device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from animat.errors import AnimatError, DeviceFailed


@contextmanager
def as_device_failure(who: str, doing: str) -> Iterator[None]:
    """Turn an exception that is none of ours into `DeviceFailed`, which names it; ours pass as they are.

    Args:
        who: the culture.
        doing: what was asked of it, as in "expected it to ...".

    Raises:
        DeviceFailed: caused by what was raised.
    """
    try:
        yield
    except (AnimatError, MemoryError):
        raise
    except Exception as error:
        raise DeviceFailed(f"{who}: expected it to {doing}, got {in_words(error)}") from error


def in_words(error: BaseException) -> str:
    """An error with its type, whatever it says, in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'no words'}"
