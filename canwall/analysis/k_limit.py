"""The K-limit: the largest stiffness free of chatter (theory, section 5), by bisection in log K."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.strike import MEASURES

#: Where the search begins and between what it stays: K·T²/m.
FIRST, SMALLEST, LARGEST = 1.0 / 512.0, 1e-5, 4.0
#: Width in log K at which a bracket is narrow enough.
RESOLUTION = 0.01

#: One strike of a search: its own limit, whether that is but the end of the search, the worst
#: limit of all strikes [N·m/rad], and what is measured of the strike there (zero stiffness: NaN).
LIMITED = np.dtype(
    [("limit", "f8"), ("open_ended", "?"), ("worst", "f8"), *MEASURES.descr], align=True
)


class Strike(Protocol):
    """A strike that can be repeated on one wall after another."""

    @property
    def mass(self) -> float:
        """Inertia of what really moves [kg·m²]."""
        ...

    @property
    def period(self) -> float:
        """T [s]."""
        ...

    def on(self, stiffness: float, damping: float) -> np.void:
        """Measure it on a wall of that stiffness [N·m/rad] and damping; dtype MEASURES."""
        ...


def k_limits(strikes: Sequence[Strike], damping: float) -> NDArray[np.void]:
    """Limits of all strikes on a wall of that damping [N·m·s/rad]; shape (n,), dtype LIMITED.

    The worst is free of chatter for every one of them, not only the least of their limits.
    """
    found = np.zeros(len(strikes), LIMITED)
    unit = strikes[0].mass / strikes[0].period ** 2
    for i, strike in enumerate(strikes):
        free, taken = bracket(functools.partial(_is_free, strike, unit, damping))
        found["limit"][i], found["open_ended"][i] = free * unit, math.isinf(taken)
    worst = found["limit"].min()
    while worst > 0.0:
        measured = [strike.on(worst, damping) for strike in strikes]
        if not any(m["chatters"] for m in measured):
            for name in MEASURES.names or ():
                found[name] = [m[name] for m in measured]
            break
        # Free at its own limit, a strike may chatter below it.
        worst *= math.exp(-RESOLUTION)
        if worst < SMALLEST * unit:
            worst = 0.0
    if worst == 0.0:
        for name in MEASURES.names or ():
            found[name] = math.nan if MEASURES[name].kind == "f" else 0
    found["worst"] = worst
    return found


def _is_free(strike: Strike, unit: float, damping: float, normalised: float) -> bool:
    return not strike.on(normalised * unit, damping)["chatters"]


def bracket(is_free: Callable[[float], bool]) -> tuple[float, float]:
    """(the largest that is free, one that is not) no further apart than RESOLUTION in the log.

    Goes up by factors of two from FIRST until one is not free. Where the first is not, goes down;
    and where none is down there (a soft wall may be too soft to hold the hand), up to one that
    is. (0, …) where none is free at all, (…, inf) where all are from there to LARGEST.
    """
    steps = math.floor(math.log2(LARGEST / FIRST))
    up = [FIRST * 2.0**n for n in range(steps + 1)]
    down = [FIRST * 0.5**n for n in range(1, math.floor(math.log2(FIRST / SMALLEST)) + 1)]
    free, taken = 0.0, math.inf
    if not is_free(up[0]):
        taken = up.pop(0)
        for at in down:
            if is_free(at):
                free = at
                break
            taken = at
    if free == 0.0:
        for at in up:
            if is_free(at):
                free, taken = at, math.inf
            elif free > 0.0:
                taken = at
                break
    while free > 0.0 and math.isfinite(taken) and math.log(taken / free) >= RESOLUTION:
        at = math.sqrt(free * taken)
        if is_free(at):
            free = at
        else:
            taken = at
    return free, taken
