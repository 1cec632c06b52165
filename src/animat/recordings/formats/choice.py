"""One of several: taken as asked for, or because there is only one; never guessed."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from animat.errors import InvalidFile

LISTED = 8


def choose(
    what: str, option: str, names: Iterable[str], asked: str | None, words: Callable[[str], str] = lambda name: name
) -> str:
    """The name asked for, or the only one.

    Args:
        what: what is chosen and where, such as `rig.h5: part`.
        option: how the user names it, such as `--part`.
        names: what there is, at least one.
        asked: the name asked for, if one was.
        words: what to list of each name.

    Raises:
        InvalidFile: naming what there is, if the name is not among them, or none is asked for and there are several.
    """
    there = list(names)
    listed = ", ".join(words(name)[:80] for name in there[:LISTED]) + (", ..." if len(there) > LISTED else "")
    if asked is not None:
        if asked in there:
            return asked
        raise InvalidFile(f"{what}: expected one of {listed}; got {asked}")
    if len(there) == 1:
        return there[0]
    raise InvalidFile(f"{what}: expected one, found {len(there)}: {listed}; choose with {option} NAME")
