"""The plain wall: a spring on the sampled position (Table 5.1, with the sign put right)."""

from canwall.compiled import Record
from canwall.walls.interface import law


@law
def standard(wall: Record) -> float:
    """f = −K·y[j] while the sample is inside."""
    if wall.y_sample >= 0.0:
        return 0.0
    return -wall.stiffness * wall.y_sample
