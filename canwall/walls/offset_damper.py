"""A damped wall whose damper begins at another depth than its spring.

One of Rosenberg's variants (section 5.2.2). A damper that begins deeper than the spring makes the
release clean; one that begins before the surface brakes the approach.
"""

from canwall.compiled import Record
from canwall.walls.interface import sampled_law
from canwall.walls.standard import spring

#: offset: where the damper begins, relative to the spring's surface (negative: inside).
OPTIONS = {"offset": -0.002}


@sampled_law
def offset_damper(wall: Record) -> float:
    """F = −K·y[j] inside, −B·ẏ[j] below the offset."""
    force = spring(wall)
    if wall.y_sample < wall.options.offset:
        force -= wall.damping * wall.v_sample
    return force
