"""Speeds into and out of a contact: the restitution of the first, and contacts that kick.

Positions y are relative to the wall at each SYNC, y < 0 inside, in rad or m.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import compiled

Array = NDArray[np.float64]

#: Samples over which speeds before and after a contact, and the rise of the force, are averaged.
SPAN = 5
#: Speed out over speed in beyond which a contact kicks.
KICK = 1.1


def swing_samples(shaft_hz: float, period: float) -> int:
    """Return the samples in a period of the shaft's resonance, 1 for a rigid one (0 Hz).

    Within it the rotor, whose position is measured, swings about the handle.
    """
    return max(1, math.ceil(1.0 / (shaft_hz * period))) if shaft_hz else 1


@compiled
def kicks(y: Array, referent: Array, count: float, least: int) -> bool:
    """Return True if a contact is left more than KICK times as fast as it was entered.

    A contact of the referent that is left faster, as where the hand pulls, is allowed for.

    Args:
        y: Positions at the wall, shape (n,).
        referent: Positions at the continuous referent, shape (n,).
        count: One encoder count, in the unit of y.
        least: Least samples over which a speed is averaged, `swing_samples`.
    """
    largest = largest_restitution(y, count, least)
    return largest > KICK and largest > KICK * largest_restitution(referent, count, least)


@compiled
def largest_restitution(y: Array, count: float, least: int) -> float:
    """Return the largest speed out over speed in of all contacts, 0 if none is left.

    Of the speeds that a quantised position allows these are the least out and the most in, so that
    it is not too large: both are the fastest of means over `least` to SPAN samples next to the
    contact, less and plus one count.
    """
    largest, start = 0.0, 0
    while start < len(y):
        enter, leave = _next_contact(y, start)
        if start < enter and leave < len(y):
            fastest_in = _most_in(y, start, enter, count, least)
            largest = max(largest, _least_out(y, leave, count, least) / fastest_in)
        start = leave
    return largest


@compiled
def _next_contact(y: Array, start: int) -> tuple[int, int]:
    """Return the first sample inside from `start` on, and the first outside after it.

    len(y) for what there is not.
    """
    enter = start
    while enter < len(y) and y[enter] >= 0.0:
        enter += 1
    leave = enter
    while leave < len(y) and y[leave] < 0.0:
        leave += 1
    return enter, leave


@compiled
def _most_in(y: Array, start: int, enter: int, count: float, least: int) -> float:
    """Return the fastest mean up to the first sample inside, and a count.

    In radians a sample. Means that end up to SPAN samples earlier count as well: a wall may act
    ahead of its surface. start: the first sample outside; if that is less than `least` samples
    ago, all of them.
    """
    least = min(least, enter - start)
    fastest = count
    for end in range(max(enter - SPAN, start + least), enter + 1):
        for begin in range(max(end - max(SPAN, least), start), end - least + 1):
            fastest = max(fastest, (y[begin] - y[end] + count) / (end - begin))
    return fastest


@compiled
def _least_out(y: Array, leave: int, count: float, least: int) -> float:
    """Return the fastest mean from the last sample inside or the first outside, less a count.

    In radians a sample. leave: the first sample outside. A handle that is inside again within
    `least` samples has not left.
    """
    fastest = 0.0
    for end in range(leave, min(leave + max(SPAN, least) + 1, len(y))):
        if y[end] < 0.0:
            break
        for begin in range(leave - 1, min(leave, end - least) + 1):
            fastest = max(fastest, (y[end] - y[begin] - count) / (end - begin))
    return fastest


@compiled
def first_bounce(y: Array, period: float, count: float) -> tuple[float, float]:
    """Return the speed into the first contact and the restitution; NaN if there is none.

    Both speeds are the fastest of means: of those over SPAN samples outside, and of those between
    the samples next to the contact, less a count, since hand and friction change the speed within
    SPAN samples. On approach all means count that end within the last SPAN samples before the
    contact: a wall may act ahead of its surface.
    Where a wall has stopped the handle before its surface, it creeps in: below a count a sample its
    speed says nothing, and the restitution is the speed on leaving over a count a sample.
    """
    enter, leave = _next_contact(y, 0)
    if enter <= SPAN or enter >= len(y):
        return math.nan, math.nan
    approach = _fastest_crossing(y, enter, -1, count)
    for j in range(max(enter - SPAN, SPAN), enter):
        approach = max(approach, (y[j - SPAN] - y[j]) / SPAN)
    back = leave
    while back < len(y) and back < leave + SPAN and y[back] >= 0.0:
        back += 1
    if approach == 0.0 or back == len(y):
        return -approach / period, math.nan
    out = _fastest_crossing(y, leave - 1, 1, count)
    if y[back] >= 0.0:
        out = max(out, (y[back] - y[leave]) / SPAN)
    return -approach / period, out / max(approach, count)


@compiled
def _fastest_crossing(y: Array, inside: int, step: int, count: float) -> float:
    """Return the fastest mean from a sample inside to one of the next SPAN outside, less a count.

    In radians a sample; that quantisation makes a way longer shall not make it faster. step: 1 for
    the samples after the one inside, −1 for those before it.
    """
    fastest = 0.0
    for n in range(1, SPAN + 1):
        outside = inside + step * n
        if not 0 <= outside < len(y) or y[outside] < 0.0:
            break
        fastest = max(fastest, (y[outside] - y[inside] - count) / n)
    return fastest
