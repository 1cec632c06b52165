"""Tables for a terminal."""

from __future__ import annotations

from animat.terminal_table import align_columns


def test_text_is_aligned_left_and_numbers_right_under_their_headings() -> None:
    assert align_columns(
        ["", "mean", "p", ""], [["policies", "96.0", "", ""], ["random", "-80.25", "0.001", "any action"]]
    ) == [
        "              mean      p",
        "  policies    96.0",
        "  random    -80.25  0.001  any action",
    ]


def test_a_table_without_rows_is_its_head() -> None:
    assert align_columns(["name", "mean", "meaning"], []) == ["  name  mean  meaning"]
