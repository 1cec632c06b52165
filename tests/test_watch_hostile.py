"""Whatever a log or a folder contains, the page shows it as plain text or reports in one line why it cannot."""

from __future__ import annotations

import io
import json
import math
import os
import re
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from animat.closed_loop.log import read_log
from animat.closed_loop.session import LOG_FILE
from animat.errors import AnimatError
from animat.training.policy import CURVE
from animat.watch.discovery import find
from animat.watch.live import LiveView
from animat.watch.session import SessionView
from animat.watch.study import StudyView
from animat.watch.training import TrainingView
from animat.watch.tuning import TuningView
from animat.watch.view import View
from animat.writing import exclusive_lock
from watching import session_in

HOSTILE = (
    "<script>alert(1)</script>",
    "</title><img src=x onerror=alert(1)>",
    "\ud800\x00\u202e",
    "../../etc/passwd",
    "a" * 5000,
)


def anything(draw: Random) -> Any:
    """A value that a damaged file may contain in place of any other."""
    number = draw.choice([0, -1, 3, 10**30, -(10**30), 1e300, 1e-320, 0.5, math.nan, math.inf, -math.inf])
    return draw.choice(
        [None, True, False, number, draw.choice(HOSTILE), [], {}, [number, None], {"a": number}, [[number]]]
    )


def seeds(n: int) -> Any:
    """This many cases, each with its own random numbers."""
    checks = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]

    def with_seeds(test: Any) -> Any:
        return settings(max_examples=n, deadline=None, suppress_health_check=checks)(
            given(seed=st.integers(0, 2**32))(test)
        )

    return with_seeds


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole")
    session_in(path, episodes=1)
    return path


@pytest.fixture(scope="module")
def records(folder: Path) -> list[Any]:
    """The words of each record, the header's first, and its spikes."""
    log = read_log(folder / LOG_FILE)
    return [(log.header, b"", 0), *((r.fields, _spikes(r), len(r.spike_times_s)) for r in log)]


def _spikes(record: Any) -> bytes:
    return record.spike_times_s.astype("<f8").tobytes() + record.spike_channels.astype("<i4").tobytes()


def written(path: Path, records: list[Any]) -> None:
    data = b"ANIMATL1"
    for words, spikes, n in records:
        body = json.dumps(words).encode() + spikes
        data += struct.pack("<4sIII", b"REC1", len(body) - len(spikes), n, zlib.crc32(body)) + body
    path.write_bytes(data)


