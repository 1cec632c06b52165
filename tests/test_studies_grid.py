"""Lists in a study's specification: the combinations, their names, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from animat.errors import InvalidFile
from animat.studies.specification import Study
from animat.studies.toml import read_study, study_to_toml

DOCS = Path(__file__).parents[1] / "docs" / "studies.md"


def study(folder: Path, text: str) -> Study:
    (folder / "study.toml").write_text(text)
    return read_study(folder / "study.toml")


def test_the_grid_of_the_docs_equals_its_entries_written_out(tmp_path: Path) -> None:
    block = re.search(r"### Grids.*?```toml\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert block
    first = '[[arms]]\nname = "first"\n\n'
    got = study(tmp_path, first + block[1])
    mappings, shadowing = ("1-threshold", "9-thresholds"), (True, False)
    assert [(arm.name, arm.mapping, arm.shadowing) for arm in got.arms[1:]] == [
        (f"{mapping} shadowing {str(each).lower()}", mapping, each) for mapping in mappings for each in shadowing
    ]
    assert [(each.first, each.second) for each in got.comparisons] == [
        ("1-threshold shadowing true", f"9-thresholds shadowing {each}") for each in ("true", "false")
    ]
    # What is left in the study's folder is the same study, and so the same folder.
    assert study(tmp_path, study_to_toml(got)) == got


def test_lists_in_parameters_of_robots_are_expanded(tmp_path: Path) -> None:
    got = study(
        tmp_path,
        '[[robots]]\nname = "pole {pole_mass_kg} {iterations}"\nkind = "cartpole"\niterations = [1000, 2000]\n'
        "parameters = { pole_mass_kg = [0.1, 0.55] }\n",
    )
    assert [(spec.name, spec.iterations, dict(spec.parameters)) for spec in got.robots] == [
        (f"pole {mass:g} {iterations}", iterations, {"pole_mass_kg": mass})
        for iterations in (1000, 2000)
        for mass in (0.1, 0.55)
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            'name = "a"\nshadowing = [true, false]',
            r"arms\.name: expected it to contain \{shadowing\}, which is a list, got 'a'",
        ),
        ("shadowing = [true, false]", r"arms\.name: expected it to contain \{shadowing\}, which is a list, got None"),
        ('name = "a {shadowing}"\nshadowing = [true, 3]', r"arms"),
        ('name = "a {shadowing}"\nshadowing = [true, true]', r"arms: expected each name once, got 'a-true' 2 times"),
        ('name = "a {delivery}"\ndelivery = []', r"arms.*delivery"),
        (f'name = "a {{percentiles}}"\npercentiles = [{"1, " * 1001}]', r"arms: expected at most 1,000, got 1,001"),
    ],
)
def test_an_invalid_grid_is_refused_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match=message) as raised:
        study(tmp_path, f"[[arms]]\n{text}\n")
    assert "\n" not in str(raised.value)
