"""The mean of the continuous wall's force over the coming hold interval.

The held force gives the handle the velocity that the continuous wall would give it at the end of
the interval, with entry and exit inside the interval accounted for. For a mass that is the mean
of the continuous force, so an undamped wall never pulls and never gains energy.
"""

from canwall.compiled import Record, compiled
from canwall.physics import advance
from canwall.walls.interface import free_step, law


@compiled
def force_over_interval(wall: Record, y: float, v: float) -> tuple[float, float, float]:
    """Return (f, y, ẏ): force for the interval from (y, ẏ), and the referent's state at its end."""
    y_end, v_end, touched = advance(wall.referent[0], y, v, wall.d, 0.0, wall.period)
    if not touched:
        return 0.0, y_end, v_end
    _, v_free = free_step(wall, y, v, 0.0)
    return (v_end - v_free) / wall.gamma[1], y_end, v_end


@law
def mean_force(wall: Record) -> float:
    """F = (v_ref(T) − (Φ·x)_v)/Γ_v − d, where the continuous wall acts within the interval."""
    force, _, _ = force_over_interval(wall, wall.y, wall.v)
    return force
