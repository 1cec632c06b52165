"""NWB files whose bytes follow from what was recorded, so that a study made twice is the same files."""

from __future__ import annotations

import hashlib
import io
import os
import uuid
from pathlib import Path

import h5py

from animat.errors import InvalidFile
from animat.writing import written_whole

_NAMESPACE = uuid.UUID("6c0f0c52-5d5e-4f5b-9c39-5f8e4c5f0a11")


def settle_identity(path: str | os.PathLike[str]) -> None:
    """Put identifiers that follow from the contents in place of an NWB file's random ones, and its date of making.

    NWB gives a file and each object in it a random identifier, and the moment at which it was written, so the same
    recording is never the same file twice. Identifiers are replaced by ones of the same length that are drawn from a
    hash over all else; the date of making becomes the first moment of 1970, which every reader sees to be none. Doing
    it again changes nothing.

    Raises:
        InvalidFile: if the file cannot be read or written.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
        random, dates = _random_words(data)
    except (OSError, KeyError, ValueError) as error:
        raise InvalidFile(f"{path}: expected a recording written by animat, got {error}") from error
    for old in dates:
        data = data.replace(old, _no_date(len(old)))
    blank = data
    for i, old in enumerate(random):
        blank = blank.replace(old, b"%036d" % i)
    digest = hashlib.sha256(blank).hexdigest()
    settled = blank
    for i in range(len(random)):
        settled = settled.replace(b"%036d" % i, str(uuid.uuid5(_NAMESPACE, f"{digest} {i}")).encode())
    if settled != path.read_bytes():
        with written_whole(path) as beside:
            beside.write_bytes(settled)


def _random_words(data: bytes) -> tuple[list[bytes], list[bytes]]:
    """The file's identifiers in the order of their objects' names, and its dates of making."""
    with h5py.File(io.BytesIO(data), "r") as file:
        words = {"": file["identifier"][()], "/": file.attrs.get("object_id", b"")}

        def collect(name: str, thing: h5py.HLObject) -> None:
            if "object_id" in thing.attrs:
                words[f"/{name}"] = thing.attrs["object_id"]

        file.visititems(collect)
        dates = list(file["file_create_date"][:])
    encoded = [_bytes(words[name]) for name in sorted(words)]
    return [word for word in encoded if len(word) == 36], [_bytes(date) for date in dates]


def _bytes(word: str | bytes) -> bytes:
    return word if isinstance(word, bytes) else word.encode()


def _no_date(length: int) -> bytes:
    whole = b"1970-01-01T00:00:00.000000+00:00"
    return whole if length == len(whole) else b"1970-01-01T00:00:00+00:00".ljust(length)[:length]
