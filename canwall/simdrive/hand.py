"""The hand on the simulated drive's handle: where it wants to be, period by period.

The hand is a mass, a spring and a damper about a moving hand position (theory, section 1). The
script moves that position along straight lines; a corner lies on a SYNC, so over one period it
is an affine function of time and the motion stays exact.
"""

import numpy as np
from numpy.typing import NDArray

from canwall.config import Hand


def hand_path(hand: Hand, period_s: float, periods: int) -> NDArray[np.float64]:
    """Hand position [rad] at SYNC 0 … periods; shape (periods + 1,).

    Rests at rest_rad; each strike goes to press_rad within approach_s, stays press_s, and
    withdraws within withdraw_s. After the last strike it rests.
    """
    times, positions = [0.0], [hand.rest_rad]
    for strike in range(hand.strikes):
        start = hand.first_strike_s + strike * hand.interval_s
        pressing = start + hand.approach_s
        leaving = pressing + hand.press_s
        times += [start, pressing, leaving, leaving + hand.withdraw_s]
        positions += [hand.rest_rad, hand.press_rad, hand.press_rad, hand.rest_rad]
    corners = np.round(np.asarray(times) / period_s)
    return np.interp(np.arange(periods + 1, dtype=float), corners, np.asarray(positions))
