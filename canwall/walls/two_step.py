"""Deadbeat to the continuous wall for the whole contact, two periods at a time.

Every second sample two forces are planned, such that two periods later the state is the one the
continuous wall would have reached: exact in energy for any stiffness, through entry and exit. It
pulls where it has to, and it believes its model.
"""

from canwall.compiled import Record
from canwall.physics import advance
from canwall.walls.deadbeat import two_forces
from canwall.walls.interface import law

_PLANNED, _SECOND = 0, 1


@law
def two_step(wall: Record) -> float:
    """f[j], f[j+1] such that x[j+2] is the event-exact flow of the continuous wall from x[j]."""
    memory = wall.memory
    if memory[_PLANNED] == 1.0:
        memory[_PLANNED] = 0.0
        return memory[_SECOND]
    referent, period = wall.referent[0], wall.period
    y, v, touched = advance(referent, wall.y, wall.v, wall.d, 0.0, period)
    if not touched:
        return 0.0
    y, v, _ = advance(referent, y, v, wall.d, 0.0, period)
    first, memory[_SECOND] = two_forces(wall, wall.y, wall.v, y, v)
    memory[_PLANNED] = 1.0
    return first
