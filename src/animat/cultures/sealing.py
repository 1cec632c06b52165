"""What a subclass may not put in the place of its base class's own."""

from __future__ import annotations

from collections.abc import Collection
from inspect import getattr_static
from types import FunctionType

_BEFORE_ALL = ("__getattribute__", "__setattr__", "__delattr__", "__copy__", "__deepcopy__")
"""They are called before whatever the base class has, or in its place."""


def refuse_overrides(cls: type, base: type, *, leaving: Collection[str]) -> None:
    """Refuse a subclass in which anything but abstract methods of the base class is replaced, private or not.

    Args:
        cls: the subclass; wherever it has a name from, what stands before `base` among its bases counts.
        base: whose methods and properties are called.
        leaving: names that may be replaced though they are not abstract.

    Raises:
        TypeError: naming the first one.
    """
    own = {
        name: member
        for kind in reversed(base.__mro__)
        for name, member in vars(kind).items()
        if kind.__module__.startswith(f"{__package__}.")
        and isinstance(member, FunctionType | property | classmethod)
        and not getattr(member, "__isabstractmethod__", False)
        and name not in leaving
    } | {name: getattr_static(base, name, None) for name in _BEFORE_ALL}
    for name, member in own.items():
        if getattr_static(cls, name, None) is not member:
            raise TypeError(
                f"{cls.__name__}.{name}: final in {base.__name__}; implement the methods that its description names"
            )
