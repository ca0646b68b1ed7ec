"""Deadbeat compensation for switching between two samples (5.14–5.24), over any law.

At the last sample outside, the contact ahead is known from the referent: when it ends, so at
which sample n the handle is outside again, and in which state. The last two forces of the
contact drive it there exactly. n is predicted, not read off the sign of y (5.16 is acausal), and
kept: the law underneath may bring the handle out a sample early.
"""

import math

from canwall.compiled import Record, compiled
from canwall.physics import contact_end, flow
from canwall.walls.interface import free_step

# Places in the law's memory: periods left until sample n, the state wanted there, and the last
# of the two planned forces.
_LEFT, _Y, _V, _LAST = 0, 1, 2, 3


@compiled
def two_forces(
    wall: Record, y: float, v: float, y_wanted: float, v_wanted: float
) -> tuple[float, float]:
    """The two forces that take (y, ẏ) to the wanted state in two periods (5.24, in order).

    The bias force is an input as well: it is taken off.
    """
    phi, gamma = wall.phi, wall.gamma
    y1, v1 = free_step(wall, y, v, 0.0)
    y2, v2 = free_step(wall, y1, v1, 0.0)
    g1, g2 = gamma[0], gamma[1]
    h1 = phi[0, 0] * g1 + phi[0, 1] * g2
    h2 = phi[1, 0] * g1 + phi[1, 1] * g2
    area = h1 * g2 - h2 * g1
    ry, rv = y_wanted - y2, v_wanted - v2
    return (ry * g2 - rv * g1) / area, (h1 * rv - h2 * ry) / area


@compiled
def first_sample_outside(wall: Record) -> tuple[int, float, float]:
    """Of the contact that is on or begins within one period: (n, y, ẏ) of the referent.

    n counts the periods from now to the first sample after the contact. (0, 0, 0) where there is
    no contact, or one without an end.
    """
    referent = wall.referent[0]
    end, v_end = contact_end(referent, wall.y, wall.v, wall.d, wall.period)
    if not end < math.inf:
        return 0, 0.0, 0.0
    n = int(end / wall.period) + 1
    y, v = flow(
        wall.mass, wall.viscous, wall.spring, 0.0, v_end, wall.d, 0.0, n * wall.period - end
    )
    return n, y, v


@compiled
def compensated(wall: Record, force: float) -> float:
    """`force` of the law underneath, or what the plan for the end of the contact says."""
    memory = wall.memory
    left = memory[_LEFT]
    if left == 1.0:
        memory[_LEFT] = 0.0
        return memory[_LAST]
    if left == 0.0:
        n, memory[_Y], memory[_V] = first_sample_outside(wall)
        if n == 0:
            return force
        if n == 1:
            # Two forces take two periods: the handle is on its way out for the second one.
            memory[_Y], memory[_V] = free_step(wall, memory[_Y], memory[_V], 0.0)
            n = 2
        left = float(n)
    memory[_LEFT] = left - 1.0
    if left > 2.0:
        return force
    first, memory[_LAST] = two_forces(wall, wall.y, wall.v, memory[_Y], memory[_V])
    return first
