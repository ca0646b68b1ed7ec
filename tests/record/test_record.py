"""The ring, the writer process and the folder: what was put in comes out, whoever dies."""

import contextlib
import fcntl
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from canwall.config import ConfigError
from canwall.record import ROW, Recorder, RecordError, Ring, RunFolder, read_signals
from canwall.record.append import put_frame, put_row
from canwall.record.columns import schema
from canwall.record.folder import lock_folder
from canwall.record.live import LiveRun
from canwall.record.ring import FRAMES, ROWS, to_message

LAWS = ["standard", "half_sample"]
CONFIG = "[bus]\n"
PATIENCE_S = 30.0


def some_rows(count: int) -> NDArray[np.void]:
    """Rows that differ in every column, law and flags within their range."""
    rows = np.zeros(count, ROW)
    for place, name in enumerate(ROW.names or ()):
        rows[name] = (np.arange(count) * 7 + place) % 101
    rows["j"] = np.arange(count)
    rows["law"] %= len(LAWS)
    return rows


def put_rows(ring: Ring, rows: NDArray[np.void]) -> None:
    for j in range(len(rows)):
        put_row(ring.header, ring.rows, rows[j : j + 1])


def some_frames(count: int) -> list[can.Message]:
    frames = [
        can.Message(
            timestamp=1_700_000_000.0 + number / 1000,
            arbitration_id=0x181 + number % 5,
            is_extended_id=False,
            is_rx=bool(number % 2),
            data=number.to_bytes(4, "little")[: number % 5],
        )
        for number in range(count)
    ]
    return [
        *frames,
        can.Message(timestamp=1.8e9, arbitration_id=0x12345678, data=b"\xff" * 8),
        can.Message(timestamp=1.8e9, arbitration_id=0x702, is_extended_id=False, dlc=0),
    ]


def log(ring: Ring, frames: list[can.Message]) -> None:
    for frame in frames:
        ring.log_frame(frame.timestamp, frame, frame.is_rx)


def assert_rows(table: pa.Table, rows: NDArray[np.void]) -> None:
    assert table.column_names == list(ROW.names or ())
    for name in table.column_names:
        if name == "law":
            assert table[name].to_pylist() == [LAWS[law] for law in rows["law"]]
        else:
            assert table[name].to_numpy().tolist() == rows[name].tolist()


@contextlib.contextmanager
def recording(folder: Path, bus_log: str = "bus.log") -> Iterator[Recorder]:
    with Recorder() as recorder:
        recorder.begin(folder, bus_log, "canwall", LAWS)
        yield recorder


def wait_until_written(ring: Ring) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while ring.backlog() > 0.0:
        assert time.monotonic() < deadline
        time.sleep(0.005)


# Ring


@st.composite
def messages(draw: st.DrawFn) -> can.Message:
    extended = draw(st.booleans())
    remote = draw(st.booleans())
    return can.Message(
        arbitration_id=draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=draw(st.booleans()) and not remote,
        is_rx=draw(st.booleans()),
        dlc=draw(st.integers(0, 8)) if remote else None,
        data=None if remote else draw(st.binary(max_size=8)),
    )


RING = Ring.create()


@settings(deadline=None, max_examples=100)
@given(sent=st.lists(messages(), max_size=5))
def test_frames_come_out_as_they_went_in(sent: list[can.Message]) -> None:
    for number, message in enumerate(sent):
        RING.log_frame(float(number), message, message.is_rx)
    taken = RING.take_frames()
    assert [frame["time_s"] for frame in taken] == [float(n) for n in range(len(sent))]
    for frame, message in zip(taken, sent, strict=True):
        assert to_message(frame, "bus").equals(message, timestamp_delta=None, check_channel=False)


def test_rows_come_out_in_order_past_the_end_of_the_ring() -> None:
    ring = Ring.create()
    rows = some_rows(ROWS)
    for start in range(0, 3 * ROWS, 5000):
        part = rows[np.arange(start, start + 5000) % ROWS]
        put_rows(ring, part)
        assert (ring.take_rows() == part).all()
    assert len(ring.take_rows()) == 0
    assert ring.header["rows_lost"][0] == 0


def test_two_views_of_one_ring() -> None:
    ring = Ring.create()
    other = Ring(ring.descriptor)
    put_rows(ring, some_rows(3))
    assert len(other.take_rows()) == 3
    assert ring.backlog() == 0.0


