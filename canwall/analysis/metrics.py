"""What is measured of a wall: one definition each, used by summaries, sweeps and figures.

Positions y are relative to the wall (y < 0 inside) at the SYNCs, forces f are those held from
each SYNC to the next, positive out of the wall. See theory, section 5.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import compiled

Array = NDArray[np.float64]

#: Contacts that follow one another within this time belong to one strike of the hand [s].
STRIKE_GAP_S = 0.2
#: Make and break events are counted within this time; that many more than the referent's are
#: chatter.
EVENT_WINDOW_S = 0.2
EVENTS_OF_CHATTER = 3
#: The shortest stretch over which a settled position is judged [s].
SETTLED_S = 0.05


def energy_out(y: Array, force: Array) -> Array:
    """Running energy W[j] = Σ f·(y[j+1] − y[j]) that the wall has put out [J]; shape (n,).

    Exact, because f is held over each interval. y and force have shape (n,); W[0] = 0. A passive
    wall never exceeds 0.
    """
    work = np.zeros(len(y))
    np.cumsum(force[:-1] * np.diff(y), out=work[1:])
    return work


def contacts(y: Array, force: Array) -> list[slice]:
    """The contacts as slices of cycles: inside the wall, or outside with its force still held.

    A slice runs from the first such cycle up to and with the first cycle after it, so that the
    energy over it is complete.
    """
    touching = np.concatenate([[False], (y < 0.0) | (force != 0.0), [False]])
    edges = np.flatnonzero(np.diff(touching.astype(np.int8)))
    return [
        slice(int(start), min(int(end) + 1, len(y)))
        for start, end in zip(edges[::2], edges[1::2], strict=True)
    ]


@dataclass(frozen=True)
class StrikeContacts:
    """Contacts that belong together: one strike of the hand on the wall."""

    cycles: slice
    contacts: tuple[slice, ...]


def strikes(
    touched: list[slice], cycle_s: float, boundaries: Array | None = None
) -> list[StrikeContacts]:
    """Group contacts into strikes: a gap of STRIKE_GAP_S, or a boundary, begins a new one.

    `boundaries` are cycles at which the wall was changed, e.g. its law exchanged.
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
    """Whether a wall chattered, and what says so."""

    chatters: bool
    reason: str


@compiled
def amplitude_tolerance(stiffness: float, count: float, force_step: float) -> float:
    """Motion that quantisation alone explains: max(6·Δ, 3·f_LSB/K) [rad or m]."""
    return max(6.0 * count, 3.0 * force_step / stiffness if stiffness > 0.0 else 0.0)


def chatter(
    y: Array, referent: Array | None, cycle_s: float, tolerance: float, count: float
) -> Chatter:
    """Judge one strike: y and the continuous referent's positions over its cycles, shape (n,).

    count is one encoder count, tolerance `amplitude_tolerance` [both as y].
    Chatter is motion about the settled contact by more than `tolerance` beyond the referent's
    own, or EVENTS_OF_CHATTER makes and breaks within EVENT_WINDOW_S that the referent does not
    make. Without a referent (a person at the handle) only the events can be judged.
    """
    # A wall that loses some energy bounces as its referent does, only earlier: it is the busiest
    # window of each that is compared, not window by window.
    window = event_window(cycle_s)
    events = most_events(y, window, count)
    expected = 0 if referent is None else most_events(referent, window, count)
    if events - expected >= EVENTS_OF_CHATTER:
        compared = "without a referent" if referent is None else f"the referent {expected}"
        return Chatter(
            True,
            f"{events} makes and breaks within {EVENT_WINDOW_S * 1e3:.0f} ms, {compared}",
        )
    if referent is None:
        return Chatter(False, "too few makes and breaks; amplitude not judged without a referent")
    start, stop = rest_of(referent, tolerance, cycle_s)
    if start == stop:
        return Chatter(False, "the referent never settles; amplitude not judged")
    measured, own = peak_to_peak(y[start:stop]), peak_to_peak(referent[start:stop])
    compared = f"{measured:.3g} peak to peak about the settled contact, referent {own:.3g}"
    return Chatter(measured - own > tolerance, f"{compared}, quantisation explains {tolerance:.3g}")


@compiled
def event_window(cycle_s: float) -> int:
    """EVENT_WINDOW_S in cycles."""
    return max(1, round(EVENT_WINDOW_S / cycle_s))


@compiled
def most_events(y: Array, window: int, count: float) -> int:
    """The most makes and breaks of contact within any window of cycles.

    Contact is made below 0 and broken above one count: to and fro between two counts at the
    surface, as the last bit of a resting encoder may go, is neither.
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
def _settled(referent: Array, tolerance: float) -> tuple[int, int]:
    best_start = best_stop = start = 0
    low, high = np.inf, -np.inf
    for j in range(len(referent)):
        position = referent[j]
        low, high = min(low, position), max(high, position)
        if position >= 0.0:
            start, low, high = j + 1, np.inf, -np.inf
        elif high - low > tolerance:
            # Begin anew after the last position that is too far from this one.
            low = high = position
            start = j
            while abs(referent[start - 1] - position) <= tolerance:
                start -= 1
                low, high = min(low, referent[start]), max(high, referent[start])
        if j + 1 - start > best_stop - best_start:
            best_start, best_stop = start, j + 1
    return best_start, best_stop


def settled_stretch(referent: Array, tolerance: float) -> slice:
    """The longest stretch, inside the wall, over which the referent stays within `tolerance`."""
    return slice(*_settled(referent, tolerance))


@compiled
def rest_of(referent: Array, tolerance: float, cycle_s: float) -> tuple[int, int]:
    """First cycle, and the one after the last, over which a settled contact is judged.

    (0, 0) where the referent settles for less than SETTLED_S. The wall may come to rest somewhat
    later than the referent, and leave its rest somewhat before it: what lasts is judged, over the
    middle of the stretch.
    """
    start, stop = _settled(referent, tolerance)
    length = stop - start
    if length * cycle_s < SETTLED_S:
        return 0, 0
    return start + length // 2, start + length * 9 // 10


@compiled
def peak_to_peak(y: Array) -> float:
    """Largest less smallest; 0 of nothing."""
    if len(y) == 0:
        return 0.0
    low = high = y[0]
    for value in y:
        low, high = min(low, value), max(high, value)
    return high - low


@compiled
def limit_cycle(y: Array, cycle_s: float) -> tuple[float, float]:
    """Amplitude (half peak to peak) and frequency [Hz] (upward crossings of the mean) of y."""
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
