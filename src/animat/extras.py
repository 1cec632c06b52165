"""Packages that only some commands need: each belongs to an extra, and is imported where it is used."""

from __future__ import annotations

import importlib
from typing import Any

from animat.errors import AnimatError


def install_command(extra: str) -> str:
    """The command that installs an extra, for messages."""
    return f"pip install 'animat[{extra}]'"


def expect_extra(module: str, *, package: str, extra: str, argument: str) -> Any:
    """Import a module that an extra installs; the AnimatError if it is missing names the argument that needs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise AnimatError(
            f"{argument}: expected the package {package}, which is not installed: {install_command(extra)}"
        ) from error
