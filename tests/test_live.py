"""A live run: recordings on time, simulators swapped under a training that never stops, a budget that is kept."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cli import main
from animat.closed_loop.session import recover_session
from animat.coding.mapping import Thresholds
from animat.cultures import under_way
from animat.cultures.base import Culture
from animat.cultures.budget import Account, Budget, record_within
from animat.cultures.kinds import culture_arguments
from animat.cultures.observed import Observed
from animat.cultures.under_way import PartialRecording
from animat.cultures.virtual import VirtualCulture
from animat.errors import (
    AnimatError,
    BudgetSpent,
    DeviceFailed,
    InvalidArgument,
    InvalidFile,
    Mismatch,
    UnsafeStimulus,
    UnusableData,
)
from animat.live import shadowing
from animat.live.plan import LOG_FILE, Timetable, check_plan
from animat.live.shadowing import LiveRun, live
from animat.live.trainers import Exchange, Trainers
from animat.neurons.synthetic import synthetic_simulator
from animat.neurons.timeline import fit_timeline
from animat.reality_gap import Calibration
from animat.recordings.reading import read_recordings
from animat.responses.extraction import extract_responses
from animat.robots import Navigation
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import BALANCED_PULSE, PUBLISHED_PULSE
from animat.stimulation.stimulus import Stimulus
from animat.training.policy import load_policies
from animat.training.settings import SAC
from animat.training.specification import Training
from animat.watch.discovery import is_locked
from animat.watch.live import LiveView
from animat.watch.recording import RecordingView
from animat.writing import exclusive_lock
from cultures import small_culture
from fake_culture import FakeCulture

pytestmark = pytest.mark.usefixtures("few_bootstraps")

SMALL = SAC(environments=8, gradient_steps=1, batch=16, replay=1024, hidden=8)
TRAINING = Training(Navigation(episode_limit=8), Thresholds(1), policies=2, iterations=6000, seed=3, algorithm=SMALL)
ONE = replace(TRAINING, policies=1)
"""In one process: for what has nothing to do with how many train."""
PROTOCOL = Protocol(order="mixed", pulses=2, patterns=8, trials=40, setup_s=0.1)
BLOCKED = replace(PROTOCOL, order="blocked", pulse=BALANCED_PULSE, patterns=7)
PULSES = 5 * 40 * 2
QUICK = Timetable(interval_min=10, duration_min=30, speed=1e6)


def test_the_return_of_a_live_run_is_that_of_all_groups(tmp_path: Path) -> None:
    trainers, none = Trainers([], tmp_path, tmp_path), float("nan")
    assert np.isnan(trainers.mean_return)
    for returns, mean in (([2.0, none, 5.0], 3.5), ([none], none)):
        trainers._reports = {i: {"mean_return": of} for i, of in enumerate(returns)}  # type: ignore[misc]
        assert trainers.mean_return == pytest.approx(mean, nan_ok=True)


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / LOG_FILE).read_text().splitlines()]


Seen = list[tuple[str, int, str, float]]
"""What the page shows of a recording under way: its state, how many are complete, which is shown, and its end in s."""


@pytest.fixture(scope="module")
def seen() -> Seen:
    return []


@pytest.fixture(scope="module")
def trained() -> list[bool | None]:
    """Whether viewers could tell that policies were being trained, whenever a recording under way was seen."""
    return []


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory, seen: Seen, trained: list[bool | None]) -> tuple[LiveRun, Path, int]:
    """A run whose recordings are watched as they are made."""
    folder = tmp_path_factory.mktemp("live") / "live"

    class Watched(PartialRecording):
        def __call__(self, so_far: Any) -> None:
            super().__call__(so_far)
            found = RecordingView(folder / "recordings").view(None, 8.0)
            facts = dict(found["blocks"][0]["rows"])
            seen.append((found["state"], facts["complete"], facts["shown"], found["end_s"]))
            trained.append(is_locked(folder / "policies"))

    with pytest.MonkeyPatch.context() as patch, FakeCulture() as culture:
        patch.setattr(under_way, "EVERY_S", 0.0)
        patch.setattr(shadowing, "PartialRecording", Watched)
        found = live(TRAINING, culture, BLOCKED, folder, timetable=QUICK, episodes=3, kind="empirical")
        return found, folder, culture.delivered


def test_the_culture_is_recorded_every_interval(ran: tuple[LiveRun, Path, int]) -> None:
    found, folder, _ = ran
    assert [file.name for file in found.recordings] == [f"recording_{m}_min.nwb" for m in ("00.2", "10.2", "20.2")]
    recordings = read_recordings([folder / "recordings"])
    np.testing.assert_allclose(np.diff([r.start_min for r in recordings]), 10, atol=1e-9)
    orders = [recording.stimuli.frequency_hz.tolist() for recording in recordings]
    assert orders[0] != orders[1] != orders[2]
    assert found.culture_min == pytest.approx(30.0)


def test_recordings_are_watched_as_they_are_made(
    ran: tuple[LiveRun, Path, int], seen: Seen, trained: list[bool | None]
) -> None:
    found, folder = ran[0], ran[1] / "recordings"
    assert trained == [whole > 0 for _, whole, *_ in seen]
    assert {state for state, *_ in seen} == {"running"}
    assert {shown for *_, shown, _ in seen} == {"the one in progress, as far as it has come"}
    for number, file in enumerate(found.recordings):
        until_s = [end_s for _, whole, _, end_s in seen if whole == number]
        assert len(until_s) > 1 and until_s == sorted(set(until_s))
        assert until_s[-1] <= read_recordings([file])[0].duration_s + 1e-9
    after = RecordingView(folder).view(None, 8.0)
    assert (after["state"], dict(after["blocks"][0]["rows"])["complete"]) == ("ended", 3)
    assert not (folder / under_way.UNDER_WAY).exists()


def test_what_has_happened_is_watched(ran: tuple[LiveRun, Path, int]) -> None:
    found, folder, _ = ran
    view = LiveView(folder)
    assert view.about()["title"] == "live training of navigation policies"
    shown = view.view(None, 8.0)
    assert (shown["state"], shown["message"]) == ("ended", found.gap.session.ending.message)
    so_far, curves, *_, events = shown["blocks"]
    rows = dict(so_far["rows"])
    assert rows["recordings"] == 3 and rows["minutes of training"] == 30.0
    assert rows["minutes at the last event"] == pytest.approx(lines(folder)[-1]["culture_min"] - 0.2, abs=0.06)
    assert rows["iterations of each"] == f"{found.iterations:,}"
    assert rows["pulses at the last event"] == found.gap.account.pulses
    minutes = [f"minute {swap['recorded_at_min']:g}" for swap in found.swaps]
    assert curves["marks"] == [[swap["iterations"], at] for swap, at in zip(found.swaps, minutes, strict=True)]
    assert rows["newest swapped in"] == f"that of {minutes[-1]}"
    *each, mean = curves["series"]
    assert [of["y"] for of in each] == [
        [None if np.isnan(y) else pytest.approx(y) for y in policy.learning_curve[:, 2].tolist()]
        for policy in found.policies.values()
    ]
    assert mean["x"][-1] == found.iterations
    assert [row[1] for row in events["rows"]] == [line["what"] for line in lines(folder)][::-1]


def test_a_live_run_is_watched_until_it_is_killed(ran: tuple[LiveRun, Path, int], tmp_path: Path) -> None:
    whole = (ran[1] / LOG_FILE).read_text().splitlines(keepends=True)
    for n, message, held in (
        (1, "the first recording is made", "recordings"),
        (5, "training", "policies"),
        (7, "training", ""),
        (9, "training has ended", "session"),
    ):
        (tmp_path / LOG_FILE).write_text("".join(whole[:n]))
        with exclusive_lock(tmp_path / held):
            shown = LiveView(tmp_path).view(None, 8.0)
            assert shown["state"] == "running" and shown["message"].startswith(message)
        killed = LiveView(tmp_path).view(None, 8.0)
        assert killed["state"] == "silent" and "was killed" in killed["message"]
    # Each group swaps at a chunk of its own; the first counts.
    swaps = [
        {"what": "swap", "members": [i], "iterations": n, "recorded_at_min": 10.2} for i, n in ((0, 500), (1, 300))
    ]
    (tmp_path / LOG_FILE).write_text(whole[0] + "".join(json.dumps(swap) + "\n" for swap in swaps))
    assert LiveView(tmp_path).view(None, 8.0)["blocks"][1]["marks"] == [[300, "minute 10.2"]]
    # Without room on the disk the end may be missing.
    for end in ('{"what": "end"}\n', ""):
        (tmp_path / LOG_FILE).write_text(whole[0] + '{"what": "fault", "message": "gone"}\n' + end)
        assert LiveView(tmp_path).view(None, 8.0)["message"] == "gone"


def test_every_simulator_is_swapped_in_once_dated_and_kept_with_the_policies(ran: tuple[LiveRun, Path, int]) -> None:
    found, folder, _ = ran
    starts_min = [r.start_min for r in read_recordings([folder / "recordings"])]
    assert [swap["recorded_at_min"] for swap in found.swaps] == pytest.approx(starts_min[1:])
    assert all(swap["members"] == [0, 1] for swap in found.swaps)
    # The training went on: each swap at a later chunk, and iterations counted on through all.
    chunks = [swap["chunk"] for swap in found.swaps]
    assert 0 < chunks[0] < chunks[1]
    policies = load_policies(folder / "policies")
    assert list(policies) == list(found.policies) == ["p0", "p1"]
    for policy in policies.values():
        iterations = policy.learning_curve[:, 0]
        assert np.all(np.diff(iterations) > 0)
        assert iterations[-1] == found.iterations
        assert len(iterations) > chunks[1]
        swaps = policy.provenance["swaps"]
        assert [swap["recorded_at_min"] for swap in swaps] == pytest.approx(starts_min)
        assert swaps[0]["chunk"] == 0
        assert policy.provenance["training"]["duration_min"] == 30.0
        assert policy.presentation == BLOCKED.presentation


def test_what_happened_is_in_the_log_in_order(ran: tuple[LiveRun, Path, int]) -> None:
    found, folder, _ = ran
    events = lines(folder)
    whats = [line["what"] for line in events]
    assert whats == [
        "begun", "recording", "training", "training began", "recording", "swap", "recording", "swap",
        "trained", "closed loop", "end",
    ]  # fmt: skip
    for name in ("at", "wall_s", "culture_min"):
        assert all(one[name] <= next_[name] for one, next_ in pairwise(events))
    # On the culture's own clock, as the minutes of the recordings.
    assert events[0]["culture_min"] == 0.2
    assert not (folder / ".exchange").exists()
    json.dumps(found.to_dict())


def test_the_loop_runs_with_what_was_trained_on_last(ran: tuple[LiveRun, Path, int]) -> None:
    found, folder, delivered = ran
    gap = found.gap
    assert gap.session.ending.by == "plan"
    assert [row.name for row in gap.rows] == ["policies", "p0", "p1", "random"]
    assert gap.loop.adaptive_from is not None
    assert {policy.provenance["simulators"]["kind"] for policy in found.policies.values()} == {"empirical"}
    assert not {finding.name for finding in gap.findings} & {"other-simulator", "old-calibration"}
    # Stimulated as it was recorded.
    assert (gap.loop.pulse, gap.loop.pulses, gap.loop.patterns) == (BALANCED_PULSE, 2, 7)
    assert gap.session.log.header["seed"] == TRAINING.seed
    series = [extract_responses(recording) for recording in read_recordings([folder / "recordings"])]
    expected = fit_timeline(series).simulators.percentiles[-1]
    np.testing.assert_array_equal(gap.loop.percentiles, np.asarray(expected))
    # A later run of these policies takes the same.
    again = Calibration.of_series(series, found.policies["p0"])
    np.testing.assert_array_equal(again.percentiles, gap.loop.percentiles)
    assert gap.account.pulses == delivered == 3 * PULSES + sum(e.pulses for e in gap.session.episodes)


@pytest.mark.oracle
def test_a_virtual_culture_s_state_lies_beside_its_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    after = []
    save_state = VirtualCulture.save_state

    def noted(self: VirtualCulture, *given: Any, **more: Any) -> None:
        after.append(self.now_s)
        save_state(self, *given, **more)

    monkeypatch.setattr(VirtualCulture, "save_state", noted)
    # Its rests are simulated.
    timetable = replace(QUICK, interval_min=1, duration_min=3)
    with small_culture() as culture:
        found = live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=timetable, episodes=1)
        ended_s = culture.now_s
    recordings = read_recordings(found.recordings)
    # After each recording, in case the run is killed, and after the loop.
    begun_s = [60 * each.start_min for each in recordings]
    assert [begun < kept < begun + 60 for begun, kept in zip(begun_s, after[:-1], strict=True)] == [True] * 3
    assert after[-1] == ended_s > 3 * 60
    known = culture_arguments("virtual", recordings, [tmp_path / "live" / "recordings"])
    assert known == {"seed": 1, "state": tmp_path / "live" / "recordings" / "culture.state"}
    goes_on = small_culture()
    goes_on.restore_state(known["state"])
    assert goes_on.now_s == ended_s


@pytest.mark.oracle
def test_where_the_budget_ends_recording_stops_and_training_goes_on(tmp_path: Path) -> None:
    account = Account(Budget(pulses=2 * PULSES + 100))
    with FakeCulture() as culture:
        given: dict[str, Any] = {"timetable": QUICK, "episodes": 1, "account": account, "adaptive": False}
        found = live(ONE, culture, PROTOCOL, tmp_path / "live", **given)
        assert culture.delivered == account.pulses <= 2 * PULSES + 100
    assert found.gap.loop.adaptive_from is None
    assert len(found.recordings) == 2
    assert len(found.swaps) == 1
    assert found.culture_min == pytest.approx(30.0)
    assert [line["what"] for line in lines(tmp_path / "live")].count("budget") == 1
    assert found.gap.session.ending.by in ("plan", "budget")
    with FakeCulture() as culture, pytest.raises(BudgetSpent, match="0 of 10 pulses are spent, and 400 more"):
        live(ONE, culture, PROTOCOL, tmp_path / "none", account=Account(Budget(pulses=10)))


@pytest.mark.parametrize(
    ("budget", "words"),
    [
        (Budget(pulses=PULSES - 1), rf"0 of {PULSES - 1} pulses are spent, and {PULSES} more were wanted by the first"),
        # Eight patterns of two of the eight electrodes, each as often.
        (Budget(pulses_per_electrode=PULSES // 4 - 1), "per_electrode: electrode 10. had 0 of 99 .* by the first"),
    ],
)
def test_a_budget_without_room_for_the_first_recording_leaves_nothing(
    budget: Budget, words: str, tmp_path: Path
) -> None:
    with FakeCulture() as culture, pytest.raises(BudgetSpent, match=words):
        live(ONE, culture, PROTOCOL, tmp_path / "live", account=Account(budget))
    assert culture.pulses == 0
    assert not (tmp_path / "live").exists()


def test_without_room_on_the_disk_nothing_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("animat.writing.shutil.disk_usage", lambda _: usage._replace(free=1000))
    with FakeCulture() as culture, pytest.raises(InvalidFile, match=r"MB free for .*, got 0\.00 MB"):
        live(ONE, culture, PROTOCOL, tmp_path / "live")
    assert culture.pulses == 0
    assert not (tmp_path / "live" / ".exchange").exists()


@pytest.mark.parametrize("error", [DeviceFailed("gone"), KeyboardInterrupt()], ids=repr)
def test_of_a_recording_that_ends_half_way_the_pulses_are_spent(error: BaseException) -> None:
    account = Account(Budget(3 * 80 + 5 * 80))
    blocked = Protocol(pulses=2, patterns=8, trials=40, setup_s=0.1)

    def fail(culture: FakeCulture, observed: Observed) -> Observed:
        raise error

    with FakeCulture(fault=fail, at=2) as culture:
        with pytest.raises(type(error)):
            record_within(account, culture, blocked, 1)
        # Blocks of 80: two were recorded, and the third was handed over.
        assert account.pulses == culture.delivered == culture.pulses == 3 * 80
        with pytest.raises(UnsafeStimulus):
            culture.stop()
            record_within(account, culture, blocked, 1)
        assert account.pulses == 3 * 80
        account.spend([Stimulus(0.0, (100,), PUBLISHED_PULSE)])
        with pytest.raises(BudgetSpent, match="241 of 640 pulses are spent, and 400 more were wanted"):
            record_within(account, culture, blocked, 1)


def test_of_a_block_in_stretches_that_stops_half_way_all_pulses_are_spent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeCulture, "stretch_s", 1.0)
    account = Account(Budget())
    blocked = Protocol((80.0, 5.0), pulses=1, patterns=8, trials=160, setup_s=0.1)

    class Stop:
        def update(self, done: float, total: float, note: str = "") -> None:
            if 1 < done < 2:
                culture.stop()

    with FakeCulture() as culture:
        with pytest.raises(UnsafeStimulus):
            record_within(account, culture, blocked, 1, Stop())
        # Of the second block a stretch was delivered: the block is spent, which is no less than what came.
        assert 160 < culture.delivered < account.pulses == 2 * 160


@pytest.mark.parametrize("fails", [False, True])
def test_what_others_deliver_meanwhile_is_not_spent(fails: bool) -> None:
    """The culture counts all deliveries of a session, an account only those of its own recordings."""
    account = Account(Budget())
    blocked = Protocol(pulses=2, patterns=8, trials=40, setup_s=0.1)

    class Other:
        """Stimulates after each block, as another thread would."""

        def update(self, done: float, total: float, note: str = "") -> None:
            culture.rest(1.0)
            for _ in range(7):
                culture.stimulate(culture.stimulation_electrodes[:1], PUBLISHED_PULSE)
                culture.rest(1.0)
            if fails and done == 2:
                culture.stop()

    with FakeCulture() as culture:
        if fails:
            with pytest.raises(UnsafeStimulus):
                record_within(account, culture, blocked, 1, Other())
        else:
            record_within(account, culture, blocked, 1, Other())
        blocks = 2 if fails else 5
        assert account.pulses == blocks * 80
        assert culture.delivered == blocks * (80 + 7)


@pytest.mark.oracle
def test_a_recording_that_cannot_be_used_is_kept_and_passed_over(tmp_path: Path) -> None:
    with FakeCulture() as culture:
        refused = iter([False, True, False])

        def extract(recordings: Any, *given: Any, **more: Any) -> Any:
            if next(refused):
                raise UnusableData("a dead window")
            return [extract_responses(recording) for recording in recordings]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("animat.live.shadowing.extract_series", extract)
            found = live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=QUICK, episodes=1, adaptive=False)
    assert found.gap.loop.adaptive_from is None
    assert len(found.recordings) == 3
    assert len(found.swaps) == 1
    assert [line["message"] for line in lines(tmp_path / "live") if line["what"] == "unusable"] == ["a dead window"]


def test_a_first_recording_that_cannot_be_used_ends_it_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def extract(recordings: Any) -> Any:
        raise UnusableData("recording_0000_min.nwb: a dead window")

    monkeypatch.setattr("animat.live.shadowing.extract_series", extract)
    expected = r"recording: expected the first one to be usable, got one that is not: recording_0000_min.nwb: a dead"
    with FakeCulture() as culture, pytest.raises(UnusableData, match=expected):
        live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=QUICK, episodes=1, adaptive=False)
    assert [line["what"] for line in lines(tmp_path / "live")][1] == "unusable"


class Pressing:
    """A progress at which a person presses Ctrl-C once there was a swap."""

    def update(self, done: float, total: float, note: str = "") -> None:
        if ", 1 swap" in note:
            raise KeyboardInterrupt


@pytest.mark.oracle
def test_ctrl_c_keeps_recordings_and_policies_and_stops_the_culture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish, was_stopped = Trainers.finish, []
    monkeypatch.setattr(Trainers, "finish", lambda self: was_stopped.append(culture.is_stopped) or finish(self))
    with FakeCulture() as culture:
        with pytest.raises(KeyboardInterrupt):
            live(
                ONE,
                culture,
                PROTOCOL,
                tmp_path / "live",
                timetable=Timetable(interval_min=10, duration_min=1000, speed=1e4),
                progress=Pressing(),
            )
        assert culture.is_stopped
        # Before the policies were waited for.
        assert was_stopped == [True]
        assert culture.after_halt == 0
    assert list(load_policies(tmp_path / "live" / "policies")) == ["p0"]
    assert not (tmp_path / "live" / ".exchange").exists()
    assert len(read_recordings([tmp_path / "live" / "recordings"])) >= 2
    events = lines(tmp_path / "live")
    assert [line["what"] for line in events[-2:]] == ["interrupted", "end"]
    assert [line["what"] for line in events].count("interrupted") == 1
    assert events[-1]["budget"]["pulses"] == culture.pulses
    assert events[-2]["message"] == "stopped by a person"
    with pytest.raises(Mismatch, match="expected an empty folder for a live run, got one with files"):
        live(ONE, culture, PROTOCOL, tmp_path / "live")


@pytest.mark.oracle
@pytest.mark.parametrize("full_at", ["closed loop", "end"])
def test_without_room_for_the_last_files_the_results_are_reported(
    full_at: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, said = shadowing._Run.write, list[str]()

    def full(run: Any, what: str, **fields: Any) -> Any:
        if what == full_at:
            raise InvalidFile("live.log: cannot be written: No space left on device")
        return write(run, what, **fields)

    monkeypatch.setattr(shadowing._Run, "write", full)
    with FakeCulture() as culture, pytest.raises(InvalidFile, match="No space") as raised:
        live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=QUICK, report=said.append)
    assert "p0" in said[-1] and "random" in said[-1]
    assert raised.value.__notes__[0].startswith(f"{tmp_path}/live/session: the session ended: all ")


@pytest.mark.oracle
def test_a_culture_that_fails_meanwhile_is_stopped_and_what_was_trained_is_kept(tmp_path: Path) -> None:
    def fail(culture: FakeCulture, observed: Observed) -> Observed:
        raise DeviceFailed("gone")

    with FakeCulture(fault=fail, at=1) as culture:
        with pytest.raises(DeviceFailed, match="gone") as raised:
            live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=QUICK)
        kept = f"animat run {tmp_path}/live/policies --recordings {tmp_path}/live/recordings"
        assert raised.value.__notes__ == [f"what was trained so far can still be run: {kept}"]
        assert culture.is_stopped
        assert culture.after_halt == 0
        # The second recording was handed over: nobody knows what came of it.
        assert lines(tmp_path / "live")[-1]["budget"]["pulses"] == culture.pulses == 2 * PULSES
    events = lines(tmp_path / "live")
    assert [line["what"] for line in events[-2:]] == ["fault", "end"]
    assert [line["what"] for line in events].count("fault") == 1
    assert events[-2]["message"] == "DeviceFailed: gone"
    policies = load_policies(tmp_path / "live" / "policies")
    assert list(policies) == ["p0"]
    assert all(len(policy.learning_curve) for policy in policies.values())


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("error", "message"),
    [(KeyboardInterrupt(), "stopped by a person"), (RuntimeError("no dynamic program"), "RuntimeError: no dynamic")],
)
def test_what_ends_a_run_between_training_and_loop_stops_the_culture_and_is_logged(
    error: BaseException, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    monkeypatch.setattr("animat.live.shadowing.run_policies", fail)
    with FakeCulture() as culture:
        with pytest.raises(type(error)):
            live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=QUICK)
        assert culture.is_stopped
    written = lines(tmp_path / "live")
    assert [line["what"] for line in written[-3:]] == ["trained", "fault" if "Run" in message else "interrupted", "end"]
    assert message in written[-2]["message"]


@pytest.mark.oracle
def test_a_session_of_a_live_run_that_still_runs_is_not_recovered(tmp_path: Path) -> None:
    refused = []

    def meanwhile(culture: FakeCulture, observed: Observed) -> Observed:
        try:
            recover_session(tmp_path / "live" / "session")
        except Mismatch as error:
            refused.append(str(error))
        return observed

    with FakeCulture(fault=meanwhile, at=7) as culture:
        found = live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=QUICK, episodes=1)
    assert found.gap.session.ending.by == "plan"
    assert len(refused) == 1
    assert "another run is at work" in refused[0]
    assert list(recover_session(tmp_path / "live" / "session").ticks) == list(found.gap.session.ticks)


@pytest.mark.oracle
def test_a_closed_loop_that_failed_is_not_reported_as_completed(tmp_path: Path) -> None:
    def fail(culture: FakeCulture, observed: Observed) -> Observed:
        raise DeviceFailed("gone")

    # Three recordings, the pause, and a few ticks.
    with FakeCulture(fault=fail, at=7) as culture:
        found = live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=QUICK, episodes=1)
    assert found.gap.session.ending.by == "culture"
    (event,) = [line for line in lines(tmp_path / "live") if line["what"] == "closed loop"]
    assert (event["ended_by"], event["ended"]) == ("culture", "the culture raised DeviceFailed: gone")


@pytest.mark.oracle
def test_policies_are_kept_while_they_are_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.live.trainers.KEEP_S", 0.0)

    class Looking:
        """A progress at which the program is ended once there are policies: until then nobody asked for them."""

        def update(self, done: float, total: float, note: str = "") -> None:
            if (tmp_path / "live" / "policies" / "p0.safetensors").exists():
                assert not (tmp_path / "live" / ".exchange" / "finish").exists()
                raise KeyboardInterrupt

    with FakeCulture() as culture, pytest.raises(KeyboardInterrupt):
        timetable = Timetable(interval_min=10, duration_min=100_000, speed=1e4)
        live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=timetable, progress=Looking())


@pytest.mark.parametrize("left", ["live.log", "recordings", "policies", "session"])
def test_a_folder_with_an_earlier_live_run_is_refused_in_a_line(left: str, tmp_path: Path) -> None:
    (tmp_path / left).mkdir()
    with pytest.raises(Mismatch) as refused:
        check_plan(ONE, PROTOCOL, tmp_path, QUICK, 1, {})
    assert str(refused.value) == (
        f"{tmp_path}: expected an empty folder for a live run, got one with files; choose another, or see what it "
        f"holds: animat watch {tmp_path}"
    )


@pytest.mark.oracle
def test_a_training_that_fails_ends_the_run_with_its_recordings_kept(tmp_path: Path) -> None:
    impossible = Training(Navigation(), Thresholds(1), policies=1, iterations=600, algorithm=SMALL)
    with FakeCulture() as culture, pytest.MonkeyPatch.context() as patch:
        patch.setattr(Exchange, "publish", lambda *_: None)
        with pytest.raises(AnimatError, match="expected a simulator in the exchange"):
            live(impossible, culture, PROTOCOL, tmp_path / "live", timetable=QUICK)
    assert len(read_recordings([tmp_path / "live" / "recordings"])) == 1


def test_what_cannot_be_is_refused_before_the_first_pulse(tmp_path: Path) -> None:
    with FakeCulture() as culture:
        with pytest.raises(InvalidArgument, match="through neurons"):
            live(Training(Navigation(), None), culture, PROTOCOL, tmp_path / "live")
        for wrong, words in (
            ({"episodes": 0}, "episodes: expected at least 1"),
            ({"patience_s": float("nan")}, "patience_s"),
            ({"pause_s": -1.0}, "pause_s"),
            ({"on_burst": "panic"}, "on_burst"),
        ):
            with pytest.raises(InvalidArgument, match=words):
                live(ONE, culture, PROTOCOL, tmp_path / "live", **wrong)
        with pytest.raises(InvalidArgument, match="interval_min: expected at least"):
            live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=Timetable(interval_min=0.1))
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "something").touch()
        with pytest.raises(Mismatch, match="an empty folder"):
            live(ONE, culture, PROTOCOL, tmp_path / "full")
        for timetable in ({"speed": 0.0}, {"interval_min": -1.0}, {"duration_min": float("nan")}):
            with pytest.raises(InvalidArgument, match=next(iter(timetable))):
                Timetable(**timetable)
        assert culture.delivered == 0
        assert not (tmp_path / "live").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--culture", "cl1", "--speed", "2"], "--speed: expected 1"),
        (["--speed", "0"], "--speed: expected more than 0, got 0"),
        (["--duration-min", "-1"], "--duration-min: expected"),
        (["--interval-min", "0.1"], "--interval-min: expected at least"),
        (["--trials", "0"], "--trials: expected at least 1"),
        (["--pulses", "0"], "--pulses: expected at least 1"),
        (["--episodes", "0"], "--episodes: expected at least 1"),
        (["--policies", "0"], "--policies: expected at least 1, got 0"),
        (["--seed", "-1"], "--seed: expected"),
        (["--culture-seed", "-1"], "--culture-seed: expected 0 or more, got -1"),
        (["--culture", "maxone", "--culture-seed", "2"], "--culture-seed: expected none for --culture maxone, got 2"),
        (["--budget-pulses", "0"], "--budget-pulses: expected at least 1, got 0"),
        (["--patience-s", "nan"], "--patience-s: expected"),
        (["--pause-s", "-1"], "--pause-s: expected"),
        (["--budget-pulses", "-1"], "--budget-pulses: expected"),
        (
            ["--budget-pulses", "2499"],
            "--budget-pulses: 0 of 2499 pulses are spent, and 2500 more were wanted by the first recording: ask for "
            "fewer trials, or give a larger budget",
        ),
        (["--budget-per-electrode", "-1"], "--budget-per-electrode: expected"),
        (
            ["--culture", "replay"],
            "expected the recordings that a replay responds from, and none with another culture, got 0 with",
        ),
        (["--recordings", "x.nwb"], "none with another culture, got 1 with --culture virtual"),
        (["--culture", "cl1", "--recordings", "x.nwb"], "none with another culture, got 1 with --culture cl1"),
        (["--out", "{full}"], "expected an empty folder"),
        (["--out", "{full}/something"], "expected a folder for the live run, got a file"),
    ],
)
def test_what_cannot_be_is_refused_before_a_culture_is_opened(
    more: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def opened(*_: Any, **__: Any) -> Any:
        raise AssertionError("a culture was made")

    monkeypatch.setattr("animat.cultures.kinds.culture_named", opened)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "something").touch()
    assert main(["live", "cartpole", *(word.replace("{full}", "full") for word in more)]) == 1
    assert words in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_an_exchange_gives_the_newest_and_each_only_once(tmp_path: Path) -> None:
    exchange = Exchange(tmp_path / "exchange")
    assert exchange.newest(-1) is None
    simulator = synthetic_simulator()
    for number in (0, 1, 2):
        exchange.publish(number, 10.0 * number, simulator)
    newest = exchange.newest(0)
    assert newest is not None
    assert newest[:2] == (2, 20.0)
    np.testing.assert_array_equal(newest[2].percentiles, simulator.percentiles)
    assert exchange.newest(2) is None
    (exchange.folder / ".000003.simulator.abc.partial.simulator").write_bytes(b"half")
    assert exchange.newest(2) is None
    assert not exchange.is_finished
    exchange.finish()
    assert exchange.is_finished


@pytest.mark.oracle
def test_from_the_command_line_it_says_what_it_did_and_exits_as_the_loop_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cultures = []

    def made(*_: Any, **__: Any) -> FakeCulture:
        # The second one fails in its third tick: after two recordings and the pause.
        fault = {"fault": gone, "at": 5} if cultures else {}
        cultures.append(FakeCulture(**fault))
        return cultures[-1]

    def gone(culture: FakeCulture, observed: Observed) -> Observed:
        raise DeviceFailed("gone")

    monkeypatch.setattr("animat.cultures.kinds.culture_named", made)
    given = ["live", "navigation", "--policies", "2", "--pulses", "1", "--trials", "40", "--speed", "1e6"]
    given += ["--interval-min", "5", "--duration-min", "10", "--episodes", "1", "--json"]
    assert main([*given, "--out", str(tmp_path / "done")]) == 0
    printed = capsys.readouterr().out.splitlines()
    results = json.loads(printed[-1])
    assert printed[0].startswith("2 recordings in 10 min of the culture's clock (")
    assert printed[0].endswith("1 swap of simulators:")
    assert f"{results['iterations']:,} iterations of each policy without a pause" in printed[0]
    assert "policies p0 to p1 after" in printed[1]
    assert "the recording at 5.2 min" in printed[1]
    assert any(line.split()[:1] == ["random"] for line in printed)
    assert results["closed_loop"]["session"]["ended_by"] == "plan"
    assert all(Path(file).is_file() for file in results["recordings"])
    assert results["policies"] == list(load_policies(tmp_path / "done" / "policies"))
    assert (tmp_path / "done" / "session" / "session.nwb").is_file()
    assert not cultures[0].is_open
    # A run that fails in the loop is reported in full too, and is then an error.
    assert main([*given, "--out", str(tmp_path / "failed")]) == 1
    printed_too = capsys.readouterr()
    assert "the session ended before its plan was completed: the culture raised DeviceFailed: gone" in printed_too.err
    assert printed_too.out.startswith("2 recordings in 10 min")


@pytest.mark.oracle
def test_the_command_takes_a_protocol(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Protocol] = []

    def stop(training: Training, culture: Culture, protocol: Protocol, *given: object, **settings: object) -> None:
        asked.append(protocol)
        raise DeviceFailed("enough")

    monkeypatch.setattr("animat.live.shadowing.live", stop)
    slow = tmp_path / "slow.json"
    slow.write_text('{"frequencies_hz": [5, 40], "trials": 30, "patterns": 7}')
    arguments = ["live", "--culture-seed", "1", "--out", str(tmp_path / "live")]
    assert main([*arguments, "--protocol", str(slow)]) == 1
    assert main([*arguments, "--trials", "20", "--pulses", "2"]) == 1
    assert main(arguments) == 1
    first, second, usual = asked
    assert (first.frequencies_hz, first.trials, first.patterns, first.order) == ((5.0, 40.0), 30, 7, "mixed")
    assert (second.trials, second.pulses, second.patterns) == (20, 2, 100)
    assert (usual.order, usual.pulses, usual.trials, len(usual.frequencies_hz)) == ("mixed", 1, 500, 5)
    capsys.readouterr()
    assert main([*arguments, "--protocol", str(slow), "--trials", "20"]) == 1
    assert "--protocol: expected it alone, got --trials too; put them in the file" in capsys.readouterr().err
