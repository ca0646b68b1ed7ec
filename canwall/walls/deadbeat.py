"""Deadbeat compensation for switching between two samples (5.14–5.24), over any law.

At the last sample outside, the referent tells the contact ahead: when it ends, hence the sample n
at which the handle is outside again, and its state there. The last two forces of the contact drive
it there exactly. n is predicted, not read off the sign of y (5.16 is acausal), and kept: the law
underneath may bring the handle out a sample early.

It is kept as long as the handle is where the forces should have brought it. Where it is not (the
model is wrong, a force was clamped, the operator moves), a new plan is made from where it is, since
the last two forces of a stale plan grow with m/T² times its error. Only the last force goes out as
planned: it is too late for another two.
"""

import math

from canwall.compiled import Record, compiled
from canwall.physics import advance, contact_end
from canwall.walls.interface import free_step

# Places in the memory of a law that plans: periods left until sample n, the state wanted there, the
# last of the two planned forces, and the state expected at the next sample.
LEFT, WANTED_Y, WANTED_V, LAST, EXPECTED_Y, EXPECTED_V = 0, 1, 2, 3, 4, 5

#: Largest deviation from the expected state, relative to its size, that rounding accounts for.
_ROUNDING = 1e-7


@compiled
def two_forces(
    wall: Record, y: float, v: float, y_wanted: float, v_wanted: float
) -> tuple[float, float]:
    """Return the two forces that take (y, ẏ) to the wanted state in two periods (5.24, in order).

    The bias force is an input as well, so it is subtracted.
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
    """Return (n, y, ẏ) of the referent after the contact that is on or begins within one period.

    n counts the periods from now to the first sample after the contact. (0, 0, 0) if there is no
    contact, or one without an end.
    """
    referent = wall.referent[0]
    end, v_end = contact_end(referent, wall.y, wall.v, wall.d, wall.period)
    if not end < math.inf:
        return 0, 0.0, 0.0
    n = int(end / wall.period) + 1
    # In the rest of that period the handle may enter the wall again.
    y, v, _ = advance(referent, 0.0, v_end, wall.d, 0.0, n * wall.period - end)
    return n, y, v


@compiled
def expect(wall: Record, force: float) -> float:
    """Record the state that `force` should lead to at the next sample; return the force."""
    memory = wall.memory
    memory[EXPECTED_Y], memory[EXPECTED_V] = free_step(wall, wall.y, wall.v, force)
    return force


@compiled
def is_as_expected(wall: Record) -> bool:
    """Return True if the handle is where the last force should have brought it."""
    dy = abs(wall.y - wall.memory[EXPECTED_Y])
    dv = abs(wall.v - wall.memory[EXPECTED_V])
    size = abs(wall.y) + wall.period * abs(wall.v)
    return dy + wall.period * dv <= _ROUNDING * size


@compiled
def plan_contact(wall: Record) -> int:
    """Return the periods left of the contact: as planned, or of a new plan after a deviation.

    0 if no contact lies ahead, or one without an end. At least 2 for a new plan: two forces take
    two periods; in a shorter contact the handle is on its way out during the second.
    """
    memory = wall.memory
    left = int(memory[LEFT])
    if left > 1 and not is_as_expected(wall):
        left = 0
    if left == 0:
        left, memory[WANTED_Y], memory[WANTED_V] = first_sample_outside(wall)
        if left == 1:
            memory[WANTED_Y], memory[WANTED_V], _ = advance(
                wall.referent[0], memory[WANTED_Y], memory[WANTED_V], wall.d, 0.0, wall.period
            )
            left = 2
    memory[LEFT] = float(max(left - 1, 0))
    return left


@compiled
def compensated(wall: Record, force: float) -> float:
    """Return `force`, of the law underneath, or the planned one at the end of the contact."""
    memory = wall.memory
    left = plan_contact(wall)
    if left == 1:
        return memory[LAST]
    if left == 2:
        force, memory[LAST] = two_forces(wall, wall.y, wall.v, memory[WANTED_Y], memory[WANTED_V])
    return expect(wall, force)
