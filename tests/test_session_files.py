"""A session's files are the same however they come about, in memory that does not grow with it, or refused by name."""

from __future__ import annotations

import csv
import json
import math
import struct
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from animat.cli import main
from animat.closed_loop.agents import Agent, OneCondition
from animat.closed_loop.log import LogRecord, LogWriter, read_log
from animat.closed_loop.running import run_session
from animat.closed_loop.session import LOG_FILE, Session, read_session, recover_session
from animat.cultures.budget import Account, Budget
from animat.errors import InvalidArgument, InvalidFile, UnusableData
from animat.evaluation.statistics import Interval
from animat.recordings.formats.hdf5_formats import read_hdf5
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.formats.nwb_spikes import SpikeCounts
from animat.recordings.reading import read_recording
from animat.recordings.recording import Channels, Recording
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import PUBLISHED_PULSE, Phase, Pulse
from animat.stimulation.stimulus import Stimuli
from fake_culture import FakeCulture
from test_closed_loop import RANDOM, loop_of


def test_the_recording_states_its_pulse(tmp_path: Path) -> None:
    pulse = Pulse((Phase(400.0, amplitude_mv=-90.0), Phase(400.0, amplitude_mv=90.0)))
    session = ran(tmp_path / "s", pulse=pulse)
    read = read_recording(session.recording_file)
    assert read.pulse == pulse == session.recording().pulse and read.protocol is None
    write_nwb(read, tmp_path / "again.nwb")
    assert read_recording(tmp_path / "again.nwb").equals(read)
    # The protocol, where there is one, is what was delivered.
    assert replace(read, protocol=Protocol(pulse=PUBLISHED_PULSE)).pulse == PUBLISHED_PULSE
    assert replace(read, loop_pulse=None).pulse is None
    wrong = replace(read, provenance={**read.provenance, "closed_loop_pulse": "[]"})
    with pytest.raises(InvalidArgument, match="closed_loop_pulse"):
        write_nwb(wrong, tmp_path / "wrong.nwb")


@pytest.mark.oracle
def test_what_was_predicted_and_measured_is_recovered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    predicted = {"random": Interval(-1.25, -2.0, 3.0)}
    with FakeCulture(3) as culture:
        agents, loop = [RANDOM, Agent("silent", "", OneCondition(0), "silent")], loop_of()
        account = Account(Budget(pulses=152))
        session = run_session(culture, loop, agents, tmp_path / "s", episodes=30, account=account, predicted=predicted)
    session.recording_file.unlink()
    assert main(["recover", str(tmp_path / "s"), "--json"]) == 0
    *_, head, random, silent, line = capsys.readouterr().out.splitlines()
    whole = {
        name: [e.total for e in session.episodes if e.agent == name and e.is_whole] for name in ("random", "silent")
    }
    summary = json.loads(line)
    assert summary["whole_episodes"] == sum(map(len, whole.values())) < summary["episodes"]
    mean = f"{np.mean(whole['random']):.1f}"
    assert random.split() == ["random", "-1.2", "-2.0", "to", "3.0", mean, str(len(whole["random"]))]
    assert silent.split() == ["silent", "-", f"{np.mean(whole['silent']):.1f}", str(len(whole["silent"]))]
    assert head.split()[0] == "predicted" and [each["name"] for each in summary["agents"]] == ["random", "silent"]
    assert [each["mean"] for each in summary["agents"]] == pytest.approx([np.mean(of) for of in whole.values()])


def ran(folder: Path, **changed: Any) -> Session:
    silent = Agent("silent", "", OneCondition(0), "silent")
    with FakeCulture(3) as culture:
        return run_session(culture, loop_of(**changed), [RANDOM, silent], folder, episodes=3)


def with_header(folder: Path, header: Any, records: bytes) -> Path:
    """A session's log whose first record is another, in a folder of its own."""
    body = json.dumps(header).encode()
    folder.mkdir(exist_ok=True)
    head = struct.pack("<4sIII", b"REC1", len(body), 0, zlib.crc32(body))
    (folder / LOG_FILE).write_bytes(b"ANIMATL1" + head + body + records)
    return folder


