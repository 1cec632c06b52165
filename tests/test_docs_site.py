"""The documentation builds as a site without a warning, and has every public name."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import animat

ROOT = Path(__file__).parents[1]


@pytest.mark.oracle
def test_the_site_builds_without_a_warning_and_explains_every_public_name(tmp_path: Path) -> None:
    pytest.importorskip("furo", reason="needs '.[docs]'")
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", "docs", ".", str(tmp_path / "site")]
    built = subprocess.run([*build, "-d", str(tmp_path / "read")], cwd=ROOT, capture_output=True, text=True)
    assert (built.returncode, built.stderr) == (0, "")
    page = (tmp_path / "site" / "docs" / "api.html").read_text()
    assert set(re.findall(r'id="animat\.(\w+)"', page)) == set(animat.__all__)
    # Equations stand as they were written, and no section of a docstring is shown as text.
    assert re.search(r"<pre>.*U_1</span> <span[^>]*>=", page)
    assert not re.search(r"<p>(Args|Raises|Returns|Attributes):", page)
    # Of a type, not of a type variable.
    assert ">Robot<" in page.split('id="animat.robot_named"')[1].split("</dt>")[0]
    assert ">Thing<" not in page
    front = (tmp_path / "site" / "README.html").read_text()
    assert all(f'href="{page.stem}' in front or f"/{page.stem}.html" in front for page in (ROOT / "docs").glob("*.md"))
