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

_DEFINITIONS = ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef
_IMPORTS = ast.Import, ast.ImportFrom


def code_of(thing: Any) -> dict[str, str]:
    """A fingerprint of the code of a robot or a mapping, by its name; empty for one of animat's own.

    The code is that of its class and of everything in the class's module that it uses; comments and docstrings do not
    count. Code in other modules does not count either, nor code that is in no file, as in a notebook.
    """
    return {} if is_ours(thing) else code_at(type(thing).__module__, type(thing).__qualname__, thing.name)


def code_at(module: str, place: str, name: str) -> dict[str, str]:
    """The same for a class or a function at its place in a module, as the code of what is called `name`."""
    with suppress(OSError, ValueError, SyntaxError, ImportError):
        file = getattr(sys.modules.get(module), "__file__", None) or getattr(find_spec(module), "origin", None)
        parts = [] if file is None else _used_by(place.partition(".")[0], ast.parse(Path(file).read_bytes()))
        if parts:
            digest = hashlib.sha256(repr(_structure(parts)).encode()).hexdigest()
            return {f"code of {name}": f"sha256 {digest[:16]}"}
    return {}


def _used_by(name: str, module: ast.Module) -> list[ast.stmt]:
    """The statements of a module that define a name, and all that these use, in their order."""
    statements = (_Plain().visit(statement) for statement in module.body if not _is_main(statement))
    defines = [(statement, _defined_in(statement)) for statement in statements if statement is not None]
    imported = {name for statement, names in defines if isinstance(statement, _IMPORTS) for name in names}
    defines = [(statement, names or {*_possibly_changed(statement)} - imported) for statement, names in defines]
    wanted, used = [name], {name}
    while wanted:
        current = wanted.pop()
        for statement, names in defines:
            if current in names:
                new = {node.id for node in ast.walk(statement) if isinstance(node, ast.Name)} - used
                used |= new
                wanted += sorted(new)
    return [statement for statement, names in defines if names & used]


def _defined_in(statement: ast.stmt) -> set[str]:
    """The names that a statement of a module defines, also within `if` and `try`."""
    if isinstance(statement, _DEFINITIONS):
        return {statement.name}
    names = set()
    for node in ast.walk(statement):
        if isinstance(node, _DEFINITIONS):
            names.add(node.name)
        elif isinstance(node, _IMPORTS):
            names |= {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.Name | ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store):
            names |= {*_root_name(node)}
    return names


def _possibly_changed(statement: ast.stmt) -> list[str]:
    """The name of the object whose method is called, which may change it: `GAINS.append(2)`."""
    call = statement.value if isinstance(statement, ast.Expr) else None
    return _root_name(call.func) if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) else []


def _root_name(part: ast.expr) -> list[str]:
    """The name at the root of an expression: `Rover` of `Rover.gain`, `GAINS` of `GAINS[0]`."""
    while isinstance(part, ast.Attribute | ast.Subscript):
        part = part.value
    return [part.id] if isinstance(part, ast.Name) else []


def _is_main(statement: ast.stmt) -> bool:
    """Whether it runs only where the module is the program: `if __name__ == "__main__":`."""
    return isinstance(statement, ast.If) and ast.unparse(statement.test).startswith("__name__ ==")


def _structure(node: Any) -> Any:
    """A syntax tree as nested tuples that are the same in every version of Python: without fields that are empty."""
    if isinstance(node, list):
        return tuple(map(_structure, node))
    if not isinstance(node, ast.AST):
        return node
    known = ((name, value) for name, value in ast.iter_fields(node) if value not in (None, []))
    return type(node).__name__, *((name, _structure(value)) for name, value in known)


class _Plain(ast.NodeTransformer):
    """Removes docstrings, and other text that nothing uses."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        return None if isinstance(node.value, ast.Constant) else node