def as_logged(folder: Path) -> dict[str, Any]:
    """Spikes and stimuli of a session, from its log by hand: two electrodes a pulse, times rising."""
    seen = [record for record in read_log(folder / LOG_FILE) if record.fields["kind"] == "seen"]
    # A file has them channel by channel: spikes of one time are read in the order of their channels.
    spikes = sorted(pair for record in seen for pair in zip(record.spike_times_s, record.spike_channels, strict=True))
    columns = zip(*(row for record in seen for row in record.fields["stimuli"]), strict=True)
    return {
        "spike_times_s": [time_s for time_s, _ in spikes],
        "spike_channels": [channel for _, channel in spikes],
        "time_s": [s for record in seen if record.fields["tick"] for s in record.fields["tick"]["pulse_time_s"]],
        **dict(zip(("frequency_hz", "pattern", "presentation", "electrodes"), columns, strict=True)),
    }


def test_a_killed_session_is_recovered_to_the_bits_that_it_would_have_written(tmp_path: Path) -> None:
    session = ran(tmp_path / "whole", pulses=3, warm_up=1, burst_threshold=0.9, on_burst="repeat")
    killed = tmp_path / "killed"
    killed.mkdir()
    (killed / LOG_FILE).write_bytes((tmp_path / "whole" / LOG_FILE).read_bytes())
    leftovers = [killed / ".ticks.csv.abcdefgh.partial.csv", killed / ".session.nwb.abcdefgh.partial.nwb"]
    # Another program's file, and what an editor keeps of a table that is open in it.
    others = [killed / ".notes.csv.abcdefgh.partial.csv", killed / ".ticks.csv.swp"]
    for leftover in (*leftovers, *others):
        leftover.write_text("half of it")
    recovered = recover_session(killed)
    expected = as_logged(killed)
    recording = read_hdf5(recovered.recording_file)
    np.testing.assert_array_equal(recording.spike_times_s, expected["spike_times_s"])
    np.testing.assert_array_equal(recording.spike_channels, expected["spike_channels"])
    for name in ("time_s", "frequency_hz", "pattern", "electrodes", "presentation"):
        np.testing.assert_array_equal(getattr(recording.stimuli, name), expected[name])
    assert recovered.ticks_file.read_bytes() == session.ticks_file.read_bytes()
    assert read_hdf5(recovered.recording_file).equals(read_hdf5(session.recording_file))
    assert recovered.to_dict() == session.to_dict()
    assert recovered.episodes == session.episodes
    # What the killed program was writing is gone, and nothing else.
    assert [file.exists() for file in (*leftovers, *others)] == [False, False, True, True]


