"""A damped wall whose damper ignores slow motion.

One of Rosenberg's variants (section 5.2.2). Below the threshold the velocity of a quantised
position is mostly noise; without it the damping can be higher.
"""

from canwall.compiled import Record
from canwall.walls.interface import sampled_law

#: threshold: speed up to which nothing is damped.
OPTIONS = {"threshold": 0.1}


@sampled_law
def thresholded_damper(wall: Record) -> float:
    """F = −K·y[j] − B·(ẏ[j] beyond ±threshold) while the sample is inside."""
    if wall.y_sample >= 0.0:
        return 0.0
    threshold = wall.options.threshold
    beyond = wall.v_sample - min(max(wall.v_sample, -threshold), threshold)
    return -wall.stiffness * wall.y_sample - wall.damping * beyond
