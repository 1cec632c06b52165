"""Drive a robot with a living neuronal culture: record, simulate, train, evaluate, close the loop.

The public names are listed in `__init__.pyi`, in the order of the story. Nothing heavy is imported before it is used.
"""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

from animat.gym import register_environments

_MODULE_OF = {
    alias.name: str(node.module)
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text()).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}

__all__ = list(_MODULE_OF)

# Since Gymnasium 1.0 plugins must be imported to be known. This loads no environment.
register_environments()


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("animat")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'animat' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
