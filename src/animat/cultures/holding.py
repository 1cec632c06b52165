"""Exclusive use of a device: one culture object at a time among all programs on the machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from animat.errors import DeviceFailed, InvalidFile, Mismatch
from animat.writing import locked

MACHINE = Path("/tmp")
"""Holds the folders of devices that all programs on this machine share; not `TMPDIR`, which differs by user."""
_LAST = "held_last_by"


def of_the_machine(device: str) -> Path:
    """The folder that stands for a device of this machine, shared by all programs."""
    return MACHINE / f"animat-{device}"


def of_the_program(device: str) -> Path:
    """The folder that stands for a simulated device of this program alone; removed when the program ends."""
    return Path(_own_folder().name) / device


@contextmanager
def hold(device: Path, holder: str) -> Iterator[bool]:
    """Hold a device exclusively until the block or the process ends; yields whether another `holder` had it last."""
    with ExitStack() as stack:
        try:
            # Refused, as the parent is world-writable: another user could have made it a link to one of our folders.
            if device.is_symlink() or (device.exists() and not device.is_dir()):
                raise DeviceFailed(f"{device.name}: expected a folder as its lock, got another file: remove {device}")
            stack.enter_context(locked(device))
            if device.stat().st_uid == os.geteuid():
                # Other users of the machine may hold it later; they cannot remove our files.
                device.chmod(0o1777)
        except (InvalidFile, OSError) as error:
            got = f"{device}: {error.__cause__ or error}: remove it, or have its owner do so"
            raise DeviceFailed(f"{device.name}: expected a folder that every user can write to, got {got}") from error
        except Mismatch as error:
            held = "one that another culture object holds, in this program or another: close it there first"
            raise DeviceFailed(f"{device.name}: expected a device that is not in use, got {held}") from error
        yield _exchange_holder(device, holder) != holder


def _exchange_holder(device: Path, holder: str) -> str:
    """The last holder, or `holder` if there was none; records `holder` as the last."""
    note = device / _LAST
    try:
        with suppress(FileExistsError):
            # Separate from writing: some systems refuse O_CREAT on an existing file of another user.
            os.close(os.open(note, os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
            note.write_text(holder)
        # Another user may have put a link there: it is not followed.
        with os.fdopen(os.open(note, os.O_RDWR | os.O_NOFOLLOW), "r+") as file:
            before = file.read()
            if os.fstat(file.fileno()).st_uid == os.geteuid():
                os.fchmod(file.fileno(), 0o666)
            file.seek(0)
            file.truncate()
            file.write(holder)
        return before
    except OSError as error:
        raise DeviceFailed(f"{device.name}: expected to record its holder in {note}, got {error.strerror}") from error


@cache
def _own_folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="animat-")
