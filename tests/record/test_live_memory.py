"""The memory of a run as readers have it: whole snapshots, rows in order, words of control."""

import mmap
import os
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from canwall.errors import ConfigError, RunFailedError
from canwall.record import ROW, Ring, RunFolder
from canwall.record import snapshot as snapshot_module
from canwall.record.append import put_row
from canwall.record.controls import Controls
from canwall.record.live import LiveMemory, LiveRun
from canwall.record.ring import ROWS
from canwall.record.snapshot import Snapshot
from canwall.record.status import STATUS

#: Length that no processor copies at once [bytes].
LONG = 1 << 16


def snapshot() -> Snapshot:
    return Snapshot(mmap.mmap(-1, Snapshot.size(LONG)), 0, LONG)


def test_snapshot_is_the_last_one_published() -> None:
    both = snapshot()
    assert both.read(0.0) is None
    for content in (b"first", b"", b"x" * LONG):
        both.publish(content)
        assert both.read() == content
    with pytest.raises(ValueError, match="65537 bytes; 65536 is the most"):
        both.publish(b"x" * (LONG + 1))
    assert both.read() == b"x" * LONG


def test_snapshot_that_changes_while_it_is_read_is_read_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both = snapshot()
    both.publish(b"one")
    fences = iter(range(100))

    def publish_meanwhile() -> None:
        if next(fences) == 1:  # the content has been copied, the number not yet compared
            monkeypatch.setattr(snapshot_module, "fence", lambda: None)
            both.publish(b"two")
            monkeypatch.setattr(snapshot_module, "fence", publish_meanwhile)

    monkeypatch.setattr(snapshot_module, "fence", publish_meanwhile)
    assert both.read() == b"two"


def test_snapshot_that_is_never_completed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The publisher dies between its two numbers."""
    both = snapshot()
    both.publish(b"whole")
    both._number[0] += 1
    assert both.read(0.001) is None


@pytest.mark.slow
def test_snapshots_of_another_process_are_never_torn() -> None:
    both = snapshot()
    both.publish(bytes(LONG))
    publisher = os.fork()
    if publisher == 0:
        try:
            for k in range(1, 1 << 30):
                both.publish(bytes([k % 256]) * LONG)
        finally:
            os._exit(0)
    try:
        seen = set[int]()
        while len(seen) < 20:
            content = both.read(10.0)
            assert content is not None
            assert content == content[:1] * LONG
            seen.add(content[0])
    finally:
        os.kill(publisher, 9)
        os.waitpid(publisher, 0)


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[LiveMemory]:
    """The memory of a run that is written to tmp_path."""
    with closing(Ring.create()) as ring, closing(LiveMemory(ring)) as found:
        RunFolder(tmp_path).write_live(found.addresses)
        yield found


def put(memory: LiveMemory, start: int, stop: int) -> None:
    """Put rows into the ring, for a writer that takes them at once."""
    ring, row = memory._ring, np.zeros(1, ROW)
    for j in range(start, stop):
        row["j"] = j
        put_row(ring.header, ring.rows, row)
        ring.header["row_tail"] = j + 1


def test_rows_come_once_and_in_order(memory: LiveMemory, tmp_path: Path) -> None:
    put(memory, 0, 100)
    with LiveRun.open(tmp_path) as live:
        assert live.pid == os.getpid()
        assert live.rows()["j"].tolist() == list(range(100))
        assert live.rows()["j"].tolist() == []
        put(memory, 100, 130)
        assert live.rows()["j"].tolist() == list(range(100, 130))
        assert live.rows_lost == 0
        put(memory, 130, 130 + ROWS + 50)
        j = live.rows()["j"]
        # The oldest one may be in the making again.
        assert j.tolist() == list(range(181, 180 + ROWS))
        assert live.rows_lost == 51
        assert not live.rows_lost + len(j) + 130 - (180 + ROWS)
    # Who comes late has the tail, and has lost nothing.
    with LiveRun.open(tmp_path) as late:
        assert late.rows()["j"].tolist() == j.tolist()
        assert late.rows_lost == 0


def test_reader_cannot_write_what_it_only_reads(memory: LiveMemory, tmp_path: Path) -> None:
    with LiveRun.open(tmp_path) as live:
        with pytest.raises(ValueError, match="read-only"):
            live._ring.header["row_head"] = 5
        with pytest.raises(ValueError, match="read-only"):
            live._status._number[0] = 5


def test_status_of_a_run_that_is_killed(memory: LiveMemory, tmp_path: Path) -> None:
    record = np.zeros(1, STATUS)
    record["cycle"], record["cycle_s"], record["emcy_code"] = 500, 0.002, -1
    record["trip"] = "µ".encode() * 300
    with LiveRun.open(tmp_path) as live:
        with pytest.raises(RunFailedError, match="does not say how it is"):
            live.status()
        with pytest.raises(RunFailedError, match="does not say how it is set"):
            live.settings()
        memory.publish(record)
        status = live.status()
        assert (status.cycle, status.t_s, status.ended) == (500, 1.0, False)
        assert (status.emcy_code, status.trip) == (None, "µ" * 300)
        record["trip"] = b""
        memory.publish(record)
        status = live.status()
        assert live.alive
        memory._status._number[0] += 1  # it was publishing
        other = os.open("/dev/null", os.O_RDONLY)
        os.dup2(other, memory._descriptor)
        os.close(other)
        assert not live.alive
        assert "watchdog" in live.status().trip
        assert live.status() == status._replace(ended=True, trip=live.status().trip)
        # Its words are still there for whoever has them open.
        live.stop()
        assert memory.controls.stopped
    with pytest.raises(ConfigError, match="no run in progress"):
        LiveRun.open(tmp_path)


def test_beats() -> None:
    with closing(Controls.create()) as controls, closing(Controls.open(controls.address)) as other:
        now_ns = time.monotonic_ns()
        assert controls.silent_s(now_ns - 3_000_000_000) >= 3.0
        other.beat()
        assert controls.silent_s(0) < 1.0
        # Nobody lives in the future.
        other.words["beat_ns"] = time.monotonic_ns() + 10**12
        assert controls.silent_s(now_ns - 3_000_000_000) >= 3.0
        assert not controls.stopped
        other.stop()
        assert controls.stopped
