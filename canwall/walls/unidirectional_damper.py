"""A damped wall that damps only while the handle moves in, so that it does not stick on leaving.

One of Rosenberg's variants (section 5.2.2).
"""

from canwall.compiled import Record
from canwall.walls.interface import sampled_law


@sampled_law
def unidirectional_damper(wall: Record) -> float:
    """F = −K·y[j] − B·min(ẏ[j], 0) while the sample is inside."""
    if wall.y_sample >= 0.0:
        return 0.0
    return -wall.stiffness * wall.y_sample - wall.damping * min(wall.v_sample, 0.0)
