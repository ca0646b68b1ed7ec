"""Process that empties the ring into the run's folder: `python -m canwall.record.writer`.

It takes orders from standard input (sent by `recorder.Recorder`) and answers on standard output,
one line of JSON each; if the record cannot go on, it says so at once. When the master closes its
end of the pipe, or dies, the writer completes the files and ends. It also draws the picture, since
it can load the plotting library, and what a first picture needs, while the run lasts.
"""

import contextlib
import gc
import json
import os
import select
import sqlite3
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from canwall.errors import ConfigError
from canwall.extras import is_installed
from canwall.record.columns import ROW, record_batch, schema
from canwall.record.folder import (
    RecordError,
    RunFolder,
    lock_folder,
    reason,
    stream_of,
    synchronise,
    whole_file,
)
from canwall.record.ring import Ring, to_message

#: Rows per row group; the last one may have fewer.
_ROW_GROUP = 8192
_POLL_S = 0.02
#: Interval of synchronisation to disk: the most of a run that a power failure can lose [s].
_SYNCHRONISE_S = 0.5


class _SignalsFile:
    """Rows as a stream that is readable while incomplete, and as Parquet once complete.

    After a power failure, `folder.read_signals` reads the stream up to the last synchronisation.
    """

    def __init__(self, path: Path, laws: list[str]) -> None:
        self._laws = laws
        self._schema = schema(laws)
        self._path = path
        self._stream_path = stream_of(path)
        self._file = self._stream_path.open("xb")
        self._stream = pa.ipc.new_stream(self._file, self._schema)
        # Without rows it is a record already.
        self._waiting: list[NDArray[np.void]] = [np.zeros(0, ROW)]
        self.synchronise()

    def add(self, rows: NDArray[np.void]) -> None:
        self._waiting.append(rows)

    def synchronise(self) -> None:
        """Write everything added so far through to the disk."""
        if self._waiting:
            rows = np.concatenate(self._waiting)
            self._waiting = []
            self._stream.write_batch(record_batch(rows, self._laws))
        synchronise(self._file)

    def close(self) -> None:
        self.synchronise()
        self._stream.close()
        self._file.close()
        with (
            pa.ipc.open_stream(self._stream_path) as rows,
            whole_file(self._path) as parquet,
            pq.ParquetWriter(parquet, self._schema, write_page_checksum=True) as file,
        ):
            group: list[pa.RecordBatch] = []
            for batch in rows:
                group.append(batch)
                if sum(map(len, group)) >= _ROW_GROUP:
                    file.write_table(pa.Table.from_batches(group))
                    group = []
            # A file without rows has the columns nevertheless.
            file.write_table(pa.Table.from_batches(group, self._schema))
        self._stream_path.unlink()


class _BusLog:
    """Frames in one of python-can's formats; discarded without a path."""

    def __init__(self, path: Path | None, channel: str) -> None:
        self._channel = channel
        self._log = None
        if path is not None:
            path.open("xb").close()
            self._log = can.Logger(str(path))

    def add(self, frames: NDArray[np.void]) -> None:
        if self._log is not None:
            for frame in frames:
                self._log.on_message_received(to_message(frame, self._channel))

    def synchronise(self) -> None:
        # The database writer has no file object, and commits on its own schedule.
        file = getattr(self._log, "file", None)
        if file is not None:
            synchronise(file)

    def close(self) -> None:
        if self._log is not None:
            self._log.stop()


def write(
    ring: Ring, orders: IO[bytes], folder: Path, bus_log: str, channel: str, laws: list[str]
) -> None:
    """Empty the ring into the folder until an order comes or the master is gone."""
    lock_folder(folder)  # for as long as this process lives
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
    try:
        signals.close()
    finally:
        log.close()


def _is_ordered(orders: IO[bytes], timeout_s: float) -> bool:
    return bool(select.select([orders], [], [], timeout_s)[0])


def _record(ring: Ring, orders: IO[bytes], order: dict[str, Any]) -> None:
    """Write the record that the order describes; say so at once if that fails."""
    try:
        write(
            ring, orders, Path(order["folder"]), order["bus_log"], order["channel"], order["laws"]
        )
    except (OSError, RecordError, pa.ArrowException, sqlite3.Error) as failure:
        _say(failed=reason(failure))
        # Keep emptying the ring, so that it does not fill up and disturb the master.
        while not _is_ordered(orders, _POLL_S):
            ring.take_frames()
            ring.take_rows()


def _prepare_to_draw(ended: threading.Event) -> None:
    """Load what draws, unless there is nothing to draw any more."""
    if is_installed("plot") and not ended.is_set():
        from canwall.record.pictures import warm_up

        with contextlib.suppress(Exception):  # the picture itself will tell
            warm_up()


def _draw(folder: Path) -> str:
    """Draw the run's picture; return an error message or an empty text."""
    from canwall.record.pictures import plot_run

    try:
        plot_run(RunFolder(folder))
    except (OSError, ConfigError, RecordError) as failure:
        return reason(failure)
    return ""


def _say(**what: str) -> None:
    with contextlib.suppress(BrokenPipeError):
        os.write(sys.stdout.fileno(), json.dumps(what).encode() + b"\n")


def main() -> None:
    """Execute orders to record, to complete the record, and to draw it, one line of JSON each."""
    ring = Ring(int(sys.argv[1]))
    ended = threading.Event()
    loading = threading.Thread(target=_prepare_to_draw, args=(ended,))
    loading.start()
    # Unbuffered, so that select sees a waiting line.
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as orders:
        if begin := orders.readline():
            order = json.loads(begin)
            _record(ring, orders, order)
            if orders.readline():
                _say(done="")
            while orders.readline():
                loading.join()
                _say(done=_draw(Path(order["folder"])))
    ended.set()
    gc.freeze()  # the master waits for the exit: spare it a collection of all imported modules


if __name__ == "__main__":
    main()
