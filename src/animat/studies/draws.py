"""Seeds of a study: everything that is drawn has one of its own, all decided by the study's."""

from __future__ import annotations

import hashlib


def draw_seed(*names: object) -> int:
    """A seed from the names of what is drawn, so that no two arms share their luck."""
    return int.from_bytes(hashlib.sha256(repr(names).encode()).digest()[:4], "big") >> 1
