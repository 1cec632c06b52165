"""How records that hold arrays are printed: an array by its type and shape, a long list by its length."""

from __future__ import annotations

from dataclasses import fields
from typing import Any


def briefly(record: Any) -> str:
    """A dataclass in a line or a few, to be its `__repr__`."""
    shown = (f"{field.name}={_brief(getattr(record, field.name))}" for field in fields(record) if field.repr)
    return f"{type(record).__name__}({', '.join(shown)})"


def _brief(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple | list | dict) and len(value) > 6:
        return f"<{len(value)} values>"
    text = repr(value)
    return text if len(text) <= 200 else f"<{type(value).__name__}>"
