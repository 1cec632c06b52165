"""No command puts its work among another's; with its own it goes on, and other files beside do not matter."""

from __future__ import annotations

from pathlib import Path

import pytest

from animat.cli import main
from animat.closed_loop.session import LOG_FILE as SESSION
from animat.cultures.series import SELECTION_FILE, STATE_FILE
from animat.errors import Mismatch
from animat.folders import MARKERS, FolderKind, expect_no_other
from animat.live.plan import LOG_FILE as LIVE
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.studies.cultures import MANIFEST as CULTURES
from animat.studies.folder import MANIFEST as STUDY
from animat.training.folder import MANIFEST as TRAINING
from animat.tuning.run import MANIFEST as TUNING
from synthetic_recordings import synthetic_recording
from test_run_on_recordings import policy_of

TINY = Path(__file__).parent / "tiny_study.toml"

COMMANDS: dict[FolderKind, tuple[str, list[str]]] = {
    "recording": ("recordings", ["record", "--sessions", "1"]),
    "training": ("policies", ["train", "cartpole", "--mapping", "none", "--policies", "1", "--iterations", "1000"]),
    "session": ("a session", ["run", "{beside}/p0.safetensors", "--recordings", "{beside}/synthetic.nwb"]),
    "cultures": ("a study of many cultures", ["study", "{beside}/many.toml"]),
}
"""What each takes its folder for, and its words but for the folder."""
OTHERS: list[tuple[FolderKind, str, str]] = [
    ("session", SESSION, "a session"),
    ("training", TRAINING, "policies"),
    ("training", "p0.safetensors", "policies"),
    ("tuning", TUNING, "a tuning"),
    ("study", STUDY, "a study"),
    ("cultures", CULTURES, "a study of many cultures"),
    ("recording", recording_name(0.0), "recordings"),
    ("recording", recording_name(1005.5), "recordings"),
    ("recording", STATE_FILE, "recordings"),
    ("live", LIVE, "a live run"),
]
"""Files that the modules write, what each belongs to, and its description."""


@pytest.mark.parametrize(
    ("kind", "mark", "description"), [(kind, *other) for kind in COMMANDS for of, *other in OTHERS if of != kind]
)
def test_a_folder_of_another_kind_is_refused_and_stays_as_it_is(
    kind: FolderKind,
    mark: str,
    description: str,
    few_bootstraps: None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if kind == "session":
        write_nwb(synthetic_recording(1, patterns=40, channels=32), tmp_path / "synthetic.nwb")
    policy_of(0).save(tmp_path / "p0.safetensors")
    (tmp_path / "many.toml").write_text(TINY.read_text().replace("files = [", "folders = ["))
    out = tmp_path / "out"
    out.mkdir()
    (out / mark).write_bytes(b"somebody's")
    expected, words = COMMANDS[kind]
    assert main([*(word.format(beside=tmp_path) for word in words), "--out", str(out)]) == 1
    said = f"{out}: expected a folder for {expected}, got one with {description} ({mark}); choose another folder\n"
    assert capsys.readouterr().err.endswith(said)
    assert {file.name: file.read_bytes() for file in out.iterdir()} == {mark: b"somebody's"}


@pytest.mark.parametrize("kind", COMMANDS)
def test_a_folder_of_the_same_kind_an_empty_one_and_other_files_are_accepted(kind: FolderKind, tmp_path: Path) -> None:
    expect_no_other(tmp_path / "none", kind)
    for beside in (".p0.safetensors", ".session.log", "notes.txt", SELECTION_FILE, "raster.png", "best.toml"):
        (tmp_path / beside).touch()
    for folder in ("figures", "culture-1", "policies"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / TRAINING).touch()
    expect_no_other(tmp_path, kind)
    (tmp_path / LIVE).touch()
    (tmp_path / TUNING).touch()
    with pytest.raises(Mismatch, match=r"got one with a tuning \(tune.json\), a live run \(live.log\); choose"):
        expect_no_other(tmp_path, kind)
    # What goes on may have had another's work put beside it, by former versions or by hand.
    (tmp_path / next(mark for of, mark, _ in OTHERS if of == kind)).touch()
    expect_no_other(tmp_path, kind)


def test_every_kind_is_tried() -> None:
    assert {kind for kind, *_ in OTHERS} == set(MARKERS)