def test_backlog_is_that_of_the_fuller_ring() -> None:
    ring = Ring.create()
    put_rows(ring, some_rows(ROWS // 4))
    assert ring.backlog() == 0.25
    ring.header["frame_head"] = FRAMES // 2
    assert ring.backlog() == 0.5


def test_full_ring_counts_what_it_loses() -> None:
    ring = Ring.create()
    rows = some_rows(ROWS)
    put_rows(ring, rows)
    put_rows(ring, rows[:3])
    for _ in range(FRAMES + 2):
        put_frame(ring.header, ring.frames, 0.0, 0x181, 0, 0, 0)
    assert ring.header["rows_lost"][0] == 3
    assert ring.header["frames_lost"][0] == 2
    assert (ring.take_rows() == rows).all()
    put_rows(ring, rows[:1])
    assert len(ring.take_rows()) == 1


# Writer


@pytest.mark.slow
@pytest.mark.parametrize("bus_log", ["bus.log", "bus.asc", "bus.blf"])
def test_round_trip_through_the_writer(tmp_path: Path, bus_log: str) -> None:
    rows, frames = some_rows(20_000), some_frames(500)  # more than one row group
    with recording(tmp_path, bus_log) as recorder:
        log(recorder.ring, frames[:-1])
        for start in range(0, len(rows), 5000):
            put_rows(recorder.ring, rows[start : min(start + 5000, len(rows) - 1)])
            wait_until_written(recorder.ring)
        time.sleep(0.1)  # now the writer is idle, and will not have looked when it is to end
        put_rows(recorder.ring, rows[-1:])
        log(recorder.ring, frames[-1:])
        assert recorder.close() == []
    table = read_signals(tmp_path / "signals.parquet")
    assert_rows(table, rows)
    assert table.schema.metadata[b"laws"] == json.dumps(LAWS).encode()
    with can.LogReader(tmp_path / bus_log) as reader:
        read = list(reader)
    assert len(read) == len(frames)
    for message, frame in zip(read, frames, strict=True):
        assert message.equals(frame, timestamp_delta=None, check_channel=False)
        # .asc is read back as time since its beginning.
        since = message.timestamp - read[0].timestamp
        assert since == pytest.approx(frame.timestamp - frames[0].timestamp, abs=0.002)


@pytest.mark.slow
def test_empty_record(tmp_path: Path) -> None:
    with recording(tmp_path) as recorder:
        assert recorder.close() == []
    table = read_signals(tmp_path / "signals.parquet")
    assert table.num_rows == 0
    assert table.schema.equals(schema(LAWS))
    assert (tmp_path / "bus.log").read_text() == ""


@pytest.mark.slow
def test_what_was_lost_is_reported(tmp_path: Path) -> None:
    with recording(tmp_path) as recorder:
        recorder.ring.header["rows_lost"] = 7
        recorder.ring.header["frames_lost"] = 9
        assert recorder.close() == [
            f"{tmp_path}: 7 rows lost: the disk was too slow",
            f"{tmp_path}: 9 frames lost: the disk was too slow",
        ]


@pytest.mark.slow
def test_folder_that_cannot_be_written(tmp_path: Path) -> None:
    with recording(tmp_path / "nowhere") as recorder:
        put_rows(recorder.ring, some_rows(10))
        wait_until_written(recorder.ring)  # emptied all the same
        (note,) = recorder.close()
    assert "the record is incomplete" in note
    assert "\n" not in note


def test_writer_that_dies(tmp_path: Path) -> None:
    with recording(tmp_path) as recorder:
        recorder._writer.kill()
        (note,) = recorder.close()
    assert note == f"{tmp_path}: the record is incomplete: the writer of the record has died"


def wait_until_told(recorder: Recorder) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while not (failure := recorder.failure()):
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return failure


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGSEGV])
def test_writer_that_dies_is_told_at_once(tmp_path: Path, end: signal.Signals) -> None:
    with recording(tmp_path) as recorder:
        assert recorder.failure() == ""
        recorder._writer.send_signal(end)
        told = wait_until_told(recorder)
        assert told == f"{tmp_path}: the record is incomplete: the writer of the record has died"
        assert recorder.close() == [told]


def test_files_that_appear_meanwhile_are_not_overwritten(tmp_path: Path) -> None:
    for name in ("signals.arrows", "bus.log"):
        folder, foreign = tmp_path / name.replace(".", "-"), tmp_path / "thesis"
        folder.mkdir()
        foreign.write_text("a thesis")
        (folder / name).symlink_to(foreign)
        with recording(folder) as recorder:
            assert wait_until_told(recorder).endswith("the record is incomplete: File exists")
        assert foreign.read_text() == "a thesis"


def test_writer_that_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no-python"))
    with pytest.raises(RecordError, match="does not start"):
        Recorder()


