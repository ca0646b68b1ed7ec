"""Measures of one strike: the metrics of docs/results.md, at one point of a sweep."""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.analysis import metrics
from canwall.analysis.felt import FeltBand, band_rms
from canwall.analysis.restitution import SPAN, first_bounce, kicks
from canwall.compiled import Record, compiled

Array = NDArray[np.float64]

#: Measures of one strike, described in MEASURE_DESCRIPTIONS. What cannot be measured is NaN.
MEASURES = np.dtype(
    [
        ("chatters", "?"),
        ("chatters_counts", "?"),
        ("chatters_kick", "?"),
        ("chatters_amplitude", "?"),
        ("chatters_ripple", "?"),
        ("settled", "?"),
        ("trip", "i1"),
        ("alarms", "i4"),
        ("contacts", "i4"),
        ("events", "i4"),
        ("referent_events", "i4"),
        ("motion", "f8"),
        ("referent_motion", "f8"),
        ("tolerance", "f8"),
        ("ripple", "f8"),
        ("referent_ripple", "f8"),
        ("settling_ripple", "f8"),
        ("amplitude", "f8"),
        ("frequency", "f8"),
        ("energy_out", "f8"),
        ("energy_end", "f8"),
        ("energy_tolerance", "f8"),
        ("peak_torque", "f8"),
        ("penetration", "f8"),
        ("stiffness_in_force", "f8"),
        ("stiffness_in_force_least", "f8"),
        ("mass_est", "f8"),
        ("first_depth", "f8"),
        ("referent_first_depth", "f8"),
        ("rate_hardness", "f8"),
        ("restitution", "f8"),
        ("referent_restitution", "f8"),
    ],
    align=True,
)

#: (unit, description) of each of the MEASURES.
MEASURE_DESCRIPTIONS = {
    "chatters": (
        "1",
        "chatter by docs/results.md, or a trip while the referent stays within the limits",
    ),
    "chatters_counts": ("1", "chatter by makes and breaks of contact"),
    "chatters_kick": ("1", "chatter by a contact that is left faster than it was entered"),
    "chatters_amplitude": ("1", "chatter by the motion about the settled contact"),
    "chatters_ripple": ("1", "chatter by the felt ripple"),
    "settled": ("1", "the referent settles, so that motion and ripple can be judged"),
    "trip": ("1", "the limit that ended the strike (cycle.Trip), 0: none"),
    "alarms": ("1", "alarms of the guard"),
    "contacts": ("1", "contacts of the strike"),
    "events": ("1", "makes and breaks of contact within the busiest 200 ms"),
    "referent_events": ("1", "the same of the continuous referent"),
    "motion": ("rad", "peak to peak about the settled contact"),
    "referent_motion": ("rad", "the same of the continuous referent"),
    "tolerance": ("rad", "motion that quantisation explains"),
    "ripple": ("N", "felt ripple: force on the hand, r.m.s. in 20-500 Hz, at the handle"),
    "referent_ripple": ("N", "the same of the continuous referent"),
    "settling_ripple": ("N", "felt ripple from 20 to 200 ms after the referent has come to rest"),
    "amplitude": ("rad", "half peak to peak of the chatter, 0: none"),
    "frequency": ("Hz", "frequency of the chatter, 0: none"),
    "energy_out": ("J", "most energy that the wall had put out at any time"),
    "energy_end": ("J", "energy that the wall had put out at the end: area of the loop f(y)"),
    "energy_tolerance": ("J", "one encoder count times the peak torque"),
    "peak_torque": ("N*m", "largest torque commanded"),
    "penetration": ("rad", "deepest position inside the wall"),
    "stiffness_in_force": ("N*m/rad", "K in force towards the end of the longest contact"),
    "stiffness_in_force_least": ("N*m/rad", "least K in force during a contact"),
    "mass_est": ("kg*m^2", "mass in the laws' model at the same time"),
    "first_depth": ("rad", "deepest position of the first contact"),
    "referent_first_depth": ("rad", "the same of the continuous referent"),
    "rate_hardness": ("N*m/rad", "initial rise of the force over the approach speed"),
    "restitution": ("1", "speed out over speed in, first contact"),
    "referent_restitution": ("1", "the same of the continuous referent"),
}


