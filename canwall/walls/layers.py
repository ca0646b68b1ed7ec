"""The layers over any law: tension policy, passivity observer and passivity controller.

All work on the energy of the present contact: `absorbed` is what the operator has put into the
wall and not yet got back, at the instants at which the forces take effect. It ends with the
contact: energy left over from one must not make the next one active.
"""

import math

from canwall.compiled import Record, compiled
from canwall.walls.interface import call_law, free_step

#: Policies for a law that pulls (f < 0): allow it, clamp to 0, or allow what was absorbed before.
TENSION = {"allow": 0, "clamp": 1, "budget": 2}
_CLAMP, _BUDGET = TENSION["clamp"], TENSION["budget"]


@compiled
def wall_force(address: int, wall: Record) -> float:
    """Return the force of the law at `address` after tension policy and passivity controller."""
    # K and B may have changed since the last call: the referent follows them.
    wall.referent[0].wall_stiffness = wall.stiffness
    wall.referent[0].wall_damping = wall.damping
    _observe_energy(wall)
    force = call_law(address, wall)
    # Of -inf a policy would make 0, and nobody would learn of it.
    if -math.inf < force < 0.0:
        force = _tension(wall, force)
    if wall.passivity_damping > 0.0:
        force = _passivity_control(wall, force)
    return force


@compiled
def set_applied_force(wall: Record, force: float) -> None:
    """Record the force that will be applied, after saturation and rounding, for the observer."""
    wall.y_before = wall.y
    wall.force_before = force


@compiled
def _observe_energy(wall: Record) -> None:
    """Update the observer of Hannaford and Ryu, exact for a held force: E −= f·(y[j] − y[j−1])."""
    if wall.force_before == 0.0 and wall.y >= 0.0:
        wall.absorbed = 0.0
    else:
        wall.absorbed -= wall.force_before * (wall.y - wall.y_before)


@compiled
def _tension(wall: Record, force: float) -> float:
    """Return the pull that the policy allows: all or none; with a budget all that E covers."""
    if wall.tension == _CLAMP:
        return 0.0
    if wall.tension == _BUDGET:
        y_next, _ = free_step(wall, wall.y, wall.v, force)
        if force * (y_next - wall.y) > max(wall.absorbed, 0.0):
            return 0.0
    return force


@compiled
def _passivity_control(wall: Record, force: float) -> float:
    """Add the damping that takes back, within one period, the energy put out beyond E = 0.

    α = −E/(T·v²), limited to the largest damping allowed: at v ≈ 0 damping takes no energy, and
    α would grow without bound.
    """
    if wall.absorbed >= 0.0:
        return force
    needed = -wall.absorbed
    largest = wall.passivity_damping
    available = wall.period * wall.v * wall.v
    damping = largest if needed >= largest * available else needed / available
    return force - damping * wall.v
