"""What is measured of a wall: one definition each, used by summaries, sweeps and figures.

Positions y are relative to the wall (y < 0 inside) at the SYNCs, forces f are those held from
each SYNC to the next, positive out of the wall. See theory, section 5.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

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
class Strike:
    """Contacts that belong together: one strike of the hand on the wall."""

    cycles: slice
    contacts: tuple[slice, ...]


def strikes(touched: list[slice], cycle_s: float, boundaries: Array | None = None) -> list[Strike]:
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
    return [Strike(slice(g[0].start, g[-1].stop), tuple(g)) for g in groups]


@dataclass(frozen=True)
class Chatter:
    """Whether a wall chattered, and what says so."""

    chatters: bool
    reason: str


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
    window = max(1, round(EVENT_WINDOW_S / cycle_s))
    # A wall that loses some energy bounces as its referent does, only earlier: it is the busiest
    # window of each that is compared, not window by window.
    events = _events(y, window, count)
    expected = 0 if referent is None else _events(referent, window, count)
    if events - expected >= EVENTS_OF_CHATTER:
        compared = "without a referent" if referent is None else f"the referent {expected}"
        return Chatter(
            True,
            f"{events} makes and breaks within {EVENT_WINDOW_S * 1e3:.0f} ms, {compared}",
        )
    if referent is None:
        return Chatter(False, "too few makes and breaks; amplitude not judged without a referent")
    settled = settled_stretch(referent, tolerance)
    if (settled.stop - settled.start) * cycle_s < SETTLED_S:
        return Chatter(False, "the referent never settles; amplitude not judged")
    # The wall may come to rest somewhat later than the referent, and leave its rest somewhat
    # before it: what lasts is judged, over the middle of the stretch.
    length = settled.stop - settled.start
    rest = slice(settled.start + length // 2, settled.start + length * 9 // 10)
    measured, own = float(np.ptp(y[rest])), float(np.ptp(referent[rest]))
    compared = f"{measured:.3g} peak to peak about the settled contact, referent {own:.3g}"
    return Chatter(measured - own > tolerance, f"{compared}, quantisation explains {tolerance:.3g}")


def _events(y: Array, window: int, count: float) -> int:
    """The most makes and breaks of contact within any window of cycles.

    Contact is made below 0 and broken above one count: to and fro between two counts at the
    surface, as the last bit of a resting encoder may go, is neither.
    """
    side = np.where(y < 0.0, -1, np.where(y > count, 1, 0))
    decided = np.flatnonzero(side)
    changes = np.zeros(len(y), np.int64)
    changes[decided[1:]] = side[decided[1:]] != side[decided[:-1]]
    if len(changes) <= window:
        return int(changes.sum())
    return int(sliding_window_view(changes, window).sum(axis=1).max())


def settled_stretch(referent: Array, tolerance: float) -> slice:
    """The longest stretch, inside the wall, over which the referent stays within `tolerance`."""
    best = slice(0, 0)
    start, low, high = 0, np.inf, -np.inf
    for j, position in enumerate(referent):
        low, high = min(low, position), max(high, position)
        if position >= 0.0:
            start, low, high = j + 1, np.inf, -np.inf
        elif high - low > tolerance:
            # Begin anew after the last position that is too far from this one.
            far = np.abs(referent[start : j + 1] - position) > tolerance
            start += int(np.flatnonzero(far)[-1]) + 1
            low, high = float(referent[start : j + 1].min()), float(referent[start : j + 1].max())
        if j + 1 - start > best.stop - best.start:
            best = slice(start, j + 1)
    return best


def limit_cycle(y: Array, cycle_s: float) -> tuple[float, float]:
    """Amplitude (half peak to peak) and frequency [Hz] (upward crossings of the mean) of y."""
    if len(y) < 2:
        return 0.0, 0.0
    above = y > y.mean()
    rises = np.flatnonzero(above[1:] & ~above[:-1])
    frequency = 0.0
    if len(rises) > 1:
        frequency = (len(rises) - 1) / ((rises[-1] - rises[0]) * cycle_s)
    return float(np.ptp(y)) / 2.0, float(frequency)
