"""The hand on the simulated drive's handle: what it wants, period by period.

The hand is a mass, a spring and a damper about a moving hand position, and a muscle torque
(theory, section 1). By its script it strikes: it goes to where it presses, stays, and withdraws.
It moves as hands do, with the least jerk (Flash and Hogan 1985). At each SYNC it is exactly on
that path, between two of them on the straight line that joins them, so that over one period all
its forces are affine functions of time and the motion stays exact.
"""

import numpy as np
from numpy.typing import NDArray

from canwall.config import Hand

Array = NDArray[np.float64]


def pressing(hand: Hand, period_s: float, periods: int) -> Array:
    """How far the hand has gone from resting (0) to pressing (1), at SYNC 0 … periods.

    Shape (periods + 1,). Each strike takes approach_s, press_s and withdraw_s; after the last one
    the hand rests.
    """
    times, stages = [0.0], [0.0]
    for strike in range(hand.strikes):
        start = hand.first_strike_s + strike * hand.interval_s
        arrived = start + hand.approach_s
        leaving = arrived + hand.press_s
        times += [start, arrived, leaving, leaving + hand.withdraw_s]
        stages += [0.0, 1.0, 1.0, 0.0]
    s = np.interp(np.arange(periods + 1) * period_s, times, stages)
    # Minimum jerk from rest to rest.
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def hand_path(hand: Hand, period_s: float, periods: int) -> Array:
    """Hand position [rad] at SYNC 0 … periods; shape (periods + 1,)."""
    stage = pressing(hand, period_s, periods)
    return hand.rest_rad + (hand.press_rad - hand.rest_rad) * stage


def hand_force(hand: Hand, period_s: float, periods: int) -> tuple[Array, Array]:
    """Force of the hand on the handle, (u₀, u₁) of u₀ + u₁·t in each period; both (periods,).

    u₀ [N·m] and u₁ [N·m/s] on the drive's axis. The part that depends on the handle's own
    position and velocity is not in it: it is the plant's (`motion.hand_plant`).
    """
    path = hand_path(hand, period_s, periods)
    torque = hand.press_torque_nm * pressing(hand, period_s, periods)
    speed = np.diff(path) / period_s
    spring, damper = hand.stiffness_nm_per_rad, hand.damping_nm_s_per_rad
    constant = spring * path[:-1] + damper * speed + torque[:-1]
    return constant, spring * speed + np.diff(torque) / period_s
