"""How long a session will be and can be, computed beforehand: sums by hand and closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from animat.closed_loop.loop import Loop
from animat.coding.mapping import Thresholds
from animat.cultures.budget import Account, Budget
from animat.reality_gap.outlook import Outlook, outlook
from animat.responses.condition import Condition
from animat.responses.quality.drift import MedianDrift, median_drift
from animat.responses.responses import Responses
from animat.robots import Navigation

CONDITIONS = (Condition("5 Hz", 5.0, "Hz"), Condition("80 Hz", 80.0, "Hz"))


def responses(start_min: float, rate_hz: np.ndarray) -> Responses:
    n = len(rate_hz)
    none = np.zeros(n, bool)
    return Responses(
        np.arange(n) % 2, rate_hz, 0.0 * none, none, CONDITIONS, (2.0, 10.0), 16, 1.0, 0.0, start_min=start_min
    )


def test_files_fill_five_megabytes_a_minute_until_the_plan_or_the_budget_ends() -> None:
    assert Outlook(60.0, None, math.inf).room_bytes == 300e6
    assert Outlook(60.0, None, 12.0).room_bytes == 60e6


def test_a_steady_fall_is_estimated_exactly() -> None:
    """P50 = 10 exp(-0.01 t), with recordings whose responses are all the same: no error."""
    series = [responses(t, np.full(40, 10.0 * math.exp(-0.01 * t))) for t in (0.0, 10.0, 25.0)]
    found = median_drift(series)
    assert found is not None
    assert found.per_min == pytest.approx(-0.01)
    assert found.error == 0
    assert found.minutes_to(0.25) == pytest.approx((-100 * math.log(0.75),) * 2)
    # The newest three count.
    assert median_drift([responses(-10.0, np.full(40, 99.0)), *series]) == pytest.approx(found)
    assert median_drift(series[:1]) is None
    assert median_drift([series[0], responses(10.0, np.zeros(40))]) is None


@pytest.mark.oracle
def test_the_error_of_a_drift_is_that_of_medians() -> None:
    """A median of n normal responses has an error of sqrt(pi / 2 n) standard deviations."""
    rng = np.random.default_rng(1)
    found = [median_drift([responses(t, rng.normal(10.0, 2.0, 400)) for t in (0.0, 10.0)]) for _ in range(60)]
    expected = math.sqrt(2 * math.pi / 2 / 400) * 0.2 / 10.0
    rates, errors = np.array([(each.per_min, each.error) for each in found if each is not None]).T
    assert errors.mean() == pytest.approx(expected, rel=0.15)
    assert rates.std() == pytest.approx(expected, rel=0.35)


def test_the_minutes_to_a_change_are_fewer_with_more_uncertainty() -> None:
    likely, least = MedianDrift(-0.01, 0.005).minutes_to(0.25)
    assert (likely, least) == pytest.approx((-100 * math.log(0.75), -50 * math.log(0.75)))
    assert MedianDrift(0.01, 0.0).minutes_to(0.25)[0] == pytest.approx(100 * math.log(1.25))
    assert MedianDrift(0.0, 0.0).minutes_to(0.25) == (math.inf, math.inf)


def test_a_session_takes_its_pauses_and_what_is_presented() -> None:
    loop = Loop(Navigation(), Thresholds(1), CONDITIONS, np.arange(11.0), pulses=1, pause_s=3.0, warm_up=2)  # type: ignore[arg-type]
    calibration: Any = SimpleNamespace(drift=MedianDrift(-0.01, 0.005), start_min=10.0)
    plan = [(4, np.array([10.0, 80.0]), True), (2, np.array([10.0, 80.0]), False)]
    account = Account(Budget(pulses=188))
    account.pulses = 94
    found = outlook(loop, calibration, plan, account, 5.0)
    # Stimulated episodes have 94 pulses, and a warm-up of two of each; in silence there is none.
    total_s = 4 * (3 + 12 / 5 + 82 / 80) + 2 * (3 + 10 / 5 + 80 / 80)
    assert found.planned_min == pytest.approx(total_s / 60)
    assert found.drifted_min == pytest.approx((-100 * math.log(0.75) - 5, -50 * math.log(0.75) - 5))
    # On a clock that was restarted no time is known to have passed.
    for age_min in (-10.0, 0.0):
        restarted = outlook(loop, calibration, plan, account, age_min)
        assert restarted.drifted_min == pytest.approx((-100 * math.log(0.75), -50 * math.log(0.75)))
    assert found.budget_min == pytest.approx(total_s / 60 / 4)
    assert str(found).endswith("; the plan is longer: ask for fewer --episodes")
    assert "the plan is longer" not in str(replace(found, budget_min=math.inf))
    # Three more pauses before the first episode, with six of each.
    longer = outlook(replace(loop, settling=3), calibration, plan, account, 5.0)
    longer_s = total_s + 3 * (3 + 6 / 5 + 6 / 80)
    assert longer.planned_min == pytest.approx(longer_s / 60)
    assert longer.settling_min == pytest.approx((longer_s - total_s) / 60) and found.settling_min == 0
    assert longer.budget_min == pytest.approx(longer_s / 60 * 94 / (4 * 94 + 36))
    # Of two pulses each, without a warm-up: 90 trials, and twelve in the settling.
    twice = outlook(replace(loop, pulses=2, warm_up=0, settling=1), calibration, [(1, plan[0][1], True)], account, 5.0)
    twice_s = 3 + 2 * (10 / 5 + 80 / 80) + 3 + 2 * (6 / 5 + 6 / 80)
    assert twice.planned_min == pytest.approx(twice_s / 60)
    assert twice.budget_min == pytest.approx(twice_s / 60 * 94 / (2 * 90 + 2 * 12))
    assert outlook(loop, calibration, plan[1:], account, 5.0).budget_min == math.inf


def test_the_outlook_is_one_line() -> None:
    line = str(Outlook(26.2, (24.0, 11.0), math.inf))
    assert line == (
        "the session is planned for about 26 min of the culture's time; at the drift of the recordings the median "
        "response will have changed by 25 % in 24 min (11 min at the earliest), beyond which adaptive thresholds may "
        "not help; the plan is longer: ask for fewer --episodes"
    )
    assert str(Outlook(26.2, (24.0, -9.0), 20.0)).endswith("the plan is longer: ask for fewer --episodes")
    assert "planned for about 15 s of the culture's time" in str(Outlook(0.25, None, math.inf))
    assert "in 24 min (0 min at the earliest)" in str(Outlook(26.2, (24.0, -9.0), 20.0))
    # The likely time counts, not the earliest.
    assert str(Outlook(20.0, (24.0, -9.0), math.inf)).endswith("beyond which adaptive thresholds may not help")
    assert str(Outlook(26.2, (-5.0, -9.0), math.inf)) == (
        "the session is planned for about 26 min of the culture's time; at the drift of the recordings the median "
        "response had already changed by 25 % 5 min ago, beyond which adaptive thresholds may not help; use newer "
        "recordings, with --at-min or by recording again"
    )
    drifted = str(Outlook(26.2, (-5.0, -9.0), 20.0))
    assert drifted.endswith("--at-min or by recording again; the plan is longer: ask for fewer --episodes")
    assert "in more than 10 h (40 min at the earliest)" in str(Outlook(26.2, (math.inf, 40.0), math.inf))
    assert str(Outlook(6.0, None, 7.0)) == (
        "the session is planned for about 6 min of the culture's time; at least two recordings are needed to estimate "
        "the culture's drift; the budget of pulses lasts for about 7 min"
    )
    # Fewer episodes would not help.
    assert str(Outlook(6.0, None, 0.4, 1.5)).endswith(
        "lasts for about 0 min, but the settling before the first episode takes 1.5 min (--settling)"
    )


def test_recordings_that_all_start_at_one_minute_have_no_drift_from_one_to_the_next() -> None:
    assert median_drift([responses(5.0, np.full(40, 9.0)), responses(5.0, np.full(40, 6.0))]) is None
