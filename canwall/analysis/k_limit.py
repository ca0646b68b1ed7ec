"""K-limit: the stiffness up to which every wall is free of chatter (docs/results.md).

Chatter is not monotone in K: a search by bisection jumps over islands of it. So walls are scanned
upwards, each strike up to its first wall that chatters.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.strike import MEASURES

#: Factor from one wall to the next, and that of the steps before the first that chatters.
FACTOR, FINE_STEPS = 1.25, 5
FINE_FACTOR = FACTOR ** (1.0 / FINE_STEPS)
#: Walls of the scan, as K·T²/m: 1e-4 to 4.5.
SCANNED = 1e-4 * FACTOR ** np.arange(49)

#: One strike of a search: its own K-limit [N·m/rad]; whether that is only the end of the search;
#: the worst K-limit of all strikes [N·m/rad]; MEASURES of the strike at the worst (NaN if it is 0).
K_LIMIT = np.dtype(
    [("limit", "f8"), ("open_ended", "?"), ("worst", "f8"), *MEASURES.descr], align=True
)


class RepeatableStrike(Protocol):
    """A strike that can be repeated on one wall after another."""

    @property
    def mass(self) -> float:
        """Inertia of everything that moves [kg·m²]."""
        ...

    @property
    def period(self) -> float:
        """Sampling period T [s]."""
        ...

    @property
    def softest(self) -> float:
        """Stiffness below which a wall does not hold the hand within the limits [N·m/rad]."""
        ...

    def on(self, stiffness: float, damping: float) -> np.void:
        """Strike a wall of this stiffness [N·m/rad] and damping [N·m·s/rad]; dtype MEASURES."""
        ...


def k_limits(strikes: Sequence[RepeatableStrike], damping: float) -> NDArray[np.void]:
    """Search the K-limit of each strike, and a stiffness up to which none of them chatters.

    Walls too soft to hold the hand are passed over where they trip. The worst K-limit may be below
    the smallest limit of a single strike: each is found on steps of its own.

    Args:
        strikes: Strikes with the same mass and period.
        damping: Damping of the wall [N·m·s/rad].

    Returns:
        Limits and measures of each strike, shape (n,), dtype K_LIMIT.
    """
    limits = np.zeros(len(strikes), K_LIMIT)
    unit = strikes[0].mass / strikes[0].period ** 2
    for i, strike in enumerate(strikes):
        limits["limit"][i], limits["open_ended"][i] = scan(strike, unit, damping)
    worst = limits["limit"].min()
    while worst > 0.0:
        measures = [strike.on(worst, damping) for strike in strikes]
        seen = zip(strikes, measures, strict=True)
        if not any(m["chatters"] and not _is_too_soft(strike, worst, m) for strike, m in seen):
            for name in MEASURES.names or ():
                limits[name] = [m[name] for m in measures]
            break
        worst /= FINE_FACTOR
        if worst < SCANNED[0] * unit:
            worst = 0.0
    if worst == 0.0:
        for name in MEASURES.names or ():
            limits[name] = math.nan if MEASURES[name].kind == "f" else 0
    limits["worst"] = worst
    return limits


def _is_too_soft(strike: RepeatableStrike, stiffness: float, measures: np.void) -> bool:
    """Return True if a wall that does not hold the hand has tripped."""
    return bool(stiffness < strike.softest and measures["trip"])


def scan(strike: RepeatableStrike, unit: float, damping: float) -> tuple[float, bool]:
    """Scan walls upwards until one chatters: by FACTOR, and anew in finer steps before that one.

    Args:
        strike: The strike.
        unit: Stiffness of K·T²/m = 1 [N·m/rad].
        damping: Damping of the walls [N·m·s/rad].

    Returns:
        The stiffness up to which every wall of the scan is free of chatter [N·m/rad], 0 if the
        first chatters; True if that is the end of the scan.
    """
    free = 0.0
    for normalised in SCANNED:
        stiffness = normalised * unit
        measures = strike.on(stiffness, damping)
        if _is_too_soft(strike, stiffness, measures):
            continue
        if measures["chatters"]:
            break
        free = stiffness
    else:
        return free, free > 0.0
    for _ in range(FINE_STEPS - 1):
        finer = free * FINE_FACTOR
        if free == 0.0 or strike.on(finer, damping)["chatters"]:
            break
        free = finer
    return free, False
