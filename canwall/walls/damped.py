"""The spring-damper wall (5.1), its velocity the backward difference of the samples."""

from canwall.compiled import Record
from canwall.walls.interface import law


@law
def damped(wall: Record) -> float:
    """f = −K·y[j] − B·(y[j] − y[j−1])/T while the sample is inside."""
    if wall.y_sample >= 0.0:
        return 0.0
    return -wall.stiffness * wall.y_sample - wall.damping * wall.v_sample
