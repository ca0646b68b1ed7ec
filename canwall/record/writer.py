"""The process that empties the ring into the run's folder: `python -m canwall.record.writer`.

It takes orders from its standard input (`recorder.Recorder` gives them) and answers on standard
output, a line of JSON each. It ends when the master closes its end of the pipe, by an order or by
dying, and completes the files first. It also draws the picture: it is there, has nothing to do
while the master sets up the drive, and can load the plotting library meanwhile.
"""

import contextlib
import gc
import json
import os
import select
import sqlite3
import sys
import time
from pathlib import Path
from typing import IO, Any

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from canwall.errors import ConfigError
from canwall.record.columns import record_batch, schema
from canwall.record.folder import RunFolder, stream_of
from canwall.record.pictures import plot_run
from canwall.record.ring import Ring, to_message

#: Rows of one row group, unless the run ends before.
_ROW_GROUP = 8192
_POLL_S = 0.02
#: Interval of synchronisation to disk: the most of a run that a power failure can lose [s].
_SYNCHRONISE_S = 0.5


class _SignalsFile:
    """Rows as a stream that needs no ending, and as Parquet once they are complete.

    What was synchronised is on the disk: after a loss of power, `folder.read_signals` reads the
    stream up to its last second.
    """

    def __init__(self, path: Path, laws: list[str]) -> None:
        self._laws = laws
        self._schema = schema(laws)
        self._path = path
        self._stream_path = stream_of(path)
        self._file = self._stream_path.open("wb")
        self._stream = pa.ipc.new_stream(self._file, self._schema)
        self._waiting: list[NDArray[np.void]] = []

    def add(self, rows: NDArray[np.void]) -> None:
        self._waiting.append(rows)

    def synchronise(self) -> None:
        """Have everything that was added so far on the disk."""
        if self._waiting:
            rows = np.concatenate(self._waiting)
            self._waiting = []
            self._stream.write_batch(record_batch(rows, self._laws))
        _synchronise(self._file)

    def close(self) -> None:
        self.synchronise()
        self._stream.close()
        self._file.close()
        with (
            pa.ipc.open_stream(self._stream_path) as rows,
            pq.ParquetWriter(self._path, self._schema) as file,
        ):
            group: list[pa.RecordBatch] = []
            for batch in rows:
                group.append(batch)
                if sum(map(len, group)) >= _ROW_GROUP:
                    file.write_table(pa.Table.from_batches(group))
                    group = []
            # A file without rows has its columns all the same.
            file.write_table(pa.Table.from_batches(group, self._schema))
        self._stream_path.unlink()


def _synchronise(file: IO[Any]) -> None:
    file.flush()
    os.fsync(file.fileno())


class _BusLog:
    """Frames in one of python-can's formats; nowhere without a path."""

    def __init__(self, path: Path | None, channel: str) -> None:
        self._channel = channel
        self._log = None if path is None else can.Logger(str(path))

    def add(self, frames: NDArray[np.void]) -> None:
        if self._log is not None:
            for frame in frames:
                self._log.on_message_received(to_message(frame, self._channel))

    def synchronise(self) -> None:
        # The database has no file of its own, and keeps its own time.
        file = getattr(self._log, "file", None)
        if file is not None:
            _synchronise(file)

    def close(self) -> None:
        if self._log is not None:
            self._log.stop()


def write(
    ring: Ring, orders: IO[bytes], folder: Path, bus_log: str, channel: str, laws: list[str]
) -> None:
    """Empty the ring into the folder until there is an order, or nobody left to give one."""
    signals = _SignalsFile(folder / "signals.parquet", laws)
    log = _BusLog(folder / bus_log if bus_log else None, channel)

    def drain() -> bool:
        frames, rows = ring.take_frames(), ring.take_rows()
        log.add(frames)
        if len(rows):
            signals.add(rows)
        return len(frames) + len(rows) > 0

    ended = False
    synchronised = time.monotonic()
    while not ended:
        if not drain():
            ended = _is_ordered(orders, _POLL_S)
        if time.monotonic() - synchronised >= _SYNCHRONISE_S:
            signals.synchronise()
            log.synchronise()
            synchronised = time.monotonic()
    drain()
    signals.close()
    log.close()


def _is_ordered(orders: IO[bytes], timeout_s: float) -> bool:
    return bool(select.select([orders], [], [], timeout_s)[0])


def _record(ring: Ring, orders: IO[bytes], order: dict[str, Any]) -> str:
    """Write the record that the order describes; what went wrong, empty if nothing."""
    try:
        write(
            ring, orders, Path(order["folder"]), order["bus_log"], order["channel"], order["laws"]
        )
    except (OSError, pa.ArrowException, sqlite3.Error) as failure:
        # The master is not to hear of it by its ring filling up: keep emptying it.
        while not _is_ordered(orders, _POLL_S):
            ring.take_frames()
            ring.take_rows()
        return str(failure)
    return ""


def _draw(folder: Path) -> str:
    """Draw the run's picture; what went wrong, empty if nothing."""
    try:
        plot_run(RunFolder(folder))
    except (OSError, ConfigError) as failure:
        return str(failure)
    return ""


def _answer(error: str) -> None:
    with contextlib.suppress(BrokenPipeError):
        os.write(sys.stdout.fileno(), json.dumps({"error": error}).encode() + b"\n")


def main() -> None:
    """Take orders, a line of JSON each: what to record, to complete it, to draw it."""
    ring = Ring(int(sys.argv[1]))
    # Unbuffered: a line that waits is to be seen by select.
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as orders:
        if begin := orders.readline():
            order = json.loads(begin)
            error = _record(ring, orders, order)
            if orders.readline():
                _answer(error)
            while orders.readline():
                _answer(_draw(Path(order["folder"])))
    gc.freeze()  # the master waits for the end: no search for garbage in all that was imported


if __name__ == "__main__":
    main()
