"""Packages that only some commands need: each belongs to an extra, and is imported where it is used."""

from __future__ import annotations

import importlib
import shlex
import sys
from typing import Any

from animat.errors import AnimatError


def install_command(extra: str) -> str:
    """The command that installs an extra, for messages: pip takes the animat that is installed, also from a clone."""
    return pip_install(f"animat[{extra}]")


def pip_install(requirement: str) -> str:
    """The command that installs a package for the Python that runs, which a bare `pip` may not belong to."""
    return f"{shlex.quote(sys.executable)} -m pip install '{requirement}'"


def expect_extra(module: str, *, package: str, extra: str) -> Any:
    """Import a module; the AnimatError if it is missing begins with its extra, as the argument that needs it does."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = f"expected the package {package}, which is not installed: {install_command(extra)}"
        raise AnimatError(f"{extra}: {missing}") from error
