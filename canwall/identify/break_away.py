"""The torque at which a handle at rest breaks loose, from slow ramps."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Time without torque before a ramp: what begins sooner is a torque that passes through zero [s].
_REST_S = 0.1


def break_away(
    position: Array, torque: Array, period: float, step: float, inertia: float, delay: float
) -> tuple[Array, Array, Array]:
    """Return where and at which torque a handle at rest broke loose, in a record of slow ramps.

    Each ramp begins after _REST_S without torque, and ends at zero torque. A handle that has just
    broken loose under a torque that rises with r needs (6·s·m/r)^⅓ for its first steps s, or less
    if friction falls: the torque is that at the middle of this time before they were seen. They are
    seen, and a held torque has risen, half a period late on average.

    Args:
        position: Positions at the SYNCs [rad].
        torque: Torques commanded after them [N·m].
        period: SYNC period [s].
        step: Step of the encoder [rad].
        inertia: Inertia of the handle [kg·m²].
        delay: From sample to torque [periods].

    Returns:
        Position [rad], torque [N·m], whose sign is its direction, and its uncertainty [N·m], one
        for each ramp in which the handle broke loose.
    """
    found = []
    acts = torque != 0.0
    rest_cycles = round(_REST_S / period)
    for start in np.flatnonzero(acts[1:] & ~acts[:-1]).tolist():
        if start + 1 < rest_cycles or acts[start + 1 - rest_cycles : start + 1].any():
            continue
        ends = np.flatnonzero(~acts[start + 1 :])
        end = start + 1 + int(ends[0]) if len(ends) else len(torque)
        rest = position[start]
        moved = np.flatnonzero(np.abs(position[start : end + 1] - rest) > 3.0 * step)
        if not len(moved) or moved[0] < 2:
            continue
        at = start + int(moved[0])
        rate = (torque[at - 1] - torque[start]) / (moved[0] - 1) / period
        if rate == 0.0:
            continue
        # More than three steps are at least three, and at most five.
        took = (6.0 * 4.0 * step * inertia / abs(rate)) ** (1.0 / 3.0)
        late = 0.5 * took + delay * period
        found.append((rest, torque[at - 1] - rate * late, 0.5 * abs(rate) * (took + period)))
    place, loose, error = np.array(found).reshape(-1, 3).T
    return place, loose, error
