"""The README against the product: its links, its commands, its code."""

from __future__ import annotations

import re
import shlex
import tomllib
from functools import cache
from pathlib import Path

import pytest

from animat.cli import _parse

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "benchmarks" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
BLOCKS = re.findall(r"```sh\n(.*?)```", README, flags=re.DOTALL)
COMMANDS = re.findall(r"\.venv/bin/animat ([^\n&#`]+)", README)


@cache
def anchors_of(page: Path) -> set[str]:
    """The anchors of its headings, as GitHub names them."""
    prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]+))?[^)]*\)", page.read_text())
    targets = [(page.parent / link if link else page, anchor) for link, anchor in links if "://" not in link]
    missing = [target for target, _ in targets if not target.exists()]
    assert not missing
    # A description broken over two lines loses the space between them in the site.
    assert re.findall(r"!\[[^\]\n]*\]", page.read_text()) == re.findall(r"!\[[^\]]*\]", page.read_text())
    assert not [(target, anchor) for target, anchor in targets if anchor and anchor not in anchors_of(target)]


def test_every_page_is_in_the_source_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    included = project["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert {page.relative_to(ROOT).parts[0] for page in PAGES} <= set(included)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_one_that_animat_knows(command: str) -> None:
    _parse(shlex.split(command))


def test_the_two_commands_are_one_line_each_and_the_second_is_what_ci_runs() -> None:
    assert [block.count("\n") for block in BLOCKS[:2]] == [1, 1]
    wanted = [line for line in README.splitlines() if line.endswith("python -m pytest")]
    assert wanted == [BLOCKS[1].strip()]


def test_the_code_for_gymnasium_runs(capsys: pytest.CaptureFixture[str]) -> None:
    code = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)[0]
    exec(compile(code, "README.md", "exec"), {})
    rate_hz, command = map(float, capsys.readouterr().out.split())
    assert rate_hz >= 0
    assert -1 <= command <= 1


@pytest.mark.oracle
def test_the_examples_in_python_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The README's and, on the policies that it trains, those of docs/training.md; all shorter than there."""
    monkeypatch.chdir(tmp_path)
    shorter = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)[1]
    for written, short in (
        ("trials=1000", "trials=40"),
        ("policies=4, iterations=400_000", "policies=2, iterations=6_400"),
        ('"session-2")', '"session-2", episodes=1, with_controls=False)'),
    ):
        assert written in shorter
        shorter = shorter.replace(written, short)
    names: dict[str, object] = {}
    exec(compile(shorter, "README.md", "exec"), names)
    evaluated, measured = re.split(r"\n(?=cartpole)", capsys.readouterr().out)
    assert evaluated.startswith("cartpole, 9-thresholds, recording at 10 min: 2 policies, 100 episodes each")
    assert measured.startswith(
        "cartpole, 9-thresholds, mixed, 1 pulse per trial; predicted from the recording at 10 min"
    )
    training_page = (ROOT / "docs" / "training.md").read_text()
    wrapped, followed, loaded = re.findall(r"```python\n(.*?)```", training_page, flags=re.DOTALL)
    exec(compile(wrapped, "training.md", "exec"), {})
    assert capsys.readouterr().out == "1 1.0 False\n"
    # With the README's training, which is done: its rows are printed all the same.
    exec(compile(followed, "training.md", "exec"), names)
    rows = [line.split()[:2] for line in capsys.readouterr().out.splitlines()]
    assert {policy for policy, _ in rows} == {"p0", "p1"} and {iterations for _, iterations in rows} >= {"6400"}
    exec(compile(loaded, "training.md", "exec"), {})
    assert capsys.readouterr().out.strip() in ("5 Hz", "10 Hz", "20 Hz", "40 Hz", "80 Hz")
