"""All forces of a contact planned at once: energy exact, and never pulling.

At the last sample outside, the contact ahead is known. Of all sequences of forces f ≥ 0 that
bring the handle, at the first sample after the contact, into the state in which the continuous
wall would have left it, the law takes the one nearest to the mean forces f̄:
min |f − f̄|² with A·f = δ, f ≥ 0. Its dual has two unknowns for any length of the contact:
f = max(0, f̄ + Aᵀ·λ), solved for λ by Newton's method with step halving. At every sample the
remaining forces are planned again, towards the same state as long as the handle is where it was
expected (`deadbeat`).
"""

import math

from canwall.compiled import Record, compiled
from canwall.walls.deadbeat import (
    LAST,
    LEFT,
    WANTED_V,
    WANTED_Y,
    expect,
    plan_contact,
    two_forces,
)
from canwall.walls.interface import HORIZON, free_step, law
from canwall.walls.mean_force import force_over_interval

_MAX_ITERATIONS = 12
_TOLERANCE = 1e-13


@compiled
def _residual(
    wall: Record, count: int, rest_y: float, rest_v: float, l1: float, l2: float
) -> tuple[float, float, float, float, float]:
    """Return A·max(0, f̄ + Aᵀλ) − δ and A·Aᵀ over the pushing forces: (r₁, r₂, J₁₁, J₁₂, J₂₂).

    Positions are divided by the period, so that both rows of A have the same scale.
    """
    phi, gamma = wall.phi, wall.gamma
    c1, c2 = gamma[0], gamma[1]
    scale = 1.0 / wall.period
    r1, r2 = -rest_y * scale, -rest_v
    j11 = j12 = j22 = 0.0
    for i in range(count - 1, -1, -1):
        a1 = c1 * scale
        force = wall.plan[i] + a1 * l1 + c2 * l2
        if force > 0.0:
            r1 += a1 * force
            r2 += c2 * force
            j11 += a1 * a1
            j12 += a1 * c2
            j22 += c2 * c2
        c1, c2 = phi[0, 0] * c1 + phi[0, 1] * c2, phi[1, 0] * c1 + phi[1, 1] * c2
    return r1, r2, j11, j12, j22


@compiled
def _planned_force(wall: Record, count: int, y_wanted: float, v_wanted: float) -> float:
    """Return the first of `count` forces to the wanted state; NaN if no pushing ones lead there."""
    # The plan starts from the mean forces along the referent; λ corrects what they miss.
    y, v = wall.y, wall.v
    free_y, free_v = wall.y, wall.v
    for i in range(count):
        wall.plan[i], y, v = force_over_interval(wall, y, v)
        wall.plan[i] = max(wall.plan[i], 0.0)
        free_y, free_v = free_step(wall, free_y, free_v, 0.0)
    rest_y, rest_v = y_wanted - free_y, v_wanted - free_v
    l1 = l2 = 0.0
    r1, r2, j11, j12, j22 = _residual(wall, count, rest_y, rest_v, l1, l2)
    size = abs(v_wanted) + abs(free_v) + (abs(y_wanted) + abs(free_y)) / wall.period
    for _ in range(_MAX_ITERATIONS):
        error = r1 * r1 + r2 * r2
        if error <= (_TOLERANCE * size) ** 2:
            break
        determinant = j11 * j22 - j12 * j12
        if determinant > 1e-14 * j11 * j22:
            s1 = (j22 * r1 - j12 * r2) / determinant
            s2 = (j11 * r2 - j12 * r1) / determinant
        elif j11 > 0.0:
            # A single force pushes: the pseudo-inverse goes as far as it reaches.
            square = (j11 + j22) ** 2
            s1 = (j11 * r1 + j12 * r2) / square
            s2 = (j12 * r1 + j22 * r2) / square
        else:
            return math.nan
        share = 1.0
        while True:
            n1, n2 = l1 - share * s1, l2 - share * s2
            t1, t2, k11, k12, k22 = _residual(wall, count, rest_y, rest_v, n1, n2)
            if t1 * t1 + t2 * t2 < error or share < 1e-3:
                break
            share *= 0.5
        if t1 * t1 + t2 * t2 >= error:
            break
        l1, l2, r1, r2, j11, j12, j22 = n1, n2, t1, t2, k11, k12, k22
    if r1 * r1 + r2 * r2 > (1e-9 * size) ** 2:
        return math.nan
    phi, gamma = wall.phi, wall.gamma
    c1, c2 = gamma[0], gamma[1]
    for i in range(count - 1, -1, -1):
        wall.plan[i] = max(0.0, wall.plan[i] + c1 / wall.period * l1 + c2 * l2)
        c1, c2 = phi[0, 0] * c1 + phi[0, 1] * c2, phi[1, 0] * c1 + phi[1, 1] * c2
    return wall.plan[0]


@compiled
def _last_two(wall: Record) -> float:
    """Return the first of the last two forces, keep the second; NaN if one would have to pull."""
    memory = wall.memory
    first, second = two_forces(wall, wall.y, wall.v, memory[WANTED_Y], memory[WANTED_V])
    # A force that should be zero comes out as a rounding error of the larger one.
    rounding = 1e-9 * max(abs(first), abs(second))
    if min(first, second) < -rounding:
        return math.nan
    memory[LAST] = max(second, 0.0)
    return max(first, 0.0)


@law
def push_only(wall: Record) -> float:
    """F = first force of the pushing plan for the rest of the contact, or else the mean force."""
    memory = wall.memory
    left = plan_contact(wall)
    force = math.nan
    if left == 1:
        force = memory[LAST]
    elif left == 2:
        force = _last_two(wall)
    elif 2 < left <= HORIZON:
        force = _planned_force(wall, left, memory[WANTED_Y], memory[WANTED_V])
    if not force >= 0.0:
        # No pushing forces lead there, or the contact is too long to be planned: the mean force
        # does not pull either, and the next plan starts from where it leads.
        memory[LEFT] = 0.0
        force = max(force_over_interval(wall, wall.y, wall.v)[0], 0.0)
    return expect(wall, force)
