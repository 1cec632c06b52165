"""Why a return differs from its prediction: each reason is named where synthetic sessions have it, and else rarely."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom, norm

from animat.neurons.history import NO_MEMORY, ranks_among
from animat.neurons.history_tracker import AdjustedRanks, HistoryTracker
from animat.reality_gap.predicting import AgentPrediction
from animat.reality_gap.reasons import CHECKS, LEVEL, Evidence, reasons
from animat.reality_gap.session_responses import CommandSums, SessionResponses
from animat.recordings.findings import Finding
from animat.responses.condition import Condition
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses, Trials
from animat.stimulation.protocol import Presentation

CONDITIONS = (Condition("5 Hz", 5.0, "Hz"), Condition("80 Hz", 80.0, "Hz"))
MEANS_HZ = np.array([10.0, 14.0])
RECORDED, EPISODES, ACTIONS = 200, 20, 40
EVERY = np.arange(EPISODES * ACTIONS)


def session(
    seed: int, *, gap: int = -1, thresholds: int = 1, means_hz: np.ndarray = MEANS_HZ, **changed: Any
) -> Evidence:
    """A synthetic session: independent responses, normal about each condition's mean, in episodes of a policy that
    prefers one condition more or less; functions of the arrays change its data."""
    rng = np.random.default_rng(seed)
    recorded = rng.normal(means_hz[:, None], 4.0, (2, RECORDED))

    def commands(responses: np.ndarray, recorded: np.ndarray) -> np.ndarray:
        """The share of the thresholds that are passed, from -1 to +1."""
        shares = np.arange(1, thresholds + 1) / (thresholds + 1)
        at = np.quantile(recorded, shares, axis=(-2, -1))[..., None, None]
        return np.asarray(2 * np.mean(responses >= at, axis=0) - 1)

    def summed(responses: np.ndarray) -> np.ndarray:
        return commands(responses, responses).sum(axis=-1)

    drawn = rng.integers(0, RECORDED, (100, 2, RECORDED))
    anew = summed(np.take_along_axis(np.broadcast_to(recorded, drawn.shape), drawn, axis=-1))
    everywhere = np.full(2, RECORDED)
    predicted = AgentPrediction(
        np.zeros(1),
        np.zeros(1),
        CommandSums(everywhere, summed(recorded)[..., None]),
        CommandSums(everywhere + 0 * drawn[..., 0], anew[..., None]),
        np.zeros((1, 2)),
    )
    pooled_hz = np.sort(recorded, axis=None)
    ranks = tuple(ranks_among(pooled_hz, x_hz)[:, None] for x_hz in recorded)
    without_memory = HistoryTracker(NO_MEMORY, 0.0, pooled_hz, np.array([rank.mean() for rank in ranks]))
    calibration: Any = SimpleNamespace(
        adjusted=AdjustedRanks(without_memory, pooled_hz, np.zeros((2, 1)), tuple(recorded), ranks),
        responses_hz=tuple(recorded),
        presentation=Presentation("mixed", 1),
        burst_share=0.02,
        simulator=SimpleNamespace(has_memory=False),
    )
    calibration.__dict__.update(changed.pop("calibration", {}))
    episode = np.repeat(np.arange(EPISODES), ACTIONS)
    prefers = rng.uniform(0.2, 0.8, EPISODES)
    condition = (rng.random(len(EVERY)) < prefers[episode]).astype(np.int64)
    rate_hz = rng.normal(means_hz[condition], 4.0)
    is_burst = rng.random(len(EVERY)) < 0.02
    late_s = np.where(rng.random(len(EVERY)) < 0.02, 0.0002, 0.0)
    returns = rng.normal(0.0, 30.0, EPISODES)
    data = {"rate_hz": rate_hz, "is_burst": is_burst, "late_s": late_s, "returns": returns}
    data |= {name: change(condition, rate_hz) for name, change in changed.items()}
    time_s = EVERY * 1.0
    responses = Responses(
        condition,
        data["rate_hz"],
        np.zeros(len(EVERY)),
        data["is_burst"],
        CONDITIONS,
        (2.0, 10.0),
        16,
        0.9,
        float("nan"),
        presentation=Presentation("mixed", 1),
        time_s=time_s,
        presented=Trials(condition, data["rate_hz"], data["is_burst"], np.zeros(len(EVERY), bool), time_s),
        place=EVERY,
    )
    command = commands(data["rate_hz"][None], recorded)[0]
    moved = np.ones(len(EVERY), bool)
    read = SessionResponses(responses, episode, data["late_s"], moved, command, data["returns"])
    return Evidence(read, calibration, predicted, gap)  # type: ignore[arg-type]


def falling(condition: np.ndarray, rate_hz: np.ndarray) -> np.ndarray:
    """By a quarter of 80 Hz' mean over the session."""
    return rate_hz - 0.25 * 14.0 * (condition == 1) * (EVERY / len(EVERY) - 0.5)


