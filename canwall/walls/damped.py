"""The spring-damper wall (5.1)."""

from canwall.compiled import Record
from canwall.walls.interface import sampled_law


@sampled_law
def damped(wall: Record) -> float:
    """F = −K·y[j] − B·ẏ[j] while the sample is inside."""
    if wall.y_sample >= 0.0:
        return 0.0
    return -wall.stiffness * wall.y_sample - wall.damping * wall.v_sample
