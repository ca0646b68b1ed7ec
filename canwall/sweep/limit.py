"""The K-limit: the largest stiffness free of chatter (theory, section 5), by bisection in log K."""

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from canwall.sweep.measures import MEASURES
from canwall.sweep.strike import Strike

#: Where the search begins and between what it stays: K·T²/m.
FIRST, SMALLEST, LARGEST = 1.0 / 512.0, 1e-5, 4.0
#: Width in log K at which a bracket is narrow enough.
RESOLUTION = 0.01

#: One strike of a search: its own limit, whether that is but the end of the search, the worst
#: limit of all strikes [N·m/rad], and what is measured of the strike there (zero stiffness: NaN).
LIMITED = np.dtype(
    [("limit", "f8"), ("open_ended", "?"), ("worst", "f8"), *MEASURES.descr], align=True
)


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

    Goes up by factors of two from FIRST until one is not free, down where the first is not.
    (0, …) where none is free down to SMALLEST, (…, inf) where all are up to LARGEST.
    """
    free, taken, at = 0.0, math.inf, FIRST
    while SMALLEST <= at <= LARGEST:
        if is_free(at):
            free = at
        else:
            taken = at
        if free > 0.0 and taken < math.inf:
            if math.log(taken / free) < RESOLUTION:
                break
            at = math.sqrt(free * taken)
        else:
            at *= 2.0 if free > 0.0 else 0.5
    return free, taken
