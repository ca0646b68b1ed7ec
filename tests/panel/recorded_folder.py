"""Folders of runs, written as a run writes them, from rows of a loop in memory."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from rig import settings_with

from canwall.config import Settings
from canwall.record import RunFolder
from canwall.record.columns import record_batch
from canwall.record.folder import stream_of
from canwall.run.closed_loop import simulate
from canwall.run.result import judged
from canwall.units import DriveUnits

#: A frame of kind 1, as PANEL's documentation has it: kind, version, columns, points, reserved.
HEADER = struct.Struct("<BBHId")


def strike_rows(cycles: int = 1000) -> tuple[Settings, NDArray[np.void], DriveUnits]:
    """The first strike of config/sim.toml, rendered in memory."""
    settings = settings_with().model_copy(update={"schedule": ()})
    done = simulate(settings, cycles)
    return settings, done.rows, done.units


def write_cut_off(path: Path, settings: Settings, rows: NDArray[np.void]) -> RunFolder:
    """What a loss of power leaves of a run."""
    folder = RunFolder.create(path, settings.to_toml())
    laws = [settings.wall.law]
    batches = [record_batch(part, laws) for part in np.array_split(rows, 5)]
    with stream_of(folder.signals).open("wb") as file:
        stream = pa.ipc.new_stream(file, batches[0].schema)
        for batch in batches:
            stream.write_batch(batch)
    return folder


def write_run(
    path: Path, settings: Settings, rows: NDArray[np.void], units: DriveUnits
) -> RunFolder:
    """A run that has ended."""
    folder = RunFolder.create(path, settings.to_toml())
    table = pa.Table.from_batches([record_batch(rows, [settings.wall.law])])
    pq.write_table(table, folder.signals, write_page_checksum=True)
    drive = {"rad_per_count": units.rad_per_count, "nm_per_mille": units.nm_per_mille}
    summary = judged(table, settings, units)
    folder.write_summary(summary | {"cut_off": False, "trips": [], "drive": drive})
    return folder


def parsed(
    frame: bytes,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Times, least and largest values of a frame of kind 1."""
    kind, version, columns, points, _ = HEADER.unpack_from(frame)
    assert (kind, version, len(frame)) == (1, 1, 16 + points * (8 + 8 * columns))
    times = np.frombuffer(frame, "<f8", points, HEADER.size)
    values = np.frombuffer(frame, "<f4", offset=HEADER.size + 8 * points)
    low_high: Any = values.reshape(columns, 2, points)
    return times, low_high[:, 0], low_high[:, 1]
