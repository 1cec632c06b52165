"""Files that are complete or absent, written beside their place and renamed into it; folders for one run at a time."""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from animat.errors import InvalidFile, Mismatch

_UNFINISHED = re.compile(r"\..+\.[a-z0-9_]{8}\.partial(\.[^.]*)?")


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
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
        keep_name(path.parent)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InvalidFile(
            f"{path}: cannot be written: {error.strerror or error}; what stood there before is unchanged"
        ) from error
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


@contextmanager
def alone_in(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keep other runs out of a folder, made where it is missing, until the block ends or the process does.

    Raises:
        Mismatch: if another run is at work in it.
        InvalidFile: if it cannot be made.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise InvalidFile(f"{folder}: cannot be made or read: {error.strerror or error}") from error
    try:
        # The folder itself is locked: nothing is left in it, and one that cannot be written to can be held as well.
        # File systems that cannot lock folders (NFS) leave it to the user.
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise Mismatch(f"{folder}: another run is at work in this folder; wait for it, or stop it") from error
        except OSError:
            pass
        yield
    finally:
        os.close(descriptor)


def is_unfinished(path: Path) -> bool:
    """Whether a file's name is one that `written_whole` gives to what it is just writing, or was when it was killed."""
    return _UNFINISHED.fullmatch(path.name) is not None


def keep_name(folder: Path) -> None:
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
