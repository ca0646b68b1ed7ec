"""A rigid stop: the limit of the mean force for K → ∞, bounded by the drive's torque alone.

Its referent reverses the velocity at the surface instantly, scaled by the restitution. Where a
finite torque lets the handle through, it is brought back to the surface by a share of its depth
per period. Stiffness and damping have no effect on its force.
"""

from canwall.compiled import Record, compiled
from canwall.physics import flow, time_to_wall
from canwall.walls.interface import free_step, law

#: restitution: 0 plastic … 1 elastic; recovery: share of the depth taken back per period.
OPTIONS = {"restitution": 0.0, "recovery": 0.2}


@compiled
def _velocity_after_impact(wall: Record) -> float:
    """Return the referent's velocity at the end of an interval in which it strikes the surface."""
    referent, period = wall.referent[0], wall.period
    impact = time_to_wall(referent, wall.y, wall.v, wall.d, period)
    _, v_impact = flow(wall.mass, wall.viscous, wall.spring, wall.y, wall.v, wall.d, 0.0, impact)
    y_end, v_end = flow(
        wall.mass,
        wall.viscous,
        wall.spring,
        0.0,
        -wall.options.restitution * v_impact,
        wall.d,
        0.0,
        period - impact,
    )
    # Pressed back onto the stop before the interval is over: it rests there.
    return v_end if y_end > 0.0 else 0.0


@law
def rigid(wall: Record) -> float:
    """F = (v_ref(T) − (Φ·x)_v)/Γ_v − d ≥ 0 of the stop."""
    y_free, v_free = free_step(wall, wall.y, wall.v, 0.0)
    if wall.y >= 0.0:
        if y_free >= 0.0:
            return 0.0
        v_wanted = _velocity_after_impact(wall)
    else:
        v_out = -wall.options.restitution * wall.v if wall.v < 0.0 else v_free
        v_wanted = max(v_out, -wall.options.recovery * wall.y / wall.period)
    return max((v_wanted - v_free) / wall.gamma[1], 0.0)
