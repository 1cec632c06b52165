"""Names of former versions in a session's log, as they are called now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_LOOP = {"lead_in": "warm_up", "following": "adaptive"}
_HANDLED = {"lead-in": "warm-up"}


def in_todays_words(words: dict[str, Any]) -> dict[str, Any]:
    """A record's words by the names of today; those that need not be renamed are left as they are."""
    if isinstance(loop := words.get("loop"), dict):
        words["loop"] = _renamed(loop, _LOOP)
    if isinstance(tick := words.get("tick"), dict) and tick.get("handled") in tuple(_HANDLED):
        tick["handled"] = _HANDLED[tick["handled"]]
    return words


def _renamed(words: dict[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    return {names.get(name, name): value for name, value in words.items()}
