"""K-limit: the largest stiffness free of chatter (theory, section 5), by bisection in log K."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.strike import MEASURES

#: Start and bounds of the search, as K·T²/m.
FIRST, SMALLEST, LARGEST = 1.0 / 512.0, 1e-5, 4.0
#: Width of the final bracket in log K.
RESOLUTION = 0.01

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

    def on(self, stiffness: float, damping: float) -> np.void:
        """Strike a wall of this stiffness [N·m/rad] and damping [N·m·s/rad]; dtype MEASURES."""
        ...


def k_limits(strikes: Sequence[RepeatableStrike], damping: float) -> NDArray[np.void]:
    """Search the K-limit of each strike, and a stiffness at which none of them chatters.

    The worst K-limit may be below the smallest limit of a single strike: a strike that is free of
    chatter at its own limit may chatter below it.

    Args:
        strikes: Strikes with the same mass and period.
        damping: Damping of the wall [N·m·s/rad].

    Returns:
        Limits and measures of each strike, shape (n,), dtype K_LIMIT.
    """
    limits = np.zeros(len(strikes), K_LIMIT)
    unit = strikes[0].mass / strikes[0].period ** 2
    for i, strike in enumerate(strikes):
        free, chatters = bracket(functools.partial(_is_free, strike, unit, damping))
        limits["limit"][i], limits["open_ended"][i] = free * unit, math.isinf(chatters)
    worst = limits["limit"].min()
    while worst > 0.0:
        measures = [strike.on(worst, damping) for strike in strikes]
        if not any(m["chatters"] for m in measures):
            for name in MEASURES.names or ():
                limits[name] = [m[name] for m in measures]
            break
        worst *= math.exp(-RESOLUTION)
        if worst < SMALLEST * unit:
            worst = 0.0
    if worst == 0.0:
        for name in MEASURES.names or ():
            limits[name] = math.nan if MEASURES[name].kind == "f" else 0
    limits["worst"] = worst
    return limits


def _is_free(strike: RepeatableStrike, unit: float, damping: float, normalised: float) -> bool:
    return not strike.on(normalised * unit, damping)["chatters"]


def bracket(is_free: Callable[[float], bool]) -> tuple[float, float]:
    """Bracket the largest K·T²/m that is free of chatter to RESOLUTION in its logarithm.

    Doubles from FIRST until a value chatters. If FIRST itself chatters, halves until a value is
    free; if none is (a very soft wall may fail to hold the hand), doubles until one is.

    Returns:
        The largest free value, 0 if there is none, and the next that chatters, infinity if all do
        not up to LARGEST.
    """
    doublings = math.floor(math.log2(LARGEST / FIRST))
    halvings = math.floor(math.log2(FIRST / SMALLEST))
    up = [FIRST * 2.0**n for n in range(doublings + 1)]
    down = [FIRST * 0.5**n for n in range(1, halvings + 1)]
    free, chatters = 0.0, math.inf
    if not is_free(up[0]):
        chatters = up.pop(0)
        for value in down:
            if is_free(value):
                free = value
                break
            chatters = value
    if free == 0.0:
        for value in up:
            if is_free(value):
                free, chatters = value, math.inf
            elif free > 0.0:
                chatters = value
                break
    while free > 0.0 and math.isfinite(chatters) and math.log(chatters / free) >= RESOLUTION:
        middle = math.sqrt(free * chatters)
        if is_free(middle):
            free = middle
        else:
            chatters = middle
    return free, chatters