def worse(*_: np.ndarray) -> np.ndarray:
    return 100.0 - 5.0 * np.arange(EPISODES) + np.random.default_rng(5).normal(0.0, 20.0, EPISODES)


def remembering(condition: np.ndarray, rate_hz: np.ndarray) -> np.ndarray:
    """A response is larger after a large one."""
    return rate_hz + 1.5 * np.sign(np.concatenate([[0.0], rate_hz[:-1] - 12.0]))


def repeating(condition: np.ndarray, rate_hz: np.ndarray) -> np.ndarray:
    """A response is larger after one to the same condition."""
    is_repeated = np.concatenate([[False], condition[1:] == condition[:-1]])
    return rate_hz + 3.0 * is_repeated


CASES: dict[str, tuple[dict[str, Any], str]] = {
    "presentation": (
        {"calibration": {"presentation": Presentation("blocked", 1)}},
        "the presentation in the recording was blocked, 1 pulse per trial, in the loop mixed, 1 pulse per trial",
    ),
    "few-samples": (
        {"calibration": {"responses_hz": (np.ones(7), np.full(200, 14.0))}},
        "the recording has few responses: 7 of 5 Hz",
    ),
    "lateness": (
        # Every second one.
        {"late_s": lambda condition, _: 0.0026 * condition * (np.cumsum(condition) % 2)},
        "pulses came late: 80 Hz in 50 % of its trials, by 2.6 ms of its 12.5 on average",
    ),
    "bursts": (
        {"is_burst": lambda *_: EVERY % 10 == 0},
        "10 % of 800 responses were bursts (2 % in the recording), which the prediction leaves out",
    ),
    "trend": ({"rate_hz": falling, "returns": worse}, "13 min: responses to 80 Hz fall by "),
    "memory": ({"rate_hz": remembering}, " of the responses pass the median if the previous response did, "),
    "repetition": (
        {"rate_hz": repeating, "calibration": {"simulator": SimpleNamespace(has_memory=True)}},
        "responses depend on repetition, which simulators do not model: their mean rank differs by -",
    ),
    "answers": (
        {"rate_hz": lambda condition, rate_hz: rate_hz - 3.0 * (condition == 1)},
        "conditions lead to different mean commands than predicted: 80 Hz to ",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_reason_is_named_with_its_number_where_the_session_has_it(name: str) -> None:
    changed, words = CASES[name]
    assert len(CASES) == len(CHECKS)
    others = []
    for seed in range(20):
        evidence = session(seed, **changed)
        named = {found.name: found.message for found in reasons(evidence)}
        message = named.pop(name)
        assert words in message
        if name == "answers":
            # Bootstraps vary less, as their thresholds follow them: the error is that of 200 commands and 4 more.
            mean = evidence.predicted.commanded.mean[1, 0]
            error = np.sqrt((1 - (200 * mean / 204) ** 2) / 204)
            assert f"({mean:+.2f} +- {error:.2f}; mean " in message
        # What is changed may show in the commands too.
        others += [other for other in named if other != "answers"]
    assert len(others) <= binom.isf(1e-4, 20, len(CHECKS) * LEVEL)


@pytest.mark.oracle
def test_where_there_is_no_reason_hardly_one_is_named() -> None:
    sessions = 400
    named = [found.name for seed in range(sessions) for found in reasons(session(seed))]
    # Each check at its level at most: of these sessions, more than this in one of ten thousand tests.
    most = binom.isf(1e-4, sessions, LEVEL)
    assert {name: named.count(name) for name in set(named) if named.count(name) > most} == {}
    # The tests do test: a level of 0 would name nothing whatever it is.
    assert not {"presentation", "few-samples", "lateness", "bursts"} & set(named)


@pytest.mark.oracle
def test_what_differs_between_episodes_is_no_reason() -> None:
    """Each episode's responses are larger or smaller as a whole: that is neither a trend nor a different command."""

    def uneven(seed: int) -> Any:
        offsets = np.random.default_rng([seed, 1]).normal(0.0, 2.0, EPISODES)
        return lambda _, rate_hz: rate_hz + np.repeat(offsets, ACTIONS)

    sessions = 200
    named = [f.name for seed in range(sessions) for f in reasons(session(seed, rate_hz=uneven(seed)))]
    most = binom.isf(1e-4, sessions, LEVEL)
    assert all(named.count(name) <= most for name in ("trend", "answers"))


def test_a_trend_is_a_reason_only_where_the_returns_have_it_too() -> None:
    for seed in range(20):
        assert "trend" not in {
            found.name for found in reasons(session(seed, rate_hz=falling, returns=lambda *_: -worse()))
        }
        found = {
            each.name: each for each in reasons(session(seed, gap=1, rate_hz=falling, returns=lambda *_: -worse()))
        }
        # Of an expected fall by 25 %; the standard error is that of some 20 episodes.
        assert found["trend"].value == pytest.approx(-0.25, abs=0.15)


def test_memory_is_no_reason_where_the_simulator_has_one() -> None:
    knows = {"simulator": SimpleNamespace(has_memory=True)}
    assert "memory" not in {f.name for f in reasons(session(1, rate_hz=remembering, calibration=knows))}


@pytest.mark.parametrize("name", ["answers", "repetition", "trend"])
def test_few_episodes_show_no_trend_no_repetition_and_no_difference_in_commands(name: str) -> None:
    evidence = session(1, **CASES[name][0])
    answered = evidence.session
    kept = answered.episode < 7
    few = replace(
        answered,
        responses=replace(
            answered.responses,
            **{
                name: getattr(answered.responses, name)[kept]
                for name in ("condition", "rate_hz", "active_ratio", "is_burst", "time_s", "place")
            },
        ),
        **{name: getattr(answered, name)[kept] for name in ("episode", "late_s", "moved", "command")},
        returns=answered.returns[:7],
    )
    assert reasons(replace(evidence, session=few)) == ()


def test_commands_of_nine_thresholds_show_what_the_median_alone_does_not() -> None:
    """80 Hz passes the median always, and less of the thresholds above it: its responses fall, and stay above."""

    def lower(condition: np.ndarray, rate_hz: np.ndarray) -> np.ndarray:
        return rate_hz - 6.0 * (condition == 1)

    for seed in range(20):
        of_one, of_nine = (
            {
                found.name: found
                for found in reasons(session(seed, thresholds=n, means_hz=np.array([0.0, 30.0]), rate_hz=lower))
            }
            for n in (1, 9)
        )
        assert "answers" not in of_one
        assert "80 Hz to " in of_nine["answers"].message
        # Of the four thresholds above the median, which are P20 to P80 of 80 Hz, lower by 1.5 standard deviations.
        of_each = norm.sf(norm.ppf([0.2, 0.4, 0.6, 0.8]) + 1.5) - [0.8, 0.6, 0.4, 0.2]
        assert of_nine["answers"].value == pytest.approx(2 * of_each.sum() / 9, abs=0.15)


def test_the_mean_response_to_a_condition_is_of_those_that_moved_the_robot() -> None:
    """With --on-burst repeat or skip bursts give no command, so they are not in the mean of what gave the others."""
    evidence = session(1, **CASES["answers"][0])
    answered, is_burst = evidence.session, EVERY % 10 == 0
    rate_hz = np.where(is_burst, 1000.0, answered.responses.rate_hz)
    responses = replace(answered.responses, rate_hz=rate_hz, is_burst=is_burst)
    found = CHECKS["mean commands"](replace(evidence, session=replace(answered, responses=responses, moved=~is_burst)))
    used = (responses.condition == 1) & ~is_burst
    assert found is not None
    assert f"; mean {rate_hz[used].mean():.3g} Hz, {evidence.calibration.responses_hz[1].mean():.3g}" in found.message


@pytest.mark.oracle
def test_commands_that_all_differ_by_little_are_a_reason_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each condition by less than is reported of one alone: thresholds that are too low, or too high."""
    here = sys.modules[__name__]
    for name, value in {"RECORDED": 4000, "EPISODES": 100, "EVERY": np.arange(100 * ACTIONS)}.items():
        monkeypatch.setattr(here, name, value)

    def named(hz: float) -> list[Finding]:
        """By sessions in which every response is larger."""
        found = [reasons(session(seed, thresholds=9, rate_hz=lambda _, rate_hz: rate_hz + hz)) for seed in range(20)]
        # Now and then one condition differs by enough to be named itself.
        return [finding for of_one in found for finding in of_one if finding.message.startswith("commands are ")]

    # A normal density of the responses to a condition, averaged over one of all responses, whose variance is 4^2 + 2^2.
    shift = 2 * 0.4 / np.sqrt(2 * np.pi * (4.0**2 + 4.0**2 + 2.0**2))
    for hz, words in ((0.4, "higher"), (-0.4, "lower")):
        found = named(hz)
        assert len(found) >= 16
        assert all(f"commands are {words} than predicted for the same conditions, by 0.0" in f.message for f in found)
        assert np.mean([finding.value for finding in found]) == pytest.approx(np.sign(hz) * shift, abs=0.01)
    # A quarter is not worth a mention, and where there is nothing hardly anything is named.
    assert len(named(0.1)) <= 3 and len(named(0.0)) <= binom.isf(1e-4, 20, LEVEL)


def test_commands_without_any_variance_are_compared_too() -> None:
    """As where every response passes all thresholds: it was a division by zero."""

    def ones(sums: CommandSums) -> CommandSums:
        return CommandSums(sums.presented, sums.presented[..., None] * 1.0)

    varied = session(1)
    commanded, bootstraps = varied.predicted.commanded, varied.predicted.commanded_bootstraps
    predicted = varied.predicted._replace(commanded=ones(commanded), commanded_bootstraps=ones(bootstraps))

    def named(command: float) -> list[str]:
        of_session = replace(varied.session, command=np.full_like(varied.session.command, command))
        found = reasons(replace(varied, predicted=predicted, session=of_session))
        return [finding.message for finding in found if finding.name == "answers"]

    assert named(1.0) == []
    (message,) = named(0.9375)
    assert message.startswith("commands are lower than predicted for the same conditions, by 0.062 +- 0.000")


def test_of_two_readouts_the_one_that_differs_is_named() -> None:
    def on_halves(left: Evidence, right: Evidence) -> Evidence:
        each = [evidence.session for evidence in (left, right)]
        responses = replace(
            each[0].responses,
            readouts=Readouts(("left", "right"), ((1,), (2,))),
            readout_hz=np.stack([one.responses.rate_hz for one in each], axis=1),
        )
        answered = replace(each[0], responses=responses, command=np.stack([one.command for one in each], axis=1))
        predicted = left.predicted
        once, bootstrapped = (
            CommandSums(each.presented, np.concatenate([each.total] * 2, -1))
            for each in (predicted.commanded, predicted.commanded_bootstraps)
        )
        recorded = tuple(np.stack([x, x], axis=1) for x in left.calibration.responses_hz)
        calibration: Any = SimpleNamespace(**{**vars(left.calibration), "responses_hz": recorded})
        doubled = predicted._replace(commanded=once, commanded_bootstraps=bootstrapped)
        return Evidence(answered, calibration, doubled, -1)

    check = CHECKS["mean commands"]
    same, other = session(3), session(3, rate_hz=lambda condition, rate_hz: rate_hz - 3.0)
    assert check(on_halves(same, same)) is None
    found, alone = check(on_halves(same, other)), check(other)
    assert found is not None and alone is not None
    assert "80 Hz on right to " in found.message and "on left" not in found.message
    # The message is the same as for this readout alone.
    assert found.message.replace(" on right", "") == alone.message
