"""Summary of a run: metrics of its record, strike by strike."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canwall.analysis import metrics
from canwall.analysis.felt import band_rms, felt_band, handle_radius
from canwall.analysis.restitution import SPAN, first_bounce, swing_samples
from canwall.analysis.strike import first_depth, least_in_contact, pressed_cycle
from canwall.config import Settings
from canwall.record.columns import Phase
from canwall.record.folder import numbers
from canwall.units import DriveUnits

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]

#: Keys of a strike (docs/formats.md).
STRIKE_KEYS = (
    "start_s",
    "end_s",
    "law",
    "stiffness",
    "contacts",
    "peak_penetration_rad",
    "first_depth_rad",
    "referent_first_depth_rad",
    "restitution",
    "peak_force_nm",
    "energy_out_j",
    "energy_out_max_j",
    "chatter",
    "chatter_reason",
    "chatter_by",
    "felt_ripple_n",
    "chatter_amplitude_rad",
    "chatter_frequency_hz",
    "stiffness_in_force",
    "stiffness_in_force_least",
    "mass_est_kg_m2",
    "mass_spread",
    "delay_est_cycles",
)
#: Shortest contact whose ripple is judged without a referent to tell where it settles [s].
_LONG_CONTACT_S = 0.2
_SOURCE = ", estimated from the torque"


def summarise(
    signals: "pa.Table",
    settings: Settings,
    units: DriveUnits,
    referent: Array | None,
    referent_felt: Array | None,
    thrown: bool = False,
) -> dict[str, Any]:
    """Return energy, contacts and chatter of a run.

    Args:
        signals: Record of the run, one row per cycle.
        settings: Configuration of the run.
        units: Scales of the drive.
        referent: Positions at the continuous wall at the same SYNCs, shape (n,); None if a person
            was at the handle.
        referent_felt: Mean forces on the hand there [N·m], shape (n,), or None.
        thrown: True if the wall threw the handle beyond limits that the referent keeps.
    """
    y, force = numbers(signals, "y"), numbers(signals, "force_applied")
    stiffness, laws = numbers(signals, "stiffness"), signals["law"]
    rendering = numbers(signals, "phase") == Phase.RENDERING
    # A wall that moves, to which y is relative, is no motion of the handle.
    handle = y + settings.wall.orientation * numbers(signals, "wall_position_rad")
    work = metrics.energy_out(handle, force)
    touched = metrics.contacts(np.where(rendering, y, np.inf), force)
    if touched and touched[0].start == (begin := int(np.argmax(rendering))):
        # The handle was inside at the start, and the wall fades in around it: nothing has struck.
        faded = begin + round(settings.run.ramp_in_s / settings.bus.cycle_s)
        rest = slice(faded, touched[0].stop)
        touched[:1] = [rest] if rest.stop > faded + 1 else []
    names = ("stiffness_in_force", "mass_est", "mass_spread", "delay_est")
    in_force = {name: numbers(signals, name) for name in names}
    found = metrics.strikes(touched, settings.bus.cycle_s, _changes(signals))
    on_the_way = (y, force, work, stiffness, laws, settings, units, referent, referent_felt)
    strikes = [
        _strike(
            strike,
            *on_the_way,
            in_force=_in_force(strike, y, force, in_force),
            thrown=thrown and strike is found[-1],
        )
        for strike in found
    ]
    chattering = [s for s in strikes if s["chatter"]]
    torque = numbers(signals, "torque_cmd")
    return {
        "law": laws.unique().to_pylist(),
        "stiffness": settings.wall.stiffness_nm_per_rad,
        "damping": settings.wall.damping_nm_s_per_rad,
        "damping_ratio": settings.wall.damping_ratio or None,
        "cap": settings.wall.cap or None,
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
    asked = ("stiffness", "damping_ratio", "cap", "wall_position_rad")
    columns += [numbers(signals, name) for name in asked]
    # The damping that belongs to a damping ratio follows the mass in force.
    columns.append(np.where(columns[2] > 0.0, 0.0, numbers(signals, "damping")))
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
    referent_felt: Array | None,
    in_force: dict[str, Any],
    thrown: bool,
) -> dict[str, Any]:
    cycles, start = strike.cycles, strike.cycles.start
    period = settings.bus.cycle_s
    inside = y[cycles]
    running = work[cycles] - work[start]
    energy_tolerance = units.rad_per_count * float(np.abs(force[cycles]).max(initial=0.0))
    seen, comparison = cycles, None
    if referent is None or referent_felt is None:
        ripple, judged = _ripple_of_contact(strike, force, settings)
    else:
        outside = _last_outside(y, referent, start, units.rad_per_count)
        seen = slice(max(outside - SPAN, 0), cycles.stop)  # with the speed of approach
        tolerance = metrics.amplitude_tolerance(
            in_force["stiffness_in_force"], units.rad_per_count, units.nm_per_mille
        )
        resonance = settings.simulation.shaft_hz if settings.simulation else 0.0
        comparison = metrics.Comparison(referent[seen], tolerance, swing_samples(resonance, period))
        rest, first, last = metrics.settled_window(referent[seen], tolerance, period)
        windows = (rest + seen.start, first + seen.start, last + seen.start)
        judged = slice(*windows[1:])
        ripple = metrics.Ripple(
            _felt(force, *windows, settings), _felt(referent_felt, *windows, settings), _SOURCE
        )
    verdict = metrics.chatter(
        y[seen],
        comparison,
        period,
        units.rad_per_count,
        bool(running.max() > energy_tolerance),
        ripple,
    )
    if thrown:
        verdict = metrics.Chatter(True, "it threw the handle beyond the limits", "limits")
    amplitude = frequency = 0.0
    if verdict.chatters:
        settles = referent is not None and judged.stop > judged.start
        amplitude, frequency = metrics.limit_cycle(y[judged] if settles else inside, period)
        if verdict.by == "counts" and not settles:  # the whole contact has the hand's motion
            window = metrics.event_window(period)
            events = metrics.busiest_window(y[seen], window, units.rad_per_count)
            frequency = events / (2.0 * window * period)
    if verdict.by == "ripple":  # it may be felt within one count
        _, frequency = metrics.limit_cycle(force[judged], period)
    around = slice(max(start - 2 * SPAN, 0), cycles.stop + SPAN)
    return {
        "start_s": start * period,
        "end_s": cycles.stop * period,
        "law": laws[start].as_py(),
        "stiffness": float(stiffness[start]),
        "contacts": len(strike.contacts),
        "peak_penetration_rad": float(-inside.min(initial=0.0)),
        "first_depth_rad": _known(first_depth(inside)),
        "referent_first_depth_rad": _known(
            math.nan if referent is None else first_depth(referent[cycles])
        ),
        "restitution": _known(first_bounce(y[around], period, units.rad_per_count)[1]),
        "peak_force_nm": float(force[cycles].max(initial=0.0)),
        "energy_out_j": float(running[-1]),
        "energy_out_max_j": float(running.max()),
        "chatter": verdict.chatters,
        "chatter_reason": verdict.reason,
        "chatter_by": verdict.by,
        "felt_ripple_n": _known(ripple.measured),
        "chatter_amplitude_rad": amplitude,
        "chatter_frequency_hz": frequency,
        **in_force,
    }


def _last_outside(y: Array, referent: Array, start: int, count: float) -> int:
    """Return the last cycle up to the start of a strike in which wall and referent are not touched.

    From there on both make contact, also if the wall acts ahead of its surface.
    """
    begin = max(start - 2 * SPAN, 0)
    outside = np.flatnonzero(np.minimum(y, referent)[begin : start + 1] > count)
    return begin + int(outside[-1]) if len(outside) else start


def _in_force(
    strike: metrics.StrikeContacts, y: Array, force: Array, in_force: dict[str, Array]
) -> dict[str, Any]:
    """Return what the cycle made of the wall that was asked for, and of the operator."""
    stiffness = in_force["stiffness_in_force"]
    last = strike.cycles.start + pressed_cycle(y[strike.cycles], force[strike.cycles])
    return {
        "stiffness_in_force": float(stiffness[last]),
        "stiffness_in_force_least": least_in_contact(
            y[strike.cycles], force[strike.cycles], stiffness[strike.cycles]
        ),
        "mass_est_kg_m2": float(in_force["mass_est"][last]),
        "mass_spread": float(in_force["mass_spread"][last]),
        "delay_est_cycles": float(in_force["delay_est"][last]),
    }


def _felt(force: Array, start: int, first: int, last: int, settings: Settings) -> float:
    """Return the r.m.s. of a force in the felt band over [first, last), at the handle [N]."""
    radius = handle_radius(settings.mechanics.handle_radius_m)
    band = felt_band(settings.bus.cycle_s)
    return band_rms(band, force[start:last], first - start, last - start) / radius


def _ripple_of_contact(
    strike: metrics.StrikeContacts, force: Array, settings: Settings
) -> tuple[metrics.Ripple, slice]:
    """Return the ripple of the longest contact, if it is long enough to have settled, and where."""
    longest = max(strike.contacts, key=lambda contact: contact.stop - contact.start)
    first, last = metrics.judged_part(longest.start, longest.stop)
    if (longest.stop - longest.start) * settings.bus.cycle_s < _LONG_CONTACT_S:
        return metrics.Ripple(), slice(first, last)
    felt = _felt(force, longest.start, first, last, settings)
    return metrics.Ripple(felt, 0.0, _SOURCE), slice(first, last)


def _known(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
