"""One culture object for one device, whatever programs there are on the machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from animat.errors import DeviceFailed, InvalidFile, Mismatch
from animat.writing import exclusive_lock

MACHINE = Path("/tmp")
"""Where devices that all programs on this machine share are held; not what `TMPDIR` says, which differs by user."""
_LAST = "held_last_by"


def of_the_machine(device: str) -> Path:
    """The folder that stands for a device of which the machine has one."""
    return MACHINE / f"animat-{device}"


def of_the_program(device: str) -> Path:
    """The folder that stands for a simulated device of which each program has its own; gone when the program ends."""
    return Path(_own_folder().name) / device


@contextmanager
def held(device: Path, holder: str) -> Iterator[bool]:
    """Keep all others from a device until the block ends or the process does; yields whether another one had it last.

    Args:
        device: the folder that stands for it.
        holder: a name that nobody else has.

    Raises:
        DeviceFailed: if another one holds it, or the folder cannot be used.
    """
    with ExitStack() as stack:
        try:
            if device.is_symlink():
                # In a folder that all can write to, another user could point it at one of ours.
                raise DeviceFailed(f"{device.name}: expected a folder to hold it by, got the link {device}: remove it")
            stack.enter_context(exclusive_lock(device))
            if device.stat().st_uid == os.geteuid():
                # Other users of the machine may hold it later; they can remove nothing of ours.
                device.chmod(0o1777)
        except (InvalidFile, OSError) as error:
            raise DeviceFailed(
                f"{device.name}: expected a folder to hold it by that every user can write to, got {device}: "
                f"{error.__cause__ or error}: remove it, or have its owner do so"
            ) from error
        except Mismatch as error:
            raise DeviceFailed(
                f"{device.name}: expected a device that nobody uses, got one that another culture object holds, in "
                "this program or another: close it there first"
            ) from error
        yield _last(device, holder) != holder


def _last(device: Path, holder: str) -> str:
    """Who held it last, which is `holder` from now on, and was where nobody did."""
    note = device / _LAST
    try:
        with suppress(FileExistsError):
            # Apart from writing: some systems let no one create a file that another user has there already.
            os.close(os.open(note, os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
            note.write_text(holder)
        # Whatever another user put there, nothing is written behind a link.
        with os.fdopen(os.open(note, os.O_RDWR | os.O_NOFOLLOW), "r+") as file:
            before = file.read()
            if os.fstat(file.fileno()).st_uid == os.geteuid():
                os.fchmod(file.fileno(), 0o666)
            file.seek(0)
            file.truncate()
            file.write(holder)
        return before
    except OSError as error:
        raise DeviceFailed(f"{device.name}: expected to note who holds it in {note}, got {error.strerror}") from error


@cache
def _own_folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="animat-")
