"""Packages that only some commands need: each belongs to an extra, and is imported where it is used."""

from __future__ import annotations

import importlib
from typing import Any

from animat.errors import AnimatError


def expect_extra(module: str, *, package: str, extra: str, what: str) -> Any:
    """Import a module that an extra installs; raise AnimatError, saying how to install it, if it is missing."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise AnimatError(f"{what} needs {package}, which is not installed: pip install 'animat[{extra}]'") from error
