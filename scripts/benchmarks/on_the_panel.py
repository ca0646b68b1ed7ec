"""The panel on a recorded run of an hour: opened anew, opened again, and zoomed into."""

import json
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from canwall.panel.frames import SIGNALS
from canwall.panel.recorded_runs import RecordedRuns
from canwall.panel.shelf import Shelf
from canwall.record import RunFolder
from canwall.record.columns import record_batch, schema
from canwall.record.folder import stream_of
from canwall.record.ring import ROW

_RATE_HZ, _SECONDS = 1000, 3600
#: Rows in a row group of a record, as its writer makes them.
_ROW_GROUP = 8192
_ZOOMS, _POINTS = 200, 1500


def panel_hour() -> dict[str, Any]:
    """Time to open a run of an hour in a new process, and to zoom into it.

    Opened is when its list, summary, strikes and an overview of its signals have been answered. A
    run that was cut off is given without its summary, which has to be computed from the rows.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "hour")
        _write_hour(path)
        found = {
            "rows": _RATE_HZ * _SECONDS,
            "file_mb": round((path / "signals.parquet").stat().st_size / 1e6),
            "complete": _in_a_new_process(path),
        }
        _cut_off(path)
        return found | {"cut_off": _in_a_new_process(path)}


def _in_a_new_process(path: Path) -> dict[str, Any]:
    """Measure with nothing imported, the file out of the page cache and then in it."""
    cold = _measured(path, "cold")
    return {"cold_file": cold["opened_s"], **_measured(path, "warm")}


def _measured(path: Path, cache: str) -> dict[str, Any]:
    words = [sys.executable, __file__, str(path), cache]
    found: dict[str, Any] = json.loads(
        subprocess.run(words, capture_output=True, check=True).stdout
    )
    return found


def _write_hour(path: Path) -> None:
    """Write a run of an hour as the writer does: strikes of a hand, an encoder, noise."""
    rows = np.zeros(_RATE_HZ * _SECONDS, ROW)
    random = np.random.default_rng(1)
    rows["j"] = np.arange(len(rows))
    rows["t_s"] = rows["j"] / _RATE_HZ
    rows["phase"], rows["received"], rows["stiffness"] = 1, True, 50.0
    rows["stiffness_in_force"], rows["statusword"] = 50.0, 0x27
    count = 2.0 * np.pi / 4096
    rows["counts"] = np.rint(0.05 * np.cos(2.0 * np.pi * rows["t_s"]) / count)
    rows["y"] = rows["position_rad"] = rows["counts"] * count
    rows["y_est"] = rows["y"] + 1e-5 * random.normal(size=len(rows))
    rows["v_est"] = np.gradient(rows["y_est"]) * _RATE_HZ
    rows["force"] = np.maximum(-50.0 * rows["y_est"], 0.0)
    rows["torque_cmd"] = rows["torque_applied"] = rows["force_applied"] = rows["force"]
    rows["torque_actual"] = rows["force"] + 1e-3 * random.normal(size=len(rows))
    rows["latency_s"] = random.gamma(4.0, 10e-6, len(rows))
    rows["sync_interval_s"] = 1e-3 + 1e-6 * random.normal(size=len(rows))
    folder = RunFolder.create(path, "")
    laws = ["half_sample"]
    with pq.ParquetWriter(folder.signals, schema(laws), write_page_checksum=True) as file:
        for start in range(0, len(rows), _ROW_GROUP):
            batch = record_batch(rows[start : start + _ROW_GROUP], laws)
            file.write_table(pa.Table.from_batches([batch]))
    # What of each strike a page shows; there is one a second.
    strike = {
        "start_s": 0.0,
        "end_s": 0.5,
        "law": "half_sample",
        "stiffness": 50.0,
        "chatter": False,
        "chatter_frequency_hz": 0.0,
        "peak_penetration_rad": 0.05,
        "chatter_reason": "0.0123 peak to peak about the settled contact, referent 0.012",
    }
    folder.write_summary(
        {"strikes": [strike] * _SECONDS, "cycles": len(rows), "cycle_s": 1.0 / _RATE_HZ}
    )


def _cut_off(path: Path) -> None:
    """Leave the stream of the run alone, in batches of half a second."""
    signals = RunFolder(path).signals
    table = pq.read_table(signals)
    with pa.OSFile(str(stream_of(signals)), "wb") as file:
        stream = pa.ipc.new_stream(file, table.schema)
        for batch in table.to_batches(_RATE_HZ // 2):
            stream.write_batch(batch)
    signals.unlink()


def _measure(path: Path, cache: str) -> dict[str, Any]:
    """Open the run in this process, and zoom."""
    if cache == "cold":
        os.sync()
        for file in path.iterdir():
            with file.open("rb") as opened:
                os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    else:
        for file in path.iterdir():
            file.read_bytes()
    shelf = Shelf(path.parent)
    start = time.perf_counter()
    word = shelf.contents()["items"][0]["id"]
    runs = RecordedRuns(shelf)
    if RunFolder(path).summary.exists():
        runs.describe(word)
    runs.signals(word, -np.inf, np.inf, _POINTS)
    opened_s = time.perf_counter() - start
    random, zooms = np.random.default_rng(2), []
    for _ in range(_ZOOMS):
        length = _SECONDS * 10.0 ** random.uniform(-5.0, 0.0)
        at = random.uniform(0.0, _SECONDS - length)
        start = time.perf_counter()
        frame = runs.signals(word, at, at + length, _POINTS)
        zooms.append(1e3 * (time.perf_counter() - start))
        assert struct.unpack_from("<xxH", frame) == (len(SIGNALS),)
    return {
        "opened_s": round(opened_s, 2),
        "zoom_ms": {
            "median": round(statistics.median(zooms), 2),
            "largest_of_200": round(max(zooms), 1),
        },
    }


if __name__ == "__main__":
    print(json.dumps(_measure(Path(sys.argv[1]), sys.argv[2])))
