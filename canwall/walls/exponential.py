"""The exponential spring: soft at the surface, ever stiffer inside.

One of Rosenberg's variants (section 5.2.2). K is the stiffness at the surface; each further
`length` of depth makes the wall e times as stiff.
"""

import math

from canwall.compiled import Record
from canwall.walls.interface import sampled_law

#: length: depth over which the stiffness grows by a factor e.
OPTIONS = {"length": 0.02}

# exp() overflows far beyond it; no drive reaches these forces.
_LARGEST_EXPONENT = 50.0


@sampled_law
def exponential(wall: Record) -> float:
    """F = K·L·(exp(−y[j]/L) − 1) while the sample is inside."""
    if wall.y_sample >= 0.0:
        return 0.0
    length = wall.options.length
    if not length > 0.0:
        return math.nan  # no wall: the run ends, and says that the law returned no number
    depth = min(-wall.y_sample / length, _LARGEST_EXPONENT)
    return wall.stiffness * length * math.expm1(depth)
