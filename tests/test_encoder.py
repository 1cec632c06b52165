"""From an action to a stimulus: described by the recording, dealt out as recorded, refused if it is not known."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.closed_loop.agents import Agent, AnyCondition, OneCondition
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.coding.encoder import Dealer, Encoder
from animat.coding.mapping import Thresholds
from animat.errors import InvalidArgument, Mismatch, UnusableData
from animat.recordings.reading import read_recording
from animat.responses.condition import Condition, stimulus_mismatch
from animat.responses.conditions import All, ByBoth, ByElectrode, ByFrequency, ByInterval, ByPattern, conditions_named
from animat.responses.extraction import extract_responses
from animat.robots import Navigation
from animat.stimulation.stimulus import Stimuli
from fake_culture import FakeCulture

PATTERNS = np.array([[1, 2, -1], [3, 4, 5], [6, 1, -1], [2, 5, 6]])
SETS = [(1, 2), (3, 4, 5), (1, 6), (2, 5, 6)]


def table(frequency_hz: list[float], electrodes: list[list[int]], presentation: list[int] | None = None) -> Stimuli:
    n = len(frequency_hz)
    pattern = [next((i for i, one in enumerate(SETS) if set(row) == set(one)), -1) for row in electrodes]
    padded = np.array([[*row, *[-1] * (3 - len(row))] for row in electrodes])
    given = np.arange(n) if presentation is None else np.array(presentation)
    return Stimuli(np.arange(n) / 10, np.array(frequency_hz), np.array(pattern), padded, given)


def description(conditions: tuple[Condition, ...]) -> list[tuple[object, ...]]:
    return [(c.label, c.frequencies_hz, c.electrodes, c.only_last) for c in conditions]


def test_a_condition_describes_its_stimuli_in_the_recording() -> None:
    stimuli = table([5, 10, 5, 5], [[2, 1], [1, 2], [3, 4, 5], [3, 5, 4]])
    assert description(ByPattern().assign(stimuli).conditions) == [
        ("pattern 0", (5.0, 10.0), ((1, 2),), False),
        ("pattern 1", (5.0,), ((3, 4, 5),), False),
    ]
    assert description(ByElectrode().assign(stimuli).conditions) == [
        ("electrodes 1+2", (5.0, 10.0), ((1, 2),), False),
        ("electrodes 3+4+5", (5.0,), ((3, 4, 5),), False),
    ]
    assert description(ByFrequency().assign(stimuli).conditions) == [
        ("5 Hz", (5.0,), None, False),
        ("10 Hz", (10.0,), None, False),
    ]
    assert description(ByInterval((10.0,)).assign(stimuli).conditions) == [("10 Hz", (10.0,), None, False)]
    # Where the frequency of some is not known, none is stated.
    some = table([5, np.nan, 10], [[2, 1], [1, 2], [3, 4, 5]])
    assert [each.frequencies_hz for each in ByPattern().assign(some).conditions] == [(), (10.0,)]
    assert description(All().assign(stimuli).conditions) == [("all", (5.0, 10.0), None, False)]


def test_what_the_recording_does_not_tell_is_not_known() -> None:
    stimuli = table([np.nan, np.nan], [[], [3, 4, 5]])
    stimuli = Stimuli(stimuli.time_s, stimuli.frequency_hz, np.array([7, 8]), stimuli.electrodes, np.arange(2))
    assert description(ByPattern().assign(stimuli).conditions) == [
        ("pattern 7", (), (), False),
        ("pattern 8", (), ((3, 4, 5),), False),
    ]


@pytest.mark.parametrize(("leading", "only_last"), [([3, 4, 5], False), ([1, 2], True)])
def test_the_last_pulse_alone_may_be_the_condition(leading: list[int], only_last: bool) -> None:
    stimuli = table([5, 5, 10], [leading, [3, 4, 5], [1, 2]], [0, 0, 1])
    of = {c.label: c for c in ByPattern().assign(stimuli).conditions}
    assert of["pattern 1"].only_last is only_last
    assert not of["pattern 0"].only_last
    assert of["pattern 0"].frequencies_hz == (10.0,)


def test_a_train_of_pulses_on_one_place_is_no_condition_of_the_last_alone() -> None:
    # The first pulse of a recording has no interval before it, and so no condition by interval.
    stimuli = table([np.nan] * 6, [[1, 2]] * 3 + [[3, 4, 5]] * 3, [0, 0, 0, 1, 1, 1])
    assigned = conditions_named("interval:10 x electrode").assign(stimuli)
    assert assigned.condition.tolist()[0] == -1
    assert [(c.electrodes, c.only_last) for c in assigned.conditions] == [(((1, 2),), False), (((3, 4, 5),), False)]


def test_products_are_the_combinations_that_occur() -> None:
    stimuli = table([5, 10, 5, 10, np.nan], [[1, 2], [1, 2], [3, 4, 5], [1, 2], [1, 2]])
    by = conditions_named("frequency x pattern")
    assert by == ByBoth(ByFrequency(), ByPattern())
    assigned = by.assign(stimuli)
    assert assigned.condition.tolist() == [0, 2, 1, 2, -1]
    assert description(assigned.conditions) == [
        ("5 Hz, pattern 0", (5.0,), ((1, 2),), False),
        ("5 Hz, pattern 1", (5.0,), ((3, 4, 5),), False),
        ("10 Hz, pattern 0", (10.0,), ((1, 2),), False),
    ]
    # Pulses 0.1 s apart, at no stated frequency: it follows from their intervals.
    (last,) = conditions_named("interval:10 x electrode:1+2").assign(stimuli).conditions
    assert description((last,)) == [("10 Hz, electrodes 1+2", (10.0,), ((1, 2),), False)]
    for text in ("frequency:5,80 x pattern:0,3", "interval:5,10+-25% x electrode:3,1+2"):
        assert str(conditions_named(text)) == text
    for text in ("pattern x frequency", "frequency x interval:5", "frequency x all", "frequency x "):
        with pytest.raises(InvalidArgument, match="conditions: expected"):
            conditions_named(text)


def test_older_conditions_are_equal_and_do_not_describe_their_stimuli() -> None:
    (known,) = ByPattern((1,)).assign(table([5], [[3, 4, 5]])).conditions
    before = Condition(label="pattern 1", value=1.0, unit="")
    assert before == known and stimulus_mismatch([before], [known]) is None
    assert Condition("5 Hz", 5.0, "Hz").frequencies_hz == (5.0,)
    (moved,) = ByElectrode(((1, 2),)).assign(table([5], [[1, 2]])).conditions
    other = Condition("pattern 1", 1.0, "", (5.0,), moved.electrodes)
    assert stimulus_mismatch([known], [other]) == (
        "expected pattern 1 at 5 Hz on the electrodes 3+4+5, got pattern 1 at 5 Hz on the electrodes 1+2"
    )


@pytest.mark.parametrize(
    ("one_hz", "other_hz", "is_other"),
    [((5.1,), (float(np.float32(5.1)),), False), ((10.0, 20.0), (5.0, 20.0), False), ((5.0,), (5.01,), True)],
)
def test_a_condition_met_at_other_frequencies_too_is_no_other(
    one_hz: tuple[float, ...], other_hz: tuple[float, ...], is_other: bool
) -> None:
    one, other = (Condition("pattern 0", 0.0, "", at_hz, ((1, 2),)) for at_hz in (one_hz, other_hz))
    assert (stimulus_mismatch([one], [other]) is not None) is is_other


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"frequencies_hz": (0.0,)}, r"frequencies_hz: expected numbers above 0, got \(0\.0,\)"),
        ({"frequencies_hz": ("x",)}, "frequencies_hz: expected a number, got 'x'"),
        ({"electrodes": ((),)}, "electrodes: expected sets of one or more electrode numbers"),
        ({"electrodes": ((-1,),)}, "electrodes: expected sets of one or more electrode numbers"),
        ({"electrodes": ((1.5,),)}, "electrodes: expected a whole number, got 1.5"),
        ({"electrodes": 3}, "electrodes: expected a list, got 3"),
        ({"only_last": 1}, "only_last: expected true or false, got 1"),
    ],
)
def test_stimuli_that_cannot_be_are_refused(changed: dict[str, object], words: str) -> None:
    with pytest.raises(InvalidArgument, match=words):
        Condition("pattern 1", 1.0, **changed)  # type: ignore[arg-type]


def a_condition(electrodes: tuple[tuple[int, ...], ...] | None, *hz: float, only_last: bool = False) -> Condition:
    return Condition("a condition", 0.0, "", hz or (5.0,), electrodes, only_last)


@given(pulses=st.integers(1, 6), seed=st.integers(0, 10**6))
def test_what_is_open_is_dealt_evenly_and_what_is_not_is_as_recorded(pulses: int, seed: int) -> None:
    one, two, last = a_condition((SETS[1],)), a_condition((SETS[0], (7,)), 5.0, 20.0), a_condition((SETS[2],))
    conditions = (a_condition(None), one, two, Condition("l", 0.0, "", (5.0,), last.electrodes, only_last=True))
    dealer = Dealer(Encoder(conditions, pulses), PATTERNS, np.random.default_rng(seed))
    # Of a deck that is shuffled when it is empty, all are dealt equally often, and no two alike while others are left.
    hands = [dealer.targets(0) for _ in range(4)]
    assert set(Counter(target.pattern for hand in hands for target in hand).values()) == {pulses}
    assert all(len({*hand}) == min(pulses, 4) for hand in hands)
    assert dealer.targets(1) == [(SETS[1], 1)] * pulses
    assert {target for _ in range(4) for target in dealer.targets(2)} == {((1, 2), 0), ((7,), -1)}
    *before, end = dealer.targets(3)
    assert end == ((1, 6), 2)
    assert len(before) == pulses - 1 and (len(before) > 3 or end not in before)
    assert {dealer.frequency_hz(2) for _ in range(60)} == {5.0, 20.0}
    assert dealer.frequency_hz(1) == 5.0


@pytest.mark.parametrize("pulses", [2, 4])
def test_the_patterns_of_a_trial_are_different_while_there_are_enough(pulses: int) -> None:
    conditions = tuple(Condition(str(i), 0.0, "", (5.0,), (one,), only_last=True) for i, one in enumerate(SETS))
    dealer = Dealer(Encoder(conditions, pulses), PATTERNS, np.random.default_rng(1))
    hands = [dealer.targets(i % 4) for i in range(400)]
    assert all(len(set(hand)) == pulses for hand in hands)
    assert [hand[-1].pattern for hand in hands] == [0, 1, 2, 3] * 100
    before = Counter(target.pattern for hand in hands for target in hand[:-1])
    assert max(before.values()) - min(before.values()) <= 4


def test_a_pattern_that_was_the_last_for_long_is_not_the_first_for_long() -> None:
    conditions = tuple(Condition(str(i), 0.0, "", (5.0,), (one,), only_last=True) for i, one in enumerate(SETS))
    dealer = Dealer(Encoder(conditions, 3), PATTERNS, np.random.default_rng(1))
    for _ in range(200):
        dealer.targets(0)
    before = Counter(target.pattern for _ in range(30) for target in dealer.targets(1)[:-1])
    assert max(before.values()) - min(before[each] for each in (0, 2, 3)) <= 4


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        (Condition("pattern 3", 3.0), "condition pattern 3: expected recordings that state the frequency"),
        (Condition("pattern 3", 3.0, "", (5.0,), ()), "condition pattern 3: expected recordings that state the elec"),
        (Condition("0 Hz", 0.0, "Hz"), "condition 0 Hz: expected a frequency from 0.001 to 10000 Hz"),
    ],
)
def test_what_cannot_be_delivered_is_refused_in_one_line(condition: Condition, words: str) -> None:
    with pytest.raises(UnusableData) as error:
        Encoder((condition,))
    assert str(error.value).startswith(words) and "\n" not in str(error.value)


def test_trains_are_as_long_as_at_the_slowest_frequency() -> None:
    """100 pulses at 0.1 Hz take 1,000 s, as long as a trial may; a condition may have several frequencies."""
    conditions = a_condition(None, 20.0), a_condition(None, 50.0, 0.1)
    assert Encoder(conditions, 100).pulses == 100
    with pytest.raises(InvalidArgument, match=r"^pulses: expected trials of 1000 s at most, got 101 .* 1,010 s at 0.1"):
        Encoder(conditions, 101)
    with pytest.raises(InvalidArgument, match=r"^conditions: expected at least one, got none$"):
        Encoder((), 100)


def test_patterns_are_taken_where_electrodes_are_open() -> None:
    """Those of the condition itself, or of the pulses before the last one."""
    fixed, last = a_condition((SETS[0],)), a_condition((SETS[0],), only_last=True)
    assert Encoder((fixed, a_condition(None)), 1).takes_patterns and Encoder((fixed, last), 2).takes_patterns
    assert not Encoder((fixed, last), 1).takes_patterns and not Encoder((fixed,), 2).takes_patterns


def of_the_fake(*rows: int, only_last: bool = False) -> tuple[Condition, ...]:
    """Some of the fake culture's patterns as conditions at 20 Hz."""
    patterns = FakeCulture().patterns.tolist()
    sets = {row: tuple(electrode for electrode in patterns[row] if electrode >= 0) for row in rows}
    return tuple(Condition(f"pattern {row}", row, "", (20.0,), (sets[row],), only_last) for row in rows)


