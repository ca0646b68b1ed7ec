"""Metrics of a wall (docs/results.md): energy, contacts, strikes and chatter.

What is felt of a wall at rest is in `felt`.

Positions y are relative to the wall at each SYNC, y < 0 inside. Forces f are held from each SYNC
to the next, positive out of the wall. Units: rad and N·m, or m and N.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.felt import FELT_BAND_HZ, QUIET_N
from canwall.analysis.restitution import kicks, largest_restitution
from canwall.compiled import compiled

Array = NDArray[np.float64]

#: Contacts that follow one another within this time belong to one strike of the hand [s].
STRIKE_GAP_S = 0.2
#: Window in which makes and breaks of contact are counted [s].
EVENT_WINDOW_S = 0.2
#: Makes and breaks in a window, beyond the referent's, from which on a wall chatters.
EVENTS_OF_CHATTER = 3
#: Makes and breaks over the referent's, up to which they are no chatter where no energy came out.
EVENTS_RATIO = 1.25
#: Shortest stretch over which a settled position is judged [s].
SETTLED_S = 0.05
#: Beginning and end of the time in which a wall comes to rest after its referent has [s].
SETTLING_S = (0.02, 0.2)

#: Relative rounding of a motion, the difference of two positions.
_ROUNDING = 1e-9


def energy_out(y: Array, force: Array) -> Array:
    """Return the energy that the wall has put out up to each SYNC: W[j] = Σ f·(y[j+1] − y[j]).

    The sum is exact, because f is held over each interval. A passive wall never exceeds 0.

    Args:
        y: Positions relative to the wall, shape (n,).
        force: Held forces, shape (n,).

    Returns:
        Energy [J], shape (n,), W[0] = 0.
    """
    work = np.zeros(len(y))
    np.cumsum(force[:-1] * np.diff(y), out=work[1:])
    return work


def contacts(y: Array, force: Array) -> list[slice]:
    """Return the contacts as slices of cycles.

    The handle is in contact while it is inside the wall, or outside with a force still held. A
    slice includes the first cycle after the contact, so that the energy over it is complete.

    Args:
        y: Positions relative to the wall, shape (n,).
        force: Held forces, shape (n,).
    """
    touching = np.concatenate([[False], (y < 0.0) | (force != 0.0), [False]])
    edges = np.flatnonzero(np.diff(touching.astype(np.int8)))
    return [
        slice(int(start), min(int(end) + 1, len(y)))
        for start, end in zip(edges[::2], edges[1::2], strict=True)
    ]


@dataclass(frozen=True)
class StrikeContacts:
    """Contacts of one strike of the hand on the wall."""

    cycles: slice
    contacts: tuple[slice, ...]


def strikes(
    touched: list[slice], cycle_s: float, boundaries: Array | None = None
) -> list[StrikeContacts]:
    """Group contacts into strikes: a gap of STRIKE_GAP_S or a boundary begins a new one.

    Args:
        touched: Contacts in order, as from `contacts`.
        cycle_s: Period of the SYNC [s].
        boundaries: Cycles at which the wall changed, for example its law.
    """
    gap = STRIKE_GAP_S / cycle_s
    cuts = np.asarray([] if boundaries is None else boundaries)
    groups: list[list[slice]] = []
    for contact in touched:
        last = groups[-1][-1] if groups else None
        apart = last is None or contact.start - last.stop > gap
        if apart or np.any((cuts > last.start) & (cuts <= contact.start)):  # type: ignore[union-attr]
            groups.append([])
        groups[-1].append(contact)
    return [StrikeContacts(slice(g[0].start, g[-1].stop), tuple(g)) for g in groups]


@dataclass(frozen=True)
class Chatter:
    """Verdict on a strike.

    Attributes:
        chatters: True if the wall chattered.
        reason: The reason in words.
        by: The criterion that found chatter, the first of several; empty without chatter. "limits":
            the handle was thrown beyond limits that the referent keeps.
    """

    chatters: bool
    reason: str
    by: Literal["", "counts", "kick", "amplitude", "ripple", "limits"] = ""


@dataclass(frozen=True)
class Ripple:
    """Felt ripple of a strike [N], r.m.s. at the handle; NaN where nothing settles.

    Attributes:
        measured: That of the wall.
        referent: That of the continuous referent.
        source: Origin of the force, for the words of the verdict.
    """

    measured: float = math.nan
    referent: float = 0.0
    source: str = ""


@dataclass(frozen=True)
class Comparison:
    """Motion that the wall's is compared with.

    Attributes:
        referent: Positions of the continuous referent, shape (n,).
        tolerance: `amplitude_tolerance`, by which a motion may exceed it, in the unit of y.
        swing_samples: Samples in a period of the shaft's resonance, over which speeds are compared.
    """

    referent: Array
    tolerance: float
    swing_samples: int = 1


@compiled
def amplitude_tolerance(stiffness: float, count: float, force_step: float) -> float:
    """Return the motion that quantisation alone explains: max(6·Δ, 3·f_LSB/K) [rad or m]."""
    return max(6.0 * count, 3.0 * force_step / stiffness if stiffness > 0.0 else 0.0)


@compiled
def moves_more(motion: float, referent: float, tolerance: float) -> bool:
    """Return True if a motion exceeds the referent's by more than `amplitude_tolerance`.

    Exactly six counts do not: as a difference of positions they may come out longer by a rounding.
    """
    return motion - referent > (1.0 + _ROUNDING) * tolerance


def chatter(
    y: Array,
    comparison: Comparison | None,
    cycle_s: float,
    count: float,
    gives_energy: bool = True,
    ripple: Ripple | None = None,
) -> Chatter:
    """Judge whether a wall chattered in one strike.

    Chatter is more makes and breaks of contact than the referent has (`bounces_more`), a contact
    that is left faster than it was entered (`restitution.kicks`), motion about the settled contact
    that exceeds the referent's by more than the tolerance, or a felt ripple that exceeds the
    referent's by more than QUIET_N. Without a referent (a person at the handle, who may pull) kicks
    and motion are not judged.

    Args:
        y: Positions relative to the wall over the strike, shape (n,).
        comparison: The referent, or None.
        cycle_s: Period of the SYNC [s].
        count: One encoder count, in the unit of y.
        gives_energy: True if the wall put out energy in the strike.
        ripple: Felt ripple, if it is known.
    """
    ripple = Ripple() if ripple is None else ripple
    # The busiest window of each is compared, not window by window: a wall that loses some energy
    # bounces as its referent does, only earlier.
    window = event_window(cycle_s)
    events = busiest_window(y, window, count)
    expected = 0 if comparison is None else busiest_window(comparison.referent, window, count)
    if bounces_more(events, expected, gives_energy):
        compared = "without a referent" if comparison is None else f"the referent {expected}"
        reason = f"{events} makes and breaks within {EVENT_WINDOW_S * 1e3:.0f} ms, {compared}"
        return Chatter(True, reason, "counts")
    felt = (
        f"felt ripple {ripple.measured:.2g} N r.m.s. in {FELT_BAND_HZ[0]:g}–{FELT_BAND_HZ[1]:g} Hz"
        f"{ripple.source}, quiet up to {QUIET_N:g} N"
    )
    ripples = is_felt(ripple.measured, ripple.referent)
    if comparison is None:
        if ripples:
            return Chatter(True, felt, "ripple")
        return Chatter(False, "too few makes and breaks; amplitude not judged without a referent")
    referent, tolerance = comparison.referent, comparison.tolerance
    swing_samples = comparison.swing_samples
    _, start, stop = settled_window(referent, tolerance, cycle_s)
    until = judged_until(start, stop, len(y))
    if kicks(y[:until], referent[:until], count, swing_samples):
        times = largest_restitution(y[:until], count, swing_samples)
        return Chatter(
            True, f"a contact is left {times:.3g} times as fast as it was entered", "kick"
        )
    if start == stop:
        return Chatter(False, "the referent never settles; amplitude not judged")
    measured, own = peak_to_peak(y[start:stop]), peak_to_peak(referent[start:stop])
    compared = f"{measured:.3g} peak to peak about the settled contact, referent {own:.3g}"
    reason = f"{compared}, quantisation explains {tolerance:.3g}"
    if moves_more(measured, own, tolerance):
        return Chatter(True, reason, "amplitude")
    return Chatter(True, felt, "ripple") if ripples else Chatter(False, reason)


@compiled
def bounces_more(events: int, expected: int, gives_energy: bool) -> bool:
    """Return True if makes and breaks of contact in the busiest window are chatter.

    Those are EVENTS_OF_CHATTER more than the referent's. Of a wall that gave no energy they also
    have to be EVENTS_RATIO times as many: 25 against 21 are the bounces of a passive wall.
    """
    if events - expected < EVENTS_OF_CHATTER:
        return False
    return gives_energy or events > EVENTS_RATIO * expected


@compiled
def is_felt(ripple: float, referent: float) -> bool:
    """Return True if a felt ripple exceeds the referent's by more than QUIET_N [N]."""
    return ripple - referent > QUIET_N


