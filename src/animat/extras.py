"""Packages that only some commands need: each belongs to an extra, and is imported where it is used."""

from __future__ import annotations

import importlib
from typing import Any

from animat.errors import AnimatError


def expect_extra(module: str, *, package: str, extra: str, what: str) -> Any:
    """A package that an extra brings.

    Args:
        module: to import.
        package: what people call it.
        extra: that brings it.
        what: needs it.

    Raises:
        AnimatError: if it is not installed, saying how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise AnimatError(f"{what} needs {package}, which is not installed: pip install 'animat[{extra}]'") from error
