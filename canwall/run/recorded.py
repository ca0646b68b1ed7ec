"""A run read from its folder, also while it is in progress or after it was cut off."""

import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import can
import numpy as np

from canwall.config import ConfigError, Settings, load
from canwall.record import ROW, Phase, RunFolder, numbers, read_signals
from canwall.run.result import delay_told, judged
from canwall.units import DriveUnits

if TYPE_CHECKING:
    import pyarrow as pa

#: Torque step [N·m] where the rows have no torque to tell it from, and so nothing depends on it.
_NO_TORQUE_STEP_NM = 1e-6
#: Larger numbers are in no run, whatever their unit.
_LARGEST = 1e12


@dataclass(frozen=True)
class RunRecord:
    """A run as its folder has it.

    Attributes:
        signals: Its rows.
        summary: Content of summary.json.
        remark: A line about the end of the run, unless it ended by itself.
    """

    signals: "pa.Table"
    summary: dict[str, Any]
    remark: str


def read_run(
    folder: RunFolder, columns: Collection[str] = ("j",), *, complete: bool = True
) -> RunRecord:
    """Read a run; complete its folder first if it was cut off.

    After a loss of power, or of master and writer, a folder has the rows, the frames and the
    configuration only. Summary and trip.csv are then made from these. A run in progress is read as
    far as it is, and its folder left alone.

    Args:
        folder: Folder of the run.
        columns: Columns that the caller requires, see `read_signals`.
        complete: Write what a folder lacks; otherwise it is left alone.

    Raises:
        ConfigError: If the folder holds no record, rows that are damaged, or something else as
            summary.json.
        RecordError: If the folder cannot be completed.
    """
    being_written = folder.is_being_written  # asked first: it may end meanwhile
    signals = read_signals(folder.signals, columns)
    if signals.num_rows == 0:
        raise ConfigError(f"{folder.path}: no cycle was recorded")
    if not being_written and os.path.lexists(folder.summary):
        summary = folder.read_summary()
        return RunRecord(signals, summary, _remark(folder, summary))
    signals = read_signals(folder.signals, ROW.names or ())
    summary = _summary_of_stream(folder, signals, columns)
    if being_written:
        summary |= {"cut_off": False, "trips": [], "trip_cycle": None}
        return RunRecord(
            signals, summary, f"{folder.path}: the run is in progress; this is what there is so far"
        )
    if complete:
        folder.write_trip(signals, summary["trip_cycle"])
        folder.write_summary(summary)
    return RunRecord(signals, summary, _remark(folder, summary))


def _summary_of_stream(
    folder: RunFolder, signals: "pa.Table", columns: Collection[str]
) -> dict[str, Any]:
    """Return a summary of rows that may be damaged: a stream has no checksums."""
    damaged = f"{folder.signals}: damaged"
    for name in columns:
        if not np.all(np.abs(numbers(signals, name)) < _LARGEST):
            raise ConfigError(f"{damaged}: column {name} has values of no run")
    try:
        return _summary_from_rows(folder, signals)
    except ConfigError:
        raise
    except (ArithmeticError, LookupError, ValueError) as error:
        raise ConfigError(f"{damaged}: {error}") from None


def _remark(folder: RunFolder, summary: dict[str, Any]) -> str:
    if not summary.get("cut_off"):
        return ""
    trips = summary.get("trips") or ["the run did not end by itself"]
    return f"{folder.path}: {trips[0]}; summary and trip.csv were made from its rows"


def _summary_from_rows(folder: RunFolder, signals: "pa.Table") -> dict[str, Any]:
    """Return a summary; None stands for what only the run itself knew."""
    settings = load(folder.config)
    rad_per_count = _scale(signals, "position_rad", "counts")
    nm_per_mille = _scale(signals, "torque_cmd", "torque_cmd_per_mille")
    units = DriveUnits(
        2.0 * np.pi / (rad_per_count or 1.0), 1000.0 * (nm_per_mille or _NO_TORQUE_STEP_NM)
    )
    last = int(numbers(signals, "j")[-1])
    t_s, phase = float(numbers(signals, "t_s")[-1]), Phase(numbers(signals, "phase")[-1])
    return judged(signals, settings, units) | {
        "cut_off": True,
        "missed_tpdo": sum(chunk.false_count for chunk in signals["received"].chunks),
        "late_tpdo": None,
        "tpdo_lag_cycles": None,
        "skipped_sync": None,
        "late_rpdo": None,
        "guard": None,
        "error_frames": _error_frames(_bus_log(folder, settings)),
        "trips": [
            f"the run did not end by itself: it was cut off while {phase.name.lower()}, after "
            f"cycle {last} ({t_s:.3f} s)"
        ],
        "trip_cycle": last,
        "interrupted": False,
        "delay_cycles": delay_told(signals),
        "drive": {"rad_per_count": rad_per_count, "nm_per_mille": nm_per_mille},
        "timing": {
            "advice": [],
            "sync_interval": _percentiles(signals, "sync_interval_s"),
            "tpdo_to_rpdo": _percentiles(signals, "latency_s"),
        },
    }


def _scale(signals: "pa.Table", si: str, integer: str) -> float | None:
    """Return the unit of an integer column, from the first row where it is not 0."""
    values = numbers(signals, integer)
    rows = np.flatnonzero(values)
    if not len(rows):
        return None
    return float(numbers(signals, si)[rows[0]] / values[rows[0]])


def _percentiles(signals: "pa.Table", name: str) -> dict[str, float]:
    """Return what `cycle.timing_summary` does, from the rows [µs]."""
    values = numbers(signals, name) * 1e6
    values = values[values > 0.0]
    if not len(values):
        return {"p50_us": 0.0, "p99_us": 0.0, "p99.9_us": 0.0, "max_us": 0.0}
    percents = (50, 99, 99.9)
    found = np.percentile(values, percents, method="inverted_cdf")
    summary = {f"p{p:g}_us": float(v) for p, v in zip(percents, found, strict=True)}
    return summary | {"max_us": float(values.max())}


def _bus_log(folder: RunFolder, settings: Settings) -> Path:
    """Return the path of the bus log, which lies beside the folders of several drives."""
    own = folder.path / settings.run.bus_log
    is_of_several = folder.path.name == f"node{settings.drive.node_id}" and not own.exists()
    return folder.path.parent / settings.run.bus_log if is_of_several else own


def _error_frames(bus_log: Path) -> int | None:
    """Return the number of error frames in a log, which may be cut off; None without a log."""
    count = 0
    try:
        with can.LogReader(bus_log) as frames:
            for frame in frames:
                count += frame.is_error_frame
    except FileNotFoundError:
        return None
    except Exception:
        # What python-can's readers raise at an unfinished line or block is not documented.
        pass
    return count