def test_a_damaged_log_is_not_written_over_what_holds_more(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = ran(tmp_path / "session")
    log = tmp_path / "session" / LOG_FILE
    damaged = bytearray(log.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    log.write_bytes(damaged)
    files = session.ticks_file, session.recording_file
    before = [file.read_bytes() for file in files]
    assert main(["recover", str(tmp_path / "session")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "which is damaged after" in line and "away to recover what the log has" in line
    assert [file.read_bytes() for file in files] == before
    for file in files:
        file.unlink()
    assert main(["recover", str(tmp_path / "session")]) == 0
    assert "from where it is torn or damaged, are lost" in capsys.readouterr().out
    assert len(session.ticks_file.read_bytes()) < len(before[0])
    # What was recovered is no less than what the log has: it is recovered again.
    assert main(["recover", str(tmp_path / "session")]) == 0


def test_a_table_that_cannot_be_written_is_made_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from animat.closed_loop.tick import TickTable

    add, rows = TickTable.add, [0]

    def failing(table: TickTable, tick: Any) -> None:
        rows[0] += 1
        if rows[0] == 5:
            raise OSError(28, "No space left on device")
        add(table, tick)

    monkeypatch.setattr(TickTable, "add", failing)
    session = ran(tmp_path)
    assert session.ending.by == "plan"
    assert "ticks.csv: cannot be written: No space left on device" in session.ending.message
    assert "animat recover" in session.ending.message
    assert [file.name for file in tmp_path.iterdir()] == [LOG_FILE]
    recover_session(tmp_path)
    with session.ticks_file.open(newline="") as file:
        assert [int(row["tick"]) for row in csv.DictReader(file)] == [tick.number for tick in session.ticks]
    assert session.recording_file.is_file()


def long_log(folder: Path, ticks: int) -> None:
    """A log of so many ticks, as the loop writes it, with the spikes of all at the same times after each pulse."""
    header = read_log(ran(folder / "short").folder / LOG_FILE).header
    last = next(w for w in read_log(folder / "short" / LOG_FILE).fields() if w["kind"] == "seen" and w["tick"])
    log = LogWriter(folder / "long" / LOG_FILE, header)
    spikes_s, channels = np.linspace(0.001, 0.009, 40), np.arange(40) % 16
    for n in range(ticks):
        tick = last["tick"] | {"number": n, "iteration": n, "pulse_time_s": [n / 64], "read_after_s": n / 64}
        row = [80.0, 3, n, [100, 101, 102]]
        words = last | {"stretch": n, "start_s": n / 64, "duration_s": 0.01, "stimuli": [row], "tick": tick}
        log.append(LogRecord(words, n / 64 + spikes_s, channels))
    log.close()


@pytest.mark.oracle
def test_memory_does_not_grow_with_the_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.closed_loop.log._BLOCK_SPIKES", 5_000)
    peaks = {}
    for ticks in (500, 3_000):
        long_log(tmp_path / str(ticks), ticks)
        tracemalloc.start()
        recover_session(tmp_path / str(ticks) / "long")
        peaks[ticks] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    recording = read_hdf5(tmp_path / "3000" / "long" / "session.nwb")
    assert (len(recording.stimuli), len(recording.spike_times_s)) == (3_000, 120_000)
    # A pulse is some ten columns of 8 bytes, each there more than once; the log holds 1,400 bytes of each tick, and as
    # objects these are 8,000.
    assert (peaks[3_000] - peaks[500]) / 2_500 < 600


@pytest.mark.oracle
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_spikes_in_blocks_are_written_as_they_are_in_one_piece(tmp_path: Path, data: st.DataObject) -> None:
    spikes = data.draw(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 5)), max_size=60), "samples and channels")
    cuts = sorted(data.draw(st.lists(st.integers(0, len(spikes)), max_size=5), "where blocks end"))
    times_s, channels = np.array([t / 20 for t, _ in spikes]), np.array([c for _, c in spikes], np.int64)
    rows = np.arange(6)
    nothing = np.empty(0)
    order = np.argsort(times_s, kind="stable")
    recording = Recording(
        spike_times_s=times_s[order],
        spike_channels=channels[order],
        channels=Channels(rows.astype(np.str_), rows, 1.0 * rows, 0.0 * rows),
        stimuli=Stimuli(nothing, nothing, nothing, np.empty((0, 1)), nothing),  # type: ignore[arg-type]
        sampling_rate_hz=20.0,
        start_s=0.0,
        duration_s=2.0,
    )

    blocks = [(times_s[a:b], channels[a:b]) for a, b in zip([0, *cuts], [*cuts, len(spikes)], strict=True)]
    counts = SpikeCounts(6)
    for block in blocks:
        counts.add(*block)
    empty = replace(recording, spike_times_s=nothing, spike_channels=nothing.astype(np.int64))
    write_nwb(empty, tmp_path / "a.nwb", blocks, counts)
    assert read_hdf5(tmp_path / "a.nwb").equals(recording)


@pytest.mark.parametrize(
    ("time_s", "channel", "words"),
    [
        (np.nan, 0, "finite times"),
        (0.5, 6, "got 6"),
        (0.5, -1, "got -1"),
        (2.5, 0, "within the recording"),
        (-0.5, 0, "within"),
    ],
)
def test_spikes_that_cannot_be_are_refused_in_blocks_too(
    tmp_path: Path, time_s: float, channel: int, words: str
) -> None:
    rows = np.arange(6)
    empty = Recording(
        np.empty(0), rows[:0], Channels(rows.astype(np.str_), rows, 1.0 * rows, 0.0 * rows),
        Stimuli(*np.empty((3, 0)), np.empty((0, 1)), np.empty(0)), 20.0, 0.0, 2.0,  # type: ignore[arg-type]
    )  # fmt: skip
    spikes, counts = (np.array([0.1, time_s]), np.array([0, channel])), SpikeCounts(6)
    with pytest.raises(UnusableData, match=words):
        counts.add(*spikes)
        write_nwb(empty, tmp_path / "a.nwb", [spikes], counts)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], bytes]:
    """The header of a session's log, and what comes after it."""
    session = ran(tmp_path_factory.mktemp("whole"))
    data = (session.folder / LOG_FILE).read_bytes()
    return session.log.header, data[8 + 16 + struct.unpack_from("<4sIII", data, 8)[1] :]


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("channels", 7, "channels: expected a table, got 7"),
        ("channels", [1, 2], "channels: expected a table, got [1, 2]"),
        ("channels.x_um", ["a"] * 16, "channels.x_um: expected a number, got 'a'"),
        ("channels.electrode", [1.5] * 16, "channels.electrode: expected a whole number, got 1.5"),
        (
            "channels.electrode",
            [10**30] * 16,
            "channels.electrode: expected less than 9,223,372,036,854,775,808, got 1000",
        ),
        ("channels.electrode", [1, 2], "electrode: expected 16 values"),
        ("channels.label", ["0"] * 16, "channels.label: expected each label once"),
        ("start_min", "soon", "start_min: expected a number, got 'soon'"),
        ("start_min", math.nan, "start_min: expected a finite number, got nan"),
        ("start_min", [1.0], "start_min: expected a number, got [1.0]"),
        ("sampling_rate_hz", -1, "sampling_rate_hz: expected a rate above 0 Hz, got -1"),
        ("sampling_rate_hz", 0.0, "sampling_rate_hz: expected a rate above 0 Hz, got 0.0"),
        ("recorded_at", "yesterday", "recorded_at: expected a date in ISO 8601, got 'yesterday'"),
        ("recorded_at", "2026\0", "recorded_at: expected text without null characters"),
        ("provenance", {"source": 3}, "provenance.source: expected text, got 3"),
        ("provenance", {"source": "\ud800"}, r"halves of surrogate pairs, got '\ud800'"),
        ("provenance", {"source": "\udfff"}, r"halves of surrogate pairs, got '\udfff'"),
        ("loop", None, "loop: expected a table, got None"),
        ("loop.pulses", 0, "pulses"),
        ("loop.conditions", "5 Hz", "loop.conditions: expected a list, got '5 Hz'"),
        ("agents", [{"name": 1}], "agents.name: expected text, got 1"),
        ("observed", {"x": 1}, "observed: expected a list, got {'x': 1}"),
    ],
)
def test_a_header_of_other_types_is_refused_by_file_and_field(
    tmp_path: Path,
    whole: tuple[dict[str, Any], bytes],
    field: str,
    value: Any,
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    header, records = json.loads(json.dumps(whole[0])), whole[1]
    *path, last = field.split(".")
    within = header
    for part in path:
        within = within[part]
    within[last] = value
    folder = with_header(tmp_path / "session", header, records)
    assert main(["recover", str(folder)]) == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith(f"animat: {folder / LOG_FILE}: the header of the session: ")
    assert words in error
    assert "\n" not in error
    assert [file.name for file in folder.iterdir()] == [LOG_FILE]


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.integers(10**18, 10**25) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=4,
)


def places(node: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in plain data, of a long list its first two."""
    inner = node.items() if isinstance(node, dict) else enumerate(node[:2]) if isinstance(node, list) else ()
    return [at, *(place for name, value in inner for place in places(value, (*at, name)))]


@pytest.mark.oracle
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_header_changed_anywhere_is_read_or_refused_by_name(
    tmp_path: Path, whole: tuple[dict[str, Any], bytes], data: st.DataObject
) -> None:
    header, records = json.loads(json.dumps(whole[0])), whole[1]
    at = data.draw(st.sampled_from(places(header)), "where")
    value = data.draw(ANYTHING, "what")
    if not at:
        header = value
    else:
        within = header
        for part in at[:-1]:
            within = within[part]
        if data.draw(st.booleans(), "gone") and isinstance(within, dict):
            del within[at[-1]]
        else:
            within[at[-1]] = value
    folder = with_header(tmp_path / "session", header, records)
    try:
        session = read_session(folder)
        session.recording()
        session.to_dict()
        assert session.episodes
    except InvalidFile as error:
        assert str(error).startswith(str(folder / LOG_FILE))
        assert "\n" not in str(error)