@compiled
def measure_strike(
    y: Array,
    force: Array,
    torque: Array,
    trip: int,
    thrown: bool,
    alarms: int,
    felt: Array,
    in_force: Array,
    referent: Array,
    referent_felt: Array,
    period: float,
    band: FeltBand,
    radius: float,
    count: float,
    torque_step: float,
    stiffness: float,
    swing_samples: int,
    measures: NDArray[np.void],
) -> None:
    """Measure one strike.

    Args:
        y: Positions relative to the wall at each SYNC [rad], shape (n,).
        force: Forces held from each SYNC on, out of the wall [N·m], shape (n,).
        torque: Commanded torques [N·m], shape (n,).
        trip: The limit that ended the strike, 0 for none.
        thrown: True if the wall threw the handle beyond limits that the referent keeps.
        alarms: Alarms of the guard.
        felt: Mean forces on the hand over each period [N·m], shape (n,).
        in_force: Stiffness in force [N·m/rad] and mass in the laws' model [kg·m²], shape (2, n).
        referent: Positions of the continuous referent [rad], shape (n,).
        referent_felt: Its mean forces on the hand [N·m], shape (n,).
        period: Period of the SYNC [s].
        band: Band of the felt ripple, from `felt.felt_band`.
        radius: Radius of the handle [m].
        count: One encoder count Δ [rad].
        torque_step: One step of torque f_LSB [N·m].
        stiffness: Stiffness asked for [N·m/rad]; without contact it counts as the one in force.
        swing_samples: Samples in a period of the shaft's resonance.
        measures: Result, shape (1,), dtype MEASURES.
    """
    into: Record = measures[0]
    window = metrics.event_window(period)
    first, after, contacts = _count_contacts(y, force)
    into.contacts = contacts
    into.stiffness_in_force = into.stiffness_in_force_least = into.mass_est = math.nan
    if contacts:
        pressed = pressed_cycle(y, force)
        into.stiffness_in_force, into.mass_est = in_force[0, pressed], in_force[1, pressed]
        into.stiffness_in_force_least = least_in_contact(y, force, in_force[0])
        stiffness = into.stiffness_in_force
    tolerance = metrics.amplitude_tolerance(stiffness, count, torque_step)
    into.trip = trip
    into.alarms = alarms
    into.tolerance = tolerance
    into.events = metrics.busiest_window(y, window, count)
    into.referent_events = metrics.busiest_window(referent, window, count)
    rest, start, stop = metrics.settled_window(referent, tolerance, period)
    into.settled = stop > start
    into.motion = metrics.peak_to_peak(y[start:stop])
    into.referent_motion = metrics.peak_to_peak(referent[start:stop])
    into.ripple = band_rms(band, felt[rest:], start - rest, stop - rest) / radius
    into.referent_ripple = band_rms(band, referent_felt[rest:], start - rest, stop - rest) / radius
    begin, end = metrics.settling_part(rest, start, period)
    into.settling_ripple = band_rms(band, felt[rest:], begin - rest, end - rest) / radius
    _integrate_energy(into, y, force)
    into.peak_torque = np.abs(torque).max() if len(torque) else 0.0
    into.energy_tolerance = count * into.peak_torque
    into.chatters_counts = metrics.bounces_more(
        into.events, into.referent_events, into.energy_out > into.energy_tolerance
    )
    until = metrics.judged_until(start, stop, len(y))
    into.chatters_kick = kicks(y[:until], referent[:until], count, swing_samples)
    into.chatters_amplitude = metrics.moves_more(into.motion, into.referent_motion, tolerance)
    into.chatters_ripple = metrics.is_felt(into.ripple, into.referent_ripple)
    moves = thrown or into.chatters_counts or into.chatters_kick or into.chatters_amplitude
    into.chatters = moves or into.chatters_ripple
    into.amplitude = into.frequency = 0.0
    if into.chatters:
        cycle = y[start:stop] if stop > start else y[first:after]
        into.amplitude, into.frequency = metrics.limit_cycle(cycle, period)
        if not moves:  # it may be felt within one count
            _, into.frequency = metrics.limit_cycle(felt[start:stop], period)
    into.penetration = max(-y.min(), 0.0) if len(y) else 0.0
    into.first_depth = first_depth(y)
    into.referent_first_depth = first_depth(referent)
    speed, into.restitution = first_bounce(y, period, count)
    _, into.referent_restitution = first_bounce(referent, period, count)
    into.rate_hardness = math.nan
    if speed < 0.0 and first + SPAN < len(force):
        into.rate_hardness = -(force[first + SPAN] - force[first]) / (SPAN * period) / speed


@compiled
def keeps_limits(
    referent: Array, position: tuple[float, float], speed: float, period: float
) -> bool:
    """Return True if the referent keeps the limits of position and speed on the drive's axis.

    A soft wall may give way that far, and a stiff one return that much of the energy put into it.
    """
    low, high = position
    for j in range(len(referent)):
        if not low <= referent[j] <= high:
            return False
        if j and not abs(referent[j] - referent[j - 1]) / period <= speed:
            return False
    return True


@compiled
def _touches(y: float, force: float) -> bool:
    """Return True in contact, as `metrics.contacts` defines it."""
    return y < 0.0 or force != 0.0


@compiled
def _count_contacts(y: Array, force: Array) -> tuple[int, int, int]:
    """Return the first cycle of contact, the one after the last, and the number of contacts."""
    first = after = contacts = 0
    touching = False
    for j in range(len(y)):
        touches = _touches(y[j], force[j])
        if touches and not touching:
            first = j if contacts == 0 else first
            contacts += 1
        touching = touches
        after = j + 1 if touches else after
    return first, after, contacts


@compiled
def pressed_cycle(y: Array, force: Array) -> int:
    """Return the cycle in which a wall is known best: the last of `judged_part`, longest contact.

    There the hand presses, and is not yet leaving.
    """
    start = best_start = best_stop = 0
    for j in range(len(y)):
        if not _touches(y[j], force[j]):
            start = j + 1
        elif j + 1 - start > best_stop - best_start:
            best_start, best_stop = start, j + 1
    _, last = metrics.judged_part(best_start, best_stop)
    return max(last - 1, best_start)


@compiled
def least_in_contact(y: Array, force: Array, values: Array) -> float:
    """Return the least of the values during contact."""
    least = math.inf
    for j in range(len(y)):
        if _touches(y[j], force[j]):
            least = min(least, values[j])
    return least


@compiled
def _integrate_energy(into: Record, y: Array, force: Array) -> None:
    """Store the largest and the last value of `metrics.energy_out`, without the array."""
    work = most = 0.0
    for j in range(len(y) - 1):
        work += force[j] * (y[j + 1] - y[j])
        most = max(most, work)
    into.energy_out, into.energy_end = most, work


@compiled
def first_depth(y: Array) -> float:
    """Return the deepest position inside the wall of the first contact; NaN if there is none."""
    deepest = 0.0
    for position in y:
        deepest = max(deepest, -position)
        if deepest > 0.0 and position >= 0.0:
            break
    return deepest if deepest > 0.0 else math.nan
