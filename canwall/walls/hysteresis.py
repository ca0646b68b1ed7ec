"""A spring with hysteresis: it releases earlier, or softer, than it engages.

The energy dissipated makes up for what sampling adds. Two kinds in one: the wall engages at the
surface and releases at the depth `release`, and while the handle moves out, the stiffness is
`softening` times K.
"""

from canwall.compiled import Record
from canwall.walls.interface import sampled_law

#: softening: stiffness on the way out over K; release: depth at which the wall lets go.
OPTIONS = {"softening": 0.8, "release": 0.0}


@sampled_law
def hysteresis(wall: Record) -> float:
    """F = −K·y[j] moving in, −softening·K·y[j] moving out, 0 above −release moving out."""
    if wall.y_sample >= 0.0:
        return 0.0
    if wall.v_sample <= 0.0:
        return -wall.stiffness * wall.y_sample
    if wall.y_sample > -wall.options.release:
        return 0.0
    return -wall.options.softening * wall.stiffness * wall.y_sample
