"""Metrics of a wall (theory, section 5): energy, contacts, strikes and chatter.

Positions y are relative to the wall at each SYNC, y < 0 inside. Forces f are held from each SYNC
to the next, positive out of the wall. Units: rad and N·m, or m and N.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import compiled

Array = NDArray[np.float64]

#: Contacts that follow one another within this time belong to one strike of the hand [s].
STRIKE_GAP_S = 0.2
#: Window in which makes and breaks of contact are counted [s].
EVENT_WINDOW_S = 0.2
#: Makes and breaks in a window, beyond the referent's, from which on a wall chatters.
EVENTS_OF_CHATTER = 3
#: Shortest stretch over which a settled position is judged [s].
SETTLED_S = 0.05


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
    """Verdict on a strike: whether the wall chattered, and the reason in words."""

    chatters: bool
    reason: str


@compiled
def amplitude_tolerance(stiffness: float, count: float, force_step: float) -> float:
    """Return the motion that quantisation alone explains: max(6·Δ, 3·f_LSB/K) [rad or m]."""
    return max(6.0 * count, 3.0 * force_step / stiffness if stiffness > 0.0 else 0.0)


def chatter(
    y: Array, referent: Array | None, cycle_s: float, tolerance: float, count: float
) -> Chatter:
    """Judge whether a wall chattered in one strike.

    Chatter is motion about the settled contact that exceeds the referent's by more than
    `tolerance`, or EVENTS_OF_CHATTER more makes and breaks of contact within EVENT_WINDOW_S than
    the referent has. Without a referent (a person at the handle) only the events are judged.

    Args:
        y: Positions relative to the wall over the strike, shape (n,).
        referent: Positions of the continuous referent, shape (n,), or None.
        cycle_s: Period of the SYNC [s].
        tolerance: `amplitude_tolerance`, in the unit of y.
        count: One encoder count, in the unit of y.
    """
    # The busiest window of each is compared, not window by window: a wall that loses some energy
    # bounces as its referent does, only earlier.
    window = event_window(cycle_s)
    events = busiest_window(y, window, count)
    expected = 0 if referent is None else busiest_window(referent, window, count)
    if events - expected >= EVENTS_OF_CHATTER:
        compared = "without a referent" if referent is None else f"the referent {expected}"
        return Chatter(
            True,
            f"{events} makes and breaks within {EVENT_WINDOW_S * 1e3:.0f} ms, {compared}",
        )
    if referent is None:
        return Chatter(False, "too few makes and breaks; amplitude not judged without a referent")
    start, stop = settled_window(referent, tolerance, cycle_s)
    if start == stop:
        return Chatter(False, "the referent never settles; amplitude not judged")
    measured, own = peak_to_peak(y[start:stop]), peak_to_peak(referent[start:stop])
    compared = f"{measured:.3g} peak to peak about the settled contact, referent {own:.3g}"
    return Chatter(measured - own > tolerance, f"{compared}, quantisation explains {tolerance:.3g}")


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
def settled_window(referent: Array, tolerance: float, cycle_s: float) -> tuple[int, int]:
    """Return the window in which the motion about a settled contact is judged.

    It is the middle of the settled stretch: the wall may come to rest later than the referent and
    leave its rest earlier. As its first cycle and the one after its last; (0, 0) if the referent
    settles for less than SETTLED_S.
    """
    start, stop = settled_stretch(referent, tolerance)
    length = stop - start
    if length * cycle_s < SETTLED_S:
        return 0, 0
    return start + length // 2, start + length * 9 // 10


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