# A master that ends otherwise

MASTER = """
import os, signal, sys, time
from pathlib import Path
from test_record import LAWS, log, put_rows, some_frames, some_rows
from canwall.record import Recorder

signal.signal(signal.SIGINT, lambda number, frame: None)
recorder = Recorder()
recorder.begin(Path(sys.argv[1]), "bus.log", "canwall", LAWS)
if sys.argv[2] == "ctrl-c":
    os.killpg(0, signal.SIGINT)  # as a terminal does: to master and writer, here a starting one
put_rows(recorder.ring, some_rows(3000))
log(recorder.ring, some_frames(3000))
if sys.argv[2] == "ctrl-c":
    sys.exit(bool(recorder.close()))
print("recorded", flush=True)
time.sleep(60)
"""


def master(folder: Path, what: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", MASTER, str(folder), what],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])},
    )


@pytest.mark.slow
def test_killed_master_leaves_a_complete_record(tmp_path: Path) -> None:
    with master(tmp_path, "kill") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "recorded\n"
        os.kill(process.pid, signal.SIGKILL)
        # The writer has the master's stderr, and ends when the record is complete.
        assert process.stderr.read() == ""
    assert_rows(read_signals(tmp_path / "signals.parquet"), some_rows(3000))
    with can.LogReader(tmp_path / "bus.log") as reader:
        assert len(list(reader)) == len(some_frames(3000))


@pytest.mark.slow
def test_ctrl_c_does_not_end_the_writer(tmp_path: Path) -> None:
    with master(tmp_path, "ctrl-c") as process:
        assert process.wait(PATIENCE_S) == 0
    assert read_signals(tmp_path / "signals.parquet").num_rows == 3000


# Folder


def test_folder_is_made_with_its_parents(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "a" / "b", CONFIG)
    assert folder.path.is_dir()
    assert list(folder.path.iterdir()) == [folder.config]
    assert folder.config.read_text() == CONFIG
    assert {p.name for p in (folder.signals, folder.summary, folder.config, folder.picture)} == {
        "signals.parquet",
        "summary.json",
        "config.toml",
        "run.png",
    }


def test_folder_of_its_own_for_every_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first, second = (RunFolder.create(None, CONFIG) for _ in range(2))
    assert first.path.parent == Path("runs")
    assert first.path != second.path


FILES = [
    *("signals.parquet", "signals.arrows", "summary.json", "config.toml", "run.png", "trip.csv"),
    *("live.json", "bus.blf"),
]


@pytest.mark.parametrize("name", FILES)
def test_folder_with_a_file_of_that_name_is_left_alone(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("a thesis")
    with pytest.raises(ConfigError, match=f"holds {name} already; choose another --output"):
        RunFolder.create(tmp_path, CONFIG, "bus.blf")
    assert (tmp_path / name).read_text() == "a thesis"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("name", FILES)
def test_nothing_is_written_through_a_symbolic_link(tmp_path: Path, name: str) -> None:
    folder, foreign = tmp_path / "run", tmp_path / "thesis"
    folder.mkdir()
    (folder / name).symlink_to(foreign)  # also one that leads nowhere yet
    with pytest.raises(ConfigError, match=f"holds {name} already"):
        RunFolder.create(folder, CONFIG, "bus.blf")
    assert not foreign.exists()


def test_what_a_run_without_a_cycle_has_left_is_replaced(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path, "of the first", "bus.blf")
    (tmp_path / "bus.blf").touch()
    pq.write_table(schema(LAWS).empty_table(), folder.signals)
    RunFolder.create(tmp_path, "of the second", "bus.blf")
    assert [path.name for path in tmp_path.iterdir()] == ["config.toml"]
    assert folder.config.read_text() == "of the second"


def test_bus_log_of_several_drives_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "bus.log").write_text("a thesis")
    with pytest.raises(ConfigError, match=r"holds bus\.log already"):
        RunFolder.create(tmp_path / "node5", CONFIG, "../bus.log")


