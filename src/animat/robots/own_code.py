"""The code of a robot or a mapping of the user's own, so that work begun with other code is not continued."""

from __future__ import annotations

import ast
import hashlib
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from animat.registry import is_ours


def code_of(thing: Any) -> dict[str, str]:
    """A fingerprint of the module that defines a robot or a mapping, by its name; empty for one of animat's own.

    Comments, docstrings, and what runs only where the module is the program do not count. Other modules do not count
    either, nor code that is in no file, as in a notebook.
    """
    return {} if is_ours(thing) else code_at(type(thing).__module__, thing.name)


def code_at(module: str, name: str) -> dict[str, str]:
    """The fingerprint of a module, as the code of what is called `name`."""
    with suppress(OSError, ValueError, SyntaxError, ImportError, RecursionError):
        file = getattr(sys.modules.get(module), "__file__", None) or getattr(find_spec(module), "origin", None)
        if file is not None:
            code = repr(_structure(_Plain().visit(ast.parse(Path(file).read_bytes()))))
            return {f"code of {name}": f"sha256 {hashlib.sha256(code.encode()).hexdigest()[:16]}"}
    return {}


def _structure(node: Any) -> Any:
    """A syntax tree as nested tuples that are the same in every version of Python: without fields that are empty."""
    if isinstance(node, list):
        return tuple(map(_structure, node))
    if not isinstance(node, ast.AST):
        return node
    known = ((name, value) for name, value in ast.iter_fields(node) if value not in (None, []))
    return type(node).__name__, *((name, _structure(value)) for name, value in known)


class _Plain(ast.NodeTransformer):
    """Removes docstrings, other text that nothing uses, and `if __name__ == "__main__":`."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        return None if isinstance(node.value, ast.Constant) else node

    def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
        self.generic_visit(node)
        return node.orelse if ast.unparse(node.test) == "__name__ == '__main__'" else node
