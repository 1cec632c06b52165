"""Differences: the first place is named, and nothing where there is none."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.folders import first_difference, with_fingerprint

plain = st.recursive(
    st.none() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("abc", min_size=1, max_size=2), inner),
    max_leaves=8,
)


@pytest.mark.parametrize(
    ("found", "wanted", "said"),
    [
        (1, 1, ""),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, "a.b[1]: 2 there, 3 now"),
        ({"a": [1]}, {"a": [1, 2]}, "a: [1] there, [1, 2] now"),
        ({"b": 1}, {"a": 2, "b": 1}, "a: nothing there, 2 now"),
        ({"a": 1, "b": 1}, {"a": 2, "b": 2}, "a: 1 there, 2 now"),
        ({"a": "x" * 99}, {"a": "y"}, f"a: '{'x' * 56}... there, 'y' now"),
        ({"a": ["x" * 60, 1]}, {"a": ["x" * 60, 2, 3]}, "a[1]: 1 there, 2 now"),
        ({"a": ["x" * 60, 1]}, {"a": ["x" * 60, 1, 3]}, "a, how many: 2 there, 3 now"),
        ({"a": 1}, {"a": 1.0}, "a: 1 there, 1.0 now"),
        ({"a": {"id": 1}, "b": 1}, {"a": {"id": 2}, "b": 2}, "b: 1 there, 2 now"),
    ],
)
def test_the_first_place_is_named(found: Any, wanted: Any, said: str) -> None:
    assert first_difference(found, wanted, ignoring=("id",)) == said


@given(plain, plain)
def test_there_is_one_where_two_differ_and_none_where_they_are_the_same(one: Any, other: Any) -> None:
    assert first_difference(one, copy.deepcopy(one), "it") == ""
    said = first_difference(one, other, "it")
    assert bool(said) == (one != other)
    assert not said or (said.startswith("it") and said.endswith(" now"))


def test_a_fingerprint_depends_on_what_is_described_and_not_on_its_order() -> None:
    described = with_fingerprint({"b": {"c": 1, "d": 2}, "a": (3,)}, b"x")
    assert described == with_fingerprint({"a": [3], "b": {"d": 2, "c": 1}}, b"x")
    others = [({"a": [3], "b": {"c": 1, "d": 3}}, b"x"), ({"a": [3], "b": {"c": 1, "d": 2}}, b"y")]
    assert all(with_fingerprint(*other)["fingerprint"] != described["fingerprint"] for other in others)
