"""Summary of a run: metrics of its record, strike by strike."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canwall.analysis import metrics
from canwall.config import Settings
from canwall.record.columns import Phase
from canwall.record.folder import numbers
from canwall.units import DriveUnits

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]


def summarise(
    signals: "pa.Table", settings: Settings, units: DriveUnits, referent: Array | None
) -> dict[str, Any]:
    """Return energy, contacts and chatter of a run.

    Args:
        signals: Record of the run, one row per cycle.
        settings: Configuration of the run.
        units: Scales of the drive.
        referent: Positions at the continuous wall at the same SYNCs, shape (n,); None if a person
            was at the handle.
    """
    y, force = numbers(signals, "y"), numbers(signals, "force_applied")
    stiffness, laws = numbers(signals, "stiffness"), signals["law"]
    rendering = numbers(signals, "phase") == Phase.RENDERING
    work = metrics.energy_out(y, force)
    touched = metrics.contacts(np.where(rendering, y, np.inf), force)
    strikes = [
        _strike(strike, y, force, work, stiffness, laws, settings, units, referent)
        for strike in metrics.strikes(touched, settings.bus.cycle_s, _changes(signals))
    ]
    chattering = [s for s in strikes if s["chatter"]]
    torque = numbers(signals, "torque_cmd")
    return {
        "law": list(dict.fromkeys(stage.wall.law for stage in settings.stages)),
        "stiffness": settings.wall.stiffness_nm_per_rad,
        "damping": settings.wall.damping_nm_s_per_rad,
        "cycle_s": settings.bus.cycle_s,
        "cycles": signals.num_rows,
        "contacts": len(touched),
        "energy_out_max_j": float(work.max(initial=0.0)),
        "energy_per_contact_j": [float(work[c.stop - 1] - work[c.start]) for c in touched],
        "chatter": bool(chattering),
        "chatter_reason": chattering[0]["chatter_reason"] if chattering else "",
        "peak_torque": float(np.abs(torque).max(initial=0.0)),
        "strikes": strikes,
    }


def _changes(signals: "pa.Table") -> Array:
    """Return the cycles at which law, stiffness, damping or position of the wall change."""
    columns = [np.from_dlpack(signals["law"].combine_chunks().indices)]
    columns += [numbers(signals, name) for name in ("stiffness", "damping", "wall_position_rad")]
    differs = np.any([np.diff(column) != 0 for column in columns], axis=0)
    return np.flatnonzero(differs).astype(float) + 1.0


def _strike(
    strike: metrics.StrikeContacts,
    y: Array,
    force: Array,
    work: Array,
    stiffness: Array,
    laws: "pa.ChunkedArray",
    settings: Settings,
    units: DriveUnits,
    referent: Array | None,
) -> dict[str, Any]:
    cycles, start = strike.cycles, strike.cycles.start
    period = settings.bus.cycle_s
    inside = y[cycles]
    tolerance = metrics.amplitude_tolerance(
        float(stiffness[start]), units.rad_per_count, units.nm_per_mille
    )
    verdict = metrics.chatter(
        inside,
        None if referent is None else referent[cycles],
        period,
        tolerance,
        units.rad_per_count,
    )
    amplitude, frequency = metrics.limit_cycle(inside, period) if verdict.chatters else (0.0, 0.0)
    running = work[cycles] - work[start]
    return {
        "start_s": start * period,
        "end_s": cycles.stop * period,
        "law": laws[start].as_py(),
        "stiffness": float(stiffness[start]),
        "contacts": len(strike.contacts),
        "peak_penetration_rad": float(-inside.min(initial=0.0)),
        "peak_force_nm": float(force[cycles].max(initial=0.0)),
        "energy_out_j": float(running[-1]),
        "energy_out_max_j": float(running.max()),
        "chatter": verdict.chatters,
        "chatter_reason": verdict.reason,
        "chatter_amplitude_rad": amplitude,
        "chatter_frequency_hz": frequency,
    }
