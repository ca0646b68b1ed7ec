"""Deadbeat to the continuous wall for the whole contact, two periods at a time.

Every second sample two forces are planned such that two periods later the state is the one that
the continuous wall would have reached: exact in energy for any stiffness, through entry and exit.
It pulls where that takes a pull, and it depends on its model.

A contact of an odd number of periods begins with a single force, whose error the first plan
corrects; so the last plan ends at the first sample outside, not one later.
"""

from canwall.compiled import Record, compiled
from canwall.physics import advance
from canwall.walls.deadbeat import first_sample_outside, two_forces
from canwall.walls.interface import law
from canwall.walls.mean_force import force_over_interval

# Places in the law's memory: what the next step is, and the planned force or the state to reach.
_STEP, _SECOND, _Y, _V = 0, 1, 2, 3
_NOTHING, _SECOND_FORCE, _FIRST_PLAN = 0.0, 1.0, 2.0


@compiled
def _plan(wall: Record, y_wanted: float, v_wanted: float) -> float:
    memory = wall.memory
    first, memory[_SECOND] = two_forces(wall, wall.y, wall.v, y_wanted, v_wanted)
    memory[_STEP] = _SECOND_FORCE
    return first


@law
def two_step(wall: Record) -> float:
    """F = f[j], f[j+1] such that x[j+2] is the exact flow of the continuous wall from x[j]."""
    memory = wall.memory
    step = memory[_STEP]
    memory[_STEP] = _NOTHING
    if step == _SECOND_FORCE:
        return memory[_SECOND]
    if step == _FIRST_PLAN:
        return _plan(wall, memory[_Y], memory[_V])
    single, y, v = force_over_interval(wall, wall.y, wall.v)
    if wall.y >= 0.0:
        if single == 0.0:
            return 0.0
        n, _, _ = first_sample_outside(wall)
        if n > 1 and n % 2 == 1:
            memory[_Y], memory[_V], _ = advance(
                wall.referent[0], y, v, wall.d, 0.0, 2.0 * wall.period
            )
            memory[_STEP] = _FIRST_PLAN
            return single
    y, v, _ = advance(wall.referent[0], y, v, wall.d, 0.0, wall.period)
    return _plan(wall, y, v)
