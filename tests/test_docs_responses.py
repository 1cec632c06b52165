"""Every finding on responses and simulators has its line in docs/responses.md, and every line there is one."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def names_in_the_code() -> set[str]:
    """The first argument of every `Finding(...)` in the package that extracts responses and fits simulators."""
    calls = [
        node
        for room in ("responses", "neurons")
        for file in (ROOT / "src" / "animat" / room).rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Finding"
    ]
    names = {argument.value for call in calls for argument in call.args[:1] if isinstance(argument, ast.Constant)}
    assert all(call.args and isinstance(call.args[0], ast.Constant) for call in calls)
    return names


def test_the_table_of_findings_is_whole() -> None:
    page = (ROOT / "docs" / "responses.md").read_text()
    table = page[page.index("| finding | severity |") :]
    assert set(re.findall(r"^\| `([a-z-]+)` \|", table, re.MULTILINE)) == names_in_the_code()
