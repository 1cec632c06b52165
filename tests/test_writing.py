"""Files that are complete or absent, whatever happens while they are written."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from animat.errors import InvalidFile, Mismatch
from animat.writing import LOCK, atomic_write, clear_away, exclusive_lock, is_unfinished


def test_a_whole_file_takes_the_old_ones_place_with_the_rights_of_a_new_one(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b.txt"
    for content in ("old", "new"):
        with atomic_write(path) as beside:
            assert beside.parent == path.parent
            assert beside.suffix == ".txt"
            assert is_unfinished(beside) and not is_unfinished(path)
            beside.write_text(content)
            assert not path.exists() or path.read_text() == "old"
    assert path.read_text() == "new"
    (tmp_path / "plain").write_text("")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)
    assert [file.name for file in path.parent.iterdir()] == ["b.txt"]


def test_the_umask_of_a_process_with_threads_is_never_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # It belongs to all threads: two that read it by setting it can leave it at 0, and a file open to everybody.
    before = os.umask(0o077)
    try:
        monkeypatch.setattr(os, "umask", None)
        with atomic_write(tmp_path / "b.txt") as beside:
            beside.write_text("new")
        assert stat.S_IMODE((tmp_path / "b.txt").stat().st_mode) == 0o600
    finally:
        monkeypatch.undo()
        os.umask(before)


@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), ValueError("something else"), KeyboardInterrupt()]
)
def test_on_any_error_the_old_file_stays_and_nothing_is_left_behind(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "b.txt"
    path.write_text("old")
    expected = InvalidFile if isinstance(error, OSError) else type(error)
    with pytest.raises(expected) as raised, atomic_write(path) as beside:
        beside.write_text("half")
        raise error
    if expected is InvalidFile:
        assert str(raised.value) == (
            f"{path}: cannot be written: No space left on device; any previous file is unchanged"
        )
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["b.txt"]


def test_both_the_content_and_the_name_are_on_disk_before_it_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = []
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        synced.append((Path(f"/proc/self/fd/{descriptor}").readlink(), (tmp_path / "b.txt").exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    with atomic_write(tmp_path / "b.txt") as beside:
        beside.write_text("new")
    assert [is_renamed for _, is_renamed in synced] == [False, True]
    assert synced[0][0] == beside
    assert synced[1][0] == tmp_path


HOLD = """
import sys
from animat.writing import exclusive_lock
with exclusive_lock(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_folder_is_for_one_run_at_a_time_until_that_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(Mismatch, match="b: another run is at work in this folder"), exclusive_lock(folder):
            pass
        other.send_signal(signal.SIGKILL)
    with exclusive_lock(folder):
        assert not any(folder.iterdir())
    with exclusive_lock(folder):
        pass


@pytest.mark.parametrize("is_made_anew", [False, True])
def test_a_folder_that_is_removed_during_a_run_is_an_error(is_made_anew: bool, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    message = "a: it was removed, moved or replaced during the run: what was written to it before is lost, or"
    with pytest.raises(InvalidFile, match=message), exclusive_lock(folder):
        (folder / "first").touch()
        shutil.rmtree(folder)
        if is_made_anew:
            # As another run does that has written nothing yet.
            folder.mkdir()
    assert folder.exists() == is_made_anew
    # Another error stays as it is.
    with pytest.raises(ValueError, match="mine"), exclusive_lock(folder):
        shutil.rmtree(folder)
        raise ValueError("mine")


def test_a_folder_is_the_same_wherever_a_program_goes_on_working(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with exclusive_lock("a"):
        (tmp_path / "b").mkdir()
        monkeypatch.chdir(tmp_path / "b")
    assert (tmp_path / "a").is_dir()


def without_locks(patch: pytest.MonkeyPatch, *, of_files: bool) -> None:
    """A file system that locks no folders (NFS), or nothing at all."""
    flock = fcntl.flock

    def refusing(descriptor: int, operation: int) -> None:
        if not of_files:
            raise OSError(errno.ENOLCK, "No locks available")
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EBADF, "Bad file descriptor")
        flock(descriptor, operation)

    patch.setattr(fcntl, "flock", refusing)


def test_where_folders_cannot_be_locked_a_file_in_them_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_locks(monkeypatch, of_files=True)
    for _ in range(2):
        with (
            exclusive_lock(tmp_path),
            pytest.raises(Mismatch, match="another run is at work"),
            exclusive_lock(tmp_path),
        ):
            pass
        assert [file.name for file in tmp_path.iterdir()] == [LOCK]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_to_can_be_held_without_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_locks(monkeypatch, of_files=True)
    tmp_path.chmod(0o555)
    with exclusive_lock(tmp_path):
        assert not any(tmp_path.iterdir())
    tmp_path.chmod(0o755)


def test_without_any_locks_the_block_still_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_locks(monkeypatch, of_files=False)
    open_ = os.open

    def read_only(path: str | os.PathLike[str], flags: int, *args: int) -> int:
        if flags & os.O_CREAT:
            raise OSError(errno.EROFS, "Read-only file system")
        return open_(path, flags, *args)

    with exclusive_lock(tmp_path / "a"):
        assert [file.name for file in (tmp_path / "a").iterdir()] == [LOCK]
    (tmp_path / "b").mkdir()
    monkeypatch.setattr(os, "open", read_only)
    with exclusive_lock(tmp_path / "b"):
        assert not any((tmp_path / "b").iterdir())


def test_a_link_to_a_missing_place_is_named_with_that_place(tmp_path: Path) -> None:
    # Such as a drive that is not mounted.
    (tmp_path / "data").symlink_to(tmp_path / "drive")
    for folder in (tmp_path / "data", tmp_path / "data" / "culture" / "1"):
        with (
            pytest.raises(InvalidFile, match=r"data is a link to .*drive, which is missing; mount"),
            exclusive_lock(folder),
        ):
            pass
    assert not (tmp_path / "drive").exists()


def test_a_block_that_fails_leaves_no_empty_folder_behind(tmp_path: Path) -> None:
    for name in ("a/b", "mine"):
        with pytest.raises(ValueError, match="no"), exclusive_lock(tmp_path / name):
            if name == "mine":
                (tmp_path / name / "result").write_text("")
            raise ValueError("no")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    (tmp_path / "mine" / "result").unlink()
    # It was there before.
    with pytest.raises(ValueError, match="no"), exclusive_lock(tmp_path / "mine"):
        raise ValueError("no")
    assert (tmp_path / "mine").is_dir()


def test_a_folder_that_is_removed_before_it_is_locked_is_not_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flock, folder = fcntl.flock, tmp_path / "a"
    monkeypatch.setattr(fcntl, "flock", lambda *args: (folder.rmdir(), flock(*args)))
    with pytest.raises(Mismatch, match="start again"), exclusive_lock(folder):
        pass


def test_a_leftover_that_cannot_be_removed_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_text("")
    clear_away(tmp_path / "a")
    clear_away(tmp_path / "a")
    assert not any(tmp_path.iterdir())
    (tmp_path / "b").write_text("")

    def refused(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "unlink", refused)
    clear_away(tmp_path / "b")
    assert (tmp_path / "b").exists()


def test_a_folder_that_is_a_file_or_below_one_cannot_be_held(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("")
    for path, words in ((tmp_path / "a", "expected a folder, got a file"), (tmp_path / "a" / "b", "a is not a folder")):
        with pytest.raises(InvalidFile, match=words), exclusive_lock(path):
            pass
