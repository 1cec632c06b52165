"""Conditions: hand-made stimulus tables, and the text form that reads back as itself."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.errors import InvalidArgument
from animat.responses.conditions import (
    All,
    ByElectrode,
    ByFrequency,
    ByInterval,
    ByPattern,
    Conditions,
    conditions_named,
    default_conditions,
)
from animat.stimulation.stimulus import Stimuli


def stimuli(
    time_s: list[float],
    frequency_hz: list[float] | None = None,
    pattern: list[int] | None = None,
    electrodes: list[list[int]] | None = None,
) -> Stimuli:
    n = len(time_s)
    return Stimuli(
        np.array(time_s),
        np.full(n, np.nan) if frequency_hz is None else np.array(frequency_hz),
        np.full(n, -1) if pattern is None else np.array(pattern),
        np.full((n, 1), -1) if electrodes is None else np.array(electrodes),
        np.arange(n),
    )


def assigned(by: Conditions, table: Stimuli) -> tuple[list[int], list[str]]:
    assignment = by.assign(table)
    return assignment.condition.tolist(), [condition.label for condition in assignment.conditions]


def test_frequencies_rise_and_unknown_ones_have_no_condition() -> None:
    table = stimuli([0, 1, 2, 3], frequency_hz=[20, 5, np.nan, 20])
    assert assigned(ByFrequency(), table) == ([1, 0, -1, 1], ["5 Hz", "20 Hz"])
    assert assigned(ByFrequency((20, 80)), table) == ([0, -1, -1, 0], ["20 Hz", "80 Hz"])
    assert ByFrequency().assign(table).conditions[1].value == 20
    assert ByFrequency().assign(table).conditions[1].unit == "Hz"


def test_a_frequency_survives_single_precision() -> None:
    table = stimuli([0], frequency_hz=[float(np.float32(12.3))])
    assert assigned(ByFrequency((12.3,)), table) == ([0], ["12.3 Hz"])


def test_frequencies_computed_from_intervals_are_one_condition() -> None:
    time_s = 3 + np.cumsum(np.repeat([0.05, 0.2], 100))
    frequency_hz = 1 / np.diff(time_s, append=time_s[-1] + 0.2)
    assert len(np.unique(frequency_hz)) > 2
    index, labels = assigned(ByFrequency(), stimuli(time_s.tolist(), frequency_hz.tolist()))
    assert labels == ["5 Hz", "20 Hz"]
    assert index == [1] * 99 + [0] * 101
    later = stimuli((time_s + 1000).tolist(), (1 / np.diff(time_s + 1000, append=time_s[-1] + 1000.2)).tolist())
    assert ByFrequency().assign(later).conditions == ByFrequency().assign(stimuli([0, 1], [5.0, 20.0])).conditions
    # So they are in other conditions, which present them equally often.
    (every,) = All().assign(later).conditions
    assert every.frequencies_hz == (5.0, 20.0)


def test_the_interval_is_the_one_before() -> None:
    # Gaps 0.2 s (5 Hz), 0.1 s (10 Hz), 1 s (neither); the first pulse has none.
    assert assigned(ByInterval((5, 10)), stimuli([0, 0.2, 0.3, 1.3])) == ([-1, 0, 1, -1], ["5 Hz", "10 Hz"])


def test_the_tolerance_is_a_ratio() -> None:
    rates_hz = np.array([3.99, 4.01, 6.24, 6.26])
    table = stimuli(np.concatenate([[0], np.cumsum(1 / rates_hz)]).tolist())
    assert assigned(ByInterval((5,)), table)[0] == [-1, -1, 0, 0, -1]


def test_the_nearer_frequency_wins_where_two_reach() -> None:
    rates_hz = np.array([5.4, 5.6])  # the geometric mean of 5 and 6 is 5.48
    table = stimuli(np.concatenate([[0], np.cumsum(1 / rates_hz)]).tolist())
    assert assigned(ByInterval((5, 6)), table)[0] == [-1, 0, 1]


@pytest.mark.parametrize("percent", [10, 20, 25, 50])
@pytest.mark.parametrize("frequency_hz", [0.2, 5.0, 7.0, 40.0])
def test_intervals_on_the_edge_are_within_however_they_are_rounded(percent: int, frequency_hz: float) -> None:
    for ratio in (1 + percent / 100, 1 / (1 + percent / 100)):
        times_s = 0.1 + np.arange(126) * ratio / frequency_hz
        index = conditions_named(f"interval:{frequency_hz}+-{percent}%").assign(stimuli(times_s)).condition
        assert np.count_nonzero(index == 0) == 125
        beyond = 0.1 + np.arange(126) * (ratio + np.copysign(1e-4, ratio - 1)) / frequency_hz
        assert not np.any(ByInterval((frequency_hz,), percent / 100).assign(stimuli(beyond)).condition == 0)


def test_simultaneous_pulses_and_empty_tables_have_no_interval() -> None:
    assert assigned(ByInterval((5,)), stimuli([1.0, 1.0]))[0] == [-1, -1]
    assert assigned(ByInterval((5,)), stimuli([]))[0] == []
    assert assigned(ByElectrode(), stimuli([]))[0] == []


def test_electrodes_are_a_set() -> None:
    table = stimuli([0, 1, 2, 3], electrodes=[[7, 3], [3, 7], [3, -1], [-1, -1]])
    assert assigned(ByElectrode(), table) == ([1, 1, 0, -1], ["electrode 3", "electrodes 3+7"])
    assert assigned(ByElectrode(((7, 3),)), table) == ([0, 0, -1, -1], ["electrodes 3+7"])


def test_patterns_and_all() -> None:
    table = stimuli([0, 1, 2], pattern=[4, -1, 2])
    assert assigned(ByPattern(), table) == ([1, -1, 0], ["pattern 2", "pattern 4"])
    assert assigned(ByPattern((4,)), table) == ([0, -1, -1], ["pattern 4"])
    assert assigned(All(), table) == ([0, 0, 0], ["all"])


def test_the_default_is_by_frequency_where_it_is_known() -> None:
    assert default_conditions(stimuli([0, 1], frequency_hz=[np.nan, 5])) == ByFrequency()
    assert default_conditions(stimuli([0, 1])) == All()


positive = st.floats(0.01, 1e4, allow_nan=False)
# Frequencies that differ by rounding only are the same.
several = (
    st.lists(positive, min_size=1, max_size=4)
    .filter(lambda values_hz: all(high > 1.00001 * low for low, high in pairwise(sorted(values_hz))))
    .map(tuple)
)
electrode_sets = st.lists(
    st.lists(st.integers(0, 30_000), min_size=1, max_size=3, unique=True).map(lambda s: tuple(sorted(s))),
    max_size=3,
    unique=True,
).map(tuple)
rules = st.one_of(
    st.just(All()),
    st.builds(ByFrequency, st.one_of(st.just(()), several)),
    st.builds(ByInterval, several, st.integers(1, 400).map(lambda percent: percent / 100)),
    st.builds(ByElectrode, electrode_sets),
    st.builds(ByPattern, st.lists(st.integers(0, 99), max_size=4, unique=True).map(tuple)),
)


@given(rules)
def test_the_text_form_reads_back(rule: Conditions) -> None:
    again = conditions_named(str(rule))
    assert str(again) == str(rule)
    if not isinstance(rule, ByInterval):
        assert again == rule
    else:
        assert isinstance(again, ByInterval) and again.tolerance == pytest.approx(rule.tolerance)


def test_the_tolerance_can_be_typed_or_left_out() -> None:
    assert conditions_named("interval:5,10") == ByInterval((5, 10), 0.25)
    assert conditions_named(" interval: 5, 10 +- 10 %") == ByInterval((5, 10), 0.1)
    assert conditions_named("interval:5±10%") == ByInterval((5,), 0.1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected one of all, frequency"),
        ("speed", "expected one of all, frequency"),
        ("all:1", "expected one of all, frequency"),
        ("frequency:5,x", "expected numbers"),
        ("frequency:-5", "conditions: frequency: expected positive frequencies in Hz, got -5"),
        ("frequency:5,5", "expected each frequency once"),
        ("frequency:5,10,5.000001", "expected each frequency once, got 5,10,5.000001"),
        ("interval:5,5.000001", "expected each frequency once"),
        ("frequency:nan", "expected positive"),
        ("frequency:inf", "expected positive"),
        ("interval", "expected at least one frequency"),
        ("interval:0", "expected positive"),
        ("interval:5+-25", "expected one tolerance in per cent"),
        ("interval:5+-5,6%", "expected one tolerance in per cent"),
        ("interval:5+-%", "tolerance"),
        ("interval:5+-0%", "expected a tolerance above 0 %"),
        ("electrode:1+b", "expected whole numbers"),
        ("electrode:1,,2", "expected numbers of electrodes from 0 on, joined by +; got an empty set"),
        ("electrode:-1+2", "expected numbers of electrodes from 0 on"),
        ("electrode:-1", "joined by +; got -1"),
        ("electrode:1+2,2+1", "expected each set of electrodes once"),
        ("pattern:1.5", "expected whole numbers"),
        ("pattern:3,3", "each once"),
        ("pattern:-1", "expected numbers from 0 on"),
        (" x ".join(["frequency"] * 5_000), "expected frequency or interval before x"),
        ("pattern:99999999999999999999", "expected whole numbers of electrodes or patterns"),
        ("electrode:1+99999999999999999999", "expected whole numbers of electrodes or patterns"),
    ],
)
def test_what_cannot_be_read_says_what_was_expected(text: str, said: str) -> None:
    with pytest.raises(InvalidArgument) as error:
        conditions_named(text)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
