"""The documentation as a site, built in the project's folder by `sphinx-build -c docs . site`."""

from __future__ import annotations

import importlib.metadata
import inspect
from pathlib import Path
from typing import Any

import animat
from animat.registry import Registry

project, author = "animat", "the maintainers of animat"
release = importlib.metadata.version("animat")
root_doc = "README"
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**.md", "benchmarks/README.md"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
myst_heading_anchors = 4
default_role = "literal"
autodoc_member_order = "bysource"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
# Shapes such as "*readouts" are not emphasis.
napoleon_attr_annotations = False
python_maximum_signature_line_length = 100
html_theme = "furo"
html_title = f"animat {release}"
html_show_sourcelink = html_show_copyright = False

_GUIDE = (
    *("recordings", "cultures", "virtual-culture", "hardware", "recording-a-culture", "responses"),
    *("robots", "own-robots", "goals", "training", "lessons", "evaluation", "closed-loop", "reality-gap", "live"),
    *("session-files", "policy-file", "agents", "studies", "tuning", "watch", "cluster", "gymnasium", "api"),
    *("architecture", "dependencies"),
)
"""Pages in the order of the story."""


def _add(app: Any, page: str, text: list[str]) -> None:
    """Add the list of pages to the README, and the public names to the page of the Python API."""
    if page == "docs/api":
        rooms: dict[str, list[str]] = {}
        for name, module in animat._MODULE_OF.items():
            thing, room = getattr(animat, name), rooms.setdefault(module.split(".")[1], [])
            if inspect.isclass(thing):
                room.extend([f".. autoclass:: animat.{name}", "   :members:", ""])
            elif callable(thing):
                room.extend([f".. autofunction:: animat.{name}", ""])
            else:
                room.extend([f".. py:data:: animat.{name}", f"   :value: {thing}", ""])
        for room, lines in rooms.items():
            title = room.replace("_", " ").capitalize()
            text[0] += "\n".join(["", f"## {title}", "", "```{eval-rst}", *lines, "```", ""])
    if page == root_doc:
        evidence = sorted(file.stem for file in (Path(__file__).parent / "evidence").glob("*.md"))
        for caption, pages in {
            "Guide": [f"docs/{name}" for name in _GUIDE],
            "Evidence": [f"docs/evidence/{name}" for name in evidence],
            "Project": ["benchmarks/README", "CHANGELOG", "CONTRIBUTING"],
        }.items():
            text[0] += "\n".join(["", "```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```", ""])


def _prepare(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Keep indented equations and examples as they are; what a section such as `Args:` indents is no example.

    An attribute's docstring gets an empty comment first, as napoleon takes what is before a colon for its type.
    """
    if what in ("attribute", "property"):
        lines[:0] = ["..", ""]
    for place in range(len(lines) - 1, 1, -1):
        before = next((line for line in reversed(lines[:place]) if line), "")
        if lines[place].startswith("    ") and not lines[place - 1] and before and not before.startswith(" "):
            lines[place:place] = ["::", ""]


def _signature(
    app: Any, what: str, name: str, thing: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Make defaults of dataclasses readable, and name what a registry's functions return, not its type variable."""
    registry = getattr(thing, "__self__", None)
    if isinstance(registry, Registry) and returned == "~animat.registry.Thing":
        returned = registry.base.__name__
    return signature and signature.replace("<factory>", "..."), returned


def setup(app: Any) -> None:
    app.connect("source-read", _add)
    app.connect("autodoc-process-signature", _signature)
    # Before napoleon reads the sections.
    app.connect("autodoc-process-docstring", _prepare, priority=400)
