"""The layers over any law: how tension is treated, and the passivity observer and controller.

Both keep the books of one contact: `absorbed` is what the operator has put into the wall and not
yet got back, reckoned at the instants at which the forces take effect. Credit ends with the
contact: what an earlier one left behind may not be spent on making the next one active.
"""

from canwall.compiled import Record, compiled
from canwall.walls.interface import call_law, free_step

#: What may happen where a law pulls (f < 0).
TENSION = {"allow": 0, "clamp": 1, "budget": 2}
_CLAMP, _BUDGET = TENSION["clamp"], TENSION["budget"]


@compiled
def wall_force(address: int, wall: Record) -> float:
    """Force of the law at `address` after tension policy and passivity controller."""
    # K and B may have been changed since the last call; they stand in one place for that.
    wall.referent[0].wall_stiffness = wall.stiffness
    wall.referent[0].wall_damping = wall.damping
    _observe_energy(wall)
    force = call_law(address, wall)
    if force < 0.0:
        force = _tension(wall, force)
    if wall.passivity_damping > 0.0:
        force = _passivity_control(wall, force)
    return force


@compiled
def set_applied_force(wall: Record, force: float) -> None:
    """Take note of the force that will be applied: after saturation and rounding."""
    wall.y_before = wall.y
    wall.force_before = force


@compiled
def _observe_energy(wall: Record) -> None:
    """Hannaford and Ryu's observer, exact for a held force: E −= f·(y[j] − y[j−1])."""
    if wall.force_before == 0.0 and wall.y >= 0.0:
        wall.absorbed = 0.0
    else:
        wall.absorbed -= wall.force_before * (wall.y - wall.y_before)


@compiled
def _tension(wall: Record, force: float) -> float:
    """A pull as the policy allows it: all, none, or what the energy absorbed so far pays for."""
    if wall.tension == _CLAMP:
        return 0.0
    if wall.tension == _BUDGET:
        y_next, _ = free_step(wall, wall.y, wall.v, force)
        if force * (y_next - wall.y) > max(wall.absorbed, 0.0):
            return 0.0
    return force


@compiled
def _passivity_control(wall: Record, force: float) -> float:
    """Damping that takes back, within one period, what the wall has put out beyond its credit.

    α = −E/(T·v²), held to the largest damping that is allowed: at v ≈ 0 no damping takes energy,
    and the division would ask for an endless one.
    """
    if wall.absorbed >= 0.0:
        return force
    needed = -wall.absorbed
    largest = wall.passivity_damping
    available = wall.period * wall.v * wall.v
    damping = largest if needed >= largest * available else needed / available
    return force - damping * wall.v