def places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Places where something else could be."""
    inner = value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    return [at, *(place for name, each in inner for place in places(each, (*at, name)))]


def changed(value: Any, place: tuple[Any, ...], other: Any) -> Any:
    if not place:
        return other
    value = dict(value) if isinstance(value, dict) else list(value)
    value[place[0]] = changed(value[place[0]], place[1:], other)
    return value


def looked_at(folder: Path) -> None:
    """Every view of a session gives plain finite text, or a line that names the file."""
    view = SessionView(folder)
    try:
        contents = [view.about(), *(view.view(to_s, 30.0) for to_s in (None, 0.5, -1.0))]
        json.dumps(contents, allow_nan=False).encode()
        picture = contents[1]["picture"]
        drawn = None if picture is None else view.picture(picture)
        assert drawn is None or drawn.startswith(b"\x89PNG")
    except AnimatError as error:
        assert LOG_FILE in str(error)
    finally:
        view.close()


@pytest.mark.oracle
@seeds(120)
def test_records_with_anything_in_them(records: list[Any], tmp_path: Path, seed: int) -> None:
    draw = Random(seed)
    number = draw.choice([0, draw.randrange(len(records))])
    words, spikes, n = records[number]
    for _ in range(draw.randint(1, 3)):
        words = changed(words, draw.choice(places(words)), anything(draw))
    written(tmp_path / LOG_FILE, [*records[:number], (words, spikes, n), *records[number + 1 :]])
    looked_at(tmp_path)


@pytest.mark.oracle
@seeds(100)
def test_logs_with_damaged_bytes(folder: Path, tmp_path: Path, seed: int) -> None:
    draw = Random(seed)
    log = bytearray((folder / LOG_FILE).read_bytes())
    for _ in range(draw.randint(0, 4)):
        log[draw.randrange(len(log))] = draw.randrange(256)
    (tmp_path / LOG_FILE).write_bytes(log[: draw.randint(0, len(log))] + draw.randbytes(draw.choice([0, 7, 40])))
    looked_at(tmp_path)


@seeds(40)
def test_impossible_spikes(records: list[Any], tmp_path: Path, seed: int) -> None:
    draw = Random(seed)
    number, n = draw.randrange(1, len(records)), draw.randint(0, 5)
    spikes = draw.randbytes(12 * n)
    written(tmp_path / LOG_FILE, [*records[:number], (records[number][0], spikes, n), *records[number + 1 :]])
    looked_at(tmp_path)


TRAINING = {
    "training": {
        "policies": 2, "iterations": 1000, "duration_min": 10.0, "shadowing": True, "mapping": "9-thresholds",
        "robot": {"name": "cartpole"}, "algorithm": {"discount": 0.9},
    },
    "simulators": {"recorded_at_min": [0.0, 5.0]},
}  # fmt: skip
STUDY = {"study": {"robots": [{"name": "cartpole"}]}, "fingerprint": "x"}
TUNING = {"tune": {"trials": 5}, "study": {"robots": [{"name": "cartpole"}]}}
TRIAL = {"trial": 0, "settings": {"discount": 0.9}, "state": "complete", "chunks": [7], "returns": [[1.0, 2.0]]}

LIVE = (
    {"culture_min": 0.2, "what": "begun", "robot": "cartpole", "policies": 2, "duration_min": 30.0},
    {"culture_min": 0.4, "what": "recording", "file": "a.nwb", "budget": {"pulses": 9, "of": None}},
    {"culture_min": 10.4, "what": "swap", "members": [0, 1], "iterations": 300, "recorded_at_min": 10.2},
    {"culture_min": 30.4, "what": "closed loop", "ended": "all episodes were run"},
    {"culture_min": 30.4, "what": "end", "budget": {"pulses": 10}},
)  # fmt: skip


@seeds(60)
def test_folders_with_anything_in_them(tmp_path: Path, seed: int) -> None:
    draw = Random(seed)
    kind, name, words = draw.choice(
        [
            (TrainingView, "training.json", TRAINING),
            (StudyView, "study.json", STUDY),
            (TuningView, "tune.json", TUNING),
            (LiveView, "live.log", LIVE[0]),
        ]
    )
    (tmp_path / name).write_text(json.dumps(changed(words, draw.choice(places(words)), anything(draw))))
    trial = changed(TRIAL, draw.choice(places(TRIAL)), anything(draw))
    (tmp_path / "journal.jsonl").write_text(json.dumps(trial) + "\nno JSON\n")
    notices = tmp_path / ".unfinished" / ".notices"
    notices.mkdir(parents=True, exist_ok=True)
    (notices / "p0 to p1.json").write_text(json.dumps([anything(draw), anything(draw)]))
    for file in (".unfinished/from-p0.npz", "p0.safetensors", "jobs/x.json"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(draw.randbytes(draw.choice([0, 9, 60])))
    costs = {name: anything(draw) for name in ("x", *HOSTILE[:2])}
    (tmp_path / ".unfinished" / ".planned.json").write_text(json.dumps(draw.choice([costs, anything(draw)])))
    view = kind(tmp_path)
    try:
        json.dumps([view.about(), view.view(None, 8.0)], allow_nan=False).encode()
    except AnimatError as error:
        assert name in str(error)


EVALUATION = {"rows": [{"name": "random", "mean_return": 2.5}], "optimum": {"value": 50.0}, "recorded_at_min": 5.0}
ROW = {"name": "policies", "mean_return": 61.5, "actors": 4, "episodes": 400}
FINAL = {"trial": 1, "mean_return": 6.25, "standard_error": 0.5, "settings": {"batch": 64}}


@pytest.mark.parametrize(
    ("kind", "marker", "description", "file", "words"),
    [
        (TrainingView, "training.json", TRAINING, "evaluation.json", EVALUATION),
        (TrainingView, "training.json", TRAINING, ".unfinished/.notices/p0.json", [0.5, "return 3"]),
        (StudyView, "study.json", STUDY, ".unfinished/.planned.json", {"a": 1.0, "b": 2.0}),
        (StudyView, "study.json", STUDY, ".unfinished/.notices/b.json", [0.5, "return 3"]),
        (StudyView, "study.json", STUDY, "jobs/a.json", {"job": "a", "outputs": {"file": "x"}}),
        (StudyView, "study.json", STUDY, "culture-2/shuttle/simulated.json", {"rows": [ROW]}),
        (TuningView, "tune.json", TUNING, "journal.jsonl", TRIAL),
        (TuningView, "tune.json", TUNING, "results.json", {"finals": [FINAL, FINAL | {"mean_return": None}]}),
    ],
)
def test_a_strange_file_costs_no_more_than_its_own_panel(
    kind: type[View], marker: str, description: Any, file: str, words: Any, tmp_path: Path
) -> None:
    (tmp_path / marker).write_text(json.dumps(description))
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text(json.dumps(words))
    first, *_ = kind(tmp_path).view(None, 8.0)["blocks"]
    for place in places(words):
        for strange in (None, True, -1, 10**400, 1e300, math.nan, math.inf, *HOSTILE[:3], [], {}, [1, None], {"a": 1}):
            (tmp_path / file).write_text(json.dumps(changed(words, place, strange)))
            found = kind(tmp_path).view(None, 8.0)
            json.dumps(found, allow_nan=False).encode()
            assert found["blocks"][0]["title"] == first["title"] and len(found["blocks"]) > 2


def test_a_strange_line_costs_no_more_than_itself_in_a_live_run(tmp_path: Path) -> None:
    for number, event in enumerate(LIVE):
        for place in places(event)[1:]:
            for strange in (None, True, -1, 10**400, 1e300, math.nan, math.inf, *HOSTILE[:3], [], {}, [1, None]):
                lines = [json.dumps(each) for each in LIVE]
                lines[number] = json.dumps(changed(event, place, strange))
                (tmp_path / "live.log").write_text("\n".join([*lines, "no JSON", "[]", '{"what": "tru']))
                found = LiveView(tmp_path).view(None, 8.0)
                json.dumps(found, allow_nan=False).encode()
                assert len(found["blocks"]) == 6 and len(found["blocks"][-1]["rows"]) >= len(LIVE) - 1


def test_where_locks_are_unknown_a_live_run_runs_while_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.watch.discovery._LOCKS", tmp_path / "none")
    (tmp_path / "live.log").write_text(json.dumps(LIVE[0]) + "\n")
    for seconds_ago, state in ((1000, "silent"), (0, "running")):
        then = time.time() - seconds_ago
        os.utime(tmp_path / "live.log", (then, then))
        os.utime(tmp_path, (then - 1000, then - 1000))
        assert LiveView(tmp_path).view(None, 8.0)["state"] == state


@pytest.mark.oracle
@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_a_pipe_or_a_link_in_place_of_a_file_is_left_out(kind: str, tmp_path: Path) -> None:
    files = ("p0.safetensors", ".unfinished/from-p0.npz", "evaluation.json", "journal.jsonl")
    (folder := tmp_path / "watched").mkdir()
    (folder / ".unfinished").mkdir()
    for file in files:
        if kind == "pipe":
            os.mkfifo(folder / file)
        else:
            (elsewhere := tmp_path / Path(file).name).write_bytes(_content(file))
            (folder / file).symlink_to(elsewhere)
    # A process of its own: a reader that waits for a pipe may hold the whole interpreter, and no test would end it.
    words = {"training.json": json.dumps(TRAINING), "tune.json": json.dumps(TUNING)}
    for name, description in words.items():
        (folder / name).write_text(description)
    code = (
        "import json, sys, pathlib, animat.watch.training as a, animat.watch.tuning as b\n"
        "folder = pathlib.Path(sys.argv[1])\n"
        "print(json.dumps([view(folder).view(None, 8.0) for view in (a.TrainingView, b.TuningView)]))"
    )
    shown = subprocess.run([sys.executable, "-c", code, folder], capture_output=True, text=True, timeout=60, check=True)
    training, tuning = json.loads(shown.stdout)
    facts = dict(training["blocks"][0]["rows"])
    assert "0 are done" in facts["policies"] and facts["done"] == "0 % of all"
    assert "61.5" not in shown.stdout and dict(tuning["blocks"][0]["rows"])["trials done"] == "0 of 5"


def _content(file: str) -> bytes:
    """What each file would show."""
    curve, content = np.full((60, len(CURVE)), 61.5, np.float32), io.BytesIO()
    if file.endswith(".safetensors"):
        return bytes(save({"learning_curve": curve}))
    if file.endswith(".npz"):
        np.savez(content, curve=curve[:, None], members=np.array([0]))
        return content.getvalue()
    return json.dumps(TRIAL if file.endswith("l") else EVALUATION | {"optimum": {"value": 61.5}}).encode()


def test_a_study_that_names_code_imports_none_of_it(tmp_path: Path) -> None:
    (tmp_path / "study.json").write_text(json.dumps(STUDY))
    (tmp_path / "study.toml").write_text('[[robots]]\nname = "mine"\nkind = "not_to_be_imported:Rover"\n')
    StudyView(tmp_path).view(None, 8.0)
    assert "not_to_be_imported" not in sys.modules


def test_the_time_left_for_trials_that_end_many_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten in ten minutes, of forty: after twenty, half an hour at the most."""
    now_s = [0.0]
    monkeypatch.setattr("animat.progress.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    (tmp_path / "tune.json").write_text(json.dumps({**TUNING, "tune": {"trials": 40}}))
    trials = [json.dumps({**TRIAL, "trial": number}) + "\n" for number in range(20)]
    with exclusive_lock(tmp_path):
        view, left = TuningView(tmp_path), ""
        for second in range(0, 1500, 5):
            now_s[0] = float(second)
            (tmp_path / "journal.jsonl").write_text("".join(trials[: second // 600 * 10]))
            left = dict(view.view(None, 8.0)["blocks"][0]["rows"])["time left for the trials"]
    assert re.fullmatch(r"1\d min|2\d min", left), left


def test_a_folder_that_cannot_be_read_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("open", "private"):
        (tmp_path / name).mkdir()
        (tmp_path / name / LOG_FILE).touch()
    is_file = Path.is_file

    def denied(self: Path) -> bool:
        if self.parent.name == "private":
            raise PermissionError(13, "Permission denied", str(self))
        return is_file(self)

    monkeypatch.setattr(Path, "is_file", denied)
    assert [item.place for item in find(tmp_path)] == ["open"]