def test_one_of_many_runs_has_the_folder(tmp_path: Path) -> None:
    """All of them look before one of them writes."""
    count = 8
    looked = threading.Barrier(count)
    made: list[RunFolder] = []
    refused: list[str] = []

    def create() -> None:
        try:
            made.append(RunFolder.create(tmp_path / "run", CONFIG))
        except ConfigError as error:
            refused.append(str(error))

    claim = RunFolder._claim

    def claim_at_once(folder: RunFolder, config: str) -> None:
        looked.wait(PATIENCE_S)
        claim(folder, config)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "_claim", claim_at_once)
        threads = [threading.Thread(target=create) for _ in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(made) == 1
    line = f"{tmp_path / 'run'}: holds config.toml already; choose another --output"
    assert refused == [line] * (count - 1)


@pytest.mark.parametrize("where", ["file", "file/below", "/proc/canwall"])
def test_folder_that_cannot_be_made(tmp_path: Path, where: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"cannot be written: .*; choose another --output"):
        RunFolder.create(tmp_path / where, CONFIG)


def test_folder_of_several_drives_is_none_of_a_run(tmp_path: Path) -> None:
    for drive in ("node5", "node6"):
        RunFolder.create(tmp_path / drive, CONFIG, "../bus.log")
    for read in (lambda: read_signals(RunFolder(tmp_path).signals), lambda: LiveRun.open(tmp_path)):
        with pytest.raises(ConfigError, match="give the folder of one: node5, node6"):
            read()


def test_what_is_no_record(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    with pytest.raises(ConfigError, match="no such file; give the folder of a run"):
        read_signals(folder.signals)
    folder.signals.write_text("PAR1 or not")
    with pytest.raises(ConfigError, match="not a record of a run"):
        read_signals(folder.signals)
    with pytest.raises(ConfigError, match=r"signals\.parquet: is a file; give the folder of a run"):
        read_signals(RunFolder(folder.signals).signals)
    pq.write_table(pa.table({"t_s": [1, 2]}), folder.signals)
    with pytest.raises(ConfigError, match="lacks column j: not a record of a run"):
        read_signals(folder.signals)
    with pytest.raises(ConfigError, match="not a summary of a run"):
        folder.read_summary()
    folder.summary.write_text("{")
    with pytest.raises(ConfigError, match="not a summary of a run"):
        folder.read_summary()


# A machine that goes dark, a disk that is full


def wait_until_on_disk(folder: Path, rows: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        with contextlib.suppress(ConfigError):  # nothing is there yet
            if read_signals(folder / "signals.parquet").num_rows >= rows:
                return
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.slow
def test_record_is_readable_without_its_end(tmp_path: Path) -> None:
    """Loss of power: neither master nor writer gets to say a last word."""
    rows, frames = some_rows(3000), some_frames(100)
    with recording(tmp_path) as recorder:
        log(recorder.ring, frames)
        for part in np.split(rows, 3):
            put_rows(recorder.ring, part)
            wait_until_on_disk(tmp_path, int(part["j"][-1]) + 1)
        recorder._writer.kill()
    assert not (tmp_path / "signals.parquet").exists()
    assert_rows(read_signals(tmp_path / "signals.parquet"), rows)
    lines = (tmp_path / "bus.log").read_text().splitlines()
    assert len(lines) == len(frames)


@pytest.mark.slow
def test_stream_that_was_cut_anywhere_is_readable_up_to_there(tmp_path: Path) -> None:
    rows = some_rows(1500)
    with recording(tmp_path, bus_log="") as recorder:
        for part in np.split(rows, 3):
            put_rows(recorder.ring, part)
            wait_until_on_disk(tmp_path, int(part["j"][-1]) + 1)
        recorder._writer.kill()
    stream = tmp_path / "signals.arrows"
    whole = stream.read_bytes()
    found = set()
    for size in range(len(whole), schema(LAWS).serialize().size, -997):
        stream.write_bytes(whole[:size])
        table = read_signals(tmp_path / "signals.parquet")
        found.add(table.num_rows)
        assert_rows(table, rows[: table.num_rows])
    assert {0, 500, 1000, 1500} <= found | {0}
    assert max(found) == 1500


@pytest.mark.slow
def test_disk_that_is_full_is_told_at_once(tmp_path: Path) -> None:
    rows = some_rows(ROWS // 2)
    with recording(tmp_path) as recorder:
        resource.prlimit(recorder._writer.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
        for _ in range(5):  # more than the ring holds
            put_rows(recorder.ring, rows)
            wait_until_written(recorder.ring)
        told = wait_until_told(recorder)
        assert recorder.close() == [told]
    assert told == f"{tmp_path}: the record is incomplete: File too large"
    kept = read_signals(tmp_path / "signals.parquet")
    assert 0 <= kept.num_rows < len(rows)


def test_who_looks_at_a_folder_does_not_disturb_its_lock(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    looking = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(looking, fcntl.LOCK_SH)
    assert not folder.is_being_written  # for somebody else who looks
    threading.Timer(0.1, os.close, [looking]).start()
    lock = lock_folder(tmp_path)
    assert lock is not None
    assert folder.is_being_written
    os.close(lock)
    assert not folder.is_being_written
