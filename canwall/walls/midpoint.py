"""The wall at the middle of the coming hold interval, by straight extrapolation.

For an undamped wall the determinant of the sampled contact is exactly 1 for any mass: this is the
simplest law that gains no energy from the hold, and it needs no model beyond the state.
"""

from canwall.compiled import Record
from canwall.walls.interface import law


@law
def midpoint(wall: Record) -> float:
    """F = −K·(y + ẏ·T/2) − B·ẏ while the state at actuation is inside."""
    if wall.y >= 0.0:
        return 0.0
    return -wall.stiffness * (wall.y + 0.5 * wall.period * wall.v) - wall.damping * wall.v
