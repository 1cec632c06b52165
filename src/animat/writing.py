"""Files that are complete or absent, written beside their place and renamed into it; folders for one run at a time."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from animat.errors import InvalidFile, Mismatch

UNCHANGED = "; what stood there before is unchanged"
LOCK = ".lock"
"""A file that is locked where a folder cannot be."""

_UNFINISHED = re.compile(r"\..+\.[a-z0-9_]{8}\.partial(\.[^.]*)?")


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success rename it to `path`, on any error remove it.

    Whatever stood at `path` stays whole until the new file is complete and on disk, also when the disk fills up or
    the process is killed. Missing parent folders are made.

    Raises:
        InvalidFile: if the file cannot be written (no permission, a full disk); the old file is untouched.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=f".partial{path.suffix}")
    except OSError as error:
        raise InvalidFile(f"{path}: cannot be written: {error.strerror or error}") from error
    os.close(handle)
    beside = Path(name)
    try:
        yield beside
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        beside.chmod(0o666 & ~_umask())
        beside.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InvalidFile(f"{path}: cannot be written: {error.strerror or error}{UNCHANGED}") from error
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def write_whole(path: Path, content: str | bytes) -> Path:
    """Write a file, complete or absent, as `atomic_write`; returns its path."""
    with atomic_write(path) as beside:
        beside.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def expect_writable(folder: str | os.PathLike[str], option: str = "--out", room_bytes: float = 0) -> None:
    """Refuse a folder that could not be written to, or not be made, before any work; nothing is left of the trial.

    Args:
        folder: it may be missing.
        option: of the command line, by which another can be chosen.
        room_bytes: that must be free.

    Raises:
        InvalidFile: naming the folder, and what stands in its way.
    """
    there = folder = Path(folder)
    try:
        while not there.exists() and there != there.parent:
            there = there.parent
        # Asking for permissions would not tell a full disk or a file system that is read only.
        with tempfile.TemporaryFile(dir=there):
            free = shutil.disk_usage(there).free
    except OSError as error:
        what = f"{there} is no folder" if there.is_file() else (error.strerror or str(error))
        raise InvalidFile(f"{folder}: cannot be written: {what}; choose another {option}") from error
    if free < room_bytes:
        raise InvalidFile(
            f"{folder}: expected {room_bytes / 1e6:.2f} MB free for what is to be written, got {free / 1e6:.2f} MB: "
            f"make room, or choose another {option}"
        )


@contextmanager
def exclusive_lock(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keep other runs out of a folder, made where it is missing, until the block ends or the process does.

    The folder itself is locked, and nothing is left in it. File systems that lock files only (NFS) get a file to lock,
    `LOCK`, which stays: whoever removed it could remove one that another run has just locked. Where nothing can be
    locked at all, as in a folder that cannot be written to, in which nothing can change, the block runs unlocked. What
    it made of the folder is removed again if the block fails with nothing in it.

    Raises:
        Mismatch: if another run is at work in it.
        InvalidFile: if it cannot be made, or is empty and cannot be written to.
    """
    folder = Path(folder)
    try:
        made = [each for each in (folder, *folder.parents) if not each.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        if not any(folder.iterdir()):
            # One that holds a finished run may be read only; in a new one nothing could be done.
            expect_writable(folder)
        descriptors = [os.open(folder, os.O_RDONLY)]
    except OSError as error:
        what = "it is no folder" if folder.exists() and not folder.is_dir() else error.strerror or error
        raise InvalidFile(f"{folder}: cannot be made or read: {what}; choose another --out") from error
    try:
        if _is_locked(folder, descriptors[0]):
            _expect_same(folder, descriptors[0])
        else:
            with suppress(OSError):
                descriptors.append(os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666))
                _is_locked(folder, descriptors[1])
        try:
            yield
        except BaseException:
            with suppress(OSError):
                for each in made:
                    each.rmdir()
            raise
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def _is_locked(folder: Path, descriptor: int) -> bool:
    """Lock what is open, for as long as it is; False where the file system cannot.

    Raises:
        Mismatch: if it is locked already.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise Mismatch(f"{folder}: another run is at work in this folder; wait for it, or stop it") from error
    except OSError:
        return False
    return True


def _expect_same(folder: Path, descriptor: int) -> None:
    """Raise if the folder was removed, by a run that failed, between its being opened and locked."""
    with suppress(FileNotFoundError):
        if os.path.samestat(os.fstat(descriptor), folder.stat()):
            return
    raise Mismatch(f"{folder}: another run was at work in this folder, and removed it; start again")


def clear_away(leftover: Path) -> None:
    """Remove a file that a killed run left, if it can be: in a read-only folder it does no harm."""
    with suppress(OSError):
        leftover.unlink()


def is_unfinished(path: Path) -> bool:
    """Whether a file's name is one that `atomic_write` gives to what it is just writing, or was when it was killed."""
    return _UNFINISHED.fullmatch(path.name) is not None


def sync_folder(folder: Path) -> None:
    """Put a folder's new name on disk too: without it a file renamed just before a power cut may be the old one."""
    # Some file systems cannot, and then do it in their own time.
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _umask() -> int:
    # The only way to read the umask is to set it; mkstemp ignores it and makes files private.
    mask = os.umask(0)
    os.umask(mask)
    return mask