def loop_over(conditions: tuple[Condition, ...], pulses: int) -> Loop:
    robot, percentiles = Navigation(episode_limit=12), np.linspace(0.0, 125.0, 11)
    return Loop(robot, Thresholds(9), conditions, percentiles, pulses=pulses, pause_s=0.1)


@pytest.mark.parametrize(("pulses", "only_last"), [(1, False), (3, False), (3, True)])
def test_a_loop_over_patterns_is_read_as_any_recording_of_patterns(
    tmp_path: Path, pulses: int, only_last: bool
) -> None:
    loop = loop_over(of_the_fake(2, 6, 3, only_last=only_last), pulses)
    with FakeCulture() as culture:
        session = run_session(
            culture, loop, [Agent("any", "", AnyCondition(3)), Agent("s", "", OneCondition(0), "shuffled")],
            tmp_path, episodes=2,
        )  # fmt: skip
    assert session.ending.by == "plan", session.ending
    # The recording's own table of stimuli says the same as the log, sorted by the rule that training has.
    for by in (ByPattern((2, 6, 3)), ByElectrode(tuple(c.electrodes[0] for c in loop.conditions if c.electrodes))):
        responses = extract_responses(read_recording(session.recording_file), by, loop.window_ms)
        assert responses.condition.tolist() == [tick.delivered for tick in session.ticks]
        np.testing.assert_array_equal(responses.rate_hz, [tick.rate_hz for tick in session.ticks])
        assert stimulus_mismatch(loop.conditions, responses.conditions) is None
        assert all(c.only_last is only_last for c in responses.conditions)
    assert len({tick.delivered for tick in session.ticks}) == 3


def test_electrodes_that_a_culture_does_not_have_are_refused_before_a_pulse(tmp_path: Path) -> None:
    loop = loop_over((*of_the_fake(1), a_condition(((100, 555),))), 1)
    with FakeCulture() as culture:
        with pytest.raises(Mismatch, match=r"electrodes that the fake culture can stimulate .*, got 555: run on"):
            run_session(culture, loop, [Agent("any", "", AnyCondition(2))], tmp_path)
        assert culture.pulses == 0
    assert not list(tmp_path.iterdir())