@compiled
def event_window(cycle_s: float) -> int:
    """Return EVENT_WINDOW_S in cycles."""
    return max(1, round(EVENT_WINDOW_S / cycle_s))


@compiled
def busiest_window(y: Array, window: int, count: float) -> int:
    """Return the largest number of makes and breaks of contact in any `window` cycles.

    Contact is made below 0 and broken above one count, so the last bit of an encoder at rest on
    the surface does not count.
    """
    changed = np.zeros(len(y), np.bool_)
    side = within = most = 0
    for j in range(len(y)):
        now = -1 if y[j] < 0.0 else (1 if y[j] > count else 0)
        if now != 0:
            changed[j] = side != 0 and now != side
            side = now
        within += changed[j]
        if j >= window:
            within -= changed[j - window]
        most = max(most, within)
    return most


@compiled
def settled_stretch(referent: Array, tolerance: float) -> tuple[int, int]:
    """Return the longest stretch inside the wall over which the referent stays within `tolerance`.

    As its first cycle and the one after its last.
    """
    best_start = best_stop = start = 0
    low, high = np.inf, -np.inf
    for j in range(len(referent)):
        position = referent[j]
        low, high = min(low, position), max(high, position)
        if position >= 0.0:
            start, low, high = j + 1, np.inf, -np.inf
        elif high - low > tolerance:
            # Start again after the last position that is too far from this one.
            low = high = position
            start = j
            while abs(referent[start - 1] - position) <= tolerance:
                start -= 1
                low, high = min(low, referent[start]), max(high, referent[start])
        if j + 1 - start > best_stop - best_start:
            best_start, best_stop = start, j + 1
    return best_start, best_stop


