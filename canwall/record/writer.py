"""The process that empties the ring into the run's folder: `python -m canwall.record.writer`.

It ends when the master closes its end of the pipe, in order or by dying, and completes the files
first. Its last words go to standard output as JSON: what was written and what was lost.
"""

import contextlib
import json
import os
import select
import sys
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from canwall.record.ring import ROW, Ring, to_message

#: Rows of one row group, unless the run ends before.
_ROW_GROUP = 8192
_POLL_S = 0.02


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
    def __init__(self, path: Path, laws: list[str]) -> None:
        self._schema = schema(laws)
        self._names = pa.array(laws, pa.string())
        self._file = pq.ParquetWriter(path, self._schema)
        self._waiting: list[NDArray[np.void]] = []
        self._count = 0

    def add(self, rows: NDArray[np.void]) -> None:
        self._waiting.append(rows)
        self._count += len(rows)
        if self._count >= _ROW_GROUP:
            self._write()

    def _write(self) -> None:
        rows = np.concatenate(self._waiting) if self._waiting else np.empty(0, ROW)
        columns = [
            pa.DictionaryArray.from_arrays(pa.array(rows["law"]), self._names)
            if name == "law"
            else pa.array(np.ascontiguousarray(rows[name]))
            for name in ROW.names or ()
        ]
        self._file.write_table(pa.Table.from_arrays(columns, schema=self._schema))
        self._waiting, self._count = [], 0

    def close(self) -> None:
        self._write()
        self._file.close()


def write(ring: Ring, folder: Path, bus_log: str, channel: str, laws: list[str]) -> None:
    """Empty the ring into the folder until standard input ends."""
    signals = _SignalsFile(folder / "signals.parquet", laws)
    log = can.Logger(str(folder / bus_log))

    def drain() -> bool:
        frames, rows = ring.take_frames(), ring.take_rows()
        for frame in frames:
            log.on_message_received(to_message(frame, channel))
        if len(rows):
            signals.add(rows)
        return len(frames) + len(rows) > 0

    ended = False
    while not ended:
        if not drain():
            readable, _, _ = select.select([sys.stdin], [], [], _POLL_S)
            ended = bool(readable)
    drain()
    signals.close()
    log.stop()


def main() -> None:
    """Arguments: descriptor of the ring, folder, name of the bus log, channel, laws as JSON."""
    descriptor, folder, bus_log, channel, laws = sys.argv[1:]
    error = ""
    ring = Ring(int(descriptor))
    try:
        write(ring, Path(folder), bus_log, channel, json.loads(laws))
    except OSError as failure:
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
