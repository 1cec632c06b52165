"""Packages that only some commands need: each belongs to an extra, and is imported where it is used."""

from __future__ import annotations

import importlib
from typing import Any

from animat.errors import AnimatError


def expect_extra(module: str, *, package: str, extra: str, what: str) -> Any:
    """A module of a package that an extra brings, for what needs it; AnimatError, saying how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise AnimatError(f"{what} needs {package}, which is not installed: pip install 'animat[{extra}]'") from error
