"""Design in the digital domain (5.12, 5.13): state feedback that places the referent's poles.

The sampled plant gets the eigenvalues of the continuous mass on the wall (Ackermann; the chapter
says Aizerman). Frequency and decay of the motion match, its samples do not: the amplitude of the
position is off by (θ/2)/tan(θ/2).
"""

import math

from canwall.compiled import Record, compiled
from canwall.physics import basis
from canwall.walls.deadbeat import compensated
from canwall.walls.interface import law


@compiled
def placing_gains(wall: Record) -> tuple[float, float]:
    """Return k of f = −k·x, from Ackermann's formula k = [0 1]·[Γ ΦΓ]⁻¹·p(Φ)."""
    period = wall.period
    own_damping, own_stiffness = wall.viscous / wall.mass, wall.spring / wall.mass
    damping = own_damping + wall.damping / wall.mass
    stiffness = own_stiffness + wall.stiffness / wall.mass
    _, own_h, own_g, _ = basis(own_damping, own_stiffness, period)
    _, h, g, _ = basis(damping, stiffness, period)
    phi, gamma = wall.phi, wall.gamma
    g1, g2 = gamma[0], gamma[1]
    h1 = phi[0, 0] * g1 + phi[0, 1] * g2
    h2 = phi[1, 0] * g1 + phi[1, 1] * g2
    # By Cayley-Hamilton p(Φ) = (tr Φ − tr)·Φ + (det − det Φ)·I. Both traces are 2 − 2κ·∫h − β·h
    # and both determinants e^(−βT): in this form small terms do not come from cancellation.
    a = 2.0 * (stiffness * g - own_stiffness * own_g) + (damping * h - own_damping * own_h)
    b = math.exp(-own_damping * period) * math.expm1(-(damping - own_damping) * period)
    area = g1 * h2 - g2 * h1  # det [Γ ΦΓ]
    # The last row of its inverse is [−g2, g1]/area.
    k1 = (-g2 * (a * phi[0, 0] + b) + g1 * a * phi[1, 0]) / area
    k2 = (-g2 * a * phi[0, 1] + g1 * (a * phi[1, 1] + b)) / area
    return k1, k2


@compiled
def placed_force(wall: Record) -> float:
    """Return the state feedback about the equilibrium under the bias force, while inside."""
    if wall.y >= 0.0:
        return 0.0
    k1, k2 = placing_gains(wall)
    # The equilibrium under a bias force has to be that of the wall, which holds −K·y_eq there.
    stiffness = wall.spring + wall.stiffness
    y_eq = wall.d / stiffness if stiffness > 0.0 else 0.0
    return -k1 * wall.y - k2 * wall.v - (wall.stiffness - k1) * y_eq


@law
def pole_placement(wall: Record) -> float:
    """F = −K·y_eq − k·(x − x_eq) while the state at actuation is inside."""
    return placed_force(wall)


@law
def pole_placement_deadbeat(wall: Record) -> float:
    """F of pole_placement, with deadbeat compensation of the last two forces of each contact."""
    return compensated(wall, placed_force(wall))
