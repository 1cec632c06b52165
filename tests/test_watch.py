"""The page's view of a session: its numbers are those of the log and of ticks.csv, while it grows and afterwards."""

from __future__ import annotations

import base64
import csv
import io
import itertools
import json
import math
import os
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest
from PIL import Image

from animat.closed_loop.log import LogRecord, LogWriter, read_log
from animat.closed_loop.session import LOG_FILE, read_session
from animat.closed_loop.tick import STOP_FILE
from animat.errors import InvalidArgument, InvalidFile
from animat.progress import format_duration
from animat.robots import Navigation
from animat.robots.drawing import draw_robot
from animat.watch.discovery import find
from animat.watch.session import SessionView, _in_force, stop_session
from animat.watch.tail import Tail, by_agent
from watching import session_in


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("watched")
    assert session_in(path).ending.by == "plan"
    return path


def whole(view: SessionView, **asked: Any) -> dict[str, Any]:
    """The view when everything is counted."""
    while True:
        found = view.view(asked.get("to_s"), asked.get("span_s", 60.0))
        if found["summed"] == 1 and found["is_found"]:
            return found


def test_the_numbers_of_the_page_are_those_of_the_table(folder: Path) -> None:
    view = SessionView(folder)
    about, found = view.about(), whole(SessionView(folder))
    ticks = found["ticks"]
    with (folder / "ticks.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(ticks["number"]) == found["n_ticks"] > 20
    for i, row in enumerate(rows):
        assert ticks["number"][i] == int(row["tick"])
        assert ticks["agent"][i] == row["agent"]
        assert about["conditions"][ticks["delivered"][i]] == row["delivered"]
        assert [float(each) for each in row["pulse_times_s"].split()] == ticks["pulse_time_s"][i]
        for name in ("time_s", "rate_hz", "late_s", "decided_s"):
            assert ticks[name][i] == float(row[name])
        assert ticks["command"][i] == ([float(row["command"])] if row["command"] else [])
        assert ticks["reward"][i] == (float(row["reward"]) if row["reward"] else None)
        observed = [row[name] for name in about["observed"]]
        assert ticks["observation"][i] == ([float(each) for each in observed] if observed[0] else [])
        earlier = [row["reward"] for row in rows[: i + 1] if row["episode"] == rows[i]["episode"]]
        assert ticks["total"][i] == sum(float(reward) for reward in earlier if reward)
    assert (found["state"], found["damage"], found["strange"], found["n_faults"]) == ("ended", "", 0, 0)


def test_thresholds_from_before_the_span_are_shown(folder: Path, tmp_path: Path) -> None:
    log = read_log(folder / LOG_FILE)
    writer, end_s, adapted = LogWriter(tmp_path / LOG_FILE, log.header), 0.0, []
    for record in log:
        fields = record.fields
        if fields["kind"] == "seen":
            end_s = fields["start_s"] + fields["duration_s"]
        if fields.get("tick"):
            adapted.append((end_s, [float(len(adapted))] * 11))
            fields = {**fields, "percentiles_hz": adapted[-1][1]}
        writer.append(record._replace(fields=fields))
    writer.close()
    found = whole(SessionView(tmp_path), span_s=0.1)
    assert found["percentiles"] == adapted
    assert adapted[0][0] < found["from_s"]


def test_the_picture_shows_the_robot_with_the_path_of_its_episode(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = []

    def drawn(*shown: Any, command: Any, **more: Any) -> Any:
        commands.append(command)
        return draw_robot(*shown, command=command, **more)

    monkeypatch.setattr("animat.watch.session.draw_robot", drawn)
    view = SessionView(folder)
    ticks = whole(view)["ticks"]
    rows = [i for i, observation in enumerate(ticks["observation"]) if observation]
    # The second episode, up to its fourth iteration.
    own = [i for i in rows if ticks["episode"][i] == ticks["episode"][rows[0]] + 1][:4]
    *earlier, now = (np.array(ticks["observation"][i]) for i in own)
    command = float(np.ravel(ticks["command"][own[-1]] or 0.0)[0])
    expected = draw_robot(Navigation(episode_limit=6), now, command=command, earlier=earlier)
    picture = view.picture(view.view(ticks["time_s"][own[-1]], 1.0)["picture"])
    assert picture is not None and len(own) == 4
    assert commands == [command] and command
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")), expected)


def test_episodes_that_are_all_alike_have_no_interval(folder: Path) -> None:
    episodes = read_session(folder).episodes
    alike = [replace(episode, total=120.0) for episode in episodes]
    assert {agent["half"] for agent in by_agent([], alike, {})} == {None}
    assert None not in {agent["half"] for agent in by_agent([], episodes, {})}


def test_totals_are_those_of_the_session(folder: Path) -> None:
    found, session = whole(SessionView(folder)), read_session(folder)
    outline = session.outline
    assert (found["pulses"], found["bursts"], found["late"]) == (outline.pulses, outline.bursts, outline.late)
    assert found["episodes_done"] == 4
    for agent in found["agents"]:
        returns = [each.total for each in session.episodes if each.agent == agent["name"]]
        assert agent["returns"] == returns
        assert agent["mean"] == pytest.approx(fmean(returns))
        # Student's 97.5 % quantile with one degree of freedom.
        assert agent["half"] == pytest.approx(12.7062 * np.std(returns, ddof=1) / math.sqrt(2), rel=1e-4)
    spikes = sum(len(record.spike_times_s) for record in session.log)
    assert found["spikes"]["n"] == sum(found["counts"]) == spikes
    seen = [record.fields for record in session.log if record.fields["kind"] == "seen"]
    on = [electrode for words in seen for row in words["stimuli"] for electrode in row[3]]
    assert found["fullest"] == [found["fullest"][0], max(on.count(e) for e in on)]
    assert on.count(int(found["fullest"][0])) == found["fullest"][1]


def test_spikes_are_those_of_the_log(folder: Path) -> None:
    recording = read_session(folder).recording()
    to_s = 0.6 * recording.duration_s
    found = SessionView(folder).view(to_s, 1.0)
    times, channels = (np.frombuffer(base64.b64decode(found["spikes"][name]), "<u2") for name in ("times", "channels"))
    within = (recording.spike_times_s >= found["from_s"]) & (recording.spike_times_s <= to_s)
    there = sorted(zip(recording.spike_times_s[within], recording.spike_channels[within], strict=True))
    ours = sorted(zip(found["from_s"] + times / 65535, channels.tolist(), strict=True))
    assert len(there) == len(ours) > 10
    np.testing.assert_allclose([t for t, _ in ours], [t for t, _ in there], atol=2e-5)
    assert sorted(c for _, c in ours) == sorted(c for _, c in there)


def test_a_span_in_the_past_has_the_ticks_of_that_time(folder: Path) -> None:
    view = SessionView(folder)
    every = whole(view)
    times = every["ticks"]["time_s"]
    for to_s in np.linspace(0.3, every["end_s"], 17).tolist():
        found = view.view(to_s, 0.7)
        # A tick is that of the stretch in which it was read; what it began before the span is in it, too.
        expected = [n for n, t in zip(every["ticks"]["number"], times, strict=True) if to_s - 0.7 <= t <= to_s]
        assert set(expected) <= set(found["ticks"]["number"])
        assert all(each <= to_s for each in found["ticks"]["time_s"])


def test_no_time_before_the_session_counts_in_its_rates(folder: Path) -> None:
    found = SessionView(folder).view(0.5, 8.0)
    assert (found["from_s"], found["to_s"]) == (0.0, 0.5)
    spikes = np.concatenate([record.spike_times_s for record in read_session(folder).log])
    assert sum(found["counts"]) == np.count_nonzero(spikes <= 0.5) > 0
    assert SessionView(folder).view(-3.0, 8.0)["to_s"] == 0.0


def test_a_log_is_followed_while_it_grows(folder: Path, tmp_path: Path) -> None:
    log = read_log(folder / LOG_FILE)
    view = SessionView(tmp_path)
    with pytest.raises(InvalidFile, match="cannot be read"):
        view.about()
    writer = LogWriter(tmp_path / LOG_FILE, log.header)
    writer.append(LogRecord({"kind": "event", "what": "culture", "message": "gone", "asked_at_s": 1.5}))
    ticks, end_s, moved_at = 0, 0.0, None
    for number, record in enumerate(log):
        fields = record.fields
        if fields.get("tick"):
            ticks += 1
            moved_at = moved_at or (None if fields["tick"]["handled"] == "warm-up" else ticks)
            fields = {**fields, "tick": {**fields["tick"], "wall_s": 10_000.0 + 60 * ticks}}
        writer.append(record._replace(fields=fields))
        if fields["kind"] == "seen":
            end_s = fields["start_s"] + fields["duration_s"]
        if number % 7 == 0:
            found = whole(view)
            assert (found["n_ticks"], found["end_s"]) == (ticks, end_s)
            assert (found["n_faults"], found["faults"]) == (1, [(1.5, "culture: gone")])
            done = found["episodes_done"]
            assert sum(agent["n"] for agent in found["agents"]) == done
            if done and found["state"] == "running":
                left_s = 60 * (ticks - moved_at) * (4 - done) / done
                assert found["time_left"] == format_duration(left_s)
            assert not found["damage"]
            assert found["state"] == ("running" if record.fields["kind"] != "end" else "ended")
    writer.close()
    found, other = whole(view), whole(SessionView(folder))
    for name in ("ticks", "counts", "agents", "percentiles", "pulses", "end_s"):
        assert found[name] == other[name]


def test_a_record_that_is_just_being_written_is_waited_for(folder: Path, tmp_path: Path) -> None:
    log = (folder / LOG_FILE).read_bytes()
    view, shown = SessionView(tmp_path), []
    places = [0, *range(len(log) // 2, len(log) // 2 + 3000, 211)]
    for first, last in itertools.pairwise(places):
        with (tmp_path / LOG_FILE).open("ab") as file:
            file.write(log[first:last])
        found = whole(view)
        shown.append(found["n_ticks"])
        assert not found["damage"]
    assert shown == sorted(shown)
    assert shown[-1] > shown[0] > 0
    assert view.tail.generation == 0


def test_a_killed_session_is_reported(folder: Path, tmp_path: Path) -> None:
    (tmp_path / LOG_FILE).write_bytes((folder / LOG_FILE).read_bytes()[:-400])
    old_s = time.time() - 100
    os.utime(tmp_path / LOG_FILE, (old_s, old_s))
    found = whole(SessionView(tmp_path))
    assert found["state"] == "silent"
    assert "it was killed, or it hangs" in found["message"]
    assert "of a truncated one" in found["damage"]


def test_what_follows_damage_is_not_shown(folder: Path, tmp_path: Path) -> None:
    log = bytearray((folder / LOG_FILE).read_bytes())
    log[len(log) // 2] ^= 0xFF
    (tmp_path / LOG_FILE).write_bytes(log)
    old_s = time.time() - 100
    os.utime(tmp_path / LOG_FILE, (old_s, old_s))
    view = SessionView(tmp_path)
    found, left = whole(view), read_session(tmp_path)
    assert found["n_ticks"] == left.outline.ticks == whole(view)["n_ticks"]
    assert "damaged" in found["damage"]


def test_a_replaced_log_is_read_from_the_start(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / LOG_FILE
    path.write_bytes((folder / LOG_FILE).read_bytes())
    view = SessionView(tmp_path)
    first = whole(view)
    path.unlink()
    writer = LogWriter(path, {**read_log(folder / LOG_FILE).header, "culture": "another"})
    writer.close()
    second = whole(view)
    assert (first["n_ticks"] > 0, second["n_ticks"]) == (True, 0)
    assert second["generation"] == first["generation"] + 1
    assert "another" in view.about()["title"]


def test_predicted_returns_are_shown_with_the_measured_ones(folder: Path, tmp_path: Path) -> None:
    log = read_log(folder / LOG_FILE)

    def shown(predicted: Any) -> dict[str, Any]:
        writer = LogWriter(tmp_path / LOG_FILE, {**log.header, "predicted": predicted})
        for record in log:
            writer.append(record)
        writer.close()
        agents = whole(SessionView(tmp_path))["agents"]
        (tmp_path / LOG_FILE).unlink()
        return {each["name"]: each["predicted"] for each in agents}

    assert shown({"random": {"mean": 1.5, "low": 1.0, "high": 2.25}}) == {"random": [1.5, 1.0, 2.25], "silent": None}
    for none in ([], {"random": [1.5, 1.0, 2.25]}, {"random": {"mean": 1.5, "low": "1"}}):
        assert shown(none) == {"random": None, "silent": None}
    # As without.
    assert {each["predicted"] for each in whole(SessionView(folder))["agents"]} == {None}


def test_stop_makes_the_file_that_the_loop_looks_for(folder: Path, tmp_path: Path) -> None:
    log = read_log(folder / LOG_FILE)
    LogWriter(tmp_path / LOG_FILE, log.header).close()
    view = SessionView(tmp_path)
    stop_session(tmp_path)
    assert (tmp_path / STOP_FILE).is_file()
    assert whole(view)["stop"]
    with pytest.raises(InvalidArgument, match="has ended"):
        stop_session(folder)
    assert not (folder / STOP_FILE).exists()


def test_stop_does_not_follow_a_link(folder: Path, tmp_path: Path) -> None:
    LogWriter(tmp_path / "in" / LOG_FILE, read_log(folder / LOG_FILE).header).close()
    (tmp_path / "in" / STOP_FILE).symlink_to(tmp_path / "outside")
    with pytest.raises(InvalidFile, match="STOP: cannot be created"):
        stop_session(tmp_path / "in")
    assert not (tmp_path / "outside").exists()


def test_a_log_that_is_a_link_is_not_followed(folder: Path, tmp_path: Path) -> None:
    (tmp_path / LOG_FILE).symlink_to(folder / LOG_FILE)
    with pytest.raises(InvalidFile, match="cannot be read"):
        SessionView(tmp_path).about()


def test_records_are_found_a_slice_at_a_time(folder: Path, tmp_path: Path) -> None:
    log = read_log(folder / LOG_FILE)
    writer = LogWriter(tmp_path / LOG_FILE, log.header)
    for _ in range(3000):
        writer.append(LogRecord({"kind": "nothing"}))
    writer.close()
    tail, looks = Tail(tmp_path / LOG_FILE), 1
    while not tail.grow(0.0):
        looks += 1
    assert len(tail) == 3001
    assert looks > 3
    tail.close()


def test_a_log_that_is_copied_into_its_full_length_is_read_as_far_as_it_has_come(folder: Path, tmp_path: Path) -> None:
    log = (folder / LOG_FILE).read_bytes()
    copy = tmp_path / LOG_FILE
    copy.write_bytes(log[:20_000] + bytes(len(log) - 20_000))
    tail = Tail(copy)
    assert tail.grow(10.0)
    assert "damaged" in tail.damage
    so_far = len(tail)
    copy.write_bytes(log)
    assert tail.grow(10.0)
    assert tail.damage == ""
    assert 0 < so_far < len(tail)
    tail.close()


def test_a_length_beyond_all_records_is_damage_and_is_not_read(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = read_log(folder / LOG_FILE)
    writer = LogWriter(tmp_path / LOG_FILE, log.header)
    writer.append(LogRecord({"kind": "nothing", "text": "x" * 100_000}))
    writer.close()
    monkeypatch.setattr("animat.watch.tail._MOST_BYTES", 90_000)
    tail = Tail(tmp_path / LOG_FILE)
    assert tail.grow(10.0)
    assert (len(tail), "damaged" in tail.damage) == (1, True)
    tail.close()


def test_a_view_is_plain_finite_json(folder: Path) -> None:
    view = SessionView(folder)
    for found in (view.about(), whole(view), view.view(0.0, 1.0)):
        json.dumps(found, allow_nan=False)
    with pytest.raises(InvalidArgument, match="span"):
        view.view(None, 1e6)


@pytest.mark.parametrize("n", [0, 1, 400, 401, 5_000])
def test_thousands_of_thresholds_are_thinned_except_in_the_span(n: int) -> None:
    rows: list[tuple[float, list[float | None]]] = [(float(at), [1.0]) for at in range(n)]
    thinned = _in_force(rows, [])
    steps = {later[0] - earlier[0] for earlier, later in itertools.pairwise(thinned[:-1])}
    assert len(steps) <= 1
    assert len(thinned) <= 400 and thinned[:1] == rows[:1] and thinned[-1:] == rows[-1:]
    shown = rows[n // 2 : n // 2 + 50]
    both = _in_force(rows, shown)
    assert both == sorted(both) and [row for row in both if row in shown] == shown
    assert {row[0] for row in both} == {row[0] for row in (*thinned, *shown)}


def test_a_training_is_found_whatever_its_folder_is_called(tmp_path: Path) -> None:
    for name in ("checkpoints", "jobs", "jobs/jobs"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "training.json").write_text("{}")
    # In a training there are no others.
    assert {item.place for item in find(tmp_path)} == {"checkpoints", "jobs"}


def test_the_trainings_of_studies_are_found_in_the_folder_above(tmp_path: Path) -> None:
    (tmp_path / "studies" / "culture-1" / "policies" / "cartpole" / "linear").mkdir(parents=True)
    places = {"studies": "cultures.json", "studies/culture-1": "study.json"}
    places["studies/culture-1/policies/cartpole/linear"] = "training.json"
    for place, name in places.items():
        (tmp_path / place / name).write_text("{}")
    assert {item.place for item in find(tmp_path)} == set(places)
