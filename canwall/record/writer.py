"""The process that empties the ring into the run's folder: `python -m canwall.record.writer`.

It ends when the master closes its end of the pipe, in order or by dying, and completes the files
first. Its last words go to standard output as JSON: what was written and what was lost.
"""

import contextlib
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

from canwall.record.folder import stream_of
from canwall.record.ring import ROW, Ring, to_message

#: Rows of one row group, unless the run ends before.
_ROW_GROUP = 8192
_POLL_S = 0.02
#: How much of a run a loss of power may take.
_SYNCHRONISE_S = 0.5


def schema(laws: list[str]) -> pa.Schema:
    """Columns of signals.parquet: those of ROW, the law by its name."""
    fields = [
        pa.field("law", pa.dictionary(pa.uint8(), pa.string()))
        if name == "law"
        else pa.field(name, pa.from_numpy_dtype(ROW[name]))
        for name in ROW.names or ()
    ]
    return pa.schema(fields, metadata={"laws": json.dumps(laws)})


class _SignalsFile:
    """Rows as a stream that needs no ending, and as Parquet once they are complete.

    What was synchronised is on the disk: after a loss of power, `folder.read_signals` reads the
    stream up to its last second.
    """

    def __init__(self, path: Path, laws: list[str]) -> None:
        self._schema = schema(laws)
        self._names = pa.array(laws, pa.string())
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
            columns = [
                pa.DictionaryArray.from_arrays(pa.array(rows["law"]), self._names)
                if name == "law"
                else pa.array(np.ascontiguousarray(rows[name]))
                for name in ROW.names or ()
            ]
            self._stream.write_batch(pa.RecordBatch.from_arrays(columns, schema=self._schema))
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


def write(ring: Ring, folder: Path, bus_log: str, channel: str, laws: list[str]) -> None:
    """Empty the ring into the folder until standard input ends."""
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
            readable, _, _ = select.select([sys.stdin], [], [], _POLL_S)
            ended = bool(readable)
        if time.monotonic() - synchronised >= _SYNCHRONISE_S:
            signals.synchronise()
            log.synchronise()
            synchronised = time.monotonic()
    drain()
    signals.close()
    log.close()


def main() -> None:
    """Arguments: descriptor of the ring, folder, name of the bus log, channel, laws as JSON."""
    descriptor, folder, bus_log, channel, laws = sys.argv[1:]
    error = ""
    ring = Ring(int(descriptor))
    try:
        write(ring, Path(folder), bus_log, channel, json.loads(laws))
    except (OSError, pa.ArrowException, sqlite3.Error) as failure:
        error = str(failure)
        # The master is not to hear of it by its ring filling up: keep emptying it.
        while not select.select([sys.stdin], [], [], _POLL_S)[0]:
            ring.take_frames()
            ring.take_rows()
    # Not through the stream: what it could not get rid of it would complain about at exit.
    with contextlib.suppress(BrokenPipeError):
        os.write(sys.stdout.fileno(), json.dumps({"error": error}).encode())


if __name__ == "__main__":
    main()
