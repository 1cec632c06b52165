"""The robot with two commands of the page on robots, as its file there says; not registered."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from animat.robots.registry import REGISTRY

PAGE = (Path(__file__).parents[1] / "docs" / "own-robots.md").read_text()
(FILE,) = re.findall(r"```python\n((?:(?!```).)*class Wheels.*?)```", PAGE, re.DOTALL)
"""Of one block, whatever stands in it."""

Wheels: Any
REGISTRY._registered.pop("two-wheels", None)
exec(compile(FILE, "two_wheels.py", "exec"), globals())
REGISTRY._registered.pop("two-wheels")
