"""The examples of the pages on cultures and on recording them run as they are printed, one after the other."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.mark.oracle
@pytest.mark.parametrize(("page", "examples"), [("cultures", 3), ("recording-a-culture", 3)])
def test_the_examples_run(page: str, examples: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = re.findall(r"```python\n(.*?)```", (DOCS / f"{page}.md").read_text(), re.DOTALL)
    assert len(found) == examples
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for example in found:
        exec(compile(example, f"docs/{page}.md", "exec"), names)
    if page == "recording-a-culture":
        assert names["selection"].patterns.shape == (50, 5)  # type: ignore[attr-defined]
        assert (tmp_path / "array.png").exists()
