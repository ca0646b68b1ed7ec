"""Half-sample prediction (Table 5.4): the wall law at the state half a hold interval ahead.

The prediction follows the referent, the mass on the wall, not the mass under the held force; its
damping is the plant's and the wall's together, and the bias force moves its equilibrium.
Table 5.4 writes the argument as t + T/2; it restarts at every sample and carries ω₀.
"""

from canwall.compiled import Record, compiled
from canwall.physics import flow
from canwall.walls.deadbeat import compensated
from canwall.walls.interface import law


@compiled
def predicted_force(wall: Record) -> float:
    """Return −K·y(T/2) − B·ẏ(T/2) of the referent while the state at actuation is inside."""
    if wall.y >= 0.0:
        return 0.0
    y_half, v_half = flow(
        wall.mass,
        wall.viscous + wall.damping,
        wall.spring + wall.stiffness,
        wall.y,
        wall.v,
        wall.d,
        0.0,
        0.5 * wall.period,
    )
    return -wall.stiffness * y_half - wall.damping * v_half


@law
def half_sample(wall: Record) -> float:
    """F = −K·y(T/2) − B·ẏ(T/2) of the referent while the state at actuation is inside."""
    return predicted_force(wall)


@law
def half_sample_deadbeat(wall: Record) -> float:
    """F of half_sample, with deadbeat compensation of the last two forces of each contact."""
    return compensated(wall, predicted_force(wall))
