"""The plain wall: a spring on the sampled position (Table 5.1, with the sign put right)."""

from canwall.compiled import Record, compiled
from canwall.walls.interface import sampled_law


@compiled
def spring(wall: Record) -> float:
    """Return −K·y[j] while the sample is inside."""
    return -wall.stiffness * wall.y_sample if wall.y_sample < 0.0 else 0.0


@sampled_law
def standard(wall: Record) -> float:
    """F = −K·y[j] while the sample is inside."""
    return spring(wall)