@compiled
def settled_window(referent: Array, tolerance: float, cycle_s: float) -> tuple[int, int, int]:
    """Return the settled stretch and the window in it in which motion and force are judged.

    The window is `judged_part`: the wall may come to rest later than the referent and leave its
    rest earlier. As the first cycle of the stretch, the first of the window and the one after its
    last; (0, 0, 0) if the referent settles for less than SETTLED_S.
    """
    start, stop = settled_stretch(referent, tolerance)
    if (stop - start) * cycle_s < SETTLED_S:
        return 0, 0, 0
    first, last = judged_part(start, stop)
    return start, first, last


@compiled
def judged_part(start: int, stop: int) -> tuple[int, int]:
    """Return the part of a stretch in which the wall is at rest: its second half but the end."""
    length = stop - start
    return start + length // 2, start + length * 9 // 10


@compiled
def judged_until(start: int, stop: int, cycles: int) -> int:
    """Return the cycle up to which contacts are judged, before the hand leaves where it settles."""
    return stop if stop > start else cycles


@compiled
def settling_part(rest: int, start: int, cycle_s: float) -> tuple[int, int]:
    """Return the part of a stretch in which a wall comes to rest after its referent.

    It ends before the part that is judged, which begins at `start`, and is empty where nothing is.
    """
    begin, end = SETTLING_S
    return rest + round(begin / cycle_s), min(rest + round(end / cycle_s), start)


@compiled
def peak_to_peak(y: Array) -> float:
    """Return the largest value minus the smallest; 0 for an empty array."""
    if len(y) == 0:
        return 0.0
    low = high = y[0]
    for value in y:
        low, high = min(low, value), max(high, value)
    return high - low


@compiled
def limit_cycle(y: Array, cycle_s: float) -> tuple[float, float]:
    """Return amplitude (half peak to peak) and frequency [Hz] (crossings of the mean) of y."""
    if len(y) < 2:
        return 0.0, 0.0
    mean = y.mean()
    rises, first, last = 0, 0, 0
    for j in range(1, len(y)):
        if y[j] > mean and not y[j - 1] > mean:
            first = j if rises == 0 else first
            last = j
            rises += 1
    frequency = (rises - 1) / ((last - first) * cycle_s) if rises > 1 else 0.0
    return 0.5 * peak_to_peak(y), frequency
