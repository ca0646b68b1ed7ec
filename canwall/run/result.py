"""Result of a run: its summary and remarks."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canwall.analysis import AskedWall, metrics
from canwall.analysis.strike import keeps_limits
from canwall.config import ConfigError, Limits, Settings
from canwall.cycle import BusMonitor, Exchange, Outcome, Trip, WallAxis, timing_summary
from canwall.drive import DriveSetup
from canwall.errors import RunFailedError
from canwall.record import Phase, RecordError, RunFolder, numbers, read_signals
from canwall.record.summary import summarise
from canwall.run.closed_loop import simulated_units
from canwall.run.referent import referent_motion
from canwall.run.torque_delay import delay_in_record
from canwall.units import DriveUnits

if TYPE_CHECKING:
    import pyarrow as pa


#: Delay beyond that of the laws from which on it is told [cycles].
_LATE_CYCLES = 0.5
#: Cycles before the end in which the delay is looked for.
_LATEST = 200_000
#: The most rows that a record may lack; beyond, it is damaged.
_MOST_LOST = 10_000_000
#: Trips of a wall that throws the handle; the others are those of a fault.
_OF_LIMITS = (Trip.SPEED, Trip.POSITION, Trip.ENERGY)


@dataclass(frozen=True)
class RunResult:
    """Result of a run.

    Attributes:
        folder: Its record.
        summary: Content of summary.json.
        outcome: How the loop ended.
        notes: What the record lacks.
        remarks: What the drive does not do as configured.
        not_restored: A line if `[drive] restore` could not undo changes in the drive.
    """

    folder: RunFolder
    summary: dict[str, Any]
    outcome: Outcome
    notes: list[str]
    remarks: list[str]
    not_restored: list[str]


def write_result(
    axis: WallAxis,
    exchange: Exchange,
    monitor: BusMonitor,
    folder: RunFolder,
    outcome: Outcome,
    notes: list[str],
    remarks: list[str],
    not_restored: list[str],
) -> RunResult:
    """Write the summary of one axis, and its last cycles if it tripped.

    Raises RecordError or RunFailedError if nothing was recorded.
    """
    settings, machine = axis.settings, outcome.machine
    notes = [note for note in notes if note not in outcome.trips]  # each is told once
    signals = _read_recorded(folder, [*outcome.trips, *notes])
    exceeded = int(axis.cycle["trip"][0]) in _OF_LIMITS
    summary = judged(signals, settings, axis.setup.units, axis.limits if exceeded else None)
    summary |= {
        "cut_off": False,
        "missed_tpdo": int(axis.cycle["missed_tpdo"][0]),
        "late_tpdo": int(axis.frames["late_tpdo"][0]),
        "tpdo_lag_cycles": int(axis.cycle["lag"][0]),
        "skipped_sync": int(axis.cycle["skipped_sync"][0]),
        "late_rpdo": axis.late_rpdo,
        "guard": _guard_summary(axis),
        "error_frames": monitor.error_frames,
        "trips": outcome.trips,
        "trip_cycle": outcome.trip_cycle,
        "interrupted": outcome.interrupted,
        "delay_cycles": axis.delay,
        "drive": _drive_summary(axis.setup),
        "timing": {
            "exchange": exchange.name,
            **{name: grant.found for name, grant in machine.items()},
            "advice": [f"{g.found}; {g.advice}" for g in machine.values() if g.advice],
            "sync_interval": timing_summary(exchange.sync_interval),
            "tpdo_to_rpdo": timing_summary(axis.latency),
            **(_real_time_summary(axis, exchange) if settings.real_time else {}),
        },
    }
    try:
        folder.write_summary(summary)
        if outcome.trip_cycle is not None:
            folder.write_trip(signals, outcome.trip_cycle)
    except RecordError as error:
        notes.append(str(error))  # the trip is told nevertheless
    return RunResult(
        folder,
        summary,
        outcome,
        notes,
        [
            *remarks,
            *_remarks_on_sync(exchange, settings.bus.cycle_s),
            *_remarks_on_lag(axis),
            *_remarks_on_delay(axis, summary["motion_delay_cycles"]),
            *_remarks_on_guard(axis),
        ],
        not_restored,
    )


def judged(
    signals: "pa.Table", settings: Settings, units: DriveUnits, exceeded: Limits | None = None
) -> dict[str, Any]:
    """Return what the summary has from the rows, judged against the continuous referent.

    Args:
        signals: Record of the run, one row per cycle.
        settings: Configuration of the run.
        units: Scales of the drive.
        exceeded: The limits in force, if the handle exceeded one of them and that ended the run.
    """
    motion_delay = _delay_of(signals)
    signals = _without_gaps(signals)
    # A referent that exceeds them somewhat later exceeds them.
    more = (0, metrics.event_window(settings.bus.cycle_s) if exceeded else 0)
    asked = AskedWall(*(np.pad(numbers(signals, n), more, "edge") for n in AskedWall._fields))
    divider = np.pad(_dividers(numbers(signals, "j"), settings), more, "edge")
    asked = asked._replace(cap=asked.cap / divider**2)
    wall_position = np.pad(numbers(signals, "wall_position_rad"), more, "edge")
    referent = referent_motion(settings, asked, wall_position, delay_told(signals))
    if referent is None:
        found = summarise(signals, settings, units, None, None)
    else:
        thrown = exceeded is not None and keeps_limits(
            wall_position + settings.wall.orientation * referent.y,
            exceeded.position_rad,
            exceeded.speed_rad_s,
            settings.bus.cycle_s,
        )
        y, felt = (values[: signals.num_rows] for values in referent)
        found = summarise(signals, settings, units, y, felt, thrown)
    return found | {"motion_delay_cycles": motion_delay}


def _dividers(j: NDArray[np.float64], settings: Settings) -> NDArray[np.float64]:
    """Return the divider of each cycle by `[wall]` and `[[schedule]]`."""
    stages = settings.stages
    begins = np.array([stage.at_s for stage in stages]) / settings.bus.cycle_s
    dividers = np.array([stage.wall.divider for stage in stages], float)
    return dividers[np.maximum(np.searchsorted(begins, j, side="right") - 1, 0)]


def delay_told(signals: "pa.Table") -> float:
    """Return the delay D that the laws were told [periods].

    When the wall begins it has been measured, if it is to be, and nothing has been found yet.
    """
    begin = int(np.argmax(numbers(signals, "phase") == Phase.RENDERING))
    return float(numbers(signals, "delay_est")[begin])


def _without_gaps(signals: "pa.Table") -> "pa.Table":
    """Return the rows with one for each cycle: where some were lost, the one before, repeated."""
    j = numbers(signals, "j")
    lost = j[-1] + 1.0 - len(j)
    if not 0.0 < lost <= _MOST_LOST:
        return signals
    before = np.searchsorted(j, np.arange(j[-1] + 1.0), side="right") - 1
    return signals.take(np.maximum(before, 0))


def _delay_of(signals: "pa.Table") -> list[float] | None:
    """Return the delay that the motion on the wall shows in the end, and half of its interval."""
    signals = signals.slice(max(0, signals.num_rows - _LATEST))
    received = np.array(signals["received"].to_pylist())
    on_the_wall = numbers(signals, "phase") == Phase.RENDERING
    position = np.where(received & on_the_wall, numbers(signals, "position_rad"), np.nan)
    found = delay_in_record(position, numbers(signals, "torque_cmd"))
    return None if found is None else list(found)


def _remarks_on_sync(exchange: Exchange, cycle_s: float) -> list[str]:
    if (found_s := exchange.other_period_s) is None:
        return []
    return [
        f"the SYNC came every {found_s * 1e3:.3g} ms, but bus.cycle_s is {cycle_s * 1e3:g} ms, "
        f"with which the laws reckon: correct it, or the producer of the SYNC"
    ]


def _remarks_on_lag(axis: WallAxis) -> list[str]:
    lag = int(axis.cycle["lag"][0])
    if not lag:
        return []
    return [
        f"TPDOs have been late by a cycle since one was missing: the delay is {axis.delay + lag:g} "
        f"cycles, for which the estimator allows; look to the drive's timing and the bus load"
    ]


def _remarks_on_delay(axis: WallAxis, found: list[float] | None) -> list[str]:
    """Name a delay that is longer than the one of the laws by about a cycle."""
    reckoned = axis.delay + int(axis.cycle["lag"][0])
    if found is None or found[0] - found[1] <= reckoned + _LATE_CYCLES:
        return []
    return [
        f"torques take effect {found[0]:.2f} ± {found[1]:.2f} cycles after their "
        f"position, as the motion shows, where the laws reckon with {reckoned:.2f}: RPDOs reach "
        f"the drive too late, or it lags; try a longer bus.cycle_s or estimator.measure_delay"
    ]


def _guard_summary(axis: WallAxis) -> dict[str, Any]:
    """Return the alarms of the guard, the time of the first, and the least force that it left."""
    guard, period = axis.cycle["guard"][0, 0], axis.settings.bus.cycle_s
    first = int(guard["first_alarm"])
    return {
        "action": axis.guard.action,
        "alarms": int(guard["alarms"]),
        "first_alarm_s": None if first < 0 else first * period,
        "least_force": float(guard["lowest"]),
    }


def _remarks_on_guard(axis: WallAxis) -> list[str]:
    found = _guard_summary(axis)
    if not found["alarms"]:
        return []
    done = 'guard.action = "act" would make it softer'
    if found["least_force"] < 1.0:
        done = f"its force was lowered, to {found['least_force']:.2g} of the law's at the least"
    times = "once" if found["alarms"] == 1 else f"{found['alarms']} times"
    return [f"guard: the wall buzzed {times}, first at {found['first_alarm_s']:.3f} s; {done}"]


def _real_time_summary(axis: WallAxis, exchange: Exchange) -> dict[str, Any]:
    """Return the timing that exists in real time only; an RPDO has to be sent within a cycle."""
    return {
        "sync_error": timing_summary(exchange.sync_error),
        "sync_to_rpdo": timing_summary(axis.sync_to_rpdo),
    }


def _read_recorded(folder: RunFolder, troubles: list[str]) -> "pa.Table":
    """Read the signals of the run; without any, raise an error with its troubles."""
    try:
        signals = read_signals(folder.signals)
    except ConfigError as error:
        raise RecordError("; ".join(troubles) or str(error)) from None
    if signals.num_rows == 0:
        raise RunFailedError("; ".join(troubles))
    return signals


def remarks_on(setup: DriveSetup, settings: Settings) -> list[str]:
    """Return remarks on what the drive does not do as configured."""
    remarks = [f"the drive: {note}" for note in setup.notes]
    if setup.torque_limit_nm < settings.limits.torque_nm and setup.scales is not None:
        source = setup.scales.sources[-1][1]
        remarks.append(
            f"the drive limits the torque to {setup.torque_limit_nm:g} N·m ({source}), below "
            f"limits.torque_nm = {settings.limits.torque_nm:g}; [drive.parameters] may raise it"
        )
    remarks += _remarks_on_scales(setup, settings)
    if setup.watchdog.kind == "none":
        remarks.append("the drive has no watchdog: a master that dies leaves the torque on")
    return remarks


def _remarks_on_scales(setup: DriveSetup, settings: Settings) -> list[str]:
    """Return a remark for each scale in [drive] that is not the simulated drive's."""
    if settings.simulation is None:
        return []
    simulated = simulated_units(settings)
    return [
        f"drive.{name} = {asked:.9g}, but the simulated drive has {has:.9g}: everything is scaled "
        f"by the difference; leave the key out, or change the drive in [simulation.objects]"
        for name in ("counts_per_rev", "rated_torque_nm")
        if getattr(settings.drive, name)
        and not math.isclose(
            asked := getattr(setup.units, name), has := getattr(simulated, name), rel_tol=1e-3
        )
    ]


def _drive_summary(setup: DriveSetup) -> dict[str, Any]:
    return {
        "mode": str(setup.mode),
        "watchdog": str(setup.watchdog),
        "notes": list(setup.notes),
        "rad_per_count": setup.units.rad_per_count,
        "nm_per_mille": setup.units.nm_per_mille,
        "tpdo_cob_id": setup.tpdo.cob_id,
        "rpdo_cob_id": setup.rpdo.cob_id,
    }
