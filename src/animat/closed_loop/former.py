"""Names of former versions in a session's log, as they are called now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_RECORD = {"contenders": "agents", "sentence": "message"}
_LOOP = {"lead_in": "warm_up", "following": "adaptive"}
_TICK = {"contender": "agent"}
_HANDLED = {"lead-in": "warm-up"}


def in_todays_words(words: dict[str, Any]) -> dict[str, Any]:
    """A record's words by the names of today."""
    words = _renamed(words, _RECORD)
    if isinstance(loop := words.get("loop"), dict):
        words["loop"] = _renamed(loop, _LOOP)
    if isinstance(tick := words.get("tick"), dict):
        words["tick"] = tick = _renamed(tick, _TICK)
        if isinstance(handled := tick.get("handled"), str):
            tick["handled"] = _HANDLED.get(handled, handled)
    return words


def _renamed(words: dict[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    if names.keys().isdisjoint(words):
        return words
    return {names.get(name, name): value for name, value in words.items()}
