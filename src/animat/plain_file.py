"""Reading plain files of a bounded size, so that no device, pipe or false size blocks or fills the memory."""

from __future__ import annotations

import errno
import os
import tomllib
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile, as_invalid_file


def expect_plain_file(path: str | os.PathLike[str], most_bytes: int | None = None) -> Path:
    """Refuse what cannot be read to its end: a folder, a device, a pipe, a missing or too large file (InvalidFile)."""
    if not os.fspath(path):
        raise InvalidFile("expected the name of a file, got an empty name")
    path = Path(path)
    try:
        size = path.stat().st_size
        kind = "a folder" if path.is_dir() else None if path.is_file() else "a device or a pipe"
    except FileNotFoundError as error:
        raise InvalidFile(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        # A name too long for the system is an OSError, one with a zero byte a ValueError.
        reason = error.strerror if isinstance(error, OSError) else error
        raise InvalidFile(f"{str(path)[:200]!r}: cannot be read: {reason}") from error
    if kind is not None:
        raise InvalidFile(f"{path}: expected a file, got {kind}")
    if most_bytes is not None and size > most_bytes:
        raise InvalidFile(f"{path}: expected at most {most_bytes:,} bytes, got {size:,}")
    if not os.access(path, os.R_OK):
        # Checked here, as some readers would report the file as damaged or missing.
        raise InvalidFile(f"{path}: cannot be read: {os.strerror(errno.EACCES)}")
    return path


def expect_no_file(folder: Path, what: str) -> None:
    """Raise InvalidFile if the folder for something is a file."""
    if folder.exists() and not folder.is_dir():
        raise InvalidFile(f"{folder}: expected a folder for {what}, got a file; choose another --out")


def is_folder(path: Path) -> bool:
    """Whether a folder exists; False, without an error, for an impossible name."""
    return os.path.isdir(path)  # noqa: PTH112


def is_absent(path: Path) -> bool:
    """Whether no file or folder has this name; False, without an error, for a name that the system refuses."""
    # `Path.exists` would also be False for such a name since Python 3.14.
    try:
        path.stat()
    except (OSError, ValueError) as error:
        return getattr(error, "errno", None) in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP)
    return False


def read_plain_text(path: str | os.PathLike[str], most_bytes: int) -> str:
    """The text of a file in UTF-8; raises InvalidFile if it is not a text file or too large."""
    path = expect_plain_file(path)
    with as_invalid_file(path), path.open("rb") as file:
        # Files that the system generates on reading have no size before.
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise InvalidFile(f"{path}: expected a text file of at most {most_bytes:,} bytes, got a larger file")
    try:
        # Windows editors and spreadsheets begin UTF-8 files with a byte order mark.
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InvalidFile(f"{path}: expected text in UTF-8, got something else ({error.reason})") from error


def read_toml(path: str | os.PathLike[str], most_bytes: int) -> dict[str, Any]:
    """A TOML file as plain data; raises InvalidFile if it cannot be read or is not TOML."""
    text = read_plain_text(path, most_bytes)
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise InvalidFile(f"{path}: expected TOML, got lists or tables nested too deeply") from error
    except ValueError as error:
        # Also for a number with more digits than Python reads.
        reason = str(error).partition(";")[0]
        raise InvalidFile(f"{path}: expected TOML, got malformed text: {reason}") from error
