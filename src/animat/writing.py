"""Files that are complete or absent, written under a temporary name and renamed; folders used by one run at a time."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from animat.errors import InvalidFile, Mismatch, as_invalid_file

UNCHANGED = "; any previous file is unchanged"
LOCK = ".lock"
"""The file that is locked if a folder cannot be."""

_UNFINISHED = re.compile(r"\..+\.[a-z0-9_]{8}\.partial(\.[^.]*)?")


@contextmanager
def atomic_write(path: str | os.PathLike[str], *, replaces: bool = True) -> Iterator[Path]:
    """Yield a temporary path next to `path`; on success rename it to `path`, on any error remove it.

    An existing file at `path` stays intact until the new one is complete and on disk, even if the disk fills up or the
    process is killed. Missing parent folders are created. Raises InvalidFile if the file cannot be written or, unless
    it `replaces` one, if there is a file at `path` by then.
    """
    path = Path(path)
    with as_invalid_file(path, "cannot be written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}.partial{path.suffix}"
        # Must be new: two processes may write the same file at the same time.
        temporary.touch(exist_ok=False)
    with as_invalid_file(path, "cannot be written", UNCHANGED):
        try:
            yield temporary
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
            if replaces:
                temporary.replace(path)
            else:
                _become_new(temporary, path)
            sync_folder(path.parent)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def _become_new(temporary: Path, path: Path) -> None:
    """Rename a file, unless there is one at `path` (FileExistsError)."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError as error:
        # Some file systems have no hard links.
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from error
        temporary.replace(path)
    else:
        temporary.unlink()


def write_whole(path: Path, content: str | bytes) -> Path:
    """Write a file with `atomic_write`; returns its path."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def expect_writable(folder: str | os.PathLike[str], option: str = "--out", room_bytes: float = 0) -> None:
    """Refuse a folder, which may be missing, that could not be written to or has no `room_bytes` left, before any work.

    Nothing is left behind. `option` is the command-line option that chooses the folder.
    """
    existing = folder = Path(folder)
    try:
        while not existing.exists() and existing != existing.parent:
            if existing.is_symlink():
                missing = f"{existing} is a link to {existing.readlink()}, which is missing"
                raise InvalidFile(
                    f"{folder}: cannot be written: {missing}; mount or make it, or choose another {option}"
                )
            existing = existing.parent
        # Write to find out: permissions do not reveal a full disk or a read-only file system.
        with tempfile.TemporaryFile(dir=existing):
            free = shutil.disk_usage(existing).free
    except OSError as error:
        if folder.exists() and not folder.is_dir():
            raise InvalidFile(f"{folder}: expected a folder, got a file; choose another {option}") from error
        what = f"{existing} is not a folder" if existing.is_file() else (error.strerror or str(error))
        raise InvalidFile(f"{folder}: cannot be written: {what}; choose another {option}") from error
    if free < room_bytes:
        raise InvalidFile(
            f"{folder}: expected {room_bytes / 1e6:.2f} MB free for the output, got {free / 1e6:.2f} MB: make room, "
            f"or choose another {option}"
        )


@contextmanager
def exclusive_lock(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keep other runs out of a folder, created if missing, until the block or the process ends.

    The folder itself is locked, and nothing is left in it. On file systems that can only lock files (NFS) the file
    `LOCK` is locked, and it stays: removing it could remove one that another run has just locked. If nothing can be
    locked, as in a read-only folder, where nothing can change either, the block runs unlocked. Folders created here are
    removed again if the block fails and left them empty.

    Raises:
        Mismatch: if another run is using it.
        InvalidFile: if it cannot be created, is empty and cannot be written to, or was replaced or is gone at the end.
    """
    folder = Path(folder)
    # Its place, whatever folder the program goes on working in.
    place = folder.absolute()
    with locked(folder) as descriptor:
        yield
        if not _is_same(place, descriptor):
            elsewhere = "what was written to it before is lost, or where it was moved to"
            raise InvalidFile(f"{folder}: it was removed, moved or replaced during the run: {elsewhere}")


@contextmanager
def locked(folder: Path) -> Iterator[int]:
    """As `exclusive_lock`, but the folder may be gone at the end; yields its descriptor."""
    with as_invalid_file(folder, "cannot be created or read", "; choose another --out"):
        created = [each for each in (folder, *folder.parents) if not each.exists()]
        if not folder.is_dir() or not any(folder.iterdir()):
            # Only an empty folder must be writable: one with a finished run may be read-only.
            expect_writable(folder)
        folder.mkdir(parents=True, exist_ok=True)
        descriptors = [os.open(folder, os.O_RDONLY)]
    try:
        if take_lock(folder, descriptors[0]):
            _expect_same(folder, descriptors[0])
        else:
            with suppress(OSError):
                descriptors.append(os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666))
                take_lock(folder, descriptors[1])
        try:
            yield descriptors[0]
        except BaseException:
            # Not another run's in its place.
            with suppress(OSError, InvalidFile):
                for each in created if _is_same(folder, descriptors[0]) else ():
                    each.rmdir()
            raise
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def take_lock(folder: Path, descriptor: int) -> bool:
    """Lock an open folder or file while it is open; False if the file system cannot; Mismatch if it is taken."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise Mismatch(f"{folder}: another run is at work in this folder; wait for it, or stop it") from error
    except OSError:
        return False
    return True


def _expect_same(folder: Path, descriptor: int) -> None:
    """Raise if a failed run removed the folder after it was opened and before it was locked."""
    if not _is_same(folder, descriptor):
        raise Mismatch(f"{folder}: another run was at work in this folder, and removed it; start again")


def _is_same(folder: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), folder.stat())
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise InvalidFile(f"{folder}: cannot be read: {error.strerror or error}") from error


def clear_away(leftover: Path) -> None:
    """Remove a file that a killed run left, if possible: in a read-only folder it does no harm."""
    with suppress(OSError):
        leftover.unlink()


def clear_leftovers(folder: Path, *names: str) -> None:
    """Remove what killed runs left in a folder of files with these names, which may be patterns."""
    for name in names:
        for leftover in folder.glob(f".{name}.*.partial*"):
            clear_away(leftover)


def is_unfinished(path: Path) -> bool:
    """Whether a file's name is one that `atomic_write` uses while writing; a killed process may leave such a file."""
    return _UNFINISHED.fullmatch(path.name) is not None


def sync_folder(folder: Path) -> None:
    """Put a folder's names on disk too: otherwise a file renamed just before a power cut may be the old one."""
    # Some file systems cannot sync a folder on request.
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
