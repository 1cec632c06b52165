"""What a folder holds: the files that identify its kind, and where its description differs from what is requested."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal

from animat.errors import InvalidFile, Mismatch
from animat.plain_file import is_folder

FolderKind = Literal["session", "training", "tuning", "study", "cultures", "recording", "live"]

MARKERS: dict[FolderKind, tuple[str, ...]] = {
    "session": ("session.log",),
    "training": ("training.json", "[!.]*.safetensors"),
    "tuning": ("tune.json",),
    "study": ("study.json",),
    "cultures": ("cultures.json",),
    "recording": ("recording_*_min.nwb", "culture.state"),
    "live": ("live.log",),
}
"""Names or patterns, any one of which is enough. The modules that write these files import JAX; this one does not."""
RECORDINGS, POLICIES, SESSION = "recordings", "policies", "session"
"""The parts of a live run's folder."""
_DESCRIPTIONS: dict[FolderKind, str] = {
    "session": "a session",
    "training": "policies",
    "tuning": "a tuning",
    "study": "a study",
    "cultures": "a study of many cultures",
    "recording": "recordings",
    "live": "a live run",
}
_LONGEST = 60
"""Length of a value in a message."""
_NOTHING = object()
"""The value of a missing key."""


def expect_no_other(folder: Path, kind: FolderKind) -> None:
    """Raise Mismatch if a folder holds work of other kinds and none of this kind; a missing folder holds nothing."""
    if not is_folder(folder):
        return
    found = {each: [file.name for name in names for file in folder.glob(name)] for each, names in MARKERS.items()}
    others = ", ".join(f"{_DESCRIPTIONS[each]} ({min(names)})" for each, names in found.items() if names)
    # A folder that already has work of this kind is continued, whatever else is in it.
    if others and not found[kind]:
        wanted = _DESCRIPTIONS[kind]
        raise Mismatch(f"{folder}: expected a folder for {wanted}, got one with {others}; choose another folder")


def first_difference(
    found: Any, wanted: Any, name: str = "", *, ignoring: Collection[str] = (), first: Collection[str] = ()
) -> str:
    """The first difference between data in a folder and those requested: `training.seed: 1 there, 2 now`; else empty.

    `name` is that of both, for the beginning of the message; `ignoring` and `first` are keys that do not matter, and
    keys that come first, at any depth.
    """
    if isinstance(found, dict) and isinstance(wanted, dict):
        pairs = [
            (found.get(key, _NOTHING), wanted.get(key, _NOTHING), f"{name}.{key}" if name else str(key))
            for key in sorted(set(found) | set(wanted), key=lambda key: (key not in first, key))
            if key not in ignoring
        ]
    # Short lists of different lengths are shown as a whole.
    elif (
        isinstance(found, list)
        and isinstance(wanted, list)
        and (len(found) == len(wanted) or max(len(repr(found)), len(repr(wanted))) > _LONGEST)
    ):
        # Compare the entries that both lists have, then their lengths.
        pairs = [(one, other, f"{name}[{i}]") for i, (one, other) in enumerate(zip(found, wanted, strict=False))]
        pairs += [(len(found), len(wanted), f"{name}, how many")]
    else:
        # 1 and 1.0 are equal, but written differently, as fingerprints notice.
        is_same = found == wanted and type(found) is type(wanted)
        return "" if is_same else f"{name}: {_short(found)} there, {_short(wanted)} now"
    keys: dict[str, Any] = {"ignoring": ignoring, "first": first}
    return next(filter(None, (first_difference(*pair, **keys) for pair in pairs)), "")


def with_fingerprint(description: dict[str, Any], *more: bytes) -> dict[str, Any]:
    """Plain data, by way of JSON, which has no tuples, with a fingerprint: SHA-256 over all of it and further bytes."""
    data: dict[str, Any] = json.loads(json.dumps(description))
    digest = hashlib.sha256(json.dumps(data, sort_keys=True).encode())
    for part in more:
        digest.update(part)
    return data | {"fingerprint": digest.hexdigest()}


def read_description(path: Path, what: str) -> dict[str, Any] | None:
    """Read the JSON description, with a fingerprint, of a folder that holds `what`; None if there is no such file."""
    if not path.exists():
        return None
    try:
        description: dict[str, Any] = json.loads(path.read_text())
        _ = description["fingerprint"]
    except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise InvalidFile(f"{path}: expected a {what}'s description, got a file that cannot be read") from error
    return description


def folder_mismatch(folder: Path, what: str, difference: str) -> Mismatch:
    """The error for a folder that holds a different study or training from the one requested."""
    return Mismatch(
        f"{folder}: expected a folder of this {what}, got one of another ({difference}); give another folder, or "
        "remove this one"
    )


def _short(value: Any) -> str:
    text = "nothing" if value is _NOTHING else repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
