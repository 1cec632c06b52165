"""A tuning's file: what is searched, what is refused, and that Optuna is needed for nothing else."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from animat.cli import main
from animat.errors import InvalidFile
from animat.training.specification import CHUNKS
from animat.tuning.results import describe_settings
from animat.tuning.search import JOURNAL, read_journal
from animat.tuning.specification import Range, Tune, own_settings, read_tuning, with_settings

TINY = Path(__file__).parent / "tiny_tuning.toml"
PLAIN = '[[robots]]\nname = "cartpole"\n[[arms]]\nname = "1 threshold"\n'


def written(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "tune.toml"
    file.write_text(text)
    return file


def test_a_file_s_search_is_read() -> None:
    space = read_tuning(TINY).space
    assert space == {
        "learning_rate": Range(1e-4, 1e-2, True),
        "discount": Range(0.9, 0.999),
        "simulator": ("histogram", "empirical"),
    }


@pytest.mark.parametrize("arm", ["", 'mapping = "9-thresholds"', 'mapping = "none"'])
@pytest.mark.parametrize(
    "algorithm", ["", "learning_rate = 1e-5\ndiscount = 0.5", "tau = 0", "discount = 0", "discount = 1"]
)
def test_the_usual_search_holds_the_study_s_own_settings(tmp_path: Path, arm: str, algorithm: str) -> None:
    tuning = read_tuning(written(tmp_path, f"{PLAIN}{arm}\n[algorithm]\n{algorithm}\n"))
    own = own_settings(tuning.study)
    assert all(own[name] in among for name, among in tuning.space.items())
    assert ("mapping" in tuning.space) == ("none" not in arm)
    # A range that reaches 0, or a discount of 1, has no logarithm.
    uniform = [name for name, among in tuning.space.items() if isinstance(among, Range) and not among.log]
    assert uniform == [algorithm.partition(" =")[0]] * algorithm.endswith(("= 0", "= 1"))
    assert all(isinstance(among, Range) or len({*among}) == len(among) for among in tuning.space.values())
    assert with_settings(tuning.study, {name: own[name] for name in tuning.space}).arms == tuning.study.arms


def test_without_neurons_continuous_commands_are_tuned_by_their_own_entropy(tmp_path: Path) -> None:
    text = '[[robots]]\nname = "navigation"\n[[arms]]\nname = "none at all"\nmapping = "none"\n'
    space = read_tuning(written(tmp_path, text)).space
    assert "entropy_nats" in space and "target_entropy_ratio" not in space


def test_the_page_s_example_is_a_tuning_and_its_defaults_are_the_code_s(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "tuning.md").read_text()
    (example,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    tuning = read_tuning(written(tmp_path, example))
    assert tuning.space["batch"] == (32, 64, 128) and tuning.tune.trials == 40
    usual = Tune()
    for names in (["trials"], ["together"], ["policies", "episodes"], ["rungs", "keep"], ["finalists"], ["seed"]):
        row = (
            f"| {', '.join(f'`{name}`' for name in names)} | {', '.join(str(getattr(usual, name)) for name in names)} |"
        )
        assert row in page


@pytest.mark.parametrize(("rungs", "keep", "chunks"), [(1, 3, [60]), (2, 2, [30, 60]), (3, 3, [7, 20, 60])])
def test_rungs_are_shares_of_a_training(rungs: int, keep: int, chunks: list[int]) -> None:
    assert Tune(rungs=rungs, keep=keep).chunks == chunks
    assert chunks[-1] == CHUNKS


BODY = 'name = "pendulum"\nkind = "gymnasium:Pendulum-v1"'
SEARCH = f"{PLAIN}[tune.search]\n"
BAD = {
    "no TOML": ("[tune", ["TOML"]),
    "no study": ("[tune]\ntrials = 3\n", ["[[robots]]"]),
    "two robots": ("[tune]\n[[arms]]\nname = 'a'\n", ["robots", "got 2"]),
    "an arm that is not trained": (f"{PLAIN}trained = false\n", ["arms.trained"]),
    "a body of others": (PLAIN.replace('name = "cartpole"', BODY), ["gymnasium:Pendulum-v1", "stepped in JAX"]),
    "no trials": (f"{PLAIN}[tune]\ntrials = 0\n", ["tune.trials", "at least 1"]),
    "a misspelt key": (f"{PLAIN}[tune]\ntrails = 9\n", ["trails", "[tune]", "did you mean trials?"]),
    "more rungs than parts": (f"{PLAIN}[tune]\nrungs = 5\n", ["rungs", "60", "3^4"]),
    "nothing to search": (SEARCH, ["tune.search", "at least one"]),
    "a misspelt setting": (f"{SEARCH}discuont = {{ low = 0.9, high = 0.99 }}\n", ["'discuont'", "mean discount?"]),
    "a logarithm of no distance from 1": (
        f"{SEARCH}discount = {{ low = 0.9, high = 1, log = true }}\n",
        ["search.discount", "below 1"],
    ),
    "an empty range": (f"{SEARCH}discount = {{ low = 0.99, high = 0.99 }}\n", ["search.discount", "more than low"]),
    "a range of no end": (f"{SEARCH}discount = {{ low = 0.9 }}\n", ["search.discount.high", "got nothing"]),
    "a logarithm of nothing": (f"{SEARCH}tau = {{ low = 0, high = 1, log = true }}\n", ["search.tau", "more than 0"]),
    "a discount beyond 1": (f"{SEARCH}discount = {{ low = 0.9, high = 1.5 }}\n", ["search.discount", "at most 1"]),
    "half a gradient step": (f"{SEARCH}gradient_steps = {{ low = 0.5, high = 8 }}\n", ["gradient_steps", "whole"]),
    "one choice": (f'{SEARCH}mapping = ["linear"]\n', ["search.mapping", "two or more"]),
    "the same choice twice": (f'{SEARCH}mapping = ["linear", "linear"]\n', ["search.mapping", "different"]),
    "a number for a range": (f"{SEARCH}tau = 0.1\n", ["search.tau", "got 0.1"]),
    "an unknown mapping": (f'{SEARCH}mapping = ["1-threshold", "cubic"]\n', ["search.mapping", "cubic"]),
    "no mapping": (f'{SEARCH}mapping = ["1-threshold", "none"]\n', ["search.mapping", "'none'"]),
    "an unknown simulator": (f'{SEARCH}simulator = ["histogram", "exact"]\n', ["search.simulator", "'exact'"]),
    "without its own": (f'{SEARCH}mapping = ["linear", "9-thresholds"]\n', ["search.mapping", "'1-threshold'"]),
    "a range without its own": (f"{SEARCH}discount = {{ low = 0.5, high = 0.6 }}\n", ["search.discount", "0.99"]),
    "environments in a range": (f"{SEARCH}environments = {{ low = 8, high = 64 }}\n", ["environments", "a list"]),
    "a replay that does not fit": (f"{SEARCH}environments = [32, 33]\n", ["tune.search", "replay", "33"]),
    "a mapping without neurons": (
        f'{PLAIN}mapping = "none"\n[tune.search]\nmapping = ["linear", "1-threshold"]\n',
        ["search.mapping", "without neurons"],
    ),
}


@pytest.mark.parametrize(("text", "words"), BAD.values(), ids=list(BAD))
def test_errors_take_one_line_and_come_before_there_is_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: list[str]
) -> None:
    assert main(["tune", str(written(tmp_path, text)), "--out", str(tmp_path / "out")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"animat: {tmp_path / 'tune.toml'}: ")
    assert all(word in line for word in words), line
    assert not (tmp_path / "out").exists()


def test_without_optuna_the_extra_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # What Python does with a module that is None is what it does where there is none.
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert main(["tune", str(TINY), "--out", str(tmp_path / "out")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'animat[tune]'" in line
    assert not (tmp_path / "out").exists()


def test_an_invalid_setting_of_a_study_is_reported_as_without_tune(tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match="polcies: no such setting at the top"):
        read_tuning(written(tmp_path, f"polcies = 3\n{PLAIN}"))


@pytest.mark.parametrize("number", ["NaN", "Infinity", "true", '"1"'])
def test_a_journal_with_a_return_that_is_no_finite_number_is_refused(tmp_path: Path, number: str) -> None:
    line = f'{{"trial": 0, "settings": {{}}, "state": "complete", "chunks": [60], "returns": [[{number}]]}}'
    (tmp_path / JOURNAL).write_text(line + "\n")
    with pytest.raises(InvalidFile, match=r"journal\.jsonl: .*returns: expected a (finite )?number.*remove it to run"):
        read_journal(tmp_path)


def test_settings_are_shown_with_the_digits_that_matter() -> None:
    """The search goes by how far a discount is from 1: all above 0.9985 were shown as 0.999 or 1."""
    settings = {"discount": 0.99971234, "learning_rate": 0.00123456, "conditions": "", "batch": 64}
    shown = describe_settings(settings)
    for each in ("discount 0.999712", "learning_rate 0.00123", 'conditions ""', "batch 64"):
        assert each in shown.split(", ")
    assert describe_settings({"discount": 0.99}) == "discount 0.99"
